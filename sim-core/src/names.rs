//! SUMO's names of the road users of an episode, for lines that people read.

use ipc_schema::{
    header::MessageHeader,
    traffic::{MetaEvent, VehicleMeta},
};

/// Id and class of each road user, by its dense index.
#[derive(Debug, Default)]
pub struct RoadUserNames {
    episode: Option<u64>,
    names: Vec<RoadUserName>,
}

#[derive(Debug, Clone, Default)]
struct RoadUserName {
    id: Box<str>,
    class: Box<str>,
}

impl RoadUserNames {
    /// Remembers the road users that depart; a new episode forgets those of the one before.
    pub fn remember(&mut self, header: &MessageHeader, metas: &[VehicleMeta]) {
        if self.episode != Some(header.episode) {
            self.episode = Some(header.episode);
            self.names.clear();
        }
        for meta in metas.iter().filter(|meta| meta.event == MetaEvent::Departed as u32) {
            let index = meta.vehicle as usize;
            if self.names.len() <= index {
                self.names.resize(index + 1, RoadUserName::default());
            }
            self.names[index] = RoadUserName {
                id: meta.id_text().into_boxed_str(),
                class: meta.class_text().into_boxed_str(),
            };
        }
    }

    /// SUMO's id; empty if the road user is not known.
    #[must_use]
    pub fn id(&self, index: u32) -> &str {
        self.names.get(index as usize).map_or("", |name| &name.id)
    }

    /// SUMO's vehicle class; empty if the road user is not known.
    #[must_use]
    pub fn class(&self, index: u32) -> &str {
        self.names.get(index as usize).map_or("", |name| &name.class)
    }
}
