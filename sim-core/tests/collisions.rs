//! Contacts: the narrow phase against parry3d, and the detector's events from tick to tick.

#![allow(clippy::unwrap_used, reason = "test code may assert by unwrapping")]

use std::sync::Arc;

use ipc_schema::{
    event::{Collision, Struck},
    props::PropKind,
    traffic::{Kind, id_hash},
    world::{COLLIDED, VehicleState, trailing_index},
};
use parry3d_f64::{
    math::{Pose, Vector},
    query::{distance, intersection_test},
    shape::{Capsule, ConvexPolyhedron, Cuboid, Shape},
};
use proptest::prelude::*;
use sim_core::{
    collision::{
        CollisionDetector,
        body::{CollisionBody, box_touches_prism, boxes_touch},
    },
    scene::{Prism, Prop, Road, Scene, SolidClass, shape::OrientedBox},
};

/// An upright box in parry's types.
fn cuboid(solid: &OrientedBox) -> (Pose, Cuboid) {
    let [l, w] = solid.half_m;
    let yaw = solid.along[1].atan2(solid.along[0]);
    let middle = 0.5 * (solid.z_m[0] + solid.z_m[1]);
    (
        Pose::new(
            Vector::new(solid.centre_m[0], solid.centre_m[1], middle),
            Vector::new(0.0, 0.0, yaw),
        ),
        Cuboid::new(Vector::new(l, w, 0.5 * (solid.z_m[1] - solid.z_m[0]))),
    )
}

/// True if the shapes touch. `None` if they are so close that rounding decides.
fn touch(p: &Pose, a: &dyn Shape, q: &Pose, b: &dyn Shape) -> Option<bool> {
    if intersection_test(p, a, q, b).unwrap().intersecting {
        // The contact must remain when one of them is moved a little.
        let clear = [
            [1e-5, 0.0, 0.0],
            [-1e-5, 0.0, 0.0],
            [0.0, 1e-5, 0.0],
            [0.0, -1e-5, 0.0],
            [0.0, 0.0, 1e-5],
            [0.0, 0.0, -1e-5],
        ]
        .iter()
        .all(|[x, y, z]| {
            let moved = Pose::from_parts(p.translation + Vector::new(*x, *y, *z), p.rotation);
            intersection_test(&moved, a, q, b).unwrap().intersecting
        });
        clear.then_some(true)
    } else {
        (distance(p, a, q, b).unwrap().distance > 1e-5).then_some(false)
    }
}

