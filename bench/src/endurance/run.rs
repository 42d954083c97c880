//! One run that is disturbed at random moments until it has completed.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, File},
    os::unix::process::ExitStatusExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use caraware::failure::Exit;
use ipc_schema::{ports::BoardReader, process::Process, run::RunFile, services};
use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::{
    case::EnduranceCase,
    target::{Target, processes_of, resources, signal},
};

/// Interval at which the resources of all processes are read, which costs some milliseconds.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);
/// Interval at which a run is looked at.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Longest time in which a run must end after its last disturbance, and in which a killed simulator's environment must make a new tick.
const DEADLINE: Duration = Duration::from_secs(300);
/// Longest pause of a stopped process, seconds.
const LONGEST_PAUSE_S: f64 = 1.5;
/// Cards of the deck that a run draws.
const DISTURBANCES: usize = 12;
/// Mean distance of two disturbances, seconds.
const MEAN_S: f64 = 1.2;
/// Viewers at once.
const VIEWERS: usize = 3;
/// What is done, and how many cards of the deck each has.
const DECK: [(Disturbance, usize); 9] = [
    (Disturbance::Kill(Target::Trainer), 6),
    (Disturbance::Kill(Target::TrafficBridge), 2),
    (Disturbance::Kill(Target::SimCore), 2),
    (Disturbance::Kill(Target::SensorDaemon), 2),
    (Disturbance::Kill(Target::Fanout), 2),
    (Disturbance::Kill(Target::Supervisor), 1),
    (Disturbance::Pause, 2),
    (Disturbance::Handover, 2),
    (Disturbance::Viewer, 3),
];

/// What is done to a run.
#[derive(Debug, Clone, Copy)]
enum Disturbance {
    /// A process is killed (SIGKILL).
    Kill(Target),
    /// A process of any kind is stopped and continues later (SIGSTOP, SIGCONT).
    Pause,
    /// Our trainer is replaced by its successor.
    Handover,
    /// A viewer is started, or one is killed or stopped.
    Viewer,
}

/// What was done to the runs of a case, and what was measured.
#[derive(Debug, Default)]
pub struct EnduranceCounts {
    /// Disturbances by name.
    pub disturbances: BTreeMap<String, u32>,
    /// Runs that have completed.
    pub runs: u32,
    /// Times that a run was resumed.
    pub resumed: u32,
    /// Seconds from a simulator's death to the next new tick of its environment.
    pub recoveries_s: Vec<f64>,
    /// Largest resident memory (MiB) and number of handles of each kind of process.
    pub peaks: BTreeMap<Target, (f64, f64)>,
    /// What was wrong with a run.
    pub faults: Vec<String>,
}

impl EnduranceCounts {
    fn count(&mut self, name: impl Into<String>) {
        *self.disturbances.entry(name.into()).or_default() += 1;
    }
}

/// Programs, and the directory in which the runs lie.
#[derive(Debug)]
pub struct EndurancePlace {
    pub caraware: PathBuf,
    pub watch: PathBuf,
    pub directory: PathBuf,
    /// True if only one run of each case is disturbed.
    pub is_quick: bool,
}

impl EndurancePlace {
    /// The command, with its runs in this directory and its own registry.
    pub fn command(&self, arguments: &[String]) -> Command {
        let mut command = Command::new(&self.caraware);
        command
            .args(arguments)
            .current_dir(&self.directory)
            .env("CARAWARE_RUNTIME_DIR", self.registry())
            .stdin(Stdio::null())
            .stdout(Stdio::null());
        command
    }

    /// Where alive runs are registered.
    #[must_use]
    pub fn registry(&self) -> PathBuf {
        self.directory.join("r")
    }

    /// Directory of a run.
    #[must_use]
    pub fn run(&self, name: &str) -> PathBuf {
        self.directory.join("runs").join(name)
    }
}

/// A run in the background that is disturbed. Dropping it ends the run and its viewers.
pub struct DisturbedRun<'a> {
    place: &'a EndurancePlace,
    case: &'a EnduranceCase,
    name: String,
    port: u16,
    child: Child,
    viewers: Vec<Child>,
    handovers: Vec<Child>,
    /// Prefixes of its files in shared memory: one for each start.
    prefixes: BTreeSet<String>,
    /// What is still to be done to it, in reverse order.
    cards: Vec<Disturbance>,
    random: fastrand::Rng,
    counts: &'a mut EnduranceCounts,
}

