//! The demand of a generated scenario: vehicles on every lane from the first step, each with a random route that outlasts the simulation.

use std::fmt::Write as _;

use rand_chacha::{
    ChaCha8Rng,
    rand_core::{RngCore as _, SeedableRng as _},
};

use super::{GeneratedCity, streets::GridStreets};
use crate::failure::Exit;

/// Vehicle classes and their shares, percent. Lengths are SUMO's.
const CLASSES: [(&str, u64); 5] = [
    ("passenger", 80),
    ("delivery", 8),
    ("truck", 6),
    ("bus", 2),
    ("motorcycle", 4),
];
/// Length of the longest vehicle (a bus) with the gap ahead of it, metres.
const ROOM_M: f64 = 15.0;
/// A mean speed that no vehicle reaches, as a multiple of the speed limit: SUMO's drivers keep to 1.0 ± 0.1 of it.
const FASTEST: f64 = 1.3;

/// The vehicles of a generated scenario and their routes.
pub struct TripDemand<'a> {
    city: &'a GeneratedCity,
    streets: &'a GridStreets,
    /// Street, number and length (metres) of every lane.
    lanes: Vec<(usize, usize, f64)>,
}

impl<'a> TripDemand<'a> {
    /// Prepares the demand for these streets.
    ///
    /// # Errors
    /// The vehicles do not fit onto them.
    pub fn new(city: &'a GeneratedCity, streets: &'a GridStreets) -> Result<Self, Exit> {
        let all = streets.all.iter().enumerate();
        let lanes: Vec<_> = all
            .flat_map(|(street, place)| place.lanes_m.iter().enumerate().map(move |(n, &m)| (street, n, m)))
            .collect();
        let room: f64 = lanes.iter().map(|(_, _, length_m)| (length_m / ROOM_M).floor()).sum();
        if f64::from(city.vehicles) > room {
            return Err(Exit::config(
                format!(
                    "{} vehicles do not fit onto streets with room for {room}",
                    city.vehicles
                ),
                "give more --junctions, longer blocks or more --lanes",
            ));
        }
        Ok(Self { city, streets, lanes })
    }

    /// The content of the route file.
    pub fn text(&self) -> String {
        let mut text = String::from("<routes>\n");
        for (class, _) in CLASSES {
            // Writing to a string cannot fail.
            let _ = writeln!(text, "    <vType id=\"{class}\" vClass=\"{class}\"/>");
        }
        let (vehicles, lanes) = (self.city.vehicles as usize, self.lanes.len());
        let mut number = 0;
        for (index, &(street, lane, length_m)) in self.lanes.iter().enumerate() {
            // The vehicles are spread evenly over all lanes.
            let end = vehicles * (index + 1) / lanes;
            let here = end - number;
            for place in 0..here {
                let position_m = length_m * (place as f64 + 0.5) / here as f64;
                self.vehicle(&mut text, number, street, lane, position_m);
                number += 1;
            }
        }
        text + "</routes>\n"
    }

    fn vehicle(&self, text: &mut String, number: usize, street: usize, lane: usize, position_m: f64) {
        // Each vehicle has its own stream of random numbers.
        let mut rng = ChaCha8Rng::seed_from_u64(self.city.seed);
        rng.set_stream(number as u64);
        let class = class(below(100, &mut rng));
        let _ = writeln!(
            text,
            "    <vehicle id=\"v{number}\" type=\"{class}\" depart=\"0\" departLane=\"{lane}\" departPos=\"{position_m:.1}\" departSpeed=\"avg\">"
        );
        text.push_str("        <route edges=\"");
        self.write_route(text, street, -position_m, &mut rng);
        text.push_str("\"/>\n    </vehicle>\n");
    }

    /// Writes a random route from `street` on that is longer than any vehicle can drive.
    fn write_route(&self, text: &mut String, mut street: usize, mut way_m: f64, rng: &mut ChaCha8Rng) {
        let enough_m = FASTEST * self.city.speed_mps() * self.city.duration_s + self.city.block_m;
        text.push_str(&self.streets.all[street].id);
        loop {
            way_m += self.streets.all[street].lanes_m.first().copied().unwrap_or(ROOM_M);
            let choices = self.streets.onward(street);
            let count = choices.clone().count() as u64;
            let next = choices.clone().nth(below(count.max(1), rng) as usize);
            let Some(next) = next.filter(|_| way_m < enough_m) else {
                return;
            };
            street = next;
            text.push(' ');
            text.push_str(&self.streets.all[street].id);
        }
    }
}

fn class(mut draw: u64) -> &'static str {
    for (class, share) in CLASSES {
        if draw < share {
            return class;
        }
        draw -= share;
    }
    CLASSES[0].0
}

/// A uniform number below `count`, which is above 0.
fn below(count: u64, rng: &mut ChaCha8Rng) -> u64 {
    ((u128::from(rng.next_u64()) * u128::from(count)) >> 64) as u64
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn classes_have_their_shares() {
        let drawn: Vec<_> = (0..100).map(class).collect();
        for (class, share) in CLASSES {
            assert_eq!(drawn.iter().filter(|drawn| **drawn == class).count() as u64, share);
        }
    }

    /// A ring of four streets in each direction: every route goes round and round.
    fn ring() -> GridStreets {
        let edges: String = (0..4)
            .flat_map(|n| [(n, (n + 1) % 4), ((n + 1) % 4, n)])
            .map(|(a, b)| {
                format!("<edge id=\"{a}to{b}\" from=\"{a}\" to=\"{b}\"><lane id=\"{a}to{b}_0\" length=\"100\"/></edge>")
            })
            .collect();
        GridStreets::of(&format!("<net>{edges}</net>")).unwrap()
    }

    #[test]
    fn every_vehicle_has_its_own_position_and_a_long_route() {
        let (streets, city) = (ring(), GeneratedCity::of(17, 30.0, 0.1, 3));
        let text = TripDemand::new(&city, &streets).unwrap().text();
        let value = |line: &str, name: &str| {
            let (_, rest) = line.split_once(&format!("{name}=\"")).unwrap();
            rest.split_once('"').unwrap().0.to_owned()
        };
        let vehicles: Vec<_> = text.lines().filter(|line| line.contains("<vehicle")).collect();
        let ways: Vec<_> = text.lines().filter(|line| line.contains("<route ")).collect();
        assert_eq!((vehicles.len(), ways.len()), (17, 17));
        let mut places: Vec<(String, f64)> = Vec::new();
        for (vehicle, way) in vehicles.iter().zip(&ways) {
            let edges = value(way, "edges");
            let street = edges.split(' ').next().unwrap().to_owned();
            let position_m: f64 = value(vehicle, "departPos").parse().unwrap();
            for (other, taken_m) in &places {
                assert!(*other != street || (position_m - taken_m).abs() >= ROOM_M, "{text}");
            }
            places.push((street, position_m));
            let ahead_m = edges.split(' ').count() as f64 * 100.0 - position_m;
            assert!(ahead_m >= FASTEST * city.speed_mps() * 30.0, "{edges} is {ahead_m} m");
        }
    }
}
