//! The traffic of an imported map: random trips of each kind of road user, most of them through the edge of the map.

use super::SumoTools;
use crate::{cli::ImportArgs, failure::Exit};

/// A kind of road user.
struct Kind {
    /// Its name, and the first part of its ids.
    name: &'static str,
    /// Departures in an hour on a kilometre of road, before `--demand`.
    per_hour_km: f64,
    /// How much more often a trip begins or ends at the edge of the map than within.
    fringe_factor: &'static str,
    /// Its options of randomTrips.
    options: &'static [&'static str],
}

/// The mix of SUMO's own web wizard, with fewer lorries.
const KINDS: [Kind; 4] = [
    Kind {
        name: "passenger",
        per_hour_km: 12.0,
        fringe_factor: "5",
        options: &[
            "--vehicle-class",
            "passenger",
            "--vclass",
            "passenger",
            "--min-distance",
            "300",
        ],
    },
    Kind {
        name: "truck",
        per_hour_km: 2.0,
        fringe_factor: "5",
        options: &["--vehicle-class", "truck", "--vclass", "truck", "--min-distance", "600"],
    },
    Kind {
        name: "bicycle",
        per_hour_km: 4.0,
        fringe_factor: "2",
        options: &[
            "--vehicle-class",
            "bicycle",
            "--vclass",
            "bicycle",
            "--max-distance",
            "8000",
        ],
    },
    Kind {
        name: "pedestrian",
        per_hour_km: 6.0,
        fringe_factor: "1",
        options: &["--pedestrians", "--max-distance", "2000"],
    },
];

/// The files of the demand.
#[derive(Debug, Default)]
pub(super) struct ImportedDemand {
    /// Kind of road user, its file, and the trips in it.
    written: Vec<(&'static str, String, usize)>,
    /// Kinds that the map has no roads for.
    left_out: Vec<&'static str>,
}

impl ImportedDemand {
    /// Writes the trips of every kind that the map has roads for.
    ///
    /// # Errors
    /// A file cannot be written, or the map has no roads at all.
    pub(super) fn write(tools: &SumoTools<'_>, net: &str, args: &ImportArgs) -> Result<Self, Exit> {
        let mut demand = Self::default();
        let (end, seed) = (args.duration_s.to_string(), args.seed.to_string());
        for kind in &KINDS {
            let (trips, routes) = (format!("{}.trips.xml", kind.name), format!("{}.rou.xml", kind.name));
            let density = (kind.per_hour_km * args.demand).to_string();
            let prefix = format!("{}.", kind.name);
            let mut arguments = vec![
                "-n",
                net,
                "-o",
                &trips,
                "-r",
                &routes,
                "--prefix",
                &prefix,
                "--validate",
            ];
            arguments.extend(["--end", &end, "--seed", &seed, "--insertion-density", &density]);
            arguments.extend(["--fringe-factor", kind.fringe_factor, "--remove-loops"]);
            arguments.extend(kind.options);
            let made = tools.run_python("randomTrips.py", &arguments);
            let routes_path = tools.directory.join(&routes);
            for leftover in [trips, format!("{}.rou.alt.xml", kind.name)] {
                // The tool leaves them out where it makes no trips.
                drop(std::fs::remove_file(tools.directory.join(leftover)));
            }
            let text = match made {
                Ok(_) => std::fs::read_to_string(&routes_path).unwrap_or_default(),
                Err(error) => {
                    tracing::debug!(?error, kind = kind.name, "no trips");
                    String::new()
                }
            };
            match text.matches("<vehicle ").count() + text.matches("<person ").count() {
                0 => {
                    drop(std::fs::remove_file(&routes_path));
                    demand.left_out.push(kind.name);
                }
                count => demand.written.push((kind.name, routes, count)),
            }
        }
        match demand.written.is_empty() {
            true => Err(Exit::run(
                "the map has no two roads between which anything could drive",
                "give a larger part of the map, or raise --demand and --duration-s",
            )),
            false => Ok(demand),
        }
    }

    /// Names of the files.
    pub(super) fn files(&self) -> Vec<&str> {
        self.written.iter().map(|(_, file, _)| file.as_str()).collect()
    }

    /// The numbers of trips.
    pub(super) fn description(&self) -> String {
        let parts: Vec<String> = self
            .written
            .iter()
            .map(|(kind, _, count)| format!("{count} {kind}"))
            .collect();
        match self.left_out.is_empty() {
            true => parts.join(", "),
            false => format!("{}; no trips for {}", parts.join(", "), self.left_out.join(", ")),
        }
    }
}
