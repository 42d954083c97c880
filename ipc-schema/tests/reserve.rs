//! Shared memory that other programs fill: what a run has reserved stays its own.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]

mod common;

use std::{
    os::unix::fs::MetadataExt as _,
    path::{Path, PathBuf},
    process::Command,
    sync::{Arc, atomic::AtomicBool},
};

use ipc_schema::{
    header::MessageHeader,
    membership::RunMembership,
    process::Process,
    reserve::{self, ReserveError},
    run::RunFile,
    services::{self, Channel, ServiceHolder},
};

/// Environment variable of the process that has a `/dev/shm` of its own.
const ALONE: &str = "CARAWARE_TEST_ALONE";

fn run_in(directory: &Path) -> RunFile {
    let mut config = common::town();
    config.traffic.max_road_users = 64;
    common::run_in(directory, "reserve", config)
}

/// Files of the run in shared memory that end with `end`.
fn files(run: &RunFile, end: &str) -> Vec<PathBuf> {
    let paths = std::fs::read_dir(reserve::SHARED_MEMORY).unwrap().flatten();
    let is_ours = |path: &PathBuf| {
        let name = path.file_name().unwrap().to_string_lossy().into_owned();
        name.starts_with(&run.shared_memory.prefix) && name.ends_with(end)
    };
    paths.map(|entry| entry.path()).filter(is_ours).collect()
}

fn allocated_bytes(paths: &[PathBuf]) -> u64 {
    paths.iter().map(|path| path.metadata().unwrap().blocks() * 512).sum()
}

/// Creates a run's services and a publisher, with `disturb` in between, and sends as many messages as can be in use at a time.
fn publish(run: &RunFile, disturb: impl Fn()) {
    let node = services::node(&run.shared_memory).unwrap();
    let _services = ServiceHolder::create(&node, run, 0).unwrap();
    let stop = Arc::new(AtomicBool::new(false));
    let producer = RunMembership::join_with(run.clone(), Process::SimCore, 0, stop).unwrap();
    disturb();
    let publisher = producer.publisher(Channel::World).unwrap();
    let (segments, reserve) = (files(run, ".data"), files(run, "reserve"));
    let messages = Channel::World.worst_case_messages(run) as u64 * Channel::World.max_payload(run) as u64;
    assert!(
        allocated_bytes(&segments) >= messages,
        "{} of {messages}",
        allocated_bytes(&segments)
    );
    assert!(allocated_bytes(&reserve) + messages <= reserve::needed_bytes(run));
    // Two messages may be on loan at a time; both are written from end to end.
    let length = Channel::World.max_payload(run);
    let drafts = [(); 2].map(|()| publisher.loan(MessageHeader::default(), length).unwrap());
    for draft in drafts {
        assert_eq!(draft.send().unwrap(), 0, "no process has subscribed");
    }
}

fn remove(run: &RunFile) {
    files(run, "")
        .iter()
        .for_each(|path| std::fs::remove_file(path).unwrap());
}

#[test]
fn a_publishers_messages_are_allocated_before_the_first_is_sent() {
    let directory = tempfile::tempdir().unwrap();
    let run = run_in(directory.path());
    reserve::create(&run).unwrap();
    assert_eq!(
        allocated_bytes(&files(&run, "reserve")),
        reserve::needed_bytes(&run).next_multiple_of(4096)
    );
    publish(&run, || {});
    // What ended publishers leave free is reserved again.
    reserve::refill(&run);
    assert!(allocated_bytes(&files(&run, "")) >= reserve::needed_bytes(&run));
    assert!(allocated_bytes(&files(&run, "")) <= reserve::needed_bytes(&run) + 4096);
    remove(&run);
}

/// Runs in the process that the test below starts; without the environment variable it does nothing.
#[test]
fn a_process_with_its_own_memory() {
    let Some(mode) = std::env::var_os(ALONE) else {
        return;
    };
    let directory = tempfile::tempdir().unwrap();
    let run = run_in(directory.path());
    if mode == "small" {
        let error = reserve::create(&run).unwrap_err();
        assert!(matches!(error, ReserveError::Full { .. }), "{error}");
        assert_eq!(
            error.to_string(),
            format!(
                "/dev/shm has 1 MiB free, but this run needs {} MiB",
                reserve::needed_bytes(&run).div_ceil(1 << 20)
            )
        );
        assert!(files(&run, "").is_empty());
        return;
    }
    let fill = || {
        let other = std::fs::File::create(format!("/dev/shm/other-{}", files(&run, "").len())).unwrap();
        rustix::fs::fallocate(&other, rustix::fs::FallocateFlags::empty(), 0, reserve::free_bytes()).unwrap();
        assert_eq!(reserve::free_bytes(), 0);
    };
    reserve::create(&run).unwrap();
    // The services are created in a full memory: iceoryx2's first write to each of their pages takes it from the reserve.
    fill();
    publish(&run, || {
        let (size, free) = (reserve::needed_bytes(&run), reserve::free_bytes());
        assert!(
            allocated_bytes(&files(&run, "reserve")) < size,
            "the services are {free} bytes of the free memory"
        );
        if free > 0 {
            fill();
        }
    });
}

#[test]
fn what_others_fill_ends_neither_the_creation_of_services_nor_of_publishers() {
    let program = std::env::current_exe().unwrap();
    for (mode, size) in [("small", "1m"), ("full", "96m")] {
        let mount =
            format!("mount -t tmpfs -o size={size} none /dev/shm && exec \"$0\" --exact a_process_with_its_own_memory");
        let user: &[&str] = if rustix::process::getuid().is_root() {
            &[]
        } else {
            &["--map-root-user"]
        };
        let output = Command::new("unshare")
            .args(user)
            .args(["--mount", "sh", "-c", &mount])
            .arg(&program)
            .env(ALONE, mode)
            .output()
            .unwrap();
        let said = format!(
            "{}{}",
            String::from_utf8_lossy(&output.stdout),
            String::from_utf8_lossy(&output.stderr)
        );
        if said.contains("unshare failed") || said.contains("Operation not permitted") {
            // This system gives no process its own mounts; the test above covers what can be seen without.
            return;
        }
        assert!(output.status.success(), "{mode}: {}\n{said}", output.status);
        assert!(said.contains("1 passed"), "{said}");
    }
}
