//! The catalogue of vehicle models: which model with which parameters moves which vehicle.

use std::collections::BTreeMap;

use ipc_schema::{
    config::{self, SingleTrackModel, Surface, VehicleModel},
    traffic::{Kind, VehicleMeta},
};

use super::{
    articulation::TrailingBodies,
    dimensions::VehicleDimensions,
    dynamic::DynamicParams,
    kinematic::KinematicParams,
    parameters::{ParameterCatalogue, ParameterError, TypeLimits},
    rigid_body::RigidBody,
    state::{ControlInput, ModelState, SubStepMotion},
};

/// Share of the friction on dry asphalt that a surface leaves (J. Wong, *Theory of Ground Vehicles*, table 1.5: 0.85 dry, 0.6
/// wet, 0.2 to 0.3 on packed snow).
#[must_use]
pub fn friction_share(surface: Surface) -> f64 {
    match surface {
        Surface::Dry => 1.0,
        Surface::Wet => 0.7,
        Surface::Snow => 0.3,
    }
}

/// A vehicle model with its parameters.
#[derive(Debug, Clone, Copy, PartialEq)]
#[non_exhaustive]
pub enum MotionModel {
    /// Kinematic single-track model.
    Kinematic(KinematicParams),
    /// Single-track model with tyres, load transfer, roll and pitch.
    Dynamic(DynamicParams),
}

impl MotionModel {
    /// The state after `dt_s` seconds of `input`, and the mean motion over them.
    #[must_use]
    pub fn step(&self, state: &ModelState, input: &ControlInput, dt_s: f64) -> (ModelState, SubStepMotion) {
        match self {
            Self::Kinematic(params) => params.step(state, input, dt_s),
            Self::Dynamic(params) => params.step(state, input, 0.0, dt_s),
        }
    }

    /// Largest road-wheel angle, radians.
    #[must_use]
    pub fn max_road_wheel_angle_rad(&self) -> f64 {
        match self {
            Self::Kinematic(params) => params.max_road_wheel_angle_rad,
            Self::Dynamic(params) => params.max_road_wheel_angle_rad,
        }
    }

    /// Longitudinal slip of the rear wheels on a road with this sine of the slope: see [`DynamicParams::rear_wheel_slip`]. Wheels of
    /// the kinematic model do not slip.
    #[must_use]
    pub fn rear_wheel_slip(&self, state: &ModelState, slope_sin: f64) -> f64 {
        match self {
            Self::Kinematic(_) => 0.0,
            Self::Dynamic(params) => params.rear_wheel_slip(state, slope_sin),
        }
    }

    /// Roll and pitch on the springs, each with its rate, after a sub-step with this acceleration along the heading and to the left.
    #[must_use]
    pub fn lean_after(&self, state: &ModelState, [along_mps2, left_mps2]: [f64; 2]) -> [[f64; 2]; 2] {
        match self {
            Self::Kinematic(_) => [[0.0; 2]; 2],
            Self::Dynamic(params) => [
                params.roll.after(state.roll, left_mps2),
                params.pitch.after(state.pitch, along_mps2),
            ],
        }
    }
}

/// A model for one kind and size of vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SizedModel {
    /// The model that moves it.
    pub model: MotionModel,
    /// Its size.
    pub dimensions: VehicleDimensions,
    /// The bodies behind its leading one.
    pub trailing: TrailingBodies,
    /// Steering-wheel angle by road-wheel angle.
    pub steering_ratio: f64,
}

/// Key of a model: parameter set, model, and bits of length, width, height and the limits of SUMO's type.
type ModelKey = (usize, u8, [u32; 6]);

/// All models of a run, one for each kind and size of vehicle.
#[derive(Debug)]
pub struct ModelCatalogue {
    catalogue: ParameterCatalogue,
    limits: config::VehicleConfig,
    by_class: BTreeMap<&'static str, SingleTrackModel>,
    surface: f64,
    sub_step_s: f64,
    built: Vec<SizedModel>,
    places: BTreeMap<ModelKey, u32>,
    /// rapier's worlds of rigid bodies, by index.
    bodies: BTreeMap<u32, RigidBody>,
    /// Classes that no set lists, and whether [`ModelCatalogue::take_unknown`] has returned them.
    unknown: BTreeMap<String, bool>,
}

