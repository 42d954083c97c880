//! The process `recorder`: one environment of a run into one file.

use std::{
    path::{Path, PathBuf},
    time::Duration,
};

use ipc_schema::{
    board::{MessageStream, State},
    channel::Channel,
    config::{FullDiskAction, RecordManner},
    failure::{Failure, FailureKind},
    membership::{RunMembership, incarnation},
    ports::BoardReader,
    process::Process,
    run::RunFile,
};
use serde::Serialize;

use crate::{
    file::{
        RECORDING, RecordingError, RecordingStart,
        writer::{ChunkOptions, RecordingWriter},
    },
    intake::{ChannelIntake, IntakeError},
    run_logs::{RunLogs, first_attachments},
};

/// Longest wait for a message where producers wake `recorder`.
const WAKE_WITHIN: Duration = Duration::from_millis(50);
/// Shortest and longest time between two looks at the queues where no producer does.
const POLL: [Duration; 2] = [Duration::from_micros(500), Duration::from_millis(3)];
/// Time between two attempts on a full disk.
const RETRY: Duration = Duration::from_millis(100);

/// The part of the run's report that this process writes.
#[derive(Debug, Serialize)]
struct RecorderReport<'a> {
    /// The newest file.
    file: &'a Path,
    file_bytes: u64,
    message_bytes: u64,
    messages: std::collections::BTreeMap<String, u64>,
    missed_ticks: u64,
    observation_hash: String,
    /// Why the recording ended before the run; null if it did not.
    stopped: Option<&'a str>,
}

/// Records until the last tick of the run, or until the process is asked to stop.
///
/// # Errors
/// The file cannot be written, or a port failed.
pub fn run(run_file: &Path) -> Result<(), Failure> {
    let membership = RunMembership::join(run_file, Process::Recorder)?;
    RunRecorder::open(membership)?.run()
}

/// Path of a new recording in the directory of an environment; `None` if there are too many.
#[must_use]
pub fn free_path(run_dir: &Path) -> Option<PathBuf> {
    let numbered = (2_u32..10_000).map(|number| format!("recording-{number}.mcap"));
    let mut names = std::iter::once(RECORDING.to_owned()).chain(numbered);
    names.find_map(|name| Some(run_dir.join(name)).filter(|path| !path.exists()))
}

struct RunRecorder {
    membership: RunMembership,
    /// Channels that give credit come first: what goes with their ticks is drained after them and before the credit.
    intakes: Vec<ChannelIntake>,
    /// `None` once the recording has ended before the run.
    writer: Option<RecordingWriter>,
    report_of_stopped: Option<(String, RecordingFigures)>,
    logs: RunLogs,
    /// The disk is full, and that has been logged.
    waits_for_space: bool,
    /// Boards of the processes that send.
    producers: Vec<BoardReader>,
    /// Credit that was given, by [`Channel`]: the stream, and its ticks.
    credited: [(MessageStream, u64); Channel::COUNT],
    poll: Duration,
}

/// Figures of a file.
#[derive(Debug, Clone)]
struct RecordingFigures {
    file: PathBuf,
    file_bytes: u64,
    message_bytes: u64,
    messages: std::collections::BTreeMap<String, u64>,
    observation_hash: String,
}

impl RecordingFigures {
    /// Figures of a file that could not be created.
    fn of_none(path: &Path) -> Self {
        Self {
            file: path.into(),
            file_bytes: 0,
            message_bytes: 0,
            messages: std::collections::BTreeMap::new(),
            observation_hash: String::new(),
        }
    }

    fn of(writer: &RecordingWriter) -> Self {
        Self {
            file: writer.path().into(),
            file_bytes: writer.file_bytes(),
            message_bytes: writer.message_bytes(),
            messages: writer.messages(),
            observation_hash: writer.observation_hash(),
        }
    }
}

