//! Ticks of messages between vehicles on an empty plane, or with a house on it.

#![allow(clippy::unwrap_used, clippy::panic, reason = "tests assert by unwrapping")]

mod common;

use std::sync::Arc;

use common::{car, config, projection};

use ipc_schema::{
    config::{Config, RoadsideService, RoadsideUnitConfig, V2xAwareness, V2xListing},
    header::{FIRST_OF_EPISODE, MessageHeader},
    neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighboursSections, RADIO_COLUMNS},
    traffic::{Kind, class_number},
    world::VehicleState,
};
use sim_core::scene::{Prism, Road, Scene, SolidClass};
use v2x::{
    exchange::{MessageExchange, SlotMeasurement},
    message::{
        StationKind,
        cam::Cam,
        cpm::{Cpm, CpmOrigin},
        geonetworking,
        roadside_cam::RoadsideCam,
    },
    station::{OwnMeasurement, station_id},
};

const NEAREST: usize = 8;

/// What each slot received, tick by tick.
#[derive(Debug, Clone, PartialEq)]
struct Block {
    objects: Vec<[f32; NEIGHBOUR_COLUMNS]>,
    ids: Vec<[u32; NEIGHBOUR_ID_COLUMNS]>,
    radio: Vec<[u32; RADIO_COLUMNS]>,
    channel_load: Vec<f32>,
}

impl Block {
    /// Objects that a slot knows, with the identity of each.
    fn of(&self, slot: usize) -> Vec<([f32; NEIGHBOUR_COLUMNS], [u32; NEIGHBOUR_ID_COLUMNS])> {
        let places = slot * NEAREST..(slot + 1) * NEAREST;
        let rows = places.map(|place| (self.objects[place], self.ids[place]));
        rows.filter(|(_, ids)| ids[2] != 0).collect()
    }
}

/// Runs `ticks` ticks of cars that drive to the east. Every car has the slot of its number and measures without errors.
fn run(config: &Config, houses: Vec<Prism>, cars: &[VehicleState], ticks: u64) -> (Vec<Block>, MessageExchange) {
    run_with(config, houses, cars, ticks, |_, _| 0.0)
}

