//! Parameter sets of vehicles, read from `data/vehicles.toml`: which set a vehicle of SUMO gets, and how it scales.

use ipc_schema::config::VehicleConfig;
use serde::Deserialize;

use super::{
    articulation::{Articulation, TrailingBodies},
    dimensions::VehicleDimensions,
    dynamic::{AIR_KGPM3, GRAVITY_MPS2},
};

/// Share of the power that references use; the tracker uses the rest to follow them.
pub const POWER_SHARE: f64 = 0.8;

/// The committed sets.
const SETS: &str = include_str!("../../data/vehicles.toml");

/// The parameter sets cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum ParameterError {
    /// Not TOML, or a key is missing or unknown.
    #[error("the parameter sets of vehicles cannot be read")]
    Format(#[from] toml::de::Error),
    /// Not exactly one default.
    #[error("{count} parameter sets of vehicles are marked `default`; exactly one must be")]
    Default {
        /// How many are.
        count: usize,
    },
}

/// One parameter set. SI units and radians.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ParameterSet {
    /// Name.
    pub name: String,
    /// True for the set of classes that no set lists.
    pub default: bool,
    /// SUMO vehicle classes.
    pub classes: Vec<String>,
    /// True if the kinematic model moves it unless the configuration names another for the class.
    #[serde(default)]
    pub kinematic: bool,
    /// Longest vehicle that gets this set, metres.
    pub longest_m: f64,
    /// Its further bodies; `None` if it has one.
    #[serde(default)]
    pub articulation: Option<Articulation>,
    /// Bumper to bumper, metres. Of an articulated vehicle: of its leading body, as all that follows but mass, power and drag.
    pub length_m: f64,
    /// Metres.
    pub width_m: f64,
    /// Metres.
    pub height_m: f64,
    /// Rear axle to front axle, metres.
    pub wheelbase_m: f64,
    /// Rear axle to the rear end of the body, metres; negative if the body ends before the axle.
    pub rear_overhang_m: f64,
    /// Mass, kg. Of a vehicle on rails: of one carriage, as power and drag.
    pub mass_kg: f64,
    /// Moment of inertia about the vertical axis through the centre of gravity, kg m².
    pub yaw_inertia_kgm2: f64,
    /// Share of the weight on the front axle.
    pub front_load_share: f64,
    /// Height of the centre of gravity, metres.
    pub cg_height_m: f64,
    /// Lateral force by vertical load and slip angle, front axle, 1/rad.
    pub cornering_stiffness_front_per_rad: f64,
    /// Lateral force by vertical load and slip angle, rear axle, 1/rad.
    pub cornering_stiffness_rear_per_rad: f64,
    /// Greatest force by vertical load on dry asphalt.
    pub friction: f64,
    /// Steady roll by lateral acceleration, rad per m/s²; positive leans out of the bend.
    pub roll_per_mps2_rad: f64,
    /// Natural frequency of roll, Hz.
    pub roll_frequency_hz: f64,
    /// Damping ratio of roll.
    pub roll_damping_ratio: f64,
    /// Steady pitch by longitudinal acceleration, rad per m/s²; positive lifts the nose when accelerating.
    pub pitch_per_mps2_rad: f64,
    /// Natural frequency of pitch, Hz.
    pub pitch_frequency_hz: f64,
    /// Damping ratio of pitch.
    pub pitch_damping_ratio: f64,
    /// Share of the driving force on the front axle.
    pub drive_share_front: f64,
    /// Greatest driving power, W.
    pub max_power_w: f64,
    /// Greatest acceleration, m/s².
    pub max_accel_mps2: f64,
    /// Share of the braking force on the front axle.
    pub brake_share_front: f64,
    /// Greatest deceleration of the brakes, m/s².
    pub max_decel_mps2: f64,
    /// Drag coefficient times frontal area, m².
    pub drag_area_m2: f64,
    /// Rolling resistance by weight.
    pub rolling_resistance: f64,
    /// Greatest road-wheel angle, radians.
    pub max_road_wheel_angle_rad: f64,
    /// Greatest rate of the road-wheel angle, rad/s.
    pub max_road_wheel_rate_radps: f64,
    /// Steering-wheel angle by road-wheel angle.
    pub steering_ratio: f64,
    /// Where the numbers come from.
    pub source: String,
}

/// What SUMO's vehicle type lets a vehicle do. Zeros limit nothing: the type is unknown.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct TypeLimits {
    /// Largest acceleration, m/s².
    pub accel_mps2: f64,
    /// Largest deceleration, in an emergency too, m/s².
    pub decel_mps2: f64,
    /// Top speed, m/s.
    pub speed_mps: f64,
}

/// What a mirror needs by what SUMO does, so that it can catch up.
const RESERVE: f64 = 1.1;
/// Fastest vehicle for which power is provided, m/s: types without a limit have a top speed of thousands.
const FASTEST_MPS: f64 = 100.0;

impl TypeLimits {
    /// The configured limits, and at least those of the type.
    #[must_use]
    pub fn raised(&self, limits: &VehicleConfig) -> VehicleConfig {
        VehicleConfig {
            max_accel_mps2: limits.max_accel_mps2.max(RESERVE * self.accel_mps2),
            max_decel_mps2: limits.max_decel_mps2.max(self.decel_mps2),
            ..limits.clone()
        }
    }
}