impl Drop for DisturbedRun<'_> {
    fn drop(&mut self) {
        for child in self.viewers.iter_mut().chain(&mut self.handovers) {
            // A child that has ended cannot be killed.
            let _ = child.kill();
            let _ = child.wait();
        }
        if matches!(self.child.try_wait(), Ok(None)) {
            signal(pid(&self.child), Signal::TERM);
            let _ = self.child.wait();
        }
    }
}

impl<'a> DisturbedRun<'a> {
    /// Starts a run of `case`. The random numbers decide what is done to it and when.
    ///
    /// # Errors
    /// The program cannot be started.
    pub fn start(
        place: &'a EndurancePlace,
        case: &'a EnduranceCase,
        name: &str,
        mut random: fastrand::Rng,
        counts: &'a mut EnduranceCounts,
    ) -> Result<Self, Exit> {
        let port = free_port()?;
        let cards = draw_cards(place.is_quick, &mut random);
        Ok(Self {
            child: start(place, name, &case.arguments(name, PACE, Some(port)))?,
            place,
            case,
            name: name.to_owned(),
            port,
            viewers: Vec::new(),
            handovers: Vec::new(),
            prefixes: BTreeSet::new(),
            cards,
            random,
            counts,
        })
    }

    /// Disturbs the run at random moments, and waits for its end. Returns its report.
    ///
    /// # Errors
    /// A program cannot be started or a file cannot be read. What is wrong with the run itself is added to the counts.
    pub fn disturb(mut self) -> Result<Option<Value>, Exit> {
        let mut due = self.next_moment();
        let mut last = Instant::now();
        let mut looked: Option<Instant> = None;
        loop {
            if looked.is_none_or(|looked| looked.elapsed() >= LOOK_INTERVAL) {
                self.look();
                looked = Some(Instant::now());
            }
            if let Some(status) = self.ended()? {
                if status.success() {
                    return self.finish();
                }
                if status.signal() != Some(Signal::KILL.as_raw()) {
                    self.fault(&format!("ended with {status}: {}", self.last_words()));
                    return Ok(None);
                }
                self.resume()?;
            }
            if Instant::now() >= due
                && let Some(card) = self.cards.pop()
            {
                if !self.carry_out(card)? {
                    // The process was not there: later.
                    self.cards.insert(0, card);
                }
                last = Instant::now();
                due = self.next_moment();
            }
            if last.elapsed() > DEADLINE {
                self.fault(&format!(
                    "did not end within {} s after its last disturbance",
                    DEADLINE.as_secs()
                ));
                return Ok(None);
            }
            pause();
        }
    }

    /// A moment of a Poisson process.
    fn next_moment(&mut self) -> Instant {
        let wait_s = -MEAN_S * (1.0 - self.random.f64()).ln();
        Instant::now() + Duration::from_secs_f64(wait_s)
    }

    fn directory(&self) -> PathBuf {
        self.place.run(&self.name)
    }

    fn ended(&mut self) -> Result<Option<ExitStatus>, Exit> {
        self.child
            .try_wait()
            .map_err(|error| Exit::io("wait for", &self.place.caraware, &error))
    }

    /// Notes the resources of the run's processes and the prefix of its shared memory.
    fn look(&mut self) {
        let directory = self.directory();
        if let Ok(run) = RunFile::read(&directory.join("run.json")) {
            self.prefixes.insert(run.shared_memory.prefix);
        }
        for target in Target::ALL {
            let pids = match target {
                Target::Supervisor => vec![pid(&self.child)],
                _ => target.processes(&directory),
            };
            for (resident_mib, handles) in pids.into_iter().filter_map(resources) {
                let peak = self.counts.peaks.entry(target).or_default();
                *peak = (peak.0.max(resident_mib), peak.1.max(handles));
            }
        }
    }

    /// Returns false if there was no process to disturb.
    fn carry_out(&mut self, disturbance: Disturbance) -> Result<bool, Exit> {
        match disturbance {
            Disturbance::Kill(Target::Supervisor) => self.kill_supervisor(),
            Disturbance::Kill(target) => self.kill(target),
            Disturbance::Pause => self.pause_process(),
            Disturbance::Handover => self.hand_over(),
            Disturbance::Viewer => self.disturb_viewers(),
        }
    }

