//! The fan-out as a process: shared memory on one side, a viewer's zenoh session on the other.

#[cfg(test)]
mod harness;

use bytemuck::cast_slice;
use fanout::keys::Topic;
use harness::{
    PATIENCE, Run, ask, next, observation, publisher, send_observation, send_prediction, send_world, states, until,
    watch,
};
use ipc_schema::{board::State, failure::Failure, header::LAST_OF_RUN, process::Process, run::Mode, services::Channel};
use zenoh::{Wait, sample::SampleKind};

/// The whole of a train run: frames are the bytes of shared memory, of one tick, newest wins, and the end is an end.
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
            ask(&viewer, &run.key(Topic::Prediction)).is_some_and(|f| f[40] == tick as u8)
        });
    }
    for tick in 0..3 {
        let (header, payload) = next(&world);
        assert_eq!(
            (header.tick, header.count, header.columns, header.run_id),
            (tick, 5, 0, run.file.run_id)
        );
        assert_eq!(payload, cast_slice::<_, u8>(&states(tick, 5)));
        let (header, payload) = next(&seen);
        assert_eq!(
            (header.tick, header.sim_time_ns, payload),
            (tick, tick * 100_000_000, observation(tick, 4))
        );
        let (header, payload) = next(&predicted);
        assert_eq!(
            (header.tick, payload),
            (tick, cast_slice(&[[tick as f32, 0.5]; 4]).to_vec())
        );
    }

    send_world(&sim, &worlds, 3, LAST_OF_RUN, 5);
    send_observation(&sensors, &observations, 3, LAST_OF_RUN, 4);
    assert_eq!(fanout.exit_code(), Some(0));
    for frames in [&world, &seen] {
        assert_eq!(next(frames).0.tick, 3);
    }
}

/// Somebody who comes late asks, and has the whole picture at once; the token tells when the run is over.
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
    assert_eq!(fanout::frame::decode(&world).unwrap().0.count, 3);
    let map: serde_json::Value = serde_json::from_slice(&ask(&viewer, &run.key(Topic::Map)).unwrap()).unwrap();
    assert_eq!(map["map"]["bounds_m"], serde_json::json!([0.0, 0.0, 220.0, 200.0]));
    assert_eq!(
        (map["run"].as_str(), map["tick_s"].as_f64(), map["mode"].as_str()),
        (Some("late"), Some(0.1), Some("simulate"))
    );
    until("a status with the tick", || {
        let status = ask(&viewer, &run.key(Topic::Status)).unwrap();
        let status: serde_json::Value = serde_json::from_slice(&status).unwrap();
        status["processes"].as_array().is_some_and(|p| p.len() == 5) && status["fanout"]["frames"] == 1
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

/// A producer far ahead of the rate loses nothing itself: the fan-out misses ticks, counts them, and shows the newest.
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
    until("an empty queue", || {
        send_world(&sim, &worlds, 5_000, LAST_OF_RUN, 2);
        fanout.0.try_wait().unwrap().is_some()
    });
    assert_eq!(fanout.exit_code(), Some(0));
    let mut ticks = Vec::new();
    while let Some(sample) = world.try_recv().unwrap() {
        ticks.push(fanout::frame::decode(&sample.payload().to_bytes()).unwrap().0.tick);
    }
    assert!(ticks.is_sorted() && ticks.last() == Some(&5_000), "{ticks:?}");
    assert!(ticks.len() < 500, "{}", ticks.len());
    assert!(board.health().drops > 0);
}

/// 2 000 road users at the rate of a paced run arrive whole and without gaps.
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
        assert_eq!((header.tick, header.count), (tick, 2_000));
        assert_eq!(payload, cast_slice::<_, u8>(&states(tick, 2_000)));
    }
    assert_eq!(fanout.exit_code(), Some(0));
}

#[test]
fn a_port_in_use_is_a_mistake_in_the_configuration() {
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
fn it_stops_when_asked() {
    let run = Run::new("stop", Mode::Train);
    let mut fanout = run.start_fanout();
    let _viewer = run.attach();
    fanout.terminate().unwrap();
    assert_eq!(fanout.exit_code(), Some(0));
}
