//! Cost of adding a tick of the town to the journal: 12 kB a message, with a commit at the interval of the default preset.
//! `cargo bench -p sensor-daemon --bench journal`

#![expect(clippy::unwrap_used, reason = "a benchmark that cannot run panics with the reason")]

use std::time::Instant;

use ipc_schema::header::MessageHeader;
use sensor_daemon::delivery::journal::Journal;

const TICKS: u32 = 100_000;
const MESSAGE_BYTES: usize = 12_000;
/// Ticks between two checkpoints of the default preset.
const COMMIT_TICKS: u32 = 2560;

fn main() {
    let directory = tempfile::tempdir().unwrap();
    let mut journal = Journal::new(directory.path(), 1 << 30, MESSAGE_BYTES);
    let message = vec![7_u8; MESSAGE_BYTES];
    let begin = Instant::now();
    for tick in 0..TICKS {
        let header = MessageHeader {
            tick: u64::from(tick),
            ..MessageHeader::default()
        };
        journal.push(header, &message).unwrap();
        if tick % COMMIT_TICKS == 0 {
            journal.commit(u64::from(tick));
        }
    }
    println!(
        "journal: {:.2} µs a tick of {MESSAGE_BYTES} bytes ({TICKS} ticks)",
        begin.elapsed().as_secs_f64() * 1e6 / f64::from(TICKS)
    );
}
