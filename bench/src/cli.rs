//! The command line of `caraware bench`.

use std::path::PathBuf;

use clap::{Parser, ValueEnum};

/// The parts that can be measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BenchPart {
    /// LIDAR: rays per second on one core, compared with Open3D's ray caster (Embree) on the same scene and rays
    Lidar,
    /// Environments: vehicle-steps per second of 1, 2 and 4 environments, compared with one on a single core
    Envs,
    /// Fan-out: lateness and rate of a run with eight viewers (one stopped, one slow), compared with the run alone; kills of the fan-out
    Fanout,
    /// Observation hop: time from publish to a visible tensor, 1 KiB to 16 MiB, compared with pyzmq, pipe and TCP
    Ipc,
    /// The learner: updates per second, compared with Stable-Baselines3 and a plain loop, and its cost of a tick
    Trainer,
    /// The cost of co-simulating 5 000 vehicles, compared with bare SUMO
    Overhead,
    /// 1 000 to 50 000 vehicles: cost and memory of a vehicle; also a motorway, and long steps of SUMO
    Scale,
    /// Vehicle-steps per second, compared with Python loops over TraCI and libsumo, with MetaDrive and with SMARTS
    Peers,
    /// Cameras: images per second on one core, compared with Open3D's ray caster and MuJoCo's software renderer on the same boxes
    Camera,
    /// Radars: scans per second on one core
    Radar,
    /// Messages: delivery over distance, channel load, awareness over the share of radios, age, redundancy, sizes, error after fusion
    #[value(name = "v2x")]
    V2x,
    /// Driving: a fixed list of held-out trips with a random driver, the script, SUMO's own driver, and a learnt policy (`--policy`)
    Driving,
    /// Heroes: agent-steps per second of 16, 64 and 256 heroes that a policy drives, and processor time of a tick by process
    Heroes,
    /// Recording: wall time of a run that is recorded, as a watcher and without loss, compared with the same run alone
    Record,
    /// Watching: wall and processor time of a tick with a recorder beside the run, compared with the same tick of an equal run without
    Watch,
    /// Endurance: kills, stops and replaces every process at random moments, and compares each run with an undisturbed one
    Endurance,
    /// Soak: growth of memory, handles and logs of one long run with viewers and handovers
    Soak,
    /// All of these but v2x, driving, endurance and soak, one after the other
    All,
}

impl BenchPart {
    /// The parts that are measured, in the order of the documentation.
    pub fn measured() -> impl Iterator<Item = Self> {
        Self::value_variants().iter().copied().filter(|part| *part != Self::All)
    }

    /// The parts of `all`: those that measure a speed.
    pub fn speeds() -> impl Iterator<Item = Self> {
        Self::measured().filter(|part| !matches!(part, Self::V2x | Self::Driving | Self::Endurance | Self::Soak))
    }

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> String {
        self.to_possible_value()
            .map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

/// What drives the trips of `driving`.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BenchDriver {
    /// Random actions
    Random,
    /// The script: pure pursuit
    Scripted,
    /// SUMO's own driver
    Sumo,
    /// The policy of `--policy`
    Policy,
}

impl BenchDriver {
    /// Value of `CARAWARE_DRIVER`.
    #[must_use]
    pub const fn key(self) -> &'static str {
        match self {
            Self::Random => "random",
            Self::Scripted => "scripted",
            Self::Sumo => "sumo",
            Self::Policy => "policy",
        }
    }
}

/// Measure a part of caraware on this machine, compared with its peers
#[derive(Debug, Parser, Clone)]
#[command(name = "caraware-bench", bin_name = "caraware bench", max_term_width = 110)]
pub struct BenchArgs {
    /// What to measure
    pub part: BenchPart,
    /// Write the figures to this file as well
    #[arg(long, value_name = "FILE")]
    pub json: Option<PathBuf>,
    /// Draw the curves as pictures into this directory
    #[arg(long, value_name = "DIRECTORY")]
    pub plots: Option<PathBuf>,
    /// Keep the figures in docs/benchmarks/ and regenerate docs/benchmarks.md
    #[arg(long)]
    pub keep: bool,
    /// Measure only a small case: tests that the benchmark works, not how fast caraware is
    #[arg(long, conflicts_with = "keep")]
    pub quick: bool,
    /// Time for which `endurance` disturbs runs, `soak` watches one, and `watch` compares stretches of ticks, minutes; `endurance` completes the last run
    #[arg(long, value_name = "MINUTES", default_value_t = 10)]
    pub minutes: u32,
    /// Seed of the moments and kinds of `endurance`'s disturbances
    #[arg(long, value_name = "SEED", default_value_t = 1)]
    pub seed: u64,
    /// Checkpoint, or file of parameters, of the policy that `driving` compares
    #[arg(long, value_name = "PATH")]
    pub policy: Option<PathBuf>,
    /// Map of `driving`: "avenue", a .net.xml, or a .sumocfg, of which the net is used [default: the town]
    #[arg(long, value_name = "MAP")]
    pub map: Option<String>,
    /// Trips of each driver in `driving`
    #[arg(long, value_name = "TRIPS", default_value_t = 480, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub trips: u32,
    /// Drivers of `driving`, separated by commas [default: all; `policy` needs `--policy`]
    #[arg(long, value_name = "DRIVERS", value_enum, value_delimiter = ',')]
    pub drivers: Vec<BenchDriver>,
    /// Python that has the peers installed [default: that of `make peers`, or the project's]
    #[arg(long, value_name = "PATH")]
    pub python: Option<PathBuf>,
}
