//! Measures the alternatives: Python loops over TraCI and libsumo on the same traffic, MetaDrive and SMARTS.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
};

use caraware::{failure::Exit, generate::GeneratedCity, install, install::Install};
use serde::Deserialize;

use super::{
    BenchOptions, BenchReport, MedianSpread, ReportTable,
    report::from_program,
    sides::{BenchDirectory, ComparedScenario, OurRun, compare_results},
    stages::StageTimes,
};

/// The sizes of a measurement.
struct PeersSize {
    /// Vehicles of the large city, all on the road throughout.
    vehicles: u32,
    /// Simulated time of the large city, seconds.
    duration_s: f64,
    /// Steps of the TraCI loop, which is slow and makes only a part of the city's steps.
    traci_steps: u32,
    /// Simulated time of the small city, seconds: long enough to make the import of torch a small part.
    few_duration_s: f64,
    /// Wall time of each case of a driving environment, seconds.
    driving_s: f64,
    /// Rounds; each measures caraware and every peer once.
    rounds: usize,
}

const SIZE: PeersSize = PeersSize {
    vehicles: 5000,
    duration_s: 60.0,
    traci_steps: 20,
    few_duration_s: 6000.0,
    driving_s: 10.0,
    rounds: 5,
};
/// The same with `--quick`.
const QUICK: PeersSize = PeersSize {
    vehicles: 60,
    duration_s: 6.0,
    traci_steps: 5,
    few_duration_s: 6.0,
    driving_s: 0.2,
    rounds: 1,
};
/// SUMO's step, seconds.
const STEP_S: f64 = 0.1;
/// Least `traffic.max_road_users` of a run: the default demand must fit, although a scenario replaces it.
const LEAST_ROOM: u32 = 64;
/// Vehicles of the small city: as many as MetaDrive's roundabout has agents.
const FEW: u32 = 40;

/// A driving environment that is installed in its own virtual environment.
struct DrivingPeer {
    /// Its name in the report.
    name: &'static str,
    /// Its name in `caraware_bench.peer`.
    peer: &'static str,
    /// Directory of its virtual environment.
    environment: &'static str,
}

const DRIVING: [DrivingPeer; 2] = [
    DrivingPeer {
        name: "MetaDrive",
        peer: "metadrive",
        environment: ".venv-metadrive",
    },
    DrivingPeer {
        name: "SMARTS",
        peer: "smarts",
        environment: ".venv-smarts",
    },
];

/// The output of `caraware_bench.peer`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
enum PeerAnswer {
    /// The peer was measured.
    Rates {
        version: String,
        /// Case → steps of a vehicle in a wall second.
        rates: BTreeMap<String, f64>,
        /// Case → processor time of a step of a vehicle, microseconds, of all processes of the peer.
        cpu_us: BTreeMap<String, f64>,
    },
    /// The peer is not installed.
    Missing { missing: String },
}

/// The answers of one kind of peers in all rounds.
#[derive(Debug, Default)]
struct PeerRounds {
    /// Case → rates, one for each round.
    rates: BTreeMap<String, Vec<f64>>,
    /// Case → processor time of a step of a vehicle, microseconds, one for each round.
    cpu_us: BTreeMap<String, Vec<f64>>,
    /// Peer → the reason why it was not measured.
    missing: BTreeMap<String, String>,
    /// Peer → version.
    versions: BTreeMap<String, String>,
}

impl PeerRounds {
    fn add(&mut self, peer: &str, answer: PeerAnswer, install_by: &str) {
        match answer {
            PeerAnswer::Rates { version, rates, cpu_us } => {
                self.versions.insert(peer.into(), version);
                for (case, each_us) in cpu_us {
                    self.cpu_us.entry(case).or_default().push(each_us);
                }
                for (case, rate) in rates {
                    self.rates.entry(case).or_default().push(rate);
                }
            }
            PeerAnswer::Missing { missing } => {
                let why = format!("not installed: {missing} (`make {install_by}`)");
                self.missing.insert(peer.into(), why);
            }
        }
    }
}

/// All measurements, by round.
#[derive(Debug, Default)]
struct PeersFigures {
    /// Ours on the large city: sensed vehicle-steps per wall second.
    many: Vec<f64>,
    /// Processor time of one of these steps in the loop, all processes, microseconds.
    many_cpu_us: Vec<f64>,
    /// As `many`, on the small city.
    few: Vec<f64>,
    /// As `many_cpu_us`, on the small city.
    few_cpu_us: Vec<f64>,
    loops: PeerRounds,
    driving: PeerRounds,
}

