//! The radio channel: loss of a link, fading, noise and interference, air time, and which stations send when.

pub mod delivery;
pub mod fading;
mod link_power;
pub mod links;
pub mod medium;
pub mod obstruction;
pub mod open_strips;
pub mod path_loss;
pub mod reception;
pub mod shadowing;

/// Carrier frequency of the control channel, GHz (EN 302 663).
pub const CARRIER_GHZ: f64 = 5.9;
/// Bandwidth of a channel, hertz.
pub const BANDWIDTH_HZ: f64 = 10e6;

/// Milliwatts of a power in dBm.
#[must_use]
pub fn milliwatts(power_dbm: f64) -> f64 {
    libm::exp(power_dbm * (std::f64::consts::LN_10 / 10.0))
}

/// Power in dBm of milliwatts.
#[must_use]
pub fn dbm(power_mw: f64) -> f64 {
    10.0 * libm::log10(power_mw)
}

/// Thermal noise in a channel with the noise figure of the receiver, dBm: kTB at 290 K is −174 dBm/Hz.
#[must_use]
pub fn noise_dbm(noise_figure_db: f64) -> f64 {
    -174.0 + 10.0 * libm::log10(BANDWIDTH_HZ) + noise_figure_db
}
