//! The fan-out as a process: shared memory on one side, a viewer's zenoh session on the other.

#[cfg(test)]
mod harness;

use std::{collections::BTreeSet, io::Write as _, mem::offset_of, net::TcpStream};

use bytemuck::{cast_slice, pod_read_unaligned};
use fanout::{frame::HEADER_BYTES, network::keys::Topic};
use harness::{
    PATIENCE, Run, ask, header, neighbours, next, observation, publisher, send, send_census, send_neighbours,
    send_observation, send_prediction, send_scan, send_world, states, until, watch,
};
use ipc_schema::{
    SCHEMA_VERSION,
    board::{State, TrainingStatus},
    failure::Failure,
    header::{LAST_OF_RUN, MessageHeader},
    pointcloud::Scan,
    process::Process,
    run::Mode,
    services::Channel,
    traffic::{SignalMeta, VehicleMeta, id_hash},
};
use zenoh::{Wait, sample::SampleKind};

/// A train run from start to end: each frame has the bytes of one tick in shared memory, and the fan-out ends with the run.
#[test]
fn frames_are_the_bytes_of_shared_memory() {
    let run = Run::new("a run/with #odd? $name*", Mode::Train);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let [world, seen, predicted] =
        [Topic::World, Topic::Observation, Topic::Prediction].map(|t| watch(&viewer, run.key(t)));
    let (sim, worlds) = publisher(&run, Channel::World);
    let (sensors, observations) = publisher(&run, Channel::Observation);
    let (trainer, predictions) = publisher(&run, Channel::Prediction);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });

    for tick in 0..3 {
        send_world(&sim, &worlds, tick, 0, 5);
        send_observation(&sensors, &observations, tick, 0, 4);
        send_prediction(&trainer, &predictions, tick, 4);
        until("publication", || {
            ask(&viewer, &run.key(Topic::Prediction)).is_some_and(|f| f[offset_of!(MessageHeader, tick)] == tick as u8)
        });
    }
    for tick in 0..3 {
        let (header, payload) = next(&world);
        assert_eq!(
            (header.tick, header.shape, header.run_id),
            (tick, [5, 0, 0, 5], run.file.run_id)
        );
        assert_eq!(payload, cast_slice::<_, u8>(&states(tick, 5)));
        let (header, payload) = next(&seen);
        assert_eq!(
            (header.tick, header.sim_time_ns, payload),
            (tick, tick * 100_000_000, observation(tick, 4))
        );
        let (header, payload) = next(&predicted);
        assert_eq!(
            (header.tick, &payload[..32]),
            (tick, cast_slice(&[[tick as f32, 0.5]; 4]))
        );
    }

    send_world(&sim, &worlds, 3, LAST_OF_RUN, 5);
    send_observation(&sensors, &observations, 3, LAST_OF_RUN, 4);
    assert_eq!(fanout.exit_code(), Some(0));
    for frames in [&world, &seen] {
        assert_eq!(next(frames).0.tick, 3);
    }
}

/// What road users know from messages goes out with its tick while a viewer subscribes, without what a policy alone may see, and costs
/// no other topic a tick.
#[test]
fn what_is_known_from_messages_goes_to_those_who_subscribe() {
    let run = Run::with_settings("messages", Mode::Simulate, 50.0, |config| config.v2x.share = 1.0);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let (sim, worlds) = publisher(&run, Channel::World);
    let (radios, known) = publisher(&run, Channel::Neighbours);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });

    // Without a subscriber the tick goes out when the others have it.
    send_world(&sim, &worlds, 0, 0, 5);
    assert_eq!(next(&world).0.tick, 0);
    send_neighbours(&radios, &known, 0, 0, 4);
    assert!(ask(&viewer, &run.key(Topic::Neighbours)).is_none());

    let heard = watch(&viewer, run.key(Topic::Neighbours));
    let mut tick = 0;
    until("a frame of what is known", || {
        tick += 1;
        send_world(&sim, &worlds, tick, 0, 5);
        send_neighbours(&radios, &known, tick, 0, 4);
        std::thread::park_timeout(std::time::Duration::from_millis(30));
        ask(&viewer, &run.key(Topic::Neighbours)).is_some()
    });
    let (header, payload) = next(&heard);
    let (layout, expected) = neighbours(header.tick, 4, 0);
    assert_eq!(header.shape, layout.shape);
    // What lies between two sections is not part of any.
    for (_, section) in layout.named() {
        let part = section.offset..section.offset + section.len;
        assert_eq!(payload[part.clone()], expected[part]);
    }
    assert_eq!(payload.len(), layout.len);

    tick += 1;
    send_world(&sim, &worlds, tick, LAST_OF_RUN, 5);
    send_neighbours(&radios, &known, tick, LAST_OF_RUN, 4);
    assert_eq!(fanout.exit_code(), Some(0));
    let last = |frames| {
        let mut newest = next(frames).0.tick;
        while newest < tick {
            newest = next(frames).0.tick;
        }
        newest
    };
    assert_eq!((last(&world), last(&heard)), (tick, tick));
}

