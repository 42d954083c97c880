//! What a successor says of itself when it is ready, compared with the run before the old trainer leaves.

use ipc_schema::{SCHEMA_VERSION, config::Config};
use serde::Deserialize;

/// The line on a successor's standard output that it is ready begins with this word; its claims may follow as JSON.
const READY: &str = "ready";

/// What a successor is made for. It need not say everything: what is left out is not compared.
#[derive(Debug, Default, Deserialize)]
#[serde(default)]
pub struct SuccessorClaims {
    schema_version: Option<u32>,
    observation_size: Option<u64>,
    observation_fields: Option<Vec<String>>,
    action_size: Option<u64>,
    task: Option<String>,
    environments: Option<u32>,
    decides_lessons: Option<bool>,
    first_tick: Option<u64>,
}

impl SuccessorClaims {
    /// The claims in the first line of a successor's output; `None` if the line does not say that it is ready.
    #[must_use]
    pub fn of_line(line: &str) -> Option<Result<Self, serde_json::Error>> {
        match line.trim_end().strip_prefix(READY)?.trim_start() {
            "" => Some(Ok(Self::default())),
            claims => Some(serde_json::from_str(claims)),
        }
    }

    /// The first claim that does not fit a run with this configuration, whose journal begins at `journal_first`, as a sentence.
    ///
    /// # Errors
    /// One does not fit.
    pub fn check(&self, config: &Config, journal_first: u64) -> Result<(), String> {
        differ("is built for schema version", self.schema_version, SCHEMA_VERSION)?;
        differ(
            "takes observations of size",
            self.observation_size,
            config.policy_width() as u64,
        )?;
        let fields: Vec<String> = config
            .observation
            .fields
            .iter()
            .map(|field| field.name().into())
            .collect();
        if let Some(claimed) = self.observation_fields.as_ref().filter(|claimed| **claimed != fields) {
            let message = format!(
                "it takes the fields {}, the run's are {}",
                claimed.join(", "),
                fields.join(", ")
            );
            return Err(message);
        }
        differ("is for the task", self.task.as_deref(), config.task.kind.name())?;
        differ("gives actions of size", self.action_size, action_size(config))?;
        differ(
            "learns from this number of environments:",
            self.environments,
            config.run.envs,
        )?;
        if self.decides_lessons == Some(false) && config.trainer_decides_lessons() {
            return Err("it decides no lessons, and the run has a curriculum that waits for them".into());
        }
        match self.first_tick {
            Some(tick) if tick < journal_first => Err(format!(
                "it continues at tick {tick}, the journal begins at tick {journal_first}: its checkpoint is too old"
            )),
            _ => Ok(()),
        }
    }
}

/// Numbers in an action of the run's task.
fn action_size(config: &Config) -> u64 {
    match config.speaks() {
        true => config.v2x.candidates.into(),
        false => 2,
    }
}

/// Compares one claim with the run's value.
fn differ<T: PartialEq + std::fmt::Display>(what: &str, claimed: Option<T>, own: T) -> Result<(), String> {
    match claimed {
        Some(claimed) if claimed != own => Err(format!("it {what} {claimed}, the run's is {own}")),
        _ => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::config::LayeredSettings;

    #[test]
    fn a_successor_may_say_nothing_but_that_it_is_ready() {
        assert!(SuccessorClaims::of_line("ready\n").is_some_and(|claims| claims.is_ok()));
        assert!(SuccessorClaims::of_line("ready {\"first_tick\": 3}\n").is_some_and(|claims| claims.is_ok()));
        assert!(SuccessorClaims::of_line("ready {\"first_tick\": -1}\n").is_some_and(|claims| claims.is_err()));
        assert!(SuccessorClaims::of_line("hello\n").is_none());
        assert!(SuccessorClaims::of_line("").is_none());
    }

    /// The default preset with these settings, in a run whose journal begins at tick 100.
    fn checked(settings: &[&str], claims: &str) -> Result<(), String> {
        let settings: Vec<String> = settings.iter().map(|setting| (*setting).to_owned()).collect();
        let layers = LayeredSettings::defaults().and_then(|layers| layers.with_assignments(&settings));
        let config = layers.and_then(|layers| layers.validate()).unwrap();
        let claims: SuccessorClaims = serde_json::from_str(claims).unwrap();
        claims.check(&config, 100)
    }

    #[test]
    fn each_claim_is_compared_with_the_run() {
        let speaks = [
            "task.kind=messages",
            "trainer.actions_per_observation=1",
            "v2x.share=1.0",
            "v2x.candidates=5",
            "v2x.perception_range_m=60",
        ];
        for (settings, fits, differs, says) in [
            (
                &[][..],
                "{}",
                r#"{"schema_version": 1}"#,
                "is built for schema version 1",
            ),
            (
                &[],
                r#"{"action_size": 2}"#,
                r#"{"action_size": 3}"#,
                "gives actions of size 3, the run's is 2",
            ),
            (
                &speaks,
                r#"{"action_size": 5}"#,
                r#"{"action_size": 2}"#,
                "gives actions of size 2, the run's is 5",
            ),
            (
                &[],
                r#"{"task": "localisation"}"#,
                r#"{"task": "driving"}"#,
                "is for the task driving",
            ),
            (
                &[],
                r#"{"environments": 1}"#,
                r#"{"environments": 2}"#,
                "number of environments: 2",
            ),
            (
                &["run.envs=2"],
                r#"{"environments": 2}"#,
                r#"{"environments": 1}"#,
                "number of environments: 1",
            ),
            (
                &[],
                r#"{"first_tick": 100}"#,
                r#"{"first_tick": 99}"#,
                "the journal begins at tick 100",
            ),
            (&[], "{}", r#"{"observation_size": 1}"#, "takes observations of size 1"),
            (
                &[],
                "{}",
                r#"{"observation_fields": ["speed"]}"#,
                "takes the fields speed",
            ),
        ] {
            assert_eq!(checked(settings, fits), Ok(()), "{fits}");
            let refusal = checked(settings, differs).unwrap_err();
            assert!(refusal.contains(says), "{refusal}");
        }
    }

    #[test]
    fn a_learner_that_decides_no_lessons_does_not_fit_a_curriculum() {
        let claims = |decides| SuccessorClaims {
            decides_lessons: Some(decides),
            ..SuccessorClaims::default()
        };
        let mut config = LayeredSettings::defaults()
            .and_then(|layers| layers.validate())
            .unwrap();
        assert_eq!(claims(false).check(&config, 0), Ok(()));
        config
            .curriculum
            .stages
            .push(serde_json::from_str(r#"{"cavs": 3}"#).unwrap());
        assert!(claims(false).check(&config, 0).unwrap_err().contains("curriculum"));
        assert_eq!(claims(true).check(&config, 0), Ok(()));
    }

    #[test]
    fn a_difference_names_both_values() {
        assert_eq!(
            differ("takes size", Some(3), 4).unwrap_err(),
            "it takes size 3, the run's is 4"
        );
        assert_eq!(differ("takes size", None, 4), Ok(()));
        assert_eq!(differ("takes size", Some(4), 4), Ok(()));
    }
}
