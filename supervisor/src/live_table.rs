//! What `caraware play` shows: position errors of each vehicle, from the file that `caraware.play` keeps.

use std::{collections::BTreeMap, path::Path};

use serde::Deserialize;

/// The file, in the run's directory.
const FILE: &str = "live.json";
/// Vehicles named in a line.
const IN_A_LINE: usize = 6;
/// Rows around the table: its head, the means, what is left out, the prompt.
const OTHER_ROWS: usize = 5;

#[derive(Debug, Deserialize)]
struct LiveFile {
    table: LiveTable,
}

/// Errors by estimator: `ppo`, `ekf`, `raw_gnss`, metres.
type VehicleErrors = BTreeMap<String, Option<f64>>;

/// The table.
#[derive(Debug, Clone, Deserialize)]
pub struct LiveTable {
    episode: u64,
    sim_time_s: f64,
    samples: u64,
    mean_m: VehicleErrors,
    vehicles: Vec<LiveVehicle>,
}

#[derive(Debug, Clone, Deserialize)]
struct LiveVehicle {
    vehicle: String,
    now_m: VehicleErrors,
    mean_m: VehicleErrors,
}

fn metres(errors: &VehicleErrors, name: &str) -> String {
    let error = errors.get(name).copied().flatten();
    error.map_or_else(|| "–".into(), |error_m| format!("{error_m:.2}"))
}

impl LiveTable {
    /// The newest; `None` before the first.
    #[must_use]
    pub fn read(run_dir: &Path) -> Option<Self> {
        let text = std::fs::read_to_string(run_dir.join(FILE)).ok()?;
        serde_json::from_str::<LiveFile>(&text).ok().map(|file| file.table)
    }

    fn means(&self) -> String {
        let mean = |name: &str| metres(&self.mean_m, name);
        format!(
            "episode {:3}  {:7.1} s  {:8} samples  policy {} m  EKF {} m  raw GNSS {} m",
            self.episode,
            self.sim_time_s,
            self.samples,
            mean("ppo"),
            mean("ekf"),
            mean("raw_gnss")
        )
    }

    /// Everything in a line: means, and policy/EKF of the first vehicles at this tick.
    #[must_use]
    pub fn line(&self) -> String {
        let told = self.vehicles.iter().take(IN_A_LINE).map(|vehicle| {
            let error = |name: &str| metres(&vehicle.now_m, name);
            format!("{} {}/{}", vehicle.vehicle, error("ppo"), error("ekf"))
        });
        let told: Vec<String> = told.collect();
        let more = self.vehicles.len().saturating_sub(IN_A_LINE);
        let more = if more > 0 {
            format!(" and {more} more")
        } else {
            String::new()
        };
        format!("{}  now policy/EKF: {}{more}", self.means(), told.join(", "))
    }

    /// A table of at most `rows` lines: a vehicle in each, its errors at this tick and on average since it came.
    #[must_use]
    pub fn lines(&self, rows: usize) -> Vec<String> {
        let room = rows.saturating_sub(OTHER_ROWS).max(1);
        let head = format!(
            "{:16} {:>10} {:>10} {:>10}   {:>10} {:>10} {:>10}",
            "position error", "policy [m]", "EKF [m]", "GNSS [m]", "mean", "mean", "mean"
        );
        let mut lines = vec![self.means(), head];
        lines.extend(self.vehicles.iter().take(room).map(|vehicle| {
            let now = |name: &str| metres(&vehicle.now_m, name);
            let mean = |name: &str| metres(&vehicle.mean_m, name);
            format!(
                "{:16} {:>10} {:>10} {:>10}   {:>10} {:>10} {:>10}",
                vehicle.vehicle,
                now("ppo"),
                now("ekf"),
                now("raw_gnss"),
                mean("ppo"),
                mean("ekf"),
                mean("raw_gnss")
            )
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
        let errors = serde_json::json!({"ppo": 4.5, "ekf": 0.75, "raw_gnss": null});
        let vehicle =
            |number: usize| serde_json::json!({"vehicle": format!("cav.{number}"), "now_m": errors, "mean_m": errors});
        serde_json::from_value(serde_json::json!({
            "episode": 2, "sim_time_s": 34.5, "samples": 100, "mean_m": errors,
            "vehicles": (0..vehicles).map(vehicle).collect::<Vec<_>>(),
        }))
        .unwrap()
    }

    #[test]
    fn every_vehicle_has_its_line_until_the_terminal_is_full() {
        let lines = table(3).lines(24);
        assert_eq!(lines.len(), 5);
        assert!(lines[2].starts_with("cav.0") && lines[2].contains("4.50") && lines[2].contains("0.75"));
        assert!(lines[2].contains('–'), "an error that is not known: {}", lines[2]);
        let lines = table(100).lines(24);
        assert_eq!((lines.len(), lines[21].as_str()), (22, "… and 81 more"));
    }

    #[test]
    fn without_a_terminal_a_line_says_the_most() {
        let line = table(8).line();
        assert!(line.contains("policy 4.50 m  EKF 0.75 m  raw GNSS – m"), "{line}");
        assert!(
            line.contains("cav.0 4.50/0.75, cav.1") && line.ends_with("and 2 more"),
            "{line}"
        );
    }
}
