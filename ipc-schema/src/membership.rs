//! How a process takes part in a run: it joins, opens its ports, waits for data or credit, reports, and leaves.

use std::{
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use crate::{
    SCHEMA_VERSION,
    activity::{Activity, Awaited},
    board::{Health, MessageStream, Progress, State},
    clock, episode_state,
    failure::{FILE_HELP, Failure, FailureKind},
    header::MessageHeader,
    ports::{BoardError, BoardReader, BoardWriter, ControlServer, PortError, Publisher, Subscriber, Waker, wait},
    process::Process,
    required_consumers::SentStream,
    run::{RunFile, RunFileError},
    scheduling,
    services::{self, BoardSeries, Channel, RunNode, ServiceError, WakeListener},
    storage,
    usage::{self, Usage},
};

pub use crate::{
    process_main::{main, main_heard},
    required_consumers::RequiredConsumers,
};

/// Environment variable with the number of times a process has been started before.
pub const INCARNATION: &str = "CARAWARE_INCARNATION";

/// How often this process has been started before, as the supervisor says.
#[must_use]
pub fn incarnation() -> u32 {
    std::env::var(INCARNATION)
        .ok()
        .and_then(|text| text.parse().ok())
        .unwrap_or(0)
}

/// States of episodes that a process keeps in a run without a trainer.
const KEPT_STATES: usize = 16;
/// Longest wait between two looks at credit, data and the stop flag.
const LOOK: Duration = Duration::from_millis(50);

/// A process cannot take part in the run any more.
#[derive(Debug, thiserror::Error)]
pub enum MembershipError {
    /// The run file cannot be used.
    #[error(transparent)]
    RunFile(#[from] RunFileError),
    /// A service cannot be opened.
    #[error(transparent)]
    Service(#[from] ServiceError),
    /// A port failed.
    #[error(transparent)]
    Port(#[from] PortError),
    /// The signal handler or the bond to the supervisor could not be set up.
    #[error("cannot set up {what}")]
    System {
        /// What.
        what: &'static str,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// The supervisor is gone.
    #[error("the supervisor (process {pid}) is gone")]
    Orphaned {
        /// Its process id.
        pid: i32,
    },
}

/// Whether to go on after a wait.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[must_use]
pub enum Wait {
    /// What was waited for is there.
    Ready,
    /// The process was asked to stop.
    Stopped,
}

/// One process's part in a run.
pub struct RunMembership {
    /// What the supervisor said.
    pub run: RunFile,
    process: Process,
    env_index: u32,
    incarnation: u32,
    node: RunNode,
    board: BoardWriter,
    wake: Arc<WakeListener>,
    stop: Arc<AtomicBool>,
    progress: Progress,
    health: Health,
    upstream: Vec<Waker>,
    /// The process whose messages this one must consume, if there is one.
    source: Option<Process>,
    /// Processor time used before the work began, seconds.
    start_cpu_s: f64,
}

impl RunMembership {
    /// Joins the run as `process` of the environment that the run file speaks to: opens its board and wake-up, ends with the
    /// supervisor, stops at SIGTERM and SIGINT.
    ///
    /// # Errors
    /// The run file, the shared memory or the supervisor is not there.
    pub fn join(run_file: &Path, process: Process) -> Result<Self, MembershipError> {
        let stop = Arc::new(AtomicBool::new(false));
        for signal in [signal_hook::consts::SIGTERM, signal_hook::consts::SIGINT] {
            signal_hook::flag::register(signal, Arc::clone(&stop)).map_err(|source| MembershipError::System {
                what: "signal handling",
                source,
            })?;
        }
        let run = RunFile::read(run_file)?;
        let env_index = run.env_index;
        Self::join_with(run, process, env_index, stop)
    }

    /// Joins like [`RunMembership::join`] but leaves signals to the caller, which sets `stop`.
    ///
    /// # Errors
    /// As [`RunMembership::join`].
    pub fn join_with(
        run: RunFile,
        process: Process,
        env_index: u32,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, MembershipError> {
        end_with_supervisor(run.supervisor_pid)?;
        Self::open(run, process, env_index, stop)
    }

    /// Joins like [`RunMembership::join_with`] from a process that the supervisor did not start, and that outlives the run: it does not end
    /// with the supervisor, and has to ask [`RunMembership::supervisor_lives`] while it waits.
    ///
    /// # Errors
    /// As [`RunMembership::join`].
    pub fn join_from_outside(
        run: RunFile,
        process: Process,
        env_index: u32,
        stop: Arc<AtomicBool>,
    ) -> Result<Self, MembershipError> {
        if !lives(run.supervisor_pid) {
            return Err(MembershipError::Orphaned {
                pid: run.supervisor_pid,
            });
        }
        Self::open(run, process, env_index, stop)
    }

    /// False once the supervisor is gone, and its parent, if that lives, has taken note of its end.
    #[must_use]
    pub fn supervisor_lives(&self) -> bool {
        lives(self.run.supervisor_pid)
    }

    fn open(run: RunFile, process: Process, env_index: u32, stop: Arc<AtomicBool>) -> Result<Self, MembershipError> {
        if run.keeps_time(process)
            && let Err(error) = scheduling::ask_for_short_turns()
        {
            tracing::debug!(%error, "ticks may have to wait for a core");
        }
        storage::stop_waiting_at(&stop);
        let node = services::node(&run.shared_memory)?;
        let wakes = services::open_wake(&node, &run, env_index, process)?;
        let wake =
            storage::retry_on_full_disk(|| wakes.listener_builder().create()).map_err(|e| PortError::Refused {
                channel: "wake",
                action: "creation of the listener",
                reason: storage::reason_of(&e),
            })?;
        Self::take_place(run, process, env_index, stop, node, Arc::new(wake))
    }

    /// The place of this process, which is one for the whole run and has joined environment 0, in another of its environments. Both are
    /// woken and wait together.
    ///
    /// # Errors
    /// There is no such environment.
    pub fn in_environment(&self, env_index: u32) -> Result<Self, MembershipError> {
        Self::take_place(
            self.run.environment(env_index),
            self.process,
            env_index,
            Arc::clone(&self.stop),
            Arc::clone(&self.node),
            Arc::clone(&self.wake),
        )
    }

    fn take_place(
        run: RunFile,
        process: Process,
        env_index: u32,
        stop: Arc<AtomicBool>,
        node: RunNode,
        wake: Arc<WakeListener>,
    ) -> Result<Self, MembershipError> {
        let incarnation = incarnation();
        let board = BoardWriter::create(&BoardSeries::new(&run, env_index, process).open(&node, incarnation)?)?;
        let progress = Progress {
            incarnation,
            ..Progress::default()
        };
        board.set_progress(progress);
        let health = Health {
            state: State::Starting as u32,
            pid: std::process::id().try_into().unwrap_or(0),
            ..Health::default()
        };
        board.set_health(health);
        Ok(Self {
            run,
            process,
            env_index,
            incarnation,
            node,
            board,
            wake,
            stop,
            progress,
            health,
            upstream: Vec::new(),
            source: None,
            start_cpu_s: 0.0,
        })
    }

    /// The sending end of `channel`.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn publisher(&self, channel: Channel) -> Result<Publisher, MembershipError> {
        let service = services::open_data(&self.node, &self.run, self.env_index, channel)?;
        Ok(Publisher::create(&service, channel, &self.run)?)
    }

    /// The receiving end of `channel`; its producer will be woken by [`RunMembership::consumed`].
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn subscriber(&mut self, channel: Channel) -> Result<Subscriber, MembershipError> {
        let service = services::open_data(&self.node, &self.run, self.env_index, channel)?;
        if channel.requires(self.process, &self.run) {
            self.upstream.push(self.waker(channel.producer())?);
            self.source = Some(channel.producer());
        }
        let subscriber = Subscriber::create(&service, channel, &self.run)?;
        // What may be sent again is addressed to an incarnation of the trainer: a later one refuses it. Other messages are for any
        // incarnation.
        Ok(match (channel, self.process) {
            (Channel::Observation | Channel::Neighbours, Process::Trainer) => {
                subscriber.since_incarnation(self.incarnation)
            }
            _ => subscriber,
        })
    }

    /// The required consumers of `channel` that the run has.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn required_consumers(&self, channel: Channel) -> Result<RequiredConsumers, MembershipError> {
        self.consumers(channel.required(&self.run), channel)
    }

    /// `processes` as consumers of `channel`, each of which must return credit.
    ///
    /// # Errors
    /// A service cannot be opened.
    pub fn consumers(
        &self,
        processes: impl IntoIterator<Item = Process>,
        channel: Channel,
    ) -> Result<RequiredConsumers, MembershipError> {
        let (mut boards, mut wakers) = (Vec::new(), Vec::new());
        for process in processes {
            boards.push((process, self.board_of(process)?));
            wakers.push(self.waker(process)?);
        }
        Ok(RequiredConsumers {
            boards,
            wakers,
            channel,
            window: (channel.spec().window)(&self.run),
            stream: SentStream::of(incarnation()),
        })
    }

    /// The end that answers commands.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn control_server(&self) -> Result<ControlServer, MembershipError> {
        let service = services::open_control(&self.node, &self.run, self.env_index)?;
        Ok(ControlServer::create(&service)?)
    }

    /// Wakes `process`.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn waker(&self, process: Process) -> Result<Waker, MembershipError> {
        Ok(Waker::create(&services::open_wake(
            &self.node,
            &self.run,
            self.env_index,
            process,
        )?)?)
    }

    /// The board of `process`.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn board_of(&self, process: Process) -> Result<BoardReader, MembershipError> {
        self.board_in(self.env_index, process)
    }

    /// The board of `process` in environment `env_index`.
    ///
    /// # Errors
    /// The service cannot be opened.
    pub fn board_in(&self, env_index: u32, process: Process) -> Result<BoardReader, MembershipError> {
        Ok(BoardReader::open(&self.node, &self.run, env_index, process)?)
    }

    /// Header for a message of this process; the caller adds episode, tick, time and sizes.
    #[must_use]
    pub fn header(&self) -> MessageHeader {
        MessageHeader {
            schema_version: SCHEMA_VERSION,
            env_index: self.env_index,
            run_id: self.run.run_id,
            incarnation: self.incarnation,
            ..MessageHeader::default()
        }
    }

    /// All ports are open: producers may send what the run begins with.
    pub fn attach(&mut self) {
        self.attach_from(self.run.first_tick());
    }

    /// All ports are open, and all ticks below `tick` are committed: its producer may send from there on.
    pub fn attach_from(&mut self, tick: u64) {
        self.progress = Progress {
            consumed_ticks: tick,
            received_ticks: tick,
            committed_ticks: tick,
            attached: 1,
            ..self.progress
        };
        self.board.set_progress(self.progress);
        self.begin_work();
        self.report(|health| health.state = State::Ready as u32);
        self.wake_upstream();
    }

    /// From here on processor time counts as that of the work itself: everything has been loaded.
    pub fn begin_work(&mut self) {
        self.start_cpu_s = usage::processor_time_s();
    }

    /// Publishes that this process has received all ticks below `ticks`, and receives the next ones from incarnation `sender` of their
    /// producer.
    pub fn turn_to_sender(&mut self, sender: u32, ticks: u64) {
        (self.progress.sender_incarnation, self.progress.received_ticks) = (sender, ticks);
        self.board.set_progress(self.progress);
        self.wake_upstream();
    }

    /// All ticks below `ticks` have been consumed: their producer gets the credit.
    pub fn consumed(&mut self, ticks: u64) {
        self.note(Awaited::Nothing);
        self.progress.consumed_ticks = ticks;
        self.board.set_progress(self.progress);
        self.wake_upstream();
    }

    /// Attaches `recorder`, which has consumed of each channel the ticks below those given, in the order of [`Channel::ALL`].
    pub fn attach_recorder(&mut self, ticks: [u64; Channel::COUNT]) {
        self.progress.recorded_ticks = ticks;
        self.progress.recorded_senders = [MessageStream::NONE.sender; Channel::COUNT];
        self.progress.recorded_addressees = [MessageStream::NONE.addressee; Channel::COUNT];
        self.attach();
    }

    /// `recorder` has consumed all ticks of `channel` below `ticks` that `stream` has: its producer gets the credit.
    pub fn recorded(&mut self, channel: Channel, stream: MessageStream, ticks: u64) {
        self.progress.recorded_ticks[channel as usize] = ticks;
        self.progress.recorded_senders[channel as usize] = stream.sender;
        self.progress.recorded_addressees[channel as usize] = stream.addressee;
        self.board.set_progress(self.progress);
        self.wake_upstream();
    }

    /// All ticks below `ticks` are in a checkpoint that has been renamed into place.
    pub fn committed(&mut self, ticks: u64) {
        self.progress.committed_ticks = ticks;
        self.board.set_progress(self.progress);
    }

    /// All work is done: a process that stayed for this one may leave.
    pub fn done(&mut self) {
        self.report(|health| health.state = State::Done as u32);
        self.wake_upstream();
    }

    /// All lessons below `lessons` have a stage of the curriculum: those from lesson `since` on have `stage`, counted from 0.
    pub fn decided(&mut self, lessons: u64, since: u64, stage: u32) {
        self.progress.decided_lessons = lessons;
        self.progress.since_lesson = since;
        self.progress.stage = stage;
        self.board.set_progress(self.progress);
    }

    fn wake_upstream(&self) {
        self.upstream.iter().for_each(Waker::wake);
    }

    /// Stores what this process has counted before `tick`, the first one of an episode, and removes what no restart needs any more.
    ///
    /// # Errors
    /// Not writable, or the trainer's board cannot be opened.
    pub fn store_episode_state(&self, tick: u64, state: &impl serde::Serialize) -> Result<(), Failure> {
        episode_state::store(&self.run, self.process, tick, state)?;
        let committed_ticks = match self.run.mode.has_trainer() {
            true => self.board_of(Process::Trainer)?.progress().committed_ticks,
            // No process asks for a tick again. The others of this environment are some episodes behind at most.
            false => {
                let ticks = episode_state::stored_ticks(&self.run.run_dir, self.process);
                ticks.iter().rev().nth(KEPT_STATES).copied().unwrap_or(0)
            }
        };
        episode_state::forget_before(&self.run, self.process, committed_ticks);
        Ok(())
    }

    /// What this process had counted before the first tick that it makes; `None` where the run begins.
    ///
    /// # Errors
    /// Not readable, or another version wrote it.
    pub fn stored_episode_state<T: serde::de::DeserializeOwned>(&self) -> Result<Option<T>, Failure> {
        episode_state::load(&self.run, self.process, self.run.first_tick())
    }

    /// Changes the health on the board.
    pub fn report(&mut self, change: impl FnOnce(&mut Health)) {
        change(&mut self.health);
        self.health.written_ns = clock::monotonic_ns();
        self.board.set_health(self.health);
        self.note(Awaited::Nothing);
    }

    /// Notes on the board that this process lives, and what it waits for.
    pub fn note(&self, awaited: Awaited) {
        self.board.set_activity(Activity::now(awaited));
    }

    /// Writes what this process adds to the run's report, `parts/<process>.json`, with what it has used of the machine as `process`.
    ///
    /// # Errors
    /// Not writable.
    pub fn write_part(&self, part: &impl serde::Serialize) -> Result<(), Failure> {
        let path = self.run.run_dir.join("parts").join(format!("{}.json", self.process));
        let failed = |reason: &dyn std::fmt::Display| {
            Failure::new(FailureKind::Run, format!("cannot write {}: {reason}", path.display())).with_help(FILE_HELP)
        };
        let mut part = serde_json::to_value(part).map_err(|error| failed(&error))?;
        let used = serde_json::to_value(Usage::so_far(self.start_cpu_s)).map_err(|error| failed(&error))?;
        if let Some(part) = part.as_object_mut() {
            part.insert("process".into(), used);
        }
        let text = serde_json::to_string_pretty(&part).map_err(|error| failed(&error))?;
        let written = storage::when_there_is_space(&path, || storage::write_whole(&path, &text));
        written.map_err(|error| failed(&error))
    }

    /// The board, for the training status.
    #[must_use]
    pub fn board(&self) -> &BoardWriter {
        &self.board
    }

    /// True once the process has been asked to stop.
    #[must_use]
    pub fn stopped(&self) -> bool {
        self.stop.load(Ordering::Relaxed)
    }

    /// Waits until `tick` may be sent to all of `consumers`, or the process is asked to stop.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait_for_credit(&self, consumers: &RequiredConsumers, tick: u64) -> Result<Wait, MembershipError> {
        let lacking = || consumers.lacks_credit(tick).map(Awaited::Credit);
        self.wait_while(lacking)
    }

    /// Waits until all of `consumers` have consumed all ticks below `ticks`: only then may their producer leave.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait_until_consumed(&self, consumers: &RequiredConsumers, ticks: u64) -> Result<Wait, MembershipError> {
        let lacking = || consumers.lacks(ticks).map(Awaited::Credit);
        self.wait_while(lacking)
    }

    /// Waits until `condition` holds or the process is asked to stop; looks again at every wake-up.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait_until(&self, condition: impl FnMut() -> bool) -> Result<Wait, MembershipError> {
        self.wait_until_for(Awaited::Other, condition)
    }

    /// As [`RunMembership::wait_until`], and notes on the board that this process waits for `awaited`.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait_until_for(
        &self,
        awaited: Awaited,
        mut condition: impl FnMut() -> bool,
    ) -> Result<Wait, MembershipError> {
        self.wait_while(|| (!condition()).then_some(awaited))
    }

    /// Waits while `lacking` names what this process waits for, until it is asked to stop. Notes every look on the board.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait_while(&self, mut lacking: impl FnMut() -> Option<Awaited>) -> Result<Wait, MembershipError> {
        let mut has_waited = false;
        loop {
            let Some(awaited) = lacking() else {
                if has_waited {
                    self.note(Awaited::Nothing);
                }
                return Ok(Wait::Ready);
            };
            if self.stopped() {
                return Ok(Wait::Stopped);
            }
            self.note(awaited);
            has_waited = true;
            wait(&self.wake, LOOK)?;
        }
    }

    /// Waits for a wake-up, at most `timeout`.
    ///
    /// # Errors
    /// The wake-up is broken.
    pub fn wait(&self, timeout: Duration) -> Result<(), MembershipError> {
        self.note(self.source.map_or(Awaited::Other, Awaited::Input));
        let waited = wait(&self.wake, timeout);
        self.note(Awaited::Nothing);
        Ok(waited?)
    }

    /// The next message of `subscriber`, waiting for it; `None` once the process is asked to stop.
    ///
    /// # Errors
    /// The port is broken.
    pub fn next(&self, subscriber: &Subscriber) -> Result<Option<crate::ports::Message>, MembershipError> {
        let mut message = None;
        let mut failure = None;
        let producer = Awaited::Input(subscriber.channel().producer());
        let waited = self.wait_until_for(producer, || match subscriber.receive() {
            Ok(received) => {
                message = received;
                message.is_some()
            }
            Err(error) => {
                failure = Some(error);
                true
            }
        })?;
        match (failure, waited) {
            (Some(error), _) => Err(error.into()),
            (None, Wait::Ready) => Ok(message),
            (None, Wait::Stopped) => Ok(None),
        }
    }
}

