//! Services, ports and boards in real shared memory.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

mod common;

use std::{
    path::Path,
    sync::{Arc, atomic::AtomicBool},
    time::{Duration, Instant},
};

use ipc_schema::{
    board::State,
    config::{Config, RecordManner},
    header::MessageHeader,
    membership::{MembershipError, RunMembership},
    ports::PortError,
    process::Process,
    run::RunFile,
    services::{self, Channel, RunNode, ServiceHolder},
};

/// The default preset, with small queues.
fn config() -> Config {
    let mut config = common::town();
    config.run.window_ticks = 4;
    config.run.sub_steps = 2;
    config.traffic.max_road_users = 8;
    config
}

/// A run with its own part of shared memory, which is removed at the end.
struct Corner {
    run: RunFile,
    _services: ServiceHolder,
    _node: RunNode,
    _directory: tempfile::TempDir,
}

impl Drop for Corner {
    fn drop(&mut self) {
        // The supervisor does the same: iceoryx2 leaves one small file behind for each part of shared memory.
        for entry in std::fs::read_dir("/dev/shm").unwrap().flatten() {
            if entry
                .file_name()
                .to_string_lossy()
                .starts_with(&self.run.shared_memory.prefix)
            {
                std::fs::remove_file(entry.path()).unwrap();
            }
        }
    }
}

impl Corner {
    fn new(run_id: u64) -> Self {
        let directory = tempfile::tempdir().unwrap();
        let run = RunFile {
            run_id,
            ..common::run_in(directory.path(), &format!("test{run_id}_"), config())
        };
        let node = services::node(&run.shared_memory).unwrap();
        let services = ServiceHolder::create(&node, &run, 0).unwrap();
        Self {
            run,
            _services: services,
            _node: node,
            _directory: directory,
        }
    }

    fn join(&self, process: Process) -> RunMembership {
        RunMembership::join_with(self.run.clone(), process, 0, Arc::new(AtomicBool::new(false))).unwrap()
    }
}

fn tick(membership: &RunMembership, tick: u64) -> MessageHeader {
    MessageHeader {
        tick,
        shape: [1, 0, 0, 0],
        ..membership.header()
    }
}

#[test]
fn a_message_arrives_unchanged_and_aligned_in_the_same_memory() {
    let corner = Corner::new(1);
    let (producer, mut consumer) = (corner.join(Process::SimCore), corner.join(Process::SensorDaemon));
    let publisher = producer.publisher(Channel::World).unwrap();
    let subscriber = consumer.subscriber(Channel::World).unwrap();
    let mut draft = publisher.loan(tick(&producer, 7), 100).unwrap();
    assert!(draft.payload().iter().all(|byte| *byte == 0), "a loan is zeroed");
    draft.payload_mut().fill(9);
    assert_eq!(draft.send().unwrap(), 1);
    let message = consumer.next(&subscriber).unwrap().unwrap();
    assert_eq!((message.header().tick, message.payload()), (7, [9_u8; 100].as_slice()));
    assert_eq!(message.payload().as_ptr().addr() % 64, 0);
    assert!(subscriber.receive().unwrap().is_none());
}

/// `fanout` holds what is in a queue until world, observation and prediction of one tick have met.
#[test]
fn a_watcher_may_hold_a_whole_queue_of_what_belongs_to_a_tick() {
    let directory = tempfile::tempdir().unwrap();
    let mut run = common::run_in(directory.path(), "test", config());
    for manner in [RecordManner::Watching, RecordManner::Lossless] {
        run.config.record.manner = manner;
        for channel in [Channel::World, Channel::Observation, Channel::Prediction] {
            let spec = channel.spec();
            assert!(
                (spec.in_hand)(&run) >= (spec.queue_length)(&run),
                "{manner:?} {}",
                spec.name
            );
        }
    }
}

