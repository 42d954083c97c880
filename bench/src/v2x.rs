//! Messages between vehicles: the curves that papers on collective perception publish, in a grid of streets with houses.

use std::{collections::BTreeMap, process::Command};

use caraware::{failure::Exit, install};
use serde::Deserialize;

use super::{BenchOptions, BenchReport, CurveLine, ReportCurve, ReportTable};

/// The output of `v2x-bench`.
#[derive(Debug, Deserialize)]
struct MessageCurves {
    vehicles: usize,
    seconds: f64,
    delivery: BTreeMap<String, Vec<[f64; 3]>>,
    cases: Vec<MessageCase>,
    cpm_sizes: Vec<[f64; 3]>,
}

#[derive(Debug, Deserialize)]
struct MessageCase {
    share: f64,
    has_perception: bool,
    channel_busy_ratio: f64,
    cams_per_s: f64,
    cpms_per_s: f64,
    cpm_bytes: f64,
    cpm_objects: f64,
    awareness: f64,
    redundancy: f64,
    age_s: [f64; 2],
    newest_error_m: f64,
    fused_error_m: f64,
}

impl MessageCase {
    fn messages(&self) -> &'static str {
        match self.has_perception {
            true => "CAM and CPM",
            false => "CAM",
        }
    }
}

/// Runs `v2x-bench`.
///
/// # Errors
/// The program is not built, or it fails.
pub fn measure(options: &BenchOptions) -> Result<BenchReport, Exit> {
    let mut command = Command::new(install::program(&options.bin, "v2x-bench")?);
    if options.quick {
        command.arg("--quick");
    }
    let measured: MessageCurves = super::report::from_program(command)?;
    let mut report = BenchReport::new(
        "v2x",
        "Messages between vehicles",
        format!(
            "{} vehicles at 25 a kilometre in a grid of streets with a house in each block of 100 m, for {} s. Fixes err by 1 m on each axis, \
             slowly; vehicles perceive others within 80 m by 0.5 m. All figures are of the simulation and none of this machine.",
            measured.vehicles, measured.seconds
        ),
    );
    report.tables.push(awareness_table(&measured.cases));
    report.tables.push(message_table(&measured.cases));
    report.tables.push(delivery_table(&measured.delivery));
    for case in &measured.cases {
        let name = format!("{}, {:.0} % with a radio", case.messages(), 100.0 * case.share);
        for (what, value) in [
            ("awareness within 100 m", case.awareness),
            ("channel busy ratio", case.channel_busy_ratio),
            ("views of a known vehicle", case.redundancy),
            ("median age, s", case.age_s[0]),
            ("error of the newest view, m", case.newest_error_m),
            ("error after fusion, m", case.fused_error_m),
        ] {
            report.figure(format!("{name}: {what}"), value);
        }
    }
    report.curves = curves(&measured);
    Ok(report)
}

fn awareness_table(cases: &[MessageCase]) -> ReportTable {
    let mut table = ReportTable::new(
        "What a vehicle knows of those within 100 m",
        &[
            "messages",
            "with a radio",
            "known",
            "views of each",
            "age, median",
            "age, 95 %",
            "error of the newest view",
            "error after fusion",
        ],
    );
    for case in cases {
        table.row([
            case.messages().into(),
            format!("{:.0} %", 100.0 * case.share),
            format!("{:.1} %", 100.0 * case.awareness),
            format!("{:.2}", case.redundancy),
            format!("{:.2} s", case.age_s[0]),
            format!("{:.2} s", case.age_s[1]),
            format!("{:.2} m", case.newest_error_m),
            format!("{:.2} m", case.fused_error_m),
        ]);
    }
    table
}

fn message_table(cases: &[MessageCase]) -> ReportTable {
    let mut table = ReportTable::new(
        "What it costs the channel",
        &[
            "messages",
            "with a radio",
            "channel busy",
            "CAM/s",
            "CPM/s",
            "bytes of a CPM",
            "objects in it",
        ],
    );
    for case in cases {
        table.row([
            case.messages().into(),
            format!("{:.0} %", 100.0 * case.share),
            format!("{:.1} %", 100.0 * case.channel_busy_ratio),
            format!("{:.1}", case.cams_per_s),
            format!("{:.1}", case.cpms_per_s),
            format!("{:.0}", case.cpm_bytes),
            format!("{:.1}", case.cpm_objects),
        ]);
    }
    table
}

fn delivery_table(delivery: &BTreeMap<String, Vec<[f64; 3]>>) -> ReportTable {
    let mut table = ReportTable::new(
        "Share of messages that arrive, all vehicles with a radio, CAM and CPM",
        &["link", "at", "arrive", "messages"],
    );
    for (state, points) in delivery {
        for [distance_m, share, messages] in points {
            table.row([
                state.clone(),
                format!("{distance_m:.0} m"),
                format!("{:.1} %", 100.0 * share),
                format!("{messages:.0}"),
            ]);
        }
    }
    table
}

fn curves(measured: &MessageCurves) -> Vec<ReportCurve> {
    let by_share = |name: &str, title: &str, y: &str, value: fn(&MessageCase) -> f64| {
        let line = |has_perception: bool| {
            let cases = measured
                .cases
                .iter()
                .filter(|case| case.has_perception == has_perception);
            CurveLine {
                name: if has_perception { "CAM and CPM" } else { "CAM" }.into(),
                points: cases.map(|case| [case.share, value(case)]).collect(),
            }
        };
        ReportCurve {
            name: name.into(),
            title: title.into(),
            x: "share of vehicles with a radio".into(),
            y: y.into(),
            logarithmic: [false; 2],
            lines: vec![line(false), line(true)],
        }
    };
    let delivery = ReportCurve {
        name: "v2x-delivery".into(),
        title: "Delivery over distance".into(),
        x: "distance (m)".into(),
        y: "share that arrives".into(),
        logarithmic: [false; 2],
        lines: measured
            .delivery
            .iter()
            .filter(|(_, points)| !points.is_empty())
            .map(|(name, points)| CurveLine {
                name: name.clone(),
                points: points
                    .iter()
                    .map(|[distance_m, share, _]| [*distance_m, *share])
                    .collect(),
            })
            .collect(),
    };
    let sizes = ReportCurve {
        name: "v2x-cpm-size".into(),
        title: "Size of a CPM".into(),
        x: "objects".into(),
        y: "bytes on air".into(),
        logarithmic: [false; 2],
        lines: vec![CurveLine {
            name: "CPM".into(),
            points: measured
                .cpm_sizes
                .iter()
                .map(|[objects, bytes, _]| [*objects, *bytes])
                .collect(),
        }],
    };
    vec![
        delivery,
        by_share(
            "v2x-awareness",
            "Vehicles within 100 m that are known",
            "share",
            |case| case.awareness,
        ),
        by_share("v2x-load", "Channel load", "channel busy ratio", |case| {
            case.channel_busy_ratio
        }),
        by_share("v2x-redundancy", "Views of a known vehicle", "views", |case| {
            case.redundancy
        }),
        by_share("v2x-age", "Age of the newest view, median", "s", |case| case.age_s[0]),
        by_share("v2x-error", "Error after fusion", "m", |case| case.fused_error_m),
        sizes,
    ]
}