/// Ends this process when the supervisor ends.
fn end_with_supervisor(pid: i32) -> Result<(), MembershipError> {
    rustix::process::set_parent_process_death_signal(Some(rustix::process::Signal::TERM)).map_err(|e| {
        MembershipError::System {
            what: "the bond to the supervisor",
            source: e.into(),
        }
    })?;
    let parent = rustix::process::getppid().map_or(0, |p| p.as_raw_nonzero().get());
    if parent == pid {
        Ok(())
    } else {
        Err(MembershipError::Orphaned { pid })
    }
}

fn lives(pid: i32) -> bool {
    rustix::process::Pid::from_raw(pid).is_some_and(|pid| rustix::process::test_kill_process(pid).is_ok())
}

impl From<BoardError> for MembershipError {
    fn from(error: BoardError) -> Self {
        match error {
            BoardError::Service(error) => Self::Service(error),
            BoardError::Port(error) => Self::Port(error),
        }
    }
}

impl From<MembershipError> for Failure {
    fn from(error: MembershipError) -> Self {
        match error {
            MembershipError::Port(error) => error.into(),
            error => Self::from_error(FailureKind::Run, &error),
        }
    }
}

impl From<PortError> for Failure {
    fn from(error: PortError) -> Self {
        match &error {
            PortError::Reserve(full) => full.failure(),
            error => Self::from_error(FailureKind::Run, error),
        }
    }
}
