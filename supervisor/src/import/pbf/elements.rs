//! Nodes, ways and relations of a block.

use super::message::{DenseNodes, PackedRelation, PackedWay, PrimitiveBlock, PrimitiveGroup};

/// Nanodegrees in the seventh decimal of a degree, OpenStreetMap's own unit.
const NANO_PER_UNIT: i64 = 100;
const UNITS_PER_DEGREE: i64 = 10_000_000;

/// A part of a map.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum OsmElement<'a> {
    /// A point.
    Node {
        id: i64,
        place: OsmPlace,
        version: Option<i32>,
        tags: &'a [(&'a str, &'a str)],
    },
    /// A line or an area, by the ids of its nodes.
    Way {
        id: i64,
        nodes: &'a [i64],
        version: Option<i32>,
        tags: &'a [(&'a str, &'a str)],
    },
    /// Elements that belong together.
    Relation {
        id: i64,
        members: &'a [OsmMember<'a>],
        version: Option<i32>,
        tags: &'a [(&'a str, &'a str)],
    },
}

/// Latitude and longitude, 10⁻⁷ degrees.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct OsmPlace {
    pub(super) latitude: i32,
    pub(super) longitude: i32,
}

/// A member of a relation.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct OsmMember<'a> {
    pub(super) kind: MemberKind,
    pub(super) id: i64,
    pub(super) role: &'a str,
}

/// What a member is.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum MemberKind {
    Node,
    Way,
    Relation,
}

/// What is wrong with the elements of a block, or the visitor's own error.
#[derive(Debug)]
pub(super) enum ElementFault<E> {
    Damaged(&'static str),
    Visitor(E),
}

impl<E> From<&'static str> for ElementFault<E> {
    fn from(what: &'static str) -> Self {
        Self::Damaged(what)
    }
}

/// Calls `visit` for each element of a block that exists, in the order of the block.
///
/// # Errors
/// A part of the block contradicts another, or `visit` fails.
pub(super) fn visit_elements<E>(
    block: &PrimitiveBlock,
    visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), E>,
) -> Result<(), ElementFault<E>> {
    let texts = block.strings.iter().flat_map(|table| &table.texts);
    let texts: Result<Vec<&str>, _> = texts.map(|text| std::str::from_utf8(text)).collect();
    let reader = ElementReader {
        block,
        texts: texts.map_err(|_| "a text is not UTF-8")?,
    };
    for group in &block.groups {
        reader.plain_nodes(group, visit)?;
        if let Some(dense) = &group.dense {
            reader.dense_nodes(dense, visit)?;
        }
        for way in &group.ways {
            reader.way(way, visit)?;
        }
        for relation in &group.relations {
            reader.relation(relation, visit)?;
        }
    }
    Ok(())
}

struct ElementReader<'a> {
    block: &'a PrimitiveBlock,
    texts: Vec<&'a str>,
}

