//! The command line of `caraware bench`.

use std::path::PathBuf;

use clap::{Parser, ValueEnum};

/// The parts that can be measured.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum BenchPart {
    /// LIDAR: rays per second on one core beside Open3D's ray caster (Embree), same scene and rays
    Lidar,
    /// Environments: vehicle-steps per second of 1, 2 and 4 side by side, beside one on a single core
    Envs,
    /// Fan-out: lateness and rate of a run with eight viewers, one stopped and one slow, beside the same run alone; kills of the fan-out
    Fanout,
    /// Observation hop: from publish to a visible tensor, 1 KiB to 16 MiB, beside pyzmq, pipe and TCP
    Ipc,
    /// The learner: updates per second beside Stable-Baselines3 and a plain loop, and its cost of a tick
    Trainer,
    /// The cost of co-simulating 5 000 vehicles beside bare SUMO
    Overhead,
    /// 1 000 to 50 000 vehicles: cost and memory of each; a motorway, and long steps of SUMO
    Scale,
    /// Python loops over TraCI and libsumo, MetaDrive and SMARTS: vehicle-steps per second of each, beside ours
    Peers,
    /// Everything above, one after the other
    All,
}

impl BenchPart {
    /// The parts that are measured, in the order of the documentation.
    pub fn measured() -> impl Iterator<Item = Self> {
        Self::value_variants().iter().copied().filter(|part| *part != Self::All)
    }

    /// Its name on the command line.
    #[must_use]
    pub fn name(self) -> String {
        self.to_possible_value()
            .map_or_else(String::new, |value| value.get_name().to_owned())
    }
}

/// Measure a part on this machine, side by side with its peers
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
    /// Small and short: tests that it works, not how fast it is
    #[arg(long, conflicts_with = "keep")]
    pub quick: bool,
    /// Python that has the peers installed [default: what `make peers` installed, or the project's]
    #[arg(long, value_name = "PATH")]
    pub python: Option<PathBuf>,
}
