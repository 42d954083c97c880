//! Where and when another road user will be in a hero's way, if it keeps its speed and yaw rate.

use ipc_schema::world::{LONGEST_GAP_S, SENSING_M, VehicleState};

use super::{bodies::TickBody, route::HeroRoute};

/// Distance between the places of the way that are compared with a road user, metres: less than any two bodies are wide.
const SPACING_M: f64 = 1.5;
/// Part of a way that the hero itself covers, at most, metres.
const BEHIND_M: f64 = 15.0;
/// Places of a way: from the hero's rear bumper to [`SENSING_M`] before its front bumper.
const PLACES: usize = 45;
/// Room between two bodies that still counts as a meeting, metres.
const ROOM_M: f64 = 0.3;
/// A slower road user stands, m/s.
const STANDS_MPS: f64 = 0.3;
/// Speed that a hero has at least when the time to a place is counted, m/s.
const SLOWEST_MPS: f64 = 0.1;
/// A road user that turns slower drives straight on, rad/s: mirrored vehicles keep their lane with small corrections.
const TURNS_RADPS: f64 = 0.06;
/// A road user that turns ends its turn after this angle.
const WHOLE_TURN_RAD: f64 = std::f64::consts::FRAC_PI_2;

/// A meeting of a road user with the hero's way.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Encounter {
    /// Distance along the route from the hero's front bumper, metres; [`SENSING_M`] if there is none.
    pub way_m: f64,
    /// Time until the hero is there at its speed, seconds, at most [`LONGEST_GAP_S`].
    pub reaches_s: f64,
    /// Time until the road user's front is in the middle of the way there, seconds, at most [`LONGEST_GAP_S`].
    pub enters_s: f64,
    /// Time until its rear has left the middle of the way, seconds, at most [`LONGEST_GAP_S`].
    pub leaves_s: f64,
}

impl Encounter {
    /// The road user stays out of the way.
    pub const NONE: Self = Self {
        way_m: SENSING_M,
        reaches_s: LONGEST_GAP_S,
        enters_s: LONGEST_GAP_S,
        leaves_s: LONGEST_GAP_S,
    };
}

/// Places along the route that the hero is at or will come to.
#[derive(Debug)]
pub struct HeroWay {
    places_m: [[f64; 2]; PLACES],
    count: usize,
    /// Distance from the hero's front bumper to the first place, metres: not positive.
    first_m: f64,
    half_width_m: f64,
    speed_mps: f64,
}

impl HeroWay {
    /// The way of a hero with its front bumper at a station of its route.
    #[must_use]
    pub fn new(route: &HeroRoute, front_station_m: f64, hero: &VehicleState) -> Self {
        let first_m = -f64::from(hero.length_m).min(BEHIND_M);
        let end_m = (route.length_m() - front_station_m).min(SENSING_M);
        let mut way = Self {
            places_m: [[0.0; 2]; PLACES],
            count: 0,
            first_m,
            half_width_m: 0.5 * f64::from(hero.width_m),
            speed_mps: f64::from(hero.velocity_body_mps[0]),
        };
        for place_m in &mut way.places_m {
            let ahead_m = first_m + way.count as f64 * SPACING_M;
            match route.at(front_station_m + ahead_m) {
                Some(place) if ahead_m <= end_m => *place_m = place,
                _ => break,
            }
            way.count += 1;
        }
        way
    }

    /// The first meeting of a road user with the way.
    #[must_use]
    pub fn encounter(&self, other: &TickBody) -> Encounter {
        let path = PathAhead::of(other);
        let half_length_m = 0.5 * f64::from(other.length_m);
        let reach_m = self.half_width_m + 0.5 * f64::from(other.width_m) + ROOM_M;
        let speed_mps = other.speed_mps.max(STANDS_MPS);
        let horizon_m = match other.speed_mps < STANDS_MPS {
            true => 0.0,
            false => speed_mps * LONGEST_GAP_S,
        };
        let mut met: Option<(usize, f64, f64)> = None;
        for (number, place) in self.places_m[..self.count].iter().enumerate() {
            let meets = path
                .along_m(*place, reach_m)
                .filter(|along_m| *along_m > -half_length_m && *along_m - half_length_m <= horizon_m);
            match (meets, &mut met) {
                (Some(along_m), Some((_, least_m, most_m))) => {
                    *least_m = least_m.min(along_m);
                    *most_m = most_m.max(along_m);
                }
                (Some(along_m), None) => met = Some((number, along_m, along_m)),
                // The way meets the road user's path a second time, as on a roundabout: later.
                (None, Some(_)) => break,
                (None, None) => {}
            }
        }
        let Some((number, least_m, most_m)) = met else {
            return Encounter::NONE;
        };
        let way_m = (self.first_m + number as f64 * SPACING_M).clamp(0.0, SENSING_M);
        Encounter {
            way_m,
            reaches_s: (way_m / self.speed_mps.max(SLOWEST_MPS)).min(LONGEST_GAP_S),
            enters_s: ((least_m - half_length_m).max(0.0) / speed_mps).min(LONGEST_GAP_S),
            leaves_s: match other.speed_mps < STANDS_MPS {
                true => LONGEST_GAP_S,
                false => ((most_m + half_length_m) / speed_mps).min(LONGEST_GAP_S),
            },
        }
    }
}

