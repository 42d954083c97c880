//! The life of a real SUMO: its frames, and its failures.

use crate::support::{Bench, own_options, run, sumo_home};
use ipc_schema::{
    failure::{Failure, FailureKind},
    run::ScenarioOptions,
    traffic::{DISCONTINUOUS, Kind, MetaEvent},
};
use traffic_bridge::sumo::{
    Sumo, connected::ConnectedRule, error::SumoError, frame::TrafficFrame, options::SumoOptions, paths_passed,
};

const TWO_CARS: &str = "<routes>\
    <vehicle id=\"first\" depart=\"0\" departSpeed=\"0\"><route edges=\"A0B0 B0C0\"/></vehicle>\
    <person id=\"walker\" depart=\"0\"><walk edges=\"A0B0 B0C0\"/></person>\
    <vehicle id=\"second\" depart=\"3\"><route edges=\"B0A0 A0A1\"/></vehicle></routes>";

#[test]
fn frames_are_in_si_units_and_the_world_frame() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(TWO_CARS);
    let mut sumo = Sumo::start(bench.scenario_options(&sumocfg, 0.5)).unwrap();
    assert_eq!(sumo.step_s(), 0.5);
    let (mut previous_x_m, mut previous_speed_mps) = (None::<f64>, 0.0_f32);
    run(&mut sumo, 10, |_, frame| {
        assert!(frame.states.is_sorted_by_key(|state| state.vehicle));
        let first = frame.states.iter().find(|state| state.vehicle == 0).unwrap();
        // Edge A0B0 leads east.
        assert!(first.yaw_rad.abs() < 1e-3, "{}", first.yaw_rad);
        assert_eq!(first.flags & DISCONTINUOUS != 0, previous_x_m.is_none());
        if let Some(x_m) = previous_x_m {
            let advance_m: f64 = first.front_x_m - x_m;
            assert!(
                (advance_m - f64::from(first.speed_mps) * 0.5).abs() < 1e-3,
                "{advance_m}"
            );
            assert!((first.accel_mps2 - (first.speed_mps - previous_speed_mps) / 0.5).abs() < 1e-3);
        }
        (previous_x_m, previous_speed_mps) = (Some(first.front_x_m), first.speed_mps);
    });
    assert!(previous_speed_mps > 5.0);
}

#[test]
fn departures_and_arrivals_are_sent_once_in_order_with_their_data() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(TWO_CARS);
    let mut sumo = Sumo::start(bench.scenario_options(&sumocfg, 1.0)).unwrap();
    let (mut departed, mut arrived) = (Vec::new(), Vec::new());
    let mut frame = TrafficFrame::default();
    while !sumo.finished().unwrap() {
        sumo.step(&mut frame).unwrap();
        for event in &frame.events {
            let list = if event.event == MetaEvent::Departed as u32 {
                &mut departed
            } else {
                &mut arrived
            };
            list.push((event.vehicle, event.id_text()));
            if event.event == MetaEvent::Departed as u32 && event.kind != Kind::Person as u32 {
                assert_eq!((event.length_m, event.width_m), (5.0, 1.8));
                assert!(event.vehicle_class.starts_with(b"passenger\0"));
            }
        }
    }
    let expected = [(0, "first"), (1, "walker"), (2, "second")].map(|(index, id)| (index, id.to_owned()));
    assert_eq!(departed, expected);
    arrived.sort_unstable();
    assert_eq!(arrived, expected);
    assert!(frame.states.is_empty());
}

#[test]
fn a_teleported_vehicle_is_absent_until_it_returns_and_then_discontinuous() {
    let bench = Bench::new();
    // The stopped vehicle blocks the only route of the other for longer than it waits.
    let sumocfg = bench.scenario(
        "<routes><vehicle id=\"block\" depart=\"0\"><route edges=\"A0B0 B0C0\"/><stop lane=\"A0B0_1\" endPos=\"60\" duration=\"1000\"/></vehicle>\
         <vehicle id=\"block2\" depart=\"0\"><route edges=\"A0B0 B0C0\"/><stop lane=\"A0B0_2\" endPos=\"60\" duration=\"1000\"/></vehicle>\
         <vehicle id=\"late\" depart=\"9\"><route edges=\"A0B0 B0C0 C0D0\"/></vehicle></routes>",
    );
    let text = std::fs::read_to_string(&sumocfg).unwrap();
    let text = text.replace(
        "</input>",
        "</input><processing><time-to-teleport value=\"5\"/></processing>",
    );
    std::fs::write(&sumocfg, text).unwrap();
    let mut sumo = Sumo::start(bench.scenario_options(&sumocfg, 1.0)).unwrap();
    let (mut teleports, mut flags) = (0, Vec::new());
    run(&mut sumo, 80, |_, frame| {
        teleports += frame
            .events
            .iter()
            .filter(|e| e.event == MetaEvent::Teleported as u32 && e.vehicle == 2)
            .count();
        flags.extend(
            frame
                .states
                .iter()
                .filter(|state| state.vehicle == 2)
                .map(|state| state.flags),
        );
    });
    assert_eq!(teleports, 1);
    assert_eq!(
        flags.iter().filter(|&&flag| flag == DISCONTINUOUS).count(),
        2,
        "{flags:?}"
    );
}

