//! The action of a hero: its range, and the control input that it stands for.

use bytemuck::{Pod, Zeroable};
use ipc_schema::config;

use crate::models::state::ControlInput;

/// Steering and acceleration, each in −1 … 1.
pub type HeroAction = [f32; 2];

/// The action of a hero, as it is logged.
#[repr(C)]
#[derive(Debug, Clone, Copy, PartialEq, Pod, Zeroable)]
pub struct LoggedAction {
    /// Dense index of the hero.
    pub vehicle: u32,
    /// Steering and acceleration, as they came.
    pub action: HeroAction,
}

/// The control input of an action: −1 … 1 of the largest road-wheel angle (left is positive), and of the largest
/// acceleration or deceleration.
#[must_use]
pub fn input([steering, acceleration]: HeroAction, limits: &config::VehicleConfig) -> ControlInput {
    let largest_mps2 = if acceleration > 0.0 {
        limits.max_accel_mps2
    } else {
        limits.max_decel_mps2
    };
    ControlInput {
        accel_mps2: f64::from(acceleration) * largest_mps2,
        road_wheel_angle_rad: f64::from(steering) * limits.max_road_wheel_angle_rad,
    }
}

/// The part of an action that cannot be used, by name and value: not a number, or beyond −1 … 1.
#[must_use]
pub fn fault(action: HeroAction) -> Option<(&'static str, f32)> {
    ["steering", "acceleration"]
        .into_iter()
        .zip(action)
        .find(|(_, value)| !(-1.0..=1.0).contains(value))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_action_that_is_not_a_number_or_out_of_range_is_a_fault() {
        assert_eq!(fault([1.0, -1.0]), None);
        assert_eq!(fault([0.0, 1.5]), Some(("acceleration", 1.5)));
        assert!(matches!(fault([f32::NAN, 0.0]), Some(("steering", value)) if value.is_nan()));
        assert_eq!(
            fault([0.0, f32::NEG_INFINITY]),
            Some(("acceleration", f32::NEG_INFINITY))
        );
    }
}
