//! A killed process leaves nothing that prevents the start of its successor.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]

mod common;

use std::{
    fs::File,
    os::unix::process::ExitStatusExt as _,
    path::{Path, PathBuf},
    process::{Child, Command},
    sync::{Arc, atomic::AtomicBool, mpsc::channel},
    time::{Duration, Instant},
};

use ipc_schema::{
    board::State,
    header::MessageHeader,
    membership::{INCARNATION, RunMembership},
    ports::{BoardReader, RosterWriter},
    process::Process,
    reserve,
    run::RunFile,
    services::{self, Channel, ServiceHolder},
};
use rustix::process::{Resource, Rlimit, setrlimit};

/// Environment variable with the path of the run file; set for the process that the test kills.
const VICTIM: &str = "CARAWARE_TEST_VICTIM";

/// The process that the test below kills; without the environment variable it does nothing.
#[test]
fn the_victim() {
    let Some(run_file) = std::env::var_os(VICTIM) else {
        return;
    };
    let run = RunFile::read(Path::new(&run_file)).unwrap();
    let mut membership = RunMembership::join_with(run, Process::Trainer, 0, Arc::new(AtomicBool::new(false))).unwrap();
    let observations = membership.subscriber(Channel::Observation).unwrap();
    let predictions = membership.publisher(Channel::Prediction).unwrap();
    membership.attach_from(7);
    let message = membership.next(&observations).unwrap().unwrap();
    let header = MessageHeader {
        tick: message.header().tick,
        ..membership.header()
    };
    predictions.loan(header, 8).unwrap().send().unwrap();
    membership.consumed(header.tick + 1);
    loop {
        membership.wait(Duration::from_secs(1)).unwrap();
    }
}

/// A process that the kernel kills as soon as it gives a file a size; without the environment variable it does nothing.
#[test]
fn the_victim_of_its_first_file() {
    let Some(run_file) = std::env::var_os(VICTIM) else {
        return;
    };
    let run = RunFile::read(Path::new(&run_file)).unwrap();
    let mut membership = RunMembership::join_with(run, Process::Trainer, 0, Arc::new(AtomicBool::new(false))).unwrap();
    let none = Rlimit {
        current: Some(0),
        maximum: Some(0),
    };
    setrlimit(Resource::Fsize, none).unwrap();
    drop(membership.subscriber(Channel::Observation));
}

fn start_victim(run_file: &Path, incarnation: u32) -> Child {
    start_as("the_victim", run_file, incarnation)
}

fn start_as(test: &str, run_file: &Path, incarnation: u32) -> Child {
    Command::new(std::env::current_exe().unwrap())
        .args(["--exact", test, "--nocapture"])
        .env(VICTIM, run_file)
        .env(INCARNATION, incarnation.to_string())
        .spawn()
        .unwrap()
}

fn eventually(what: &str, condition: impl Fn() -> bool) {
    let deadline = Instant::now() + Duration::from_secs(30);
    while !condition() {
        assert!(Instant::now() < deadline, "{what}: not within half a minute");
        std::thread::park_timeout(Duration::from_millis(1));
    }
}

#[test]
fn a_killed_trainer_is_replaced_again_and_again() {
    let directory = tempfile::tempdir().unwrap();
    let mut config = common::town();
    config.traffic.max_road_users = 8;
    let run = RunFile {
        supervisor_pid: std::process::id().try_into().unwrap(),
        ..common::run_in(directory.path(), "killed", config)
    };
    let run_file = run.write().unwrap();
    let node = services::node(&run.shared_memory).unwrap();
    let mut holder = ServiceHolder::create(&node, &run, 0).unwrap();
    let mut roster = RosterWriter::create(&holder).unwrap();
    let board = BoardReader::open(&node, &run, 0, Process::Trainer).unwrap();
    let mut in_process = run.clone();
    in_process.supervisor_pid = rustix::process::getppid().unwrap().as_raw_nonzero().get();
    let mut sensing =
        RunMembership::join_with(in_process, Process::SensorDaemon, 0, Arc::new(AtomicBool::new(false))).unwrap();
    let observations = sensing.publisher(Channel::Observation).unwrap();
    let predictions = sensing.subscriber(Channel::Prediction).unwrap();
    let waker = sensing.waker(Process::Trainer).unwrap();
    for incarnation in 0..=300 {
        if incarnation > 0 {
            holder.add_board(&node, &run, Process::Trainer, incarnation).unwrap();
        }
        roster.set(Process::Trainer, incarnation);
        // Most die before they have joined: their number has no limit.
        if (12..300).contains(&incarnation) {
            continue;
        }
        assert_eq!(
            (board.progress().attached, board.health().state),
            (0, State::Starting as u32)
        );
        let mut victim = start_victim(&run_file, incarnation);
        eventually("attached", || board.progress().attached == 1);
        assert_eq!(
            (board.progress().incarnation, board.progress().committed_ticks),
            (incarnation, 7)
        );
        let header = MessageHeader {
            tick: 7,
            addressee: incarnation,
            ..sensing.header()
        };
        observations.loan(header, 8).unwrap().send().unwrap();
        waker.wake();
        eventually("consumed", || board.progress().consumed_ticks == 8);
        let answer = predictions.receive().unwrap().unwrap();
        assert_eq!((answer.header().incarnation, answer.header().tick), (incarnation, 7));
        victim.kill().unwrap();
        victim.wait().unwrap();
        assert_eq!(board.progress().consumed_ticks, 8, "a board outlives its writer");
        services::forget_dead(&node);
    }
    drop((observations, predictions, waker, sensing, board, roster, holder, node));
    for path in files(&run) {
        std::fs::remove_file(path).unwrap();
    }
}

