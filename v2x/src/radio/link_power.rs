//! Powers of many links at once. Logarithm and exponential are polynomials whose error is far below the last digit of the result, an f32.
//! So nearly every power is that of the formulas bit for bit. Where rounding or a threshold leaves it open, the formulas decide.

use sensor_daemon::wide::VectorWork;

/// More than what a power may be wrong by, dB.
const ERROR_DB: f64 = 1e-10;
/// The same as a share of the power. One dB is a share of ln 10 / 10 = 0.23.
const ERROR_SHARE: f64 = 0.3 * ERROR_DB;

/// What adds up to the power of the links of one radio, a column for each term.
#[derive(Debug, Default)]
pub struct LinkTerms {
    /// Square of the distance on the ground, m².
    pub flat2_m2: Vec<f64>,
    /// Difference of the heights, metres.
    pub height_m: Vec<f64>,
    /// Power sent less the loss at 1 m, dBm.
    pub at_1_m_dbm: Vec<f64>,
    /// Loss for each decade of distance, dB.
    pub decade_db: Vec<f64>,
    /// Standard deviation of shadowing, dB; 0 without fading.
    pub shadowing_db: Vec<f64>,
    /// Its standard normal number.
    pub normal: Vec<f64>,
    /// Loss behind vehicles with its random part, without what distance adds, dB.
    pub vehicles_db: Vec<f64>,
    /// 1 for a link behind vehicles that distance adds to, else 0.
    pub behind: Vec<f64>,
    /// The power, milliwatts: 0 for a link that does not count, NaN where the formulas have to say.
    pub power_mw: Vec<f32>,
    /// Twice the shape of the fading ([`super::fading::twice_shape`]).
    pub twice_shape: Vec<u32>,
}

impl LinkTerms {
    /// Forgets the links.
    pub fn clear(&mut self) {
        let Self {
            flat2_m2,
            height_m,
            at_1_m_dbm,
            decade_db,
            shadowing_db,
            normal,
            vehicles_db,
            behind,
            power_mw,
            twice_shape,
        } = self;
        for column in [
            flat2_m2,
            height_m,
            at_1_m_dbm,
            decade_db,
            shadowing_db,
            normal,
            vehicles_db,
            behind,
        ] {
            column.clear();
        }
        power_mw.clear();
        twice_shape.clear();
    }
}

/// Fills in the powers.
pub struct LinkPowers<'a> {
    /// The links.
    pub terms: &'a mut LinkTerms,
    /// Power below which a link does not count, dBm.
    pub least_dbm: f64,
}

/// Logarithm to base 10 of a number from 1 on, relative error below 1e-13.
#[inline(always)]
fn log10(value: f64) -> f64 {
    const HALF_ROOT_BITS: u64 = std::f64::consts::FRAC_1_SQRT_2.to_bits();
    // The number in the low bits of a float of this exponent.
    const TWO_52: u64 = 0x4330_0000_0000_0000;
    let bits = value.to_bits().wrapping_sub(HALF_ROOT_BITS);
    let exponent = f64::from_bits(TWO_52 | bits >> 52) - f64::from_bits(TWO_52);
    let mantissa = f64::from_bits((bits & 0x000F_FFFF_FFFF_FFFF).wrapping_add(HALF_ROOT_BITS));
    // ln m = 2 artanh((m − 1) / (m + 1)), for m from √½ to √2.
    let s = (mantissa - 1.0) / (mantissa + 1.0);
    let q = s * s;
    let tail = 1.0 / 3.0
        + q * (1.0 / 5.0
            + q * (1.0 / 7.0 + q * (1.0 / 9.0 + q * (1.0 / 11.0 + q * (1.0 / 13.0 + q * (1.0 / 15.0 + q / 17.0))))));
    exponent * std::f64::consts::LOG10_2 + 2.0 * std::f64::consts::LOG10_E * (s + s * q * tail)
}

/// Milliwatts of a power in dBm, relative error below 1e-13 of ordinary powers.
#[inline(always)]
fn milliwatts(power_dbm: f64) -> f64 {
    const TO_BITS: f64 = std::f64::consts::LOG2_10 / 10.0;
    // Adding it leaves a whole number in the low bits.
    const WHOLE: f64 = 6_755_399_441_055_744.0;
    let x = (power_dbm * TO_BITS).clamp(-1000.0, 1000.0);
    let whole = x + WHOLE;
    let z = (x - (whole - WHOLE)) * std::f64::consts::LN_2;
    let scale = f64::from_bits((whole.to_bits() << 52).wrapping_add(1.0_f64.to_bits()));
    let tail = 1.0 / 120.0
        + z * (1.0 / 720.0
            + z * (1.0 / 5_040.0
                + z * (1.0 / 40_320.0 + z * (1.0 / 362_880.0 + z * (1.0 / 3_628_800.0 + z / 39_916_800.0)))));
    let share = 1.0 + z * (1.0 + z * (0.5 + z * (1.0 / 6.0 + z * (1.0 / 24.0 + z * tail))));
    scale * share
}

