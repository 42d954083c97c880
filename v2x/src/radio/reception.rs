//! Air time of a message, and the probability that a receiver decodes it: IEEE 802.11p at 6 Mbit/s (QPSK, rate 1/2).

/// Data bits of one OFDM symbol at 6 Mbit/s.
const SYMBOL_BITS: usize = 48;
/// Preamble and signal field, seconds.
const PREAMBLE_S: f64 = 40e-6;
/// Length of an OFDM symbol in a channel of 10 MHz, seconds.
const SYMBOL_S: f64 = 8e-6;
/// Service bits before and tail bits behind the data.
const SERVICE_BITS: usize = 16;
const TAIL_BITS: usize = 6;
/// Bytes of MAC header with QoS control, LLC and SNAP header, and frame check sequence around a GeoNetworking packet.
pub const FRAME_BYTES: usize = 26 + 8 + 4;

/// Time on air of a frame of `bytes` bytes, seconds (IEEE 802.11-2020, section 17.4.3).
#[must_use]
pub fn air_time_s(bytes: usize) -> f64 {
    let symbols = (SERVICE_BITS + 8 * bytes + TAIL_BITS).div_ceil(SYMBOL_BITS);
    PREAMBLE_S + SYMBOL_S * symbols as f64
}

/// Number of bit errors on the paths of each distance from 10 in steps of 2 (rate 1/2, constraint length 7).
const ERROR_WEIGHTS: [f64; 9] = [
    36.0,
    211.0,
    1404.0,
    11_633.0,
    77_433.0,
    502_690.0,
    3_322_763.0,
    21_292_910.0,
    134_365_911.0,
];

/// Ratio of signal to noise below which no frame is received.
pub const HOPELESS: f64 = 1.1;
/// Ratio of signal to noise above which the probability of reception rounds to 1.
pub const CERTAIN: f64 = 20.0;

/// Probability that a frame of `bytes` bytes is received without an error at a ratio of signal to noise and interference.
///
/// Union bound of the Viterbi decoder with QPSK (Pei and Henderson, "Validation of OFDM error rate model in ns-3", 2010: the "NIST" model).
#[must_use]
pub fn decode_probability(signal_to_noise: f64, bytes: usize) -> f64 {
    match signal_to_noise {
        ratio if ratio < HOPELESS => 0.0,
        ratio if ratio > CERTAIN => 1.0,
        ratio => union_bound(ratio, bytes),
    }
}

/// The probability without shortcuts.
fn union_bound(signal_to_noise: f64, bytes: usize) -> f64 {
    match log_bit_success(signal_to_noise) {
        f64::NEG_INFINITY => 0.0,
        log => libm::exp(8.0 * bytes as f64 * log),
    }
}

/// Logarithm of the probability that a bit is received without an error.
#[must_use]
pub fn log_bit_success(signal_to_noise: f64) -> f64 {
    let bit = 0.5 * libm::erfc((0.5 * signal_to_noise.max(0.0)).sqrt());
    let d2 = 4.0 * bit * (1.0 - bit);
    // Beyond this the bound is over 1.
    if d2 > 0.5 {
        return f64::NEG_INFINITY;
    }
    let series = ERROR_WEIGHTS.iter().rev().fold(0.0, |sum, weight| sum * d2 + weight);
    let d10 = d2 * d2 * d2 * d2 * d2;
    let coded = (0.5 * series * d10).min(1.0);
    libm::log1p(-coded)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn air_time_is_that_of_the_standard() {
        for (bytes, us) in [(200, 312.0), (350, 512.0), (800, 1112.0), (0, 48.0)] {
            assert!((air_time_s(bytes) * 1e6 - us).abs() < 1e-9, "{bytes}");
        }
    }

    #[test]
    fn decoding_rises_with_the_signal_and_falls_with_the_length() {
        let at_db = |db: f64, bytes| decode_probability(libm::exp10(db / 10.0), bytes);
        assert!(at_db(0.0, 300) < 1e-3 && at_db(8.0, 300) > 0.999);
        for db in 0..120 {
            let db = f64::from(db) / 10.0;
            assert!(at_db(db + 0.1, 300) >= at_db(db, 300));
            assert!(at_db(db, 100) >= at_db(db, 300));
        }
        assert_eq!(decode_probability(0.0, 300), 0.0);
        assert!(decode_probability(1e9, 300) == 1.0);
    }

    #[test]
    fn the_shortcuts_change_no_bit() {
        for step in 0..40_000 {
            let (ratio, bytes) = (f64::from(step) * 1e-3, step as usize % 3000);
            assert_eq!(decode_probability(ratio, bytes), union_bound(ratio, bytes), "{ratio}");
        }
    }

    #[test]
    fn the_bound_is_the_sum_over_the_paths() {
        // 5 dB: p = ½ erfc √(10^0.5 / 2) = 0.037 679; D = √(4 p (1 − p)), summed term by term.
        let ratio = libm::exp10(0.5);
        let p = 0.5 * libm::erfc((ratio / 2.0).sqrt());
        let d = (4.0 * p * (1.0 - p)).sqrt();
        let coded: f64 = ERROR_WEIGHTS
            .iter()
            .enumerate()
            .map(|(i, w)| 0.5 * w * d.powi(10 + 2 * i as i32))
            .sum();
        let expected = (1.0 - coded.min(1.0)).powi(8 * 300);
        assert!((p - 0.037_679).abs() < 1e-6, "{p}");
        assert!((decode_probability(ratio, 300) - expected).abs() < 1e-9);
    }
}
