//! Messages between road users and roadside units. Equations and sources: docs/v2x.md.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use super::text::serde_as_text;

/// The formulas of path loss of 3GPP TR 37.885.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum V2xPathLoss {
    /// Urban grid.
    Urban,
    /// Highway.
    Highway,
}

/// Decentralised congestion control of ETSI TS 102 687.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum V2xCongestionControl {
    /// None.
    Off,
    /// By a table of states.
    Reactive,
    /// By a control loop.
    Adaptive,
}

/// The message by which vehicles make themselves known.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum V2xAwareness {
    /// Cooperative awareness messages of ETSI.
    Cam,
    /// Basic safety messages of SAE.
    Bsm,
}

/// Which descriptions of objects a row of `neighbours` lists.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum V2xListing {
    /// One for each object: its own word before another's, and never the road user itself.
    Merged,
    /// Every station's view of every object, of the road user itself too, and what its own sensors perceive.
    Separate,
}

/// Which of the objects that a vehicle perceives its collective perception messages list.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum V2xInclusion {
    /// Those that the rules of ETSI TS 103 324 name.
    Standard,
    /// All, at every tick.
    All,
    /// Those that a station nearby lacks, as if all maps were known: the bound for every other choice.
    Needed,
    /// Those that the trainer chooses, in the messages task.
    Policy,
}

/// A service of a roadside unit.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum RoadsideService {
    /// Cooperative awareness messages.
    Cam,
    /// Collective perception messages.
    Cpm,
    /// Warnings that it heard, sent once more.
    Denm,
    /// The map of an edge service: CPMs of everything that it hears and perceives, fused.
    Map,
}

impl RoadsideService {
    /// All of them.
    pub const ALL: [Self; 4] = [Self::Cam, Self::Cpm, Self::Denm, Self::Map];

    /// Name in configurations.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Cam => "cam",
            Self::Cpm => "cpm",
            Self::Denm => "denm",
            Self::Map => "map",
        }
    }
}

/// The text is no service of a roadside unit.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[error("\"{0}\" is no service of a roadside unit")]
pub struct RoadsideServiceError(pub String);

serde_as_text!(RoadsideService);

impl FromStr for RoadsideService {
    type Err = RoadsideServiceError;

    fn from_str(text: &str) -> Result<Self, RoadsideServiceError> {
        let mut services = Self::ALL.into_iter();
        services
            .find(|service| service.name() == text)
            .ok_or_else(|| RoadsideServiceError(text.to_owned()))
    }
}

impl fmt::Display for RoadsideService {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(self.name())
    }
}

/// A roadside unit: a station at a fixed place.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoadsideUnitConfig {
    /// Name, of which the station id follows.
    pub id: String,
    /// Place, world, metres.
    pub x_m: f64,
    /// Place, world, metres.
    pub y_m: f64,
    /// Height of antenna and sensors above the ground, metres.
    pub height_m: f64,
    /// Range in which it perceives road users, metres; none = it perceives nothing.
    pub range_m: Option<f64>,
    /// Middle of its field of view, counter-clockwise from east, degrees; none = 0.
    pub heading_deg: Option<f64>,
    /// Angle of its field of view, degrees; none = all around.
    pub field_of_view_deg: Option<f64>,
    /// What it sends; none = CAMs, and CPMs where it perceives.
    pub services: Option<Vec<RoadsideService>>,
}

impl RoadsideUnitConfig {
    /// Range in which it perceives, metres; 0 = it perceives nothing.
    #[must_use]
    pub fn range_m(&self) -> f64 {
        self.range_m.unwrap_or(0.0)
    }

    /// True if it has this service.
    #[must_use]
    pub fn offers(&self, service: RoadsideService) -> bool {
        match &self.services {
            Some(services) => services.contains(&service),
            None => match service {
                RoadsideService::Cam => true,
                RoadsideService::Cpm => self.range_m() > 0.0,
                RoadsideService::Denm | RoadsideService::Map => false,
            },
        }
    }
}

/// Messages between road users.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct V2xConfig {
    /// Share of the connected road users that have a radio; 0 = no messages and no process.
    pub share: f64,
    /// The message by which vehicles make themselves known.
    pub awareness: V2xAwareness,
    /// Vehicles warn of their emergency braking.
    pub denm: bool,
    /// Pedestrians with a smartphone have radios too, and send awareness messages.
    pub vam: bool,
    /// Nearest known objects in a row of `neighbours`.
    pub neighbours: u32,
    /// Which descriptions of objects such a row lists.
    pub listing: V2xListing,
    /// Stations at fixed places.
    pub roadside: Vec<RoadsideUnitConfig>,
    /// Every message on air is written into files that protocol analysers open.
    pub pcap: bool,
    /// Formulas of path loss.
    pub path_loss: V2xPathLoss,
    /// Transmit power with the gain of both antennas, dBm.
    pub power_dbm: f64,
    /// Noise figure of a receiver, dB.
    pub noise_figure_db: f64,
    /// Received power from which the channel counts as busy, dBm.
    pub carrier_sense_dbm: f64,
    /// Longest link that is computed, metres.
    pub range_m: f64,
    /// Shadowing and fast fading are drawn; false = path loss alone.
    pub fading: bool,
    /// Congestion control.
    pub congestion_control: V2xCongestionControl,
    /// Range in which a vehicle perceives objects for its collective perception messages, metres; 0 = no such messages.
    pub perception_range_m: f64,
    /// Which of the perceived objects these messages list.
    pub inclusion: V2xInclusion,
    /// Messages task: the nearest perceived objects that the policy chooses from.
    pub candidates: u32,
    /// Messages task: range in which a station is to know all road users, metres.
    pub awareness_range_m: f64,
    /// Standard deviation of the position of a perceived object on each axis, metres.
    pub perception_position_std_m: f64,
    /// Standard deviation of the speed of a perceived object on each axis, m/s.
    pub perception_speed_std_mps: f64,
    /// Time after which a known object that was not heard of again is forgotten, seconds.
    pub object_lifetime_s: f64,
    /// Threads that compute links and maps. The result does not depend on it.
    pub threads: u32,
}

impl V2xConfig {
    /// True if a run has the process `v2x`.
    #[must_use]
    pub fn is_on(&self) -> bool {
        self.share > 0.0
    }
}
