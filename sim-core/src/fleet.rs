//! Which model with which parameters moves which vehicle.

use std::collections::BTreeMap;

use ipc_schema::{
    config::{self, Surface, VehicleModel},
    traffic::{Kind, VehicleMeta},
};

use crate::{
    dimensions::Dimensions,
    dynamic::DynamicParams,
    parameters::{Catalogue, ParameterError},
    rigid_body::RigidBody,
    vehicle::{KinematicParams, Model},
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

/// The vehicle models cannot be set up.
#[derive(Debug, thiserror::Error)]
pub enum FleetError {
    /// The parameter sets are damaged.
    #[error(transparent)]
    Parameters(#[from] ParameterError),
    /// An entry of `vehicle.class_models` is not understood.
    #[error(
        "`vehicle.class_models` has \"{entry}\": give \"class=kinematic\" or \"class=dynamic\" with a vehicle class of SUMO"
    )]
    ClassModel {
        /// The entry.
        entry: String,
    },
}

/// A model for one kind and size of vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Built {
    /// What moves it.
    pub model: Model,
    /// Its size.
    pub dimensions: Dimensions,
}

/// The same for all vehicles that share it: parameter set, model, and size (bits of length, width and height).
type Key = (usize, u8, [u32; 3]);

/// All models of a run, one for each kind and size of vehicle.
#[derive(Debug)]
pub struct Fleet {
    catalogue: Catalogue,
    limits: config::Vehicle,
    by_class: BTreeMap<String, VehicleModel>,
    surface: f64,
    sub_step_s: f64,
    built: Vec<Built>,
    places: BTreeMap<Key, u32>,
    /// rapier's worlds, for the places whose model they are.
    bodies: BTreeMap<u32, RigidBody>,
    /// Classes that no set lists, and whether that has been told.
    unknown: BTreeMap<String, bool>,
}

impl Fleet {
    /// The models of a run with sub-steps of `sub_step_s`.
    ///
    /// # Errors
    /// A class is given a model that does not exist.
    pub fn new(limits: &config::Vehicle, surface: Surface, sub_step_s: f64) -> Result<Self, FleetError> {
        let by_class = limits
            .class_models
            .iter()
            .map(|entry| match config::class_model(entry) {
                Some((class, model)) => Ok((class.to_owned(), model)),
                None => Err(FleetError::ClassModel { entry: entry.clone() }),
            });
        Ok(Self {
            catalogue: Catalogue::new()?,
            limits: limits.clone(),
            by_class: by_class.collect::<Result<_, _>>()?,
            surface: friction_share(surface),
            sub_step_s,
            built: Vec::new(),
            places: BTreeMap::new(),
            bodies: BTreeMap::new(),
            unknown: BTreeMap::new(),
        })
    }

    /// Index of the model for an announced road user.
    pub fn place(&mut self, meta: &VehicleMeta) -> u32 {
        let choice = self.catalogue.choose(&meta.vehicle_class, f64::from(meta.length_m));
        let class = class_text(meta);
        if !choice.known && meta.kind != Kind::Person as u32 {
            self.unknown.entry(class.clone()).or_insert(false);
        }
        let model = self.model_of(&class, meta.kind);
        let size = [meta.length_m, meta.width_m, meta.height_m];
        let key = (choice.set, model as u8, size.map(f32::to_bits));
        if let Some(place) = self.places.get(&key) {
            return *place;
        }
        let place = self.built.len() as u32;
        let [length, width, height] = size.map(f64::from);
        let built = self.build(choice.set, model, [length, width, height]);
        if model == VehicleModel::RigidBody {
            self.add_body(place, choice.set, &built.dimensions);
        }
        self.built.push(built);
        self.places.insert(key, place);
        place
    }

    /// Two-wheelers stay with the dynamic model: four wheels do not lean into a bend.
    fn add_body(&mut self, place: u32, set: usize, size: &Dimensions) {
        let set = &self.catalogue.sets()[set];
        if let Ok(body) = RigidBody::new(set, size, &self.limits, self.surface, self.sub_step_s) {
            self.bodies.insert(place, body);
        }
    }

    /// The model at a place and, if it is that of a rigid body, rapier's world for it.
    pub fn with_body(&mut self, place: u32) -> (&Built, Option<&mut RigidBody>) {
        (&self.built[place as usize], self.bodies.get_mut(&place))
    }

