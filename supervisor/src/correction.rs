//! The default learner on a scenario: it corrects fixes instead of naming places in a map that may be any size (decision 33).

use serde_json::Value;

use crate::config::{LayeredSettings, rules::OWN_TRAINER};

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

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use ipc_schema::config::{Config, LocalisationAction};

    use super::*;

    fn config_of(sets: &[&str]) -> Config {
        let sets: Vec<String> = sets.iter().map(|set| (*set).to_owned()).collect();
        let mut settings = LayeredSettings::defaults().unwrap().with_assignments(&sets).unwrap();
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
