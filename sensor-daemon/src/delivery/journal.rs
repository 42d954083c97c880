//! The journal holds every observation since the trainer's commit before the last, so that a successor misses none.
//!
//! Messages are stored one after the other in chunks. The first chunks are memory, further ones are parts of an unlinked file. A chunk
//! is reused once all its ticks are committed. When the journal reaches its size limit, it drops the oldest chunk.

use std::{
    collections::VecDeque,
    fs::{File, OpenOptions},
    os::unix::fs::FileExt as _,
    path::{Path, PathBuf},
};

use ipc_schema::{header::MessageHeader, storage};
use memmap2::MmapMut;

/// Longest chunk, bytes, unless one message is longer: short enough to free often, long enough to allocate seldom.
const CHUNK_BYTES: usize = 4 << 20;
/// Least number of chunks within the size limit: dropping one frees at most an eighth.
const CHUNKS: usize = 8;
/// Bytes held in memory before the file is used.
const MEMORY_BYTES: usize = 64 << 20;
/// Most free chunks that stay in memory. What a slow learner or a handover needed beyond goes back to the system.
const FREE_IN_MEMORY: usize = 2;

/// The journal cannot store or deliver a tick.
#[derive(Debug, thiserror::Error)]
pub enum JournalError {
    /// The file cannot be created, written or read.
    #[error("cannot {action} the journal of observations in {directory}")]
    Io {
        /// "create", "write", "read", "get memory for".
        action: &'static str,
        /// Where it is.
        directory: PathBuf,
        /// Why.
        #[source]
        source: std::io::Error,
    },
    /// A successor asks for a tick that was dropped at the size limit.
    #[error(
        "the trainer continues at tick {wanted}, the journal begins at tick {first}: raise `run.journal_mib` (now {limit_mib}), or commit more often (`trainer.checkpoint_interval`)"
    )]
    Gone {
        /// The tick asked for.
        wanted: u64,
        /// The oldest tick held.
        first: u64,
        /// The size limit, MiB.
        limit_mib: usize,
    },
    /// A successor asks for a tick that has not been made.
    #[error(
        "the trainer continues at tick {wanted}, but only {ticks} ticks have been made: its checkpoint belongs to another run"
    )]
    Future {
        /// The tick asked for.
        wanted: u64,
        /// Ticks so far.
        ticks: u64,
    },
}

/// Where a chunk's bytes lie.
#[derive(Debug)]
enum ChunkStorage {
    /// Pages of its own: glibc keeps freed blocks of this size in its heap, once it has seen one.
    Memory(MmapMut),
    /// Number of the chunk in the file.
    File(u64),
}

impl ChunkStorage {
    fn is_memory(&self) -> bool {
        matches!(self, Self::Memory(_))
    }
}

/// One message in a chunk.
#[derive(Debug, Clone, Copy)]
struct JournalEntry {
    header: MessageHeader,
    offset: usize,
    len: usize,
}

#[derive(Debug)]
struct JournalChunk {
    first_tick: u64,
    place: ChunkStorage,
    used: usize,
    entries: Vec<JournalEntry>,
}

impl JournalChunk {
    /// One more than its newest tick.
    fn end(&self) -> u64 {
        self.first_tick + self.entries.len() as u64
    }
}

/// Observations by tick, without gaps.
#[derive(Debug)]
pub struct Journal {
    directory: PathBuf,
    limit_bytes: usize,
    chunk_bytes: usize,
    chunks: VecDeque<JournalChunk>,
    /// Chunks in memory and in the file that are free for reuse.
    free: Vec<ChunkStorage>,
    memory_chunks: usize,
    file_chunks: u64,
    file: Option<File>,
    /// Ticks that a successor may continue from: the newest commit, and the one before it.
    commits: [u64; 2],
    /// One more than the newest tick.
    ticks: u64,
    most_bytes: usize,
    warned: bool,
}

