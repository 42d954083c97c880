//! The table that `caraware play` shows: the task's metric of each vehicle by estimator, from the file that the player writes.

use std::{collections::BTreeMap, path::Path};

use ipc_schema::metric::{MetricSpec, PolicyMetric};
use serde::Deserialize;

/// Name of the file in the run directory.
const FILE: &str = "live.json";
/// Most vehicles in the one-line form.
const LINE_VEHICLES: usize = 6;
/// Rows that are not available for vehicles: the means, the table's head, the number of vehicles left out, and the prompt.
const OTHER_ROWS: usize = 5;
/// The estimators in the order of the columns: key in the file, name for people.
const COLUMNS: [(&str, &str); 3] = [("ppo", "policy"), ("ekf", "EKF"), ("raw_gnss", "raw GNSS")];

#[derive(Debug, Deserialize)]
struct LiveFile {
    table: LiveTable,
}

/// Values of the metric by estimator.
type MetricEstimates = BTreeMap<String, Option<f64>>;

/// Values of the vehicles at one tick, and their means.
#[derive(Debug, Clone, Deserialize)]
pub struct LiveTable {
    metric: PolicyMetric,
    episode: u64,
    sim_time_s: f64,
    samples: u64,
    mean: MetricEstimates,
    vehicles: Vec<LiveVehicle>,
}

#[derive(Debug, Clone, Deserialize)]
struct LiveVehicle {
    vehicle: String,
    now: MetricEstimates,
    mean: MetricEstimates,
}

fn number(values: &MetricEstimates, estimator: &str) -> String {
    let value = values.get(estimator).copied().flatten();
    value.map_or_else(|| "–".into(), |value| format!("{value:.2}"))
}

/// A row of the table: its head, then a cell for each column at this tick, and one for each on average.
fn row(head: &str, now: [String; 3], mean: [String; 3]) -> String {
    let cells = |cells: [String; 3]| cells.map(|cell| format!("{cell:>12}")).join(" ");
    format!("{head:16} {}   {}", cells(now), cells(mean))
}

impl LiveTable {
    /// Reads the newest table; `None` before the first one.
    #[must_use]
    pub fn read(run_dir: &Path) -> Option<Self> {
        let text = std::fs::read_to_string(run_dir.join(FILE)).ok()?;
        serde_json::from_str::<LiveFile>(&text).ok().map(|file| file.table)
    }

    fn means(&self) -> String {
        let unit = self.metric.spec().unit;
        let means = COLUMNS.map(|(key, label)| format!("{label} {} {unit}", number(&self.mean, key)));
        format!(
            "episode {:3}  {:7.1} s  {:8} samples  {}",
            self.episode,
            self.sim_time_s,
            self.samples,
            means.join("  ")
        )
    }

    /// The table as one line: the means, and the policy's and the EKF's errors of the first vehicles at this tick.
    #[must_use]
    pub fn line(&self) -> String {
        let shown = self.vehicles.iter().take(LINE_VEHICLES).map(|vehicle| {
            let value = |estimator: &str| number(&vehicle.now, estimator);
            format!("{} {}/{}", vehicle.vehicle, value("ppo"), value("ekf"))
        });
        let shown: Vec<String> = shown.collect();
        let more = self.vehicles.len().saturating_sub(LINE_VEHICLES);
        let more = if more > 0 {
            format!(" and {more} more")
        } else {
            String::new()
        };
        format!("{}  now policy/EKF: {}{more}", self.means(), shown.join(", "))
    }

    /// The table for a terminal of `rows` lines: one line for each vehicle with its values at this tick and their means since it appeared.
    #[must_use]
    pub fn lines(&self, rows: usize) -> Vec<String> {
        let room = rows.saturating_sub(OTHER_ROWS).max(1);
        let &MetricSpec { label, unit, .. } = self.metric.spec();
        let head = row(
            label,
            COLUMNS.map(|(_, estimator)| format!("{estimator} [{unit}]")),
            COLUMNS.map(|_| "mean".to_owned()),
        );
        let mut lines = vec![self.means(), head];
        lines.extend(self.vehicles.iter().take(room).map(|vehicle| {
            let cells = |values: &MetricEstimates| COLUMNS.map(|(key, _)| number(values, key));
            row(&vehicle.vehicle, cells(&vehicle.now), cells(&vehicle.mean))
        }));
        if self.vehicles.len() > room {
            lines.push(format!("… and {} more", self.vehicles.len() - room));
        }
        lines
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn table(vehicles: usize) -> LiveTable {
        let values = serde_json::json!({"ppo": 4.5, "ekf": 0.75, "raw_gnss": null});
        let vehicle =
            |number: usize| serde_json::json!({"vehicle": format!("cav.{number}"), "now": values, "mean": values});
        serde_json::from_value(serde_json::json!({
            "metric": "error_m", "episode": 2, "sim_time_s": 34.5, "samples": 100, "mean": values,
            "vehicles": (0..vehicles).map(vehicle).collect::<Vec<_>>(),
        }))
        .unwrap()
    }

    #[test]
    fn every_vehicle_has_a_line_until_the_terminal_is_full() {
        let lines = table(3).lines(24);
        assert_eq!(lines.len(), 5);
        assert!(
            lines[1].starts_with("error ") && lines[1].contains("policy [m]"),
            "{}",
            lines[1]
        );
        assert!(lines[2].starts_with("cav.0") && lines[2].contains("4.50") && lines[2].contains("0.75"));
        assert!(lines[2].contains('–'), "an error that is not known: {}", lines[2]);
        let lines = table(100).lines(24);
        assert_eq!((lines.len(), lines[21].as_str()), (22, "… and 81 more"));
    }

    #[test]
    fn without_a_terminal_one_line_has_the_means_and_the_first_vehicles() {
        let line = table(8).line();
        assert!(line.contains("policy 4.50 m  EKF 0.75 m  raw GNSS – m"), "{line}");
        assert!(
            line.contains("cav.0 4.50/0.75, cav.1") && line.ends_with("and 2 more"),
            "{line}"
        );
    }
}