/// The path of a road user's middle: a line or an arc.
#[derive(Debug, Clone, Copy)]
struct PathAhead {
    middle_m: [f64; 2],
    /// Of length one.
    direction: [f64; 2],
    /// Positive to the left; `None` for a line.
    radius_m: Option<f64>,
}

impl PathAhead {
    fn of(body: &TickBody) -> Self {
        let [vx, vy] = body.velocity_mps;
        let turns = body.yaw_rate_radps.abs() > TURNS_RADPS;
        Self {
            middle_m: body.middle_m,
            direction: match body.speed_mps < STANDS_MPS {
                true => body.heading,
                false => [vx / body.speed_mps, vy / body.speed_mps],
            },
            radius_m: (turns && body.speed_mps >= STANDS_MPS).then(|| body.speed_mps / body.yaw_rate_radps),
        }
    }

    /// Distance along the path to the place nearest to a point, negative behind the middle; `None` if the point is farther beside it than
    /// `reach_m`, or beyond the end of a turn.
    fn along_m(&self, [x, y]: [f64; 2], reach_m: f64) -> Option<f64> {
        let (dx, dy) = (x - self.middle_m[0], y - self.middle_m[1]);
        let [ux, uy] = self.direction;
        let (ahead_m, left_m) = (dx * ux + dy * uy, ux * dy - uy * dx);
        let Some(radius_m) = self.radius_m else {
            return (left_m.abs() < reach_m).then_some(ahead_m);
        };
        // In a frame whose origin is the middle of the arc, seen so that the arc turns to the left.
        let (side, radius_m) = (radius_m.signum(), radius_m.abs());
        let inward_m = radius_m - side * left_m;
        let from_middle_m = libm::sqrt(ahead_m * ahead_m + inward_m * inward_m);
        if (from_middle_m - radius_m).abs() >= reach_m {
            return None;
        }
        let turned_rad = libm::atan2(ahead_m, inward_m);
        (turned_rad.abs() < WHOLE_TURN_RAD).then_some(radius_m * turned_rad)
    }
}

#[cfg(test)]
mod tests {
    use ipc_schema::traffic::RoutePoint;

    use super::*;

    /// The way of a hero that long, in the middle of 200 m along x.
    fn way_of(length_m: f32) -> HeroWay {
        let mut route = HeroRoute::default();
        for (x_m, index) in [(0.0, 0), (200.0, 1)] {
            route.push(&RoutePoint {
                x_m,
                index,
                ..RoutePoint::default()
            });
        }
        let hero = VehicleState {
            length_m,
            width_m: 2.0,
            velocity_body_mps: [9.0, 0.0, 0.0],
            ..VehicleState::default()
        };
        HeroWay::new(&route, 100.0, &hero)
    }

    fn way() -> HeroWay {
        way_of(4.5)
    }

    fn car([x_m, y_m]: [f64; 2], yaw_rad: f64, speed_mps: f32, yaw_rate_radps: f32) -> TickBody {
        TickBody::of(&VehicleState {
            x_m,
            y_m,
            yaw_rad,
            length_m: 4.0,
            width_m: 2.0,
            rear_overhang_m: 2.0,
            velocity_body_mps: [speed_mps, 0.0, 0.0],
            angular_rate_body_radps: [0.0, 0.0, yaw_rate_radps],
            ..VehicleState::default()
        })
    }

    fn seen(body: &TickBody) -> [f64; 3] {
        let seen = way().encounter(body);
        if seen != Encounter::NONE {
            assert_eq!(seen.reaches_s, seen.way_m / 9.0);
        }
        [seen.way_m, seen.enters_s, seen.leaves_s].map(|value| (value * 1e3).round() / 1e3)
    }

    const NONE: [f64; 3] = [SENSING_M, LONGEST_GAP_S, LONGEST_GAP_S];

    #[test]
    fn what_crosses_is_met_where_its_side_comes_and_until_its_rear_has_left() {
        let south = -std::f64::consts::FRAC_PI_2;
        // 30 m to the left at 10 m/s: its middle is at the centre line after 3 s. Places are 1.5 m apart, the first at -4.5 m, and what
        // it passes over is 2.3 m to each side of x = 120 m.
        let crosses = car([120.0, 30.0], south, 10.0, 0.0);
        assert_eq!(seen(&crosses), [18.0, 2.8, 3.2]);
        // After it has crossed it is no matter; with its rear still in the way it is.
        assert_eq!(seen(&car([120.0, -2.1], south, 10.0, 0.0)), NONE);
        assert_eq!(seen(&car([120.0, -1.0], south, 10.0, 0.0)), [18.0, 0.0, 0.1]);
        // One that crosses behind the hero's rear bumper is no matter either.
        assert_eq!(seen(&car([90.0, 30.0], south, 10.0, 0.0)), NONE);
    }

