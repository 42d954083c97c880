//! What the places of a population have in common: each has a random stream, and a turn in which it is updated.

use rand_chacha::{ChaCha8Rng, rand_core::SeedableRng};

/// Each road user is updated once in this time, seconds.
const CARE_S: f64 = 1.0;
/// A vehicle that finds no room for this long is added elsewhere, seconds.
const PATIENCE_S: f64 = 1.5;

/// The times above, in steps.
#[derive(Debug, Clone, Copy)]
pub(super) struct CareSchedule {
    pub(super) care: u64,
    pub(super) patience: u64,
}

impl CareSchedule {
    pub(super) fn new(step_s: f64) -> Self {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a few steps, positive"
        )]
        let steps = |seconds: f64| ((seconds / step_s).round() as u64).max(1);
        Self {
            care: steps(CARE_S),
            patience: steps(PATIENCE_S),
        }
    }

    /// True once every [`CARE_S`] for each place, for different places at different steps.
    pub(super) fn is_due(self, place: usize, step: u64) -> bool {
        (step + place as u64).is_multiple_of(self.care)
    }
}

/// The random stream of one place: a function of the episode's seed and the place alone.
pub(super) fn stream(episode_seed: u64, place: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(episode_seed);
    rng.set_stream(place);
    rng
}

#[cfg(test)]
mod tests {
    use super::stream;
    use crate::population::vehicle_types::unit;

    #[test]
    fn neighbouring_places_draw_independently() {
        let low = (0..10_000).filter(|&place| unit(&mut stream(5, place)) < 0.3).count();
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&low), "{low}");
    }
}
