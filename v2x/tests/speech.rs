//! The messages task: what a policy sees, what its choices become, and what messages achieve, on an empty plane or beside a house.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]

mod common;

use std::sync::Arc;

use common::projection;

use ipc_schema::{
    config::{Config, TaskKind, V2xInclusion},
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{
        ACHIEVED_COLUMNS, CANDIDATE_COLUMNS, NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighboursSections,
        RADIO_COLUMNS, SPEAKER_COLUMNS, speech_width,
    },
    world::VehicleState,
};
use sim_core::scene::{Prism, Road, Scene, SolidClass};
use v2x::{
    exchange::{MessageExchange, SlotMeasurement, speech::SpeechCounts},
    station::OwnMeasurement,
};

const CANDIDATES: usize = 4;
const TOLD: usize = 0;
const BYTES: usize = 1;
const KNOWN: usize = 2;
const IN_RANGE: usize = 3;

fn config(inclusion: V2xInclusion) -> Config {
    let mut config = common::config();
    config.task.kind = TaskKind::Messages;
    config.v2x.inclusion = inclusion;
    config.v2x.candidates = CANDIDATES as u32;
    config.v2x.perception_range_m = 60.0;
    config.v2x.perception_position_std_m = 0.0;
    config.v2x.perception_speed_std_mps = 0.0;
    config
}

/// A car that stands.
fn car(number: u32, x_m: f64, y_m: f64) -> VehicleState {
    common::car(number, x_m, y_m, 0.0)
}

struct Tick {
    speech: Vec<f32>,
    achieved: Vec<[f32; ACHIEVED_COLUMNS]>,
}

impl Tick {
    fn speaker(&self, slot: usize) -> &[f32] {
        &self.speech[slot * speech_width(CANDIDATES)..][..SPEAKER_COLUMNS]
    }

    fn candidate(&self, slot: usize, place: usize) -> &[f32] {
        let at = slot * speech_width(CANDIDATES) + SPEAKER_COLUMNS + place * CANDIDATE_COLUMNS;
        &self.speech[at..at + CANDIDATE_COLUMNS]
    }
}

/// Runs cars that stand, of which the first `sensing` have slots. At each tick `choose` gives the bits of a slot.
fn run(
    config: &Config,
    houses: Vec<Prism>,
    cars: &[VehicleState],
    sensing: usize,
    ticks: u64,
    choose: impl Fn(u64, usize) -> u32,
) -> (Vec<Tick>, SpeechCounts) {
    let scene = Arc::new(Scene::new(Road::default(), houses, Vec::new()));
    let mut exchange = MessageExchange::new(config, vec![(scene, projection())]);
    let mut found = Vec::new();
    for tick in 0..ticks {
        let slots: Vec<SlotMeasurement> = cars[..sensing]
            .iter()
            .map(|car| SlotMeasurement {
                vehicle: car.vehicle,
                id_hash: car.id_hash,
                episode_step: tick as u32,
                own: Some(OwnMeasurement {
                    fix_m: [car.x_m, car.y_m],
                    accuracy_m: Some(1.0),
                    ..OwnMeasurement::default()
                }),
            })
            .collect();
        let header = MessageHeader {
            flags: if tick == 0 { FIRST_OF_EPISODE } else { 0 },
            episode_seed: 11,
            tick,
            sim_time_ns: tick * 100_000_000,
            ..MessageHeader::default()
        };
        let nearest = config.v2x.neighbours as usize;
        let mut out = Tick {
            speech: vec![0.0; sensing * speech_width(CANDIDATES)],
            achieved: vec![[0.0; ACHIEVED_COLUMNS]; sensing],
        };
        let mut sections = NeighboursSections {
            objects: &mut vec![[0.0; NEIGHBOUR_COLUMNS]; sensing * nearest],
            ids: &mut vec![[0; NEIGHBOUR_ID_COLUMNS]; sensing * nearest],
            radio: &mut vec![[0; RADIO_COLUMNS]; sensing],
            channel_load: &mut vec![0.0; sensing],
            vehicle: &mut vec![0; sensing],
            speech: &mut out.speech,
            achieved: &mut out.achieved,
        };
        exchange.receive(&header, &slots, cars, &mut sections);
        if config.v2x.inclusion == V2xInclusion::Policy {
            (0..sensing).for_each(|slot| exchange.choose(slot, choose(tick, slot)));
        }
        exchange.send(&header, &slots, cars);
        found.push(out);
    }
    (found, exchange.speech_counts())
}

/// Slot 0 is at 0 m, slot 1 at 50 m, and the car without a slot at 95 m: in range of both, within 60 m of slot 1 alone.
fn row_of_three() -> Vec<VehicleState> {
    vec![car(0, 0.0, 0.0), car(1, 50.0, 4.0), car(2, 95.0, 0.0)]
}

