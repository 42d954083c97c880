//! The published curves: delivery, channel load, age, awareness, redundancy, sizes of CPMs, and the error of what is known.

use std::collections::BTreeMap;

use ipc_schema::{
    config::{Config, V2xListing},
    neighbours::{NEIGHBOUR_COLUMNS, NEIGHBOUR_ID_COLUMNS, NeighbourSource},
    world::VehicleState,
};
use serde::Serialize;
use v2x::{
    message::{
        cpm::Cpm,
        geonetworking::{self, BtpPort},
    },
    radio::{obstruction::body_of, reception::FRAME_BYTES},
    random::{LinkKey, RadioDraw, RadioRandom},
};

use crate::street::{BIN_M, DeliveredShare, StreetRun, StreetTick, count};

/// Distance within which a vehicle should know the others, metres.
const AWARENESS_M: f64 = 100.0;
/// A view farther than this from a vehicle is not of it, metres.
const SAME_VEHICLE_M: f64 = 4.0;
/// Slow error of a vehicle's fixes on each axis, metres.
const FIX_STD_M: f64 = 1.0;
/// Range of perception, metres.
const PERCEPTION_M: f64 = 80.0;
/// Ticks before the measurement: maps fill.
const WARM_UP_TICKS: u64 = 15;
/// Ticks between two looks at the maps.
const LOOK_TICKS: u64 = 5;

/// All that is printed.
#[derive(Serialize)]
struct Curves {
    vehicles: usize,
    seconds: f64,
    /// State of the link → [distance, share that arrived, messages] by bins of distance.
    delivery: BTreeMap<&'static str, Vec<[f64; 3]>>,
    cases: Vec<CaseFigures>,
    /// [objects, mean bytes on air, messages].
    cpm_sizes: Vec<[f64; 3]>,
}

/// One share of vehicles with a radio, and one set of messages.
#[derive(Serialize)]
struct CaseFigures {
    share: f64,
    has_perception: bool,
    channel_busy_ratio: f64,
    cams_per_s: f64,
    cpms_per_s: f64,
    cpm_bytes: f64,
    cpm_objects: f64,
    /// Share of the vehicles within reach that are known.
    awareness: f64,
    /// Views of a known vehicle.
    redundancy: f64,
    /// Age of the newest view: median and 95 %, seconds.
    age_s: [f64; 2],
    /// Mean distance to the truth of the newest view, and of all weighted by their deviations, metres.
    newest_error_m: f64,
    fused_error_m: f64,
}

/// Sums over looks at maps.
#[derive(Default)]
struct Looks {
    near: u64,
    known: u64,
    views: u64,
    ages_s: Vec<f64>,
    newest_error_m: f64,
    fused_error_m: f64,
}

/// Sizes of CPMs by their number of objects: bytes and messages.
type Sizes = BTreeMap<usize, [u64; 2]>;

/// Measures the curves, and writes them into a file, or to standard output without one.
pub fn measure_all(is_quick: bool, file: Option<&str>) {
    let (vehicles, seconds, shares): (usize, u64, &[f64]) = match is_quick {
        true => (60, 2, &[0.5, 1.0]),
        false => (250, 10, &[0.1, 0.3, 0.5, 0.7, 1.0]),
    };
    let mut sizes = Sizes::new();
    let mut bins = [[DeliveredShare::default(); 10]; 3];
    let mut cases = Vec::new();
    for has_perception in [false, true] {
        for share in shares {
            cases.push(measure(
                vehicles,
                seconds,
                *share,
                has_perception,
                &mut sizes,
                &mut bins,
            ));
        }
    }
    let states = ["line of sight", "behind vehicles", "behind houses"];
    let curve = |bins: &[DeliveredShare; 10]| {
        let points = bins.iter().enumerate().filter(|(_, bin)| bin.sent > 0);
        points
            .map(|(number, bin)| {
                let middle_m = (number as f64 + 0.5) * BIN_M;
                [middle_m, bin.received as f64 / bin.sent as f64, bin.sent as f64]
            })
            .collect()
    };
    let curves = Curves {
        vehicles,
        seconds: seconds as f64,
        delivery: states.into_iter().zip(bins.iter().map(curve)).collect(),
        cases,
        cpm_sizes: sizes
            .iter()
            .map(|(objects, [bytes, messages])| [*objects as f64, *bytes as f64 / *messages as f64, *messages as f64])
            .collect(),
    };
    let text = serde_json::to_string(&curves).unwrap();
    match file {
        Some(path) => std::fs::write(path, text).unwrap(),
        None => println!("{text}"),
    }
}

