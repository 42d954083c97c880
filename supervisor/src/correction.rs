//! What the default learner does where the user says no more: on a scenario it corrects fixes instead of naming places in a map that may
//! be any size (decision 33), and where the world takes its actions it tries one.

use ipc_schema::config::OWN_TRAINER;
use serde_json::Value;

use crate::config::LayeredSettings;

/// What the policy sees of a scenario's vehicles at each of [`CORRECTING_HISTORY`] ticks: the paper's fields and the wheel speed.
const CORRECTING_FIELDS: [&str; 10] = [
    "gnss_x", "gnss_y", "accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z", "compass", "speed",
];

/// Ticks in an observation of a policy that corrects fixes.
const CORRECTING_HISTORY: u32 = 8;

/// Lets our learner correct fixes on a scenario, whose map may be any size, instead of naming places, unless the user says what an
/// action or an observation is, or what stands for a fix in a blackout (decision 33).
pub fn suggest_correction(settings: &mut LayeredSettings, source: &str) {
    let of_user = [
        "task.action",
        "observation.fields",
        "observation.history",
        "blackout.policy",
    ];
    let localises = settings.has_text("task.kind", "localisation") && settings.has_text("trainer.module", OWN_TRAINER);
    if !localises || of_user.iter().any(|key| settings.is_set_by_user(key)) {
        return;
    }
    settings.suggest("task.action", Value::from("correction"), source);
    settings.suggest("observation.fields", Value::from(CORRECTING_FIELDS.to_vec()), source);
    settings.suggest("observation.history", Value::from(CORRECTING_HISTORY), source);
}

/// Lets our learner try one action on an observation where the world takes its actions, unless the user asks for several.
pub fn suggest_one_action(settings: &mut LayeredSettings) {
    let draws = ["driving", "messages"]
        .iter()
        .any(|task| settings.has_text("task.kind", task));
    if draws {
        settings.suggest("trainer.actions_per_observation", Value::from(1), "task.kind");
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use ipc_schema::config::{Config, LocalisationAction};

    use super::*;

    fn settings_of(sets: &[&str]) -> LayeredSettings {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        LayeredSettings::defaults().unwrap().with_assignments(&sets).unwrap()
    }

    #[test]
    fn the_world_takes_one_action_unless_the_user_asks_for_several() {
        let tries = |sets: &[&str]| {
            let mut settings = settings_of(sets);
            suggest_one_action(&mut settings);
            settings.validate().map(|config| config.trainer.actions_per_observation)
        };
        assert_eq!(tries(&[]).unwrap(), 8);
        let drives = ["task.kind=driving", "traffic.heroes=1"];
        assert_eq!(tries(&drives).unwrap(), 1);
        assert!(tries(&[&drives[..], &["trainer.actions_per_observation=8"]].concat()).is_err());
    }

    fn config_of(sets: &[&str]) -> Config {
        let mut settings = settings_of(sets);
        suggest_correction(&mut settings, "a.sumocfg");
        settings.validate().unwrap()
    }

    #[test]
    fn our_learner_corrects_fixes_and_sees_the_ticks_before() {
        let config = config_of(&[]);
        assert_eq!(config.task.action, LocalisationAction::Correction);
        assert_eq!(config.observation.fields.len(), CORRECTING_FIELDS.len());
        assert_eq!(config.observation.history, CORRECTING_HISTORY);
    }

    #[test]
    fn what_the_user_sets_stays() {
        for set in [
            "task.action=place",
            "observation.fields=caraware",
            "observation.history=2",
            "blackout.policy=nan",
            "trainer.module=caraware.fusion.train",
        ] {
            assert_eq!(config_of(&[set]).task.action, LocalisationAction::Place, "{set}");
        }
        assert_eq!(config_of(&["observation.history=2"]).observation.history, 2);
    }
}
