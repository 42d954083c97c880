//! Path loss between road users: 3GPP TR 37.885 V15.3.0, tables 6.2.1-1 and 6.2.1-2.

use ipc_schema::config::V2xPathLoss;

/// What is between two antennas.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum LinkState {
    /// Nothing (LOS).
    Clear,
    /// Vehicles, but no building (`NLOSv`).
    Vehicles,
    /// A building (NLOS).
    Building,
}

/// Logarithm of the carrier frequency in GHz to base 10.
const LOG_CARRIER: f64 = 0.770_852_011_642_144_2;
/// Least distance of the formulas, metres.
const NEAREST_M: f64 = 1.0;

/// Path loss at a distance between the antennas, dB, without the loss behind vehicles.
#[must_use]
pub fn path_loss_db(formulas: V2xPathLoss, state: LinkState, distance_m: f64) -> f64 {
    let log_d = libm::log10(distance_m.max(NEAREST_M));
    let log_f = LOG_CARRIER;
    match (state, formulas) {
        (LinkState::Building, _) => 36.85 + 30.0 * log_d + 18.9 * log_f,
        (_, V2xPathLoss::Urban) => 38.77 + 16.7 * log_d + 18.2 * log_f,
        (_, V2xPathLoss::Highway) => 32.4 + 20.0 * log_d + 20.0 * log_f,
    }
}

/// Mean and standard deviation of the loss behind vehicles, dB. The loss itself is never negative. `above` says for both antennas
/// whether they are higher than the highest vehicle between them.
#[must_use]
pub fn vehicle_loss_db(above: [bool; 2], distance_m: f64) -> [f64; 2] {
    let far_db = (15.0 * libm::log10(distance_m.max(NEAREST_M)) - 41.0).max(0.0);
    match above {
        [true, true] => [0.0, 0.0],
        [false, false] => [9.0 + far_db, 4.5],
        _ => [5.0 + far_db, 4.0],
    }
}

/// Standard deviation of shadowing, dB.
#[must_use]
pub fn shadowing_std_db(state: LinkState) -> f64 {
    match state {
        LinkState::Clear | LinkState::Vehicles => 3.0,
        LinkState::Building => 4.0,
    }
}

/// Distance over which shadowing keeps 1/e of its correlation, metres: urban as in TR 37.885, highway as in TR 36.885, table A.1.4-1.
#[must_use]
pub fn decorrelation_m(formulas: V2xPathLoss, state: LinkState) -> f64 {
    match (formulas, state) {
        (V2xPathLoss::Highway, _) => 25.0,
        (V2xPathLoss::Urban, LinkState::Clear) => 10.0,
        (V2xPathLoss::Urban, _) => 13.0,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Distance, highway, urban, behind a building: computed with forty decimal digits.
    const TABLE: [[f64; 4]; 4] = [
        [1.0, 47.817_040_232_843, 52.799_506_611_887, 51.419_103_020_037],
        [17.3, 72.577_962_295_419, 73.474_876_534_138, 88.560_486_113_900],
        [100.0, 87.817_040_232_843, 86.199_506_611_887, 111.419_103_020_037],
        [433.25, 100.551_811_660_562, 96.833_040_754_032, 130.521_260_161_615],
    ];

    #[test]
    fn the_carrier_has_its_logarithm() {
        assert!((libm::log10(crate::radio::CARRIER_GHZ) - LOG_CARRIER).abs() < 1e-15);
    }

    #[test]
    fn it_is_the_formulas_of_tr_37_885() {
        for [distance_m, highway, urban, building] in TABLE {
            for state in [LinkState::Clear, LinkState::Vehicles] {
                assert!((path_loss_db(V2xPathLoss::Highway, state, distance_m) - highway).abs() < 1e-9);
                assert!((path_loss_db(V2xPathLoss::Urban, state, distance_m) - urban).abs() < 1e-9);
            }
            for formulas in [V2xPathLoss::Highway, V2xPathLoss::Urban] {
                assert!((path_loss_db(formulas, LinkState::Building, distance_m) - building).abs() < 1e-9);
            }
        }
        // Nearer than a metre it stays.
        let near = path_loss_db(V2xPathLoss::Urban, LinkState::Clear, 0.0);
        assert!((near - TABLE[0][2]).abs() < 1e-9);
    }

    #[test]
    fn the_loss_behind_vehicles_depends_on_the_antennas() {
        assert_eq!(vehicle_loss_db([true, true], 100.0), [0.0, 0.0]);
        assert_eq!(vehicle_loss_db([false, false], 100.0), [9.0, 4.5]);
        assert_eq!(vehicle_loss_db([true, false], 100.0), [5.0, 4.0]);
        // 15 log d − 41 is positive beyond 541 m.
        assert_eq!(vehicle_loss_db([false, true], 541.0)[0], 5.0);
        assert!((vehicle_loss_db([false, false], 1000.0)[0] - 13.0).abs() < 1e-9);
    }
}