#[test]
fn a_second_sumo_is_refused_until_the_first_is_dropped() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(TWO_CARS);
    let options = bench.scenario_options(&sumocfg, 1.0);
    let first = Sumo::start(options.clone()).unwrap();
    assert!(matches!(Sumo::start(options.clone()), Err(SumoError::AlreadyRunning)));
    first.close().unwrap();
    drop(Sumo::start(options.clone()).unwrap());
    Sumo::start(options).unwrap().close().unwrap();
}

/// SUMO's own functions for paths keep some 1.5 KiB at each start: the linker has to give it ours.
#[test]
fn sumo_takes_every_path_through_the_functions_that_keep_nothing() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(TWO_CARS);
    let before = paths_passed();
    Sumo::start(bench.scenario_options(&sumocfg, 1.0))
        .unwrap()
        .close()
        .unwrap();
    // The configuration, the net and the routes at least.
    assert!(paths_passed() >= before + 3, "{}", paths_passed() - before);
}

/// The error of a start of SUMO with these options, as the user sees it.
fn refusal(options: Result<SumoOptions, SumoError>, steps: usize) -> Failure {
    let started = options.and_then(Sumo::start);
    let result = started.and_then(|mut sumo| {
        let mut frame = TrafficFrame::default();
        (0..steps).try_for_each(|_| sumo.step(&mut frame))
    });
    Failure::from(result.unwrap_err())
}

fn assert_config(failure: &Failure, words: &[&str]) {
    assert_eq!(failure.kind, FailureKind::Config, "{failure:?}");
    assert!(failure.help.is_some());
    for word in words {
        assert!(failure.message.contains(word), "no {word} in: {}", failure.message);
    }
}

#[test]
fn an_unknown_edge_is_named_with_file_and_line() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(
        "<routes>\n<route id=\"r\" edges=\"A0B0 nope\"/>\n<vehicle id=\"v\" route=\"r\" depart=\"0\"/></routes>",
    );
    let failure = refusal(Ok(bench.scenario_options(&sumocfg, 1.0)), 1);
    assert_config(&failure, &["a.rou.xml, line 2", "nope", "not known"]);
}

#[test]
fn an_unknown_edge_that_sumo_reads_later_is_named_too() {
    let bench = Bench::new();
    let sumocfg = bench.scenario(
        "<routes><vehicle id=\"w\" depart=\"0\"><route edges=\"A0B0 B0C0\"/></vehicle>\
         <vehicle id=\"x\" depart=\"500\"><route edges=\"A0B0 B0C0\"/></vehicle>\n\
         <vehicle id=\"v\" depart=\"900\"><route edges=\"A0B0 nope\"/></vehicle></routes>",
    );
    let failure = refusal(Ok(bench.scenario_options(&sumocfg, 1.0)), 1000);
    assert_config(&failure, &["a.rou.xml, line 2", "nope", "v"]);
}

#[test]
fn files_that_are_missing_or_broken_are_named() {
    let bench = Bench::new();
    let home = sumo_home();
    let folder = bench.folder.path();
    let scenario = |name: &str| {
        let own = match name {
            "lost.sumocfg" => own_options(&folder.join("lost.net.xml"), &[]),
            _ => ScenarioOptions::default(),
        };
        SumoOptions::scenario(
            &home,
            &folder.join(name),
            &own,
            &folder.join("sumo"),
            1.0,
            23423,
            ConnectedRule::connected(0.5),
        )
    };
    assert_config(
        &refusal(scenario("none.sumocfg"), 0),
        &["none.sumocfg", "does not exist"],
    );
    bench.file(
        "lost.sumocfg",
        "<configuration><input><net-file value=\"lost.net.xml\"/></input></configuration>",
    );
    assert_config(&refusal(scenario("lost.sumocfg"), 0), &["lost.net.xml", "lost.sumocfg"]);
    bench.file(
        "odd.sumocfg",
        "<configuration><input><foo value=\"1\"/></input></configuration>",
    );
    assert_config(&refusal(scenario("odd.sumocfg"), 0), &["odd.sumocfg", "foo"]);
    let bad = bench.file(
        "bad.net.xml",
        "<net version=\"1.20\"><edge id=\"a\" from=\"x\" to=\"y\"/></net>",
    );
    assert_config(
        &refusal(SumoOptions::population(&home, &bad, &[], 0.1, 1), 0),
        &["bad.net.xml", "from-node 'x'"],
    );
    let text = bench.file("text.net.xml", "hello");
    assert_config(
        &refusal(SumoOptions::population(&home, &text, &[], 0.1, 1), 0),
        &["text.net.xml"],
    );
}
