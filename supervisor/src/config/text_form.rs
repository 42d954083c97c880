//! Forms of texts that the validated configuration holds as types.

use std::{fmt::Display, str::FromStr};

use ipc_schema::{
    config::{ClassModel, CurriculumMap, FanoutEndpoint, MeshPlacement, Network, RegionCorner, RoadsideService},
    props::{Obstacle, PROPS, PropName},
    traffic::VEHICLE_CLASSES,
};

use super::suites;

/// Form of a text.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum TextForm {
    /// A [`ClassModel`].
    ClassModel,
    /// A [`RegionCorner`].
    Corner,
    /// A [`FanoutEndpoint`].
    Endpoint,
    /// A [`CurriculumMap`].
    Map,
    /// A [`MeshPlacement`].
    Mesh,
    /// A [`Network`].
    Network,
    /// An [`Obstacle`].
    Obstacle,
    /// A [`PropName`].
    Prop,
    /// A ready-made suite, and the number of slots whose vehicles carry it.
    Suite,
    /// One of [`VEHICLE_CLASSES`].
    VehicleClass,
    /// A [`RoadsideService`].
    RoadsideService,
}

impl TextForm {
    /// Checks that `text` has this form.
    ///
    /// # Errors
    /// The text does not have this form: the error gives the reason.
    pub fn check(self, text: &str) -> Result<(), String> {
        match self {
            Self::ClassModel => read::<ClassModel>(text),
            Self::Corner => read::<RegionCorner>(text),
            Self::Endpoint => read::<FanoutEndpoint>(text),
            Self::Map => read::<CurriculumMap>(text),
            Self::Mesh => read::<MeshPlacement>(text),
            Self::Network => read::<Network>(text),
            Self::Obstacle => read::<Obstacle>(text),
            Self::Prop => read::<PropName>(text),
            Self::Suite => suites::ready_made(text).map(drop),
            Self::VehicleClass if VEHICLE_CLASSES.contains(&text) => Ok(()),
            Self::VehicleClass => Err(format!("\"{text}\" is no vehicle class of SUMO")),
            Self::RoadsideService => read::<RoadsideService>(text),
        }
    }

    /// Description of the allowed texts, for messages and `configs/README.md`.
    #[must_use]
    pub fn allowed(self) -> String {
        match self {
            Self::ClassModel => format!(
                "\"class=kinematic\", \"class=dynamic\" with a class of {}",
                VEHICLE_CLASSES.join(", ")
            ),
            Self::Corner => "\"x y\" such as \"120 45.5\"".into(),
            Self::Endpoint => "\"tcp/HOST:PORT\", \"tls/HOST:PORT\" such as \"tcp/127.0.0.1:7447\"".into(),
            Self::Map => "\"town\", \"avenue\", a .net.xml (or .net.xml.gz), a .sumocfg".into(),
            Self::Mesh => "\"file.obj x y\", \"file.obj x y heading\" such as \"house.obj 120.5 80 90\"".into(),
            Self::Network => "\"mlp\", \"gru\", \"cnn\", \"package.module:Class\"".into(),
            Self::Obstacle => format!(
                "\"name x y\", \"name x y heading\" such as \"cone 120.5 80 90\"; props: {}",
                prop_names()
            ),
            Self::Prop => format!("props: {}", prop_names()),
            Self::Suite => format!("\"NAME\", \"NAME:SLOTS\" with a name of {}", suites::names()),
            Self::VehicleClass => VEHICLE_CLASSES.join(", "),
            Self::RoadsideService => format!("\"{}\"", RoadsideService::ALL.map(RoadsideService::name).join("\", \"")),
        }
    }
}

fn read<T: FromStr<Err: Display>>(text: &str) -> Result<(), String> {
    text.parse::<T>().map(drop).map_err(|error| error.to_string())
}

fn prop_names() -> String {
    PROPS.map(|prop| prop.name).join(", ")
}
