//! One run that is disturbed at random moments until it has completed.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{self, File},
    io::Write as _,
    os::unix::process::ExitStatusExt as _,
    path::{Path, PathBuf},
    process::{Child, Command, ExitStatus, Stdio},
    time::{Duration, Instant},
};

use caraware::failure::Exit;
use ipc_schema::{
    ports::BoardReader,
    process::Process,
    run::RunFile,
    services::{self, RunNode},
};
use rustix::process::{Pid, Signal};
use serde_json::Value;

use super::case::EnduranceCase;
use crate::free_port;
use crate::target::{CountedMemory, Target, processes_of, resources, signal};

/// Interval at which the resources of all processes are read, which costs some milliseconds.
const LOOK_INTERVAL: Duration = Duration::from_millis(250);
/// Interval at which a run is looked at.
const POLL_INTERVAL: Duration = Duration::from_millis(5);
/// Longest time in which a run must end after its last disturbance, and in which a killed simulator's environment must make a new tick.
const DEADLINE: Duration = Duration::from_secs(300);
/// Longest pause of a stopped process, seconds.
const LONGEST_PAUSE_S: f64 = 1.5;
/// Mean distance of two disturbances, seconds.
const MEAN_S: f64 = 0.8;
/// Time until the next disturbance where there was no process for one. If that took as long as a disturbance, a short run could end
/// before all have been made.
const RETRY_INTERVAL: Duration = Duration::from_millis(50);
/// A larger file of a run with faults is not kept.
const MOST_KEPT_BYTES: u64 = 4 << 20;
/// Viewers at once.
const VIEWERS: usize = 3;
/// The learners that take turns: ours, and the one of docs/learners.md.
const LEARNERS: [&str; 2] = ["caraware.train", "caraware.examples.minimal_learner"];
/// What is done, and how many cards of the deck each has: a run draws them all.
const DECK: [(Disturbance, usize); 14] = [
    (Disturbance::Kill(Target::Trainer), 10),
    (Disturbance::Kill(Target::TrafficBridge), 3),
    (Disturbance::Kill(Target::SimCore), 3),
    (Disturbance::Kill(Target::SensorDaemon), 3),
    (Disturbance::Kill(Target::V2x), 3),
    (Disturbance::Kill(Target::Fanout), 3),
    (Disturbance::Kill(Target::Recorder), 3),
    (Disturbance::Kill(Target::Supervisor), 1),
    (Disturbance::Pause, 2),
    (Disturbance::Hang, 1),
    (Disturbance::Handover, 2),
    (Disturbance::HeldHandover, 2),
    (Disturbance::Viewer, 4),
    (Disturbance::FullDisk, 1),
];

/// What is done to a run.
#[derive(Debug, Clone, Copy)]
enum Disturbance {
    /// A process is killed (SIGKILL).
    Kill(Target),
    /// A process of any kind is stopped and continues later (SIGSTOP, SIGCONT).
    Pause,
    /// A process of the run is stopped until the supervisor has killed it.
    Hang,
    /// The trainer is replaced by its successor, or by a learner of another kind.
    Handover,
    /// The simulation is paused by a command, its trainer is replaced, and it is resumed at once, while the successor still catches up.
    HeldHandover,
    /// A viewer is killed or stopped, and others are started.
    Viewer,
    /// The disk of the runs is full for a while.
    FullDisk,
}

/// What was done to the runs of a case, what was measured, and what is still to be done.
#[derive(Debug, Default)]
pub struct EnduranceCounts {
    /// What the last run that completed ended before, in reverse order.
    missed: Vec<Disturbance>,
    /// Disturbances by name.
    pub disturbances: BTreeMap<String, u32>,
    /// Handovers that were refused or given up, by the first line of the reason.
    pub refusals: BTreeMap<String, u32>,
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
    /// True if the last run completed before everything had been done to it.
    #[must_use]
    pub const fn has_missed(&self) -> bool {
        !self.missed.is_empty()
    }

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
    /// True if the directory is a small disk of its own, which can be filled.
    pub has_small_disk: bool,
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