#[test]
fn a_producer_waits_for_credit_and_a_full_watcher_only_misses_messages() {
    let corner = Corner::new(2);
    let (producer, mut consumer, mut watcher) = (
        corner.join(Process::SimCore),
        corner.join(Process::SensorDaemon),
        corner.join(Process::Fanout),
    );
    let publisher = producer.publisher(Channel::World).unwrap();
    let board = producer.board_of(Process::SensorDaemon).unwrap();
    let subscriber = consumer.subscriber(Channel::World).unwrap();
    let idle = watcher.subscriber(Channel::World).unwrap();
    let credit = |tick| ipc_schema::flow::has_credit(tick, &board.progress(), corner.run.window_ticks());
    assert!(!credit(0), "not attached yet");
    consumer.attach();
    for number in 0..20 {
        assert!(credit(number) && !credit(number + 4));
        publisher.loan(tick(&producer, number), 8).unwrap().send().unwrap();
        assert_eq!(subscriber.receive().unwrap().unwrap().header().tick, number);
        consumer.consumed(number + 1);
    }
    // The watcher never read: its queue holds window + 2 messages, the rest it missed.
    let seen = std::iter::from_fn(|| idle.receive().unwrap())
        .map(|message| message.header().tick)
        .collect::<Vec<_>>();
    assert_eq!(seen, (0..6).collect::<Vec<_>>());
    assert_eq!(publisher.drops(), 14);
}

#[test]
fn a_tick_is_due_once_every_required_consumer_has_credit_for_it() {
    let corner = Corner::new(12);
    let producer = corner.join(Process::SimCore);
    let [mut first, mut second] = [Process::SensorDaemon, Process::Fanout].map(|process| corner.join(process));
    let consumers = producer
        .consumers([Process::SensorDaemon, Process::Fanout], Channel::World)
        .unwrap();
    let window = corner.run.window_ticks();
    first.attach();
    assert!(!consumers.have_credit(0), "the second is not attached");
    second.attach();
    assert!(consumers.have_credit(window - 1) && !consumers.have_credit(window));
    first.consumed(5);
    assert!(!consumers.have_credit(window), "the second has consumed nothing");
    second.consumed(1);
    assert!(consumers.have_credit(window) && !consumers.have_credit(window + 1));
    assert!(consumers.have_consumed(1) && !consumers.have_consumed(2));
    consumers.wake();
    for woken in [&first, &second] {
        let before = Instant::now();
        woken.wait(Duration::from_secs(60)).unwrap();
        assert!(before.elapsed().as_secs() < 60, "it was woken");
    }
}

#[test]
fn a_message_to_an_earlier_incarnation_is_refused() {
    let corner = Corner::new(13);
    let (producer, mut consumer) = (corner.join(Process::SensorDaemon), corner.join(Process::Trainer));
    let publisher = producer.publisher(Channel::Observation).unwrap();
    let subscriber = consumer.subscriber(Channel::Observation).unwrap();
    for (number, addressee) in [(0, 1), (1, 0), (2, 1)] {
        let header = MessageHeader {
            addressee,
            ..tick(&producer, number)
        };
        publisher.loan(header, 8).unwrap().send().unwrap();
    }
    let ticks: Vec<u64> = std::iter::from_fn(|| subscriber.receive().unwrap())
        .map(|message| message.header().tick)
        .collect();
    assert_eq!((ticks, subscriber.refused()), (vec![0, 2], 1));
}

#[test]
fn a_message_of_another_run_or_version_is_refused() {
    let corner = Corner::new(3);
    let (producer, mut consumer) = (corner.join(Process::SimCore), corner.join(Process::SensorDaemon));
    let publisher = producer.publisher(Channel::World).unwrap();
    let subscriber = consumer.subscriber(Channel::World).unwrap();
    publisher
        .loan(
            MessageHeader {
                run_id: 99,
                ..tick(&producer, 0)
            },
            8,
        )
        .unwrap()
        .send()
        .unwrap();
    publisher.loan(tick(&producer, 1), 8).unwrap().send().unwrap();
    assert_eq!(subscriber.receive().unwrap().unwrap().header().tick, 1);
    assert_eq!(subscriber.refused(), 1);
    publisher
        .loan(
            MessageHeader {
                schema_version: 99,
                ..tick(&producer, 2)
            },
            8,
        )
        .unwrap()
        .send()
        .unwrap();
    assert!(matches!(
        subscriber.receive(),
        Err(PortError::Version { found: 99, .. })
    ));
}