#[test]
fn a_message_achieves_the_time_for_which_others_newly_know() {
    // Slot 1 lists all that it perceives at ticks 0, 5 and 13.
    let tells = |tick: u64, slot: usize| {
        let is_time = slot == 1 && [0, 5, 13].contains(&tick);
        if is_time { u32::MAX } else { 0 }
    };
    let (ticks, counts) = run(&config(V2xInclusion::Policy), Vec::new(), &row_of_three(), 2, 32, tells);
    // Slot 0 perceives slot 1 itself, and slot 1 perceives both others. Only the third car is news, and only to slot 0.
    let known: Vec<f32> = ticks.iter().map(|tick| tick.achieved[0][KNOWN]).collect();
    assert_eq!(ticks[0].achieved[0][KNOWN..], [1.0, 2.0]);
    assert_eq!(ticks[0].achieved[1][KNOWN..], [2.0, 2.0]);
    // Measured at tick 0, it lives for 1.5 s: at tick 1 there are 1.4 s left. At tick 6 it would be known for 0.9 s more: no news. At
    // tick 14 what was told at tick 5 has 0.6 s left; told at tick 13 it is none either.
    let told: Vec<(usize, f32)> = ticks
        .iter()
        .enumerate()
        .filter(|(_, tick)| tick.achieved[1][TOLD] > 0.0)
        .map(|(number, tick)| (number, tick.achieved[1][TOLD]))
        .collect();
    let [(1, first)] = told[..] else { panic!("{told:?}") };
    assert!((first - 1.4).abs() < 1e-3, "{told:?}");
    assert!(ticks.iter().all(|tick| tick.achieved[0][TOLD] == 0.0));
    // Known from tick 1 until 1.5 s after tick 13.
    let times: Vec<usize> = (0..known.len()).filter(|tick| known[*tick] == 2.0).collect();
    assert_eq!(times, (1..28).collect::<Vec<_>>());
    assert!((counts.told_s - 1.4).abs() < 1e-3, "{counts:?}");
    assert_eq!(counts.in_range, 32 * 4);
    assert_eq!(counts.known, 32 * 3 + 27);
}

#[test]
fn what_would_be_forgotten_in_0_3_s_is_news() {
    let told_at = |again: u64| {
        let tells = move |tick: u64, slot: usize| {
            if slot == 1 && [0, again].contains(&tick) {
                u32::MAX
            } else {
                0
            }
        };
        let (ticks, _) = run(&config(V2xInclusion::Policy), Vec::new(), &row_of_three(), 2, 20, tells);
        ticks[again as usize + 1].achieved[1][TOLD]
    };
    // Told at tick 0, it is known until tick 15. What is told at tick 11 arrives at tick 12, 0.3 s before that.
    assert_eq!([9, 10, 11].map(told_at), [0.0; 3]);
    // At tick 13 there are 0.2 s left: it is known for 1.2 s longer. At tick 16 it is forgotten, and known for 1.4 s.
    assert!((told_at(12) - 1.2).abs() < 1e-3 && (told_at(15) - 1.4).abs() < 1e-3);
}

#[test]
fn a_policy_cannot_fall_silent_but_says_no_more_than_it_chooses() {
    let (silent, counts) = run(
        &config(V2xInclusion::Policy),
        Vec::new(),
        &row_of_three(),
        2,
        21,
        |_, _| 0,
    );
    // Sensor information goes out once a second: at ticks 0, 10 and 20, of which 20 is not seen.
    let spoke: Vec<usize> = (0..21).filter(|tick| silent[*tick].achieved[1][BYTES] > 0.0).collect();
    assert_eq!(spoke, [1, 11]);
    assert_eq!((counts.told_s, counts.known), (0.0, 21 * 3));
    let (all, _) = run(&config(V2xInclusion::All), Vec::new(), &row_of_three(), 2, 21, |_, _| 0);
    assert!((1..21).all(|tick| all[tick].achieved[1][BYTES] > silent[1].achieved[1][BYTES]));
}

#[test]
fn stations_that_tell_the_same_share_what_it_achieves() {
    // Two cars beside each other perceive the third, and both tell slot 0 of it at tick 3.
    let cars = [
        car(0, 0.0, 0.0),
        car(1, 50.0, 4.0),
        car(2, 50.0, -4.0),
        car(3, 95.0, 0.0),
    ];
    let tells = |tick: u64, slot: usize| if tick == 3 && slot > 0 { u32::MAX } else { 0 };
    let (ticks, _) = run(&config(V2xInclusion::Policy), Vec::new(), &cars, 3, 6, tells);
    let shares = [1, 2].map(|slot: usize| ticks[4].achieved[slot][TOLD]);
    assert!(shares.iter().all(|share| (share - 0.7).abs() < 1e-3), "{shares:?}");
}