    #[test]
    fn what_drives_or_stands_in_the_way_is_met_at_its_rear() {
        // Rear bumper 28 m ahead; its way is looked at as far as 49.5 m ahead.
        assert_eq!(seen(&car([130.0, 0.0], 0.0, 5.0, 0.0)), [28.5, 0.0, 4.3]);
        assert_eq!(seen(&car([130.0, 0.0], 0.0, 0.0, 0.0)), [28.5, 0.0, LONGEST_GAP_S]);
        // In the next lane, and across the road without reaching the way.
        assert_eq!(seen(&car([130.0, 3.2], 0.0, 5.0, 0.0)), NONE);
        assert_eq!(seen(&car([130.0, 8.0], -1.0, 0.0, 0.0)), NONE);
        // Oncoming in the hero's lane.
        assert_eq!(seen(&car([130.0, 0.0], std::f64::consts::PI, 10.0, 0.0))[0], 0.0);
    }

    #[test]
    fn a_way_reaches_as_far_before_a_long_hero_as_before_a_short_one() {
        for length_m in [2.0, 4.5, 12.0, 18.0] {
            let seen = way_of(length_m).encounter(&car([150.0, 0.0], 0.0, 0.0, 0.0));
            assert!((seen.way_m - 48.0).abs() <= SPACING_M, "{length_m} m: {seen:?}");
        }
    }

    #[test]
    fn what_turns_is_met_on_its_arc() {
        let west = std::f64::consts::PI;
        // Oncoming one lane to the left, turning left on a radius of 10 m: it crosses x = 130 m - 10 m · sin, y = 3.2 m - 10 m · (1 - cos).
        let turns = seen(&car([130.0, 3.2], west, 5.0, 0.5));
        let angle = libm::acos(1.0 - 3.2 / 10.0);
        assert!((turns[0] - (30.0 - 10.0 * libm::sin(angle))).abs() < 3.0, "{turns:?}");
        assert!(turns[1] < angle / 0.5 && turns[2] > angle / 0.5, "{turns:?}");
        // To the right it leaves, and straight on it passes.
        assert_eq!(seen(&car([130.0, 3.2], west, 5.0, -0.5)), NONE);
        assert_eq!(seen(&car([130.0, 3.2], west, 5.0, 0.01)), NONE);
    }

    #[test]
    fn an_arc_meets_what_its_road_user_meets_when_it_is_moved_step_by_step() {
        let way = way();
        for number in 0..2_000_u32 {
            let unit =
                |part: u32| f64::from((number * 7 + part * 131).wrapping_mul(2_654_435_761) >> 8) / f64::from(1 << 24);
            let place = [80.0 + 80.0 * unit(1), -30.0 + 60.0 * unit(2)];
            let body = car(
                place,
                std::f64::consts::TAU * unit(3),
                (1.0 + 12.0 * unit(4)) as f32,
                (unit(5) - 0.5) as f32,
            );
            let found = way.encounter(&body);
            // The middle of the body, for nearly as long as a turn lasts.
            let path = PathAhead::of(&body);
            let whole_s = path.radius_m.map_or(LONGEST_GAP_S, |radius_m| {
                0.8 * WHOLE_TURN_RAD * radius_m.abs() / body.speed_mps
            });
            let mut first_s = None;
            for step in 0..1000 {
                let time_s = f64::from(step) * 0.01;
                if time_s > whole_s.min(LONGEST_GAP_S) {
                    break;
                }
                let [ux, uy] = path.direction;
                let (ahead_m, left_m) = match path.radius_m {
                    None => (body.speed_mps * time_s, 0.0),
                    Some(radius_m) => {
                        let turned = body.speed_mps * time_s / radius_m;
                        (radius_m * libm::sin(turned), radius_m * (1.0 - libm::cos(turned)))
                    }
                };
                let at = [
                    body.middle_m[0] + ahead_m * ux - left_m * uy,
                    body.middle_m[1] + ahead_m * uy + left_m * ux,
                ];
                // Well within the strip and the part of the way that is looked at.
                if at[1].abs() < 1.0 && at[0] > 97.0 && at[0] < 145.0 {
                    first_s = Some(time_s);
                    break;
                }
            }
            if let Some(first_s) = first_s {
                assert!(
                    found.enters_s <= first_s + 0.01,
                    "{body:?}: {found:?}, in the way after {first_s} s"
                );
            }
        }
    }
}
