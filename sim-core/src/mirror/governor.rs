//! The governor: limits a path to what the vehicle can drive, and returns to the path afterwards.
//!
//! SUMO drives kinks of 80° at 17 m/s, takes bends faster than the tyres allow, and accelerates at 30 m/s as at 3 m/s. The
//! reference leaves SUMO's path there: `reference = path + offset`, with an acceleration that never exceeds what the vehicle can do. Once
//! the path is drivable again the offset returns like a critically damped spring, in driving time: it freezes
//! while the vehicle stands.

use super::curve::ReferenceCurve;

/// Rate at which an offset returns, 1/s.
const RETURN_PER_S: f64 = 1.2;
/// Below this speed offsets return by distance, m/s.
const SLOW_MPS: f64 = 3.0;
/// Least share of the driving time that passes while a reference is moved.
const LEAST_PACE: f64 = 0.2;
/// Below this speed nothing is limited, because a slow vehicle can be steered, m/s.
const CRAWL_MPS: f64 = 1.0;
/// Offsets and rates below this count as zero, metres and m/s.
const NONE: f64 = 1e-4;

/// Limits of a vehicle on a level road.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DrivingLimits {
    /// Largest lateral acceleration, m/s².
    pub lateral_mps2: f64,
    /// Largest curvature, 1/m.
    pub curvature_per_m: f64,
    /// Largest acceleration, m/s².
    pub accel_mps2: f64,
    /// Largest deceleration, m/s².
    pub decel_mps2: f64,
    /// Driving power by mass, m²/s³.
    pub power_by_mass: f64,
    /// Drag by mass and speed squared, 1/m.
    pub drag_by_mass_per_m: f64,
    /// Rolling resistance by mass, m/s².
    pub rolling_mps2: f64,
}

impl DrivingLimits {
    /// No motion at all.
    pub const NONE: Self = Self {
        lateral_mps2: 0.0,
        curvature_per_m: 0.0,
        accel_mps2: 0.0,
        decel_mps2: 0.0,
        power_by_mass: 0.0,
        drag_by_mass_per_m: 0.0,
        rolling_mps2: 0.0,
    };

    /// Largest acceleration, deceleration and lateral acceleration at a speed, m/s².
    pub(super) fn at(&self, speed_mps: f64) -> [f64; 3] {
        let power =
            self.power_by_mass / speed_mps - self.drag_by_mass_per_m * speed_mps * speed_mps - self.rolling_mps2;
        [
            self.accel_mps2.min(power).max(0.1),
            self.decel_mps2,
            self.lateral_mps2.min(self.curvature_per_m * speed_mps * speed_mps),
        ]
    }
}

/// The offset of a reference from its path.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct ReferenceGovernor {
    /// World frame, metres.
    offset_m: [f64; 2],
    /// Its rate while the vehicle moves at [`SLOW_MPS`] or more, m/s.
    rate_mps: [f64; 2],
}

impl ReferenceGovernor {
    /// Distance of the reference from its path, metres.
    #[must_use]
    pub fn distance_m(&self) -> f64 {
        norm(self.offset_m)
    }

    /// Makes the reference one that is `away_m` from the present one and leaves it at `leaving_mps`, where the path has this speed.
    pub fn move_reference(&mut self, away_m: [f64; 2], leaving_mps: [f64; 2], speed_mps: f64) {
        let pace = (speed_mps / SLOW_MPS).clamp(LEAST_PACE, 1.0);
        for axis in 0..2 {
            self.offset_m[axis] += away_m[axis];
            self.rate_mps[axis] += leaving_mps[axis] / pace;
        }
    }

    /// The reference over a tick of `tick_s` for a path over the same tick.
    #[must_use]
    pub fn tick(&mut self, path: &ReferenceCurve, tick_s: f64, ability: &DrivingLimits) -> ReferenceCurve {
        let middle = path.at(0.5 * tick_s);
        let speed = norm(middle.velocity_mps);
        let away = self.offset_m != [0.0; 2] || self.rate_mps != [0.0; 2];
        if !away && (speed < CRAWL_MPS || within(middle.bend_mps2, middle.velocity_mps, speed, ability)) {
            return *path;
        }
        let pace = |t_s: f64| (norm(path.at(t_s).velocity_mps) / SLOW_MPS).min(1.0);
        let (first, last) = (pace(0.0), pace(tick_s));
        let mean = 0.5 * (first + last);
        let back =
            |axis: usize| -RETURN_PER_S * (2.0 * self.rate_mps[axis] + RETURN_PER_S * self.offset_m[axis]) * mean;
        let mut push = [back(0), back(1)];
        if speed >= CRAWL_MPS {
            let wanted = [0, 1].map(|axis: usize| middle.bend_mps2[axis] + mean * push[axis]);
            let held = hold(wanted, middle.velocity_mps, speed, ability);
            push = [0, 1].map(|axis: usize| push[axis] + (held[axis] - wanted[axis]) / mean);
        }
        let before = *self;
        for (axis, push) in push.into_iter().enumerate() {
            self.rate_mps[axis] += push * tick_s;
            self.offset_m[axis] += 0.5 * tick_s * (first * before.rate_mps[axis] + last * self.rate_mps[axis]);
        }
        if norm(self.offset_m) < NONE && norm(self.rate_mps) < NONE {
            *self = Self::default();
        }
        let moved = [0, 1].map(|axis: usize| self.offset_m[axis] - before.offset_m[axis]);
        let rates = [
            before.rate_mps.map(|rate| first * rate),
            self.rate_mps.map(|rate| last * rate),
        ];
        let mut reference = path.plus(&ReferenceCurve::hermite(before.offset_m, moved, rates, tick_s));
        let along = [0, 1].map(|axis: usize| (rates[1][axis] - rates[0][axis]) / tick_s * middle.velocity_mps[axis]);
        reference.accel_mps2 += (along[0] + along[1]) / speed.max(CRAWL_MPS);
        reference
    }
}