    fn build(&self, set: usize, model: VehicleModel, [length, width, height]: [f64; 3]) -> Built {
        let set = &self.catalogue.sets()[set];
        let dimensions = set.dimensions(length, width, height);
        let model = if model != VehicleModel::Kinematic {
            Model::Dynamic(DynamicParams::new(
                set,
                &dimensions,
                &self.limits,
                self.surface,
                self.sub_step_s,
            ))
        } else {
            Model::Kinematic(KinematicParams::new(set, &self.limits, dimensions.wheelbase_m))
        };
        Built { model, dimensions }
    }

    fn model_of(&self, class: &str, kind: u32) -> VehicleModel {
        self.by_class.get(class).copied().unwrap_or({
            if kind == Kind::Cav as u32 {
                self.limits.cav_model
            } else if kind == Kind::Hero as u32 {
                self.limits.hero_model
            } else {
                self.limits.other_model
            }
        })
    }

    /// The model at a place given by [`Fleet::place`].
    #[must_use]
    #[inline]
    pub fn at(&self, place: u32) -> &Built {
        &self.built[place as usize]
    }

    /// Name of the parameter set that unknown classes get.
    #[must_use]
    pub fn default_set(&self) -> &str {
        &self.catalogue.default_set().name
    }

    /// Vehicle classes met since the last call that no parameter set lists; each comes once in a run.
    pub fn take_unknown(&mut self) -> Vec<String> {
        let untold = self.unknown.iter_mut().filter(|(_, told)| !**told);
        untold
            .map(|(class, told)| {
                *told = true;
                class.clone()
            })
            .collect()
    }
}

fn class_text(meta: &VehicleMeta) -> String {
    let end = meta
        .vehicle_class
        .iter()
        .position(|&byte| byte == 0)
        .unwrap_or(meta.vehicle_class.len());
    String::from_utf8_lossy(&meta.vehicle_class[..end]).into_owned()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset;

    fn limits() -> config::Vehicle {
        config::Vehicle {
            hero_model: VehicleModel::RigidBody,
            class_models: vec!["bus=kinematic".into(), "truck=dynamic".into()],
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

    fn dynamic(fleet: &mut Fleet, kind: Kind, class: &str) -> bool {
        let place = fleet.place(&meta(kind, class));
        matches!(fleet.at(place).model, Model::Dynamic(_))
    }

    #[test]
    fn models_follow_the_role_unless_the_class_says_otherwise() {
        let mut fleet = Fleet::new(&limits(), Surface::Dry, 0.01).unwrap();
        assert!(dynamic(&mut fleet, Kind::Cav, "passenger"));
        assert!(!dynamic(&mut fleet, Kind::Other, "passenger"));
        assert!(!dynamic(&mut fleet, Kind::Cav, "bus"));
        assert!(dynamic(&mut fleet, Kind::Other, "truck"));
        let (hero, motorcycle) = (
            fleet.place(&meta(Kind::Hero, "passenger")),
            fleet.place(&meta(Kind::Hero, "moped")),
        );
        assert!(fleet.with_body(hero).1.is_some());
        assert!(fleet.with_body(motorcycle).1.is_none(), "two wheels lean into a bend");
        assert_eq!(
            fleet.place(&meta(Kind::Hero, "passenger")),
            hero,
            "one world for all of a kind"
        );
    }

    #[test]
    fn an_unknown_class_gets_the_named_default_and_is_told_once() {
        let mut fleet = Fleet::new(&limits(), Surface::Dry, 0.01).unwrap();
        let (unknown, sedan) = (
            fleet.place(&meta(Kind::Cav, "hovercraft")),
            fleet.place(&meta(Kind::Cav, "passenger")),
        );
        assert_eq!(fleet.default_set(), "sedan");
        assert_eq!(fleet.at(unknown), fleet.at(sedan));
        fleet.place(&meta(Kind::Other, "hovercraft"));
        assert_eq!(fleet.take_unknown(), ["hovercraft"]);
        fleet.place(&meta(Kind::Cav, "hovercraft"));
        assert!(fleet.take_unknown().is_empty());
    }

    #[test]
    fn a_model_for_no_class_is_refused() {
        for entry in ["bus", "bus=flying", "hovercraft=dynamic"] {
            let limits = config::Vehicle {
                class_models: vec![entry.into()],
                ..limits()
            };
            let error = Fleet::new(&limits, Surface::Dry, 0.01).unwrap_err();
            assert!(error.to_string().contains(entry), "{error}");
        }
    }
}
