//! Messages between road users and roadside units. Equations and sources: docs/v2x.md.

use serde::{Deserialize, Serialize};

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