/// A viewer that joins late gets the whole picture from one query, and the liveliness token disappears with the run.
#[test]
fn a_late_joiner_has_the_whole_picture() {
    let run = Run::new("late", Mode::Simulate);
    let mut fanout = run.start_fanout();
    let first = run.attach();
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    send_world(&sim, &worlds, 0, 0, 3);
    until("publication", || ask(&first, &run.key(Topic::World)).is_some());

    let viewer = run.attach();
    let world = ask(&viewer, &run.key(Topic::World)).unwrap();
    assert_eq!(fanout::frame::decode(&world).unwrap().0.rows(), 3);
    let map: serde_json::Value = serde_json::from_slice(&ask(&viewer, &run.key(Topic::Map)).unwrap()).unwrap();
    assert_eq!(map["map"]["bounds_m"], serde_json::json!([0.0, 0.0, 220.0, 200.0]));
    assert_eq!(
        (map["run"].as_str(), map["tick_s"].as_f64(), map["mode"].as_str()),
        (Some("late"), Some(0.1), Some("simulate"))
    );
    until("a status with the tick", || {
        let status = ask(&viewer, &run.key(Topic::Status)).unwrap();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap();
        status["processes"]
            .as_array()
            .is_some_and(|p| p.len() == Process::COUNT)
            && status["fanout"]["frames"] != 0
    });

    let alive = viewer
        .liveliness()
        .declare_subscriber(run.alive_key())
        .history(true)
        .wait()
        .unwrap();
    assert_eq!(alive.recv_timeout(PATIENCE).unwrap().unwrap().kind(), SampleKind::Put);
    send_world(&sim, &worlds, 1, LAST_OF_RUN, 3);
    assert_eq!(fanout.exit_code(), Some(0));
    assert_eq!(
        alive.recv_timeout(PATIENCE).unwrap().unwrap().kind(),
        SampleKind::Delete
    );
    let health = sim.board_of(Process::Fanout).unwrap().health();
    assert_eq!((health.state, health.ticks, health.drops), (State::Done as u32, 2, 0));
}

/// Names of all members of a JSON value, each with those of the objects around it.
fn members(value: &serde_json::Value, around: &str, found: &mut BTreeSet<String>) {
    match value {
        serde_json::Value::Object(map) => {
            for (name, value) in map {
                let path = format!("{around}/{name}");
                members(value, &path, found);
                found.insert(path);
            }
        }
        serde_json::Value::Array(values) => values.iter().for_each(|value| members(value, around, found)),
        _ => {}
    }
}