impl ModelCatalogue {
    /// The models of a run with sub-steps of `sub_step_s`.
    ///
    /// # Errors
    /// The parameter sets are damaged.
    pub fn new(limits: &config::VehicleConfig, surface: Surface, sub_step_s: f64) -> Result<Self, ParameterError> {
        let by_class = limits.class_models.iter();
        let by_class = by_class.map(|entry| (entry.class.name(), entry.model)).collect();
        Ok(Self {
            catalogue: ParameterCatalogue::new()?,
            limits: limits.clone(),
            by_class,
            surface: friction_share(surface),
            sub_step_s,
            built: Vec::new(),
            places: BTreeMap::new(),
            bodies: BTreeMap::new(),
            unknown: BTreeMap::new(),
        })
    }

    /// Index of the model for an announced road user.
    pub fn index_for(&mut self, meta: &VehicleMeta) -> u32 {
        let choice = self.catalogue.choose(&meta.vehicle_class, f64::from(meta.length_m));
        let class = meta.class_text();
        if !choice.known && meta.kind != Kind::Person as u32 {
            self.unknown.entry(class.clone()).or_insert(false);
        }
        let model = self.model_of(&class, meta.kind, choice.set);
        let [length, width, height] = [meta.length_m, meta.width_m, meta.height_m];
        let [accel, decel, speed] = [meta.type_accel_mps2, meta.type_decel_mps2, meta.type_speed_mps];
        let key = [length, width, height, accel, decel, speed].map(f32::to_bits);
        let key = (choice.set, model as u8, key);
        if let Some(place) = self.places.get(&key) {
            return *place;
        }
        let place = self.built.len() as u32;
        let size = [length, width, height].map(f64::from);
        let type_limits = TypeLimits {
            accel_mps2: accel.into(),
            decel_mps2: decel.into(),
            speed_mps: speed.into(),
        };
        let built = self.build(choice.set, model, size, &type_limits);
        if model == VehicleModel::RigidBody {
            self.add_body(place, choice.set, &built.dimensions);
        }
        self.built.push(built);
        self.places.insert(key, place);
        place
    }

    /// Two-wheelers keep the dynamic model: four wheels do not lean into a bend.
    fn add_body(&mut self, place: u32, set: usize, size: &VehicleDimensions) {
        let set = &self.catalogue.sets()[set];
        if let Ok(body) = RigidBody::new(set, size, &self.limits, self.surface, self.sub_step_s) {
            self.bodies.insert(place, body);
        }
    }

    /// The model at an index and, for a rigid body, rapier's world.
    pub fn with_body(&mut self, place: u32) -> (&SizedModel, Option<&mut RigidBody>) {
        (&self.built[place as usize], self.bodies.get_mut(&place))
    }

    fn build(
        &self,
        set: usize,
        model: VehicleModel,
        [length, width, height]: [f64; 3],
        type_limits: &TypeLimits,
    ) -> SizedModel {
        let set = &self.catalogue.sets()[set];
        let (dimensions, trailing) = (set.dimensions(length, width, height), set.trailing(length));
        let (set, limits) = (
            &set.strengthened(type_limits, &dimensions),
            &type_limits.raised(&self.limits),
        );
        let model = if model != VehicleModel::Kinematic {
            MotionModel::Dynamic(DynamicParams::new(
                set,
                &dimensions,
                limits,
                self.surface,
                self.sub_step_s,
            ))
        } else {
            MotionModel::Kinematic(KinematicParams::new(set, limits, dimensions.wheelbase_m))
        };
        SizedModel {
            model,
            dimensions,
            trailing,
            steering_ratio: set.steering_ratio,
        }
    }