impl Journal {
    /// An empty journal of at most `limit_bytes` (but at least two messages of the longest kind), with its file in `directory`.
    #[must_use]
    pub fn new(directory: &Path, limit_bytes: usize, longest_message: usize) -> Self {
        Self {
            directory: directory.into(),
            limit_bytes,
            chunk_bytes: (limit_bytes / CHUNKS).min(CHUNK_BYTES).max(longest_message),
            chunks: VecDeque::new(),
            free: Vec::new(),
            memory_chunks: 0,
            file_chunks: 0,
            file: None,
            commits: [0; 2],
            ticks: 0,
            most_bytes: 0,
            warned: false,
        }
    }

    /// The same journal beginning at `tick`: all ticks below are committed already.
    #[must_use]
    pub fn beginning_at(self, tick: u64) -> Self {
        Self {
            commits: [tick; 2],
            ticks: tick,
            ..self
        }
    }

    /// The oldest tick held; with nothing held, the next one.
    #[must_use]
    pub fn first(&self) -> u64 {
        self.chunks.front().map_or(self.ticks, |chunk| chunk.first_tick)
    }

    /// One more than the newest tick.
    #[must_use]
    pub fn ticks(&self) -> u64 {
        self.ticks
    }

    /// Largest number of bytes held so far.
    #[must_use]
    pub fn most_bytes(&self) -> usize {
        self.most_bytes
    }