/// Files of the run in shared memory.
fn files(run: &RunFile) -> Vec<PathBuf> {
    let entries = std::fs::read_dir("/dev/shm").unwrap().flatten();
    let ours = entries.filter(|entry| {
        entry
            .file_name()
            .to_string_lossy()
            .starts_with(&run.shared_memory.prefix)
    });
    ours.map(|entry| entry.path()).collect()
}

/// Files that have no size yet.
fn unfinished(run: &RunFile) -> Vec<PathBuf> {
    let is_empty = |path: &PathBuf| path.metadata().is_ok_and(|data| data.len() == 0);
    files(run).into_iter().filter(is_empty).collect()
}

#[test]
fn a_file_without_a_size_is_removed_if_its_creator_is_dead() {
    let directory = tempfile::tempdir().unwrap();
    let run = RunFile {
        supervisor_pid: std::process::id().try_into().unwrap(),
        ..common::run_in(directory.path(), "unfinished", common::town())
    };
    let run_file = run.write().unwrap();
    let node = services::node(&run.shared_memory).unwrap();
    let holder = ServiceHolder::create(&node, &run, 0).unwrap();
    let roster = RosterWriter::create(&holder).unwrap();
    let mut in_process = run.clone();
    in_process.supervisor_pid = rustix::process::getppid().unwrap().as_raw_nonzero().get();
    let sensing =
        RunMembership::join_with(in_process, Process::SensorDaemon, 0, Arc::new(AtomicBool::new(false))).unwrap();
    // The victim connects itself with it.
    let observations = sensing.publisher(Channel::Observation).unwrap();
    let status = start_as("the_victim_of_its_first_file", &run_file, 0).wait().unwrap();
    assert_eq!(status.signal(), Some(signal_hook::consts::SIGXFSZ), "{status}");
    let left = unfinished(&run);
    assert!(
        left.len() == 1 && left[0].extension().is_some_and(|kind| kind == "connection"),
        "{left:?}"
    );
    // A process that lives and has it open may still finish it.
    let open = File::open(&left[0]).unwrap();
    services::remove_unfinished(&run.shared_memory);
    assert_eq!(unfinished(&run), left);
    drop(open);
    let (sender, forgotten) = channel();
    let forgetful = Arc::clone(&node);
    std::thread::spawn(move || {
        services::forget_dead(&forgetful);
        sender.send(()).unwrap();
    });
    forgotten
        .recv_timeout(Duration::from_secs(30))
        .expect("it waits for ever");
    assert!(unfinished(&run).is_empty());
    drop((observations, sensing, roster, holder, node));
    for path in files(&run) {
        std::fs::remove_file(path).unwrap();
    }
}

#[test]
fn the_reserve_of_a_run_that_is_removed_is_freed_though_it_is_open() {
    let directory = tempfile::tempdir().unwrap();
    let run = common::run_in(directory.path(), "reserve", common::town());
    reserve::create(&run).unwrap();
    let [path] = &files(&run)[..] else { panic!("one file") };
    let held = File::open(path).unwrap();
    assert!(held.metadata().unwrap().len() > 0);
    services::remove_files(&run.shared_memory);
    assert_eq!(held.metadata().unwrap().len(), 0);
}
