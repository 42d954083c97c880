//! Trips that are reserved for evaluations: a policy is then judged on routes that no training episode drove.

use ipc_schema::traffic::id_hash;

use crate::sumo::connected::share_of_hash;

/// Which trips, from one road to another along the fastest route, drivers may make.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TripSelection {
    held_out: f64,
    evaluation: bool,
}

impl TripSelection {
    /// All trips.
    pub const ANY: Self = Self {
        held_out: 0.0,
        evaluation: false,
    };

    /// The share `held_out` of all trips is driven in evaluation episodes only, and evaluation episodes drive no others;
    /// 0 = all trips in all episodes.
    #[must_use]
    pub fn of_episode(held_out: f64, evaluation: bool) -> Self {
        Self { held_out, evaluation }
    }

    /// Whether a driver may go from one road to the other. The answer depends on the ids alone: it is the same in every run.
    #[must_use]
    pub fn allow(&self, from: &str, to: &str) -> bool {
        self.held_out <= 0.0 || self.is_held_out(from, to) == self.evaluation
    }

    fn is_held_out(&self, from: &str, to: &str) -> bool {
        // Ids hold no spaces: no two pairs give the same text.
        share_of_hash(id_hash(&format!("{from} {to}"))) < self.held_out
    }
}

#[cfg(test)]
mod tests {
    use super::TripSelection;

    fn pairs() -> impl Iterator<Item = (String, String)> {
        (0..60).flat_map(|from| (0..60).map(move |to| (format!("edge_{from}"), format!("edge_{to}"))))
    }

    #[test]
    fn a_trip_is_for_training_or_for_evaluation_never_for_both() {
        let (training, evaluation) = (
            TripSelection::of_episode(0.2, false),
            TripSelection::of_episode(0.2, true),
        );
        let held_out = pairs().filter(|(from, to)| evaluation.allow(from, to)).count();
        assert!(pairs().all(|(from, to)| training.allow(&from, &to) != evaluation.allow(&from, &to)));
        // Binomial of 3600 with 0.2: 5 standard deviations are 120.
        assert!((600..=840).contains(&held_out), "{held_out}");
        let reverse = pairs()
            .filter(|(from, to)| evaluation.allow(from, to) && evaluation.allow(to, from))
            .count();
        assert!(
            reverse < held_out / 2,
            "both ways are one trip: {reverse} of {held_out}"
        );
    }

    #[test]
    fn without_held_out_trips_all_are_allowed_everywhere() {
        assert!(
            pairs().all(|(from, to)| TripSelection::ANY.allow(&from, &to)
                && TripSelection::of_episode(0.0, true).allow(&from, &to))
        );
    }
}