impl RunRecorder {
    fn open(mut membership: RunMembership) -> Result<Self, Failure> {
        let run = membership.run.clone();
        let record = &run.config.record;
        let is_taken = |channel: &Channel| {
            (channel.spec().is_used)(&run) && (record.records(*channel) || record.needs_credit(*channel))
        };
        let (pacing, others): (Vec<Channel>, Vec<Channel>) = Channel::ALL
            .into_iter()
            .filter(is_taken)
            .partition(|channel| record.needs_credit(*channel));
        let mut intakes = Vec::new();
        for channel in pacing.into_iter().chain(others) {
            let subscriber = membership.subscriber(channel)?;
            intakes.push(ChannelIntake::new(channel, subscriber, &run));
        }
        let names = Channel::ALL.into_iter().filter(|channel| record.records(*channel));
        let names = names.map(|channel| channel.name().to_owned()).collect();
        let start = RecordingStart::of(&run, names, record.manner == RecordManner::Lossless);
        let path = free_path(&run.run_dir)
            .ok_or_else(|| Failure::new(FailureKind::Run, "the run directory has too many recordings"))?;
        let options = ChunkOptions::from(record);
        let producers = [
            Process::TrafficBridge,
            Process::SimCore,
            Process::SensorDaemon,
            Process::Trainer,
        ];
        let producers = producers.into_iter().filter(|process| (process.spec().is_wanted)(&run));
        let producers = producers
            .map(|process| membership.board_of(process))
            .collect::<Result<_, _>>()?;
        let mut recorder = Self {
            logs: RunLogs::new(&run),
            waits_for_space: false,
            membership,
            intakes,
            writer: None,
            report_of_stopped: None,
            producers,
            credited: [(MessageStream::NONE, 0); Channel::COUNT],
            poll: POLL[0],
        };
        recorder.create_file(&path, &start, &run, options)?;
        let ticks = recorder.first_ticks(&run)?;
        recorder.membership.attach_recorder(ticks);
        Ok(recorder)
    }

    fn create_file(
        &mut self,
        path: &Path,
        start: &RecordingStart,
        run: &RunFile,
        options: ChunkOptions,
    ) -> Result<(), Failure> {
        let attachments = first_attachments(run);
        loop {
            match RecordingWriter::create(path, start.clone(), &attachments, options) {
                Ok(writer) => {
                    self.writer = Some(writer);
                    return Ok(());
                }
                Err(error) => {
                    let figures = RecordingFigures::of_none(path);
                    if !self.outlives(&error, &figures)? {
                        return Ok(());
                    }
                }
            }
        }
    }

    /// Of each channel, the ticks below which this process needs no message: those before the first that is sent.
    fn first_ticks(&self, run: &RunFile) -> Result<[u64; Channel::COUNT], Failure> {
        let mut ticks = [run.first_tick(); Channel::COUNT];
        // Observations of committed ticks are made again but not sent.
        ticks[Channel::Observation as usize] = run.committed_ticks().max(run.first_tick());
        if incarnation() > 0 {
            // What was sent before this incarnation is not in its queues.
            for intake in &self.intakes {
                let sent = self.membership.board_of(intake.channel().producer())?.health().ticks;
                let place = &mut ticks[intake.channel() as usize];
                *place = sent.max(*place);
            }
        }
        Ok(ticks)
    }

    fn run(mut self) -> Result<(), Failure> {
        loop {
            // The state of the run is read first: what a process has sent before it was done is in the queues then.
            let is_over = self.run_is_over() || self.membership.stopped();
            let fullest = self.take_in()?;
            if is_over && fullest == 0.0 {
                break;
            }
            if self.writer.as_ref().is_some_and(RecordingWriter::is_chunk_due) {
                self.close_chunk()?;
            }
            self.report();
            if fullest == 0.0 || !self.is_woken() {
                let timeout = self.next_wait(fullest);
                self.membership.wait(timeout)?;
            }
        }
        self.finish()
    }

    /// True if producers wake this process.
    fn is_woken(&self) -> bool {
        self.membership.run.config.record.manner == RecordManner::Lossless
    }

    /// Without wake-ups the queues are looked at more often, the fuller they were.
    fn next_wait(&mut self, fullest: f64) -> Duration {
        if self.is_woken() {
            return WAKE_WITHIN;
        }
        let factor = match fullest {
            fullest if fullest > 0.5 => 0.5,
            fullest if fullest < 0.25 => 1.2,
            _ => 1.0,
        };
        let [shortest, longest] = POLL;
        self.poll = self.poll.mul_f64(factor).clamp(shortest, longest);
        self.poll
    }

    /// Adds what is queued to the recording and returns credit; returns how full the fullest queue was, from 0 to 1.
    fn take_in(&mut self) -> Result<f64, Failure> {
        let mut fullest = 0.0_f64;
        for intake in &mut self.intakes {
            let received = intake.drain(&mut self.writer).map_err(intake_failure)?;
            #[expect(clippy::cast_precision_loss, reason = "a share of a queue")]
            let share = received as f64 / intake.queue_length().max(1) as f64;
            fullest = fullest.max(share);
        }
        // Only now: what goes with a tick is in the chunk before the producer gets credit for another.
        for intake in &self.intakes {
            let (channel, newest) = (intake.channel(), intake.stream());
            let is_due = newest != self.credited[channel as usize];
            if is_due && self.membership.run.config.record.needs_credit(channel) {
                self.credited[channel as usize] = newest;
                let (stream, ticks) = newest;
                self.membership.recorded(channel, stream, ticks);
            }
        }
        Ok(fullest)
    }