impl PeersFigures {
    fn versions(&self) -> String {
        let all = self.loops.versions.iter().chain(&self.driving.versions);
        let named: Vec<String> = all.map(|(peer, version)| format!("{peer} {version}")).collect();
        named.join(", ")
    }
}

/// Measures caraware and every peer in turn.
///
/// # Errors
/// A run fails, an installed peer fails, or SUMO's results differ between ours and the loop over libsumo.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let size = if options.quick { &QUICK } else { &SIZE };
    // All cities share one directory, which numbers their runs.
    let place = BenchDirectory::new("peers")?;
    let (many, _) = city(options, &place, size.vehicles, size.duration_s)?;
    let (few, few_net) = city(options, &place, FEW, size.few_duration_s)?;
    let mut measured = PeersFigures::default();
    for _ in 0..size.rounds {
        let results = run_loops(options, size, &many, &mut measured.loops)?;
        let ours = many.ours()?;
        if let Some(theirs) = results {
            compare_results(&theirs, &ours.results)?;
        }
        measured.many.push(ours.number("/env_steps_per_s")?);
        measured.many_cpu_us.push(cpu_us(&ours)?);
        for peer in &DRIVING {
            let answer = run_driving(options, &place, peer, &few_net, size.driving_s)?;
            let install_by = format!("peers-{}", peer.peer);
            measured.driving.add(peer.name, answer, &install_by);
        }
        let ours = few.ours()?;
        measured.few.push(ours.number("/env_steps_per_s")?);
        measured.few_cpu_us.push(cpu_us(&ours)?);
    }
    report(size, &measured)
}

/// Processor time of a sensed vehicle-step in the loops of all processes, microseconds.
fn cpu_us(ours: &OurRun) -> Result<f64, Exit> {
    let stages = StageTimes::of(ours)?;
    Ok(stages.per_step_us(stages.sum_s()))
}

/// Generates a city for both sides; returns it with its net.
fn city<'a>(
    options: &BenchOptions,
    place: &'a BenchDirectory,
    vehicles: u32,
    duration_s: f64,
) -> Result<(ComparedScenario<'a>, PathBuf), Exit> {
    let install = Install::find()?;
    let directory = place.path().join(format!("city-{vehicles}"));
    let sumocfg = GeneratedCity::of(vehicles, duration_s, STEP_S, 1).write(&install, &directory)?;
    let scenario = ComparedScenario::new(options, place, install, sumocfg, 1.0, vehicles.max(LEAST_ROOM))?;
    Ok((scenario, directory.join("city.net.xml")))
}

/// Runs both Python loops over SUMO. Returns the directory of SUMO's results of the loop over libsumo, which runs to the end.
fn run_loops(
    options: &BenchOptions,
    size: &PeersSize,
    city: &ComparedScenario,
    rounds: &mut PeerRounds,
) -> Result<Option<PathBuf>, Exit> {
    let python = match &options.python {
        Some(python) => python.clone(),
        None => install::python(&options.bin)?,
    };
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "some hundred steps"
    )]
    let all_steps = (size.duration_s / STEP_S).round() as u32;
    let run = |peer: &str, steps: u32| -> Result<(PeerAnswer, PathBuf), Exit> {
        let (command, results) = city.python_loop(&python, peer, steps)?;
        Ok((from_program(command)?, results))
    };
    let (traci, _) = run("traci", size.traci_steps)?;
    rounds.add("TraCI", traci, "build");
    let (libsumo, results) = run("libsumo", all_steps)?;
    let results = matches!(libsumo, PeerAnswer::Rates { .. }).then_some(results);
    rounds.add("libsumo", libsumo, "peers");
    Ok(results)
}

/// Measures one driving environment with its own Python.
fn run_driving(
    options: &BenchOptions,
    place: &BenchDirectory,
    peer: &DrivingPeer,
    net: &Path,
    seconds: f64,
) -> Result<PeerAnswer, Exit> {
    let Some(python) = install::environment_python(&options.bin, peer.environment) else {
        let missing = format!("{} does not exist", peer.environment);
        return Ok(PeerAnswer::Missing { missing });
    };
    let mut command = Command::new(python);
    command
        .args(["-m", "caraware_bench.peer", peer.peer, "--net"])
        .arg(net)
        .args(["--seconds", &seconds.to_string()])
        // SMARTS writes logs to the home directory.
        .env("HOME", place.path());
    from_program(command)
}

