//! The streets of a net: what the demand needs of it.

use std::collections::BTreeMap;

use quick_xml::{Reader, events::Event};

use crate::scenario::attribute;

/// One direction of a street between two junctions.
#[derive(Debug, Clone, PartialEq)]
pub struct GridStreet {
    /// SUMO's id of the edge.
    pub id: String,
    /// Number of the junction where it begins.
    from: usize,
    /// Number of the junction where it ends.
    to: usize,
    /// Length of each lane, metres.
    pub lanes_m: Vec<f64>,
}

/// All streets, in the order of the net.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct GridStreets {
    /// The streets.
    pub all: Vec<GridStreet>,
    /// Streets that begin at each junction.
    beginning: Vec<Vec<usize>>,
}

impl GridStreets {
    /// Reads the edges of a net, without the internal edges of junctions.
    ///
    /// # Errors
    /// The reason why the net cannot be read.
    pub fn of(net: &str) -> Result<Self, String> {
        let mut streets = Self::default();
        let mut junctions = BTreeMap::new();
        let mut reader = Reader::from_str(net);
        let mut is_street = false;
        loop {
            match reader.read_event().map_err(|error| error.to_string())? {
                Event::Start(element) | Event::Empty(element) => match element.local_name().as_ref() {
                    "edge" => {
                        let names = ["id", "from", "to"].map(|name| attribute(&element, name));
                        is_street = names.iter().all(Option::is_some);
                        if let [Some(id), Some(from), Some(to)] = names {
                            let [from, to] = [from, to].map(|name| {
                                let next = junctions.len();
                                *junctions.entry(name).or_insert(next)
                            });
                            streets.add(id, from, to);
                        }
                    }
                    "lane" if is_street => {
                        let length_m = attribute(&element, "length").and_then(|text| text.parse().ok());
                        let length_m = length_m.ok_or("a lane without length")?;
                        if let Some(street) = streets.all.last_mut() {
                            street.lanes_m.push(length_m);
                        }
                    }
                    _ => {}
                },
                Event::Eof => break,
                _ => {}
            }
        }
        streets.beginning.resize(junctions.len(), Vec::new());
        Ok(streets)
    }

    fn add(&mut self, id: String, from: usize, to: usize) {
        if self.beginning.len() <= from {
            self.beginning.resize(from + 1, Vec::new());
        }
        self.beginning[from].push(self.all.len());
        self.all.push(GridStreet {
            id,
            from,
            to,
            lanes_m: Vec::new(),
        });
    }

    /// The streets that a vehicle may take after `street` without turning round.
    pub fn onward(&self, street: usize) -> impl Iterator<Item = usize> + Clone {
        let here = &self.all[street];
        let next = self.beginning[here.to].iter().copied();
        next.filter(|&next| self.all[next].to != here.from)
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    #[test]
    fn a_route_continues_on_every_street_but_the_way_back() {
        let net = r#"<net><edge id=":B_0" function="internal"><lane id=":B_0_0" length="9"/></edge>
            <edge id="ab" from="a" to="b"><lane id="ab_0" length="100.5"/><lane id="ab_1" length="100.5"/></edge>
            <edge id="ba" from="b" to="a"><lane id="ba_0" length="100"/></edge>
            <edge id="bc" from="b" to="c"><lane id="bc_0" length="50"/></edge></net>"#;
        let streets = GridStreets::of(net).unwrap();
        let ids: Vec<_> = streets.all.iter().map(|street| street.id.as_str()).collect();
        assert_eq!(ids, ["ab", "ba", "bc"]);
        assert_eq!(streets.all[0].lanes_m, [100.5, 100.5]);
        assert_eq!(streets.onward(0).collect::<Vec<_>>(), [2]);
        assert_eq!(streets.onward(2).count(), 0);
    }
}
