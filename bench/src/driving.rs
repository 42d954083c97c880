//! Drives a fixed list of held-out trips with each driver, and counts how they end.
//!
//! The trips are those of `caraware.driving.trips`: the heroes that begin the evaluation episodes of a run, so start, destination and the
//! first traffic follow from the seed alone and are the same for every driver.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, ReportTable};

/// Heroes that begin each episode: trips of an episode.
const HEROES: u32 = 16;
/// Other vehicles, as shares of the preset's.
const DENSITIES: [f64; 3] = [0.5, 1.0, 1.5];
/// Other vehicles of the preset.
const OTHERS: f64 = 20.0;
/// Longest trip, seconds.
const TIME_LIMIT_S: u32 = 120;
/// A trip is long from here on, metres.
const LONG_M: f64 = 500.0;
/// Normal quantile of a two-sided 95 % interval.
const Z95: f64 = 1.959_964;
/// The ends in the order of the columns.
const ENDS: [&str; 7] = [
    "arrival",
    "collision",
    "off-road",
    "red light",
    "against traffic",
    "time limit",
    "end of the run's episode",
];

/// Which vehicles drive, and how the run is started for it.
#[derive(Debug, Clone)]
struct TripDriver {
    name: &'static str,
    /// Value of `CARAWARE_DRIVER`.
    key: &'static str,
    settings: Vec<String>,
}

#[derive(Debug, Clone, Deserialize)]
struct Trip {
    length_m: f64,
    end: String,
    time_s: f64,
    way_m: f64,
}

/// A directory for the runs. Dropping it removes the directory.
struct TripRuns(PathBuf);

impl Drop for TripRuns {
    fn drop(&mut self) {
        if let Err(error) = fs::remove_dir_all(&self.0) {
            tracing::warn!(%error, path = %self.0.display(), "cannot remove");
        }
    }
}

/// Drives the list with a random policy, the script, SUMO's driver, and the policy of `options.policy`.
///
/// # Errors
/// A run fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let caraware = install::program(&options.bin, "caraware")?;
    let runs = TripRuns(std::env::temp_dir().join(format!("caraware-bench-driving-{}", std::process::id())));
    let densities: &[f64] = if options.quick { &DENSITIES[1..2] } else { &DENSITIES };
    let trips = if options.quick { HEROES } else { options.trips };
    let episodes = trips.div_ceil(HEROES * densities.len() as u32).max(1);
    let mut report = BenchReport::new(
        "driving",
        "Trips through the town",
        format!(
            "Each driver drives the same {} trips: {HEROES} heroes that begin each of {episodes} evaluation episodes, at {} times the \
             traffic of the preset `driving`, at most {TIME_LIMIT_S} s. Their seeds are used by no training. A trip that does not end \
             in time, or by a contact, beside the road, at a red light or against the traffic, is no arrival. Intervals are Wilson's, \
             95 %. `sumo` is SUMO's own driver in the hero's place, seen by the same checks.",
            episodes * HEROES * densities.len() as u32,
            densities.iter().map(f64::to_string).collect::<Vec<_>>().join(", ")
        ),
    );
    let mut columns = vec!["driver", "trips", "arrived", "95 % interval"];
    columns.extend(&ENDS[1..]);
    columns.extend(["collisions per 1 000 km", "m/s on the way"]);
    let mut all = ReportTable::new("All trips", &columns);
    let mut long = ReportTable::new(format!("Trips of {LONG_M} m and more"), &columns);
    for driver in drivers(options) {
        let mut driven = Vec::new();
        for density in densities {
            driven.extend(drive(&driver, *density, episodes, &caraware, &runs.0)?);
        }
        all.push(row(&driver, &driven));
        let longer: Vec<Trip> = driven.iter().filter(|trip| trip.length_m >= LONG_M).cloned().collect();
        long.push(row(&driver, &longer));
        let (share, [low, high]) = arrivals(&driven);
        report.figure(format!("{}, arrived", driver.key), share);
        report.figure(format!("{}, arrived, lower end", driver.key), low);
        report.figure(format!("{}, arrived, upper end", driver.key), high);
    }
    report.tables.extend([all, long]);
    Ok(report)
}

fn drivers(options: &BenchOptions) -> Vec<TripDriver> {
    let driver = |name, key, settings: &[&str]| TripDriver {
        name,
        key,
        settings: settings.iter().map(|&setting| setting.to_owned()).collect(),
    };
    let mut drivers = vec![
        driver("random actions", "random", &[]),
        driver("script (pure pursuit)", "scripted", &[]),
        driver("SUMO's own driver", "sumo", &["task.driver=sumo"]),
    ];
    if let Some(policy) = &options.policy {
        let place = format!("task.begin_from={}", policy.display());
        drivers.push(driver("learnt policy", "policy", &[&place]));
    }
    drivers
}

