//! Whole runs that are recorded: nothing is missing, a kill loses at most a chunk, and learning from a recording is learning from the run.

use std::{
    fs::File,
    os::fd::AsRawFd as _,
    path::{Path, PathBuf},
    process::{Child, Stdio},
};

use crate::common::{ACTING, Spectator, Workplace, assert_documented, free_port, lines_of, text, until, with_mounts};
use ipc_schema::{activity::Awaited, channel::Channel, process::Process};
use recorder::file::{reader::RecordingReader, writer::LineTopic};
use rustix::process::{Pid, Signal, kill_process};

/// A short training run of six vehicles with small networks, without viewers.
const SHORT: [&str; 13] = [
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=150",
    "episode.training_episodes=4",
    "episode.evaluation_interval=2",
    "episode.evaluation_ticks=40",
    "episode.final_evaluations=2",
    "trainer.horizon=900",
    "trainer.plots=false",
    "trainer.batch_size=300",
    "trainer.hidden=[32, 32]",
    "fanout.enabled=false",
];

fn command<'a>(mode: &'a str, name: &'a str, settings: &[&'a str], more: &[&'a str]) -> Vec<&'a str> {
    let set = SHORT.iter().chain(settings).flat_map(|setting| ["--set", *setting]);
    let head = [mode, "town", "--name", name].into_iter();
    head.chain(set).chain(more.iter().copied()).collect()
}

fn run_dir(workplace: &Workplace, name: &str) -> PathBuf {
    workplace.path().join("runs").join(name)
}

/// Hash of every tensor of the newest checkpoint: parameters, optimiser, generators.
fn learnt(run: &Path) -> String {
    let checkpoints = run.join("checkpoints");
    let newest = std::fs::read_to_string(checkpoints.join("latest")).unwrap();
    let mut hasher = blake3::Hasher::new();
    for name in ["parameters", "optimiser", "random"] {
        let file = checkpoints.join(newest.trim()).join(format!("{name}.safetensors"));
        hasher.update(&std::fs::read(file).unwrap());
    }
    format!("{} {}", newest.trim(), hasher.finalize().to_hex())
}

/// The run `again`, whose report this is, has lost nothing and learnt what the run `live` did.
fn assert_learnt_alike(workplace: &Workplace, again: &serde_json::Value) {
    assert_eq!(
        (&again["lost_ticks"], &again["duplicated_ticks"]),
        (&0.into(), &0.into())
    );
    assert_eq!(
        learnt(&run_dir(workplace, "again")),
        learnt(&run_dir(workplace, "live"))
    );
    workplace.assert_nothing_left();
}

/// The ticks of a channel in a recording, as far as it is readable.
fn ticks(recording: &RecordingReader, channel: Channel) -> Vec<u64> {
    let messages = recording.channel_messages().map_while(Result::ok);
    let of_channel = messages.filter(|message| message.channel == channel);
    of_channel.map(|message| message.header.tick).collect()
}

fn spawn(workplace: &Workplace, arguments: &[&str]) -> Child {
    let mut command = workplace.command(arguments);
    command.stdout(Stdio::null()).stderr(Stdio::piped());
    command.spawn().unwrap()
}

/// The first tick that a replay to viewers plays, and its simulated seconds per wall second.
const PLAYED_FROM: u64 = 200;
const PLAYED_SPEED: f64 = 20.0;

/// Plays the recording of the run `live` to a viewer from [`PLAYED_FROM`] on, compares some messages, and returns the report.
fn play_to_viewers(workplace: &Workplace, recording: &RecordingReader) -> serde_json::Value {
    let from_s = (PLAYED_FROM / 10).to_string();
    let speed = PLAYED_SPEED.to_string();
    let arguments = [
        "replay", "live", "--from-s", &from_s, "--speed", &speed, "--name", "seen",
    ];
    let port = format!("fanout.listen=tcp/127.0.0.1:{}", free_port());
    let mut replay = spawn(workplace, &[&arguments[..], &["--set", &port]].concat());
    let spectator = Spectator::join_after(
        &run_dir(workplace, "seen").join("run.json"),
        &mut replay,
        Process::SensorDaemon,
    );
    let world = spectator.subscribe(Channel::World);
    let mut seen = Vec::new();
    while seen.len() < 5 {
        let message = until(&mut replay, "a message", || world.receive().unwrap());
        seen.push((message.header().tick, message.payload().to_vec()));
    }
    assert!(seen.iter().all(|(tick, _)| *tick >= PLAYED_FROM));
    for message in recording.channel_messages().map_while(Result::ok) {
        let same = |(tick, _): &&(u64, Vec<u8>)| message.channel == Channel::World && *tick == message.header.tick;
        if let Some((tick, payload)) = seen.iter().find(same) {
            assert_eq!(message.payload(), payload, "tick {tick}");
        }
    }
    drop((world, spectator));
    let output = replay.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    workplace.report("seen")
}

#[test]
fn learning_from_a_lossless_recording_gives_the_parameters_of_the_run() {
    let workplace = Workplace::new();
    workplace.succeed(&command("train", "live", &["record.chunk_mib=1"], &["--record"]));
    let live = workplace.report("live");
    let recorded = &live["environments"][0]["recording"];
    assert_eq!(recorded["missed_ticks"], 0, "{recorded:#}");
    assert_eq!(recorded["observation_hash"], live["observation_hash"]);
    assert_eq!(recorded["messages"]["observation"], live["ticks"]);
    assert!(live["processes"]["recorder"].is_object());

    // Every tick of every channel with a message for each is there, once.
    let file = run_dir(&workplace, "live").join("recording.mcap");
    let recording = RecordingReader::open(&file).unwrap();
    assert!(recording.damage().is_none() && recording.chunk_count() > 2);
    let every: Vec<u64> = (0..live["ticks"].as_u64().unwrap()).collect();
    for channel in [Channel::World, Channel::Observation, Channel::Prediction] {
        assert_eq!(ticks(&recording, channel), every, "{}", channel.name());
    }
    assert!(!ticks(&recording, Channel::TrafficMeta).is_empty());
    for name in ["run.json", "config.toml", "layout.json"] {
        assert!(recording.attachment(name).is_some(), "{name}");
    }

    // A trainer learns from it what it learnt from the simulators.
    workplace.succeed(&["replay", "live", "--learn", "--name", "again"]);
    let again = workplace.report("again");
    assert_eq!(again["observation_hash"], live["observation_hash"]);
    assert_learnt_alike(&workplace, &again);
    for name in ["live", "again"] {
        assert_documented(&run_dir(&workplace, name));
    }

    // Viewers get what was recorded, from the time that they ask for, at the speed that they ask for.
    let played = play_to_viewers(&workplace, &recording);
    assert_eq!(played["first_tick"], PLAYED_FROM, "{played:#}");
    let ticks = every.len() as u64 - PLAYED_FROM;
    assert_eq!(played["ticks"], ticks, "{played:#}");
    // The last tick is due that long after the first.
    let least_s = (ticks - 1) as f64 * 0.1 / PLAYED_SPEED;
    assert!(played["wall_s"].as_f64().unwrap() >= least_s, "{least_s}: {played:#}");
    workplace.assert_nothing_left();

    // The same run again is the same recording; another seed is another from its first tick on.
    workplace.succeed(&command("train", "same", &[], &["--record"]));
    let equal = workplace.succeed(&["diff", "live", "same"]);
    assert!(text(&equal).contains("messages are equal"), "{}", text(&equal));
    let settings = [
        "run.seed=9",
        "record.channels=[\"observation\"]",
        "episode.training_episodes=1",
    ];
    workplace.succeed(&command("simulate", "other", &settings, &["--record"]));
    let other = workplace.run(&["diff", "live", "other"]);
    assert_eq!(other.status.code(), Some(1));
    assert!(text(&other).contains("tick 0 "), "{}", text(&other));
}

/// What stations knew is recorded with the observations, and a trainer gets both, also the successor of one that dies.
#[test]
fn learning_what_to_say_from_a_recording_gives_the_parameters_of_the_run() {
    let workplace = Workplace::new();
    let small = ["traffic.cavs=5", "trainer.hidden=[16]"].iter().chain(&ACTING);
    let settings = small.clone().flat_map(|setting| ["--set", *setting]);
    let train = ["train", "messages", "--name", "live", "--record"].into_iter();
    workplace.succeed(&train.chain(settings).collect::<Vec<_>>());
    let live = workplace.report("live");
    let file = run_dir(&workplace, "live").join("recording.mcap");
    let recording = RecordingReader::open(&file).unwrap();
    assert_eq!(
        ticks(&recording, Channel::Neighbours),
        ticks(&recording, Channel::Observation)
    );

    let arguments = ["replay", "live", "--learn", "--speed", "10", "--name", "again"];
    let mut replay = spawn(&workplace, &arguments);
    let spectator = Spectator::join_after(
        &run_dir(&workplace, "again").join("run.json"),
        &mut replay,
        Process::SensorDaemon,
    );
    let trainer = spectator.board(Process::Trainer);
    until(&mut replay, "ticks after a commit", || {
        let progress = trainer.progress();
        (progress.committed_ticks > 0 && progress.consumed_ticks > progress.committed_ticks + 5).then_some(())
    });
    kill_process(Pid::from_raw(trainer.health().pid).unwrap(), Signal::KILL).unwrap();
    drop((trainer, spectator));
    let output = replay.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let again = workplace.report("again");
    assert_eq!(
        (&again["observation_hash"], &again["restarts"]),
        (&live["observation_hash"], &1.into()),
        "{again:#}"
    );
    assert_learnt_alike(&workplace, &again);

    // Without what stations knew there is nothing to learn from.
    let settings = small.clone().flat_map(|setting| ["--set", *setting]);
    let bare = [
        "simulate",
        "messages",
        "--name",
        "bare",
        "--record",
        "--set",
        "record.channels=[\"observation\"]",
        "--set",
        "v2x.inclusion=standard",
    ];
    workplace.succeed(&bare.into_iter().chain(settings).collect::<Vec<_>>());
    let refused = workplace.run(&["replay", "bare", "--learn"]);
    assert_eq!(refused.status.code(), Some(2), "{}", text(&refused));
    assert!(text(&refused).contains("`neighbours`"), "{}", text(&refused));
}

/// Kills the recorder of a run once it has written a chunk, and returns the run's exit code and what it said.
fn kill_recorder(workplace: &Workplace, name: &str, on_death: &str) -> (Option<i32>, String) {
    let on_death = format!("record.on_death={on_death}");
    let settings = [on_death.as_str(), "record.chunk_mib=1", "episode.training_episodes=8"];
    let mut run = spawn(workplace, &command("simulate", name, &settings, &["--record"]));
    let directory = run_dir(workplace, name);
    let spectator = Spectator::join(&directory.join("run.json"), &mut run);
    let board = spectator.board(Process::Recorder);
    let file = directory.join("recording.mcap");
    until(&mut run, "a chunk with observations", || {
        let recording = RecordingReader::open(&file).ok()?;
        (!ticks(&recording, Channel::Observation).is_empty()).then_some(())
    });
    let pid = Pid::from_raw(board.health().pid).unwrap();
    kill_process(pid, Signal::KILL).unwrap();
    drop((board, spectator));
    let output = run.wait_with_output().unwrap();
    (output.status.code(), text(&output))
}

#[test]
fn a_killed_recorder_loses_a_chunk_at_most_and_the_run_continues_or_ends_as_configured() {
    let workplace = Workplace::new();
    let (code, said) = kill_recorder(&workplace, "goes-on", "continue");
    assert_eq!(code, Some(0), "{said}");
    let report = workplace.report("goes-on");
    assert_eq!(report["restarts"], 1);
    // The file of the killed recorder opens, without a gap up to where it ends.
    let directory = run_dir(&workplace, "goes-on");
    let first = RecordingReader::open(&directory.join("recording.mcap")).unwrap();
    assert!(first.damage().unwrap().reason.contains("was not finished"));
    let before = ticks(&first, Channel::Observation);
    assert!(!before.is_empty());
    assert_eq!(before, (0..before.len() as u64).collect::<Vec<_>>());
    // The next one has the rest of the run, again without a gap.
    let second = RecordingReader::open(&directory.join("recording-2.mcap")).unwrap();
    assert!(second.damage().is_none());
    let after = ticks(&second, Channel::Observation);
    let total = report["ticks"].as_u64().unwrap();
    assert_eq!(after, (after[0]..total).collect::<Vec<_>>());
    // What is lost is what one chunk holds, and what was on its way.
    let lost = after[0] - before.len() as u64;
    let per_tick = report["environments"][0]["recording"]["message_bytes"]
        .as_u64()
        .unwrap()
        / after.len() as u64;
    let window = 64;
    assert!(
        lost * per_tick < (1 << 20) + window * per_tick,
        "{lost} ticks of {per_tick} bytes"
    );

    let (code, said) = kill_recorder(&workplace, "ends", "end_run");
    assert_eq!(code, Some(1), "{said}");
    assert!(said.contains("recorder"), "{said}");
    let recording = RecordingReader::open(&run_dir(&workplace, "ends").join("recording.mcap")).unwrap();
    assert!(!ticks(&recording, Channel::Observation).is_empty());
    workplace.assert_nothing_left();
}

#[test]
fn a_simulator_that_dies_leaves_no_trace_in_the_recording() {
    let workplace = Workplace::new();
    // A paced run has the filter's estimates in its predictions, and another configuration.
    let estimates = "trainer.estimates=never";
    workplace.succeed(&command("train", "whole", &[estimates], &["--record"]));
    for (name, recorder_stands) in [("killed", false), ("behind", true)] {
        let paced = ["run.real_time_factor=60", estimates];
        let mut run = spawn(&workplace, &command("train", name, &paced, &["--record"]));
        let directory = run_dir(&workplace, name);
        let spectator = Spectator::join(&directory.join("run.json"), &mut run);
        let boards = [Process::SimCore, Process::Recorder].map(|process| spectator.board(process));
        // 0 until a process has reported.
        let pid_of = |board: usize| Pid::from_raw(boards[board].health().pid);
        until(&mut run, "the second episode", || {
            (boards[0].health().ticks > 200).then_some(())
        });
        let (simulator, recorder) = (pid_of(0).unwrap(), pid_of(1).unwrap());
        if recorder_stands {
            // Messages lie in its queues until it continues, and those that are made again come on top.
            kill_process(recorder, Signal::STOP).unwrap();
        }
        kill_process(simulator, Signal::KILL).unwrap();
        if recorder_stands {
            until(&mut run, "a simulator that waits for the recorder", || {
                let simulators = [Process::TrafficBridge, Process::SimCore, Process::SensorDaemon];
                let waits =
                    |process| spectator.board(process).activity().awaited() == Awaited::Credit(Process::Recorder);
                (pid_of(0).is_some_and(|pid| pid != simulator) && simulators.into_iter().any(waits)).then_some(())
            });
            kill_process(recorder, Signal::CONT).unwrap();
        }
        drop((boards, spectator));
        let output = run.wait_with_output().unwrap();
        assert!(output.status.success(), "{}", text(&output));
        assert_eq!(workplace.report(name)["restarts"], 1);
        let equal = workplace.run(&["diff", "whole", name]);
        assert!(equal.status.success(), "{name}: {}", text(&equal));
    }
}

#[test]
fn recorders_that_watch_do_not_change_a_run_and_count_what_they_miss() {
    let workplace = Workplace::new();
    let settings = ["run.real_time_factor=10"];
    let mut run = spawn(
        &workplace,
        &command("simulate", "watched", &settings, &["--record=watching"]),
    );
    let directory = run_dir(&workplace, "watched");
    let file = directory.join("recording.mcap");
    until(&mut run, "the recording", || file.exists().then_some(()));
    // It is refused while the simulation starts.
    let switch = ["control", "--run", "watched", "sensor", "all", "imu", "off"];
    until(&mut run, "the command", || {
        workplace.run(&switch).status.success().then_some(())
    });
    // A second recorder beside the run, of one channel.
    let beside = workplace.succeed(&[
        "record",
        "watched",
        "--channel",
        "observation",
        "--output",
        "beside.mcap",
    ]);
    assert!(text(&beside).contains("ticks missed"), "{}", text(&beside));
    let output = run.wait_with_output().unwrap();
    assert!(output.status.success(), "{}", text(&output));
    let report = workplace.report("watched");
    let recorded = &report["environments"][0]["recording"];
    for (path, missed) in [
        (file.clone(), recorded["missed_ticks"].as_u64().unwrap()),
        (workplace.path().join("beside.mcap"), u64::MAX),
    ] {
        let recording = RecordingReader::open(&path).unwrap();
        assert!(recording.damage().is_none());
        let found = ticks(&recording, Channel::Observation);
        let gaps = found.windows(2).map(|pair| pair[1] - pair[0] - 1).sum::<u64>();
        let counted = recording.end().unwrap().missed_ticks;
        assert!(
            gaps <= counted && (missed == u64::MAX || missed == counted),
            "{gaps} {counted} {missed}"
        );
        assert!(found.len() > 100, "{}", found.len());
    }
    // The command is in the recording as it is in the run's log.
    let log = std::fs::read_to_string(directory.join("commands.jsonl")).unwrap();
    let recorded_lines = lines_of(&RecordingReader::open(&file).unwrap(), LineTopic::Commands);
    assert!(log.contains("imu"), "{log}");
    assert_eq!(recorded_lines, log.lines().collect::<Vec<_>>());
    // A channel that does not exist is refused with the names of those that do.
    let refused = workplace.run(&["simulate", "--record", "--set", "record.channels=[\"observations\"]"]);
    assert_eq!(refused.status.code(), Some(2));
    assert!(text(&refused).contains("traffic-meta"), "{}", text(&refused));
}

/// A lossless recording on a disk of 16 MiB, most of which another program has. Returns the run, the directory of its results as others
/// see it, and the file with what the run says; `None` if this system allows no mounts.
fn record_on_small_disk(workplace: &Workplace, on_full_disk: &str) -> Option<(Child, File, PathBuf)> {
    let small = workplace.path().join(on_full_disk);
    std::fs::create_dir(&small).unwrap();
    let on_full = format!("record.on_full_disk={on_full_disk}");
    let settings = [on_full.as_str(), "record.chunk_mib=1", "episode.training_episodes=10"];
    let arguments = command("simulate", "full", &settings, &["--record", "--runs", on_full_disk]);
    let place = small.display();
    let mount = format!("mount -t tmpfs -o size=16m none {place} && head -c 12m /dev/zero > {place}/other");
    let mut command = with_mounts(&workplace.command(&arguments), &mount)?;
    let said = workplace.path().join(format!("{on_full_disk}.txt"));
    command.stderr(File::create(&said).unwrap()).stdout(Stdio::null());
    let mut run = command.spawn().unwrap();
    // The run's mounts are seen through its process, and through an open directory also after its end.
    let inside = PathBuf::from(format!("/proc/{}/root{place}", run.id()));
    let recording = inside.join("full/recording.mcap");
    until(&mut run, "the recording", || recording.exists().then_some(()));
    let held = File::open(&inside).unwrap();
    Some((run, held, said))
}

#[test]
fn on_a_full_disk_a_recording_waits_or_ends_as_configured() {
    let workplace = Workplace::new();
    for on_full_disk in ["wait", "stop_recording"] {
        let Some((mut run, held, said)) = record_on_small_disk(&workplace, on_full_disk) else {
            return;
        };
        let inside = PathBuf::from(format!("/proc/self/fd/{}", held.as_raw_fd()));
        if on_full_disk == "wait" {
            let log = inside.join("full/logs/recorder.log");
            until(&mut run, "notice", || {
                let log = std::fs::read_to_string(&log).unwrap_or_default();
                log.contains("waits until there is space").then_some(())
            });
            std::fs::remove_file(inside.join("other")).unwrap();
        }
        let status = run.wait().unwrap();
        let said = std::fs::read_to_string(&said).unwrap();
        assert!(status.success(), "{on_full_disk}: {said}");
        let recording = RecordingReader::open(&inside.join("full/recording.mcap")).unwrap();
        let found = ticks(&recording, Channel::Observation);
        assert_eq!(found, (0..found.len() as u64).collect::<Vec<_>>(), "{on_full_disk}");
        assert_eq!(
            recording.damage().is_none(),
            on_full_disk == "wait",
            "{:?}",
            recording.damage()
        );
        let report = std::fs::read_to_string(inside.join("full/report.json")).unwrap();
        let report: serde_json::Value = serde_json::from_str(&report).unwrap();
        let recorded = &report["environments"][0]["recording"];
        let is_whole = found.len() as u64 == report["ticks"].as_u64().unwrap();
        assert_eq!(
            (is_whole, recorded["stopped"].is_null()),
            (on_full_disk == "wait", on_full_disk == "wait")
        );
        assert_eq!(report["ticks"], 1500);
    }
}