    fn kill(&mut self, target: Target) -> Result<bool, Exit> {
        let before = self.sensed_ticks();
        let victim = self.random.choice(target.processes(&self.directory()));
        if !victim.is_some_and(|victim| signal(victim, Signal::KILL)) {
            return Ok(false);
        }
        self.counts.count(format!("{} killed", target.name()));
        // Every second time the next disturbance may come while the environment is being made again.
        if target.is_simulator() && self.random.bool() {
            self.measure_recovery(&before)?;
        }
        Ok(true)
    }

    /// Ticks that each environment has sensed; empty if the run has no boards now.
    fn sensed_ticks(&self) -> Vec<u64> {
        let ticks = || {
            let run = RunFile::read(&self.directory().join("run.json")).ok()?;
            let node = services::node(&run.shared_memory).ok()?;
            let boards = (0..self.case.envs).map(|env| BoardReader::open(&node, &run, env, Process::SensorDaemon));
            boards
                .map(|board| Some(board.ok()?.health().ticks))
                .collect::<Option<Vec<u64>>>()
        };
        ticks().unwrap_or_default()
    }

    /// Waits until every environment has made a new tick, or the run ends.
    fn measure_recovery(&mut self, before: &[u64]) -> Result<(), Exit> {
        let begun = Instant::now();
        while self.ended()?.is_none() {
            let now = self.sensed_ticks();
            if now.len() == before.len() && now.iter().zip(before).all(|(now, before)| now > before) {
                self.counts.recoveries_s.push(begun.elapsed().as_secs_f64());
                return Ok(());
            }
            if begun.elapsed() > DEADLINE {
                self.fault("a killed simulator made no new tick");
                return Ok(());
            }
            pause();
        }
        Ok(())
    }

    /// Kills the supervisor. Its children end with it.
    fn kill_supervisor(&mut self) -> Result<bool, Exit> {
        // A run that has not been set up has nothing that could be resumed.
        if !self.directory().join("run.json").exists() || !signal(pid(&self.child), Signal::KILL) {
            return Ok(false);
        }
        self.counts.count("supervisor killed");
        let status = self.child.wait();
        status.map_err(|error| Exit::io("wait for", &self.place.caraware, &error))?;
        Ok(true)
    }

    /// Resumes the run once nothing of it is alive.
    fn resume(&mut self) -> Result<(), Exit> {
        let begun = Instant::now();
        while !processes_of(&self.directory()).is_empty() {
            if begun.elapsed() > DEADLINE {
                self.fault("processes outlive their supervisor");
                break;
            }
            pause();
        }
        let arguments = ["train", "--resume", &self.name].map(str::to_owned);
        self.child = start(self.place, &self.name, &arguments)?;
        self.counts.resumed += 1;
        Ok(())
    }

    fn pause_process(&mut self) -> Result<bool, Exit> {
        let target = Target::ALL[self.random.usize(0..Target::ALL.len())];
        let pids = match target {
            Target::Supervisor => vec![pid(&self.child)],
            _ => target.processes(&self.directory()),
        };
        let Some(stopped) = self.random.choice(pids) else {
            return Ok(false);
        };
        let is_stopped = signal(stopped, Signal::STOP);
        if is_stopped {
            self.counts.count(format!("{} stopped and continued", target.name()));
            std::thread::park_timeout(Duration::from_secs_f64(LONGEST_PAUSE_S * self.random.f64()));
            signal(stopped, Signal::CONT);
        }
        Ok(is_stopped)
    }

    /// Asks for a handover. It may be refused, for instance because another one is in progress.
    fn hand_over(&mut self) -> Result<bool, Exit> {
        let arguments = ["handover", &self.name].map(str::to_owned);
        let client = self.place.command(&arguments).stderr(Stdio::null()).spawn();
        self.handovers
            .push(client.map_err(|error| Exit::io("start", &self.place.caraware, &error))?);
        self.counts.count("handover asked for");
        Ok(true)
    }