    /// Where the logs of a run with faults stay after the measurement.
    #[must_use]
    pub fn kept(&self, name: &str) -> PathBuf {
        let mut kept = self.directory.as_os_str().to_owned();
        kept.push("-faults");
        Path::new(&kept).join(name)
    }

    /// Directory of a run.
    #[must_use]
    pub fn run(&self, name: &str) -> PathBuf {
        self.directory.join("runs").join(name)
    }
}

/// The boards of `sensor-daemon` in all environments, and of the trainer. They are opened while a run starts and kept until its end: a
/// node that is opened while a run ends would leave files behind.
struct WatchedBoards {
    boards: Vec<BoardReader>,
    trainer: BoardReader,
    _node: RunNode,
}

impl WatchedBoards {
    /// Opens the boards of a run; `None` while they are not there.
    fn open(run: &RunFile, envs: u32) -> Option<Self> {
        let node = services::node(&run.shared_memory).ok()?;
        let board = |env| BoardReader::open(&node, run, env, Process::SensorDaemon).ok();
        Some(Self {
            boards: (0..envs).map(board).collect::<Option<_>>()?,
            trainer: BoardReader::open(&node, run, 0, Process::Trainer).ok()?,
            _node: node,
        })
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
    watched: Option<WatchedBoards>,
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
    /// Starts a run of `case`. The random numbers decide what is done to it and when. In a quick measurement it is what the run before
    /// missed, if that was something.
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
        let cards = match place.is_quick && counts.has_missed() {
            true => std::mem::take(&mut counts.missed),
            false => draw_cards(place, case, &mut random),
        };
        Ok(Self {
            child: start(place, name, &case.arguments(name, PACE, Some(port)))?,
            place,
            case,
            name: name.to_owned(),
            port,
            viewers: Vec::new(),
            handovers: Vec::new(),
            prefixes: BTreeSet::new(),
            watched: None,
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
                    self.watched = None;
                    self.check_left_behind();
                    return Ok(None);
                }
                self.resume()?;
            }
            if Instant::now() >= due
                && let Some(card) = self.cards.pop()
            {
                due = if self.carry_out(card)? {
                    last = Instant::now();
                    self.next_moment()
                } else {
                    // The process was not there: after all others.
                    self.cards.insert(0, card);
                    Instant::now() + RETRY_INTERVAL
                };
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
            if self.watched.is_none() && self.wrote(&run) {
                self.watched = WatchedBoards::open(&run, self.case.envs);
            }
            self.prefixes.insert(run.shared_memory.prefix);
        }
        for target in Target::ALL {
            let pids = match target {
                Target::Supervisor => vec![pid(&self.child)],
                _ => target.processes(&directory),
            };
            for (resident_mib, handles) in pids
                .into_iter()
                .filter_map(|pid| resources(pid, CountedMemory::Resident))
            {
                let peak = self.counts.peaks.entry(target).or_default();
                *peak = (peak.0.max(resident_mib), peak.1.max(handles));
            }
        }
    }

    /// True if the supervisor that lives wrote this run file: that of a killed one is there until its successor has written its own.
    fn wrote(&self, run: &RunFile) -> bool {
        run.supervisor_pid == pid(&self.child).as_raw_nonzero().get()
    }

    fn is_prepared(&self) -> bool {
        RunFile::read(&self.directory().join("run.json")).is_ok_and(|run| self.wrote(&run))
    }

