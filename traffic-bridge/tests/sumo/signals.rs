//! Published traffic lights, compared with SUMO's own output.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
};

use crate::support::{Bench, run, sumo_home};
use ipc_schema::traffic::{SIGNAL_LINKS, SignalMeta, id_hash};
use traffic_bridge::{
    population::{HeroRoutes, Population, PopulationSize},
    sumo::{
        Sumo,
        frame::TrafficFrame,
        inputs::{attribute, for_each_element},
        options::SumoOptions,
    },
};

/// Junctions with signals in the town.
const LIGHTS: usize = 4;

/// The letters of the links that a message carries.
fn letters(signal: &SignalMeta) -> String {
    let len = (signal.links as usize).min(SIGNAL_LINKS);
    String::from_utf8_lossy(&signal.state[..len]).into_owned()
}

/// Runs `net` with some traffic and compares every state of every light with what SUMO saves; returns the published changes.
fn compare(bench: &Bench, net: &Path, mut files: Vec<PathBuf>, pedestrians: u32) -> u32 {
    let lights = bench.lights_of(net);
    let events: String = lights
        .iter()
        .map(|id| format!("<timedEvent type=\"SaveTLSStates\" source=\"{id}\" dest=\"{id}.states.xml\"/>"))
        .collect();
    files.push(bench.file("a.add.xml", &format!("<additional>{events}</additional>")));
    let options = SumoOptions::population(&sumo_home(), net, &files, 0.5, 1).unwrap();
    let mut sumo = Sumo::start(options).unwrap();
    let size = PopulationSize {
        cavs: 20,
        others: 0,
        heroes: 0,
        pedestrians,
    };
    let mut population = Population::start(&mut sumo, size, HeroRoutes::default(), 1).unwrap();
    let mut now: BTreeMap<String, String> = BTreeMap::new();
    let (mut published, mut changes) = (Vec::new(), 0);
    run(&mut sumo, 400, |sumo: &mut Sumo, frame: &TrafficFrame| {
        if frame.step == 1 {
            let all: Vec<String> = frame.signals.iter().map(|signal| signal.id_text()).collect();
            assert_eq!(all, lights, "all of them, in the order of their ids");
        }
        for signal in &frame.signals {
            assert_eq!(lights[signal.signal as usize], signal.id_text());
            assert_eq!((signal.id_hash, signal.reserved), (id_hash(&signal.id_text()), 0));
            let before = now.insert(signal.id_text(), letters(signal));
            assert_ne!(before.as_ref(), Some(&letters(signal)), "published without a change");
            changes += u32::from(before.is_some());
        }
        published.push(now.clone());
        population.after_step(sumo, frame).unwrap();
    });
    sumo.close().unwrap();
    let mut compared = 0;
    for id in &lights {
        for_each_element(&bench.folder.path().join(format!("{id}.states.xml")), |element| {
            let (Some(time), Some(state)) = (attribute(element, "time"), attribute(element, "state")) else {
                return;
            };
            // SUMO's time is that of the start of the step.
            let step = (2.0 * time.parse::<f64>().unwrap()).round() as usize;
            if let Some(published) = published.get(step) {
                assert_eq!(published[id], state, "{id} at {time}");
                compared += 1;
            }
        })
        .unwrap();
    }
    assert_eq!(compared, lights.len() * 400);
    changes
}

/// Its lights are actuated: traffic decides when they switch.
#[test]
fn the_lights_of_the_town_are_published_as_sumo_writes_them() {
    let bench = Bench::new();
    let (net, files) = bench.town();
    assert_eq!(bench.lights_of(&net).len(), LIGHTS);
    let changes = compare(&bench, &net, files, 10);
    assert!(changes > 20, "{changes} changes in 200 s");
}

#[test]
fn lights_with_fixed_times_are_published_as_sumo_writes_them() {
    let bench = Bench::new();
    let net = bench.signalled_grid(3);
    let changes = compare(&bench, &net, Vec::new(), 0);
    assert!(changes > 30, "{changes} changes in 200 s");
}

#[test]
fn a_new_episode_sends_every_light_again() {
    let bench = Bench::new();
    let (net, files) = bench.town();
    let options = || SumoOptions::population(&sumo_home(), &net, &files, 1.0, 1).unwrap();
    let mut sumo = Sumo::start(options()).unwrap();
    let mut counts = Vec::new();
    run(&mut sumo, 3, |_, frame| counts.push(frame.signals.len()));
    let mut sumo = sumo.reload(options()).unwrap();
    run(&mut sumo, 1, |_, frame| counts.push(frame.signals.len()));
    assert_eq!((counts[0], counts[3]), (LIGHTS, LIGHTS), "{counts:?}");
    assert!(counts[1] < LIGHTS && counts[2] < LIGHTS, "{counts:?}");
}
