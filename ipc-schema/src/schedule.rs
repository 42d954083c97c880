//! The schedule of a run's episodes: a pure function of configuration and seed, which every process can compute.

use crate::config::{CurriculumConfig, EpisodeConfig as Lengths, MapChoice, StageConfig};

/// One episode of a run.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Episode {
    /// Number of the episode in the run, from 0.
    pub index: u64,
    /// True in an evaluation: the learner does not learn, and no training episode has its seed.
    pub evaluation: bool,
    /// Seed of traffic, noise and blackouts.
    pub seed: u64,
    /// Length in ticks; `None` means until the scenario ends.
    pub ticks: Option<u64>,
}

/// How many episodes of one kind and length a run plans.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct EpisodeCount {
    /// Length of each in ticks; `None` means until the scenario ends.
    pub ticks: Option<u64>,
    /// How many.
    pub episodes: u64,
}

/// The `index`-th episode of a training run: training episodes, evaluations at the interval, and the final evaluations. `None` past the
/// last one.
#[must_use]
pub fn training(lengths: &Lengths, seed: u64, index: u64) -> Option<Episode> {
    let between = evaluations_between(lengths);
    let (evaluation, number) = match lengths.training_episodes + between {
        before_the_end if index >= before_the_end => {
            let number = index - before_the_end;
            if number >= lengths.final_evaluations {
                return None;
            }
            (true, between + number)
        }
        _ => {
            // As many training episodes as the interval, and the evaluation that follows them.
            let group = index / lengths.evaluation_interval.saturating_add(1);
            let place = index - group * lengths.evaluation_interval.saturating_add(1);
            match between {
                between if group >= between => (false, index - between),
                _ if place == lengths.evaluation_interval => (true, group),
                _ => (false, index - group),
            }
        }
    };
    let ticks = match evaluation {
        true => lengths.evaluation_ticks,
        false => lengths.ticks,
    };
    Some(Episode {
        index,
        evaluation,
        seed: episode_seed(seed, evaluation, number),
        ticks: Some(ticks),
    })
}

/// The lengths of a training run's episodes, training episodes first.
#[must_use]
pub fn training_counts(lengths: &Lengths) -> [EpisodeCount; 2] {
    [
        EpisodeCount {
            ticks: Some(lengths.ticks),
            episodes: lengths.training_episodes,
        },
        EpisodeCount {
            ticks: Some(lengths.evaluation_ticks),
            episodes: evaluations_between(lengths) + lengths.final_evaluations,
        },
    ]
}

/// Evaluations before the last training episode.
fn evaluations_between(lengths: &Lengths) -> u64 {
    let last = lengths.training_episodes.saturating_sub(1);
    last.checked_div(lengths.evaluation_interval).unwrap_or(0)
}

/// The `index`-th episode of a run without learning: all training episodes in order.
#[must_use]
pub fn simulation(lengths: &Lengths, seed: u64, index: u64) -> Option<Episode> {
    (index < lengths.training_episodes).then(|| Episode {
        index,
        evaluation: false,
        seed: episode_seed(seed, false, index),
        ticks: Some(lengths.ticks),
    })
}

/// The single episode of a user's scenario. It has the run's seed and lasts until the scenario ends.
#[must_use]
pub fn scenario(seed: u64, index: u64) -> Option<Episode> {
    (index == 0).then_some(Episode {
        index,
        evaluation: false,
        seed,
        ticks: None,
    })
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
    first_words(&hasher)[0]
}

/// The first bytes of a hash as two numbers.
fn first_words(hasher: &blake3::Hasher) -> [u64; 2] {
    let hash = hasher.finalize();
    [0, 8].map(|from| {
        let mut word = [0_u8; 8];
        word.copy_from_slice(&hash.as_bytes()[from..from + 8]);
        u64::from_le_bytes(word)
    })
}

/// The `index`-th episode of play. No episode of the training run has its seed: evaluations have chosen the best checkpoint, which play
/// measures on other seeds.
#[must_use]
pub fn play(seed: u64, index: u64, ticks: Option<u64>) -> Episode {
    Episode {
        index,
        evaluation: true,
        seed: keyed_seed("caraware play episode", seed, index),
        ticks,
    }
}