impl ParameterSet {
    /// This set for a vehicle of SUMO's type: as strong as its own numbers say, and at least as strong as SUMO drives it. SUMO
    /// accelerates at the type's acceleration up to the top speed, whatever that takes.
    #[must_use]
    pub fn strengthened(&self, limits: &TypeLimits, body: &VehicleDimensions) -> Self {
        let (mass_kg, speed_mps) = (self.mass_kg(body), limits.speed_mps.min(FASTEST_MPS));
        let drag_mps2 = 0.5 * AIR_KGPM3 * self.drag_area_m2 / mass_kg * speed_mps * speed_mps;
        let resistance_mps2 = drag_mps2 + self.rolling_resistance * GRAVITY_MPS2;
        let power_w = mass_kg * speed_mps * (limits.accel_mps2 + resistance_mps2) / POWER_SHARE;
        Self {
            max_accel_mps2: self.max_accel_mps2.max(RESERVE * limits.accel_mps2),
            max_decel_mps2: self.max_decel_mps2.max(limits.decel_mps2),
            max_power_w: self.max_power_w.max(RESERVE * power_w),
            ..self.clone()
        }
    }

    /// SUMO's length of the vehicle that the values belong to, metres: with a trailer that of the whole.
    #[must_use]
    pub fn whole_length_m(&self) -> f64 {
        match self.articulation {
            Some(Articulation::Trailer { whole_length_m, .. }) => whole_length_m,
            Some(Articulation::Carriages { .. }) | None => self.length_m,
        }
    }

    /// Size and axles of a vehicle of SUMO with this set: lengths along the body scale with its length.
    #[must_use]
    pub fn dimensions(&self, length_m: f64, width_m: f64, height_m: f64) -> VehicleDimensions {
        let whole_length_m = length_m.max(SHORTEST_M);
        let (scale, _) = self.bodies(whole_length_m);
        VehicleDimensions {
            length_m: match self.articulation {
                None => whole_length_m,
                Some(_) => self.length_m * scale,
            },
            width_m,
            height_m,
            wheelbase_m: self.wheelbase_m * scale,
            rear_overhang_m: self.rear_overhang_m * scale,
            whole_length_m,
        }
    }

    /// The bodies behind the leading one of a vehicle of SUMO's length.
    #[must_use]
    pub fn trailing(&self, length_m: f64) -> TrailingBodies {
        self.bodies(length_m.max(SHORTEST_M)).1
    }

    /// Factor of the lengths along the leading body, and the bodies behind it.
    fn bodies(&self, whole_length_m: f64) -> (f64, TrailingBodies) {
        match &self.articulation {
            None => (whole_length_m / self.length_m, TrailingBodies::None),
            Some(articulation) => articulation.sized(whole_length_m, self.length_m),
        }
    }

    /// Mass of a vehicle of this size: it scales with length × width, kg.
    #[must_use]
    pub fn mass_kg(&self, body: &VehicleDimensions) -> f64 {
        self.mass_kg * (body.length_m / self.length_m) * (body.width_m.max(NARROWEST_M) / self.width_m)
    }

    /// Moment of inertia by mass, m²: it scales with the length squared.
    #[must_use]
    pub fn yaw_inertia_by_mass_m2(&self, body: &VehicleDimensions) -> f64 {
        let scale = body.length_m / self.length_m;
        self.yaw_inertia_kgm2 / self.mass_kg * scale * scale
    }

    /// Height of the centre of gravity: it scales with the height, metres.
    #[must_use]
    pub fn cg_height_m(&self, body: &VehicleDimensions) -> f64 {
        self.cg_height_m * body.height_m.max(LOWEST_M) / self.height_m
    }
}

/// Shortest, narrowest and lowest body that is accepted, metres: SUMO itself does not check sizes.
const SHORTEST_M: f64 = 0.5;
const NARROWEST_M: f64 = 0.3;
const LOWEST_M: f64 = 0.5;

/// All parameter sets.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterCatalogue {
    sets: Vec<ParameterSet>,
    default: usize,
}

/// Which set a vehicle gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SetChoice {
    /// Index of the set.
    pub set: usize,
    /// True if a set lists the class.
    pub known: bool,
}

#[derive(Debug, Deserialize)]
#[serde(deny_unknown_fields)]
struct SetsFile {
    set: Vec<ParameterSet>,
}

impl ParameterCatalogue {
    /// The committed sets.
    ///
    /// # Errors
    /// The committed file is damaged (a test reads it).
    pub fn new() -> Result<Self, ParameterError> {
        let SetsFile { set: sets } = toml::from_str(SETS)?;
        let mut defaults = sets.iter().enumerate().filter(|(_, set)| set.default);
        let default = defaults.next().map(|(index, _)| index);
        let count = usize::from(default.is_some()) + defaults.count();
        match default {
            Some(default) if count == 1 => Ok(Self { sets, default }),
            _ => Err(ParameterError::Default { count }),
        }
    }

    /// The sets in the order of the file.
    #[must_use]
    pub fn sets(&self) -> &[ParameterSet] {
        &self.sets
    }

    /// The set for classes that none lists.
    #[must_use]
    pub fn default_set(&self) -> &ParameterSet {
        &self.sets[self.default]
    }

    /// The first set that lists SUMO class `class` (UTF-8, zero padded) and admits the length; the last that lists it if none
    /// does; the default if none lists it.
    #[must_use]
    pub fn choose(&self, class: &[u8], length_m: f64) -> SetChoice {
        let end = class.iter().position(|&b| b == 0).unwrap_or(class.len());
        let lists = |set: &ParameterSet| set.classes.iter().any(|known| known.as_bytes() == &class[..end]);
        let mut listing = self.sets.iter().enumerate().filter(|(_, set)| lists(set));
        let fitting = listing.clone().find(|(_, set)| length_m <= set.longest_m);
        match fitting.or_else(|| listing.next_back()) {
            Some((set, _)) => SetChoice { set, known: true },
            None => SetChoice {
                set: self.default,
                known: false,
            },
        }
    }
}