/// The example of a status in docs/fanout.md has the members that a status has, and each example the version of the schema.
#[test]
fn the_documented_status_has_the_members_of_a_real_one() {
    let page = include_str!("../../docs/fanout.md");
    let (_, section) = page.split_once("## `status`").unwrap();
    let (example, _) = section.split_once("```json\n").unwrap().1.split_once("```").unwrap();
    let example: serde_json::Value = serde_json::from_str(example).unwrap();

    let run = Run::new("documented", Mode::Train);
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    let (trainer, _predictions) = publisher(&run, Channel::Prediction);
    let mut learnt = TrainingStatus::default();
    learnt.metrics.fill(5.0);
    trainer.board().set_training(learnt);
    send_world(&sim, &worlds, 0, 0, 3);
    let mut real = serde_json::Value::Null;
    until("a status with the task's metrics", || {
        let status = ask(&viewer, &run.key(Topic::Status));
        real = status.map_or(real.take(), |status| serde_json::from_slice(&status).unwrap());
        !real["training"]["metrics"][0].is_null()
    });
    let [documented, sent] = [&example, &real].map(|status| {
        let mut found = BTreeSet::new();
        members(status, "", &mut found);
        found
    });
    assert_eq!(documented, sent);
    let versions = page.split("\"schema_version\": ").skip(1);
    let versions: Vec<&str> = versions.filter_map(|rest| rest.split(',').next()).collect();
    assert_eq!(versions, vec![real["schema_version"].to_string(); 3]);
}

/// A producer far ahead of the rate is not slowed down: the fan-out misses ticks, counts them, and publishes the newest.
#[test]
fn a_fast_producer_is_decimated_and_counted() {
    let run = Run::new("fast", Mode::Simulate);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let (sim, worlds) = publisher(&run, Channel::World);
    let board = sim.board_of(Process::Fanout).unwrap();
    until("attendance", || board.progress().attached == 1);
    send_world(&sim, &worlds, 0, 0, 2);
    until("publication", || ask(&viewer, &run.key(Topic::World)).is_some());
    for tick in 1..5_000 {
        send_world(&sim, &worlds, tick, 0, 2);
    }
    assert!(worlds.drops() > 0);
    // A subscriber may miss a frame; a query gets the newest.
    until("the newest tick", || {
        send_world(&sim, &worlds, 5_000, 0, 2);
        let frame = ask(&viewer, &run.key(Topic::World)).unwrap();
        fanout::frame::decode(&frame).unwrap().0.tick == 5_000
    });
    until("the end", || {
        send_world(&sim, &worlds, 5_001, LAST_OF_RUN, 2);
        fanout.0.try_wait().unwrap().is_some()
    });
    assert_eq!(fanout.exit_code(), Some(0));
    let ticks: Vec<u64> = std::iter::from_fn(|| world.try_recv().unwrap())
        .map(|sample| fanout::frame::decode(&sample.payload().to_bytes()).unwrap().0.tick)
        .collect();
    assert!(!ticks.is_empty());
    assert!(ticks.is_sorted(), "{ticks:?}");
    assert!(ticks.len() < 500, "{}", ticks.len());
    let health = board.health();
    assert!(health.drops > 0);
    assert_eq!((health.state, health.ticks), (State::Done as u32, 5_002));
}

/// A run may pause at any tick: the newest one is published even if it came before the rate allowed it.
#[test]
fn the_newest_tick_is_published_if_none_follows() {
    let run = Run::at_rate("paused", Mode::Simulate, 2.0);
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    let (sim, worlds) = publisher(&run, Channel::World);
    let board = sim.board_of(Process::Fanout).unwrap();
    until("attendance", || board.progress().attached == 1);
    for tick in 0..5 {
        send_world(&sim, &worlds, tick, 0, 2);
        until("publication", || {
            let frame = ask(&viewer, &run.key(Topic::World));
            frame.is_some_and(|frame| fanout::frame::decode(&frame).unwrap().0.tick == tick)
        });
    }
}

/// Ticks of 2 000 road users at the rate of a paced run arrive complete and without gaps.
#[test]
fn two_thousand_road_users_arrive_without_a_gap() {
    let run = Run::new("crowd", Mode::Simulate);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    for tick in 0..20 {
        send_world(&sim, &worlds, tick, if tick == 19 { LAST_OF_RUN } else { 0 }, 2_000);
        let (header, payload) = next(&world);
        assert_eq!((header.tick, header.rows()), (tick, 2_000));
        assert_eq!(payload, cast_slice::<_, u8>(&states(tick, 2_000)));
    }
    assert_eq!(fanout.exit_code(), Some(0));
}

