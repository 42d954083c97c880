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
    SCHEMA_VERSION,
    header::MessageHeader,
    membership::RunMembership,
    ports::Message,
    process::Process,
    reserve::{self, ReserveError},
    run::RunFile,
    services::{self, Channel, ServiceHolder},
};

/// Environment variable of the process that has a `/dev/shm` of its own.
const ALONE: &str = "CARAWARE_TEST_ALONE";

/// A run whose `name` is that of no other test in this process.
fn run_in(directory: &Path, name: &str) -> RunFile {
    let mut config = common::town();
    config.traffic.max_road_users = 64;
    common::run_in(directory, name, config)
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

/// Creates a run's services, a publisher and a subscriber, with `disturb` in between, and sends as many messages as can be in use at a
/// time, each written from end to end.
fn publish(run: &RunFile, disturb: impl Fn()) {
    let node = services::node(&run.shared_memory).unwrap();
    let _services = ServiceHolder::create(&node, run, 0).unwrap();
    let join = |process| RunMembership::join_with(run.clone(), process, 0, Arc::new(AtomicBool::new(false))).unwrap();
    let producer = join(Process::SimCore);
    let mut consumers = [Process::SensorDaemon, Process::Fanout].map(join);
    disturb();
    let channel = Channel::World;
    let allocated = || allocated_bytes(&files(run, ".data"));
    let before = allocated();
    let publisher = producer.publisher(channel).unwrap();
    let subscribers = consumers.each_mut().map(|process| process.subscriber(channel).unwrap());
    let (length, most) = (channel.max_payload(run) as u64, channel.worst_case_messages(run) as u64);
    let at_first = allocated() - before;
    assert!(
        (length..most * length / 2).contains(&at_first),
        "{at_first} bytes are allocated before any message is sent"
    );
    // The first subscriber holds the first half of the messages, and the second one, which keeps up until then, the other half.
    let (in_hand, queued) = ((channel.spec().in_hand)(run), channel.queue_length(run));
    let mut held = Vec::new();
    for message in 0..2 * (in_hand + queued) {
        let header = MessageHeader {
            schema_version: SCHEMA_VERSION,
            run_id: run.run_id,
            ..MessageHeader::default()
        };
        let mut draft = publisher.loan(header, channel.max_payload(run)).unwrap();
        draft.payload_mut().fill(byte_of(message));
        assert!(draft.send().unwrap() > 0);
        let half = message / (in_hand + queued);
        if message % (in_hand + queued) < in_hand {
            held.push((message, subscribers[half].receive().unwrap().unwrap()));
        }
        if half == 0 {
            subscribers[1].receive().unwrap().unwrap();
        }
    }
    let reserve = allocated_bytes(&files(run, "reserve"));
    assert!(
        reserve + allocated() <= reserve::needed_bytes(run),
        "{reserve} bytes are left in the reserve"
    );
    let check = |(message, received): (usize, Message)| {
        assert!(
            received.payload().iter().all(|&byte| byte == byte_of(message)),
            "message {message} was overwritten"
        );
    };
    held.into_iter().for_each(check);
    for (half, subscriber) in subscribers.iter().enumerate() {
        let first = half * (in_hand + queued) + in_hand;
        (first..first + queued).for_each(|message| check((message, subscriber.receive().unwrap().unwrap())));
    }
}

fn byte_of(message: usize) -> u8 {
    u8::try_from(message % 255).unwrap()
}

fn remove(run: &RunFile) {
    files(run, "")
        .iter()
        .for_each(|path| std::fs::remove_file(path).unwrap());
}

#[test]
fn a_publishers_messages_are_allocated_before_they_are_used() {
    let directory = tempfile::tempdir().unwrap();
    let run = run_in(directory.path(), "reserve");
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

#[test]
fn a_run_without_fanout_reserves_no_messages_for_it() {
    let directory = tempfile::tempdir().unwrap();
    let with_fanout = run_in(directory.path(), "unwatched");
    let mut run = with_fanout.clone();
    run.config.fanout.enabled = false;
    assert!(reserve::needed_bytes(&run) < reserve::needed_bytes(&with_fanout) * 3 / 4);
    reserve::create(&run).unwrap();
    let node = services::node(&run.shared_memory).unwrap();
    let _services = ServiceHolder::create(&node, &run, 0).unwrap();
    let bridge = RunMembership::join_with(run.clone(), Process::TrafficBridge, 0, Arc::default()).unwrap();
    let reserved = || allocated_bytes(&files(&run, "reserve"));
    let before = reserved();
    let _census = bridge.publisher(Channel::Census).unwrap();
    assert_eq!(reserved(), before, "no message of this channel is ever sent");
    let _traffic = bridge.publisher(Channel::Traffic).unwrap();
    assert!(reserved() < before);
    remove(&run);
}

/// Runs in the process that the test below starts; without the environment variable it does nothing.
#[test]
fn a_process_with_its_own_memory() {
    let Some(mode) = std::env::var_os(ALONE) else {
        return;
    };
    let directory = tempfile::tempdir().unwrap();
    let run = run_in(directory.path(), "reserve");
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
