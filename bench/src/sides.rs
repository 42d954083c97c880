//! The two sides of a comparison on one scenario: bare SUMO, and caraware with a consumer of every observation.

use std::{
    cell::Cell,
    path::{Path, PathBuf},
    process::{Command, Stdio},
    time::Instant,
};

use caraware::{failure::Exit, install, install::Install};
use ipc_schema::usage;
use rustix::{
    io::Errno,
    process::{Pid, WaitId, WaitIdOptions, waitid},
};
use serde_json::Value;

use super::{BenchOptions, allocator::SharedMimalloc};

/// Vehicle-ticks that a run may be ahead of the consumer: with 5 000 vehicles, as long as the consumer takes to import torch.
const WINDOW_VEHICLE_TICKS: u32 = 64 * 5000;
/// Steps up that reach the root directory from any directory: SUMO appends the prefix to the directory of the scenario.
const TO_THE_ROOT: usize = 128;

/// The cost of a program.
#[derive(Debug, Clone, Copy)]
pub struct ProcessCost {
    /// Wall time from its start to its end, seconds.
    pub wall_s: f64,
    /// Processor time of the program and of all processes that it started, seconds.
    pub cpu_s: f64,
}

/// What bare SUMO allocates its memory with.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BareAllocator {
    /// The system's allocator, as SUMO comes.
    System,
    /// mimalloc, as in `traffic-bridge`.
    Mimalloc,
}

/// A finished run of caraware.
#[derive(Debug, Clone)]
pub struct OurRun {
    /// Its cost.
    pub taken: ProcessCost,
    /// Its `report.json`.
    pub report: Value,
    /// Directory of SUMO's results.
    pub results: PathBuf,
}

impl OurRun {
    /// A number of the report, by its path.
    ///
    /// # Errors
    /// The report has no such number.
    pub fn number(&self, path: &str) -> Result<f64, Exit> {
        let number = self.report.pointer(path).and_then(Value::as_f64);
        number.ok_or_else(|| Exit::run(format!("the report of a run has no number {path}"), ""))
    }
}

/// A directory for a measurement. Dropping it removes the directory.
#[derive(Debug)]
pub struct BenchDirectory {
    path: PathBuf,
    /// Runs in it so far, of all scenarios.
    runs: Cell<u32>,
}

impl BenchDirectory {
    /// Creates a directory below the system's directory for temporary files.
    ///
    /// # Errors
    /// The system's directory is not writable.
    pub fn new(part: &str) -> Result<Self, Exit> {
        let path = std::env::temp_dir().join(format!("caraware-bench-{part}-{}", std::process::id()));
        std::fs::create_dir_all(&path).map_err(|error| Exit::io("create", &path, &error))?;
        Ok(Self {
            path,
            runs: Cell::new(0),
        })
    }

    /// Its path.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The number of a new run.
    fn next_run(&self) -> u32 {
        self.runs.set(self.runs.get() + 1);
        self.runs.get()
    }
}

impl Drop for BenchDirectory {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_dir_all(&self.path) {
            tracing::warn!(%error, path = %self.path.display(), "cannot remove the directory of a measurement");
        }
    }
}

/// One scenario for both sides.
#[derive(Debug)]
pub struct ComparedScenario<'a> {
    place: &'a BenchDirectory,
    install: Install,
    mimalloc: SharedMimalloc,
    program: PathBuf,
    sumocfg: PathBuf,
    /// Factor on its demand.
    scale: f64,
    max_road_users: u32,
}

impl<'a> ComparedScenario<'a> {
    /// Prepares `sumocfg` with `scale` times its demand and at most `max_road_users` at once.
    ///
    /// # Errors
    /// The program `caraware` is not built, or SUMO does not run with mimalloc.
    pub fn new(
        options: &BenchOptions,
        place: &'a BenchDirectory,
        install: Install,
        sumocfg: PathBuf,
        scale: f64,
        max_road_users: u32,
    ) -> Result<Self, Exit> {
        Ok(Self {
            place,
            program: install::program(&options.bin, "caraware")?,
            mimalloc: SharedMimalloc::new(place.path(), &install.sumo_program("sumo"))?,
            install,
            sumocfg,
            scale,
            max_road_users,
        })
    }