impl VectorWork for LinkPowers<'_> {
    type Output = ();

    #[inline(always)]
    fn run(self) {
        let Self { terms, least_dbm } = self;
        let count = terms.flat2_m2.len();
        terms.power_mw.resize(count, 0.0);
        terms.twice_shape.resize(count, 0);
        let (flat2_m2, height_m) = (&terms.flat2_m2[..count], &terms.height_m[..count]);
        let (at_1_m_dbm, decade_db) = (&terms.at_1_m_dbm[..count], &terms.decade_db[..count]);
        let (shadowing_db, normal) = (&terms.shadowing_db[..count], &terms.normal[..count]);
        let (vehicles_db, behind) = (&terms.vehicles_db[..count], &terms.behind[..count]);
        let (power_mw, twice_shape) = (&mut terms.power_mw[..count], &mut terms.twice_shape[..count]);
        for link in 0..count {
            let distance2_m2 = flat2_m2[link] + height_m[link] * height_m[link];
            let distance_m = distance2_m2.sqrt();
            let near = if distance_m < 150.0 { 3 } else { 2 };
            twice_shape[link] = if distance_m < 50.0 { 6 } else { near };
            let log_distance = 0.5 * log10(distance2_m2.max(1.0));
            let mean_dbm = at_1_m_dbm[link] - decade_db[link] * log_distance;
            let far_db = (15.0 * log_distance - 41.0).max(0.0);
            let behind_db = (vehicles_db[link] + behind[link] * far_db).max(0.0);
            let power_dbm = mean_dbm + shadowing_db[link] * normal[link] - behind_db;
            // What four standard deviations of shadowing cannot lift above it does not count either.
            let over_db = (power_dbm - least_dbm).min(mean_dbm + 4.0 * shadowing_db[link] - least_dbm);
            let power = milliwatts(power_dbm);
            let (low, high) = (
                (power * (1.0 - ERROR_SHARE)) as f32,
                (power * (1.0 + ERROR_SHARE)) as f32,
            );
            let is_sure = low == high && over_db > ERROR_DB;
            let counts = if is_sure { low } else { f32::NAN };
            power_mw[link] = if over_db < -ERROR_DB { 0.0 } else { counts };
        }
    }
}

#[cfg(test)]
mod tests {
    use sensor_daemon::wide::VectorPath;

    use super::*;

    #[test]
    fn logarithm_and_exponential_are_nearly_exact() {
        for step in 0..400_000 {
            let value = 1.0 + f64::from(step) * 2.7;
            assert!((log10(value) - libm::log10(value)).abs() < 1e-13, "{value}");
            let dbm = f64::from(step) * 1e-3 - 200.0;
            let exact = super::super::milliwatts(dbm);
            assert!((milliwatts(dbm) / exact - 1.0).abs() < 1e-13, "{dbm}");
        }
        assert_eq!(log10(1.0), 0.0);
        assert!((log10(1.0 + 1e-9) * std::f64::consts::LN_10 / 1e-9 - 1.0).abs() < 1e-6);
    }

    #[test]
    fn few_powers_are_left_to_the_formulas_on_every_path() {
        let terms = || {
            let mut terms = LinkTerms::default();
            for link in 0..10_000 {
                let link = f64::from(link);
                terms.flat2_m2.push(link * 7.3);
                terms.height_m.push(link % 3.0);
                terms.at_1_m_dbm.push(-28.4);
                terms.decade_db.push(30.0);
                terms.shadowing_db.push(4.0);
                terms.normal.push((link * 0.37) % 5.0 - 2.5);
                terms.vehicles_db.push((link * 0.77) % 9.0 - 4.0);
                terms.behind.push(link % 2.0);
            }
            terms
        };
        let mut plain: Option<Vec<u32>> = None;
        for path in VectorPath::available() {
            let mut terms = terms();
            path.run(LinkPowers {
                terms: &mut terms,
                least_dbm: -101.0,
            });
            assert!(terms.power_mw.iter().filter(|power| power.is_nan()).count() < 20);
            assert!(terms.power_mw.iter().filter(|power| **power == 0.0).count() > 1000);
            let bits: Vec<u32> = terms.power_mw.iter().map(|power| power.to_bits()).collect();
            assert_eq!(plain.get_or_insert_with(|| bits.clone()), &bits);
        }
    }
}
