//! The vehicle types that a population is drawn from.

use std::path::Path;

use rand_chacha::{ChaCha8Rng, rand_core::RngCore};

use crate::sumo::{
    Sumo, called,
    error::SumoError,
    inputs::{attribute, for_each_element},
    libsumo::ffi,
};

/// SUMO's own types, for a net without types.
const DEFAULT_VEHICLE: &str = "DEFAULT_VEHTYPE";
const DEFAULT_PEDESTRIAN: &str = "DEFAULT_PEDTYPE";

/// A type and how often it is drawn.
#[derive(Debug, Clone, PartialEq)]
pub struct WeightedType {
    /// SUMO's id of the type.
    pub id: String,
    /// SUMO's vehicle class.
    pub class: String,
    /// Relative frequency, above 0.
    pub weight: f64,
}

/// Types of vehicles and of pedestrians; neither is empty.
#[derive(Debug, Clone, PartialEq)]
pub struct TypeCatalogue {
    /// Types of vehicles.
    pub vehicles: Vec<WeightedType>,
    /// Types of pedestrians.
    pub pedestrians: Vec<WeightedType>,
}

impl TypeCatalogue {
    /// The types in the additional files of `sumo`. Where a file has `vTypeDistribution`s, their members are drawn by
    /// their `probability`; all other types are drawn equally often.
    ///
    /// # Errors
    /// A file is unreadable, or SUMO does not know a type.
    pub fn read(sumo: &Sumo) -> Result<Self, SumoError> {
        let mut listed = Vec::new();
        for file in &sumo.files().others {
            listed.extend(listed_in(file)?);
        }
        let (mut vehicles, mut pedestrians) = (Vec::new(), Vec::new());
        for (id, weight) in listed.into_iter().filter(|(_, weight)| *weight > 0.0) {
            let entry = weighted_type(sumo.simulation(), id, weight)?;
            if entry.class == "pedestrian" {
                pedestrians.push(entry)
            } else {
                vehicles.push(entry)
            }
        }
        if vehicles.is_empty() {
            vehicles.push(weighted_type(sumo.simulation(), DEFAULT_VEHICLE.to_owned(), 1.0)?);
        }
        if pedestrians.is_empty() {
            pedestrians.push(weighted_type(sumo.simulation(), DEFAULT_PEDESTRIAN.to_owned(), 1.0)?);
        }
        Ok(Self { vehicles, pedestrians })
    }
}

fn weighted_type(simulation: &ffi::Simulation, id: String, weight: f64) -> Result<WeightedType, SumoError> {
    let class = called("report the class of a vehicle type", simulation.vehicle_class(&id))?;
    Ok(WeightedType { id, class, weight })
}

/// Types of one additional file with their weights. A type without probability counts 1.
fn listed_in(file: &Path) -> Result<Vec<(String, f64)>, SumoError> {
    let (mut listed, mut wrong) = (Vec::new(), None);
    for_each_element(file, |element| {
        if element.name().as_ref() == "vType"
            && let Some(id) = attribute(element, "id")
        {
            let probability = attribute(element, "probability").unwrap_or_else(|| "1".into());
            match probability.trim().parse() {
                Ok(weight) => listed.push((id, weight)),
                Err(_) => wrong = Some((format!("the probability of vehicle type \"{id}\","), probability)),
            }
        }
    })?;
    match wrong {
        None => Ok(listed),
        Some((what, value)) => Err(SumoError::NoNumber {
            path: file.into(),
            what,
            value,
        }),
    }
}

/// Draws an entry by weight. `entries` is not empty.
#[must_use]
pub fn draw<'a>(entries: &'a [WeightedType], rng: &mut ChaCha8Rng) -> &'a WeightedType {
    let total: f64 = entries.iter().map(|entry| entry.weight).sum();
    let mut left = unit(rng) * total;
    for entry in &entries[..entries.len() - 1] {
        left -= entry.weight;
        if left < 0.0 {
            return entry;
        }
    }
    &entries[entries.len() - 1]
}

/// A uniform number in [0, 1).
pub fn unit(rng: &mut ChaCha8Rng) -> f64 {
    #[expect(clippy::cast_precision_loss, reason = "53 bits are exact")]
    let bits = (rng.next_u64() >> 11) as f64;
    bits / (1_u64 << 53) as f64
}

/// A uniform index below `count`, which is above 0.
pub fn below(count: usize, rng: &mut ChaCha8Rng) -> usize {
    #[expect(
        clippy::cast_possible_truncation,
        reason = "the product's high half is below `count`"
    )]
    let index = ((u128::from(rng.next_u64()) * count as u128) >> 64) as usize;
    index
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand_chacha::rand_core::SeedableRng;

    #[test]
    fn a_probability_that_is_no_number_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("types.add.xml");
        let types =
            |probability: &str| format!("<additional><vType id=\"a\"/><vType id=\"b\" {probability}/></additional>");
        std::fs::write(&file, types("probability=\"0.5\"")).unwrap();
        assert_eq!(
            listed_in(&file).unwrap(),
            [("a".to_owned(), 1.0), ("b".to_owned(), 0.5)]
        );
        std::fs::write(&file, types("probability=\"often\"")).unwrap();
        let error = listed_in(&file).unwrap_err();
        assert!(matches!(error, SumoError::NoNumber { .. }), "{error}");
    }

    #[test]
    fn draws_follow_the_weights() {
        let entry = |id: &str, weight| WeightedType {
            id: id.into(),
            class: "passenger".into(),
            weight,
        };
        let entries = [entry("a", 1.0), entry("b", 3.0)];
        let mut rng = ChaCha8Rng::seed_from_u64(1);
        let b = (0..10_000).filter(|_| draw(&entries, &mut rng).id == "b").count();
        // Binomial: 5 standard deviations are 217.
        assert!((7_283..=7_717).contains(&b), "{b}");
    }

    #[test]
    fn indices_stay_below_and_reach_everything() {
        let mut rng = ChaCha8Rng::seed_from_u64(2);
        let mut seen = [false; 7];
        (0..1_000).for_each(|_| seen[below(7, &mut rng)] = true);
        assert!(seen.iter().all(|&seen| seen));
    }
}
