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
    /// How far ahead a mirror sees SUMO's path: so far it is behind SUMO, seconds. At least half a frame.
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
    /// Steering-wheel angle per road-wheel angle of every vehicle; 0 = each that of its parameter set.
    pub steering_ratio: f64,
    /// Tracking error beyond which the mirror is set onto SUMO, metres.
    pub resynchronise_m: f64,
    /// Distance between the reference and SUMO's path, because that cannot be driven, beyond which the mirror is set onto SUMO, metres.
    pub leave_path_m: f64,
}

/// Most SUMO states in a mirror's window.
const MOST_WINDOW_STATES: usize = 16;
/// Most frames that a mirror is behind its window.
const MOST_LATE_FRAMES: usize = 16;

/// Share of a preview by which a mirror is behind its path.
const LATE_SHARE: f64 = 0.55;

/// How a mirror sees the path ahead, in frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PreviewFrames {
    /// States of SUMO whose mean is the path.
    pub window_states: usize,
    /// Frames by which the mirror is behind the newest mean.
    pub late: usize,
}

impl PreviewFrames {
    /// The whole delay behind SUMO, half a frame rounded down.
    #[must_use]
    pub fn delay(self) -> usize {
        self.window_states / 2 + self.late
    }

    fn of(preview_s: f64, frame_s: f64) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a small number that is not negative"
        )]
        // A little more than the quotient: 0.45 / 0.1 is less than 4.5.
        let frames = |time_s: f64| (time_s / frame_s + 1e-6).max(0.0) as usize;
        let late = frames(LATE_SHARE * preview_s).min(MOST_LATE_FRAMES);
        let rest_s = preview_s - late as f64 * frame_s;
        let more_states = frames(2.0 * rest_s - frame_s).min(MOST_WINDOW_STATES - 1);
        Self {
            window_states: more_states + 1,
            late,
        }
    }
}

impl VehicleConfig {
    /// What [`preview_s`](Self::preview_s) means with frames of `frame_s`: somewhat more than half of it is how far a mirror is behind its
    /// path, the rest how far the path, the mean of SUMO's states followed half a frame behind, is behind SUMO. `None` without a preview, or if
    /// a frame is too long for it.
    #[must_use]
    pub fn preview(&self, frame_s: f64) -> Option<PreviewFrames> {
        let preview = PreviewFrames::of(self.preview_s, frame_s);
        (preview.delay() > 0).then_some(preview)
    }
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
    fn the_whole_delay_is_the_preview_at_every_frame() {
        let cases = [
            (1.5, 0.1, (14, 8)),
            (1.5, 0.2, (7, 4)),
            (1.5, 0.5, (4, 1)),
            (0.5, 0.1, (6, 2)),
            (2.0, 0.01, (MOST_WINDOW_STATES, MOST_LATE_FRAMES)),
            (0.5, 1.0, (1, 0)),
            (0.0, 0.1, (1, 0)),
        ];
        for (preview_s, frame_s, (window_states, late)) in cases {
            let expected = PreviewFrames { window_states, late };
            assert_eq!(PreviewFrames::of(preview_s, frame_s), expected, "{preview_s} {frame_s}");
        }
        // The mean of 14 states, followed half a frame behind, and eight frames.
        assert_eq!(PreviewFrames::of(1.5, 0.1).delay(), 15);
    }
}
