//! Which episodes a run consists of: a pure function of configuration and seed, so that every process knows it.

use crate::config::Episode as Lengths;

/// One episode of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Episode {
    /// 0-based over the run.
    pub index: u64,
    /// True if nothing is learned in it and training never sees its seed.
    pub evaluation: bool,
    /// Seed of traffic, noise and blackouts.
    pub seed: u64,
    /// Length in ticks; `None` = until the scenario ends.
    pub ticks: Option<u64>,
}

/// The episodes of a training run: training episodes, evaluations at the interval, and the final evaluations.
#[must_use]
pub fn training(lengths: &Lengths, seed: u64) -> Vec<Episode> {
    let mut episodes = Vec::new();
    let (mut trained, mut evaluated) = (0, 0);
    let mut push = |evaluation: bool, count: &mut u64, ticks: u64| {
        episodes.push(Episode {
            index: episodes.len() as u64,
            evaluation,
            seed: episode_seed(seed, evaluation, *count),
            ticks: Some(ticks),
        });
        *count += 1;
    };
    while trained < lengths.training_episodes {
        push(false, &mut trained, lengths.ticks);
        let due = lengths.evaluation_interval > 0 && trained % lengths.evaluation_interval == 0;
        if due && trained < lengths.training_episodes {
            push(true, &mut evaluated, lengths.evaluation_ticks);
        }
    }
    for _ in 0..lengths.final_evaluations {
        push(true, &mut evaluated, lengths.evaluation_ticks);
    }
    episodes
}

/// The episodes of a run without learning: all training episodes one after the other.
#[must_use]
pub fn simulation(lengths: &Lengths, seed: u64) -> Vec<Episode> {
    (0..lengths.training_episodes)
        .map(|index| Episode {
            index,
            evaluation: false,
            seed: episode_seed(seed, false, index),
            ticks: Some(lengths.ticks),
        })
        .collect()
}

/// The single episode of a user's scenario: to its own end, with the run's seed.
#[must_use]
pub fn scenario(seed: u64) -> Vec<Episode> {
    vec![Episode {
        index: 0,
        evaluation: false,
        seed,
        ticks: None,
    }]
}

/// Seed of the `environment`-th environment: the run's own for the first, then the first eight bytes of a BLAKE3 hash.
#[must_use]
pub fn environment_seed(run_seed: u64, environment: u32) -> u64 {
    if environment == 0 {
        return run_seed;
    }
    let mut hasher = blake3::Hasher::new_derive_key("caraware environment");
    hasher.update(&run_seed.to_le_bytes());
    hasher.update(&environment.to_le_bytes());
    first_eight(&hasher)
}

fn first_eight(hasher: &blake3::Hasher) -> u64 {
    let mut first = [0_u8; 8];
    first.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
    u64::from_le_bytes(first)
}

/// The `index`-th episode of play: its seed is one that no training sees.
#[must_use]
pub fn play(seed: u64, index: u64, ticks: Option<u64>) -> Episode {
    Episode {
        index,
        evaluation: true,
        seed: episode_seed(seed, true, index),
        ticks,
    }
}

/// Seed of the `count`-th training or evaluation episode: first eight bytes of a BLAKE3 hash, so the two never meet.
#[must_use]
pub fn episode_seed(run_seed: u64, evaluation: bool, count: u64) -> u64 {
    let mut hasher = blake3::Hasher::new_derive_key(if evaluation {
        "caraware evaluation episode"
    } else {
        "caraware training episode"
    });
    hasher.update(&run_seed.to_le_bytes());
    hasher.update(&count.to_le_bytes());
    first_eight(&hasher)
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use std::collections::BTreeSet;

    fn lengths(training_episodes: u64, evaluation_interval: u64, final_evaluations: u64) -> Lengths {
        Lengths {
            ticks: 10,
            training_episodes,
            evaluation_interval,
            evaluation_ticks: 5,
            final_evaluations,
        }
    }

    #[test]
    fn evaluations_come_at_the_interval_and_at_the_end() {
        let kinds: Vec<bool> = training(&lengths(4, 2, 2), 1).iter().map(|e| e.evaluation).collect();
        assert_eq!(kinds, [false, false, true, false, false, true, true]);
    }

    #[test]
    fn the_first_environment_has_the_seed_of_the_run() {
        assert_eq!(environment_seed(42, 0), 42);
    }

    proptest! {
        #[test]
        fn no_two_environments_share_an_episode(seed: u64, n in 1_u64..8, environments in 2_u32..9) {
            let episodes = (0..environments).flat_map(|env| training(&lengths(n, 2, 2), environment_seed(seed, env)));
            let seeds: Vec<u64> = episodes.map(|episode| episode.seed).collect();
            prop_assert_eq!(seeds.iter().collect::<BTreeSet<_>>().len(), seeds.len());
        }

        #[test]
        fn no_seed_is_used_twice(seed: u64, n in 0_u64..50, interval in 0_u64..5, last in 0_u64..5) {
            let episodes = training(&lengths(n, interval, last), seed);
            let seeds: BTreeSet<u64> = episodes.iter().map(|e| e.seed).collect();
            prop_assert_eq!(seeds.len(), episodes.len());
            prop_assert_eq!(episodes.iter().filter(|e| !e.evaluation).count() as u64, n);
        }
    }
}
