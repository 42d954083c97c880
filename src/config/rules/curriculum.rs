//! Rules of a curriculum: every step complete, with room for its vehicles, and a learner that can pass its gates.

use ipc_schema::config::Config;

use super::{ConfigError, LOCALISING_TRAINER, Settings, conflict};

/// Steps fit into a byte of the header's flags, counted from 1.
const MOST_STEPS: usize = 255;

pub(super) fn check(settings: &Settings, config: &Config) -> Result<(), ConfigError> {
    let (steps, traffic) = (&config.curriculum.steps, &config.traffic);
    let refuse = |message: String, help: String| Err(conflict(settings, "curriculum.steps", message, help));
    if steps.len() > MOST_STEPS {
        return refuse(
            format!("`curriculum.steps` has {} steps", steps.len()),
            format!("give at most {MOST_STEPS}"),
        );
    }
    if !steps.is_empty() && config.drives() {
        return refuse(
            "a curriculum is for the localisation task: its steps say how many connected vehicles there are".into(),
            "set task.kind = \"localisation\" or curriculum.steps = []".into(),
        );
    }
    if !steps.is_empty() && (config.run.envs > 1 || config.trainer.ranks > 1) {
        return refuse(
            "a curriculum is decided by one trainer for one environment".into(),
            "set run.envs = 1, and start one trainer, or set curriculum.steps = []".into(),
        );
    }
    if !steps.is_empty() && config.trainer.module != LOCALISING_TRAINER {
        return refuse(
            format!(
                "`trainer.module` = \"{}\" decides about no lessons, which a curriculum waits for",
                config.trainer.module
            ),
            format!("set trainer.module = \"{LOCALISING_TRAINER}\" or curriculum.steps = []"),
        );
    }
    for (number, step) in (1..).zip(steps) {
        let road_users = step.cavs + traffic.others + traffic.pedestrians;
        if road_users > traffic.max_road_users {
            return refuse(
                format!(
                    "step {number} of `curriculum.steps` asks for {road_users} road users, `traffic.max_road_users` is {}",
                    traffic.max_road_users
                ),
                format!("set traffic.max_road_users to {road_users} or more"),
            );
        }
    }
    Ok(())
}
