//! SUMO's own scenario A10KW: a Berlin motorway whose additional files write their results into their own folder.

use std::{collections::BTreeSet, path::Path, time::SystemTime};

use crate::support::{Bench, run, sumo_home};
use ipc_schema::{
    run::ScenarioOptions,
    traffic::{Kind, MetaEvent, VehicleMeta},
};
use traffic_bridge::sumo::{Sumo, connected::ConnectedRule, options::SumoOptions};

/// Files below `folder` with their times of change.
fn listing(folder: &Path) -> BTreeSet<(std::path::PathBuf, SystemTime)> {
    let mut found = BTreeSet::new();
    for entry in std::fs::read_dir(folder).unwrap().map(Result::unwrap) {
        if entry.file_type().unwrap().is_dir() {
            found.append(&mut listing(&entry.path()));
        } else {
            found.insert((entry.path(), entry.metadata().unwrap().modified().unwrap()));
        }
    }
    found
}

#[test]
fn a10kw_runs_and_writes_only_to_the_run_directory() {
    let bench = Bench::new();
    let games = sumo_home().join("tools/game");
    let before = listing(&games);
    let output = bench.folder.path().join("sumo");
    let options = SumoOptions::scenario(
        &sumo_home(),
        &games.join("A10KW.sumocfg"),
        &ScenarioOptions {
            step_s: 0.5,
            ..ScenarioOptions::default()
        },
        &output,
        0.5,
        23423,
        ConnectedRule::Scenario {
            heroes: BTreeSet::new(),
            cav_share: 1.0,
            max_cavs: 20,
        },
    )
    .unwrap();
    let mut sumo = Sumo::start(options).unwrap();
    assert_eq!((sumo.step_s(), sumo.duration_s()), (0.5, Some(1800.0)));
    let (mut most, mut vehicle_steps) = (0, 0);
    let (mut cavs, mut departed_cavs) = (0, 0);
    run(&mut sumo, 240, |_, frame| {
        assert!(frame.cavs <= 20, "{}", frame.cavs);
        cavs = frame.cavs;
        let departed = |meta: &&VehicleMeta| meta.event == MetaEvent::Departed as u32 && meta.kind == Kind::Cav as u32;
        departed_cavs += frame.events.iter().filter(departed).count();
        most = most.max(frame.states.len());
        vehicle_steps += frame.states.len();
        assert!(
            frame
                .states
                .iter()
                .all(|state| state.front_x_m.is_finite() && state.yaw_rad.is_finite())
        );
    });
    assert!(most > 50, "{most}");
    assert!(
        cavs == 20 && departed_cavs > 20,
        "{cavs} at the end of {departed_cavs}: a vehicle that arrives makes room"
    );
    sumo.close().unwrap();
    assert_eq!(listing(&games), before, "nothing was written into the wheel");
    let written: Vec<_> = listing(&output).into_iter().map(|(path, _)| path).collect();
    assert_eq!(written, [output.join("netstate.xml"), output.join("tlsstate.xml")]);
    println!("{vehicle_steps} vehicle-steps");
}
