//! Drives a fixed list of held-out trips with each driver, and counts how they end.
//!
//! The trips are those of `caraware.driving.trips`: the heroes that begin the evaluation episodes of a run, so start, destination and the
//! first traffic follow from the seed alone and are the same for every driver.

use std::{
    collections::BTreeMap,
    fs,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

use caraware::{failure::Exit, install};
use clap::ValueEnum as _;
use serde::Deserialize;

use super::{BenchOptions, BenchReport, ReportTable};
use crate::cli::BenchDriver;

/// Heroes that begin each episode: trips of an episode.
const HEROES: u32 = 16;
/// Most episodes of a run. A longer list goes on with the next seed, so that its runs can be driven side by side.
const RUN_EPISODES: u32 = 10;
/// Other vehicles, as shares of the preset's.
const DENSITIES: [f64; 3] = [0.5, 1.0, 1.5];
/// Other vehicles of the preset.
const OTHERS: f64 = 20.0;
/// Longest trip, seconds.
const TIME_LIMIT_S: u32 = 300;
/// A trip is long from here on, metres.
const LONG_M: f64 = 500.0;
/// Normal quantile of a two-sided 95 % interval.
const Z95: f64 = 1.959_964;
/// The ends in the order of the columns.
const ENDS: [&str; 8] = [
    "arrival",
    "collision",
    "off-road",
    "red light",
    "against traffic",
    "blocked",
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

/// A run of the list: the episodes of one seed in one density of traffic.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord)]
struct TripRun {
    /// Index of its driver.
    driver: usize,
    /// Other vehicles.
    others: u32,
    seed: u32,
    episodes: u32,
}

/// The runs of `drivers` drivers: `episodes` of each density, in runs of at most [`RUN_EPISODES`].
fn runs_of(drivers: usize, densities: &[f64], episodes: u32) -> Vec<TripRun> {
    let mut runs = Vec::new();
    for driver in 0..drivers {
        for density in densities {
            for first in (0..episodes).step_by(RUN_EPISODES as usize) {
                runs.push(TripRun {
                    driver,
                    others: (density * OTHERS).round() as u32,
                    seed: 1 + first / RUN_EPISODES,
                    episodes: RUN_EPISODES.min(episodes - first),
                });
            }
        }
    }
    runs
}

#[derive(Debug, Clone, Deserialize)]
struct Trip {
    /// The run that it belongs to.
    #[serde(skip)]
    run: TripRun,
    episode: u64,
    hero: String,
    length_m: f64,
    end: String,
    time_s: f64,
    way_m: f64,
    /// Root of the mean square over its ticks, of the speed's second difference.
    jerk_mps3: f64,
    /// At the end.
    manoeuvre: String,
    /// Stop lines passed, by manoeuvre.
    passed: BTreeMap<String, u32>,
    /// Of a trip that ended by a collision.
    #[serde(default)]
    is_at_fault: bool,
}

impl Trip {
    /// The same for the same trip of another driver.
    fn place(&self) -> (u32, u32, u64, &str) {
        (self.run.others, self.run.seed, self.episode, &self.hero)
    }
}

/// A line of a run's `events/collisions.jsonl`, as far as fault depends on it.
#[derive(Debug, Deserialize)]
struct Contact {
    episode: u64,
    vehicle: String,
    other: String,
    #[serde(flatten)]
    own: ContactBody,
    other_body: Option<ContactBody>,
}

/// How a road user was in a contact.
#[derive(Debug, Deserialize)]
struct ContactBody {
    speed_mps: f64,
    side: String,
}

/// A vehicle that is slower stands.
const STANDS_MPS: f64 = 0.05;

impl Contact {
    /// Whether `hero` is at fault, or `None` if it is not in the contact.
    ///
    /// After nuPlan's classes of collisions (Caesar et al., arXiv 2106.11810): what stands is not at fault, what is struck in its rear is
    /// not, what strikes with its front is, and what strikes with its side is unless the other strikes with its front.
    fn is_fault_of(&self, hero: &str) -> Option<bool> {
        let (own, other) = match (self.vehicle == hero, self.other == hero, &self.other_body) {
            (true, _, other) => (&self.own, other.as_ref()),
            (false, true, Some(own)) => (own, Some(&self.own)),
            _ => return None,
        };
        let is_struck = other.is_some_and(|other| other.side == "front" && other.speed_mps > STANDS_MPS);
        Some(own.speed_mps > STANDS_MPS && own.side != "rear" && (own.side == "front" || !is_struck))
    }
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
        format!("Trips through {}", options.map.as_deref().unwrap_or("the town")),
        format!(
            "Each driver drives the same {} trips: {HEROES} heroes that begin each of {episodes} evaluation episodes, at {} times the \
             traffic of the preset `driving`, at most {TIME_LIMIT_S} s. Their seeds are used by no training. A trip that does not end \
             in time, or by a contact, beside the road, at a red light or against the traffic, is no arrival. Fault is that of nuPlan: a \
             hero that moves and strikes with its front, or with its side what does not strike with its own front. Intervals are \
             Wilson's, 95 %. `sumo` is SUMO's own driver in the hero's place, seen by the same checks. Time is that of trips on \
             which both it and the driver arrive, over its time on the same trips. Jerk is the root of the mean square of a trip, \
             along the vehicle, and the median of trips.",
            episodes * HEROES * densities.len() as u32,
            densities.iter().map(f64::to_string).collect::<Vec<_>>().join(", ")
        ),
    );
    let mut columns = vec!["driver", "trips", "arrived", "95 % interval"];
    columns.extend(&ENDS[1..]);
    columns.extend([
        "collisions per 1 000 km",
        "of these at fault",
        "m/s on the way",
        "time / SUMO's",
        "jerk, m/s³",
    ]);
    let mut all = ReportTable::new("All trips", &columns);
    let mut manoeuvres = ReportTable::new(
        "Collisions by manoeuvre",
        &[
            "driver",
            "manoeuvre",
            "stop lines passed",
            "collisions",
            "of these at fault",
        ],
    );
    let mut long = ReportTable::new(format!("Trips of {LONG_M} m and more"), &columns);
    let drivers = drivers(options)?;
    let mut driven: Vec<Vec<Trip>> = vec![Vec::new(); drivers.len()];
    for trip in drive_all(
        &drivers,
        &runs_of(drivers.len(), densities, episodes),
        &caraware,
        &runs.0,
    )? {
        driven[trip.run.driver].push(trip);
    }
    let yardstick = drivers.iter().position(|driver| driver.key == "sumo");
    let yardstick = yardstick.map_or(Vec::new(), |index| driven[index].clone());
    for (driver, driven) in drivers.iter().zip(&driven) {
        all.push(row(driver, driven, &yardstick));
        for cells in manoeuvre_rows(driver, driven) {
            manoeuvres.push(cells);
        }
        let longer: Vec<Trip> = driven.iter().filter(|trip| trip.length_m >= LONG_M).cloned().collect();
        long.push(row(driver, &longer, &yardstick));
        let (share, [low, high]) = arrivals(driven);
        report.figure(format!("{}, arrived", driver.key), share);
        report.figure(format!("{}, arrived, lower end", driver.key), low);
        report.figure(format!("{}, arrived, upper end", driver.key), high);
    }
    report.tables.extend([all, long, manoeuvres]);
    Ok(report)
}

/// The drivers that are asked for.
///
/// # Errors
/// The policy is asked for, and no file of it is given.
fn drivers(options: &BenchOptions) -> Result<Vec<TripDriver>, Exit> {
    asked(&options.drivers, options.policy.is_some())
        .into_iter()
        .map(|driver| trip_driver(driver, options))
        .collect()
}

/// Each of `drivers` once, in their order; without any, all that there are.
fn asked(drivers: &[BenchDriver], has_policy: bool) -> Vec<BenchDriver> {
    let all = BenchDriver::value_variants().iter().copied();
    let all = all.filter(|driver| has_policy || *driver != BenchDriver::Policy);
    let named = drivers.iter().copied();
    let drivers: Vec<BenchDriver> = if drivers.is_empty() {
        all.collect()
    } else {
        named.collect()
    };
    let mut asked = Vec::new();
    for driver in drivers {
        if !asked.contains(&driver) {
            asked.push(driver);
        }
    }
    asked
}

fn trip_driver(driver: BenchDriver, options: &BenchOptions) -> Result<TripDriver, Exit> {
    let (name, mut settings) = match driver {
        BenchDriver::Random => ("random actions", Vec::new()),
        BenchDriver::Scripted => ("script (pure pursuit)", Vec::new()),
        // With the view of the road ahead that mirrors have of SUMO's paths elsewhere.
        BenchDriver::Sumo => (
            "SUMO's own driver",
            vec!["task.driver=sumo".to_owned(), "vehicle.preview_s=1.5".to_owned()],
        ),
        BenchDriver::Policy => {
            let policy = options.policy.as_ref().ok_or_else(|| {
                Exit::config(
                    "`--drivers policy` without a policy",
                    "give --policy a checkpoint, or maps/town/driver.safetensors",
                )
            })?;
            ("learnt policy", vec![format!("task.begin_from={}", policy.display())])
        }
    };
    settings.extend(options.map.iter().flat_map(|map| map_settings(map)));
    Ok(TripDriver {
        name,
        key: driver.key(),
        settings,
    })
}

/// A run's settings for this map. A file's net may have no projection, and where on Earth it is does not matter to a driver.
fn map_settings(map: &str) -> Vec<String> {
    let mut settings = vec![format!("curriculum.maps=[{map:?}]")];
    if Path::new(map).extension().is_some() {
        settings.extend(["map.origin_latitude_deg=52.0", "map.origin_longitude_deg=10.0"].map(str::to_owned));
    }
    settings
}

/// The trips of all runs, in the order of the runs; as many run at once as three quarters of the cores.
///
/// # Errors
/// A run fails. No other is started after it, and those that are driving end first.
fn drive_all(drivers: &[TripDriver], runs: &[TripRun], caraware: &Path, directory: &Path) -> Result<Vec<Trip>, Exit> {
    let at_once = (thread::available_parallelism().map_or(1, usize::from) * 3 / 4).clamp(1, runs.len().max(1));
    let next = AtomicUsize::new(0);
    let driven = Mutex::new(BTreeMap::new());
    let failed = Mutex::new(None);
    let take = |index: usize| {
        let run = runs.get(index)?;
        let is_over = failed.lock().unwrap_or_else(PoisonError::into_inner).is_some();
        (!is_over).then_some(*run)
    };
    thread::scope(|scope| {
        for _ in 0..at_once {
            scope.spawn(|| {
                while let Some(run) = take(next.fetch_add(1, Ordering::Relaxed)) {
                    match drive(&drivers[run.driver], run, caraware, directory) {
                        Ok(trips) => {
                            let mut driven = driven.lock().unwrap_or_else(PoisonError::into_inner);
                            let (name, share) = (drivers[run.driver].name, arrivals(&trips).0);
                            driven.insert(run, trips);
                            eprintln!(
                                "{} of {} runs: {name}, {} others, seed {}: {:.0} % arrived",
                                driven.len(),
                                runs.len(),
                                run.others,
                                run.seed,
                                100.0 * share
                            );
                        }
                        Err(error) => {
                            let mut failed = failed.lock().unwrap_or_else(PoisonError::into_inner);
                            failed.get_or_insert(error);
                        }
                    }
                }
            });
        }
    });
    match failed.into_inner().unwrap_or_else(PoisonError::into_inner) {
        Some(error) => Err(error),
        None => Ok(driven
            .into_inner()
            .unwrap_or_else(PoisonError::into_inner)
            .into_values()
            .flatten()
            .collect()),
    }
}

/// The trips of one run.
fn drive(driver: &TripDriver, part: TripRun, caraware: &Path, runs: &Path) -> Result<Vec<Trip>, Exit> {
    let name = format!("{}-{}-{}", driver.key, part.others, part.seed);
    let mut settings = vec![
        "trainer.module=caraware.driving.trips".to_owned(),
        format!("run.seed={}", part.seed),
        format!("traffic.heroes={HEROES}"),
        format!("traffic.others={}", part.others),
        format!("task.time_limit_s={TIME_LIMIT_S}"),
        "episode.ticks=1".into(),
        "episode.training_episodes=1".into(),
        // Every hero of the list departs within seconds.
        format!("episode.evaluation_ticks={}", (TIME_LIMIT_S + 10) * 10),
        format!("episode.final_evaluations={}", part.episodes),
        "fanout.enabled=false".into(),
    ];
    settings.extend(driver.settings.iter().cloned());
    let mut command = Command::new(caraware);
    command.args(["train", "driving", "--name", &name, "--runs"]).arg(runs);
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
    let run = runs.join(name);
    let path = run.join("report.json");
    let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
    let unreadable = |error: serde_json::Error| Exit::run(format!("{}: {error}", path.display()), "");
    let result: serde_json::Value = serde_json::from_str(&text).map_err(unreadable)?;
    let mut trips: Vec<Trip> = serde_json::from_value(result["trainer"]["trips"].clone()).map_err(unreadable)?;
    trips.iter_mut().for_each(|trip| trip.run = part);
    find_faults(&mut trips, &run.join("events/collisions.jsonl"))?;
    fs::remove_dir_all(&run).map_err(|error| Exit::io("remove", &run, &error))?;
    Ok(trips)
}

/// Says of the trips that ended by a collision whether the hero was at fault: by the last contact of the hero in that episode.
fn find_faults(trips: &mut [Trip], lines: &Path) -> Result<(), Exit> {
    let text = fs::read_to_string(lines).map_err(|error| Exit::io("read", lines, &error))?;
    let contacts = text.lines().map(serde_json::from_str::<Contact>);
    let contacts: Vec<Contact> =
        Result::from_iter(contacts).map_err(|error| Exit::run(format!("{}: {error}", lines.display()), ""))?;
    for trip in trips.iter_mut().filter(|trip| trip.end == "collision") {
        let of_episode = contacts.iter().filter(|contact| contact.episode == trip.episode);
        let mut faults = of_episode.filter_map(|contact| contact.is_fault_of(&trip.hero));
        // Without a line the hero counts as at fault: its contact was with what no line has.
        trip.is_at_fault = faults.next_back().unwrap_or(true);
    }
    Ok(())
}

/// `yardstick`: the trips of SUMO's driver.
fn row(driver: &TripDriver, trips: &[Trip], yardstick: &[Trip]) -> Vec<String> {
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
    let faults = trips.iter().filter(|trip| trip.is_at_fault).count();
    cells.extend([count("collision"), faults].map(|count| format!("{:.0}", count as f64 / (way_m / 1e6).max(1e-9))));
    cells.push(format!("{:.1}", way_m / f64::max(time_s, 1e-9)));
    cells.push(time_ratio(trips, yardstick).map_or("–".into(), |ratio| format!("{ratio:.2}")));
    let mut jerks: Vec<f64> = trips.iter().map(|trip| trip.jerk_mps3).collect();
    jerks.sort_by(f64::total_cmp);
    cells.push(
        jerks
            .get(jerks.len() / 2)
            .map_or("–".into(), |jerk| format!("{jerk:.1}")),
    );
    cells
}

/// Time of the trips on which both drivers arrive, over that of the yardstick; `None` without such trips.
fn time_ratio(trips: &[Trip], yardstick: &[Trip]) -> Option<f64> {
    let has_arrived = |trip: &&Trip| trip.end == ENDS[0];
    let of_yardstick: BTreeMap<_, f64> = yardstick
        .iter()
        .filter(has_arrived)
        .map(|trip| (trip.place(), trip.time_s))
        .collect();
    let both = trips
        .iter()
        .filter(has_arrived)
        .filter_map(|trip| Some((trip.time_s, of_yardstick.get(&trip.place())?)));
    let (time_s, yardstick_s) = both.fold((0.0, 0.0), |(time_s, yardstick_s), (own_s, other_s)| {
        (time_s + own_s, yardstick_s + other_s)
    });
    (yardstick_s > 0.0).then(|| time_s / yardstick_s)
}

/// One row for each manoeuvre that was driven, and for the ways between them.
fn manoeuvre_rows(driver: &TripDriver, trips: &[Trip]) -> Vec<Vec<String>> {
    let mut counts: BTreeMap<&str, [u32; 3]> = BTreeMap::new();
    for trip in trips {
        for (manoeuvre, passed) in &trip.passed {
            counts.entry(manoeuvre).or_default()[0] += passed;
        }
        if trip.end == "collision" {
            let counts = counts.entry(&trip.manoeuvre).or_default();
            counts[1] += 1;
            counts[2] += u32::from(trip.is_at_fault);
        }
    }
    let row = |(manoeuvre, counts): (&str, [u32; 3])| {
        let mut cells = vec![driver.name.to_owned(), manoeuvre.to_owned()];
        cells.extend(counts.map(|count| count.to_string()));
        cells
    };
    counts.into_iter().map(row).collect()
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
    fn a_net_of_ones_own_needs_no_place_on_earth() {
        assert_eq!(map_settings("avenue"), ["curriculum.maps=[\"avenue\"]"]);
        let own = map_settings("nets/a.net.xml");
        assert_eq!(own[0], "curriculum.maps=[\"nets/a.net.xml\"]");
        assert_eq!(own.len(), 3);
    }

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

    fn trip(end: &str, is_at_fault: bool) -> Trip {
        Trip {
            run: TripRun::default(),
            jerk_mps3: 1.25,
            episode: 0,
            hero: "hero.0".into(),
            length_m: 600.0,
            end: end.into(),
            time_s: 50.0,
            way_m: 500.0,
            manoeuvre: "left turn, yielding".into(),
            passed: BTreeMap::from([("left turn, yielding".into(), 2)]),
            is_at_fault,
        }
    }

    fn driver() -> TripDriver {
        TripDriver {
            name: "d",
            key: "d",
            settings: Vec::new(),
        }
    }

    #[test]
    fn rows_count_every_end_and_every_manoeuvre() {
        let trips = [
            trip("arrival", false),
            trip("collision", false),
            trip("collision", true),
            trip("blocked", false),
            trip("time limit", false),
        ];
        let cells = row(&driver(), &trips, &[]);
        assert_eq!(cells[1..3], ["5", "20.0 %"]);
        assert_eq!(cells[4..11], ["2", "0", "0", "0", "1", "1", "0"]);
        // Two collisions in 2.5 km, one of them at fault, 2.5 km in 250 s.
        assert_eq!(cells[11..], ["800", "400", "10.0", "–", "1.2"]);
        assert_eq!(
            manoeuvre_rows(&driver(), &trips),
            [["d", "left turn, yielding", "10", "2", "1"]]
        );
    }

    #[test]
    fn a_driver_that_is_named_twice_drives_once() {
        use BenchDriver::{Policy, Random, Scripted, Sumo};
        assert_eq!(asked(&[Sumo, Policy, Sumo], true), [Sumo, Policy]);
        assert_eq!(asked(&[], true), [Random, Scripted, Sumo, Policy]);
        assert_eq!(asked(&[], false), [Random, Scripted, Sumo]);
    }

    #[test]
    fn time_is_compared_on_the_trips_on_which_both_arrive() {
        let of = |seed: u32, hero: &str, end: &str, time_s: f64| Trip {
            run: TripRun {
                seed,
                ..TripRun::default()
            },
            hero: hero.into(),
            time_s,
            ..trip(end, false)
        };
        let yardstick = [
            of(1, "hero.0", "arrival", 40.0),
            of(1, "hero.1", "collision", 5.0),
            of(2, "hero.0", "arrival", 60.0),
        ];
        let trips = [
            of(2, "hero.0", "arrival", 90.0),
            of(1, "hero.0", "arrival", 50.0),
            of(1, "hero.1", "arrival", 70.0),
            of(3, "hero.0", "arrival", 80.0),
        ];
        assert_eq!(time_ratio(&trips, &yardstick), Some(1.4));
        assert_eq!(time_ratio(&trips[2..], &yardstick), None);
    }

    #[test]
    fn a_list_begins_with_the_shorter_one_and_goes_on_with_other_seeds() {
        let short = runs_of(2, &DENSITIES, 10);
        assert_eq!(short.len(), 6);
        assert!(short.iter().all(|run| (run.seed, run.episodes) == (1, 10)));
        let long = runs_of(2, &DENSITIES, 63);
        assert_eq!(long.len(), 42);
        assert!(short.iter().all(|run| long.contains(run)));
        let episodes: u32 = long.iter().filter(|run| run.driver == 1).map(|run| run.episodes).sum();
        assert_eq!(episodes, 3 * 63);
        let others: Vec<u32> = long[..21].iter().map(|run| run.others).collect();
        assert_eq!([others[0], others[7], others[20]], [10, 20, 30]);
    }

    #[test]
    fn what_strikes_with_its_front_is_at_fault_and_what_stands_or_is_struck_is_not() {
        let line = |own: &str, own_mps: f64, other: &str, other_mps: f64| {
            let other_body = match other {
                "" => String::new(),
                side => format!(r#","other_body":{{"speed_mps":{other_mps},"side":"{side}"}}"#),
            };
            let line = format!(
                r#"{{"tick":1,"episode":0,"vehicle":"hero.0","what":"vehicle","other":"car.1","speed_mps":{own_mps},"side":"{own}"{other_body}}}"#
            );
            serde_json::from_str::<Contact>(&line).unwrap()
        };
        for (contact, of_hero, of_other) in [
            (line("front", 5.0, "rear", 2.0), Some(true), Some(false)),
            (line("front", 0.0, "front", 2.0), Some(false), Some(true)),
            (line("front", 5.0, "front", 2.0), Some(true), Some(true)),
            (line("left", 5.0, "front", 2.0), Some(false), Some(true)),
            (line("left", 5.0, "right", 2.0), Some(true), Some(true)),
            (line("right", 5.0, "front", 0.0), Some(true), Some(false)),
            (line("rear", 5.0, "front", 9.0), Some(false), Some(true)),
            // A building.
            (line("left", 5.0, "", 0.0), Some(true), None),
        ] {
            let found = [contact.is_fault_of("hero.0"), contact.is_fault_of("car.1")];
            assert_eq!(found, [of_hero, of_other], "{contact:?}");
        }
        assert_eq!(line("front", 5.0, "rear", 2.0).is_fault_of("hero.7"), None);
    }

    #[test]
    fn the_last_contact_of_a_trips_hero_in_its_episode_decides_on_fault() {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("collisions.jsonl");
        let line = |episode: u64, vehicle: &str, side: &str| {
            format!(r#"{{"episode":{episode},"vehicle":"{vehicle}","other":"x","speed_mps":5.0,"side":"{side}"}}"#)
        };
        let lines = [
            line(0, "hero.0", "rear"),
            line(1, "hero.0", "front"),
            line(0, "hero.1", "front"),
        ];
        fs::write(&path, lines.join("\n")).unwrap();
        let mut trips = [
            trip("collision", true),
            trip("arrival", false),
            Trip {
                hero: "hero.1".into(),
                ..trip("collision", false)
            },
        ];
        find_faults(&mut trips, &path).unwrap();
        assert_eq!(trips.map(|trip| trip.is_at_fault), [false, false, true]);
        fs::write(&path, "{}").unwrap();
        let error = find_faults(&mut [], &path).unwrap_err();
        assert!(format!("{error:?}").contains("collisions.jsonl"), "{error:?}");
    }
}