/// The next part of a run with a curriculum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum DueWork {
    /// An evaluation, in the base configuration.
    Evaluation {
        /// The episode.
        episode: Episode,
        /// True for the last episode of the run.
        is_last: bool,
    },
    /// The lesson with this number. [`CurriculumPlan::enter`] begins it in its stage.
    Lesson(u64),
    /// The run is complete.
    Nothing,
}

/// A lesson of a run with a curriculum.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Lesson {
    /// Number of its stage, from 0.
    pub stage: usize,
    /// Index of its map among those of the run.
    pub map: usize,
    /// The episode that begins with it; `None` if the running episode continues.
    pub begins: Option<Episode>,
}

/// The plan of a run with a curriculum: lessons, evaluations at the interval, and the final evaluations. It depends only on the
/// configuration, the seed and the stages of the lessons.
#[derive(Debug)]
pub struct CurriculumPlan {
    lengths: Lengths,
    stages: Vec<StagePlan>,
    seed: u64,
    lessons: u64,
    episodes: u64,
    evaluations: u64,
    final_evaluations: u64,
    evaluated_lessons: u64,
    is_over: bool,
    /// Stage of the running episode.
    running: Option<usize>,
    /// Stage of the newest lesson, and the first lesson of that stage.
    since: Option<(usize, u64)>,
}

/// The part of a stage that the plan needs.
#[derive(Debug, Clone)]
struct StagePlan {
    restart: bool,
    maps: Vec<usize>,
    choice: MapChoice,
    until_lessons: Option<u64>,
}

impl StagePlan {
    fn new(curriculum: &CurriculumConfig, stage: &StageConfig) -> Self {
        Self {
            restart: stage.restart,
            maps: curriculum.maps_of(stage),
            choice: stage.map_choice,
            until_lessons: stage.until_lessons,
        }
    }

    /// The map of the lesson that comes `since` lessons after `first`, the first lesson of the stage. The run has at most `most` lessons.
    fn map(&self, seed: u64, first: u64, since: u64, most: u64) -> usize {
        let count = self.maps.len() as u64;
        let [share, draw] = map_words(seed, first + since);
        #[expect(clippy::cast_possible_truncation, reason = "less than the number of maps")]
        let at = |place: u64| self.maps[place as usize];
        let lessons = self.until_lessons.unwrap_or(most.saturating_sub(first));
        match self.choice {
            MapChoice::InOrder => at(since % count),
            MapChoice::Random => at(draw % count),
            // The probability is since / (lessons − 1), in whole numbers: `share` is uniform over 2⁶⁴ values.
            MapChoice::GraduallyRandom => {
                let (since, last) = (u128::from(since), u128::from(lessons.saturating_sub(1)));
                match u128::from(share) * last < since << 64 {
                    true => at(draw % count),
                    false => at(0),
                }
            }
        }
    }
}

/// Two random numbers for the map of a lesson: the first bytes of a BLAKE3 hash.
fn map_words(run_seed: u64, lesson: u64) -> [u64; 2] {
    let mut hasher = blake3::Hasher::new_derive_key("caraware map of a lesson");
    hasher.update(&run_seed.to_le_bytes());
    hasher.update(&lesson.to_le_bytes());
    first_words(&hasher)
}

impl CurriculumPlan {
    /// The plan at the beginning of the run.
    #[must_use]
    pub fn new(lengths: &Lengths, curriculum: &CurriculumConfig, seed: u64) -> Self {
        Self {
            lengths: lengths.clone(),
            stages: curriculum
                .stages
                .iter()
                .map(|stage| StagePlan::new(curriculum, stage))
                .collect(),
            seed,
            lessons: 0,
            episodes: 0,
            evaluations: 0,
            final_evaluations: 0,
            evaluated_lessons: 0,
            is_over: false,
            running: None,
            since: None,
        }
    }