#[test]
fn a_message_that_is_too_long_names_the_setting() {
    let corner = Corner::new(4);
    let producer = corner.join(Process::TrafficBridge);
    let publisher = producer.publisher(Channel::Traffic).unwrap();
    let error = publisher.loan(producer.header(), 9 * 64).unwrap_err();
    assert!(
        error.to_string().contains("raise `traffic.max_road_users` (now 8)"),
        "{error}"
    );
}

#[test]
fn a_board_outlives_its_writer_and_a_wake_up_is_not_lost() {
    let corner = Corner::new(5);
    let mut writer = corner.join(Process::Trainer);
    let reader = corner.join(Process::SensorDaemon);
    let board = reader.board_of(Process::Trainer).unwrap();
    let waker = reader.waker(Process::Trainer).unwrap();
    waker.wake();
    // A wake-up sent before the wait ends it at once; without one the wait ends at its timeout.
    writer.wait(Duration::from_secs(60)).unwrap();
    writer.wait(Duration::from_millis(1)).unwrap();
    writer.attach();
    writer.committed(5);
    drop(writer);
    assert_eq!(
        (board.progress().committed_ticks, board.health().state),
        (5, State::Ready as u32)
    );
    // A successor can take the place.
    corner.join(Process::Trainer);
}

/// The socket of a wake-up takes zero microseconds as a wait without end.
#[test]
fn a_wait_of_less_than_a_microsecond_ends() {
    let run = Corner::new(11);
    let membership = run.join(Process::Trainer);
    let begin = Instant::now();
    for nanoseconds in [0, 1, 999, 1_001] {
        membership.wait(Duration::from_nanos(nanoseconds)).unwrap();
    }
    assert!(begin.elapsed() < Duration::from_secs(5));
}

#[test]
fn a_process_without_its_supervisor_does_not_start() {
    let corner = Corner::new(6);
    let run = RunFile {
        supervisor_pid: 1_000_000_000,
        ..corner.run.clone()
    };
    let result = RunMembership::join_with(run, Process::SimCore, 0, Arc::new(AtomicBool::new(false)));
    assert!(matches!(result, Err(MembershipError::Orphaned { .. })));
}

#[test]
fn a_process_from_outside_needs_a_living_supervisor_that_is_not_its_parent() {
    let corner = Corner::new(61);
    let joined = |supervisor_pid: i32| {
        let run = RunFile {
            supervisor_pid,
            ..corner.run.clone()
        };
        RunMembership::join_from_outside(run, Process::Trainer, 0, Arc::new(AtomicBool::new(false)))
    };
    assert!(matches!(joined(1_000_000_000), Err(MembershipError::Orphaned { .. })));
    let mut supervisor = std::process::Command::new("sleep").arg("60").spawn().unwrap();
    let mut membership = joined(supervisor.id().try_into().unwrap()).unwrap();
    membership.attach();
    assert!(membership.supervisor_lives());
    supervisor.kill().unwrap();
    supervisor.wait().unwrap();
    assert!(!membership.supervisor_lives());
}

#[test]
fn a_run_file_of_another_version_is_refused() {
    let corner = Corner::new(7);
    RunFile {
        schema_version: 99,
        env_index: 0,
        ..corner.run.clone()
    }
    .write()
    .unwrap();
    let error = RunFile::read(&corner.run.run_dir.join("run.json")).unwrap_err();
    assert!(error.to_string().contains("schema version 99"), "{error}");
    assert!(
        RunFile::read(Path::new("nowhere/run.json"))
            .unwrap_err()
            .to_string()
            .contains("nowhere/run.json")
    );
}