fn any_box() -> impl Strategy<Value = OrientedBox> {
    let place = prop::array::uniform2(-4.0_f64..4.0);
    (
        place,
        -3.1_f64..3.1,
        0.1_f64..4.0,
        0.1_f64..2.0,
        -3.0_f64..3.0,
        0.1_f64..3.0,
    )
        .prop_map(|(centre_m, yaw, l, w, z, height)| OrientedBox {
            centre_m,
            along: [yaw.cos(), yaw.sin()],
            half_m: [l, w],
            z_m: [z, z + height],
        })
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(4000))]

    #[test]
    fn boxes_touch_as_parry_says(a in any_box(), b in any_box()) {
        let ((p, c), (q, d)) = (cuboid(&a), cuboid(&b));
        if let Some(expected) = touch(&p, &c, &q, &d) {
            prop_assert_eq!(boxes_touch(&a, &b), expected);
            prop_assert_eq!(boxes_touch(&b, &a), expected);
        }
    }

    #[test]
    fn a_person_touches_a_box_as_parry_says(
        solid in any_box(), x in -6.0_f64..6.0, y in -6.0_f64..6.0, z in -4.0_f64..4.0, radius in 0.1_f64..0.5, height in 1.1_f64..2.0,
    ) {
        let person = CollisionBody {
            solid: OrientedBox { centre_m: [x, y], along: [1.0, 0.0], half_m: [radius; 2], z_m: [z, z + height] },
            is_capsule: true,
        };
        let vehicle = CollisionBody { solid, is_capsule: false };
        let capsule = Capsule::new_z(0.5 * height - radius, radius);
        let (q, c) = cuboid(&solid);
        let p = Pose::translation(x, y, z + 0.5 * height);
        if let Some(expected) = touch(&p, &capsule, &q, &c) {
            prop_assert_eq!(person.touches(&vehicle), expected);
            prop_assert_eq!(vehicle.touches(&person), expected);
            if expected {
                let [cx, cy, cz] = person.contact_m(&vehicle);
                prop_assert!((cx - x).hypot(cy - y) <= radius + 1e-9 && cz >= z - 1e-9 && cz <= z + height + 1e-9);
            }
        }
    }

    #[test]
    fn a_box_touches_a_convex_building_as_parry_says(
        solid in any_box(), points in prop::collection::vec(prop::array::uniform2(-3.0_f64..3.0), 4..9), z in -3.0_f64..3.0, height in 0.2_f64..3.0,
    ) {
        let hull = sim_core::scene::shape::hull(&points);
        prop_assume!(sim_core::scene::shape::signed_area(&hull) > 0.5);
        let corners: Vec<Vector> = hull.iter().flat_map(|[x, y]| [Vector::new(*x, *y, z), Vector::new(*x, *y, z + height)]).collect();
        let polyhedron = ConvexPolyhedron::from_convex_hull(&corners).unwrap();
        let (p, c) = cuboid(&solid);
        if let Some(expected) = touch(&p, &c, &Pose::identity(), &polyhedron) {
            prop_assert_eq!(box_touches_prism(&solid, &hull, [z, z + height]), expected);
        }
    }

    #[test]
    fn a_box_touches_an_l_as_parry_says_of_its_two_wings(solid in any_box(), arm in 0.5_f64..2.5) {
        let outline = [[-3.0, -3.0], [3.0, -3.0], [3.0, -3.0 + arm], [-3.0 + arm, -3.0 + arm], [-3.0 + arm, 3.0], [-3.0, 3.0]];
        let wing = |x: f64, y: f64, l: f64, w: f64| OrientedBox { centre_m: [x, y], along: [1.0, 0.0], half_m: [l, w], z_m: [0.0, 1.0] };
        let wings = [wing(0.0, -3.0 + 0.5 * arm, 3.0, 0.5 * arm), wing(-3.0 + 0.5 * arm, 0.0, 0.5 * arm, 3.0)];
        let (p, c) = cuboid(&solid);
        let says = wings.map(|wing| {
            let (q, d) = cuboid(&wing);
            touch(&p, &c, &q, &d)
        });
        if let [Some(one), Some(two)] = says {
            prop_assert_eq!(box_touches_prism(&solid, &outline, [0.0, 1.0]), one || two);
        }
    }
}

fn vehicle(index: u32, kind: Kind, x_m: f64, y_m: f64) -> VehicleState {
    VehicleState {
        x_m,
        y_m,
        id_hash: id_hash(&index.to_string()),
        length_m: 4.0,
        width_m: 2.0,
        height_m: 1.5,
        rear_overhang_m: 1.0,
        vehicle: index,
        kind: kind as u32,
        velocity_body_mps: [10.0, 0.0, 0.0],
        ..VehicleState::default()
    }
}

fn person(index: u32, x_m: f64, y_m: f64) -> VehicleState {
    VehicleState {
        x_m,
        y_m,
        length_m: 0.2,
        width_m: 0.5,
        height_m: 1.7,
        vehicle: index,
        kind: Kind::Person as u32,
        ..VehicleState::default()
    }
}

/// Runs one tick; returns the contacts that began, and the flagged vehicles.
fn tick(detector: &mut CollisionDetector, episode: u64, mut states: Vec<VehicleState>) -> (Vec<Collision>, Vec<u32>) {
    detector.detect(episode, &mut states);
    let flagged = states.iter().filter(|state| state.flags & COLLIDED != 0);
    (detector.begun().to_vec(), flagged.map(|state| state.vehicle).collect())
}

fn empty() -> CollisionDetector {
    CollisionDetector::new(Arc::new(Scene::default()))
}

#[test]
fn a_contact_is_reported_when_it_begins_and_again_after_it_has_ended() {
    let mut detector = empty();
    // Bodies reach from 1 m behind to 3 m ahead of the origin.
    let at = |gap_m: f64| {
        vec![
            vehicle(0, Kind::Cav, 0.0, 0.0),
            vehicle(1, Kind::Other, 4.0 + gap_m, 0.5),
        ]
    };
    assert_eq!(tick(&mut detector, 0, at(0.1)), (Vec::new(), Vec::new()));
    let (begun, flagged) = tick(&mut detector, 0, at(-0.5));
    assert_eq!((begun.len(), flagged), (1, vec![0, 1]));
    let event = begun[0];
    assert_eq!(
        (event.vehicle, event.other, event.other_class),
        (0, 1, Struck::Vehicle as u32)
    );
    assert_eq!((event.id_hash, event.other_id_hash), (id_hash("0"), id_hash("1")));
    assert_eq!(
        event.relative_speed_mps, 0.0,
        "both drive the same way at the same speed"
    );
    let expected = [2.75, 0.25, 0.75];
    assert!(
        (0..3).all(|axis| (event.position_m[axis] - expected[axis]).abs() < 1e-6),
        "{event:?}"
    );
    assert_eq!(tick(&mut detector, 0, at(-0.6)), (Vec::new(), Vec::new()), "it lasts");
    assert_eq!(tick(&mut detector, 0, at(0.1)), (Vec::new(), Vec::new()), "it ends");
    assert_eq!(tick(&mut detector, 0, at(-0.1)).0.len(), 1, "it begins again");
    assert_eq!(
        tick(&mut detector, 1, at(-0.1)).0.len(),
        1,
        "a new episode knows nothing of the last"
    );
}

