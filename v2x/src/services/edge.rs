//! The map of an edge service: everything that a roadside unit hears and perceives, fused into one description of each road user, with a
//! number that it keeps.

use crate::local_map::{KnownObject, SAME_OBJECT_M};
use ipc_schema::neighbours::NeighbourSource;

/// A description belongs to the object that was here before if it is not farther away than this, metres.
const SAME_TRACK_M: f64 = 4.0;
/// Time for which the number of an object that is not described any more is kept, ms.
const TRACK_MS: i64 = 2000;
/// Errors that all views share, as of the clock, are not averaged away: no position is better than this, metres.
const BEST_STD_M: f64 = 0.1;
/// Objects that are no longer and no wider than this are people: descriptions do not say so, metres.
const PERSON_M: f32 = 1.0;

/// A road user as all views together describe it now.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct FusedObject {
    /// Its number.
    pub number: u16,
    /// Centre, world, metres.
    pub position_m: [f64; 2],
    /// World, m/s.
    pub velocity_mps: [f64; 2],
    /// Radians counter-clockwise from east.
    pub heading_rad: f64,
    /// Length and width, metres.
    pub size_m: [f32; 2],
    /// Standard deviation of the position on each axis, metres.
    pub position_std_m: f64,
    /// Standard deviation of the velocity on each axis, m/s.
    pub speed_std_mps: f64,
}

impl FusedObject {
    /// True if it is small enough for a person.
    #[must_use]
    pub fn is_person(&self) -> bool {
        self.size_m.iter().all(|size| *size <= PERSON_M)
    }
}

/// Views that are of the same road user.
#[derive(Debug, Clone, Copy)]
struct Cluster {
    /// The station that spoke for itself; 0 if none did.
    station: u32,
    precision: f64,
    weighted_m: [f64; 2],
    speed_precision: f64,
    weighted_mps: [f64; 2],
    /// Of the best view.
    heading_rad: f64,
    size_m: [f32; 2],
}

impl Cluster {
    fn position_m(&self) -> [f64; 2] {
        self.weighted_m.map(|sum| sum / self.precision)
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
struct Track {
    number: u16,
    position_m: [f64; 2],
    velocity_mps: [f64; 2],
    seen_ms: i64,
}

/// The map of an edge service.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct FusedMap {
    tracks: Vec<Track>,
    /// The next number.
    next: u16,
    updated_ms: i64,
}

impl FusedMap {
    /// Fuses the views of a tick, and gives each object the number that it had before.
    pub fn update(&mut self, now_ms: i64, views: &[KnownObject]) -> Vec<FusedObject> {
        let clusters = clusters_of(now_ms, views);
        let elapsed_s = (now_ms - self.updated_ms) as f64 / 1000.0;
        self.updated_ms = now_ms;
        for track in &mut self.tracks {
            add(&mut track.position_m, elapsed_s, track.velocity_mps);
        }
        // The nearest pairs first: each track is one object.
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for (place, cluster) in clusters.iter().enumerate() {
            for (number, track) in self.tracks.iter().enumerate() {
                let away_m = distance_m(cluster.position_m(), track.position_m);
                if away_m <= SAME_TRACK_M {
                    pairs.push((away_m, place, number));
                }
            }
        }
        pairs.sort_by(|a, b| a.0.total_cmp(&b.0));
        let mut track_of: Vec<Option<usize>> = vec![None; clusters.len()];
        let mut is_taken = vec![false; self.tracks.len()];
        for (_, place, number) in pairs {
            if track_of[place].is_none() && !is_taken[number] {
                track_of[place] = Some(number);
                is_taken[number] = true;
            }
        }
        let mut objects = Vec::with_capacity(clusters.len());
        for (cluster, track) in clusters.iter().zip(track_of) {
            let position_m = cluster.position_m();
            let velocity_mps = cluster.weighted_mps.map(|sum| sum / cluster.speed_precision);
            let number = match track {
                Some(number) => self.tracks[number].number,
                None => self.free_number(),
            };
            let newest = Track {
                number,
                position_m,
                velocity_mps,
                seen_ms: now_ms,
            };
            match track {
                Some(number) => self.tracks[number] = newest,
                None => self.tracks.push(newest),
            }
            objects.push(FusedObject {
                number,
                position_m,
                velocity_mps,
                heading_rad: cluster.heading_rad,
                size_m: cluster.size_m,
                position_std_m: cluster.precision.sqrt().recip().max(BEST_STD_M),
                speed_std_mps: cluster.speed_precision.sqrt().recip(),
            });
        }
        self.tracks.retain(|track| now_ms - track.seen_ms <= TRACK_MS);
        objects.sort_by_key(|object| object.number);
        objects
    }