fn measure(
    vehicles: usize,
    seconds: u64,
    share: f64,
    has_perception: bool,
    sizes: &mut Sizes,
    bins: &mut [[DeliveredShare; 10]; 3],
) -> CaseFigures {
    let mut config = Config::from_json(include_str!("../../../../ipc-schema/tests/town.json")).unwrap();
    config.v2x.share = share;
    config.v2x.listing = V2xListing::Separate;
    config.v2x.neighbours = 256;
    config.v2x.pcap = true;
    config.v2x.perception_range_m = if has_perception { PERCEPTION_M } else { 0.0 };
    let mut run = StreetRun::new(vehicles, &config);
    let mut obstacles = run.obstacles();
    let random = RadioRandom::new(99);
    let fix_error_m = |number: usize| {
        let key = LinkKey {
            sender: number as u32 + 1,
            ..LinkKey::default()
        };
        let [east, north, ..] = random.normals(key, RadioDraw::Perception, 1);
        [east, north].map(|normal| FIX_STD_M * f64::from(normal))
    };
    let (mut looks, mut load, mut radios, mut own_sizes) = (Looks::default(), 0.0, 0_u64, Sizes::new());
    let mut before = run.exchange.counts();
    for tick in 0..WARM_UP_TICKS + 10 * seconds {
        let mut street = run.tick(tick, fix_error_m, FIX_STD_M * std::f64::consts::SQRT_2);
        run.exchange(&mut street);
        if tick < WARM_UP_TICKS {
            before = run.exchange.counts();
            continue;
        }
        let equipped = street.block.radio.iter().zip(&street.block.channel_load);
        for (_, busy) in equipped.filter(|(radio, _)| radio[0] == 1) {
            load += f64::from(*busy);
            radios += 1;
        }
        for sent in run.exchange.on_air() {
            add_size(&sent.packet, &mut own_sizes);
        }
        if tick.is_multiple_of(LOOK_TICKS) {
            look(&street, config.v2x.neighbours as usize, &mut looks);
        }
        if share == 1.0 && has_perception && tick.is_multiple_of(10) {
            obstacles.update(&street.states);
            count(&run.exchange, &obstacles, &street.states, bins);
        }
    }
    let counts = run.exchange.counts();
    let stations = radios as f64 / (10 * seconds) as f64;
    let per_s = |count: u64| count as f64 / seconds as f64 / stations;
    let [mut bytes, mut objects, mut messages] = [0_u64; 3];
    for (number, [size, count]) in own_sizes {
        let all = sizes.entry(number).or_default();
        *all = [all[0] + size, all[1] + count];
        (bytes, objects, messages) = (bytes + size, objects + number as u64 * count, messages + count);
    }
    looks.ages_s.sort_unstable_by(f64::total_cmp);
    let age = |share: f64| {
        let last = looks.ages_s.len().saturating_sub(1);
        looks.ages_s.get((last as f64 * share) as usize).copied().unwrap_or(0.0)
    };
    let of = |sum: f64, count: u64| if count > 0 { sum / count as f64 } else { 0.0 };
    CaseFigures {
        share,
        has_perception,
        channel_busy_ratio: of(load, radios),
        cams_per_s: per_s(counts.cams - before.cams),
        cpms_per_s: per_s(counts.cpms - before.cpms),
        cpm_bytes: of(bytes as f64, messages),
        cpm_objects: of(objects as f64, messages),
        awareness: of(looks.known as f64, looks.near),
        redundancy: of(looks.views as f64, looks.known),
        age_s: [age(0.5), age(0.95)],
        newest_error_m: of(looks.newest_error_m, looks.known),
        fused_error_m: of(looks.fused_error_m, looks.known),
    }
}