#[test]
fn a_port_in_use_is_a_configuration_error() {
    let run = Run::new("taken", Mode::Train);
    let _taken = std::net::TcpListener::bind(("127.0.0.1", run.port)).unwrap();
    assert_eq!(run.start_fanout().exit_code(), Some(2));
    let failure = Failure::read(&run.file.run_dir, "fanout").unwrap();
    assert!(
        failure.message.contains("fanout.listen") && failure.message.contains(&run.port.to_string()),
        "{failure:?}"
    );
}

#[test]
fn it_stops_at_sigterm() {
    let run = Run::new("stop", Mode::Train);
    let mut fanout = run.start_fanout();
    let _viewer = run.attach();
    fanout.terminate().unwrap();
    assert_eq!(fanout.exit_code(), Some(0));
}

/// A query gets the whole tables, whatever characters the ids have. A scan is published only while a viewer subscribes to it.
#[test]
fn ids_lights_and_scans_reach_viewers_whatever_the_ids() {
    const IDS: [&str; 3] = ["plain", "a/b #?$*", "ünï%41"];
    let run = Run::new("names", Mode::Simulate);
    let _fanout = run.start_fanout();
    let viewer = run.attach();
    let (bridge, censuses) = publisher(&run, Channel::Census);
    let (sim, worlds) = publisher(&run, Channel::World);
    let (sensors, scans) = publisher(&run, Channel::Pointcloud);
    let lights = watch(&viewer, run.key(Topic::Signals));
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    send_world(&sim, &worlds, 0, 0, 3);
    send_census(&bridge, &censuses, 0, &IDS, "rG");
    let (header, payload) = next(&lights);
    let state = |payload: &[u8], row: usize| payload[row * size_of::<SignalMeta>() + offset_of!(SignalMeta, state)];
    assert_eq!((header.rows(), state(&payload, 0), state(&payload, 1)), (2, b'r', b'G'));

    let late = run.attach();
    until("the table of road users", || {
        let Some(frame) = ask(&late, &run.key(Topic::Vehicles)) else {
            return false;
        };
        let (header, payload) = fanout::frame::decode(&frame).unwrap();
        let rows = payload.chunks_exact(size_of::<VehicleMeta>());
        let ids: Vec<String> = rows
            .map(|row| pod_read_unaligned::<VehicleMeta>(row).id_text())
            .collect();
        header.rows() == 3 && ids == IDS
    });
    assert!(ask(&late, &run.key(Topic::Signals)).is_some_and(|frame| state(&frame[HEADER_BYTES..], 1) == b'G'));

    // Without a subscriber no scan is published; with one, its scans are.
    send_scan(&sensors, &scans, 1, (IDS[1], 1), 50);
    let wanted = watch(&late, run.sensor_key(Channel::Pointcloud, IDS[1]));
    let mut tick = 1;
    until("a scan", || {
        tick += 1;
        send_scan(&sensors, &scans, tick, (IDS[2], 2), 50);
        send_scan(&sensors, &scans, tick, (IDS[1], 1), 50);
        ask(&late, &run.sensor_key(Channel::Pointcloud, IDS[1])).is_some()
    });
    let (header, payload) = next(&wanted);
    let scan: Scan = pod_read_unaligned(&payload[..size_of::<Scan>()]);
    assert_eq!((header.rows(), scan.vehicle, scan.id_hash), (50, 1, id_hash(IDS[1])));
    assert!(ask(&late, &run.sensor_key(Channel::Pointcloud, IDS[2])).is_none());
}

