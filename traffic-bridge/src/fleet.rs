//! Which vehicles are connected, and which are heroes.

use std::collections::BTreeSet;

use ipc_schema::traffic::{Kind, id_hash};

/// Ids of the population's connected vehicles start with this.
pub const CAV_PREFIX: &str = "cav.";
/// Ids of the population's heroes start with this.
pub const HERO_PREFIX: &str = "hero.";

/// The rule that tells connected vehicles and heroes from others: a function of the id alone.
#[derive(Debug, Clone, PartialEq)]
pub enum Fleet {
    /// Population control names its connected vehicles `cav.N` and its heroes `hero.N`.
    Population,
    /// The vehicles of a scenario.
    Scenario {
        /// Ids of the heroes.
        heroes: BTreeSet<String>,
        /// Share of all others that are connected, by the hash of their ids.
        cav_share: f64,
    },
}

impl Fleet {
    /// A scenario without heroes.
    #[must_use]
    pub fn connected(cav_share: f64) -> Self {
        Self::Scenario {
            heroes: BTreeSet::new(),
            cav_share,
        }
    }

    /// The kind of the vehicle `id`.
    #[must_use]
    pub fn kind_of_vehicle(&self, id: &str) -> Kind {
        let (hero, connected) = match self {
            Self::Population => (id.starts_with(HERO_PREFIX), id.starts_with(CAV_PREFIX)),
            Self::Scenario { heroes, cav_share } => (heroes.contains(id), unit(id_hash(id)) < *cav_share),
        };
        match (hero, connected) {
            (true, _) => Kind::Hero,
            (false, true) => Kind::Cav,
            (false, false) => Kind::Other,
        }
    }
}

/// `hash` / 2⁶⁴, below 1.
pub(crate) fn unit(hash: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "the 53 high bits are exact")]
    let high = (hash >> 11) as f64;
    high / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scenario(cav_share: f64) -> Fleet {
        Fleet::Scenario {
            heroes: BTreeSet::from(["h".into()]),
            cav_share,
        }
    }

    #[test]
    fn heroes_are_told_by_their_ids() {
        assert_eq!(scenario(1.0).kind_of_vehicle("h"), Kind::Hero);
        assert_eq!(Fleet::Population.kind_of_vehicle("hero.3"), Kind::Hero);
        assert_eq!(Fleet::Population.kind_of_vehicle("other.3"), Kind::Other);
    }

    #[test]
    fn shares_are_exact_at_the_ends_and_fair_between() {
        let cavs = |share| {
            (0..10_000)
                .filter(|i| scenario(share).kind_of_vehicle(&format!("v{i}")) == Kind::Cav)
                .count()
        };
        assert_eq!((cavs(0.0), cavs(1.0)), (0, 10_000));
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&cavs(0.3)), "{}", cavs(0.3));
    }
}
