//! The part of a map that `--bbox` cuts out: nodes inside, ways with a node inside, all nodes of these ways, and the relations that have
//! any of these as members.

use std::str::FromStr;

use super::{
    PbfError, UnpackLimits,
    elements::{MemberKind, OsmElement, OsmPlace},
};

/// A part of the globe between two longitudes and two latitudes; its border belongs to it.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BoundingBox {
    /// 10⁻⁷ degrees, as all others.
    west: i32,
    south: i32,
    east: i32,
    north: i32,
}

impl FromStr for BoundingBox {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let degrees: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
        let Ok([west, south, east, north]) = <[f64; 4]>::try_from(degrees.unwrap_or_default()) else {
            return Err("give west,south,east,north in degrees, such as 13.68,51.99,13.69,52.01".to_owned());
        };
        let units = |degrees: f64, most: f64| match (-most..=most).contains(&degrees) {
            #[expect(clippy::cast_possible_truncation, reason = "180 × 10⁷ fits")]
            true => Ok((degrees * 1e7).round() as i32),
            false => Err(format!(
                "{degrees} is not in [-{most}, {most}] degrees; the order is west,south,east,north"
            )),
        };
        let area = Self {
            west: units(west, 180.0)?,
            south: units(south, 90.0)?,
            east: units(east, 180.0)?,
            north: units(north, 90.0)?,
        };
        match area.west < area.east && area.south < area.north {
            true => Ok(area),
            false => Err("west must be less than east, and south less than north".to_owned()),
        }
    }
}

impl BoundingBox {
    fn contains(&self, place: OsmPlace) -> bool {
        (self.west..=self.east).contains(&place.longitude) && (self.south..=self.north).contains(&place.latitude)
    }
}

/// The ids of what is cut out, sorted.
#[derive(Debug, Default)]
pub(super) struct Selection {
    /// Nodes inside.
    inside: Vec<i64>,
    /// Ways with a node inside.
    ways: Vec<i64>,
    /// Nodes of these ways.
    of_ways: Vec<i64>,
}

impl Selection {
    /// Whether an element is cut out.
    pub(super) fn has(&self, element: &OsmElement<'_>) -> bool {
        match element {
            OsmElement::Node { id, .. } => has(&self.inside, *id) || has(&self.of_ways, *id),
            OsmElement::Way { id, .. } => has(&self.ways, *id),
            OsmElement::Relation { members, .. } => members.iter().any(|member| match member.kind {
                MemberKind::Node => has(&self.inside, member.id),
                MemberKind::Way => has(&self.ways, member.id),
                MemberKind::Relation => false,
            }),
        }
    }
}

/// Makes a [`Selection`]. Most files have all nodes before the ways and need one pass, others two.
pub(super) struct AreaScan<'a> {
    area: &'a BoundingBox,
    limits: &'a UnpackLimits,
    selection: Selection,
    pass: ScanPass,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum ScanPass {
    /// No way has been met.
    Nodes,
    /// A way has been met, and no node since.
    WaysAfterNodes,
    /// A node has been met after a way: the ways must be looked at again.
    Mixed,
    /// The second pass.
    WaysAgain,
}

impl<'a> AreaScan<'a> {
    pub(super) fn new(area: &'a BoundingBox, limits: &'a UnpackLimits) -> Self {
        Self {
            area,
            limits,
            selection: Selection::default(),
            pass: ScanPass::Nodes,
        }
    }

    /// Looks at the next element of a pass.
    ///
    /// # Errors
    /// More is inside than the limits allow.
    pub(super) fn visit(&mut self, element: &OsmElement<'_>) -> Result<(), PbfError> {
        match element {
            OsmElement::Node { id, place, .. } if self.pass != ScanPass::WaysAgain && self.area.contains(*place) => {
                self.selection.inside.push(*id);
                if self.pass == ScanPass::WaysAfterNodes {
                    self.pass = ScanPass::Mixed;
                }
                self.require_few(self.selection.inside.len())
            }
            OsmElement::Way { id, nodes, .. } if self.pass != ScanPass::Mixed => {
                if self.pass == ScanPass::Nodes {
                    self.pass = ScanPass::WaysAfterNodes;
                    self.selection.inside.sort_unstable();
                }
                if nodes.iter().any(|node| has(&self.selection.inside, *node)) {
                    self.selection.ways.push(*id);
                    self.selection.of_ways.extend(*nodes);
                }
                // Where ways meet they share a node, so a net has about 1.2 times as many references as nodes.
                self.require_few(self.selection.of_ways.len() / 2)
            }
            _ => Ok(()),
        }
    }

    fn require_few(&self, nodes: usize) -> Result<(), PbfError> {
        match nodes > self.limits.nodes {
            true => Err(PbfError::TooManyNodes {
                most: self.limits.nodes,
            }),
            false => Ok(()),
        }
    }

    /// Ends a pass. Returns whether a second one is needed.
    pub(super) fn end_pass(&mut self) -> bool {
        self.selection.inside.sort_unstable();
        let again = self.pass == ScanPass::Mixed;
        if again {
            self.selection.ways.clear();
            self.selection.of_ways.clear();
            self.pass = ScanPass::WaysAgain;
        }
        again
    }

    /// What is cut out.
    pub(super) fn finish(mut self) -> Selection {
        self.selection.ways.sort_unstable();
        self.selection.of_ways.sort_unstable();
        self.selection.of_ways.dedup();
        self.selection
    }
}

fn has(ids: &[i64], id: i64) -> bool {
    let range = ids.first().zip(ids.last());
    range.is_some_and(|(first, last)| (*first..=*last).contains(&id)) && ids.binary_search(&id).is_ok()
}