    /// The next part of the run. An evaluation counts as begun once it is returned.
    pub fn due(&mut self) -> DueWork {
        self.is_over |= self.lessons >= self.lengths.training_episodes;
        let interval = self.lengths.evaluation_interval;
        if self.is_over {
            self.final_evaluations += 1;
            return match self.final_evaluations > self.lengths.final_evaluations {
                true => DueWork::Nothing,
                false => self.evaluation(self.final_evaluations == self.lengths.final_evaluations),
            };
        }
        if interval > 0 && self.lessons > self.evaluated_lessons && self.lessons.is_multiple_of(interval) {
            self.evaluated_lessons = self.lessons;
            return self.evaluation(false);
        }
        DueWork::Lesson(self.lessons)
    }

    fn evaluation(&mut self, is_last: bool) -> DueWork {
        self.running = None;
        let episode = self.begin(true, self.evaluations, self.lengths.evaluation_ticks);
        self.evaluations += 1;
        DueWork::Evaluation { episode, is_last }
    }

    fn begin(&mut self, evaluation: bool, count: u64, ticks: u64) -> Episode {
        self.episodes += 1;
        Episode {
            index: self.episodes - 1,
            evaluation,
            seed: episode_seed(self.seed, evaluation, count),
            ticks: Some(ticks),
        }
    }

    /// Begins the lesson that is due, in `stage`, counted from 0. `None` if `stage` is after the last one: then the lessons are over.
    pub fn enter(&mut self, stage: usize) -> Option<Lesson> {
        let Some(way) = self.stages.get(stage) else {
            self.is_over = true;
            return None;
        };
        let first = match self.since {
            Some((newest, first)) if newest == stage => first,
            _ => self.lessons,
        };
        // An episode that continues cannot change its map.
        let since = if way.restart { self.lessons - first } else { 0 };
        let map = way.map(self.seed, first, since, self.lengths.training_episodes);
        let continues = !way.restart && self.running == Some(stage);
        let begins = (!continues).then(|| self.begin(false, self.lessons, self.lengths.ticks));
        (self.running, self.since) = (Some(stage), Some((stage, first)));
        self.lessons += 1;
        Some(Lesson { stage, map, begins })
    }
}

/// Seed of the `count`-th training or evaluation episode: the first eight bytes of a BLAKE3 hash. The two kinds have different keys, so
/// they do not share seeds.
#[must_use]
pub fn episode_seed(run_seed: u64, evaluation: bool, count: u64) -> u64 {
    let key = match evaluation {
        true => "caraware evaluation episode",
        false => "caraware training episode",
    };
    keyed_seed(key, run_seed, count)
}

