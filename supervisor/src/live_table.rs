//! The table that `caraware play` shows: position errors of each vehicle, from the file that the player writes.

use std::{collections::BTreeMap, path::Path};

use serde::Deserialize;

/// Name of the file in the run directory.
const FILE: &str = "live.json";
/// Most vehicles in the one-line form.
const LINE_VEHICLES: usize = 6;
/// Rows that are not available for vehicles: the means, the table's head, the number of vehicles left out, and the prompt.
const OTHER_ROWS: usize = 5;

#[derive(Debug, Deserialize)]
struct LiveFile {
    table: LiveTable,
}

/// Position errors by estimator (`ppo`, `ekf`, `raw_gnss`), metres.
type VehicleErrors = BTreeMap<String, Option<f64>>;

/// Position errors of the vehicles at one tick, and their means.
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
    /// Reads the newest table; `None` before the first one.
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

    /// The table as one line: the means, and the policy's and the EKF's errors of the first vehicles at this tick.
    #[must_use]
    pub fn line(&self) -> String {
        let shown = self.vehicles.iter().take(LINE_VEHICLES).map(|vehicle| {
            let error = |name: &str| metres(&vehicle.now_m, name);
            format!("{} {}/{}", vehicle.vehicle, error("ppo"), error("ekf"))
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

    /// The table for a terminal of `rows` lines: one line for each vehicle with its errors at this tick and their means since it appeared.
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
    fn every_vehicle_has_a_line_until_the_terminal_is_full() {
        let lines = table(3).lines(24);
        assert_eq!(lines.len(), 5);
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
