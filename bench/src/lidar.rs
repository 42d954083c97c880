//! Measures the LIDAR's rays per second, compared with general ray tracers on the same scene.

use std::{collections::BTreeMap, process::Command};

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, ReportTable};

/// The output of `lidar-bench`.
#[derive(Debug, Deserialize)]
struct LidarFigures {
    path: String,
    cases: BTreeMap<String, RayRate>,
    lidars: BTreeMap<u32, f64>,
    #[serde(default)]
    peers: BTreeMap<String, RayCasterPeer>,
}

#[derive(Debug, Deserialize)]
struct RayRate {
    rays_per_s: f64,
    spread: [f64; 2],
}

#[derive(Debug, Deserialize)]
struct RayCasterPeer {
    rays_per_s: f64,
    ratio: f64,
    spread: [f64; 2],
}

/// Runs `lidar-bench`.
///
/// # Errors
/// The program is not built, or it fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let mut command = Command::new(install::program(&options.bin, "lidar-bench")?);
    if let Some(python) = &options.python {
        command.arg("--python").arg(python);
    }
    let measured: LidarFigures = super::report::from_program(command)?;
    let mut report = BenchReport::new(
        "lidar",
        "LIDAR",
        format!(
            "500 buildings, 200 moving vehicles, and 16 LIDARs of 32 × 1800 rays with a range of 100 m, noise and tags, whose points are written \
             to shared memory. The figures are processor time on one core with {}. The peers cast the same rays at the same triangles in the \
             same run, and return distances only.",
            measured.path
        ),
    );
    let mega = |rate: f64| format!("{:.1}", rate / 1e6);
    let mut ours = ReportTable::new("", &["scan", "million rays/s", "smallest–largest"]);
    for (name, rate) in &measured.cases {
        let [smallest, largest] = rate.spread.map(mega);
        ours.row([name.clone(), mega(rate.rays_per_s), format!("{smallest}–{largest}")]);
        report.figure(format!("{name}, rays/s"), rate.rays_per_s);
    }
    for (lidars, rate) in &measured.lidars {
        ours.row([
            format!("{lidars} LIDARs, tilted, rolling shutter"),
            mega(*rate),
            String::new(),
        ]);
    }
    report.tables.push(ours);
    let mut peers = ReportTable::new("", &["peer", "million rays/s", "ours is faster by", "smallest–largest"]);
    for (name, peer) in &measured.peers {
        let [smallest, largest] = peer.spread;
        let ratio = format!("{:.1} ×", peer.ratio);
        peers.row([
            name.clone(),
            mega(peer.rays_per_s),
            ratio,
            format!("{smallest:.1}–{largest:.1}"),
        ]);
        report.figure(format!("ratio to {name}"), peer.ratio);
    }
    if peers.rows.is_empty() {
        report.text += " No peer is installed on this machine: `pip install open3d-cpu embreex`.";
    } else {
        report.tables.push(peers);
    }
    Ok(report)
}
