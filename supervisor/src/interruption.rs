//! Ctrl-C, or a request to end, while a command still makes something: what is half made is removed, and the exit code is 130.

use std::{
    path::Path,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    thread::JoinHandle,
    time::Duration,
};

use signal_hook::{
    consts::{SIGHUP, SIGINT, SIGTERM},
    iterator::{Handle, Signals},
    low_level::emulate_default_handler,
};

use crate::{
    display::notice,
    failure::{Exit, INTERRUPTED},
};

/// Attempts to remove a directory into which a program that has been asked to end may still write.
const REMOVALS: usize = 20;
/// Pause between two of them.
const PAUSE: Duration = Duration::from_millis(50);

/// A thread that handles the signals that ask this program to end. Dropping it waits until the last one has been handled.
#[derive(Debug)]
pub struct SignalThread {
    handle: Handle,
    thread: Option<JoinHandle<()>>,
}

impl SignalThread {
    fn start(mut handle_signal: impl FnMut(i32) + Send + 'static) -> Result<Self, Exit> {
        let failed = |error: &std::io::Error| Exit::run(format!("cannot watch signals: {error}"), "");
        let mut signals = Signals::new([SIGINT, SIGTERM, SIGHUP]).map_err(|error| failed(&error))?;
        let handle = signals.handle();
        let thread = std::thread::Builder::new()
            .name("interruption".into())
            .spawn(move || signals.forever().for_each(&mut handle_signal))
            .map_err(|error| failed(&error))?;
        Ok(Self {
            handle,
            thread: Some(thread),
        })
    }
}

impl Drop for SignalThread {
    fn drop(&mut self) {
        self.handle.close();
        if let Some(thread) = self.thread.take()
            && thread.join().is_err()
        {
            tracing::warn!("the thread that handles signals has failed");
        }
    }
}

/// Notes signals until it is dropped. A second one ends the program at once.
#[derive(Debug)]
pub struct InterruptionWatch {
    is_requested: Arc<AtomicBool>,
    _thread: SignalThread,
}

impl InterruptionWatch {
    /// Begins to note signals.
    ///
    /// # Errors
    /// Signals cannot be watched.
    pub fn start() -> Result<Self, Exit> {
        let is_requested = Arc::new(AtomicBool::new(false));
        let seen = Arc::clone(&is_requested);
        let thread = SignalThread::start(move |signal| {
            if !seen.swap(true, Ordering::Relaxed) {
                notice("stopping once this step of the preparation is done (press Ctrl-C again to kill)");
            } else if let Err(error) = emulate_default_handler(signal) {
                tracing::warn!(%error, "the signal {signal} is ignored");
            }
        })?;
        Ok(Self {
            is_requested,
            _thread: thread,
        })
    }

    /// `result`, or [`Exit::Interrupted`] after a signal: a tool that gets Ctrl-C as well fails because of that.
    ///
    /// # Errors
    /// Those of `result`, or there was a signal.
    pub fn outcome<T>(&self, result: Result<T, Exit>) -> Result<T, Exit> {
        match self.is_requested.load(Ordering::Relaxed) {
            true => Err(Exit::Interrupted),
            false => result,
        }
    }

    /// Stops. True if there was a signal: whoever watches from now on has not seen it.
    #[must_use]
    pub fn finish(self) -> bool {
        self.is_requested.load(Ordering::Relaxed)
    }
}

/// From now on a signal removes all that is in `directory`, which was empty, and ends the program; the directory itself stays if it
/// `was_there`. Drop the returned value when the directory is complete.
///
/// # Errors
/// Signals cannot be watched.
pub fn remove_when_interrupted(directory: &Path, was_there: bool) -> Result<SignalThread, Exit> {
    let directory = directory.to_owned();
    SignalThread::start(move |_| {
        let removed = (0..REMOVALS).any(|attempt| {
            if attempt > 0 {
                std::thread::park_timeout(PAUSE);
            }
            let entries = std::fs::read_dir(&directory).into_iter().flatten().flatten();
            // What cannot be removed now may be next time; at last the directory is not empty.
            entries.for_each(|entry| remove(&entry.path()));
            match was_there {
                true => std::fs::read_dir(&directory).is_ok_and(|mut entries| entries.next().is_none()),
                false => std::fs::remove_dir(&directory).is_ok(),
            }
        });
        let what = match removed {
            true => "what was made is removed",
            false => "some of what was made is left",
        };
        notice(&format!("interrupted: {what} ({})", directory.display()));
        std::process::exit(INTERRUPTED.into());
    })
}

fn remove(path: &Path) {
    let removed = match path.is_dir() {
        true => std::fs::remove_dir_all(path),
        false => std::fs::remove_file(path),
    };
    if let Err(error) = removed {
        tracing::debug!(%error, path = %path.display(), "cannot remove");
    }
}