    /// Bytes of observations held.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.chunks.iter().map(|chunk| chunk.used).sum()
    }

    /// True if a tick of `len` bytes can be added without dropping an older one.
    #[must_use]
    pub fn has_room(&self, len: usize) -> bool {
        let fits = |chunk: &JournalChunk| chunk.used + len <= self.chunk_bytes;
        self.chunks.back().is_some_and(fits) || self.chunks.len() < self.most_chunks()
    }

    fn most_chunks(&self) -> usize {
        (self.limit_bytes / self.chunk_bytes).max(2)
    }

    /// Adds the next tick.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn push(&mut self, header: MessageHeader, payload: &[u8]) -> Result<(), JournalError> {
        let full = |chunk: &JournalChunk| chunk.used + payload.len() > self.chunk_bytes;
        if self.chunks.back().is_none_or(full) {
            self.add_chunk(payload.len())?;
        }
        let Some(chunk) = self.chunks.back_mut() else {
            return Ok(());
        };
        let offset = chunk.used;
        match &mut chunk.place {
            ChunkStorage::Memory(bytes) => bytes[offset..offset + payload.len()].copy_from_slice(payload),
            ChunkStorage::File(number) => {
                let at = *number * self.chunk_bytes as u64 + offset as u64;
                let file = self.file.as_ref();
                let written = storage::when_there_is_space(&self.directory, || {
                    file.map_or(Ok(()), |file| file.write_all_at(payload, at))
                });
                written.map_err(failed("write", &self.directory))?;
            }
        }
        chunk.entries.push(JournalEntry {
            header,
            offset,
            len: payload.len(),
        });
        chunk.used += payload.len();
        self.ticks += 1;
        if chunk.entries.len() == 1 || self.ticks.is_multiple_of(64) {
            self.most_bytes = self.most_bytes.max(self.bytes());
        }
        Ok(())
    }

    /// Records that all ticks below `ticks` are committed, and frees the chunks before the previous commit.
    pub fn commit(&mut self, ticks: u64) {
        let [newest, _] = self.commits;
        if ticks > newest {
            self.commits = [ticks, newest];
            self.free_below(newest);
        }
    }

    /// Lets a successor continue at `tick`.
    ///
    /// # Errors
    /// That tick has been dropped, or has not been made.
    pub fn restart(&mut self, tick: u64) -> Result<(), JournalError> {
        if tick > self.ticks {
            return Err(JournalError::Future {
                wanted: tick,
                ticks: self.ticks,
            });
        }
        if tick < self.first() {
            return Err(JournalError::Gone {
                wanted: tick,
                first: self.first(),
                limit_mib: self.limit_bytes >> 20,
            });
        }
        self.commits = [tick, self.commits[1].min(tick)];
        Ok(())
    }

    /// Header and length of a tick; `None` if it is not held.
    #[must_use]
    pub fn find(&self, tick: u64) -> Option<(MessageHeader, usize)> {
        self.entry(tick).map(|(_, entry)| (entry.header, entry.len))
    }

    /// Copies the payload of a tick to `payload`, which has its length. False if the tick is not held.
    ///
    /// # Errors
    /// The file cannot be read.
    pub fn read(&self, tick: u64, payload: &mut [u8]) -> Result<bool, JournalError> {
        let Some((chunk, entry)) = self.entry(tick) else {
            return Ok(false);
        };
        match &chunk.place {
            ChunkStorage::Memory(bytes) => payload.copy_from_slice(&bytes[entry.offset..entry.offset + entry.len]),
            ChunkStorage::File(number) => {
                let at = *number * self.chunk_bytes as u64 + entry.offset as u64;
                let read = self
                    .file
                    .as_ref()
                    .map_or(Ok(()), |file| file.read_exact_at(payload, at));
                read.map_err(failed("read", &self.directory))?;
            }
        }
        Ok(true)
    }

    fn entry(&self, tick: u64) -> Option<(&JournalChunk, JournalEntry)> {
        let after = self.chunks.partition_point(|chunk| chunk.first_tick <= tick);
        let chunk = self.chunks.get(after.checked_sub(1)?)?;
        let index = usize::try_from(tick - chunk.first_tick).ok()?;
        chunk.entries.get(index).map(|entry| (chunk, *entry))
    }

    fn add_chunk(&mut self, message: usize) -> Result<(), JournalError> {
        if message > self.chunk_bytes {
            let source = std::io::Error::from(std::io::ErrorKind::InvalidInput);
            return Err(failed("write", &self.directory)(source));
        }
        while self.chunks.len() >= self.most_chunks() {
            self.warn();
            self.free_first();
        }
        let place = match self.free.pop_if(|place| place.is_memory()) {
            Some(place) => place,
            None => self.new_place()?,
        };
        self.chunks.push_back(JournalChunk {
            first_tick: self.ticks,
            place,
            used: 0,
            entries: Vec::new(),
        });
        Ok(())
    }

    fn new_place(&mut self) -> Result<ChunkStorage, JournalError> {
        if (self.memory_chunks + 1) * self.chunk_bytes <= MEMORY_BYTES || self.memory_chunks < 2 {
            let bytes = MmapMut::map_anon(self.chunk_bytes).map_err(failed("get memory for", &self.directory))?;
            self.memory_chunks += 1;
            return Ok(ChunkStorage::Memory(bytes));
        }
        if let Some(place) = self.free.pop() {
            return Ok(place);
        }
        if self.file.is_none() {
            let file = storage::when_there_is_space(&self.directory, || unlinked_file(&self.directory));
            self.file = Some(file.map_err(failed("create", &self.directory))?);
        }
        self.file_chunks += 1;
        Ok(ChunkStorage::File(self.file_chunks - 1))
    }

    fn free_below(&mut self, tick: u64) {
        while self.chunks.front().is_some_and(|chunk| chunk.end() <= tick) {
            self.free_first();
        }
    }

    fn free_first(&mut self) {
        if let Some(chunk) = self.chunks.pop_front() {
            let free_in_memory = self.free.iter().filter(|place| place.is_memory()).count();
            if chunk.place.is_memory() && free_in_memory >= FREE_IN_MEMORY {
                self.memory_chunks -= 1;
                return;
            }
            self.free.push(chunk.place);
            // Memory is reused before the file, which costs a system call for each message.
            self.free.sort_by_key(|place| match place {
                ChunkStorage::Memory(_) => (1, 0),
                ChunkStorage::File(number) => (0, u64::MAX - number),
            });
        }
    }

    fn warn(&mut self) {
        if !self.warned {
            self.warned = true;
            tracing::warn!(
                "the journal of observations is full ({} MiB) before the trainer has committed: the oldest ticks are dropped, and a trainer that dies now cannot be replaced; raise `run.journal_mib` or lower `trainer.checkpoint_interval`",
                self.limit_bytes >> 20
            );
        }
    }
}