    fn model_of(&self, class: &str, kind: u32, set: usize) -> VehicleModel {
        if let Some(model) = self.by_class.get(class) {
            (*model).into()
        } else if self.catalogue.sets()[set].kinematic {
            VehicleModel::Kinematic
        } else if kind == Kind::Cav as u32 {
            self.limits.cav_model.into()
        } else if kind == Kind::Hero as u32 {
            self.limits.hero_model
        } else {
            self.limits.other_model.into()
        }
    }

    /// The model at an index that [`ModelCatalogue::index_for`] returned.
    #[must_use]
    #[inline]
    pub fn at(&self, place: u32) -> &SizedModel {
        &self.built[place as usize]
    }

    /// Name of the parameter set that unknown classes get.
    #[must_use]
    pub fn default_set(&self) -> &str {
        &self.catalogue.default_set().name
    }

    /// Vehicle classes seen since the last call that no parameter set lists. Each is returned once in a run.
    pub fn take_unknown(&mut self) -> Vec<String> {
        let new = self.unknown.iter_mut().filter(|(_, returned)| !**returned);
        new.map(|(class, returned)| {
            *returned = true;
            class.clone()
        })
        .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset;

    fn limits() -> config::VehicleConfig {
        config::VehicleConfig {
            hero_model: VehicleModel::RigidBody,
            class_models: ["bus=kinematic", "truck=dynamic"]
                .map(|entry| entry.parse().unwrap())
                .into(),
            ..preset::town().vehicle
        }
    }

    fn meta(kind: Kind, class: &str) -> VehicleMeta {
        let mut meta: VehicleMeta = bytemuck::Zeroable::zeroed();
        meta.kind = kind as u32;
        (meta.length_m, meta.width_m, meta.height_m) = (4.5, 1.8, 1.5);
        meta.vehicle_class[..class.len()].copy_from_slice(class.as_bytes());
        meta
    }

    fn dynamic(fleet: &mut ModelCatalogue, kind: Kind, class: &str) -> bool {
        let place = fleet.index_for(&meta(kind, class));
        matches!(fleet.at(place).model, MotionModel::Dynamic(_))
    }

    #[test]
    fn models_follow_the_role_unless_the_class_says_otherwise() {
        let mut fleet = ModelCatalogue::new(&limits(), Surface::Dry, 0.01).unwrap();
        assert!(dynamic(&mut fleet, Kind::Cav, "passenger"));
        assert!(!dynamic(&mut fleet, Kind::Other, "passenger"));
        assert!(!dynamic(&mut fleet, Kind::Cav, "bus"));
        assert!(dynamic(&mut fleet, Kind::Other, "truck"));
        let (hero, motorcycle) = (
            fleet.index_for(&meta(Kind::Hero, "passenger")),
            fleet.index_for(&meta(Kind::Hero, "moped")),
        );
        assert!(fleet.with_body(hero).1.is_some());
        assert!(fleet.with_body(motorcycle).1.is_none(), "two wheels lean into a bend");
        assert_eq!(
            fleet.index_for(&meta(Kind::Hero, "passenger")),
            hero,
            "one world for all of a kind"
        );
    }

    #[test]
    fn an_unknown_class_gets_the_named_default_and_is_reported_once() {
        let mut fleet = ModelCatalogue::new(&limits(), Surface::Dry, 0.01).unwrap();
        let (unknown, sedan) = (
            fleet.index_for(&meta(Kind::Cav, "hovercraft")),
            fleet.index_for(&meta(Kind::Cav, "passenger")),
        );
        assert_eq!(fleet.default_set(), "sedan");
        assert_eq!(fleet.at(unknown), fleet.at(sedan));
        fleet.index_for(&meta(Kind::Other, "hovercraft"));
        assert_eq!(fleet.take_unknown(), ["hovercraft"]);
        fleet.index_for(&meta(Kind::Cav, "hovercraft"));
        assert!(fleet.take_unknown().is_empty());
    }
}
