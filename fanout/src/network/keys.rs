//! Keys of a run in zenoh. Names are percent-encoded, because zenoh refuses `# ? $ *` and empty parts, and `/` separates parts.

use ipc_schema::services::Channel;
use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};

/// Characters that are encoded: all but RFC 3986's unreserved ones.
const ENCODED: &AsciiSet = &NON_ALPHANUMERIC.remove(b'-').remove(b'.').remove(b'_').remove(b'~');

/// What is published under a run's prefix; each mounted sensor has its own key ([`RunKeys::sensor`]).
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
pub enum Topic {
    /// The scene and the tick, as JSON; answers queries only.
    Map,
    /// State of the run, as JSON.
    Status,
    /// The course of training, as JSON; queries are answered with the whole.
    Learning,
    /// Table of road users, as a frame.
    Vehicles,
    /// Traffic lights, as a frame.
    Signals,
    /// Routes of heroes, as a frame.
    Routes,
    /// Poses and motion of road users, as a frame.
    World,
    /// What connected vehicles sense, with the truth, as a frame.
    Observation,
    /// Predictions of the policy and estimates of the filter, as a frame.
    Prediction,
    /// What connected vehicles know from messages, as a frame; published while a viewer subscribes.
    Neighbours,
    /// Contacts that begin in a tick, as a frame.
    Event,
}

impl Topic {
    /// All topics.
    pub const ALL: [Self; 11] = [
        Self::Map,
        Self::Status,
        Self::Learning,
        Self::Vehicles,
        Self::Signals,
        Self::Routes,
        Self::World,
        Self::Observation,
        Self::Prediction,
        Self::Neighbours,
        Self::Event,
    ];

    /// Name of the topic: the last part of its key.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::Map => "map",
            Self::Status => "status",
            Self::Learning => "learning",
            Self::Vehicles => "vehicles",
            Self::Signals => "signals",
            Self::Routes => "routes",
            Self::World => Channel::World.name(),
            Self::Observation => Channel::Observation.name(),
            Self::Prediction => Channel::Prediction.name(),
            Self::Neighbours => Channel::Neighbours.name(),
            Self::Event => Channel::Event.name(),
        }
    }
}

/// `name` as one part of a key; different names give different parts, and the empty name gives `%`.
#[must_use]
pub fn encode(name: &str) -> String {
    if name.is_empty() {
        return "%".to_owned();
    }
    utf8_percent_encode(name, ENCODED).to_string()
}

/// The keys of one environment of a run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunKeys {
    prefix: String,
}

impl RunKeys {
    /// Keys of environment `env_index` of the run called `run_name`.
    #[must_use]
    pub fn new(run_name: &str, env_index: u32) -> Self {
        Self {
            prefix: format!("caraware/{}/{env_index}", encode(run_name)),
        }
    }

    /// Key of a topic.
    #[must_use]
    pub fn topic(&self, topic: Topic) -> String {
        format!("{}/{}", self.prefix, topic.name())
    }

    /// Key of the liveliness token.
    #[must_use]
    pub fn alive(&self) -> String {
        format!("{}/alive", self.prefix)
    }

    /// Key that takes commands. Its prefix differs from that of the topics, so that a right to read is no right to command.
    #[must_use]
    pub fn control(&self) -> String {
        format!("caraware-control{}", &self.prefix["caraware".len()..])
    }

    /// Key of what `channel` carries of one mounted sensor: `name` is its carrier's id, with `@` and the sensor's name if it is of a suite.
    #[must_use]
    pub fn sensor(&self, channel: Channel, name: &str) -> String {
        format!("{}/{}/{}", self.prefix, channel.name(), encode(name))
    }

    /// Key expression over [`RunKeys::sensor`] of every sensor.
    #[must_use]
    pub fn every_sensor(&self, channel: Channel) -> String {
        format!("{}/{}/*", self.prefix, channel.name())
    }

    /// Key expression over all of these.
    #[must_use]
    pub fn all(&self) -> String {
        format!("{}/**", self.prefix)
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use ipc_schema::channel::CHANNELS;
    use percent_encoding::percent_decode_str;
    use proptest::prelude::*;
    use zenoh::key_expr::KeyExpr;

    /// The topics of the channels are those that a run publishes, beside `map`, `status`, `learning` and the mounted sensors.
    #[test]
    fn every_topic_of_a_channel_is_published() {
        let of_channels: BTreeSet<&str> = CHANNELS.iter().flat_map(|channel| channel.topics).copied().collect();
        let names = Topic::ALL.map(Topic::name);
        let published: BTreeSet<&str> = names
            .into_iter()
            .chain([Channel::Pointcloud, Channel::Image, Channel::Radar].map(Channel::name))
            .collect();
        let of_the_run = BTreeSet::from([Topic::Map, Topic::Status, Topic::Learning].map(Topic::name));
        assert_eq!(&published - &of_the_run, of_channels);
    }

    #[test]
    fn plain_names_stay_readable() {
        assert_eq!(
            RunKeys::new("town-2026.01_a~b", 0).topic(Topic::World),
            "caraware/town-2026.01_a~b/0/world"
        );
    }

    #[test]
    fn what_zenoh_refuses_is_encoded() {
        assert_eq!(encode("a/b#c?d$e*@ü"), "a%2Fb%23c%3Fd%24e%2A%40%C3%BC");
        assert_eq!(encode(""), "%");
    }

    proptest! {
        #[test]
        fn any_name_makes_a_key_of_four_parts_and_comes_back(name in any::<String>(), env in any::<u32>()) {
            let keys = RunKeys::new(&name, env);
            for topic in Topic::ALL {
                let key = keys.topic(topic);
                prop_assert!(KeyExpr::new(key.as_str()).is_ok_and(|k| k.as_str() == key && !k.is_wild()), "{}", key);
                prop_assert!(KeyExpr::new(keys.all()).is_ok_and(|all| all.includes(&KeyExpr::new(key.as_str()).unwrap())));
                prop_assert_eq!(key.split('/').count(), 4);
            }
            let scan = keys.sensor(Channel::Pointcloud, &name);
            prop_assert!(KeyExpr::new(keys.every_sensor(Channel::Pointcloud)).is_ok_and(|all| all.includes(&KeyExpr::new(scan.as_str()).unwrap())));
            prop_assert!(KeyExpr::new(scan.as_str()).is_ok_and(|k| k.as_str() == scan && !k.is_wild()), "{}", scan);
            prop_assert!(KeyExpr::new(keys.all()).is_ok_and(|all| all.includes(&KeyExpr::new(scan.as_str()).unwrap())));
            prop_assert_eq!(scan.split('/').count(), 5);
            if !name.is_empty() {
                let part = encode(&name);
                prop_assert_eq!(percent_decode_str(&part).decode_utf8().unwrap(), name);
            }
        }

        #[test]
        fn different_names_never_meet(a in ".{0,6}", b in ".{0,6}") {
            prop_assert_eq!(encode(&a) == encode(&b), a == b);
        }
    }
}
