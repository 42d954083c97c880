//! A measurement runs in a process of its own. When a signal ends it, this one ends the programs that it had started and removes its files.

use std::{
    env,
    os::unix::process::ExitStatusExt as _,
    path::Path,
    process::{Child, Command, ExitCode, ExitStatus},
    time::{Duration, Instant},
};

use caraware::failure::Exit;
use rustix::process::{Pid, Signal, WaitOptions, getpid, kill_process, set_child_subreaper, wait};
use signal_hook::{
    consts::{SIGCHLD, SIGHUP, SIGINT, SIGTERM},
    iterator::Signals,
};

/// Set in the process that measures.
const MEASURES: &str = "CARAWARE_BENCH_MEASURES";
/// Time that programs have to end before they get SIGTERM: Ctrl-C in a terminal, and its end, have reached them as well.
const PATIENCE: Duration = Duration::from_secs(2);
/// Time after which they are killed. A run of thousands of vehicles ends in some seconds.
const DEADLINE: Duration = Duration::from_secs(60);
const POLL_INTERVAL: Duration = Duration::from_millis(20);

/// Starts this program again as the process that measures, and waits for its end. Returns `None` in that process, which continues.
pub fn measured_elsewhere() -> Option<ExitCode> {
    if env::var_os(MEASURES).is_some() {
        return None;
    }
    Some(watch().unwrap_or_else(Exit::report))
}

fn watch() -> Result<ExitCode, Exit> {
    let failed = |error: &std::io::Error| Exit::io("start", Path::new("the measurement"), error);
    let mut signals = Signals::new([SIGCHLD, SIGHUP, SIGINT, SIGTERM]).map_err(|error| failed(&error))?;
    // What the measurement leaves behind becomes a child of this process.
    set_child_subreaper(Some(getpid())).map_err(|error| failed(&error.into()))?;
    let program = env::current_exe().map_err(|error| failed(&error))?;
    let mut measurement = Command::new(program)
        .args(env::args_os().skip(1))
        .env(MEASURES, "1")
        .spawn()
        .map_err(|error| failed(&error))?;
    let ended = |measurement: &mut Child| measurement.try_wait().map_err(|error| failed(&error));
    let (number, status) = loop {
        let number = signals.wait().find(|number| *number != SIGCHLD);
        let status = ended(&mut measurement)?;
        if number.is_some() || status.is_some() {
            break (number, status);
        }
    };
    let number = number.or_else(|| status.and_then(|status: ExitStatus| status.signal()));
    let Some(number) = number else {
        let code = status.and_then(|status| status.code()).unwrap_or(1);
        return Ok(ExitCode::from(u8::try_from(code).unwrap_or(1)));
    };
    if status.is_none() {
        // It may have ended just now.
        let _ = measurement.kill();
        let _ = measurement.wait();
    }
    let reaches_all = number == SIGINT || number == SIGHUP;
    end_children(&mut signals, if reaches_all { PATIENCE } else { Duration::ZERO });
    remove_files(measurement.id());
    // As a shell reports a program that a signal has ended.
    Ok(ExitCode::from(u8::try_from(128 + number).unwrap_or(1)))
}

/// Waits until no program is left that the measurement had started. They end in order after `patience`, and at once after another signal.
fn end_children(signals: &mut Signals, patience: Duration) {
    let begun = Instant::now();
    let mut asked = Vec::new();
    // An error says that there is no child any more.
    while let Ok(ended) = wait(WaitOptions::NOHANG) {
        if ended.is_some() {
            continue;
        }
        let is_impatient = signals.pending().any(|number| number != SIGCHLD) || begun.elapsed() > DEADLINE;
        for child in children() {
            if is_impatient {
                send(child, Signal::KILL);
            } else if begun.elapsed() >= patience && !asked.contains(&child) {
                asked.push(child);
                send(child, Signal::TERM);
                // One that the measurement has stopped ends as well.
                send(child, Signal::CONT);
            }
        }
        std::thread::park_timeout(POLL_INTERVAL);
    }
}

fn send(child: Pid, signal: Signal) {
    // It may have ended just now.
    let _ = kill_process(child, signal);
}

/// The children of this process.
fn children() -> Vec<Pid> {
    let pid = getpid().as_raw_nonzero();
    let text = std::fs::read_to_string(format!("/proc/{pid}/task/{pid}/children")).unwrap_or_default();
    text.split_whitespace()
        .filter_map(|word| Pid::from_raw(word.parse().ok()?))
        .collect()
}

/// Removes the temporary files and directories of a measurement. Their names end with its process id.
fn remove_files(pid: u32) {
    let ends = [format!("-{pid}"), format!("-{pid}.json")];
    for entry in std::fs::read_dir(env::temp_dir()).into_iter().flatten().flatten() {
        let name = entry.file_name().to_string_lossy().into_owned();
        if name.starts_with("caraware-bench-") && ends.iter().any(|end| name.ends_with(end)) {
            let path = entry.path();
            if let Err(error) = std::fs::remove_file(&path).or_else(|_| std::fs::remove_dir_all(&path)) {
                tracing::warn!(%error, path = %path.display(), "cannot be removed");
            }
        }
    }
}
