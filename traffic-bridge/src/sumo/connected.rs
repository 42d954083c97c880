//! The rule that decides which vehicles are connected and which are heroes.

use std::collections::BTreeSet;

use ipc_schema::traffic::{Kind, id_hash};

/// Ids of the population's connected vehicles start with this.
pub const CAV_PREFIX: &str = "cav.";
/// Ids of the population's heroes start with this.
pub const HERO_PREFIX: &str = "hero.";

/// The rule that separates connected vehicles and heroes from others: a function of the id and, in a scenario, of how many
/// connected vehicles are on the road.
#[derive(Debug, Clone, PartialEq)]
pub enum ConnectedRule {
    /// Population control names its connected vehicles `cav.N` and its heroes `hero.N`.
    Population,
    /// The vehicles of a scenario.
    Scenario {
        /// Ids of the heroes.
        heroes: BTreeSet<String>,
        /// Share of all others that are connected, by the hash of their ids.
        cav_share: f64,
        /// Most connected vehicles at a time; 0 = no limit.
        max_cavs: u32,
    },
}

impl ConnectedRule {
    /// A scenario without heroes.
    #[must_use]
    pub fn connected(cav_share: f64) -> Self {
        Self::Scenario {
            heroes: BTreeSet::new(),
            cav_share,
            max_cavs: 0,
        }
    }

    /// The kind of the vehicle `id`, which departs while `cavs` connected vehicles are on the road.
    #[must_use]
    pub fn kind_of_vehicle(&self, id: &str, cavs: u32) -> Kind {
        let (hero, connected) = match self {
            Self::Population => (id.starts_with(HERO_PREFIX), id.starts_with(CAV_PREFIX)),
            Self::Scenario {
                heroes,
                cav_share,
                max_cavs,
            } => {
                let has_room = *max_cavs == 0 || cavs < *max_cavs;
                (heroes.contains(id), has_room && share_of_hash(id_hash(id)) < *cav_share)
            }
        };
        match (hero, connected) {
            (true, _) => Kind::Hero,
            (false, true) => Kind::Cav,
            (false, false) => Kind::Other,
        }
    }
}

/// `hash` / 2⁶⁴, below 1.
pub(crate) fn share_of_hash(hash: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "the 53 high bits are exact")]
    let high = (hash >> 11) as f64;
    high / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario(cav_share: f64) -> ConnectedRule {
        ConnectedRule::Scenario {
            heroes: BTreeSet::from(["h".into()]),
            cav_share,
            max_cavs: 2,
        }
    }

    #[test]
    fn heroes_are_recognised_by_their_ids() {
        assert_eq!(scenario(1.0).kind_of_vehicle("h", 2), Kind::Hero);
        assert_eq!(ConnectedRule::Population.kind_of_vehicle("hero.3", 0), Kind::Hero);
        assert_eq!(ConnectedRule::Population.kind_of_vehicle("other.3", 0), Kind::Other);
    }

    #[test]
    fn no_vehicle_is_connected_beyond_the_limit() {
        let kinds = [0, 1, 2, 3].map(|cavs| scenario(1.0).kind_of_vehicle("v", cavs));
        assert_eq!(kinds, [Kind::Cav, Kind::Cav, Kind::Other, Kind::Other]);
        assert_eq!(ConnectedRule::connected(1.0).kind_of_vehicle("v", u32::MAX), Kind::Cav);
    }

    #[test]
    fn shares_are_exact_at_the_ends_and_fair_between() {
        let cavs = |share| {
            (0..10_000)
                .filter(|i| scenario(share).kind_of_vehicle(&format!("v{i}"), 0) == Kind::Cav)
                .count()
        };
        assert_eq!((cavs(0.0), cavs(1.0)), (0, 10_000));
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&cavs(0.3)), "{}", cavs(0.3));
    }
}