/// A viewer that joins late gets the course of training from its start, also after the fan-out was killed; later updates follow.
#[test]
fn a_late_viewer_gets_the_whole_course_of_training() {
    let run = Run::new("course", Mode::Simulate);
    let append = |env_steps: u64| {
        let mut file = std::fs::File::options()
            .create(true)
            .append(true)
            .open(run.file.run_dir.join("learning.jsonl"))
            .unwrap();
        writeln!(
            file,
            "{{\"env_steps\":{env_steps},\"tick\":1,\"training\":{{\"reward\":0.5}}}}"
        )
        .unwrap();
    };
    let steps = |document: &[u8]| -> Vec<u64> {
        assert_eq!(
            fanout::reader::check("learning", document, Some(run.file.run_id)),
            Ok(None)
        );
        let document: serde_json::Value = serde_json::from_slice(document).unwrap();
        let lines = document["updates"].as_array().unwrap().iter();
        lines.map(|line| line["env_steps"].as_u64().unwrap()).collect()
    };
    (0..100).for_each(append);
    let mut fanout = run.start_fanout();
    fanout.0.kill().unwrap();
    fanout.0.wait().unwrap();
    run.forget_dead();
    let _fanout = run.restart_fanout(1);
    let late = run.attach();
    let newest = watch(&late, run.key(Topic::Learning));
    until("the whole course", || {
        ask(&late, &run.key(Topic::Learning)).is_some_and(|document| steps(&document) == Vec::from_iter(0..100))
    });
    append(100);
    until("the newest update", || {
        let sample = newest.recv_timeout(PATIENCE).unwrap().unwrap();
        let steps = steps(&sample.payload().to_bytes());
        steps.len() <= 32 && steps.last() == Some(&100)
    });
}

/// Random bytes on the port and on every key, and another version in shared memory, are counted, and the run's frames still arrive.
#[test]
fn garbage_is_counted_and_not_fatal() {
    let run = Run::new("garbage", Mode::Simulate);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let (sim, worlds) = publisher(&run, Channel::World);
    let (sensors, observations) = publisher(&run, Channel::Observation);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    for seed in 0..20_u64 {
        let mut port = TcpStream::connect(("127.0.0.1", run.port)).unwrap();
        let bytes: Vec<u8> = (0..200 * seed)
            .map(|i| (i.wrapping_mul(6_364_136_223_846_793_005 ^ seed) >> 33) as u8)
            .collect();
        // The fan-out may close the connection in the middle: that is a refusal.
        let _ = port.write_all(&bytes);
        // A length that promises more than follows, and a closed connection.
        let _ = port.write_all(&[0xff, 0xff, 1, 2, 3]);
    }
    let forger = run.attach();
    let keys = Topic::ALL.map(|topic| run.key(topic)).into_iter();
    let keys: Vec<String> = keys
        .chain([
            run.alive_key(),
            run.sensor_key(Channel::Pointcloud, "x"),
            format!("{}/x/y", run.key(Topic::World)),
        ])
        .collect();
    for key in &keys {
        for bytes in [vec![], vec![0xff; 71], vec![7; 300]] {
            forger.put(key, bytes).wait().unwrap();
        }
        forger.delete(key).wait().unwrap();
        let _ = forger.get(format!("{key}?_anyke;x=%")).payload(vec![1; 99]).wait();
    }
    // A message of another version, and one whose header promises more than its payload holds.
    let old = MessageHeader {
        schema_version: SCHEMA_VERSION - 1,
        ..header(&sim, 0, 0, [1, 0, 0, 0])
    };
    send(&worlds, old, &[0; 136]);
    send(&observations, header(&sensors, 0, 0, [4000, 9, 0, 0]), &[0; 64]);
    send_world(&sim, &worlds, 1, 0, 3);
    let is_the_runs = |payload: &[u8]| payload == cast_slice::<_, u8>(&states(1, 3));
    until("a frame of the run among the garbage", || {
        let sample = world.recv_timeout(PATIENCE).unwrap().unwrap();
        let bytes = sample.payload().to_bytes();
        fanout::reader::check("world", &bytes, Some(run.file.run_id)).is_ok() && is_the_runs(&bytes[HEADER_BYTES..])
    });
    until("the counts", || {
        let status = ask(&viewer, &run.key(Topic::Status)).unwrap();
        let Ok(status) = serde_json::from_slice::<serde_json::Value>(&status) else {
            return false;
        };
        let count = |name: &str| status["fanout"][name].as_u64().unwrap();
        count("refused_samples") >= 4 * keys.len() as u64 && count("refused_messages") == 2
    });
    send_world(&sim, &worlds, 2, LAST_OF_RUN, 3);
    assert_eq!(fanout.exit_code(), Some(0));
}