#[test]
fn only_contacts_of_connected_vehicles_and_heroes_count() {
    let mut detector = empty();
    let others = vec![
        vehicle(0, Kind::Other, 0.0, 0.0),
        vehicle(1, Kind::Other, 1.0, 0.0),
        person(2, 1.0, 0.0),
        person(3, 1.0, 0.1),
    ];
    assert_eq!(tick(&mut detector, 0, others).0, Vec::new());
    let mut oncoming = vehicle(7, Kind::Hero, 2.0, 0.0);
    oncoming.yaw_rad = std::f64::consts::PI;
    let (begun, flagged) = tick(
        &mut detector,
        0,
        vec![person(3, 1.0, 0.0), vehicle(5, Kind::Other, 0.0, 0.0), oncoming],
    );
    let contacts: Vec<_> = begun
        .iter()
        .map(|event| (event.vehicle, event.other, event.other_class))
        .collect();
    assert_eq!(
        contacts,
        [(7, 5, Struck::Vehicle as u32), (7, 3, Struck::Person as u32)]
    );
    assert_eq!(flagged, [3, 5, 7]);
    assert!((begun[0].relative_speed_mps - 20.0).abs() < 1e-5, "head on");
    assert!((begun[1].relative_speed_mps - 10.0).abs() < 1e-5);
}

#[test]
fn two_watched_vehicles_have_one_event_of_the_lower_index() {
    let (begun, flagged) = tick(
        &mut empty(),
        0,
        vec![vehicle(4, Kind::Hero, 0.0, 0.0), vehicle(9, Kind::Cav, 1.0, 0.0)],
    );
    assert_eq!(begun.len(), 1);
    assert_eq!((begun[0].vehicle, begun[0].other, flagged), (4, 9, vec![4, 9]));
}

#[test]
fn a_vehicle_on_a_bridge_touches_nothing_below() {
    let mut detector = empty();
    let mut above = vehicle(1, Kind::Cav, 0.0, 0.0);
    above.z_m = 5.0;
    assert_eq!(
        tick(
            &mut detector,
            0,
            vec![vehicle(0, Kind::Cav, 0.0, 0.0), above, person(2, 1.0, 0.0)]
        )
        .0
        .len(),
        1
    );
    above.z_m = 1.4;
    assert_eq!(
        tick(&mut detector, 0, vec![vehicle(0, Kind::Cav, 0.0, 0.0), above])
            .0
            .len(),
        1
    );
}

