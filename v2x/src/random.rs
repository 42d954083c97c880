//! Counter-based random numbers of links: a value depends on sender, receiver, message and purpose, never on when it is drawn.

use sensor_daemon::noise::{normals, philox4x32};

/// Purpose of a draw. Its number goes into the counter beside those of the sensors' noise streams, so it begins above them, and a new
/// purpose takes a number that was never used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum RadioDraw {
    /// Whether a road user has a radio.
    Equipped = 128,
    /// Offset of a station's checks within a tick.
    Phase = 129,
    /// Slots that a station waits after a busy channel.
    Backoff = 130,
    /// Loss of a link behind a vehicle.
    Blocking = 133,
    /// Waves of the field of shadowing.
    Shadowing = 134,
    /// Error of a perceived object.
    Perception = 135,
    /// Reception of a message: three numbers for its fast fading, and one for whether it is decoded. 131 and 132 were these two.
    Reception = 136,
}

/// Random numbers of an episode.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct RadioRandom {
    key: [u32; 2],
}

/// What a number is for: station ids of sender and receiver (0 for none), and the number of the message.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct LinkKey {
    /// Sending station.
    pub sender: u32,
    /// Receiving station.
    pub receiver: u32,
    /// Number of the message.
    pub message: u32,
}

impl RadioRandom {
    /// Numbers of the episode with this seed.
    #[must_use]
    pub fn new(episode_seed: u64) -> Self {
        Self {
            key: [episode_seed as u32, (episode_seed >> 32) as u32],
        }
    }

    /// Key of all numbers of the episode.
    pub(crate) fn key(&self) -> [u32; 2] {
        self.key
    }

    /// The block of four words that has a number; 24 bits of `part` count.
    #[inline(always)]
    pub(crate) fn counter(link: LinkKey, purpose: RadioDraw, part: u32) -> [u32; 4] {
        [link.message, purpose as u32 | (part << 8), link.sender, link.receiver]
    }

    /// Four words; 24 bits of `part` count.
    #[must_use]
    #[inline]
    pub fn words(&self, link: LinkKey, purpose: RadioDraw, part: u32) -> [u32; 4] {
        philox4x32(Self::counter(link, purpose, part), self.key)
    }

    /// Four independent standard normal numbers.
    #[must_use]
    #[inline]
    pub fn normals(&self, link: LinkKey, purpose: RadioDraw, part: u32) -> [f32; 4] {
        normals::block(Self::counter(link, purpose, part), self.key)
    }

    /// Four numbers uniform in (0, 1).
    #[must_use]
    #[inline]
    pub fn uniforms(&self, link: LinkKey, purpose: RadioDraw, part: u32) -> [f64; 4] {
        self.words(link, purpose, part)
            .map(|word| (f64::from(word) + 0.5) / 4_294_967_296.0)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_part_of_the_key_counts() {
        let link = LinkKey {
            sender: 1,
            receiver: 2,
            message: 3,
        };
        let reference = RadioRandom::new(7).words(link, RadioDraw::Reception, 0);
        let others = [
            RadioRandom::new(8).words(link, RadioDraw::Reception, 0),
            RadioRandom::new(7 << 32).words(link, RadioDraw::Reception, 0),
            RadioRandom::new(7).words(
                LinkKey {
                    sender: 2,
                    receiver: 1,
                    ..link
                },
                RadioDraw::Reception,
                0,
            ),
            RadioRandom::new(7).words(LinkKey { message: 4, ..link }, RadioDraw::Reception, 0),
            RadioRandom::new(7).words(link, RadioDraw::Backoff, 0),
            RadioRandom::new(7).words(link, RadioDraw::Reception, 1),
        ];
        assert!(others.iter().all(|other| *other != reference));
        assert_eq!(RadioRandom::new(7).words(link, RadioDraw::Reception, 0), reference);
    }

    #[test]
    fn no_purpose_has_the_number_of_a_sensors_noise_stream() {
        let streams = ipc_schema::sensor::SENSORS
            .iter()
            .flat_map(|spec| spec.noise.iter().chain([&spec.blackout_noise]));
        assert!(
            streams
                .map(|stream| *stream as u32)
                .all(|number| number < RadioDraw::Equipped as u32)
        );
    }
}