/// Frames of random bytes at the socket, and random samples of a client that zenoh lets in: neither ends the fan-out nor reaches a viewer.
/// `CARAWARE_FUZZ_FRAMES` chooses how many of each.
#[test]
fn a_flood_at_the_endpoint_changes_nothing() {
    let frames: u64 = std::env::var("CARAWARE_FUZZ_FRAMES").map_or(20_000, |text| text.parse().unwrap());
    let run = Run::new("flood", Mode::Simulate);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let (sim, worlds) = publisher(&run, Channel::World);
    until("attendance", || {
        sim.board_of(Process::Fanout).unwrap().progress().attached == 1
    });
    let mut random = 1_u64;
    let mut bytes = |count: usize| -> Vec<u8> {
        let mut draw = || {
            random = random
                .wrapping_mul(6_364_136_223_846_793_005)
                .wrapping_add(1_442_695_040_888_963_407);
            (random >> 33) as u8
        };
        (0..count).map(|_| draw()).collect()
    };
    // zenoh's frames begin with their length. It closes a connection at the first that it cannot read, so each has a connection.
    let connections = frames / 20;
    for number in 0..connections {
        let Ok(mut port) = TcpStream::connect(("127.0.0.1", run.port)) else {
            continue;
        };
        for _ in 0..20 {
            let length = 1 + bytes(1)[0] % 90;
            let mut frame = vec![length, 0];
            // Half of the frames begin as one that opens a session.
            frame.push(if number % 2 == 0 { 0x01 } else { bytes(1)[0] });
            frame.extend(bytes(usize::from(length) - 1));
            if port.write_all(&frame).is_err() {
                break;
            }
        }
    }
    let forger = run.attach();
    for number in 0..frames {
        let key = run.key(Topic::ALL[number as usize % Topic::ALL.len()]);
        let length = usize::from(bytes(1)[0]);
        forger.put(&key, bytes(length)).wait().unwrap();
    }
    let mut tick = 0;
    until("a frame of the run", || {
        tick += 1;
        send_world(&sim, &worlds, tick, 0, 3);
        let Ok(Some(sample)) = world.recv_timeout(std::time::Duration::from_millis(200)) else {
            return false;
        };
        let received = sample.payload().to_bytes();
        assert!(
            fanout::reader::check("world", &received, Some(run.file.run_id)).is_ok(),
            "a forged frame has arrived"
        );
        true
    });
    send_world(&sim, &worlds, tick + 1, LAST_OF_RUN, 3);
    assert_eq!(fanout.exit_code(), Some(0));
}

/// A killed fan-out that is started again shows the run to a viewer that was connected before.
#[test]
fn viewers_reconnect_to_a_restarted_fan_out() {
    let run = Run::new("again", Mode::Simulate);
    let (sim, worlds) = publisher(&run, Channel::World);
    let (bridge, censuses) = publisher(&run, Channel::Census);
    let mut fanout = run.start_fanout();
    let viewer = run.attach();
    let world = watch(&viewer, run.key(Topic::World));
    let mut tick = 0;
    let mut shown = || {
        tick += 1;
        send_world(&sim, &worlds, tick, 0, 3);
        send_census(&bridge, &censuses, tick, &["a"], "r");
        world
            .recv_timeout(std::time::Duration::from_millis(100))
            .unwrap()
            .is_some()
    };
    for incarnation in 1..4 {
        until("a frame", &mut shown);
        fanout.0.kill().unwrap();
        fanout.0.wait().unwrap();
        run.forget_dead();
        while world.try_recv().unwrap().is_some() {}
        fanout = run.restart_fanout(incarnation);
    }
    until("a frame", &mut shown);
    let late = run.attach();
    until("the whole picture", || {
        shown();
        [Topic::Map, Topic::Vehicles, Topic::Signals, Topic::World, Topic::Status]
            .into_iter()
            .all(|topic| ask(&late, &run.key(topic)).is_some())
    });
}