    fn disturb_viewers(&mut self) -> Result<bool, Exit> {
        if self.viewers.len() < VIEWERS {
            let viewer = Command::new(&self.place.watch)
                .args([&format!("tcp/127.0.0.1:{}", self.port), &self.name, "--seconds", "600"])
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn();
            self.viewers
                .push(viewer.map_err(|error| Exit::io("start", &self.place.watch, &error))?);
            self.counts.count("viewer started");
            return Ok(true);
        }
        let index = self.random.usize(0..self.viewers.len());
        if self.random.bool() {
            signal(pid(&self.viewers[index]), Signal::STOP);
            self.counts.count("viewer stopped");
        } else {
            let mut viewer = self.viewers.swap_remove(index);
            // A viewer whose run has ended may have ended as well.
            let _ = viewer.kill();
            let _ = viewer.wait();
            self.counts.count("viewer killed");
        }
        Ok(true)
    }

    /// Checks what a completed run leaves behind, and reads its report.
    fn finish(mut self) -> Result<Option<Value>, Exit> {
        self.counts.runs += 1;
        for mut client in std::mem::take(&mut self.handovers) {
            let status = client.wait();
            let status = status.map_err(|error| Exit::io("wait for", &self.place.caraware, &error))?;
            self.counts.count(if status.success() {
                "handover made"
            } else {
                "handover refused"
            });
        }
        let left = self.left_behind();
        if !left.is_empty() {
            self.fault(&format!("left behind: {}", left.join(", ")));
        }
        let path = self.directory().join("report.json");
        let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        let report = serde_json::from_str(&text);
        Ok(Some(report.map_err(|error| {
            Exit::run(format!("{}: {error}", path.display()), "")
        })?))
    }

    /// Processes, files in shared memory and entries of the registry that outlive the run.
    fn left_behind(&self) -> Vec<String> {
        let processes = processes_of(&self.directory()).into_iter();
        let processes = processes.map(|(pid, line)| format!("process {} ({})", pid.as_raw_nonzero(), line.join(" ")));
        let is_ours = |file: &String| self.prefixes.iter().any(|prefix| file.starts_with(prefix));
        let files = names_in(Path::new("/dev/shm")).into_iter().filter(is_ours);
        processes.chain(files).chain(names_in(&self.place.registry())).collect()
    }

    fn fault(&mut self, text: &str) {
        self.counts.faults.push(format!("run {}: {text}", self.name));
    }

    /// The end of what the run has written to its standard error.
    fn last_words(&self) -> String {
        let text = fs::read_to_string(words_path(self.place, &self.name)).unwrap_or_default();
        let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
        lines[lines.len().saturating_sub(4)..].join(" / ")
    }
}

/// What is done to a run: some cards of the shuffled deck, or each kind once if the measurement is quick.
fn draw_cards(is_quick: bool, random: &mut fastrand::Rng) -> Vec<Disturbance> {
    let of_kind =
        |(disturbance, count): (Disturbance, usize)| std::iter::repeat_n(disturbance, if is_quick { 1 } else { count });
    let mut cards: Vec<Disturbance> = DECK.into_iter().flat_map(of_kind).collect();
    random.shuffle(&mut cards);
    cards.truncate(DISTURBANCES);
    cards
}

/// Simulated seconds per second of a disturbed run: slow enough that its disturbances meet every part of it.
const PACE: f64 = 6.0;

fn words_path(place: &EndurancePlace, name: &str) -> PathBuf {
    place.directory.join(format!("{name}.stderr"))
}

fn start(place: &EndurancePlace, name: &str, arguments: &[String]) -> Result<Child, Exit> {
    let path = words_path(place, name);
    let words = File::create(&path).map_err(|error| Exit::io("write", &path, &error))?;
    let child = place.command(arguments).stderr(words).spawn();
    child.map_err(|error| Exit::io("start", &place.caraware, &error))
}

fn names_in(directory: &Path) -> Vec<String> {
    let entries = fs::read_dir(directory).into_iter().flatten().flatten();
    entries
        .map(|entry| entry.file_name().to_string_lossy().into_owned())
        .collect()
}

fn pid(child: &Child) -> Pid {
    Pid::from_child(child)
}

fn pause() {
    std::thread::park_timeout(POLL_INTERVAL);
}

fn free_port() -> Result<u16, Exit> {
    std::net::TcpListener::bind("127.0.0.1:0")
        .and_then(|listener| listener.local_addr())
        .map(|address| address.port())
        .map_err(|error| Exit::run(format!("no free port: {error}"), ""))
}