    /// Runs bare SUMO; returns its cost and the directory of its results.
    ///
    /// # Errors
    /// SUMO fails.
    pub fn bare(&self, allocator: BareAllocator) -> Result<(ProcessCost, PathBuf), Exit> {
        let (results, prefix) = self.results("bare")?;
        let mut command = Command::new(self.install.sumo_program("sumo"));
        command
            .arg("-c")
            .arg(&self.sumocfg)
            .args(["--output-prefix", &prefix])
            .args(["--scale", &self.scale.to_string(), "--no-step-log", "true"]);
        if allocator == BareAllocator::Mimalloc {
            self.mimalloc.preload(&mut command);
        }
        self.set_sumo_environment(&mut command);
        Ok((self.run_measured(&mut command)?, results))
    }

    /// The command of a Python loop over SUMO's steps (`caraware_bench.peer`), and the directory that its results will be in.
    ///
    /// # Errors
    /// The directory of the results cannot be created.
    pub fn python_loop(&self, python: &Path, peer: &str, steps: u32) -> Result<(Command, PathBuf), Exit> {
        let (results, prefix) = self.results(peer)?;
        let mut command = Command::new(python);
        command
            .args(["-m", "caraware_bench.peer", peer, "--sumo"])
            .arg(self.install.sumo_program("sumo"))
            .arg("--sumocfg")
            .arg(&self.sumocfg)
            .args(["--prefix", &prefix, "--steps", &steps.to_string()]);
        self.set_sumo_environment(&mut command);
        Ok((command, results))
    }

    /// Creates a directory for SUMO's results; returns it with the prefix of file names that leads there.
    fn results(&self, side: &str) -> Result<(PathBuf, String), Exit> {
        let results = self.place.path().join(format!("{side}-{}", self.place.next_run()));
        std::fs::create_dir_all(&results).map_err(|error| Exit::io("create", &results, &error))?;
        let from_root = results.to_string_lossy().trim_start_matches('/').to_owned();
        Ok((results, format!("{}{from_root}/", "../".repeat(TO_THE_ROOT))))
    }

    /// Sets the environment variables from which a program finds SUMO's data.
    fn set_sumo_environment(&self, command: &mut Command) {
        let data = self.install.sumo_home.join("data/proj");
        command
            .env("SUMO_HOME", &self.install.sumo_home)
            .env("PROJ_DATA", &data)
            .env("PROJ_LIB", &data);
    }

    /// Runs caraware: every vehicle senses, and every observation is delivered to the consumer.
    ///
    /// # Errors
    /// The run fails.
    pub fn ours(&self) -> Result<OurRun, Exit> {
        let name = format!("ours-{}", self.place.next_run());
        let runs = self.place.path().join("runs");
        let mut command = Command::new(&self.program);
        command
            .arg("train")
            .arg(&self.sumocfg)
            .args(["--name", &name])
            .arg("--runs")
            .arg(&runs);
        let settings = [
            "trainer.module=caraware.consumer".to_owned(),
            "episode.whole_scenario=true".to_owned(),
            "fanout.enabled=false".to_owned(),
            "traffic.cav_share=1.0".to_owned(),
            format!(
                "run.window_ticks={}",
                (WINDOW_VEHICLE_TICKS / self.max_road_users).clamp(8, 64)
            ),
            format!("traffic.scale={}", self.scale),
            format!("traffic.max_road_users={}", self.max_road_users),
        ];
        settings.iter().for_each(|setting| {
            command.args(["--set", setting]);
        });
        let taken = self.run_measured(&mut command)?;
        let path = runs.join(&name).join("report.json");
        let text = std::fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        let report: Value =
            serde_json::from_str(&text).map_err(|error| Exit::run(format!("{}: {error}", path.display()), ""))?;
        if report["trainer"]["received_ticks"] != report["ticks"] {
            return Err(Exit::run(
                format!(
                    "the consumer received {} of {} ticks",
                    report["trainer"]["received_ticks"], report["ticks"]
                ),
                "",
            ));
        }
        let results = runs.join(&name).join("sumo");
        Ok(OurRun { taken, report, results })
    }

