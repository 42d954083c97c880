//! Memory that the system keeps a recording in, on its way to the disk.

use std::{
    fs::File,
    io,
    num::NonZero,
    sync::mpsc::{Receiver, SyncSender, sync_channel},
    thread,
};

use rustix::fs::{Advice, fadvise};

/// Bytes before the new ones that the system is asked for once more: those that were not on the disk yet.
const LATE_BYTES: u64 = 64 << 20;

/// Asks the system to write what is new to the disk, and to drop what is there. Its memory is used again then: new pages take longer, and
/// a file that fills the memory pushes that of other programs out of the caches.
///
/// A thread asks, because the system lets it wait while the disk has enough to write.
#[derive(Debug)]
pub struct WrittenPages {
    ends: SyncSender<u64>,
}

impl WrittenPages {
    /// Those of `file`.
    ///
    /// # Errors
    /// The system refuses another handle or a thread.
    pub fn of(file: &File) -> io::Result<Self> {
        let file = file.try_clone()?;
        let (ends, received) = sync_channel(1);
        thread::Builder::new()
            .name("written-pages".into())
            .spawn(move || drop_pages(&file, &received))?;
        Ok(Self { ends })
    }

    /// Drops the pages up to this byte, now or with a later call.
    pub fn drop_until(&self, end: u64) {
        // A full queue: the thread waits for the disk, and will see a later end.
        let _ = self.ends.try_send(end);
    }
}

fn drop_pages(file: &File, ends: &Receiver<u64>) {
    let mut begin = 0;
    for end in ends {
        let from = u64::saturating_sub(begin, LATE_BYTES);
        if let Err(error) = fadvise(file, from, NonZero::new(end.saturating_sub(from)), Advice::DontNeed) {
            tracing::debug!(%error, "the system keeps the recording in memory");
            return;
        }
        begin = end;
    }
}
