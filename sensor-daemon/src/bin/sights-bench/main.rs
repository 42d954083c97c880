//! Images and radar scans per second of one core: 500 buildings, 200 moving vehicles, 16 carriers; and images beside general renderers.
//!
//! `sights-bench --help` lists the options. Times are of the thread's processor time, because other work may run on the machine.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "a benchmark that cannot run panics with the reason"
)]

use std::path::PathBuf;

use ipc_schema::process_main::{answer_help, misused};

mod camera;
mod city;
#[path = "../../../tests/lidar_city/mod.rs"]
mod lidar_city;
#[path = "../../../benches/peers/mod.rs"]
mod peers;
mod radar;

const USAGE: &str = "\
usage: sights-bench camera|radar [OPTIONS]

Measures images or radar scans per second of one core; `caraware bench camera` and `bench radar` start it.

  --python PATH  a Python that can `import open3d` and `import mujoco` (`make peers`): they are measured too
  --quick        a small measurement, whose figures say nothing
  --json FILE    where the figures go";

/// How much is measured.
struct BenchSize {
    /// The median of these counts.
    rounds: usize,
    ticks: u64,
}

impl BenchSize {
    const FULL: Self = Self { rounds: 7, ticks: 20 };
    const QUICK: Self = Self { rounds: 1, ticks: 2 };

    /// True if only the fastest instructions are measured, and too little of them.
    fn is_quick(&self) -> bool {
        self.rounds == Self::QUICK.rounds
    }
}

/// Processor time of this thread, seconds.
fn now_s() -> f64 {
    ipc_schema::clock::seconds(rustix::time::ClockId::ThreadCPUTime)
}

fn main() {
    answer_help(USAGE);
    let mut arguments = std::env::args().skip(1);
    let part = arguments.next();
    let (mut python, mut json, mut size) = (None::<PathBuf>, None::<PathBuf>, BenchSize::FULL);
    while let Some(argument) = arguments.next() {
        let mut value = || {
            arguments
                .next()
                .unwrap_or_else(|| misused(&format!("{argument} needs a value"), USAGE))
        };
        match argument.as_str() {
            "--python" => python = Some(value().into()),
            "--json" => json = Some(value().into()),
            "--quick" => size = BenchSize::QUICK,
            other => misused(&format!("unknown option {other}"), USAGE),
        }
    }
    let report = match part.as_deref() {
        Some("camera") => camera::measure(python.as_deref(), &size),
        Some("radar") => radar::measure(&size),
        Some(other) => misused(&format!("{other} is neither camera nor radar"), USAGE),
        None => misused("camera or radar is missing", USAGE),
    };
    if let Some(file) = json {
        std::fs::write(&file, format!("{report:#}\n")).unwrap_or_else(|error| panic!("{}: {error}", file.display()));
    }
}