/// The same with the acceleration in m/s² that the car of a number measures at a tick.
fn run_with(
    config: &Config,
    houses: Vec<Prism>,
    cars: &[VehicleState],
    ticks: u64,
    accel_mps2: impl Fn(u32, u64) -> f64,
) -> (Vec<Block>, MessageExchange) {
    let scene = Arc::new(Scene::new(Road::default(), houses, Vec::new()));
    let mut exchange = MessageExchange::new(config, vec![(scene, projection())]);
    let blocks = (0..ticks).map(|tick| {
        let moved: Vec<VehicleState> = cars
            .iter()
            .map(|car| VehicleState {
                x_m: car.x_m + 0.1 * tick as f64 * f64::from(car.velocity_body_mps[0]),
                ..*car
            })
            .collect();
        let slots: Vec<SlotMeasurement> = moved
            .iter()
            .map(|car| SlotMeasurement {
                vehicle: car.vehicle,
                id_hash: car.id_hash,
                episode_step: tick as u32,
                own: Some(OwnMeasurement {
                    fix_m: [car.x_m, car.y_m],
                    accuracy_m: Some(1.0),
                    speed_mps: car.velocity_body_mps[0].into(),
                    accel_mps2: accel_mps2(car.vehicle, tick),
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
        let count = slots.len();
        let mut block = Block {
            objects: vec![[0.0; NEIGHBOUR_COLUMNS]; count * NEAREST],
            ids: vec![[0; NEIGHBOUR_ID_COLUMNS]; count * NEAREST],
            radio: vec![[0; RADIO_COLUMNS]; count],
            channel_load: vec![0.0; count],
        };
        let mut sections = NeighboursSections {
            objects: &mut block.objects,
            ids: &mut block.ids,
            radio: &mut block.radio,
            channel_load: &mut block.channel_load,
            vehicle: &mut vec![0; count],
            speech: &mut [],
            achieved: &mut [],
        };
        exchange.receive(&header, &slots, &moved, &mut sections);
        exchange.send(&header, &slots, &moved);
        block
    });
    let blocks = blocks.collect();
    (blocks, exchange)
}

#[test]
fn what_a_car_measures_reaches_the_other_a_tick_later() {
    let cars = [car(0, 0.0, 0.0, 10.0), car(1, 80.0, 30.0, 15.0)];
    let (blocks, exchange) = run(&config(), Vec::new(), &cars, 3);
    assert!(blocks[0].of(0).is_empty());
    let [(numbers, ids)] = blocks[1].of(0)[..] else {
        panic!("{blocks:?}")
    };
    let station = station_id(cars[1].id_hash);
    assert_eq!(ids, [station, station, 1]);
    // Centre of the car at tick 0: 1.25 m before its rear axle. A unit of a message is 1.1 cm, and 10 cm of length.
    let expected = [81.25, 30.0, 15.0, 0.0, 0.0, 4.5, 1.8, 0.1];
    for (found, expected) in numbers.iter().zip(expected) {
        assert!((f64::from(*found) - expected).abs() < 0.03, "{numbers:?}");
    }
    // A distance of 1 m has 0.71 m on each axis.
    assert!((numbers[8] - 0.707).abs() < 0.01, "{numbers:?}");
    // Both sent and received one message of the same length.
    let [equipped, known, sent, bytes, received] = blocks[1].radio[0];
    assert_eq!([equipped, known, sent, received], [1, 1, 1, 1]);
    assert!((100..200).contains(&bytes), "{bytes}");
    // 4 m at 10 m/s take 0.5 s: nothing was sent at tick 1, and the age grows.
    assert_eq!(blocks[2].radio[0][2], 0);
    assert!((blocks[2].of(0)[0].0[7] - 0.2).abs() < 1e-3);
    assert_eq!(exchange.counts().cams, 2);
}

#[test]
fn a_house_is_between_two_cars_and_a_lorry_is_not_enough() {
    let cars = [car(0, 0.0, 0.0, 0.0), car(1, 200.0, 0.0, 0.0)];
    let outline = vec![[95.0, -20.0], [105.0, -20.0], [105.0, 20.0], [95.0, 20.0]];
    let house = Prism::new("house".into(), SolidClass::Building, outline, 0.0, 10.0).unwrap();
    let (blocks, _) = run(&config(), vec![house], &cars, 2);
    assert!(blocks[1].of(0).is_empty() && blocks[1].of(1).is_empty());
    let lorry = VehicleState {
        height_m: 3.5,
        ..car(2, 100.0, 0.0, 0.0)
    };
    let (blocks, _) = run(&config(), Vec::new(), &[cars[0], cars[1], lorry], 2);
    assert_eq!(blocks[1].of(0).len(), 2);
}

#[test]
fn a_car_without_a_radio_is_known_from_those_that_see_it() {
    let mut config = config();
    config.v2x.share = 0.5;
    config.v2x.perception_range_m = 60.0;
    config.v2x.perception_position_std_m = 0.0;
    config.v2x.perception_speed_std_mps = 0.0;
    let cars: Vec<VehicleState> = (0..12)
        .map(|number| car(number, 30.0 * f64::from(number), 0.0, 20.0))
        .collect();
    let (blocks, _) = run(&config, Vec::new(), &cars, 12);
    let last = blocks.last().unwrap();
    let equipped: Vec<usize> = (0..12).filter(|slot| last.radio[*slot][0] == 1).collect();
    assert!((2..11).contains(&equipped.len()), "{equipped:?}");
    let mut perceived = 0;
    for slot in 0..12 {
        if !equipped.contains(&slot) {
            assert!(last.of(slot).is_empty() && last.radio[slot][1..] == [0; 4]);
            continue;
        }
        for (numbers, ids) in last.of(slot).iter().filter(|(_, ids)| ids[2] == 2) {
            // Where one of the cars was when it was measured.
            let age_s = f64::from(numbers[7]);
            let at = |car: &VehicleState| car.x_m + 1.25 + 20.0 * (1.1 - age_s);
            let nearest_m = cars
                .iter()
                .map(|car| (at(car) - f64::from(numbers[0])).abs())
                .fold(f64::MAX, f64::min);
            assert!(nearest_m < 0.1 && ids[0] == 0, "{nearest_m} m: {numbers:?}");
            assert!((f64::from(numbers[2]) - 20.0).abs() < 0.02);
            perceived += 1;
        }
    }
    assert!(perceived > 0);
}

#[test]
fn a_pedestrian_with_a_phone_is_known_from_its_own_messages() {
    let mut config = config();
    let person = VehicleState {
        kind: Kind::Person as u32,
        length_m: 0.5,
        width_m: 0.5,
        height_m: 1.7,
        rear_overhang_m: 0.0,
        ..car(1, 30.0, 5.0, 1.5)
    };
    let cars = [car(0, 0.0, 0.0, 0.0), person];
    let (blocks, exchange) = run(&config, Vec::new(), &cars, 3);
    assert!(blocks[2].of(0).is_empty() && exchange.counts().vams == 0);
    config.v2x.vam = true;
    // 1.5 m/s are 4 m in 2.7 s: three messages in 6 s, after which the lifetime of one has passed.
    let (blocks, exchange) = run(&config, Vec::new(), &cars, 60);
    assert_eq!((exchange.counts().vams, blocks[1].radio[1][0]), (3, 1));
    let [(numbers, ids)] = blocks[1].of(0)[..] else {
        panic!("{:?}", blocks[1])
    };
    let station = station_id(cars[1].id_hash);
    assert_eq!(ids, [station, station, 3]);
    // A phone states no speed; the size is that of a person.
    let expected = [30.0, 5.0, 0.0, 0.0, 0.0, 0.5, 0.5, 0.1];
    for (found, expected) in numbers.iter().zip(expected) {
        assert!((f64::from(*found) - expected).abs() < 0.03, "{numbers:?}");
    }
    assert_eq!(blocks[1].of(1).len(), 1);
    assert!(blocks[20].of(0).is_empty() && blocks[28].of(0).len() == 1);
}

#[test]
fn basic_safety_messages_take_the_place_of_cams() {
    let mut config = config();
    config.v2x.awareness = V2xAwareness::Bsm;
    let cars = [car(0, 0.0, 0.0, 10.0), car(1, 80.0, 30.0, 15.0)];
    let (blocks, exchange) = run(&config, Vec::new(), &cars, 3);
    assert_eq!((exchange.counts().cams, exchange.counts().bsms), (0, 6));
    let [(numbers, ids)] = blocks[2].of(0)[..] else {
        panic!("{blocks:?}")
    };
    let station = station_id(cars[1].id_hash);
    assert_eq!(ids, [station, station, 4]);
    // Measured at tick 1.
    let expected = [82.75, 30.0, 15.0, 0.0, 0.0, 4.5, 1.8, 0.1];
    for (found, expected) in numbers.iter().zip(expected) {
        assert!((f64::from(*found) - expected).abs() < 0.03, "{numbers:?}");
    }
    // 37 bytes of core data, three of their frame, four of the short header, and what is around them on air.
    assert_eq!(blocks[2].radio[0][3], 37 + 3 + 4 + 38);
}

#[test]
fn stations_name_the_kind_of_vehicle_that_they_are() {
    let mut config = config();
    config.v2x.pcap = true;
    let expected = [
        ("passenger", 5),
        ("delivery", 7),
        ("truck", 8),
        ("trailer", 8),
        ("bus", 6),
        ("tram", 11),
        ("motorcycle", 4),
        ("moped", 3),
        ("bicycle", 2),
        ("scooter", 12),
        ("emergency", 10),
        ("ship", 0),
    ];
    let cars: Vec<VehicleState> = (0..)
        .zip(expected)
        .map(|(number, (class, _))| VehicleState {
            class: class_number(class),
            ..car(number, 40.0 * f64::from(number), 0.0, 10.0)
        })
        .collect();
    let (_, exchange) = run(&config, Vec::new(), &cars, 1);
    let sent = |number: usize| {
        let station = station_id(cars[number].id_hash);
        let packets = exchange.on_air().iter();
        let heads = packets.map(|sent| geonetworking::decode(&sent.packet).unwrap());
        let mut cams = heads.filter_map(|(head, message)| Some((head.kind, Cam::decode(message).ok()?)));
        cams.find(|(_, cam)| cam.station == station).unwrap()
    };
    for (number, (class, kind)) in expected.into_iter().enumerate() {
        let (head, cam) = sent(number);
        assert_eq!((head, cam.kind.0), (kind, kind), "{class}");
    }
    // The class names no kind: the length decides.
    assert_eq!(StationKind::of_vehicle("ignoring", 7.1), StationKind::HEAVY_TRUCK);
    assert_eq!(StationKind::of_vehicle("custom1", 4.0), StationKind::PASSENGER_CAR);
}

#[test]
fn emergency_braking_is_warned_of_where_it_is_configured() {
    let cars = [car(0, 0.0, 0.0, 20.0), car(1, 80.0, 0.0, 20.0)];
    // The second car brakes hard from 0.2 s to 0.5 s, and accelerates at 0.8 s.
    let brakes = |number: u32, tick: u64| match (number, tick) {
        (1, 2..=5) => -8.0,
        (1, 8) => 1.0,
        _ => 0.0,
    };
    let (blocks, exchange) = run_with(&config(), Vec::new(), &cars, 12, brakes);
    assert_eq!(exchange.counts().denms, 0);
    let mut config = config();
    config.v2x.denm = true;
    let (warned, exchange) = run_with(&config, Vec::new(), &cars, 12, brakes);
    // New at 0.2 s, repeated five times, and cancelled at 0.8 s.
    assert_eq!(exchange.counts().denms, 7);
    let sent = |blocks: &[Block]| -> Vec<u32> { blocks.iter().map(|block| block.radio[1][2]).collect() };
    let more: Vec<u32> = sent(&warned).iter().zip(sent(&blocks)).map(|(a, b)| a - b).collect();
    assert_eq!(more, [0, 0, 0, 1, 1, 1, 1, 1, 1, 1, 0, 0]);
    // Maps are of objects: a warning adds none.
    assert!(warned.iter().zip(&blocks).all(|(a, b)| a.of(0).len() == b.of(0).len()));
}

fn roadside(id: &str, x_m: f64, y_m: f64, services: &[RoadsideService]) -> RoadsideUnitConfig {
    RoadsideUnitConfig {
        id: id.into(),
        x_m,
        y_m,
        height_m: 6.0,
        range_m: Some(60.0),
        heading_deg: None,
        field_of_view_deg: None,
        services: Some(services.to_vec()),
    }
}

/// A house between (0, 0) and (200, 0).
fn house_between() -> Prism {
    let outline = vec![[95.0, -20.0], [105.0, -20.0], [105.0, 20.0], [95.0, 20.0]];
    Prism::new("house".into(), SolidClass::Building, outline, 0.0, 10.0).unwrap()
}

#[test]
fn a_roadside_unit_makes_known_what_it_perceives_and_adds_no_row() {
    let mut config = config();
    config.v2x.perception_position_std_m = 0.0;
    config.v2x.perception_speed_std_mps = 0.0;
    config.v2x.roadside = vec![roadside(
        "corner",
        150.0,
        30.0,
        &[RoadsideService::Cam, RoadsideService::Cpm],
    )];
    config.v2x.pcap = true;
    // Radios: two of three. The third is behind the house, and in the unit's sight.
    config.v2x.share = 1.0;
    let cars = [car(0, 150.0, 0.0, 0.0), car(1, 10.0, 0.0, 0.0)];
    let silent = run(&config, vec![house_between()], &cars, 1).1;
    let [cam, cpm] = [0, 1].map(|place| {
        let unit = silent.on_air().iter().filter(|sent| {
            let (head, _) = geonetworking::decode(&sent.packet).unwrap();
            head.kind == 15
        });
        unit.map(|sent| geonetworking::decode(&sent.packet).unwrap().1.to_vec())
            .nth(place)
            .unwrap()
    });
    assert!(RoadsideCam::decode(&cam).unwrap().position.accuracy_cm == Some(1));
    let cpm = Cpm::decode(&cpm).unwrap();
    assert_eq!((cpm.origin, cpm.objects.len()), (CpmOrigin::Roadside, 1));
    assert_eq!(cpm.sensor.unwrap().range_10cm, 600);
    // The car's centre is 1.25 m before its rear axle, and the unit's place is exact.
    assert_eq!(cpm.objects[0].position_cm, [125, -3000]);
    let (blocks, exchange) = run(&config, vec![house_between()], &cars, 12);
    // One CAM at 0 s and 1 s; a CPM whenever the object or the sensor information is due.
    let counts = exchange.counts();
    assert_eq!((counts.roadside_sent, counts.cams), (4, 6), "{counts:?}");
    assert!(counts.roadside_received >= 2, "{counts:?}");
    // No row is its own, and no map lists it.
    assert!(blocks.iter().all(|block| block.radio.len() == 2));
    let names: Vec<u32> = cars.iter().map(|car| station_id(car.id_hash)).collect();
    for (_, ids) in blocks.iter().flat_map(|block| [block.of(0), block.of(1)].concat()) {
        assert!(ids[0] == 0 || names.contains(&ids[0]), "{ids:?}");
    }
}

#[test]
fn a_roadside_unit_sees_its_field_of_view() {
    let mut config = config();
    config.v2x.pcap = true;
    let seen = |heading_deg, field_of_view_deg| {
        let mut config = config.clone();
        config.v2x.roadside = vec![RoadsideUnitConfig {
            heading_deg: Some(heading_deg),
            field_of_view_deg,
            ..roadside("corner", 0.0, 0.0, &[RoadsideService::Cpm])
        }];
        let cars = [car(0, 30.0, 0.0, 0.0), car(1, 0.0, -30.0, 0.0), car(2, -80.0, 0.0, 0.0)];
        let exchange = run(&config, Vec::new(), &cars, 1).1;
        let mut sent = exchange.on_air().iter().filter_map(|sent| {
            let (_, message) = geonetworking::decode(&sent.packet).ok()?;
            Cpm::decode(message).ok()
        });
        let cpm = sent.next().unwrap();
        let opening = cpm.sensor.unwrap().opening;
        let objects: Vec<u16> = cpm.objects.iter().map(|object| object.object).collect();
        (objects, opening)
    };
    assert_eq!(seen(0.0, None), (vec![0, 1], None));
    assert_eq!(seen(0.0, Some(90.0)), (vec![0], Some([3150, 450])));
    assert_eq!(seen(-90.0, Some(60.0)), (vec![1], Some([2400, 3000])));
    assert_eq!(seen(90.0, Some(90.0)), (vec![], Some([450, 1350])));
}

#[test]
fn a_warning_reaches_behind_a_house_by_a_roadside_unit_once() {
    let mut config = config();
    config.v2x.denm = true;
    config.v2x.pcap = true;
    config.v2x.roadside = vec![roadside("corner", 100.0, 60.0, &[RoadsideService::Denm])];
    let cars = [car(0, 0.0, 0.0, 20.0), car(1, 150.0, 0.0, 0.0)];
    let brakes = |number: u32, tick: u64| if number == 0 && tick <= 3 { -8.0 } else { 0.0 };
    let received = |config: &Config| {
        let (blocks, exchange) = run_with(config, vec![house_between()], &cars, 8, brakes);
        let of_second: u32 = blocks.iter().map(|block| block.radio[1][4]).sum();
        (of_second, exchange.counts())
    };
    let (heard, counts) = received(&config);
    // Repetitions of the same warning are not sent once more.
    assert_eq!(counts.roadside_sent, 1, "{counts:?}");
    config.v2x.roadside.clear();
    let (before, alone) = received(&config);
    assert_eq!((heard, counts.denms), (before + 1, alone.denms + 1), "{counts:?}");
}

#[test]
fn an_edge_service_tells_behind_a_house_what_it_hears_fused_under_numbers_that_stay() {
    let mut config = config();
    config.v2x.pcap = true;
    config.v2x.perception_range_m = 40.0;
    config.v2x.perception_position_std_m = 0.2;
    // Two cars on this side of the house, one on the other. The unit hears all of them and perceives nothing.
    let cars = [car(0, 0.0, 0.0, 10.0), car(1, 20.0, 3.0, 10.0), car(2, 150.0, 0.0, 0.0)];
    let unit = |id: &str, services: &[RoadsideService]| RoadsideUnitConfig {
        range_m: None,
        ..roadside(id, 100.0, 60.0, services)
    };
    let listed = |config: &Config| {
        let blocks = run(config, vec![house_between()], &cars, 14).0;
        blocks[13].of(2)
    };
    config.v2x.roadside = vec![unit("edge", &[RoadsideService::Cam])];
    assert!(listed(&config).is_empty());
    // A second unit hears the first: what was fused is not fused again.
    config.v2x.roadside = vec![
        unit("edge", &[RoadsideService::Map]),
        unit("other", &[RoadsideService::Map]),
    ];
    let known = listed(&config);
    assert_eq!(known.len(), 2, "{known:?}");
    for (numbers, ids) in &known {
        assert_eq!((ids[0], ids[2]), (0, 2), "a perceived object: {ids:?}");
        // Their centres after 1.3 s are 1.25 m before rear axles that have driven 13 m.
        let age_s = numbers[7];
        let now_m = [numbers[0] + age_s * numbers[2], numbers[1] + age_s * numbers[3]];
        let away_m =
            [[14.25, 0.0], [34.25, 3.0]].map(|place: [f32; 2]| libm::hypotf(now_m[0] - place[0], now_m[1] - place[1]));
        assert!(away_m.iter().any(|away_m| *away_m < 0.5), "{numbers:?}");
        // One fix of 0.71 m and a view of 0.2 m over another fix of 0.71 m, and the way since.
        assert!((0.4..0.71).contains(&numbers[8]), "{numbers:?}");
    }
    // The same numbers in every message.
    let exchange = run(&config, vec![house_between()], &cars, 14).1;
    let numbers: Vec<Vec<u16>> = exchange
        .on_air()
        .iter()
        .filter_map(|sent| Cpm::decode(geonetworking::decode(&sent.packet).ok()?.1).ok())
        .filter(|cpm| cpm.origin == CpmOrigin::Roadside)
        .map(|cpm| cpm.objects.iter().map(|object| object.object).collect())
        .collect();
    assert!(numbers.iter().flatten().all(|number| *number < 4), "{numbers:?}");
}

#[test]
fn a_separate_listing_has_every_view_and_ones_own() {
    let mut config = config();
    config.v2x.listing = V2xListing::Separate;
    config.v2x.perception_range_m = 60.0;
    config.v2x.perception_position_std_m = 0.0;
    config.v2x.perception_speed_std_mps = 0.0;
    let cars = [car(0, 0.0, 0.0, 0.0), car(1, 40.2, 3.0, 0.0)];
    let (blocks, _) = run(&config, Vec::new(), &cars, 2);
    let [own, other] = [0, 1].map(|slot: usize| station_id(cars[slot].id_hash));
    let mut found: Vec<([u32; 3], [i32; 2])> = blocks[1]
        .of(0)
        .iter()
        .map(|(numbers, ids)| (*ids, [0, 1].map(|axis: usize| numbers[axis].round() as i32)))
        .collect();
    found.sort_unstable();
    let mut expected = [
        // The other's CAM, its centre; its CPM, of itself (its front) and of this car; own sensors, from the own front, and the other.
        ([other, other, 1], [41, 3]),
        ([other, other, 2], [44, 3]),
        ([0, other, 2], [1, 0]),
        ([own, own, 5], [4, 0]),
        ([0, own, 5], [41, 3]),
    ];
    expected.sort_unstable();
    assert_eq!(found, expected);
}

#[test]
fn the_number_of_threads_changes_nothing() {
    let blocks = |threads| {
        let mut config = config();
        config.v2x.threads = threads;
        config.v2x.fading = true;
        config.v2x.perception_range_m = 50.0;
        config.v2x.roadside = vec![
            roadside("a", 100.0, 20.0, &RoadsideService::ALL),
            roadside("b", 200.0, 20.0, &RoadsideService::ALL),
        ];
        let cars: Vec<VehicleState> = (0..80)
            .map(|number| {
                car(
                    number,
                    17.0 * f64::from(number % 20),
                    12.0 * f64::from(number / 20),
                    (number % 7) as f32 * 5.0,
                )
            })
            .collect();
        let (blocks, exchange) = run(&config, Vec::new(), &cars, 15);
        (blocks, exchange.counts())
    };
    let one = blocks(1);
    assert!(one.1.received > 1000 && one.1.cpms > 50, "{:?}", one.1);
    assert_eq!(one, blocks(2));
    assert_eq!(one, blocks(4));
}
