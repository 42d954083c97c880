//! Frames between SUMO's steps, on a net with netconvert's default corners.

use std::{collections::BTreeMap, path::Path};

use crate::support::{Bench, own_options, sumo_home};
use traffic_bridge::sumo::{
    Sumo,
    connected::ConnectedRule,
    frame::TrafficFrame,
    inputs::{attribute, for_each_element},
    interpolation::StepInterpolation,
    options::SumoOptions,
};

const STEP_S: f64 = 1.0;
const FRAMES: u64 = 10;

/// The segments of all lanes of a net.
fn segments(net: &Path) -> Vec<[[f64; 2]; 2]> {
    let mut segments = Vec::new();
    for_each_element(net, |element| {
        if element.name().as_ref() == "lane"
            && let Some(shape) = attribute(element, "shape")
        {
            let points: Vec<[f64; 2]> = shape
                .split(' ')
                .map(|point| {
                    let mut numbers = point.split(',').map(|number| number.parse().unwrap());
                    [numbers.next().unwrap(), numbers.next().unwrap()]
                })
                .collect();
            segments.extend(points.windows(2).map(|pair| [pair[0], pair[1]]));
        }
    })
    .unwrap();
    segments
}

/// Distance of a point from the nearest segment, metres.
fn distance_m(segments: &[[[f64; 2]; 2]], [x, y]: [f64; 2]) -> f64 {
    let to = |[from, to]: &[[f64; 2]; 2]| {
        let line = [to[0] - from[0], to[1] - from[1]];
        let square = line[0] * line[0] + line[1] * line[1];
        let along = ((x - from[0]) * line[0] + (y - from[1]) * line[1]) / square;
        let share = along.clamp(0.0, 1.0);
        (x - from[0] - share * line[0]).hypot(y - from[1] - share * line[1])
    };
    segments.iter().map(to).fold(f64::INFINITY, f64::min)
}

#[test]
fn at_steps_of_a_second_vehicles_stay_on_their_lanes_between_the_steps() {
    let bench = Bench::new();
    let net = bench.default_grid();
    let sumocfg = bench.crossing_scenario(&net);
    let output = bench.folder.path().join("out");
    let rule = ConnectedRule::connected(1.0);
    let own = own_options(&net, &[]);
    let options = SumoOptions::scenario(&sumo_home(), &sumocfg, &own, &output, STEP_S, 1, rule).unwrap();
    let mut sumo = Sumo::start(options).unwrap();
    let mut between = StepInterpolation::new(sumo.read_lanes().unwrap(), FRAMES, STEP_S);
    let segments = segments(&net);
    let (mut frame, mut part) = (TrafficFrame::default(), TrafficFrame::default());
    let mut last: BTreeMap<u32, [f64; 2]> = BTreeMap::new();
    let mut before: BTreeMap<u32, [f64; 2]> = BTreeMap::new();
    let (mut worst_m, mut worst_straight_m, mut compared, mut jumps, mut left) = (0.0_f64, 0.0_f64, 0, 0, 0);
    for _ in 0..200 {
        sumo.step(&mut frame).unwrap();
        between.take_step(&frame);
        let now: BTreeMap<u32, [f64; 2]> = frame
            .states
            .iter()
            .map(|state| (state.vehicle, [state.front_x_m, state.front_y_m]))
            .collect();
        for number in 1..=FRAMES {
            let frame = if number == FRAMES {
                &frame
            } else {
                between.fill(number, &mut part);
                &part
            };
            for state in &frame.states {
                let here = [state.front_x_m, state.front_y_m];
                let speed_mps = f64::from(state.speed_mps);
                if let Some(there) = last.insert(state.vehicle, here) {
                    let moved_m = (here[0] - there[0]).hypot(here[1] - there[1]);
                    jumps += u32::from(moved_m > 0.1 * speed_mps + 0.3);
                }
                if number < FRAMES {
                    worst_m = worst_m.max(distance_m(&segments, here));
                    compared += 1;
                    match (before.get(&state.vehicle), now.get(&state.vehicle)) {
                        (Some(from), Some(to)) => {
                            let share = number as f64 / FRAMES as f64;
                            let straight = [0, 1].map(|axis: usize| from[axis] + share * (to[axis] - from[axis]));
                            worst_straight_m = worst_straight_m.max(distance_m(&segments, straight));
                        }
                        _ => left += 1,
                    }
                }
            }
        }
        before = now;
    }
    assert!(compared > 10_000, "{compared} states");
    assert!(left > 100, "{left} states of vehicles that roll out");
    assert!(
        worst_straight_m > 1.0,
        "the net's corners show nothing: {worst_straight_m} m"
    );
    assert!(worst_m < 0.05, "{worst_m} m from a lane");
    assert_eq!(jumps, 0, "one lane in each direction");
}