impl<'a> ElementReader<'a> {
    fn plain_nodes<E>(
        &self,
        group: &PrimitiveGroup,
        visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), E>,
    ) -> Result<(), ElementFault<E>> {
        for node in &group.nodes {
            if node.info.as_ref().is_some_and(|info| info.visible == Some(false)) {
                continue;
            }
            let (Some(id), Some(latitude), Some(longitude)) = (node.id, node.latitude, node.longitude) else {
                return Err("a node has no id or no place".into());
            };
            let element = OsmElement::Node {
                id,
                place: self.place(latitude, longitude)?,
                version: version(node.info.as_ref().and_then(|info| info.version)),
                tags: &self.tags(&node.keys, &node.values)?,
            };
            visit(element).map_err(ElementFault::Visitor)?;
        }
        Ok(())
    }

    fn dense_nodes<E>(
        &self,
        dense: &DenseNodes,
        visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), E>,
    ) -> Result<(), ElementFault<E>> {
        let count = dense.ids.len();
        if dense.latitudes.len() != count || dense.longitudes.len() != count {
            return Err("nodes have not as many places as ids".into());
        }
        let (versions, visible): (&[i32], &[bool]) = match &dense.info {
            Some(info) => (&info.versions, &info.visible),
            None => (&[], &[]),
        };
        let is_missing = |length: usize| length != 0 && length != count;
        if is_missing(versions.len()) || is_missing(visible.len()) {
            return Err("nodes have not as many versions as ids".into());
        }
        let mut indices = dense.keys_values.iter();
        let mut tags = Vec::new();
        let (mut id, mut latitude, mut longitude) = (0, 0, 0);
        for (number, step) in dense.ids.iter().enumerate() {
            id = sum(id, *step)?;
            latitude = sum(latitude, dense.latitudes[number])?;
            longitude = sum(longitude, dense.longitudes[number])?;
            tags.clear();
            while !dense.keys_values.is_empty() {
                match indices.next() {
                    None => return Err("the tags of nodes have no end".into()),
                    Some(0) => break,
                    Some(key) => {
                        let value = indices.next().ok_or("a key has no value")?;
                        tags.push((self.text(*key)?, self.text(*value)?));
                    }
                }
            }
            if visible.get(number) == Some(&false) {
                continue;
            }
            let element = OsmElement::Node {
                id,
                place: self.place(latitude, longitude)?,
                version: version(versions.get(number).copied()),
                tags: &tags,
            };
            visit(element).map_err(ElementFault::Visitor)?;
        }
        match indices.next() {
            Some(_) => Err("there are more tags than nodes".into()),
            None => Ok(()),
        }
    }

    fn way<E>(
        &self,
        way: &PackedWay,
        visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), E>,
    ) -> Result<(), ElementFault<E>> {
        if way.info.as_ref().is_some_and(|info| info.visible == Some(false)) {
            return Ok(());
        }
        let element = OsmElement::Way {
            id: way.id.ok_or("a way has no id")?,
            nodes: &sums(&way.nodes)?,
            version: version(way.info.as_ref().and_then(|info| info.version)),
            tags: &self.tags(&way.keys, &way.values)?,
        };
        visit(element).map_err(ElementFault::Visitor)
    }

    fn relation<E>(
        &self,
        relation: &PackedRelation,
        visit: &mut impl FnMut(OsmElement<'_>) -> Result<(), E>,
    ) -> Result<(), ElementFault<E>> {
        if relation.info.as_ref().is_some_and(|info| info.visible == Some(false)) {
            return Ok(());
        }
        let count = relation.members.len();
        if relation.roles.len() != count || relation.kinds.len() != count {
            return Err("a relation has not as many roles as members".into());
        }
        let ids = sums(&relation.members)?;
        let members = ids.iter().zip(&relation.roles).zip(&relation.kinds);
        let members = members.map(|((id, role), kind)| {
            Ok(OsmMember {
                kind: MemberKind::of(*kind)?,
                id: *id,
                role: self.text(*role)?,
            })
        });
        let members: Result<Vec<OsmMember<'_>>, &'static str> = members.collect();
        let element = OsmElement::Relation {
            id: relation.id.ok_or("a relation has no id")?,
            members: &members?,
            version: version(relation.info.as_ref().and_then(|info| info.version)),
            tags: &self.tags(&relation.keys, &relation.values)?,
        };
        visit(element).map_err(ElementFault::Visitor)
    }

    fn tags(&self, keys: &[u32], values: &[u32]) -> Result<Vec<(&'a str, &'a str)>, &'static str> {
        if keys.len() != values.len() {
            return Err("an element has not as many values as keys");
        }
        let tags = keys.iter().zip(values);
        tags.map(|(key, value)| Ok((self.text(*key)?, self.text(*value)?)))
            .collect()
    }

    /// A text by its index.
    fn text(&self, index: impl TryInto<usize>) -> Result<&'a str, &'static str> {
        let index = index.try_into().ok();
        let text = index.and_then(|index| self.texts.get(index));
        text.copied().ok_or("a text is missing")
    }

    /// A place from the numbers of a node, which are in the block's own unit.
    fn place(&self, latitude: i64, longitude: i64) -> Result<OsmPlace, &'static str> {
        let granularity = i64::from(self.block.granularity());
        let units = |value: i64, offset: Option<i64>, most_degrees: i64| {
            let nano = value.checked_mul(granularity)?.checked_add(offset.unwrap_or(0))?;
            // Rounded to the nearest, halves away from 0.
            let half = NANO_PER_UNIT / 2 * nano.signum();
            let units = nano.checked_add(half)? / NANO_PER_UNIT;
            let most = most_degrees * UNITS_PER_DEGREE;
            (-most..=most).contains(&units).then(|| i32::try_from(units).ok())?
        };
        let latitude = units(latitude, self.block.latitude_offset, 90);
        let longitude = units(longitude, self.block.longitude_offset, 180);
        match (latitude, longitude) {
            (Some(latitude), Some(longitude)) => Ok(OsmPlace { latitude, longitude }),
            _ => Err("a node is not on the globe"),
        }
    }
}

impl MemberKind {
    fn of(number: i32) -> Result<Self, &'static str> {
        match number {
            0 => Ok(Self::Node),
            1 => Ok(Self::Way),
            2 => Ok(Self::Relation),
            _ => Err("a member has no kind"),
        }
    }

    /// Its name in XML.
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Node => "node",
            Self::Way => "way",
            Self::Relation => "relation",
        }
    }
}

/// −1 stands for an unknown version.
fn version(version: Option<i32>) -> Option<i32> {
    version.filter(|version| *version >= 0)
}

fn sum(before: i64, step: i64) -> Result<i64, &'static str> {
    before.checked_add(step).ok_or("an id or a place is out of range")
}

/// Values from their differences.
fn sums(steps: &[i64]) -> Result<Vec<i64>, &'static str> {
    let mut value = 0;
    steps
        .iter()
        .map(|step| {
            value = sum(value, *step)?;
            Ok(value)
        })
        .collect()
}
