//! Measures images and radar scans per second, and compares images with general renderers on the same boxes and cameras.

use std::process::Command;

use caraware::{failure::Exit, install};
use serde::{Deserialize, de::DeserializeOwned};

use super::{BenchOptions, BenchReport, ReportTable};

/// The output of `sights-bench camera`.
#[derive(Debug, Deserialize)]
struct CameraFigures {
    rows: Vec<ImageRate>,
    peers: Vec<RendererPeer>,
}

#[derive(Debug, Deserialize)]
struct ImageRate {
    path: String,
    size: [u32; 2],
    ground: String,
    planes: String,
    images_per_s: f64,
}

#[derive(Debug, Deserialize)]
struct RendererPeer {
    name: String,
    size: [u32; 2],
    images_per_s: f64,
    ratio: f64,
    spread: [f64; 2],
}

/// The output of `sights-bench radar`.
#[derive(Debug, Deserialize)]
struct RadarFigures {
    rows: Vec<ScanRate>,
}

#[derive(Debug, Deserialize)]
struct ScanRate {
    ground: String,
    unit: String,
    scans_per_s: f64,
    detections: f64,
}

fn figures<T: DeserializeOwned>(part: &str, options: &BenchOptions) -> Result<T, Exit> {
    let mut command = Command::new(install::program(&options.bin, "sights-bench")?);
    command.arg(part);
    if options.quick {
        command.arg("--quick");
    }
    if let (Some(python), "camera") = (&options.python, part) {
        command.arg("--python").arg(python);
    }
    super::report::from_program(command)
}

/// Runs `sights-bench camera`.
///
/// # Errors
/// The program is not built, or it fails: also where a peer sees another picture.
pub fn camera(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let measured: CameraFigures = figures("camera", options)?;
    let mut report = BenchReport::new(
        "camera",
        "Cameras",
        "500 buildings, 200 moving vehicles, 16 cameras of 90° and 150 m. The figures are processor time on one core, the motion of the \
         vehicles from tick to tick included. On hills the ground is a grid of triangles; elsewhere it is a plane. The peers see one tick of \
         the upright city from the same cameras: the share of pixels that hit something and their mean depth agree within 1 %. Open3D's tree \
         and rays and MuJoCo's scene are made beforehand, and none of their vehicles moves. Their labels are depth, instance and a table's \
         class; ours also has the classes painted on the road and the boxes of the road users. MuJoCo's colours have no fog and no sky."
            .to_owned(),
    );
    let size = |[width, height]: [u32; 2]| format!("{width} × {height}");
    let mut planes: Vec<&str> = Vec::new();
    let mut rows: Vec<Vec<String>> = Vec::new();
    for rate in &measured.rows {
        if !planes.contains(&rate.planes.as_str()) {
            planes.push(&rate.planes);
        }
        let case = [rate.path.clone(), size(rate.size), rate.ground.clone()];
        report.figure(format!("{}, {}", case.join(", "), rate.planes), rate.images_per_s);
        let number = format!("{:.0}", rate.images_per_s);
        match rows.iter_mut().find(|row| row.starts_with(&case)) {
            Some(row) => row.push(number),
            None => rows.push(case.into_iter().chain([number]).collect()),
        }
    }
    let heads: Vec<&str> = ["instructions", "image", "scene"].into_iter().chain(planes).collect();
    let mut ours = ReportTable::new("images/s", &heads);
    ours.rows = rows;
    report.tables.push(ours);
    let mut peers = ReportTable::new(
        "",
        &["peer", "image", "images/s", "ours is faster by", "smallest–largest"],
    );
    for peer in &measured.peers {
        let [smallest, largest] = peer.spread;
        report.figure(format!("ratio to {}, {}", peer.name, size(peer.size)), peer.ratio);
        peers.row([
            peer.name.clone(),
            size(peer.size),
            format!("{:.0}", peer.images_per_s),
            format!("{:.1} ×", peer.ratio),
            format!("{smallest:.1}–{largest:.1}"),
        ]);
    }
    if peers.rows.is_empty() {
        report.text += " No peer is installed on this machine: `make peers`.";
    } else {
        report.tables.push(peers);
    }
    Ok(report)
}

/// Runs `sights-bench radar`.
///
/// # Errors
/// The program is not built, or it fails.
pub fn radar(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let measured: RadarFigures = figures("radar", options)?;
    let mut report = BenchReport::new(
        "radar",
        "Radars",
        "500 buildings, 200 moving vehicles, 16 radars. The figures are processor time on one core with the fastest instructions, the motion of \
         the vehicles from tick to tick included. What a scan costs is mostly its rays: eight side by side in each cell of the azimuth."
            .to_owned(),
    );
    let mut table = ReportTable::new("", &["scene", "radar", "scans/s", "detections a scan"]);
    for row in &measured.rows {
        report.figure(format!("{}, {}", row.ground, row.unit), row.scans_per_s);
        table.row([
            row.ground.clone(),
            row.unit.clone(),
            format!("{:.0}", row.scans_per_s),
            format!("{:.0}", row.detections),
        ]);
    }
    report.tables.push(table);
    Ok(report)
}
