//! What a hero senses around it: road users, the junctions and traffic lights of its route, persons beside it.
//!
//! All of it is the truth of this tick within [`SENSING_M`]. A rival of a junction is a vehicle that would cross the hero's way there if
//! it drove straight on at its speed.

use ipc_schema::world::{
    AROUND, CONFLICT_COLUMNS, LONGEST_GAP_S, PERSON_BESIDE_M, PERSON_COLUMNS, SEEN_CONFLICTS, SEEN_PERSONS,
    SEEN_SIGNALS, SENSED_USERS, SENSING_M, SIGHT_M, SIGNAL_COLUMNS, USER_COLUMNS, VehicleState,
};

use super::{
    bodies::{TickBodies, TickBody},
    encounter::HeroWay,
    is_trailing_body_of,
    route::{Crossing, HeroRoute, StopLine},
};

/// Half the width of the strip in which a rival would touch the hero, metres.
const RIVAL_REACH_M: f64 = 2.5;
/// Slower vehicles are no rivals: they wait, m/s.
const RIVAL_FROM_MPS: f64 = 0.5;
/// Places of a way across a junction at which rivals are looked for.
const PLACES: u32 = 5;
/// Farthest rival from the hero, metres.
const RIVAL_SIGHT_M: f64 = 80.0;
/// A stop line this near to the beginning of a way across a junction is that way's, metres.
const SAME_LINE_M: f64 = 1.0;

/// Row of a road user that is not there.
const NO_USER: [f32; USER_COLUMNS] = {
    let (far_m, never_s) = (SENSING_M as f32, LONGEST_GAP_S as f32);
    [
        far_m, far_m, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, far_m, never_s, never_s, never_s, 0.0,
    ]
};
/// What a green light, a red one and one that has just turned yellow count as.
const GREEN: f64 = 1.0;
const RED: f64 = 0.0;
const YELLOW: f64 = 0.5;
/// What a yellow light loses in a second, and what it keeps.
const YELLOW_FADES_PER_S: f64 = 0.15;
const LAST_YELLOW: f64 = 0.05;

/// What a link of a traffic light shows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ShownLight {
    /// SUMO's letter.
    pub letter: u8,
    /// For how long, seconds.
    pub shown_s: f64,
}

/// A hero among the road users of a tick.
#[derive(Debug)]
pub struct HeroSurroundings<'a> {
    /// Its route.
    pub route: &'a HeroRoute,
    /// All road users, and the trailing bodies behind them.
    pub states: &'a [VehicleState],
    /// The same, as all heroes see them.
    pub bodies: &'a TickBodies,
    /// Its row among them.
    pub row: usize,
    /// Station of its rear axle, metres.
    pub station_m: f64,
    /// Station of its front bumper, metres.
    pub front_station_m: f64,
}

/// A road user near the hero.
#[derive(Debug, Clone, Copy)]
struct Neighbour<'a> {
    state: &'a VehicleState,
    body: &'a TickBody,
    square_m2: f64,
}