/// The trips of one driver at one density.
fn drive(driver: &TripDriver, density: f64, episodes: u32, caraware: &Path, runs: &Path) -> Result<Vec<Trip>, Exit> {
    let mut settings = vec![
        "trainer.module=caraware.driving.trips".to_owned(),
        format!("traffic.heroes={HEROES}"),
        format!("traffic.others={}", (density * OTHERS).round()),
        format!("task.time_limit_s={TIME_LIMIT_S}"),
        "episode.ticks=1".into(),
        "episode.training_episodes=1".into(),
        // Every hero of the list departs within seconds.
        format!("episode.evaluation_ticks={}", (TIME_LIMIT_S + 10) * 10),
        format!("episode.final_evaluations={episodes}"),
        "fanout.enabled=false".into(),
    ];
    settings.extend(driver.settings.iter().cloned());
    let mut command = Command::new(caraware);
    command
        .args(["train", "driving", "--name", "trips", "--runs"])
        .arg(runs);
    settings.iter().for_each(|setting| {
        command.args(["--set", setting]);
    });
    let output = command
        .env("CARAWARE_DRIVER", driver.key)
        .stdin(Stdio::null())
        .output()
        .map_err(|error| Exit::io("start", caraware, &error))?;
    if !output.status.success() {
        return Err(Exit::run(
            format!("the trips of {} ended with {}", driver.name, output.status),
            String::from_utf8_lossy(&output.stderr).into_owned(),
        ));
    }
    let run = runs.join("trips");
    let path = run.join("report.json");
    let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
    let unreadable = |error: serde_json::Error| Exit::run(format!("{}: {error}", path.display()), "");
    let result: serde_json::Value = serde_json::from_str(&text).map_err(unreadable)?;
    let trips = serde_json::from_value(result["trainer"]["trips"].clone()).map_err(unreadable)?;
    fs::remove_dir_all(&run).map_err(|error| Exit::io("remove", &run, &error))?;
    Ok(trips)
}

fn row(driver: &TripDriver, trips: &[Trip]) -> Vec<String> {
    let mut ends: BTreeMap<&str, usize> = BTreeMap::new();
    for trip in trips {
        *ends.entry(trip.end.as_str()).or_default() += 1;
    }
    let (share, [low, high]) = arrivals(trips);
    let (way_m, time_s) = trips.iter().fold((0.0, 0.0), |(way_m, time_s), trip| {
        (way_m + trip.way_m, time_s + trip.time_s)
    });
    let count = |end: &str| ends.get(end).copied().unwrap_or(0);
    let mut cells = vec![
        driver.name.to_owned(),
        trips.len().to_string(),
        format!("{:.1} %", 100.0 * share),
        format!("{:.1} – {:.1} %", 100.0 * low, 100.0 * high),
    ];
    cells.extend(ENDS[1..].iter().map(|end| count(end).to_string()));
    cells.push(format!("{:.0}", count("collision") as f64 / (way_m / 1e6).max(1e-9)));
    cells.push(format!("{:.1}", way_m / f64::max(time_s, 1e-9)));
    cells
}

/// Share of arrivals, with its interval.
fn arrivals(trips: &[Trip]) -> (f64, [f64; 2]) {
    let arrived = trips.iter().filter(|trip| trip.end == ENDS[0]).count();
    (
        arrived as f64 / trips.len().max(1) as f64,
        wilson(arrived as f64, trips.len() as f64),
    )
}

/// Wilson's 95 % interval of a share of `successes` in `trials` (Wilson 1927); 0 … 1 without trials.
fn wilson(successes: f64, trials: f64) -> [f64; 2] {
    if trials == 0.0 {
        return [0.0, 1.0];
    }
    let share = successes / trials;
    let square = Z95 * Z95;
    let middle = (share + square / (2.0 * trials)) / (1.0 + square / trials);
    let half =
        Z95 / (1.0 + square / trials) * (share * (1.0 - share) / trials + square / (4.0 * trials * trials)).sqrt();
    [middle - half, middle + half].map(|end| end.clamp(0.0, 1.0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wilsons_interval_has_its_known_values_and_stays_within_a_share() {
        // Newcombe (1998), table I: 81 of 263, 15 of 148, 0 of 20, 1 of 29.
        for (successes, trials, expected) in [
            (81.0, 263.0, [0.2553, 0.3662]),
            (15.0, 148.0, [0.0624, 0.1605]),
            (0.0, 20.0, [0.0, 0.1611]),
            (1.0, 29.0, [0.0061, 0.1718]),
        ] {
            let found = wilson(successes, trials);
            assert!(
                (found[0] - expected[0]).abs() < 1e-4 && (found[1] - expected[1]).abs() < 1e-4,
                "{successes} of {trials}: {found:?}"
            );
        }
        assert_eq!(wilson(0.0, 0.0), [0.0, 1.0]);
    }

    #[test]
    fn a_row_counts_every_end() {
        let trip = |end: &str| Trip {
            length_m: 600.0,
            end: end.into(),
            time_s: 50.0,
            way_m: 500.0,
        };
        let trips: Vec<Trip> = ["arrival", "arrival", "collision", "time limit"].map(trip).into();
        let driver = TripDriver {
            name: "d",
            key: "d",
            settings: Vec::new(),
        };
        let cells = row(&driver, &trips);
        assert_eq!(cells[1..3], ["4", "50.0 %"]);
        assert_eq!(cells[4..10], ["1", "0", "0", "0", "1", "0"]);
        // One collision in 2 km, 2 km in 200 s.
        assert_eq!(cells[10..], ["500", "10.0"]);
    }
}
