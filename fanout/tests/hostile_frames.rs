//! Every parser of what comes from other processes and from the network, with frames that hold anything: an answer or a refusal, no panic.
//!
//! `CARAWARE_FUZZ_FRAMES=100000000 cargo test --release --locked --test hostile_frames` looks at more frames than the million of CI, and
//! `CARAWARE_FUZZ_SEED` at others.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

use fanout::{frame, reader};
use ipc_schema::{
    SCHEMA_VERSION,
    control::{self, Command},
    header::MessageHeader,
    services::Channel,
};

const TOPICS: [&str; 17] = [
    "world",
    "observation",
    "prediction",
    "neighbours",
    "pointcloud/cav.1",
    "image/cav.1",
    "radar/cav.1@front",
    "pointcloud",
    "event",
    "collision",
    "vehicles",
    "signals",
    "routes",
    "map",
    "status",
    "learning",
    "no/such",
];

fn variable(name: &str, default: u64) -> u64 {
    std::env::var(name).map_or(default, |text| text.parse().unwrap())
}

/// Frames to look at.
fn frames() -> u64 {
    variable("CARAWARE_FUZZ_FRAMES", 1_000_000)
}

/// Random numbers of one frame, a function of seed, frame and count.
struct FrameNoise {
    key: u64,
    count: u64,
}

impl FrameNoise {
    fn new(frame: u64) -> Self {
        let key = variable("CARAWARE_FUZZ_SEED", 1) << 48 ^ frame;
        Self { key, count: 0 }
    }

    fn next(&mut self) -> u64 {
        self.count += 1;
        let mut bits = (self.key << 8 | self.count).wrapping_mul(0x9e37_79b9_7f4a_7c15);
        bits = (bits ^ bits >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        bits = (bits ^ bits >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        bits ^ bits >> 31
    }

    fn below(&mut self, end: u64) -> usize {
        usize::try_from(self.next() % end).unwrap()
    }

    /// A number that a parser may trip over.
    fn number(&mut self) -> u32 {
        match self.below(6) {
            0 => 0,
            1 => u32::MAX,
            2 => 1 << self.below(32),
            3 | 4 => u32::try_from(self.below(40)).unwrap(),
            _ => u32::try_from(self.next() >> 32).unwrap(),
        }
    }

    /// `text` with some bytes changed, removed, repeated, or cut off.
    fn damaged(&mut self, text: &[u8]) -> Vec<u8> {
        let mut bytes = text.to_vec();
        for _ in 0..=self.below(4) {
            let at = self.below(bytes.len() as u64 + 1).min(bytes.len().saturating_sub(1));
            match self.below(5) {
                0 if !bytes.is_empty() => bytes[at] = self.next().to_le_bytes()[0],
                1 if !bytes.is_empty() => bytes[at] ^= 1 << self.below(8),
                2 => bytes.truncate(at),
                3 => bytes
                    .splice(at..at, text[..text.len().min(self.below(16))].iter().copied())
                    .for_each(drop),
                _ => bytes.insert(at, b"\"{}[],:-9e\\"[self.below(11)]),
            }
        }
        bytes
    }
}

/// A header that lies about its payload in any field.
fn header(noise: &mut FrameNoise) -> MessageHeader {
    let mut header = MessageHeader {
        schema_version: SCHEMA_VERSION,
        run_id: 7,
        tick: noise.next(),
        shape: std::array::from_fn(|_| noise.number()),
        ..MessageHeader::default()
    };
    if noise.below(8) == 0 {
        let bytes = bytemuck::bytes_of_mut(&mut header);
        let at = noise.below(bytes.len() as u64);
        bytes[at] = noise.next().to_le_bytes()[0];
    }
    header
}

#[test]
fn no_message_in_shared_memory_and_no_frame_makes_a_parser_panic() {
    let mut words = vec![0_u64; 512];
    let (mut encoded, mut refused) = (0_u64, 0_u64);
    for number in 0..frames() {
        let mut noise = FrameNoise::new(number);
        let header = header(&mut noise);
        let place = noise.below(words.len() as u64);
        words[place] = noise.next();
        let length = noise.below(4097);
        let payload = &bytemuck::cast_slice::<_, u8>(&words)[..length];
        let channel = Channel::ALL[noise.below(Channel::ALL.len() as u64)];
        match frame::encode(channel, &header, payload) {
            Ok(frame) => {
                assert!(frame.bytes.len() <= frame::MAX_FRAME_BYTES);
                encoded += 1;
            }
            Err(_) => refused += 1,
        }
        // The same as it comes from the network: cut anywhere.
        let whole = [bytemuck::bytes_of(&header), payload].concat();
        let cut = match noise.below(4) {
            0 => noise.below(whole.len() as u64),
            _ => whole.len(),
        };
        let topic = TOPICS[noise.below(TOPICS.len() as u64)];
        match reader::check(topic, &whole[..cut], Some(7)) {
            Ok(_) => encoded += 1,
            Err(_) => refused += 1,
        }
    }
    assert!(
        encoded > frames() / 20 && refused > frames() / 20,
        "{encoded} accepted, {refused} refused"
    );
}

#[test]
fn no_command_makes_the_parser_panic() {
    let (vehicle, edge) = ("cav.3".to_owned(), "A1B1".to_owned());
    let valid = [
        Command::Pause {},
        Command::Step { ticks: 10 },
        Command::Start {
            vehicle: vehicle.clone(),
            edge: edge.clone(),
        },
        Command::Destination { vehicle, edge },
    ];
    let mut commands: Vec<Vec<u8>> = valid
        .iter()
        .map(|command| command.to_json().unwrap().into_bytes())
        .collect();
    assert!(commands.iter().all(|text| Command::from_json(text).is_ok()));
    commands.push(vec![b'['; 300]);
    let mut accepted = 0_u64;
    for number in 0..frames() {
        let mut noise = FrameNoise::new(number);
        let bytes = noise.damaged(&commands[number as usize % commands.len()]);
        accepted += u64::from(Command::from_json(&bytes).is_ok());
        if number % 16 == 0 {
            drop(control::actions(&String::from_utf8_lossy(&bytes)));
        }
    }
    assert!(accepted > 0 && accepted < frames(), "{accepted}");
}