    /// Runs a program that must succeed and measures its cost. Its output goes to a file.
    fn run_measured(&self, command: &mut Command) -> Result<ProcessCost, Exit> {
        let program = command.get_program().to_string_lossy().into_owned();
        let path = self.place.path().join("output.txt");
        let output = std::fs::File::create(&path).map_err(|error| Exit::io("create", &path, &error))?;
        let errors = output.try_clone().map_err(|error| Exit::io("create", &path, &error))?;
        let begin = Instant::now();
        let failed = |error: &std::io::Error| Exit::io("start", program.as_ref(), error);
        let mut child = command
            .stdin(Stdio::null())
            .stdout(output)
            .stderr(errors)
            .spawn()
            .map_err(|error| failed(&error))?;
        let pid = i32::try_from(child.id()).ok().and_then(Pid::from_raw);
        if let Some(pid) = pid {
            // NOWAIT leaves the ended process in the process table, where its processor time can still be read.
            let options = WaitIdOptions::EXITED | WaitIdOptions::NOWAIT;
            while matches!(waitid(WaitId::Pid(pid), options), Err(Errno::INTR)) {}
        }
        let wall_s = begin.elapsed().as_secs_f64();
        let cpu_s = usage::family_processor_time_s(child.id());
        let status = child.wait().map_err(|error| failed(&error))?;
        if status.success() {
            let cpu_s = cpu_s.ok_or_else(|| {
                Exit::run(
                    format!("the processor time of {program} is unknown: /proc does not say"),
                    "",
                )
            })?;
            return Ok(ProcessCost { wall_s, cpu_s });
        }
        let text = std::fs::read_to_string(&path).unwrap_or_default();
        let tail: Vec<&str> = text.lines().rev().take(12).collect();
        Err(Exit::run(
            format!(
                "{program} ended with {status}\n{}",
                tail.into_iter().rev().collect::<Vec<_>>().join("\n")
            ),
            "",
        ))
    }
}

/// Compares the files that SUMO wrote on both sides, and returns their number.
///
/// The comparison leaves out the comment at the head of each file, which holds time and options, and in summaries the milliseconds that
/// a step took.
///
/// # Errors
/// A file is missing on one side, or two files differ.
pub fn compare_results(bare: &Path, ours: &Path) -> Result<usize, Exit> {
    let names = |directory: &Path| -> Result<Vec<String>, Exit> {
        let entries = std::fs::read_dir(directory).map_err(|error| Exit::io("list", directory, &error))?;
        let mut names: Vec<_> = entries
            .flatten()
            .map(|entry| entry.file_name().to_string_lossy().into_owned())
            .collect();
        names.sort();
        Ok(names)
    };
    let (theirs, files) = (names(bare)?, names(ours)?);
    let differ = |what: String| Exit::run(what, "the mirror must not change what SUMO does: please report this");
    if theirs != files {
        return Err(differ(format!("bare SUMO wrote {theirs:?}, ours {files:?}")));
    }
    for name in &files {
        let read = |directory: &Path| {
            let path = directory.join(name);
            std::fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))
        };
        let (bare, ours) = (read(bare)?, read(ours)?);
        let unlike = content(&bare).zip(content(&ours)).find(|(a, b)| a != b);
        if let Some((bare, ours)) = unlike {
            return Err(differ(format!("{name} differs:\n{bare}\n{ours}")));
        }
        if content(&bare).count() != content(&ours).count() {
            return Err(differ(format!("{name} is longer on one side")));
        }
    }
    Ok(files.len())
}

/// The lines of a result file that depend on traffic alone.
fn content(text: &str) -> impl Iterator<Item = String> {
    let body = text.split_once("-->").map_or(text, |(_, body)| body);
    body.lines().map(|line| {
        let is_step = line.trim_start().starts_with("<step ");
        match line.rsplit_once(" duration=") {
            Some((traffic, _)) if is_step => traffic.to_owned(),
            _ => line.to_owned(),
        }
    })
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn only_differences_in_traffic_count() {
        let [bare, ours] = [(); 2].map(|()| tempfile::tempdir().unwrap());
        let write = |directory: &tempfile::TempDir, name: &str, text: &str| {
            std::fs::write(directory.path().join(name), text).unwrap();
        };
        let compare = || compare_results(bare.path(), ours.path());
        write(&bare, "a.xml", "<!-- 1 --><s>\n <step n=\"1\" duration=\"4\"/>\n</s>");
        write(&ours, "a.xml", "<!-- 2 --><s>\n <step n=\"1\" duration=\"5\"/>\n</s>");
        assert_eq!(compare().unwrap(), 1);
        write(&bare, "b.xml", "<trip duration=\"4\"/>");
        assert!(compare().is_err(), "a file is missing");
        write(&ours, "b.xml", "<trip duration=\"5\"/>");
        assert!(compare().is_err(), "a trip took longer");
        write(&ours, "b.xml", "<trip duration=\"4\"/>\n<trip/>");
        assert!(compare().is_err(), "a trip more");
        write(&ours, "b.xml", "<trip duration=\"4\"/>");
        assert_eq!(compare().unwrap(), 2);
    }
}