#[test]
fn buildings_and_obstacles_are_struck_where_they_stand() {
    let house = Prism::new(
        "house".into(),
        SolidClass::Building,
        vec![[10.0, 0.0], [20.0, 0.0], [20.0, 10.0], [10.0, 10.0]],
        0.0,
        6.0,
    );
    let cone = Prop::new(PropKind::by_name("cone").unwrap(), [5.0, -20.0], 0.0, 0.0);
    let mut detector = CollisionDetector::new(Arc::new(Scene::new(
        Road::default(),
        house.into_iter().collect(),
        vec![cone],
    )));
    assert_eq!(
        tick(
            &mut detector,
            0,
            vec![vehicle(0, Kind::Cav, 6.9, 5.0), vehicle(1, Kind::Cav, 1.7, -20.0)]
        )
        .0,
        Vec::new()
    );
    let (begun, flagged) = tick(
        &mut detector,
        0,
        vec![vehicle(0, Kind::Cav, 7.5, 5.0), vehicle(1, Kind::Cav, 1.9, -20.0)],
    );
    let contacts: Vec<_> = begun
        .iter()
        .map(|e| (e.vehicle, e.other, e.other_class, e.other_id_hash))
        .collect();
    assert_eq!(
        contacts,
        [
            (0, 0, Struck::Building as u32, id_hash("house")),
            (1, 1, Struck::Obstacle as u32, id_hash("cone"))
        ]
    );
    assert_eq!(flagged, [0, 1]);
    assert_eq!(begun[0].relative_speed_mps, 10.0);
    let expected = [10.25, 5.0, 0.75];
    assert!(
        (0..3).all(|axis| (begun[0].position_m[axis] - expected[axis]).abs() < 1e-6),
        "{begun:?}"
    );
    // Inside without touching a wall; a lorry beyond the cells of its centre; a bus on the roof.
    let inside = vehicle(2, Kind::Cav, 14.0, 5.0);
    let mut lorry = vehicle(3, Kind::Cav, -40.0, 5.0);
    (lorry.length_m, lorry.rear_overhang_m) = (60.0, 2.0);
    let mut roof = vehicle(4, Kind::Cav, 14.0, 5.0);
    roof.z_m = 6.5;
    let (begun, _) = tick(&mut detector, 0, vec![inside, lorry, roof]);
    let building = begun
        .iter()
        .filter(|event| event.other_class == Struck::Building as u32);
    assert_eq!(building.map(|event| event.vehicle).collect::<Vec<_>>(), [2, 3]);
}

#[test]
fn events_are_the_same_in_every_run_and_sorted() {
    let crowd = |shift: f64| -> Vec<VehicleState> {
        (0..300)
            .map(|i| {
                let mut state = vehicle(i, if i % 3 == 0 { Kind::Cav } else { Kind::Other }, 0.0, 0.0);
                state.x_m = f64::from(i % 17) * 3.7 + shift;
                state.y_m = f64::from(i / 17) * 2.4;
                state.yaw_rad = f64::from(i % 7) * 0.4;
                state
            })
            .collect()
    };
    let run = || {
        let mut detector = empty();
        (0..5)
            .map(|i| tick(&mut detector, 0, crowd(f64::from(i) * 0.3)).0)
            .collect::<Vec<_>>()
    };
    let events = run();
    assert!(events[0].len() > 50);
    assert_eq!(events, run());
    assert!(
        events
            .iter()
            .all(|tick| tick.is_sorted_by_key(|event| (event.vehicle, event.other_class, event.other)))
    );
}

/// A trailing body of a vehicle, its middle at (x, y).
fn trailing(of: u32, place: u32, x_m: f64, y_m: f64) -> VehicleState {
    VehicleState {
        vehicle: trailing_index(of, place),
        kind: Kind::Trailing as u32,
        ..vehicle(of, Kind::Other, x_m, y_m)
    }
}

#[test]
fn a_vehicle_touches_with_any_of_its_bodies_and_they_do_not_touch_each_other() {
    // A train without sensors, whose bodies overlap at the joints, and a car with sensors that meets its last one.
    let bodies = |car_x_m: f64| {
        vec![
            vehicle(0, Kind::Cav, car_x_m, 0.0),
            vehicle(1, Kind::Other, 0.0, 0.0),
            trailing(1, 1, -4.0, 0.0),
            trailing(1, 2, -8.0, 0.0),
        ]
    };
    let mut detector = empty();
    assert_eq!(tick(&mut detector, 0, bodies(-20.0)).0, []);
    let (begun, flagged) = tick(&mut detector, 0, bodies(-11.0));
    let pairs: Vec<(u32, u32)> = begun.iter().map(|contact| (contact.vehicle, contact.other)).collect();
    assert_eq!(pairs, [(0, 1)], "the vehicles, and once");
    assert_eq!(flagged, [0, 1]);
    assert!(begun[0].position_m[0] < -8.0, "{:?}", begun[0].position_m);
    // Farther in it touches two of them: the contact lasts, and nothing begins.
    assert_eq!(tick(&mut detector, 0, bodies(-6.0)).0, []);
    // A connected vehicle's own bodies count as itself.
    let mut own = empty();
    let states = vec![
        vehicle(0, Kind::Cav, 0.0, 0.0),
        vehicle(1, Kind::Other, -9.0, 0.0),
        trailing(0, 1, -4.0, 0.0),
        trailing(0, 2, -8.0, 0.0),
    ];
    let (begun, flagged) = tick(&mut own, 0, states);
    assert_eq!((begun.len(), flagged), (1, vec![0, 1]));
    assert_eq!((begun[0].vehicle, begun[0].other), (0, 1));
}