    /// A number that no track has.
    fn free_number(&mut self) -> u16 {
        while self.tracks.iter().any(|track| track.number == self.next) {
            self.next = self.next.wrapping_add(1);
        }
        let number = self.next;
        self.next = self.next.wrapping_add(1);
        number
    }
}

/// The views of a tick by road user. The most exact views come first, and one that is near to a road user joins it, unless both spoke for
/// themselves.
fn clusters_of(now_ms: i64, views: &[KnownObject]) -> Vec<Cluster> {
    let std_m = |view: &KnownObject| {
        let [position, speed, _] = view.deviations.map(f64::from);
        let age_s = (now_ms - view.measured_ms) as f64 / 1000.0;
        libm::hypot(position.max(BEST_STD_M), speed * age_s)
    };
    let mut order: Vec<(f64, &KnownObject)> = views.iter().map(|view| (std_m(view), view)).collect();
    // What spoke for itself knows its size and its name: it comes first.
    let speaks = |view: &KnownObject| !matches!(view.source, NeighbourSource::Cpm | NeighbourSource::Own);
    order.sort_by(|(a, one), (b, other)| speaks(other).cmp(&speaks(one)).then(a.total_cmp(b)));
    let mut clusters: Vec<Cluster> = Vec::new();
    for (std_m, view) in order {
        let there_m = view.position_at_m(now_ms);
        let station = if speaks(view) { view.station } else { 0 };
        let (weight, speed_weight) = (std_m.powi(-2), f64::from(view.deviations[1]).max(0.01).powi(-2));
        let nearest = clusters
            .iter_mut()
            .filter(|cluster| station == 0 || cluster.station == 0 || cluster.station == station)
            .map(|cluster| (distance_m(cluster.position_m(), there_m), cluster))
            .filter(|(away_m, _)| *away_m <= SAME_OBJECT_M)
            .min_by(|(a, _), (b, _)| a.total_cmp(b));
        match nearest {
            Some((_, cluster)) => {
                cluster.precision += weight;
                cluster.speed_precision += speed_weight;
                add(&mut cluster.weighted_m, weight, there_m);
                add(&mut cluster.weighted_mps, speed_weight, view.velocity_mps);
            }
            None => clusters.push(Cluster {
                station,
                precision: weight,
                weighted_m: there_m.map(|value| weight * value),
                speed_precision: speed_weight,
                weighted_mps: view.velocity_mps.map(|value| speed_weight * value),
                heading_rad: view.heading_rad,
                size_m: view.size_m,
            }),
        }
    }
    clusters
}

/// Adds `factor` times a vector.
fn add(sum: &mut [f64; 2], factor: f64, vector: [f64; 2]) {
    for (sum, value) in sum.iter_mut().zip(vector) {
        *sum += factor * value;
    }
}

fn distance_m(a: [f64; 2], b: [f64; 2]) -> f64 {
    libm::hypot(a[0] - b[0], a[1] - b[1])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn view(station: u32, heard_from: u32, x_m: f64, std_m: f32, measured_ms: i64) -> KnownObject {
        KnownObject {
            station,
            heard_from,
            object: u32::from(station == 0),
            source: if station == 0 {
                NeighbourSource::Cpm
            } else {
                NeighbourSource::Cam
            },
            position_m: [x_m, 0.0],
            velocity_mps: [10.0, 0.0],
            heading_rad: 0.0,
            size_m: [4.5, 1.8],
            measured_ms,
            deviations: [std_m, 0.5, 0.1],
        }
    }

    #[test]
    fn views_are_weighted_by_their_variances_at_the_present_time() {
        let mut map = FusedMap::default();
        // A view of 0.1 s ago has moved by 1 m, with 0.05 m of uncertainty more.
        let views = [view(0, 7, 10.0, 0.5, 1000), view(0, 8, 9.6, 1.0, 900)];
        let [object] = map.update(1000, &views)[..] else {
            panic!()
        };
        let weights = [0.25_f64.recip(), (1.0_f64 + 0.0025).recip()];
        let expected_m = (weights[0] * 10.0 + weights[1] * 10.6) / (weights[0] + weights[1]);
        assert!((object.position_m[0] - expected_m).abs() < 1e-9);
        assert!((object.position_std_m - (weights[0] + weights[1]).sqrt().recip()).abs() < 1e-9);
        assert!((object.speed_std_mps - 0.5 / 2.0_f64.sqrt()).abs() < 1e-6);
        assert!(!object.is_person());
    }

    #[test]
    fn two_that_speak_for_themselves_are_two_and_what_is_perceived_joins_the_nearer() {
        let mut map = FusedMap::default();
        let views = [
            view(3, 3, 10.0, 1.0, 1000),
            view(4, 4, 12.0, 1.0, 1000),
            view(0, 7, 12.3, 0.5, 1000),
        ];
        let objects = map.update(1000, &views);
        assert_eq!(objects.len(), 2);
        let mut places: Vec<f64> = objects.iter().map(|object| object.position_m[0]).collect();
        places.sort_by(f64::total_cmp);
        assert!((places[0] - 10.0).abs() < 1e-9 && (12.0..12.3).contains(&places[1]));
    }

    #[test]
    fn an_object_keeps_its_number_until_it_is_gone_for_two_seconds() {
        let mut map = FusedMap::default();
        let at = |x_m: f64, ms: i64| [view(0, 7, x_m, 0.5, ms)];
        let first = map.update(0, &at(0.0, 0))[0].number;
        // It drives on at 10 m/s: 4 s later it is 40 m farther.
        for tenth in 1..=40 {
            let objects = map.update(tenth * 100, &at(tenth as f64, tenth * 100));
            assert_eq!(objects[0].number, first);
        }
        // Nothing is heard of it for 1 s: it is where it was to be expected. After 3 s its number is given up.
        assert!(map.update(4500, &[]).is_empty());
        assert_eq!(map.update(5000, &at(50.0, 5000))[0].number, first);
        map.update(6500, &[]);
        map.update(8000, &[]);
        assert_ne!(map.update(8100, &at(81.0, 8100))[0].number, first);
    }
}
