//! Messages on air as a file that protocol analysers open: one of libpcap's for each episode, with frames of Ethernet around the packets.

use std::{
    fs::File,
    io::{Result, Seek as _, SeekFrom, Write as _},
    path::{Path, PathBuf},
};

use ipc_schema::storage;

use crate::{
    exchange::AirPacket,
    message::{EPISODE_START_UNIX_S, wsmp},
};

/// Times are in nanoseconds (libpcap's file format, draft-ietf-opsawg-pcap).
const MAGIC: u32 = 0xA1B2_3C4D;
/// Version 2.4, no correction of time, frames of at most 65 535 bytes.
const VERSION: [u16; 2] = [2, 4];
const MOST_BYTES: u32 = 65_535;
/// `LINKTYPE_ETHERNET`.
const ETHERNET: u32 = 1;
/// Types of frames: GeoNetworking (EN 302 636-6-1), and WAVE short messages (IEEE 1609.3).
const GEONETWORKING: u16 = 0x8947;
const WSMP: u16 = 0x88DC;
/// Bytes that are kept in memory before they are written.
const BUFFER_BYTES: usize = 64 << 10;

/// The beginning of a file.
#[must_use]
pub fn file_head() -> Vec<u8> {
    let mut head = Vec::with_capacity(24);
    head.extend(MAGIC.to_le_bytes());
    VERSION.iter().for_each(|number| head.extend(number.to_le_bytes()));
    head.extend([0; 8]);
    head.extend(MOST_BYTES.to_le_bytes());
    head.extend(ETHERNET.to_le_bytes());
    head
}

/// Adds a packet that was sent `sim_time_ns` after the start of the episode, as a frame to all from the station's address.
pub fn push_frame(out: &mut Vec<u8>, sim_time_ns: u64, sent: &AirPacket) {
    let kind = match wsmp::decode(&sent.packet) {
        Ok(_) => WSMP,
        Err(_) => GEONETWORKING,
    };
    let length = (14 + sent.packet.len()) as u32;
    let seconds = EPISODE_START_UNIX_S + sim_time_ns / 1_000_000_000;
    for number in [seconds as u32, (sim_time_ns % 1_000_000_000) as u32, length, length] {
        out.extend(number.to_le_bytes());
    }
    out.extend([0xFF; 6]);
    // The address that the packet's own header has.
    out.extend([0x02, 0]);
    out.extend(sent.station.to_be_bytes());
    out.extend(kind.to_be_bytes());
    out.extend(&sent.packet);
}

/// The open file of an episode. A process that is replaced begins with the first tick of an episode, and writes its file again.
#[derive(Debug)]
pub struct CaptureFile {
    path: PathBuf,
    file: File,
    written_bytes: u64,
    buffer: Vec<u8>,
}

impl CaptureFile {
    /// The file of an episode in a run's directory.
    ///
    /// # Errors
    /// It cannot be created.
    pub fn create(run_dir: &Path, episode: u64) -> Result<Self> {
        let directory = run_dir.join("messages");
        let path = directory.join(format!("episode-{episode}.pcap"));
        let file = storage::when_there_is_space(&path, || {
            std::fs::create_dir_all(&directory)?;
            File::create(&path)
        })?;
        Ok(Self {
            path,
            file,
            written_bytes: 0,
            buffer: file_head(),
        })
    }

    /// Where it is.
    #[must_use]
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// Adds the packets of a tick. While the disk is full, it waits.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn push(&mut self, tick_ns: u64, packets: &[AirPacket]) -> Result<()> {
        for sent in packets {
            push_frame(&mut self.buffer, tick_ns + sent.start_ns, sent);
        }
        match self.buffer.len() > BUFFER_BYTES {
            true => self.flush(),
            false => Ok(()),
        }
    }

    /// Writes what is in memory.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn flush(&mut self) -> Result<()> {
        let Self {
            path,
            file,
            written_bytes,
            buffer,
        } = self;
        storage::when_there_is_space(path, || {
            let written = file.write_all(buffer);
            if written.is_err() {
                file.set_len(*written_bytes)?;
                file.seek(SeekFrom::Start(*written_bytes))?;
            }
            written
        })?;
        *written_bytes += buffer.len() as u64;
        buffer.clear();
        Ok(())
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used, reason = "tests assert by unwrapping")]
mod tests {
    use super::*;

    /// Written by hand from the format's description.
    #[test]
    fn a_file_is_a_head_and_frames_with_their_times() {
        let sent = |packet: &[u8]| AirPacket {
            start_ns: 0,
            station: 0x0102_0304,
            packet: packet.into(),
        };
        let mut out = file_head();
        push_frame(&mut out, 1_500_000_007, &sent(&[0x11, 0xAA]));
        push_frame(&mut out, 0, &sent(&wsmp::encode(&[0xBB])));
        let expected: [&[u8]; 7] = [
            &[
                0x4D, 0x3C, 0xB2, 0xA1, 2, 0, 4, 0, 0, 0, 0, 0, 0, 0, 0, 0, 0xFF, 0xFF, 0, 0, 1, 0, 0, 0,
            ],
            // 2024-01-01 00:00:01 UTC, 500 000 007 ns; 16 bytes twice.
            &[0x81, 0x00, 0x92, 0x65, 0x07, 0x65, 0xCD, 0x1D, 16, 0, 0, 0, 16, 0, 0, 0],
            &[
                0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x02, 0x00, 0x01, 0x02, 0x03, 0x04, 0x89, 0x47,
            ],
            &[0x11, 0xAA],
            &[0x80, 0x00, 0x92, 0x65, 0, 0, 0, 0, 19, 0, 0, 0, 19, 0, 0, 0],
            &[
                0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0xFF, 0x02, 0x00, 0x01, 0x02, 0x03, 0x04, 0x88, 0xDC,
            ],
            &[0x03, 0x00, 0x20, 0x01, 0xBB],
        ];
        assert_eq!(out, expected.concat());
    }

    #[test]
    fn an_episode_that_is_made_again_has_its_file_written_again() {
        let directory = tempfile::tempdir().unwrap();
        let sent = AirPacket {
            start_ns: 5,
            station: 1,
            packet: vec![0x11; 100],
        };
        let write = |ticks: u64| {
            let mut file = CaptureFile::create(directory.path(), 3).unwrap();
            for tick in 0..ticks {
                file.push(tick, std::slice::from_ref(&sent)).unwrap();
            }
            file.flush().unwrap();
            std::fs::read(file.path()).unwrap()
        };
        let whole = write(1000);
        assert_eq!(whole.len(), 24 + 1000 * (16 + 14 + 100));
        assert_eq!(write(2), whole[..24 + 2 * 130]);
    }
}