impl HeroSurroundings<'_> {
    /// The numbers of [`ipc_schema::world::HeroView::around`]; `light` is that of a stop line's link.
    #[must_use]
    pub fn numbers(&self, light: impl Fn(&StopLine) -> Option<ShownLight>) -> [f32; AROUND] {
        let mut numbers = [0.0; AROUND];
        let (persons_near, vehicles_near): (Vec<_>, Vec<_>) = self.neighbours().partition(|other| other.body.is_person);
        let (users, rest) = numbers.split_at_mut(SENSED_USERS * USER_COLUMNS);
        let (junctions, rest) = rest.split_at_mut(SEEN_CONFLICTS * CONFLICT_COLUMNS);
        let (lights, persons) = rest.split_at_mut(SEEN_SIGNALS * SIGNAL_COLUMNS);
        self.write_users(&vehicles_near, users);
        let letter = |stop: &StopLine| light(stop).map(|light| light.letter);
        self.write_junctions(&vehicles_near, &letter, junctions);
        self.write_lights(&light, lights);
        self.write_persons(persons_near, persons);
        numbers
    }

    fn hero(&self) -> &VehicleState {
        &self.states[self.row]
    }

    /// Road users within [`RIVAL_SIGHT_M`].
    fn neighbours(&self) -> impl Iterator<Item = Neighbour<'_>> {
        let hero = self.hero();
        let here = self.bodies.body(self.row).middle_m;
        let near = self.bodies.near([hero.x_m, hero.y_m], RIVAL_SIGHT_M);
        let others = near.filter(|row| *row != self.row && !is_trailing_body_of(&self.states[*row], hero));
        others.map(move |row| {
            let body = self.bodies.body(row);
            let (dx, dy) = (body.middle_m[0] - here[0], body.middle_m[1] - here[1]);
            Neighbour {
                state: &self.states[row],
                body,
                square_m2: dx * dx + dy * dy,
            }
        })
    }

    fn write_users(&self, vehicles: &[Neighbour<'_>], numbers: &mut [f32]) {
        let hero = self.hero();
        let way = HeroWay::new(self.route, self.front_station_m, hero);
        let (sin, cos) = libm::sincos(hero.yaw_rad);
        let turned = |[x, y]: [f64; 2]| [cos * x + sin * y, cos * y - sin * x];
        let mut users = nearest_users(vehicles).into_iter().flatten();
        for row in numbers.as_chunks_mut::<USER_COLUMNS>().0 {
            *row = match users.next() {
                None => NO_USER,
                Some(other) => {
                    let [x, y] = other.body.middle_m;
                    let [x, y] = turned([x - hero.x_m, y - hero.y_m]);
                    let [forward, left] = turned(other.body.velocity_mps);
                    let (sine, cosine) = libm::sincos(other.state.yaw_rad - hero.yaw_rad);
                    let [x, y, cosine, sine, forward, left] =
                        [x, y, cosine, sine, forward, left].map(|value| value as f32);
                    let (length_m, width_m, turn) = (other.body.length_m, other.body.width_m, other.body.turn);
                    let met = way.encounter(other.body);
                    let [way_m, reaches_s, enters_s, leaves_s] =
                        [met.way_m, met.reaches_s, met.enters_s, met.leaves_s].map(|value| value as f32);
                    [
                        x, y, cosine, sine, forward, left, length_m, width_m, way_m, reaches_s, enters_s, leaves_s,
                        turn,
                    ]
                }
            };
        }
    }

    fn write_junctions(
        &self,
        vehicles: &[Neighbour<'_>],
        letter: &impl Fn(&StopLine) -> Option<u8>,
        numbers: &mut [f32],
    ) {
        let crossings = self.route.crossings();
        let first = crossings.partition_point(|crossing| crossing.to_m <= self.front_station_m);
        let mut crossings = crossings[first..]
            .iter()
            .filter(|crossing| crossing.from_m - self.front_station_m < SIGHT_M);
        for row in numbers.as_chunks_mut::<CONFLICT_COLUMNS>().0 {
            *row = match crossings.next() {
                None => [SIGHT_M as f32, 1.0, LONGEST_GAP_S as f32],
                Some(crossing) => {
                    let stop = self.stop_line(crossing).and_then(letter);
                    let has_right_of_way = match stop {
                        Some(letter) if !is_off(letter) => letter == b'G',
                        _ => crossing.has_right_of_way,
                    };
                    [
                        (crossing.from_m - self.front_station_m).max(0.0) as f32,
                        f32::from(u8::from(has_right_of_way)),
                        self.rival_s(crossing, vehicles) as f32,
                    ]
                }
            };
        }
    }

    fn stop_line(&self, crossing: &Crossing) -> Option<&StopLine> {
        let is_its = |stop: &&StopLine| (stop.station_m - crossing.from_m).abs() < SAME_LINE_M;
        self.route.stop_lines().iter().find(is_its)
    }

    /// Time until the first rival reaches the hero's way across a junction, driving straight on; at most [`LONGEST_GAP_S`].
    fn rival_s(&self, crossing: &Crossing, vehicles: &[Neighbour<'_>]) -> f64 {
        let mut soonest_s = LONGEST_GAP_S;
        for number in 0..PLACES {
            let share = f64::from(number) / f64::from(PLACES - 1);
            let station_m = crossing.from_m + share * (crossing.to_m - crossing.from_m);
            let (Some(place), Some(behind)) = (self.route.at(station_m), self.route.at(station_m - 0.5)) else {
                continue;
            };
            let way = [(place[0] - behind[0]) * 2.0, (place[1] - behind[1]) * 2.0];
            for rival in vehicles.iter().map(|vehicle| vehicle.body) {
                let ([vx, vy], speed_mps) = (rival.velocity_mps, rival.speed_mps);
                // What drives along the hero's own way is a leader or a follower.
                if speed_mps < RIVAL_FROM_MPS || (vx * way[0] + vy * way[1]) > 0.9 * speed_mps {
                    continue;
                }
                let (dx, dy) = (place[0] - rival.middle_m[0], place[1] - rival.middle_m[1]);
                let (along_m, beside_m) = ((dx * vx + dy * vy) / speed_mps, (dx * vy - dy * vx) / speed_mps);
                let half_m = 0.5 * f64::from(rival.length_m);
                if beside_m.abs() < RIVAL_REACH_M && along_m > -half_m {
                    soonest_s = soonest_s.min((along_m - half_m).max(0.0) / speed_mps);
                }
            }
        }
        soonest_s
    }

    fn write_lights(&self, light: &impl Fn(&StopLine) -> Option<ShownLight>, numbers: &mut [f32]) {
        let is_ahead = |stop: &&StopLine| {
            let ahead_m = stop.station_m - self.front_station_m;
            (0.0..SIGHT_M).contains(&ahead_m) && !light(stop).is_some_and(|light| is_off(light.letter))
        };
        let mut stops = self.route.stop_lines().iter().filter(is_ahead);
        for row in numbers.as_chunks_mut::<SIGNAL_COLUMNS>().0 {
            *row = match stops.next() {
                None => [SIGHT_M as f32, 1.0],
                Some(stop) => {
                    let green = light(stop).map_or(GREEN, greenness);
                    [(stop.station_m - self.front_station_m) as f32, green as f32]
                }
            };
        }
    }

    fn write_persons(&self, mut near: Vec<Neighbour<'_>>, numbers: &mut [f32]) {
        near.sort_by(|a, b| a.square_m2.total_cmp(&b.square_m2));
        let way = self.route.window(self.station_m, self.front_station_m + SENSING_M);
        let mut persons: Vec<[f64; PERSON_COLUMNS]> = near
            .iter()
            .filter_map(|other| {
                let place = way.project_within(other.body.middle_m, PERSON_BESIDE_M)?;
                let ahead_m = place.station_m - self.front_station_m;
                let [dx, dy] = place.direction;
                let [vx, vy] = other.body.velocity_mps;
                let is_ahead = ahead_m > 0.0 && ahead_m < SENSING_M;
                is_ahead.then_some([ahead_m, place.left_m, dx * vy - dy * vx])
            })
            .collect();
        persons.sort_by(|a, b| a[0].total_cmp(&b[0]));
        let mut persons = persons.into_iter();
        for row in numbers.as_chunks_mut::<PERSON_COLUMNS>().0 {
            *row = persons
                .next()
                .unwrap_or([SENSING_M, PERSON_BESIDE_M, 0.0])
                .map(|value| value as f32);
        }
        debug_assert_eq!(numbers.len(), SEEN_PERSONS * PERSON_COLUMNS);
    }
}

/// The nearest vehicles within [`SENSING_M`], the nearest first; of two at one distance the one in the lower row.
fn nearest_users<'a>(vehicles: &'a [Neighbour<'a>]) -> [Option<&'a Neighbour<'a>>; SENSED_USERS] {
    let mut nearest = [None; SENSED_USERS];
    let mut count = 0;
    for other in vehicles.iter().filter(|other| other.square_m2 <= SENSING_M * SENSING_M) {
        let is_nearer = |held: &Option<&Neighbour<'_>>| held.is_some_and(|held| held.square_m2 <= other.square_m2);
        let place = nearest[..count].partition_point(is_nearer);
        if place < SENSED_USERS {
            count = (count + 1).min(SENSED_USERS);
            nearest[place..count].rotate_right(1);
            nearest[place] = Some(other);
        }
    }
    nearest
}

/// How near a light is to green. Yellow tells since when it is shown: how long it lasts decides whether a driver can still pass.
fn greenness(light: ShownLight) -> f64 {
    match light.letter {
        b'r' | b'R' => RED,
        b'y' | b'Y' | b'u' => (YELLOW - YELLOW_FADES_PER_S * light.shown_s).max(LAST_YELLOW),
        _ => GREEN,
    }
}

/// True for a link whose traffic light is off, blinking or not.
fn is_off(letter: u8) -> bool {
    matches!(letter, b'o' | b'O')
}

#[cfg(test)]
mod tests {
    use ipc_schema::traffic::{Kind, NO_SIGNAL, ON_EDGE, RoutePoint, YIELDS};

    use super::*;

    /// 200 m along x, with a junction from 100 m to 120 m.
    fn route() -> HeroRoute {
        let mut route = HeroRoute::default();
        for (x_m, index, way) in [
            (0.0, 0, ON_EDGE),
            (100.0, 1, YIELDS),
            (120.0, 2, ON_EDGE),
            (200.0, 3, ON_EDGE),
        ] {
            route.push(&RoutePoint {
                x_m,
                index,
                way,
                signal: if index == 1 { 0 } else { NO_SIGNAL },
                ..RoutePoint::default()
            });
        }
        route
    }

    fn user(kind: Kind, [x_m, y_m]: [f64; 2], yaw_rad: f64, speed_mps: f32) -> VehicleState {
        VehicleState {
            x_m,
            y_m,
            yaw_rad,
            kind: kind as u32,
            length_m: 4.0,
            width_m: 2.0,
            rear_overhang_m: 2.0,
            velocity_body_mps: [speed_mps, 0.0, 0.0],
            ..VehicleState::default()
        }
    }

    fn seen(states: &[VehicleState], letter: Option<u8>) -> [f32; AROUND] {
        let route = route();
        let bodies = TickBodies::of(states);
        let hero = HeroSurroundings {
            route: &route,
            states,
            bodies: &bodies,
            row: 0,
            station_m: 58.0,
            front_station_m: 60.0,
        };
        hero.numbers(|_| letter.map(|letter| ShownLight { letter, shown_s: 0.0 }))
    }

    #[test]
    fn with_nothing_around_every_number_says_so() {
        let hero = user(Kind::Hero, [58.0, 0.0], 0.0, 10.0);
        let numbers = seen(&[hero], None);
        assert_eq!(
            numbers[..13],
            [50.0, 50.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 50.0, 10.0, 10.0, 10.0, 0.0]
        );
        assert_eq!(numbers[104..110], [40.0, 0.0, 10.0, 100.0, 1.0, 10.0]);
        assert_eq!(numbers[113..117], [40.0, 1.0, 100.0, 1.0]);
        assert_eq!(numbers[117..], [50.0, 10.0, 0.0, 50.0, 10.0, 0.0]);
    }

    #[test]
    fn road_users_stand_by_distance_in_the_heros_frame() {
        let north = std::f64::consts::FRAC_PI_2;
        let hero = user(Kind::Hero, [58.0, 0.0], north, 10.0);
        let far = VehicleState {
            signals: 2,
            ..user(Kind::Other, [58.0, 30.0], 0.0, 5.0)
        };
        let near = user(Kind::Cav, [48.0, 0.0], north, 8.0);
        let unseen = user(Kind::Other, [58.0, -60.0], 0.0, 5.0);
        let numbers = seen(&[hero, far, near, unseen], None);
        let rounded = |from: usize| -> Vec<f32> {
            numbers[from..from + 13]
                .iter()
                .map(|n| (n * 1e3).round() / 1e3)
                .collect()
        };
        // 10 m to the left, driving alike: it drives away from the route, which leads to the right.
        assert_eq!(
            rounded(0),
            [0.0, 10.0, 1.0, 0.0, 8.0, 0.0, 4.0, 2.0, 50.0, 10.0, 10.0, 10.0, 0.0]
        );
        // 30 m ahead, driving to the right, which it does not indicate: it indicates a turn to the left.
        assert_eq!(
            rounded(13),
            [30.0, 0.0, 0.0, -1.0, 0.0, -5.0, 4.0, 2.0, 50.0, 10.0, 10.0, 10.0, 1.0]
        );
        assert_eq!(numbers[26], 50.0);
    }

    #[test]
    fn of_many_vehicles_the_nearest_are_seen_and_of_two_at_one_distance_the_lower_row_first() {
        let hero = user(Kind::Hero, [58.0, 0.0], 0.0, 10.0);
        let others =
            [9.0, 4.0, 7.0, 2.0, -2.0, 8.0, 3.0, 6.0, 5.0, 1.0].map(|y_m| user(Kind::Other, [58.0, y_m], 0.0, 0.0));
        let states: Vec<VehicleState> = std::iter::once(hero).chain(others).collect();
        let left: Vec<f32> = (0..8).map(|row| seen(&states, None)[row * USER_COLUMNS + 1]).collect();
        assert_eq!(left, [1.0, 2.0, -2.0, 3.0, 4.0, 5.0, 6.0, 7.0]);
    }

    #[test]
    fn a_rival_is_what_crosses_the_way_and_a_follower_is_none() {
        let south = -std::f64::consts::FRAC_PI_2;
        let hero = user(Kind::Hero, [58.0, 0.0], 0.0, 10.0);
        // Its front bumper is 40 m from the way, in the middle of the junction.
        let rival = user(Kind::Other, [110.0, 42.0], south, 10.0);
        let leader = user(Kind::Other, [90.0, 0.0], 0.0, 10.0);
        let leaving = user(Kind::Other, [110.0, -20.0], south, 10.0);
        let waiting = user(Kind::Other, [115.0, 20.0], south, 0.0);
        let numbers = seen(&[hero, rival, leader, leaving, waiting], None);
        assert_eq!(numbers[104..107], [40.0, 0.0, 4.0]);
        assert_eq!(seen(&[hero, leader, leaving, waiting], None)[106], 10.0);
    }

    #[test]
    fn lights_decide_right_of_way_and_persons_are_seen_beside_the_route() {
        let hero = user(Kind::Hero, [58.0, 0.0], 0.0, 10.0);
        let person = user(Kind::Person, [80.0, -4.0], std::f64::consts::FRAC_PI_2, 1.5);
        // The junction gives the hero no precedence, and lights that are off change nothing.
        for (letter, priority, light) in [
            (b'G', 1.0, [40.0, 1.0]),
            (b'g', 0.0, [40.0, 1.0]),
            (b'y', 0.0, [40.0, 0.5]),
            (b'r', 0.0, [40.0, 0.0]),
            (b'o', 0.0, [100.0, 1.0]),
            (b'O', 0.0, [100.0, 1.0]),
        ] {
            let numbers = seen(&[hero, person], Some(letter));
            assert_eq!(
                (numbers[105], [numbers[113], numbers[114]]),
                (priority, light),
                "{}",
                letter as char
            );
            assert_eq!(numbers[117..120], [20.0, -4.0, 1.5]);
            assert_eq!(numbers[0], 50.0, "a person is no vehicle");
        }
    }

    #[test]
    fn yellow_fades_and_nothing_else_does() {
        let shown = |letter, shown_s| greenness(ShownLight { letter, shown_s });
        for (shown_s, yellow) in [(0.0, 0.5), (1.0, 0.35), (3.0, 0.05), (60.0, 0.05)] {
            assert!((shown(b'y', shown_s) - yellow).abs() < 1e-9);
            assert_eq!(
                (shown(b'G', shown_s), shown(b'g', shown_s), shown(b'r', shown_s)),
                (1.0, 1.0, 0.0)
            );
        }
    }
}
