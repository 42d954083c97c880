//! What a `.sumocfg` sets in the configuration of a run: step, tick, seed and span. What the user sets has precedence.

use ipc_schema::run::Mode;
use serde_json::Value;

use crate::{
    config::LayeredSettings,
    failure::Exit,
    scenario::{SumoScenario, configuration},
};

/// Road users that shared memory is sized for in a scenario, unless the user sets `traffic.max_road_users`.
const ROAD_USERS: u64 = 8192;
/// Length of a tick that is chosen where SUMO's step allows it, milliseconds.
const TICK_MS: u64 = 100;
/// Periods of sensors that follow the tick, unless the user sets them.
const PERIODS: [&str; 4] = [
    "gnss.period_s",
    "imu.period_s",
    "speed_steering.period_s",
    "ultrasonic.period_s",
];

/// Takes step, tick and seed from the scenario unless the user sets them. Road users are always the scenario's own.
///
/// # Errors
/// The user sets the size of a population, or the run would end before it begins.
pub fn apply(settings: &mut LayeredSettings, scenario: &SumoScenario, source: &str) -> Result<(), Exit> {
    for (path, none) in [("traffic.cavs", 1), ("traffic.others", 0), ("traffic.pedestrians", 0)] {
        if settings.is_set_by_user(path) {
            return Err(Exit::config(
                format!("`{path}` is for maps with population control, and {source} has its own road users"),
                "traffic.cav_share and traffic.max_cavs set how many of its vehicles carry sensors; traffic.scale changes its demand",
            ));
        }
        settings.suggest(path, Value::from(none), source);
    }
    // A preset's maps, stages and heroes. Those of a user are refused later, with the keys that a scenario has for them.
    settings.suggest("traffic.heroes", Value::from(0), source);
    settings.suggest("traffic.hero_route", Value::Array(Vec::new()), source);
    settings.suggest("curriculum.maps", Value::Array(Vec::new()), source);
    settings.suggest("curriculum.stages", Value::Array(Vec::new()), source);
    settings.suggest("traffic.step_s", Value::from(scenario.own.step_s), source);
    settings.suggest("run.seed", Value::from(scenario.own.seed), source);
    settings.suggest("traffic.max_road_users", Value::from(ROAD_USERS), source);
    suggest_tick(settings, source);
    let begin_s = settings.number("traffic.begin_s").unwrap_or(scenario.own.begin_s);
    let end_s = settings.number("traffic.end_s").or(scenario.end_s);
    match end_s.filter(|end_s| *end_s <= begin_s) {
        Some(end_s) => Err(Exit::config(
            format!("the run would end at {end_s} s of SUMO's time, and it begins at {begin_s} s"),
            "set --end after --begin: both are SUMO's time, and a saved state (load-state) brings its own",
        )),
        None => Ok(()),
    }
}

/// Lets a tick divide SUMO's step: the tick that is nearest to 0.1 s, in whole milliseconds, as SUMO counts.
fn suggest_tick(settings: &mut LayeredSettings, source: &str) {
    if settings.is_set_by_user("run.tick_s") {
        return;
    }
    let Some(tick_s) = settings.number("traffic.step_s").and_then(fitting_tick_s) else {
        return;
    };
    settings.suggest("run.tick_s", Value::from(tick_s), source);
    for period in PERIODS {
        settings.suggest(period, Value::from(tick_s), source);
    }
}

/// The tick for a step of SUMO, seconds; `None` if 0.1 s fits, or if the step is no whole number of milliseconds.
fn fitting_tick_s(step_s: f64) -> Option<f64> {
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "validated: at most 10 s; a negative step becomes 0 and has no tick"
    )]
    let step_ms = (step_s * 1000.0).round() as u64;
    if step_ms == 0 || step_ms.is_multiple_of(TICK_MS) {
        return None;
    }
    // By ratio: half of 0.1 s is as far from it as twice.
    let distance = |tick_ms: &u64| (tick_ms.max(&TICK_MS) * 1_000_000) / tick_ms.min(&TICK_MS);
    let divisors = (1..=step_ms).filter(|tick_ms| step_ms.is_multiple_of(*tick_ms));
    #[expect(clippy::cast_precision_loss, reason = "a few thousand at most")]
    let seconds = |tick_ms: u64| tick_ms as f64 / 1000.0;
    divisors.min_by_key(distance).map(seconds)
}