#[test]
fn a_row_of_speech_says_what_the_station_knows() {
    let tells = |tick: u64, slot: usize| if slot == 1 && tick == 2 { 0b10 } else { 0 };
    let (ticks, _) = run(&config(V2xInclusion::Policy), Vec::new(), &row_of_three(), 2, 9, tells);
    let [one, load, perceived, ..] = ticks[1].speaker(1) else {
        panic!()
    };
    assert_eq!((*one, *perceived), (1.0, 2.0 / 32.0));
    assert!((0.0..1.0).contains(load) && *load > 0.0, "{load}");
    // A message with sensor information is due at tick 0, and then after a second.
    assert_eq!([0, 1].map(|tick: usize| ticks[tick].speaker(1)[6]), [1.0, 0.0]);
    // The nearest is the car at 95 m: from the front at 53.5 m to its centre at 96.25 m, 4 m to the right.
    let [present, person, ahead, left, distance, ..] = ticks[0].candidate(1, 0) else {
        panic!()
    };
    assert_eq!((*present, *person), (1.0, 0.0));
    assert!((ahead - 0.4275).abs() < 1e-4 && (left + 0.04).abs() < 1e-4 && (distance - 0.4294).abs() < 1e-3);
    assert!(ticks[0].candidate(1, 2).iter().all(|number| *number == 0.0));
    // Nothing was told of either, nothing heard: all of it is 1. It does not speak for itself.
    assert_eq!(
        ticks[0].candidate(1, 0)[6..],
        [1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 1.0, 0.0, 0.0]
    );
    // Slot 0 spoke for itself at tick 0, and was told of at tick 2: 0.4 s later it stands where it stood.
    let [since, moved, faster, turned, astray, age, error, views, speaks] = ticks[6].candidate(1, 1)[6..] else {
        panic!()
    };
    assert!((since - 0.2).abs() < 1e-4 && (age - 0.3).abs() < 1e-4, "{since} {age}");
    assert_eq!([moved, faster, turned, astray], [0.0; 4]);
    assert!(
        error < 0.01 && views == 1.0 / 8.0 && speaks == 1.0,
        "{error} {views} {speaks}"
    );
    let quiet = run(
        &config(V2xInclusion::Policy),
        Vec::new(),
        &row_of_three(),
        1,
        2,
        |_, _| 0,
    );
    assert_eq!(quiet.0[0].speech.len(), speech_width(CANDIDATES));
}

#[test]
fn what_is_needed_is_told_once_by_the_nearest_that_is_heard() {
    let cars = [
        car(0, 0.0, 0.0),
        car(1, 40.0, 4.0),
        car(2, 52.0, -4.0),
        car(3, 95.0, 0.0),
    ];
    let (ticks, counts) = run(&config(V2xInclusion::Needed), Vec::new(), &cars, 3, 40, |_, _| 0);
    let (all, most) = run(&config(V2xInclusion::All), Vec::new(), &cars, 3, 40, |_, _| 0);
    // Slot 0 lacks the car at 95 m; slot 1 is nearer to it than slot 2 and perceives it. Once 1.5 s it is told.
    let told = ticks.iter().filter(|tick| tick.achieved[1][TOLD] > 0.0).count();
    assert!((2..=4).contains(&told), "{told}");
    assert!(ticks.iter().all(|tick| tick.achieved[2][TOLD] == 0.0));
    // From the first CAMs on everything is known all the time, for far fewer bytes.
    assert!(
        ticks[4..]
            .iter()
            .all(|tick| tick.achieved[0][KNOWN] == tick.achieved[0][IN_RANGE])
    );
    assert!(
        all[4..]
            .iter()
            .all(|tick| tick.achieved[0][KNOWN] == tick.achieved[0][IN_RANGE])
    );
    assert!(counts.cpm_bytes * 5 < most.cpm_bytes, "{counts:?} {most:?}");
}

#[test]
fn a_house_between_two_cars_hides_one_from_the_other() {
    let outline = vec![[25.0, -30.0], [30.0, -30.0], [30.0, 30.0], [25.0, 30.0]];
    let house = Prism::new("house".into(), SolidClass::Building, outline, 0.0, 10.0).unwrap();
    let (ticks, _) = run(
        &config(V2xInclusion::Standard),
        vec![house],
        &row_of_three(),
        2,
        2,
        |_, _| 0,
    );
    assert_eq!(ticks[0].achieved[0][KNOWN..], [0.0, 2.0]);
    assert_eq!(ticks[0].achieved[1][KNOWN..], [1.0, 2.0]);
}

#[test]
fn the_result_does_not_depend_on_threads() {
    let cars: Vec<VehicleState> = (0..80)
        .map(|number| car(number, f64::from(number % 10) * 14.0, f64::from(number / 10) * 9.0))
        .collect();
    let choose = |tick: u64, slot: usize| (tick as u32 * 7 + slot as u32) % 16;
    let run_with = |threads: u32| {
        let mut config = config(V2xInclusion::Policy);
        config.v2x.threads = threads;
        let (ticks, counts) = run(&config, Vec::new(), &cars, 80, 8, choose);
        let numbers: Vec<u32> = ticks
            .iter()
            .flat_map(|tick| tick.speech.iter().chain(tick.achieved.iter().flatten()))
            .map(|number| number.to_bits())
            .collect();
        (numbers, counts)
    };
    assert_eq!(run_with(1), run_with(2));
}
