//! When a station sends which message: the generation rules of the standards, as functions of measured motion and time.

pub mod bsm;
pub mod cam;
pub mod congestion;
pub mod cpm;
pub mod denm;
pub mod edge;
pub mod relay;
pub mod vam;

/// Nanoseconds in a millisecond.
pub const MS: u64 = 1_000_000;
/// Change of the position from which a road user has news, metres (EN 302 637-2, TS 103 324, TS 103 300-3).
pub const POSITION_CHANGE_M: f64 = 4.0;
/// Change of the speed from which a road user has news, m/s.
pub const SPEED_CHANGE_MPS: f64 = 0.5;
/// Change of the heading from which a road user has news, radians: 4°.
pub const HEADING_CHANGE_RAD: f64 = 4.0 * std::f64::consts::PI / 180.0;

/// Motion of a station or an object as it was measured.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct MeasuredMotion {
    /// x and y, world, metres.
    pub position_m: [f64; 2],
    /// Speed, m/s.
    pub speed_mps: f64,
    /// Direction, radians counter-clockwise from east.
    pub heading_rad: f64,
}

impl MeasuredMotion {
    /// True if this motion differs from `before` by more than one of the thresholds.
    #[must_use]
    pub fn has_news_since(&self, before: &Self) -> bool {
        let [dx, dy] = [0, 1].map(|axis: usize| self.position_m[axis] - before.position_m[axis]);
        libm::hypot(dx, dy) > POSITION_CHANGE_M
            || (self.speed_mps - before.speed_mps).abs() > SPEED_CHANGE_MPS
            || turn(before.heading_rad, self.heading_rad).abs() > HEADING_CHANGE_RAD
    }
}

/// Angle from heading `from_rad` to heading `to_rad`, in [−π, π), radians.
#[must_use]
pub fn turn(from_rad: f64, to_rad: f64) -> f64 {
    let turn = (to_rad - from_rad).rem_euclid(std::f64::consts::TAU);
    if turn >= std::f64::consts::PI {
        turn - std::f64::consts::TAU
    } else {
        turn
    }
}