fn report(size: &PeersSize, measured: &PeersFigures) -> Result<BenchReport, Exit> {
    let PeersSize {
        vehicles,
        duration_s,
        traci_steps,
        rounds,
        ..
    } = size;
    let mut report = BenchReport::new(
        "peers",
        "Beside Python loops over SUMO, MetaDrive and SMARTS",
        format!(
            "Vehicle-steps per wall second without loading; only the import of torch in our consumer counts, against ours. caraware (ours) and the \
             peers are measured in turn; figures are medians of {rounds} rounds, and a ratio compares one round (smallest–largest). Ours runs as several \
             processes on all cores. A loop over libsumo and each driving environment are one Python process, a loop over TraCI is two processes \
             that wait for each other. So the processor time of a vehicle-step stands beside the rate: it is that of all processes of a side in \
             their loops, and does not count cores. SUMO and the peers use the allocator of the system, `traffic-bridge` uses mimalloc. Ours \
             reads every vehicle's state each 0.1 s, moves every vehicle at 100 Hz, samples its GNSS, IMU, speed and steering, and delivers them to \
             a torch tensor in the consumer's process. The Python loops run the same generated city of {vehicles} vehicles at steps of 0.1 s, with \
             SUMO's own time included. For every vehicle they call the getters that `traffic-bridge` calls at every step (position, angle, speed, \
             and signals at every fourth step), and compute nothing from them. The loop over libsumo runs to the end at {duration_s} s and leaves \
             the same results of SUMO as ours; the loop over TraCI makes {traci_steps} steps. The driving environments step their agents by 0.1 s; \
             resets do not count. Their vehicle models and observations differ from ours and from each other, so the comparison is the number of \
             vehicles of which a learner gets a new observation in a second. MetaDrive drives 40 agents with its Bullet physics (without a window, \
             with the models and textures of its version 0.3.0.1). SMARTS has eight agents, moved by its lane-following controller, and no other \
             traffic on the net of our city of {FEW} vehicles. Versions: {}.",
            measured.versions()
        ),
    );
    let loops = loops_table(measured, &mut report)?;
    let driving = driving_table(size, measured, &mut report)?;
    report.tables = vec![loops, driving];
    Ok(report)
}

fn loops_table(measured: &PeersFigures, report: &mut BenchReport) -> Result<ReportTable, Exit> {
    let mut table = ReportTable::new(
        "Python loops that read every vehicle of SUMO",
        &[
            "how",
            "vehicle-updates/s",
            "ours is faster by",
            "smallest–largest",
            "CPU µs per vehicle-update",
            "ours takes of it",
        ],
    );
    let ours = MedianSpread::of(measured.many.iter().copied())?;
    report.figure("ours, vehicle-steps/s", ours.median);
    table.row([
        "ours, with dynamics, sensors and delivery".into(),
        format!("{:.0}", ours.median),
        String::new(),
        String::new(),
        format!("{:.2}", MedianSpread::of(measured.many_cpu_us.iter().copied())?.median),
        String::new(),
    ]);
    for (case, theirs) in &measured.loops.rates {
        let rate = MedianSpread::of(theirs.iter().copied())?;
        let ratio = ratio(&measured.many, theirs)?;
        report.figure(format!("{case}, vehicle-updates/s"), rate.median);
        report.figure(format!("ratio to {case}"), ratio.median);
        let [cpu, share] = cpu_cells(&measured.many_cpu_us, &measured.loops, case, report)?;
        table.row([
            case.clone(),
            format!("{:.0}", rate.median),
            format!("{:.2} ×", ratio.median),
            format!("{:.2}–{:.2}", ratio.smallest, ratio.largest),
            cpu,
            share,
        ]);
    }
    for (peer, why) in &measured.loops.missing {
        table.push(missing_row(peer, why, table.columns.len()));
    }
    Ok(table)
}