/// `caraware simulate` runs a scenario once, to its end.
///
/// # Errors
/// The user limits the length of an episode, which only training has.
pub fn check_length(settings: &LayeredSettings, mode: Mode, is_scenario: bool) -> Result<(), Exit> {
    let is_ignored = is_scenario && mode == Mode::Simulate && settings.is_set_by_user("episode.ticks");
    match is_ignored {
        true => Err(Exit::config(
            "`episode.ticks` is the length of a training episode, and `caraware simulate` runs a .sumocfg once, to its end",
            "limit the run with --end, SUMO's time: `--end 600` or `--end 0:10:0`",
        )),
        false => Ok(()),
    }
}

/// Reads a time of the command line as SUMO does, seconds.
///
/// # Errors
/// The text is no time.
pub fn time_argument(option: &str, text: &str) -> Result<f64, Exit> {
    configuration::time_s(text).ok_or_else(|| {
        Exit::config(
            format!("{option} {text} is no time"),
            "write seconds such as 600, or H:M:S such as 0:10:0",
        )
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::SumoScenario;

    #[test]
    fn a_tick_divides_the_step_and_is_near_a_tenth_of_a_second() {
        let ticks = [
            (0.05, Some(0.05)),
            (0.1, None),
            (0.15, Some(0.075)),
            (0.25, Some(0.125)),
            (0.333, Some(0.111)),
            (0.101, Some(0.101)),
            (0.5, None),
            (1.0, None),
            (1.007, Some(0.053)),
            (0.001, Some(0.001)),
            (0.0, None),
        ];
        for (step_s, tick_s) in ticks {
            assert_eq!(fitting_tick_s(step_s), tick_s, "{step_s}");
        }
    }

    fn settings(step_s: f64, set: &[&str]) -> Result<LayeredSettings, Exit> {
        let set: Vec<String> = set.iter().map(|text| (*text).to_owned()).collect();
        let mut settings = LayeredSettings::defaults().unwrap().with_assignments(&set)?;
        let mut scenario = SumoScenario::default();
        scenario.own.step_s = step_s;
        apply(&mut settings, &scenario, "a.sumocfg")?;
        Ok(settings)
    }

    #[test]
    fn sensors_follow_the_tick_of_the_step_unless_the_user_sets_them() {
        for step_s in [0.05, 0.15, 0.25, 0.1, 1.0, 0.333] {
            let config = settings(step_s, &[]).unwrap().validate().unwrap();
            assert_eq!(config.traffic.step_s, step_s);
            let sampled_s = [
                config.gnss.period_s,
                config.imu.period_s,
                config.speed_steering.period_s,
            ];
            assert_eq!(sampled_s, [config.run.tick_s; 3], "{step_s}");
        }
        let chosen = settings(0.5, &["traffic.step_s=0.25"]).unwrap().validate().unwrap();
        assert_eq!(chosen.run.tick_s, 0.125);
        let own = settings(0.25, &["run.tick_s=0.05", "gnss.period_s=0.5"])
            .unwrap()
            .validate()
            .unwrap();
        assert_eq!((own.run.tick_s, own.gnss.period_s, own.imu.period_s), (0.05, 0.5, 0.1));
    }

    #[test]
    fn a_run_that_would_end_before_it_begins_is_refused() {
        let said = settings(1.0, &["traffic.begin_s=60", "traffic.end_s=60"])
            .unwrap_err()
            .summary()
            .0;
        assert!(
            said.contains("end at 60 s") && said.contains("begins at 60 s"),
            "{said}"
        );
        assert!(settings(1.0, &["traffic.end_s=60"]).is_ok());
        let settings = settings(1.0, &["episode.ticks=60"]).unwrap();
        assert!(check_length(&settings, Mode::Simulate, true).is_err());
        assert!(
            check_length(&settings, Mode::Train, true).is_ok()
                && check_length(&settings, Mode::Simulate, false).is_ok()
        );
    }
}