/// Acceleration along the velocity and to its left.
fn split(accel: [f64; 2], velocity: [f64; 2], speed: f64) -> [f64; 2] {
    [
        (accel[0] * velocity[0] + accel[1] * velocity[1]) / speed,
        (accel[1] * velocity[0] - accel[0] * velocity[1]) / speed,
    ]
}

fn within(accel: [f64; 2], velocity: [f64; 2], speed: f64, ability: &DrivingLimits) -> bool {
    let [along, left] = split(accel, velocity, speed);
    let [accel, decel, lateral] = ability.at(speed);
    along <= accel && along >= -decel && left.abs() <= lateral
}

/// The acceleration nearest to `accel` that the vehicle can do.
fn hold(accel: [f64; 2], velocity: [f64; 2], speed: f64, ability: &DrivingLimits) -> [f64; 2] {
    let [along, left] = split(accel, velocity, speed);
    let [most, decel, lateral] = ability.at(speed);
    let (along, left) = (along.clamp(-decel, most), left.clamp(-lateral, lateral));
    [
        (along * velocity[0] - left * velocity[1]) / speed,
        (along * velocity[1] + left * velocity[0]) / speed,
    ]
}

fn norm(a: [f64; 2]) -> f64 {
    (a[0] * a[0] + a[1] * a[1]).sqrt()
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const TICK_S: f64 = 0.1;
    const ABILITY: DrivingLimits = DrivingLimits {
        lateral_mps2: 7.0,
        curvature_per_m: 0.2,
        accel_mps2: 4.0,
        decel_mps2: 9.0,
        power_by_mass: 60.0,
        drag_by_mass_per_m: 3e-4,
        rolling_mps2: 0.1,
    };

    /// A path at 15 m/s that turns at once by `angle_rad` (spread over one tick, as the path does), then goes straight.
    fn kink(angle_rad: f64) -> impl Fn(usize) -> ReferenceCurve {
        move |tick| {
            let (sin, cos) = libm::sincos(angle_rad);
            let (before, after) = ([15.0, 0.0], [15.0 * cos, 15.0 * sin]);
            let mean = [0, 1].map(|i: usize| 0.5 * TICK_S * (before[i] + after[i]));
            match tick {
                0..10 => ReferenceCurve::straight([1.5 * tick as f64, 0.0], before),
                10 => ReferenceCurve::hermite([15.0, 0.0], mean, [before, after], TICK_S),
                _ => {
                    let since = TICK_S * (tick - 11) as f64;
                    ReferenceCurve::straight([0, 1].map(|i| [15.0, 0.0][i] + mean[i] + since * after[i]), after)
                }
            }
        }
    }

    proptest! {
        #[test]
        fn a_reference_can_be_driven_and_returns(angle_rad in -1.2_f64..1.2) {
            let path = kink(angle_rad);
            let mut governor = ReferenceGovernor::default();
            let mut end: Option<super::super::curve::ReferencePoint> = None;
            for tick in 0..200 {
                let reference = governor.tick(&path(tick), TICK_S, &ABILITY);
                let start = reference.at(0.0);
                if let Some(end) = end {
                    let jump = norm([0, 1].map(|i: usize| start.position_m[i] - end.position_m[i]));
                    let kick = norm([0, 1].map(|i: usize| start.velocity_mps[i] - end.velocity_mps[i]));
                    prop_assert!(jump < 1e-3 && kick < 1e-3, "tick {}: {} m, {} m/s", tick, jump, kick);
                }
                end = Some(reference.at(TICK_S));
                let change = [0, 1].map(|i: usize| (end.unwrap().velocity_mps[i] - start.velocity_mps[i]) / TICK_S);
                prop_assert!(norm(change) < 12.0, "tick {}: {:?}", tick, change);
            }
            prop_assert!(governor.distance_m() < 0.01, "{}", governor.distance_m());
        }
    }

    #[test]
    fn a_drivable_path_is_left_alone() {
        let curve = ReferenceCurve::hermite([0.0, 0.0], [1.5, 0.01], [[15.0, 0.0], [15.0, 0.2]], TICK_S);
        let mut governor = ReferenceGovernor::default();
        assert_eq!(governor.tick(&curve, TICK_S, &ABILITY), curve);
        assert_eq!(governor, ReferenceGovernor::default());
    }
}
