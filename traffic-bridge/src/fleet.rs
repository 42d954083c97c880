//! Which vehicles are connected.

use ipc_schema::traffic::{Kind, id_hash};

/// Ids of the population's connected vehicles start with this.
pub const CAV_PREFIX: &str = "cav.";

/// The rule that tells connected vehicles from others: a function of the id alone.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fleet {
    /// Population control names its connected vehicles `cav.N`.
    Population,
    /// This share of all vehicles, by the hash of their ids.
    Share(f64),
}

impl Fleet {
    /// The kind of the vehicle `id`.
    #[must_use]
    pub fn kind_of_vehicle(self, id: &str) -> Kind {
        let connected = match self {
            Self::Population => id.starts_with(CAV_PREFIX),
            Self::Share(share) => unit(id_hash(id)) < share,
        };
        if connected { Kind::Cav } else { Kind::Other }
    }
}

/// `hash` / 2⁶⁴, below 1.
fn unit(hash: u64) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "the 53 high bits are exact")]
    let high = (hash >> 11) as f64;
    high / (1_u64 << 53) as f64
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn shares_are_exact_at_the_ends_and_fair_between() {
        let cavs = |share| {
            (0..10_000)
                .filter(|i| Fleet::Share(share).kind_of_vehicle(&format!("v{i}")) == Kind::Cav)
                .count()
        };
        assert_eq!((cavs(0.0), cavs(1.0)), (0, 10_000));
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&cavs(0.3)), "{}", cavs(0.3));
    }
}