    /// Returns false if there was no process to disturb.
    fn carry_out(&mut self, disturbance: Disturbance) -> Result<bool, Exit> {
        match disturbance {
            Disturbance::Kill(Target::Supervisor) => self.kill_supervisor(),
            Disturbance::Kill(target) => self.kill(target),
            Disturbance::Pause => self.pause_process(),
            Disturbance::Hang => self.hang_process(),
            Disturbance::Handover => self.hand_over(),
            Disturbance::HeldHandover => self.hand_over_while_paused(),
            Disturbance::Viewer => self.disturb_viewers(),
            Disturbance::FullDisk => self.fill_disk(),
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
        let boards = self.watched.iter().flat_map(|watched| &watched.boards);
        boards.map(|board| board.health().ticks).collect()
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
        self.watched = None;
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

    /// Stops a process that the supervisor starts, and waits until it has been killed and so can be replaced.
    fn hang_process(&mut self) -> Result<bool, Exit> {
        // A process that does not get ready when a run starts or resumes ends the run, so that no hang is found while a trainer starts.
        let has_begun = |watched: &WatchedBoards| watched.trainer.progress().consumed_ticks > 0;
        if !self.watched.as_ref().is_some_and(has_begun) {
            return Ok(false);
        }
        let directory = self.directory();
        let pids = |target: Target| target.processes(&directory).into_iter().map(move |pid| (target, pid));
        let processes = Target::ALL.into_iter().filter(|target| *target != Target::Supervisor);
        let hanging = self.random.choice(processes.flat_map(pids).collect::<Vec<_>>());
        let Some((target, hanging)) = hanging.filter(|(_, pid)| signal(*pid, Signal::STOP)) else {
            return Ok(false);
        };
        self.counts.count(format!("{} hung", target.name()));
        let begun = Instant::now();
        while target.processes(&self.directory()).contains(&hanging) && self.ended()?.is_none() {
            if begun.elapsed() > DEADLINE {
                self.fault(&format!("{} hung and was not killed", target.name()));
                signal(hanging, Signal::CONT);
                break;
            }
            pause();
        }
        Ok(true)
    }

    /// Asks for a handover, after the next update or at once. It may be refused, for instance because the trainer was killed meanwhile.
    fn hand_over(&mut self) -> Result<bool, Exit> {
        if self.watched.is_none() {
            return Ok(false);
        }
        let client = self.ask_for_handover()?;
        // Every second time the next disturbance may come amid the handover.
        if self.random.bool() {
            self.handovers.push(client);
            return Ok(true);
        }
        if !self.count_handover(client)? {
            // It is asked for again after all other disturbances.
            self.cards.insert(0, Disturbance::Handover);
        }
        Ok(true)
    }

    /// Pauses the simulation, replaces the trainer and resumes. The pause is refused while an environment is being made again.
    fn hand_over_while_paused(&mut self) -> Result<bool, Exit> {
        if self.watched.is_none() || !self.control("pause")? {
            return Ok(false);
        }
        self.counts.count("paused");
        let client = self.ask_for_handover()?;
        let is_made = self.count_handover(client)?;
        let begun = Instant::now();
        while !self.control("resume")? && self.ended()?.is_none() {
            if begun.elapsed() > DEADLINE {
                self.fault("a paused run was not resumed");
                break;
            }
            pause();
        }
        if !is_made {
            self.cards.insert(0, Disturbance::HeldHandover);
        }
        Ok(true)
    }

    /// Sends a command to all environments; true if it was carried out.
    fn control(&self, action: &str) -> Result<bool, Exit> {
        let mut command = self
            .place
            .command(&["control", action, "--run", &self.name].map(str::to_owned));
        let status = command.stderr(Stdio::null()).status();
        let status = status.map_err(|error| Exit::io("start", &self.place.caraware, &error))?;
        Ok(status.success())
    }

    /// Starts a client that asks for a handover.
    fn ask_for_handover(&mut self) -> Result<Child, Exit> {
        let mut arguments = vec!["handover".to_owned(), self.name.clone()];
        if self.random.bool() {
            arguments.push("--now".into());
        }
        if self.case.learners_take_turns {
            let module = self.other_learner()?;
            arguments.extend(["--set".into(), format!("trainer.module={module}")]);
        }
        let client = self.place.command(&arguments).stderr(Stdio::piped()).spawn();
        let client = client.map_err(|error| Exit::io("start", &self.place.caraware, &error))?;
        self.counts.count("handover asked for");
        Ok(client)
    }

    /// The learner's module that the run does not have now.
    fn other_learner(&self) -> Result<&'static str, Exit> {
        let run = RunFile::read(&self.directory().join("run.json"))
            .map_err(|error| Exit::run(format!("the run file cannot be read: {error}"), ""))?;
        let [ours, other] = LEARNERS;
        Ok(if run.config.trainer.module == ours { other } else { ours })
    }

    /// Waits for the end of a handover. Returns false if it was not made.
    fn count_handover(&mut self, mut client: Child) -> Result<bool, Exit> {
        let failed = |error: &std::io::Error| Exit::io("wait for", &self.place.caraware, error);
        let begun = Instant::now();
        while client.try_wait().map_err(|error| failed(&error))?.is_none() {
            if begun.elapsed() > DEADLINE {
                self.fault(&format!("a handover had no answer within {} s", DEADLINE.as_secs()));
                // It may end just now.
                let _ = client.kill();
                break;
            }
            pause();
        }
        let output = client.wait_with_output().map_err(|error| failed(&error))?;
        if output.status.success() {
            self.counts.count("handover made");
            return Ok(true);
        }
        self.counts.count("handover refused or given up");
        let text = String::from_utf8_lossy(&output.stderr);
        let line = text.lines().find(|line| !line.trim().is_empty()).unwrap_or_default();
        // Numbers differ from run to run.
        let reason = line.trim().replace(|letter: char| letter.is_ascii_digit(), "#");
        *self.counts.refusals.entry(reason).or_default() += 1;
        Ok(false)
    }

    /// Kills a viewer, or stops one for good every fourth time. There are always some.
    fn disturb_viewers(&mut self) -> Result<bool, Exit> {
        while self.viewers.len() < VIEWERS {
            let viewer = Command::new(&self.place.watch)
                .args([&format!("tcp/127.0.0.1:{}", self.port), &self.name, "--seconds", "600"])
                .stdin(Stdio::null())
                .stdout(Stdio::null())
                .stderr(Stdio::null())
                .spawn();
            self.viewers
                .push(viewer.map_err(|error| Exit::io("start", &self.place.watch, &error))?);
            self.counts.count("viewer started");
        }
        let index = self.random.usize(0..self.viewers.len());
        if self.random.usize(0..4) == 0 {
            signal(pid(&self.viewers[index]), Signal::STOP);
            self.counts.count("viewer stopped");
        } else {
            let mut viewer = self.viewers.swap_remove(index);
            let is_alive = matches!(viewer.try_wait(), Ok(None));
            // A viewer whose fan-out has ended may have ended as well.
            let _ = viewer.kill();
            let _ = viewer.wait();
            self.counts.count(match is_alive {
                true => "viewer killed",
                false => "viewer had ended with its fan-out",
            });
        }
        Ok(true)
    }

    /// Leaves no byte on the disk for a while, also if the run removes files.
    fn fill_disk(&mut self) -> Result<bool, Exit> {
        // A run that this process has not prepared yet is refused on a full disk.
        if !self.is_prepared() {
            return Ok(false);
        }
        let path = self.place.directory.join("ballast");
        let failed = |error: &std::io::Error| Exit::io("write", &path, error);
        let mut ballast = File::create(&path).map_err(|error| failed(&error))?;
        let until = Instant::now() + Duration::from_secs_f64(LONGEST_PAUSE_S * self.random.f64());
        loop {
            for bytes in [1 << 20, 4096, 1] {
                let block = vec![0; bytes];
                while ballast.write_all(&block).is_ok() {}
            }
            if Instant::now() >= until {
                break;
            }
            pause();
        }
        self.counts.count("disk filled");
        drop(ballast);
        fs::remove_file(&path).map_err(|error| failed(&error))?;
        Ok(true)
    }

    /// Checks what a completed run leaves behind, and reads its report.
    fn finish(mut self) -> Result<Option<Value>, Exit> {
        self.counts.runs += 1;
        self.counts.missed = std::mem::take(&mut self.cards);
        self.watched = None;
        for client in std::mem::take(&mut self.handovers) {
            self.count_handover(client)?;
        }
        self.check_left_behind();
        let path = self.directory().join("report.json");
        let text = fs::read_to_string(&path).map_err(|error| Exit::io("read", &path, &error))?;
        let report = serde_json::from_str(&text);
        Ok(Some(report.map_err(|error| {
            Exit::run(format!("{}: {error}", path.display()), "")
        })?))
    }

    /// Adds a fault for what outlives the run, and removes it from the registry: the next run leaves it behind as well otherwise.
    fn check_left_behind(&mut self) {
        let left = self.left_behind();
        if !left.is_empty() {
            self.fault(&format!("left behind: {}", left.join(", ")));
        }
        for name in names_in(&self.place.registry()) {
            let path = self.place.registry().join(&name);
            let moved = self.place.kept(&self.name).join(name);
            if let Err(error) = fs::rename(&path, &moved).or_else(|_| fs::remove_dir_all(&path)) {
                tracing::warn!(%error, path = %path.display(), "cannot be removed");
            }
        }
    }

    /// Processes, files in shared memory and entries of the registry that outlive the run.
    fn left_behind(&self) -> Vec<String> {
        let processes = processes_of(&self.directory()).into_iter();
        let processes = processes.map(|(pid, line)| format!("process {} ({})", pid.as_raw_nonzero(), line.join(" ")));
        let is_ours = |file: &String| self.prefixes.iter().any(|prefix| file.starts_with(prefix));
        let files = names_in(Path::new("/dev/shm")).into_iter().filter(is_ours);
        processes.chain(files).chain(names_in(&self.place.registry())).collect()
    }

    /// Adds a fault, and keeps what the run has logged.
    fn fault(&mut self, text: &str) {
        let kept = self.place.kept(&self.name);
        let copied = copy_logs(&self.directory(), &kept).and_then(|()| {
            let words = words_path(self.place, &self.name);
            fs::copy(words, kept.join("standard-error.txt")).map(|_| ())
        });
        if let Err(error) = copied {
            tracing::warn!(%error, path = %kept.display(), "cannot keep a run's logs");
        }
        let text = format!("run {}: {text} (its logs are in {})", self.name, kept.display());
        caraware::display::notice(&text);
        self.counts.faults.push(text);
    }

    /// The end of what the run has written to its standard error.
    fn last_words(&self) -> String {
        let text = fs::read_to_string(words_path(self.place, &self.name)).unwrap_or_default();
        let lines: Vec<&str> = text.lines().filter(|line| !line.trim().is_empty()).collect();
        lines[lines.len().saturating_sub(4)..].join(" / ")
    }
}

/// What is done to a run: the shuffled deck, or each kind once if the measurement is quick.
fn draw_cards(place: &EndurancePlace, case: &EnduranceCase, random: &mut fastrand::Rng) -> Vec<Disturbance> {
    let is_possible = |(disturbance, _): &(Disturbance, usize)| match disturbance {
        Disturbance::Kill(target) => case.has(*target),
        Disturbance::FullDisk => place.has_small_disk && case.survives_a_full_disk,
        Disturbance::Pause
        | Disturbance::Hang
        | Disturbance::Handover
        | Disturbance::HeldHandover
        | Disturbance::Viewer => true,
    };
    let of_kind = |(disturbance, count): (Disturbance, usize)| {
        std::iter::repeat_n(disturbance, if place.is_quick { 1 } else { count })
    };
    let possible = DECK.into_iter().filter(is_possible);
    let mut cards: Vec<Disturbance> = possible.flat_map(of_kind).collect();
    random.shuffle(&mut cards);
    cards
}

/// Simulated seconds per second of a disturbed run: slow enough that its disturbances meet every part of it.
const PACE: f64 = 6.0;

/// Copies a run's logs, events and small files, without its checkpoints and recordings.
fn copy_logs(from: &Path, to: &Path) -> std::io::Result<()> {
    fs::create_dir_all(to)?;
    for entry in fs::read_dir(from)? {
        let entry = entry?;
        let (name, kind) = (entry.file_name(), entry.file_type()?);
        if kind.is_dir() && name != "checkpoints" {
            copy_logs(&entry.path(), &to.join(name))?;
        } else if kind.is_file() && entry.metadata()?.len() < MOST_KEPT_BYTES {
            fs::copy(entry.path(), to.join(name))?;
        }
    }
    Ok(())
}

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