/// The first eight bytes of a BLAKE3 hash of seed and number, under the key of the episode's kind.
fn keyed_seed(key: &str, run_seed: u64, count: u64) -> u64 {
    let mut hasher = blake3::Hasher::new_derive_key(key);
    hasher.update(&run_seed.to_le_bytes());
    hasher.update(&count.to_le_bytes());
    first_words(&hasher)[0]
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
            whole_scenario: false,
        }
    }

    fn all(lengths: &Lengths, seed: u64) -> Vec<Episode> {
        (0..).map_while(|index| training(lengths, seed, index)).collect()
    }

    #[test]
    fn evaluations_come_at_the_interval_and_at_the_end() {
        let kinds: Vec<bool> = all(&lengths(4, 2, 2), 1).iter().map(|e| e.evaluation).collect();
        assert_eq!(kinds, [false, false, true, false, false, true, true]);
    }

    proptest! {
        /// The plan by index is the one that counts the episodes one after the other.
        #[test]
        fn an_episode_of_any_index_is_that_of_the_loop(
            training_episodes in 0_u64..40,
            interval in 0_u64..12,
            final_evaluations in 0_u64..4,
        ) {
            let lengths = lengths(training_episodes, interval, final_evaluations);
            let mut expected = Vec::new();
            let mut counts = [0; 2];
            let mut push = |evaluation: bool| {
                let count = &mut counts[usize::from(evaluation)];
                expected.push(Episode {
                    index: expected.len() as u64,
                    evaluation,
                    seed: episode_seed(7, evaluation, *count),
                    ticks: Some(if evaluation { lengths.evaluation_ticks } else { lengths.ticks }),
                });
                *count += 1;
            };
            for trained in 1..=training_episodes {
                push(false);
                if trained < training_episodes && trained.checked_rem(interval) == Some(0) {
                    push(true);
                }
            }
            (0..final_evaluations).for_each(|_| push(true));
            prop_assert_eq!(all(&lengths, 7), expected);
            prop_assert_eq!(training_counts(&lengths).map(|count| count.episodes), counts);
        }
    }

    #[test]
    fn the_first_environment_has_the_seed_of_the_run() {
        assert_eq!(environment_seed(42, 0), 42);
    }

    /// A plan through stages of which the second does not restart, with lessons in `stages`: L and E begin an episode, l continues.
    fn plan(lengths: &Lengths, stages: &[usize]) -> String {
        let curriculum = CurriculumConfig {
            stages: [true, false]
                .map(|restart| serde_json::from_value(serde_json::json!({"cavs": 1, "restart": restart})).unwrap())
                .to_vec(),
            ..CurriculumConfig::default()
        };
        let mut plan = CurriculumPlan::new(lengths, &curriculum, 7);
        let mut parts = String::new();
        let mut seeds = BTreeSet::new();
        loop {
            let episode = match plan.due() {
                DueWork::Evaluation { episode, is_last } => {
                    parts.push(if is_last { '!' } else { 'E' });
                    Some(episode)
                }
                DueWork::Lesson(number) => plan.enter(stages[number as usize]).and_then(|lesson| {
                    parts.push(if lesson.begins.is_some() { 'L' } else { 'l' });
                    lesson.begins
                }),
                DueWork::Nothing => return parts,
            };
            if let Some(episode) = episode {
                assert_eq!(episode.index, seeds.len() as u64);
                assert!(seeds.insert(episode.seed));
            }
        }
    }

    #[test]
    fn a_plan_restarts_where_its_stage_says_so_and_ends_after_the_last_stage() {
        assert_eq!(plan(&lengths(9, 0, 2), &[0, 0, 1, 1, 1, 2]), "LLLllE!");
        // An evaluation has an episode of its own; the stage that it interrupts begins a new episode.
        assert_eq!(plan(&lengths(9, 2, 1), &[0, 1, 1, 1, 2]), "LLELlE!");
        // No lesson passes the gate.
        assert_eq!(plan(&lengths(4, 0, 1), &[0, 0, 0, 0, 0]), "LLLL!");
    }

    /// Maps of lessons in `stages`, in a curriculum over the maps a, b and c.
    fn maps(seed: u64, most: u64, kinds: &serde_json::Value, stages: &[usize]) -> Vec<usize> {
        let curriculum = CurriculumConfig {
            stages: serde_json::from_value(kinds.clone()).unwrap(),
            maps: ["a.net.xml", "b.net.xml", "some/c.sumocfg"]
                .map(|map| map.parse().unwrap())
                .to_vec(),
            ..CurriculumConfig::default()
        };
        let mut plan = CurriculumPlan::new(&lengths(most, 0, 1), &curriculum, seed);
        stages.iter().map(|stage| plan.enter(*stage).unwrap().map).collect()
    }

    #[test]
    fn maps_are_taken_in_order_and_stay_while_an_episode_continues() {
        let kinds = serde_json::json!([
            {"cavs": 1},
            {"cavs": 1, "maps": ["c", "a"]},
            {"cavs": 1, "maps": ["b", "c"], "restart": false},
        ]);
        // The count starts again with the stage.
        assert_eq!(maps(7, 99, &kinds, &[0, 0, 1, 1, 1, 2, 2, 2]), [0, 0, 2, 0, 2, 1, 1, 1]);
        let drawn = serde_json::json!([{"cavs": 1, "maps": ["a", "b", "c"], "map_choice": "random", "restart": false}]);
        for seed in 0..20 {
            let found = maps(seed, 99, &drawn, &[0; 9]);
            assert!(found.iter().all(|map| *map == found[0]), "{found:?}");
        }
    }

    #[test]
    fn an_evaluation_between_does_not_change_the_map_of_a_stage_that_stays() {
        let kinds = serde_json::json!([{"cavs": 1, "maps": ["a", "b", "c"], "map_choice": "random", "restart": false}]);
        let curriculum = CurriculumConfig {
            stages: serde_json::from_value(kinds).unwrap(),
            maps: ["a.net.xml", "b.net.xml", "c.net.xml"]
                .map(|map| map.parse().unwrap())
                .to_vec(),
            ..CurriculumConfig::default()
        };
        let mut plan = CurriculumPlan::new(&lengths(20, 2, 1), &curriculum, 5);
        let (mut maps, mut begun) = (BTreeSet::new(), 0);
        loop {
            match plan.due() {
                DueWork::Evaluation { .. } => {}
                DueWork::Lesson(_) => {
                    let lesson = plan.enter(0).unwrap();
                    begun += u64::from(lesson.begins.is_some());
                    maps.insert(lesson.map);
                }
                DueWork::Nothing => break,
            }
        }
        assert_eq!((maps.len(), begun), (1, 10));
    }

    #[test]
    fn a_random_map_depends_on_seed_and_lesson_alone() {
        let kinds = serde_json::json!([
            {"cavs": 1, "maps": ["a", "b", "c"], "map_choice": "random"},
            {"cavs": 1, "maps": ["a", "b", "c"], "map_choice": "random", "noise": 2.0},
        ]);
        let all = maps(3, 3000, &kinds, &[0; 3000]);
        let split: Vec<usize> = (0..3000).map(|lesson| usize::from(lesson >= 1234)).collect();
        assert_eq!(maps(3, 9999, &kinds, &split), all);
        assert_ne!(maps(4, 3000, &kinds, &[0; 3000]), all);
        for map in 0..3 {
            // Binomial: 5 standard deviations are 130.
            let count = all.iter().filter(|found| **found == map).count();
            assert!((870..=1130).contains(&count), "{count}");
        }
    }

    #[test]
    fn gradually_random_begins_on_the_first_map_and_ends_on_any() {
        let kinds = |until: Option<u64>| serde_json::json!([{"cavs": 1, "maps": ["b", "a"], "map_choice": "gradually_random", "until_lessons": until}]);
        // Over the lessons of the stage, and over those of training where the stage has no number of lessons.
        for (most, until) in [(9999, Some(2000)), (2000, None)] {
            let found = maps(5, most, &kinds(until), &[0; 2000]);
            assert_eq!(found[0], 1);
            let away = |part: std::ops::Range<usize>| found[part].iter().filter(|map| **map == 0).count();
            // Half of the drawn ones: 1/8 and 3/8 of 1000, 5 standard deviations are 53 and 77.
            let (early, late) = (away(0..1000), away(1000..2000));
            assert!(
                (72..=178).contains(&early) && (298..=452).contains(&late),
                "{early} {late}"
            );
        }
        assert_eq!(maps(5, 1, &kinds(Some(1)), &[0]), [1]);
    }

    proptest! {
        #[test]
        fn no_two_environments_share_an_episode(seed: u64, n in 1_u64..8, environments in 2_u32..9) {
            let episodes = (0..environments).flat_map(|env| all(&lengths(n, 2, 2), environment_seed(seed, env)));
            let seeds: Vec<u64> = episodes.map(|episode| episode.seed).collect();
            prop_assert_eq!(seeds.iter().collect::<BTreeSet<_>>().len(), seeds.len());
        }

        #[test]
        fn no_seed_is_used_twice(seed: u64, n in 0_u64..50, interval in 0_u64..5, last in 0_u64..5) {
            let episodes = all(&lengths(n, interval, last), seed);
            let seeds: BTreeSet<u64> = episodes.iter().map(|e| e.seed).collect();
            prop_assert_eq!(seeds.len(), episodes.len());
            prop_assert_eq!(episodes.iter().filter(|e| !e.evaluation).count() as u64, n);
            // What chose the best checkpoint does not report about it.
            prop_assert!((0..20).all(|index| !seeds.contains(&play(seed, index, None).seed)));
        }
    }
}
