//! Vehicle models and their limits.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::serde_as_text;
use crate::traffic::VEHICLE_CLASSES;

/// Vehicle models and their limits.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct VehicleConfig {
    /// Model of connected vehicles.
    pub cav_model: SingleTrackModel,
    /// Model of vehicles without sensors.
    pub other_model: SingleTrackModel,
    /// Model of heroes.
    pub hero_model: VehicleModel,
    /// Models by SUMO class; they have precedence over the three above.
    pub class_models: Vec<ClassModel>,
    /// How far ahead a mirror sees SUMO's path: so far it is behind SUMO, seconds. At least half a SUMO step.
    pub preview_s: f64,
    /// Time over which an instantaneous lane change is spread, seconds.
    pub lane_change_s: f64,
    /// Largest road-wheel angle, radians.
    pub max_road_wheel_angle_rad: f64,
    /// Largest rate of the road-wheel angle, rad/s.
    pub max_road_wheel_rate_radps: f64,
    /// Largest acceleration of the mirror, m/s².
    pub max_accel_mps2: f64,
    /// Largest deceleration of the mirror, m/s².
    pub max_decel_mps2: f64,
    /// Steering-wheel angle per road-wheel angle.
    pub steering_ratio: f64,
    /// Tracking error beyond which the mirror is set onto SUMO, metres.
    pub resynchronise_m: f64,
    /// Distance between the reference and SUMO's path, because that cannot be driven, beyond which the mirror is set onto SUMO, metres.
    pub leave_path_m: f64,
}

/// Most SUMO states in a mirror's window.
const MOST_WINDOW_STATES: usize = 16;

impl VehicleConfig {
    /// Number of SUMO states, `step_s` apart, whose mean a mirror follows: followed half a step behind, the mean is
    /// [`preview_s`](Self::preview_s) behind SUMO. 1 if a step is too long for that.
    #[must_use]
    pub fn window_states(&self, step_s: f64) -> usize {
        window_states(self.preview_s, step_s)
    }
}

fn window_states(preview_s: f64, step_s: f64) -> usize {
    // A little more than the quotient: 0.45 / 0.1 is less than 4.5.
    let steps = 2.0 * (preview_s - 0.5 * step_s) / step_s + 1e-6;
    #[expect(
        clippy::cast_possible_truncation,
        clippy::cast_sign_loss,
        reason = "between 0 and MOST_WINDOW_STATES"
    )]
    let steps = steps.clamp(0.0, (MOST_WINDOW_STATES - 1) as f64) as usize;
    steps + 1
}

/// A model that any vehicle may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum SingleTrackModel {
    /// Single track without slip.
    Kinematic,
    /// Single track with saturating tyres, load transfer, roll and pitch.
    Dynamic,
}

/// A model that a hero may have.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum VehicleModel {
    /// Single track without slip.
    Kinematic,
    /// Single track with saturating tyres, load transfer, roll and pitch.
    Dynamic,
    /// Rigid body on four ray-cast wheels.
    RigidBody,
}

impl From<SingleTrackModel> for VehicleModel {
    fn from(model: SingleTrackModel) -> Self {
        match model {
            SingleTrackModel::Kinematic => Self::Kinematic,
            SingleTrackModel::Dynamic => Self::Dynamic,
        }
    }
}

/// The model of a vehicle class. Configurations and run files write it as "class=model".
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct ClassModel {
    /// The class.
    pub class: VehicleClass,
    /// Its model.
    pub model: SingleTrackModel,
}

/// A vehicle class of SUMO: one of [`VEHICLE_CLASSES`].
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub struct VehicleClass(&'static str);

impl VehicleClass {
    /// The class of this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        VEHICLE_CLASSES.into_iter().find(|class| *class == name).map(Self)
    }

    /// SUMO's name of the class.
    #[must_use]
    pub fn name(self) -> &'static str {
        self.0
    }
}

/// The text is not a vehicle class with its model.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is no vehicle class of SUMO with a model")]
pub struct ClassModelError(pub String);

serde_as_text!(ClassModel);

impl FromStr for ClassModel {
    type Err = ClassModelError;

    fn from_str(text: &str) -> Result<Self, ClassModelError> {
        let malformed = || ClassModelError(text.to_owned());
        let (class, model) = text.split_once('=').ok_or_else(malformed)?;
        let model = match model.trim() {
            "kinematic" => SingleTrackModel::Kinematic,
            "dynamic" => SingleTrackModel::Dynamic,
            _ => return Err(malformed()),
        };
        let class = VehicleClass::by_name(class.trim()).ok_or_else(malformed)?;
        Ok(Self { class, model })
    }
}

impl fmt::Display for ClassModel {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        let model = match self.model {
            SingleTrackModel::Kinematic => "kinematic",
            SingleTrackModel::Dynamic => "dynamic",
        };
        write!(formatter, "{}={model}", self.class.name())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_class_with_its_model_comes_back_from_json() {
        let entry: ClassModel = serde_json::from_str("\" bus = kinematic \"").unwrap();
        assert_eq!((entry.class.name(), entry.model), ("bus", SingleTrackModel::Kinematic));
        assert_eq!(serde_json::to_string(&entry).unwrap(), "\"bus=kinematic\"");
        for text in ["bus", "bus=flying", "bus=rigid_body", "hovercraft=dynamic", "=dynamic"] {
            assert_eq!(text.parse::<ClassModel>(), Err(ClassModelError(text.to_owned())));
        }
    }

    #[test]
    fn the_whole_delay_is_the_preview_at_every_step() {
        for (step_s, states) in [
            (0.1, 10),
            (0.2, 5),
            (0.5, 2),
            (1.0, 1),
            (2.0, 1),
            (0.01, MOST_WINDOW_STATES),
        ] {
            assert_eq!(window_states(0.5, step_s), states, "{step_s}");
        }
        assert_eq!(window_states(0.0, 0.1), 1);
    }
}