fn driving_table(size: &PeersSize, measured: &PeersFigures, report: &mut BenchReport) -> Result<ReportTable, Exit> {
    let (of_many, of_few) = (
        format!("ours, {} vehicles, is faster by", size.vehicles),
        format!("ours, {FEW} vehicles, is faster by"),
    );
    let share_of_few = format!("ours, {FEW} vehicles, takes of it");
    let mut table = ReportTable::new(
        "Driving environments",
        &[
            "environment",
            "agent-steps/s",
            &of_many,
            &of_few,
            "CPU µs per agent-step",
            &share_of_few,
        ],
    );
    let ours = [
        (size.vehicles, &measured.many, &measured.many_cpu_us),
        (FEW, &measured.few, &measured.few_cpu_us),
    ];
    for (vehicles, rates, cpu_us) in ours {
        table.row([
            format!("ours, {vehicles} vehicles"),
            format!("{:.0}", MedianSpread::of(rates.iter().copied())?.median),
            String::new(),
            String::new(),
            format!("{:.2}", MedianSpread::of(cpu_us.iter().copied())?.median),
            String::new(),
        ]);
    }
    for (case, theirs) in &measured.driving.rates {
        let rate = MedianSpread::of(theirs.iter().copied())?;
        let (many, few) = (ratio(&measured.many, theirs)?, ratio(&measured.few, theirs)?);
        report.figure(format!("{case}, agent-steps/s"), rate.median);
        report.figure(format!("ratio to {case}"), many.median);
        report.figure(format!("ratio of ours with {FEW} vehicles to {case}"), few.median);
        let [cpu, share] = cpu_cells(&measured.few_cpu_us, &measured.driving, case, report)?;
        table.row([
            case.clone(),
            format!("{:.0}", rate.median),
            format!("{many:.0} ×"),
            format!("{few:.0} ×"),
            cpu,
            share,
        ]);
    }
    for (peer, why) in &measured.driving.missing {
        table.push(missing_row(peer, why, table.columns.len()));
    }
    Ok(table)
}

/// A peer's processor time of a vehicle-step, and ours as a share of it, round by round.
fn cpu_cells(ours: &[f64], theirs: &PeerRounds, case: &str, report: &mut BenchReport) -> Result<[String; 2], Exit> {
    let theirs = theirs.cpu_us.get(case).map(Vec::as_slice).unwrap_or_default();
    let (each, share) = (MedianSpread::of(theirs.iter().copied())?, ratio(ours, theirs)?);
    report.figure(format!("{case}, CPU µs per vehicle-step"), each.median);
    report.figure(format!("CPU of ours as a share of {case}"), share.median);
    Ok([format!("{:.2}", each.median), format!("{share:.3} ×")])
}

/// The row of a peer that was not measured.
fn missing_row(peer: &str, why: &str, columns: usize) -> Vec<String> {
    let mut cells = vec![peer.to_owned(), why.to_owned()];
    cells.resize(columns, String::new());
    cells
}

/// Ratio of our figure to theirs, round by round.
fn ratio(ours: &[f64], theirs: &[f64]) -> Result<MedianSpread, Exit> {
    MedianSpread::of(ours.iter().zip(theirs).map(|(ours, theirs)| ours / theirs))
}

#[cfg(test)]
#[allow(clippy::unwrap_used, clippy::float_cmp, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    fn answer(json: &str) -> PeerAnswer {
        serde_json::from_str(json).unwrap()
    }

    #[test]
    fn a_peer_that_is_not_installed_has_a_row_with_the_reason() {
        let mut measured = PeersFigures {
            many: vec![200.0, 300.0],
            many_cpu_us: vec![6.0, 9.0],
            few: vec![50.0, 50.0],
            few_cpu_us: vec![4.0, 4.0],
            ..PeersFigures::default()
        };
        for rate in ["100", "100"] {
            let fast = answer(&format!(
                r#"{{"version": "1", "rates": {{"libsumo loop": {rate}}}, "cpu_us": {{"libsumo loop": 10}}}}"#
            ));
            measured.loops.add("libsumo", fast, "peers");
            let absent = answer(r#"{"missing": "No module named 'smarts'"}"#);
            measured.driving.add("SMARTS", absent, "peers-smarts");
        }
        let report = report(&QUICK, &measured).unwrap();
        assert_eq!(report.figures["ratio to libsumo loop"], 2.5);
        let [loops, driving] = report.tables.as_slice() else {
            unreachable!("{report}")
        };
        assert_eq!(
            loops.rows[1],
            [
                "libsumo loop",
                "100",
                "2.50 ×",
                "2.00–3.00",
                "10.00",
                "0.750 (0.600–0.900) ×"
            ]
        );
        assert_eq!(
            driving.rows.last().unwrap()[..2],
            [
                "SMARTS",
                "not installed: No module named 'smarts' (`make peers-smarts`)"
            ]
        );
    }
}
