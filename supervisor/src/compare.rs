//! `caraware compare`: the settings and results in which runs differ.

use std::{
    collections::{BTreeMap, BTreeSet},
    path::{Path, PathBuf},
};

use serde_json::Value;

use crate::{cli::CompareArgs, display, failure::Exit};

/// Results that are compared although they are equal, in the order of the table; the others follow where they differ.
const FIRST_RESULTS: [&str; 5] = ["result", "mode", "env_steps", "wall_s", "real_time_factor"];
/// Results that say nothing about two runs.
const UNCOMPARED: [&str; 4] = ["name", "checkpoint", "config_hash", "beginning"];

/// One of the compared runs.
#[derive(Debug)]
struct ComparedRun {
    name: String,
    /// By dotted path.
    settings: BTreeMap<String, String>,
    /// Figures and words of `report.json`; empty while the run is alive.
    results: BTreeMap<String, String>,
}

impl ComparedRun {
    fn read(name: &str, runs: &Path) -> Result<Self, Exit> {
        let directory = [PathBuf::from(name), runs.join(name)]
            .into_iter()
            .find(|directory| directory.join("config.toml").is_file())
            .ok_or_else(|| {
                Exit::config(
                    format!("there is no run `{name}`"),
                    format!("give the directory of a run, or the name of one in {}", runs.display()),
                )
            })?;
        let path = directory.join("config.toml");
        let text = std::fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        let tables: toml::Table =
            toml::from_str(&text).map_err(|error| Exit::run(format!("{} is damaged: {error}", path.display()), ""))?;
        let settings = tables.into_iter().flat_map(|(table, values)| match values {
            toml::Value::Table(values) => values
                .into_iter()
                .map(|(key, value)| (format!("{table}.{key}"), value.to_string()))
                .collect(),
            value => vec![(table, value.to_string())],
        });
        let settings = settings.collect();
        let path = directory.join("report.json");
        let report: BTreeMap<String, Value> = match std::fs::read(&path) {
            Ok(text) => serde_json::from_slice(&text)
                .map_err(|error| Exit::run(format!("{} is damaged: {error}", path.display()), ""))?,
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => BTreeMap::new(),
            Err(error) => return Err(Exit::io("read", &path, &error)),
        };
        let results = report
            .into_iter()
            .filter_map(|(key, value)| Some((key, figure(&value)?)));
        Ok(Self {
            name: name.to_owned(),
            settings,
            results: results.collect(),
        })
    }
}

/// A number or a word of a report; `None` for its parts.
fn figure(value: &Value) -> Option<String> {
    match value {
        Value::String(text) => Some(text.clone()),
        Value::Number(number) if number.is_f64() => number.as_f64().map(|number| format!("{number:.3}")),
        Value::Number(_) | Value::Bool(_) => Some(value.to_string()),
        Value::Null | Value::Array(_) | Value::Object(_) => None,
    }
}

/// Prints a table with a column for each run.
///
/// # Errors
/// There is no such run, or one of its files cannot be read.
pub fn compare(args: &CompareArgs) -> Result<(), Exit> {
    let runs: Result<Vec<ComparedRun>, Exit> = args
        .compared
        .iter()
        .map(|name| ComparedRun::read(name, &args.runs))
        .collect();
    table(&runs?).iter().for_each(|line| display::print(line));
    Ok(())
}

/// The lines of the table: the settings that differ, then the results.
fn table(runs: &[ComparedRun]) -> Vec<String> {
    let settings: Vec<&BTreeMap<String, String>> = runs.iter().map(|run| &run.settings).collect();
    let results: Vec<&BTreeMap<String, String>> = runs.iter().map(|run| &run.results).collect();
    let mut rows = vec![("SETTINGS".to_owned(), runs.iter().map(|run| run.name.clone()).collect())];
    rows.extend(differing(&settings));
    rows.push(("RESULTS".to_owned(), runs.iter().map(|run| run.name.clone()).collect()));
    for key in FIRST_RESULTS {
        if results.iter().any(|values| values.contains_key(key)) {
            rows.push(row(key, &results));
        }
    }
    let known = |key: &str| FIRST_RESULTS.contains(&key) || UNCOMPARED.contains(&key);
    rows.extend(differing(&results).into_iter().filter(|(key, _)| !known(key)));
    let widths: Vec<usize> = (0..=runs.len())
        .map(|column| {
            let cells = rows.iter().map(|(key, cells)| match column {
                0 => key.chars().count(),
                column => cells[column - 1].chars().count(),
            });
            cells.max().unwrap_or(0)
        })
        .collect();
    let line = |(key, cells): &(String, Vec<String>)| {
        let mut line = format!("{key:<width$}", width = widths[0]);
        for (cell, width) in cells.iter().zip(&widths[1..]) {
            line.push_str(&format!("  {cell:>width$}"));
        }
        line
    };
    rows.iter().map(line).collect()
}

/// A row of the table: the value of every run, or "–".
fn row(key: &str, runs: &[&BTreeMap<String, String>]) -> (String, Vec<String>) {
    let cells = runs
        .iter()
        .map(|values| values.get(key).map_or("–", String::as_str).to_owned());
    (key.to_owned(), cells.collect())
}

/// The rows whose values are not all equal.
fn differing(runs: &[&BTreeMap<String, String>]) -> Vec<(String, Vec<String>)> {
    let keys: BTreeSet<&String> = runs.iter().flat_map(|values| values.keys()).collect();
    let rows = keys.into_iter().map(|key| row(key, runs));
    rows.filter(|(_, cells)| cells.iter().any(|cell| cell != &cells[0]))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn run(runs: &Path, name: &str, cavs: u32, report: Option<&str>) {
        let directory = runs.join(name);
        std::fs::create_dir_all(&directory).unwrap();
        let config = format!("[run]\nseed = 1\n[traffic]\ncavs = {cavs}\n");
        std::fs::write(directory.join("config.toml"), config).unwrap();
        if let Some(report) = report {
            std::fs::write(directory.join("report.json"), report).unwrap();
        }
    }

    #[test]
    fn the_table_has_the_settings_and_results_that_differ() {
        let runs = tempfile::tempdir().unwrap();
        let report = |error_m: f64| {
            format!(
                r#"{{"result":"completed","name":"x","ppo_mean_error_m":{error_m:?},"seed":1,"trainer":{{"a":1}}}}"#
            )
        };
        run(runs.path(), "first", 8, Some(&report(4.25)));
        run(runs.path(), "second", 32, Some(&report(5.0)));
        run(runs.path(), "alive", 32, None);
        let read = |name: &str| ComparedRun::read(name, runs.path()).unwrap();
        assert_eq!(
            table(&[read("first"), read("second")]),
            [
                "SETTINGS              first     second",
                "traffic.cavs              8         32",
                "RESULTS               first     second",
                "result            completed  completed",
                "ppo_mean_error_m      4.250      5.000",
            ]
        );
        let with_alive = table(&[read("first"), read("alive")]);
        assert!(
            with_alive.contains(&"result            completed      –".to_owned()),
            "{with_alive:#?}"
        );
        assert!(ComparedRun::read("third", runs.path()).is_err());
    }
}