/// Adds the size of a packet, if it is a CPM's.
fn add_size(packet: &[u8], sizes: &mut Sizes) {
    let Ok((head, message)) = geonetworking::decode(packet) else {
        return;
    };
    if head.port != BtpPort::Cpm {
        return;
    }
    let objects = Cpm::decode(message).unwrap().objects.len();
    let size = sizes.entry(objects).or_default();
    *size = [size[0] + (packet.len() + FRAME_BYTES) as u64, size[1] + 1];
}

/// A view of a vehicle: where it is now, by this view.
#[derive(Clone, Copy)]
struct MatchedView {
    position_m: [f64; 2],
    variance_m2: f64,
    age_s: f64,
}

/// Looks at what every vehicle with a radio knows of those within reach.
fn look(street: &StreetTick, nearest: usize, looks: &mut Looks) {
    let centres: Vec<[f64; 2]> = street.states.iter().map(|state| body_of(state).centre_m).collect();
    for (slot, radio) in street.block.radio.iter().enumerate() {
        if radio[0] != 1 {
            continue;
        }
        let rows = slot * nearest..(slot + 1) * nearest;
        let mut views: BTreeMap<usize, Vec<MatchedView>> = BTreeMap::new();
        for (numbers, ids) in street.block.objects[rows.clone()].iter().zip(&street.block.ids[rows]) {
            if let Some((vehicle, view)) = matched(numbers, ids, &centres, &street.states) {
                views.entry(vehicle).or_default().push(view);
            }
        }
        for (other, centre_m) in centres.iter().enumerate() {
            if other == slot || distance(*centre_m, centres[slot]) > AWARENESS_M {
                continue;
            }
            looks.near += 1;
            let Some(of_other) = views.get(&other) else { continue };
            looks.known += 1;
            looks.views += of_other.len() as u64;
            let newest = of_other.iter().min_by(|a, b| a.age_s.total_cmp(&b.age_s)).unwrap();
            looks.ages_s.push(newest.age_s);
            looks.newest_error_m += distance(newest.position_m, *centre_m);
            looks.fused_error_m += distance(fused(of_other), *centre_m);
        }
    }
}

fn distance(a: [f64; 2], b: [f64; 2]) -> f64 {
    (a[0] - b[0]).hypot(a[1] - b[1])
}

/// The vehicle that a row is of: the nearest to where the row has it now. Own perception and points of reference are no views.
fn matched(
    numbers: &[f32; NEIGHBOUR_COLUMNS],
    ids: &[u32; NEIGHBOUR_ID_COLUMNS],
    centres: &[[f64; 2]],
    states: &[VehicleState],
) -> Option<(usize, MatchedView)> {
    let is_view = ids[2] != NeighbourSource::Empty as u32 && ids[2] != NeighbourSource::Own as u32 && numbers[5] > 0.0;
    if !is_view {
        return None;
    }
    let [x, y, vx, vy, _, _, _, age_s, std_m, speed_std_mps, _] = numbers.map(f64::from);
    let position_m = [x + age_s * vx, y + age_s * vy];
    let away = |place: usize| distance(position_m, centres[place]);
    let nearest = (0..states.len()).min_by(|a, b| away(*a).total_cmp(&away(*b)))?;
    let view = MatchedView {
        position_m,
        variance_m2: std_m * std_m + (age_s * speed_std_mps).powi(2),
        age_s,
    };
    (away(nearest) <= SAME_VEHICLE_M).then_some((nearest, view))
}

/// Mean of views, weighted by their stated deviations.
fn fused(views: &[MatchedView]) -> [f64; 2] {
    let weight: f64 = views.iter().map(|view| 1.0 / view.variance_m2).sum();
    [0, 1].map(|axis: usize| {
        let sum: f64 = views.iter().map(|view| view.position_m[axis] / view.variance_m2).sum();
        sum / weight
    })
}