    /// True once every producer has sent everything, and every required consumer has consumed it.
    fn run_is_over(&self) -> bool {
        let is_done = |board: &BoardReader| State::from_u32(board.health().state) == State::Done;
        self.producers.iter().all(is_done)
    }

    fn missed(&self) -> u64 {
        self.intakes.iter().map(ChannelIntake::missed).sum()
    }

    fn report(&mut self) {
        let newest = self.intakes.iter().max_by_key(|intake| intake.received_ticks());
        let Some((newest, ticks)) = newest.map(|intake| (*intake.newest(), intake.received_ticks())) else {
            return;
        };
        let missed = self.missed();
        self.membership.report(|health| {
            health.state = if ticks > 0 { State::Running as u32 } else { health.state };
            health.ticks = ticks;
            health.episode = newest.episode;
            health.sim_time_ns = newest.sim_time_ns;
            health.drops = missed;
        });
    }

    /// Closes the chunk, and lets the configuration decide where the disk is full.
    fn close_chunk(&mut self) -> Result<(), Failure> {
        let Some(writer) = &mut self.writer else { return Ok(()) };
        let logged = self.logs.add_new(writer);
        let closed = logged.and_then(|()| writer.close_chunk());
        self.survive(closed)
    }

    /// Repeats a write that failed for want of space, as the configuration says.
    fn survive(&mut self, mut written: Result<(), RecordingError>) -> Result<(), Failure> {
        loop {
            let Err(error) = written else {
                self.waits_for_space = false;
                return Ok(());
            };
            let Some(writer) = &self.writer else { return Ok(()) };
            let figures = RecordingFigures::of(writer);
            if !self.outlives(&error, &figures)? {
                // The rest of the run needs some space too.
                let room = self.writer.take().map_or(Ok(()), |mut writer| writer.make_room());
                return room.map_err(|error| recording_failure(&error));
            }
            let Some(writer) = &mut self.writer else { return Ok(()) };
            written = writer.write_rest();
        }
    }

    /// True if the write is to be repeated, after a pause; false if the recording ends here.
    fn outlives(&mut self, error: &RecordingError, figures: &RecordingFigures) -> Result<bool, Failure> {
        let action = self.membership.run.config.record.on_full_disk;
        match action {
            FullDiskAction::Wait if error.is_full() && !self.membership.stopped() => {
                if !self.waits_for_space {
                    tracing::warn!(
                        "the disk is full: {} waits until there is space",
                        figures.file.display()
                    );
                }
                self.waits_for_space = true;
                self.membership.wait(RETRY)?;
                Ok(true)
            }
            FullDiskAction::Wait | FullDiskAction::StopRecording if error.is_full() => {
                tracing::warn!("{}: the disk is full; the recording ends here", figures.file.display());
                self.report_of_stopped = Some(("the disk is full".into(), figures.clone()));
                Ok(false)
            }
            _ => Err(recording_failure(error)),
        }
    }

    fn finish(mut self) -> Result<(), Failure> {
        let missed = self.missed();
        if let Some(writer) = &mut self.writer {
            let logged = self.logs.add_new(writer);
            self.survive(logged)?;
        }
        if let Some(writer) = &mut self.writer {
            let finished = writer.finish(missed);
            self.survive(finished)?;
        }
        let figures = self.writer.as_ref().map(RecordingFigures::of);
        let stopped = self.report_of_stopped.clone();
        let (figures, reason) = match (figures, stopped) {
            (Some(figures), _) => (figures, None),
            (None, Some((reason, figures))) => (figures, Some(reason)),
            (None, None) => return Ok(()),
        };
        self.membership.write_part(&RecorderReport {
            file: &figures.file,
            file_bytes: figures.file_bytes,
            message_bytes: figures.message_bytes,
            messages: figures.messages,
            missed_ticks: missed,
            observation_hash: figures.observation_hash,
            stopped: reason.as_deref(),
        })?;
        self.membership.report(|health| health.state = State::Done as u32);
        Ok(())
    }
}

fn intake_failure(error: IntakeError) -> Failure {
    match error {
        IntakeError::Port(error) => error.into(),
        IntakeError::Recording(error) => recording_failure(&error),
    }
}

fn recording_failure(error: &RecordingError) -> Failure {
    let failure = Failure::from_error(FailureKind::Run, error);
    match error.is_full() {
        true => failure
            .with_help("free space in the run directory, or set record.on_full_disk to \"wait\" or \"stop_recording\""),
        false => failure,
    }
}
