//! A recorder beside a run: it watches from outside, takes no part, and no process waits for it (`caraware record RUN`).

use std::{
    path::Path,
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use ipc_schema::{
    channel::Channel,
    failure::{Failure, FailureKind},
    ports::Subscriber,
    run::RunFile,
    services,
};

use crate::{
    file::{RecordingError, RecordingStart, writer::RecordingWriter},
    intake::{ChannelIntake, IntakeError},
    run_logs::{RunLogs, first_attachments},
};

/// Time between two looks at the queues.
const POLL: Duration = Duration::from_millis(1);

/// What was recorded beside a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct OutsideFigures {
    /// Bytes of the file.
    pub file_bytes: u64,
    /// Bytes of the messages.
    pub message_bytes: u64,
    /// Ticks that were missed.
    pub missed_ticks: u64,
}

/// Records `channels` of the environment of `run` into the new file `path`, until the run is over or `stop` is set.
///
/// # Errors
/// The file cannot be written, or the run's services cannot be opened.
pub fn record(
    run: &RunFile,
    channels: &[Channel],
    path: &Path,
    stop: &AtomicBool,
    is_alive: impl Fn() -> bool,
) -> Result<OutsideFigures, Failure> {
    let failed = |error: &dyn std::error::Error| Failure::from_error(FailureKind::Run, error);
    let node = services::node(&run.shared_memory).map_err(|error| failed(&error))?;
    let mut intakes = Vec::new();
    for channel in channels.iter().copied().filter(|channel| (channel.spec().is_used)(run)) {
        let service = services::open_data(&node, run, run.env_index, channel).map_err(|error| failed(&error))?;
        let subscriber = Subscriber::create(&service, channel, run)?;
        intakes.push(ChannelIntake::new(channel, subscriber, run));
    }
    let names = channels.iter().map(|channel| channel.name().to_owned()).collect();
    let record = &run.config.record;
    let file_failed = |error: RecordingError| {
        Failure::from_error(FailureKind::Run, &error).with_help("name another file with --output, or free space")
    };
    let mut writer = Some(
        RecordingWriter::create(
            path,
            RecordingStart::of(run, names, false),
            &first_attachments(run),
            record.into(),
        )
        .map_err(file_failed)?,
    );
    let mut logs = RunLogs::new(run);
    loop {
        // The state of the run is read first: what was sent before its end is in the queues then.
        let is_over = stop.load(Ordering::Relaxed) || !is_alive();
        let mut received = 0;
        for intake in &mut intakes {
            received += intake.drain(&mut writer).map_err(|error| match error {
                IntakeError::Port(error) => error.into(),
                IntakeError::Recording(error) => file_failed(error),
            })?;
        }
        if let Some(writer) = &mut writer
            && (writer.is_chunk_due() || is_over)
        {
            logs.add_new(writer).map_err(file_failed)?;
            writer.close_chunk().map_err(file_failed)?;
        }
        if is_over {
            break;
        }
        if received == 0 {
            std::thread::park_timeout(POLL);
        }
    }
    let missed_ticks = intakes.iter().map(ChannelIntake::missed).sum();
    let mut figures = OutsideFigures {
        file_bytes: 0,
        message_bytes: 0,
        missed_ticks,
    };
    if let Some(writer) = &mut writer {
        writer.finish(missed_ticks).map_err(file_failed)?;
        (figures.file_bytes, figures.message_bytes) = (writer.file_bytes(), writer.message_bytes());
    }
    Ok(figures)
}