/// Opens an unlinked file in `directory`: the system frees it when this process ends, for whatever reason.
fn unlinked_file(directory: &Path) -> std::io::Result<File> {
    let path = directory.join("journal.partial");
    let file = OpenOptions::new()
        .create(true)
        .truncate(true)
        .read(true)
        .write(true)
        .open(&path)?;
    std::fs::remove_file(&path)?;
    Ok(file)
}

fn failed(action: &'static str, directory: &Path) -> impl FnOnce(std::io::Error) -> JournalError {
    let directory = directory.into();
    move |source| JournalError::Io {
        action,
        directory,
        source,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn header(tick: u64) -> MessageHeader {
        MessageHeader {
            tick,
            ..MessageHeader::default()
        }
    }

    /// Test payload of a tick.
    fn payload(tick: u64, len: usize) -> Vec<u8> {
        (0..len).map(|i| (tick.wrapping_mul(31) + i as u64) as u8).collect()
    }

    fn fill(journal: &mut Journal, ticks: u64, len: usize) {
        for _ in 0..ticks {
            let tick = journal.ticks();
            journal.push(header(tick), &payload(tick, len)).unwrap();
        }
    }

    fn check(journal: &Journal, tick: u64) {
        let (head, len) = journal.find(tick).unwrap();
        let mut found = vec![0; len];
        assert!(journal.read(tick, &mut found).unwrap());
        assert_eq!((head, found), (header(tick), payload(tick, len)), "tick {tick}");
    }

    #[test]
    fn ticks_beyond_the_memory_are_read_back_from_an_unlinked_file() {
        let directory = tempfile::tempdir().unwrap();
        let mut journal = Journal::new(directory.path(), 1 << 30, 1000);
        fill(&mut journal, 90, 1 << 20);
        assert!(journal.file.is_some(), "90 MiB are more than the memory part");
        (0..90).for_each(|tick| check(&journal, tick));
        assert_eq!(std::fs::read_dir(directory.path()).unwrap().count(), 0);
        // Freed chunks are reused: never more than 130 MiB are held, at most 64 of them in memory, in chunks of 4.
        for _ in 0..5 {
            journal.commit(journal.ticks());
            fill(&mut journal, 40, 1 << 20);
        }
        let len = journal.file.as_ref().unwrap().metadata().unwrap().len();
        assert!(len <= 72 << 20, "{len} bytes in the file");
        (journal.first()..journal.ticks()).for_each(|tick| check(&journal, tick));
    }

    #[test]
    fn memory_that_is_no_longer_needed_goes_back_to_the_system() {
        let directory = tempfile::tempdir().unwrap();
        let mut journal = Journal::new(directory.path(), 1 << 30, 1000);
        fill(&mut journal, 52, 1 << 20);
        assert_eq!(journal.memory_chunks, 13);
        for _ in 0..3 {
            journal.commit(journal.ticks());
            fill(&mut journal, 8, 1 << 20);
            (journal.first()..journal.ticks()).for_each(|tick| check(&journal, tick));
        }
        // Two commits of 8 MiB and the chunks at both ends are in use.
        let (used, free) = (journal.chunks.len(), journal.free.len());
        assert_eq!(journal.memory_chunks, used + free);
        assert!(used <= 6 && free <= FREE_IN_MEMORY, "{used} chunks in use, {free} free");
    }

    #[test]
    fn a_damaged_newest_checkpoint_can_be_passed_over() {
        let directory = tempfile::tempdir().unwrap();
        let mut journal = Journal::new(directory.path(), 1 << 20, 100);
        for commit in [1000, 2000, 3000] {
            fill(&mut journal, 1000, 100);
            journal.commit(commit);
        }
        journal.restart(2000).unwrap();
        (2000..3000).for_each(|tick| check(&journal, tick));
        // From there on the commit at 2000 is the newest, and stays reachable until two more commits.
        journal.commit(2500);
        fill(&mut journal, 2000, 100);
        journal.restart(2500).unwrap();
        journal.restart(2000).unwrap();
    }

    #[test]
    fn the_size_limit_is_kept_and_the_error_names_it() {
        let directory = tempfile::tempdir().unwrap();
        let mut journal = Journal::new(directory.path(), 1 << 20, 1000);
        fill(&mut journal, 5000, 1000);
        assert!(journal.most_bytes() <= 1 << 20, "{} bytes", journal.most_bytes());
        assert!(journal.first() > 3900, "an eighth too much may be dropped at a time");
        let error = journal.restart(0).unwrap_err().to_string();
        assert!(error.contains("`run.journal_mib` (now 1)"), "{error}");
        assert!(journal.restart(5001).unwrap_err().to_string().contains("another run"));
        journal.restart(journal.first()).unwrap();
    }

    #[derive(Debug, Clone)]
    enum Step {
        Push(usize),
        Commit(f64),
        Restart(f64),
    }

    fn steps() -> impl Strategy<Value = Vec<Step>> {
        let step = prop_oneof![
            8 => (0_usize..3000).prop_map(Step::Push),
            1 => (0.0..1.0).prop_map(Step::Commit),
            1 => (0.0..1.0).prop_map(Step::Restart),
        ];
        prop::collection::vec(step, 1..300)
    }

    proptest! {
        /// For any order of ticks, commits and restarts, every tick that may be requested is held unchanged, within the size limit.
        #[test]
        fn every_tick_since_the_commit_before_the_last_is_held(steps in steps(), limit_kib in prop::sample::select(vec![16_usize, 64, 100_000])) {
            let directory = tempfile::tempdir().unwrap();
            let mut journal = Journal::new(directory.path(), limit_kib << 10, 3000);
            let mut lens = Vec::new();
            let (mut newest, mut before) = (0_u64, 0_u64);
            for step in steps {
                let at = |part: f64| (part * (lens.len() as f64 + 0.99)) as u64;
                match step {
                    Step::Push(len) => {
                        let (first, has_room) = (journal.first(), lens.is_empty() || journal.has_room(len));
                        journal.push(header(journal.ticks()), &payload(journal.ticks(), len)).unwrap();
                        lens.push(len);
                        prop_assert_eq!(has_room, lens.len() == 1 || journal.first() == first);
                    }
                    Step::Commit(part) => {
                        journal.commit(at(part));
                        if at(part) > newest {
                            (newest, before) = (at(part), newest);
                        }
                    }
                    Step::Restart(part) => {
                        let tick = at(part);
                        prop_assert_eq!(journal.restart(tick).is_ok(), tick >= journal.first());
                        if tick >= journal.first() {
                            (newest, before) = (tick, before.min(tick));
                        }
                    }
                }
                prop_assert_eq!(journal.ticks(), lens.len() as u64);
                prop_assert!(journal.bytes() <= (limit_kib << 10));
                if limit_kib == 100_000 {
                    prop_assert!(journal.first() <= before);
                }
            }
            for tick in journal.first()..journal.ticks() {
                prop_assert_eq!(journal.find(tick).unwrap().1, lens[tick as usize]);
                check(&journal, tick);
            }
            prop_assert!(journal.find(journal.ticks()).is_none());
        }
    }
}
