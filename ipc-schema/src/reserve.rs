//! Reserves the shared memory of a run, so that no process gets SIGBUS when other programs fill `/dev/shm`.
//!
//! iceoryx2's files are sparse: the kernel allocates a page at the first write to it, and sends SIGBUS if there is none left. Therefore:
//!
//! 1. The supervisor allocates all that a run may need in one file, the *reserve*, before it creates the first service.
//! 2. A process that sends allocates the pages of a message before it is first used, in place of as many bytes of the reserve.
//! 3. Where iceoryx2 itself writes to a new page while `/dev/shm` is full, the handler of SIGBUS takes the page from the reserve.
//! 4. What a dead process leaves free returns to the reserve, for its successor.

use std::{
    fs::{File, OpenOptions, Permissions},
    io,
    os::{
        fd::{AsFd, OwnedFd},
        unix::fs::{MetadataExt as _, OpenOptionsExt as _, PermissionsExt as _},
    },
    path::{Path, PathBuf},
    sync::{
        Mutex, Once, OnceLock, PoisonError,
        atomic::{AtomicU64, Ordering},
    },
};

use rustix::{
    fs::{FallocateFlags, FlockOperation, fallocate, flock, fstat, ftruncate, statvfs},
    io::Errno,
};

use crate::{
    failure::{Failure, FailureKind},
    run::{RunFile, SharedMemory},
    services::Channel,
};

/// Where iceoryx2 puts shared memory.
pub const SHARED_MEMORY: &str = "/dev/shm";
/// Bytes of one environment for iceoryx2's own files: boards (3 MB), connections and the settings of services.
const SERVICE_BYTES: u64 = 5 << 20;
/// Bytes before a payload that iceoryx2 and the message's header take at most.
const HEADER_BYTES: u64 = 1 << 10;
/// Unit in which the kernel allocates shared memory.
const PAGE_BYTES: u64 = 4 << 10;
/// Bytes that the handler of SIGBUS takes from the reserve at a time.
const STEP_BYTES: u64 = 64 << 10;
/// Messages that a publisher allocates beyond the one that it uses.
const AHEAD: u64 = 4;
/// Runs that one process takes part in or watches at a time, as far as their reserves are used by the handler of SIGBUS.
const MOST_RUNS: usize = 8;

/// Shared memory cannot be reserved.
#[derive(Debug, thiserror::Error)]
pub enum ReserveError {
    /// There is not enough.
    #[error("{SHARED_MEMORY} has {} MiB free, but {what} needs {} MiB", free_bytes >> 20, needed_bytes.div_ceil(1 << 20))]
    Full {
        /// "this run", or the channel.
        what: &'static str,
        /// Bytes needed.
        needed_bytes: u64,
        /// Bytes free.
        free_bytes: u64,
    },
    /// The system refused for another reason.
    #[error("cannot reserve shared memory in {path}")]
    Io {
        /// The file.
        path: PathBuf,
        /// Why.
        #[source]
        source: io::Error,
    },
}

impl ReserveError {
    /// As a process reports it.
    #[must_use]
    pub fn failure(&self) -> Failure {
        let failure = Failure::from_error(FailureKind::Missing, self);
        failure.with_help(format!(
            "other programs fill {SHARED_MEMORY}: remove what they have left there, or enlarge it (Docker: --shm-size)"
        ))
    }
}

fn failed(path: &Path, source: impl Into<io::Error>) -> ReserveError {
    ReserveError::Io {
        path: path.into(),
        source: source.into(),
    }
}

fn path(memory: &SharedMemory) -> PathBuf {
    Path::new(SHARED_MEMORY).join(format!("{}reserve", memory.prefix))
}

/// Frees the reserve of a run that has ended. A program that watched it keeps the file open, and with it would keep the memory.
pub(crate) fn release(memory: &SharedMemory) {
    let released = OpenOptions::new()
        .write(true)
        .open(path(memory))
        .and_then(|file| file.set_len(0));
    if let Err(error) = released
        && error.kind() != io::ErrorKind::NotFound
    {
        tracing::debug!(%error, "the reserve of shared memory is not freed");
    }
}

/// True if `file` is the reserve, which is empty once all of it is in use.
pub(crate) fn is_reserve(memory: &SharedMemory, file: &Path) -> bool {
    file == path(memory)
}

/// Free bytes of shared memory.
#[must_use]
pub fn free_bytes() -> u64 {
    statvfs(SHARED_MEMORY).map_or(0, |stat| stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Shared memory that a run needs at most, bytes: every message of every channel, those of a second trainer during a handover, and
/// iceoryx2's own files.
#[must_use]
pub fn needed_bytes(run: &RunFile) -> u64 {
    let messages: u64 = Channel::ALL
        .into_iter()
        .map(|channel| channel_bytes(run, channel))
        .sum();
    (messages + channel_bytes(run, Channel::Prediction) + SERVICE_BYTES) * u64::from(run.config.run.envs)
}

/// Pages of all messages of a channel, bytes. Each may begin and end amid a page.
fn channel_bytes(run: &RunFile, channel: Channel) -> u64 {
    channel.worst_case_messages(run) as u64 * message_bytes(channel.max_payload(run) as u64)
}

/// Pages of a message, bytes.
fn message_bytes(payload_bytes: u64) -> u64 {
    (HEADER_BYTES + payload_bytes).next_multiple_of(PAGE_BYTES) + PAGE_BYTES
}

/// Reserves all that the run needs.
///
/// # Errors
/// There is not enough.
pub fn create(run: &RunFile) -> Result<(), ReserveError> {
    let (path, needed_bytes) = (path(&run.shared_memory), needed_bytes(run));
    // The question comes first: an allocation that fails half-way fills the memory for a moment.
    let free_bytes = free_bytes();
    let full = ReserveError::Full {
        what: "this run",
        needed_bytes,
        free_bytes,
    };
    if needed_bytes > free_bytes {
        return Err(full);
    }
    let mut options = OpenOptions::new();
    options.create(true).truncate(true).read(true).write(true).mode(0o600);
    let file = options.open(&path).map_err(|error| failed(&path, error))?;
    match allocate(&file, 0, needed_bytes, FallocateFlags::empty()) {
        Ok(()) => Ok(()),
        Err(Errno::NOSPC) => Err(full),
        Err(error) => Err(failed(&path, error)),
    }
}

/// Returns what dead processes have left free to the reserve, as far as other programs have not taken it.
pub fn refill(run: &RunFile) {
    let reserve_path = path(&run.shared_memory);
    let Ok(reserve) = OpenOptions::new().read(true).write(true).open(&reserve_path) else {
        return;
    };
    // A process may have been stopped while it held the lock: the supervisor does not wait for it.
    if flock(&reserve, FlockOperation::NonBlockingLockExclusive).is_err() {
        return;
    }
    let in_use: u64 = files(&run.shared_memory)
        .filter(|path| *path != reserve_path)
        .filter_map(|path| path.metadata().ok())
        .map(|data| data.blocks() * 512)
        .sum();
    let size = reserve.metadata().map_or(0, |data| data.len());
    let due = needed_bytes(run).saturating_sub(in_use).min(size + free_bytes());
    if due > size
        && let Err(error) = allocate(&reserve, size, due - size, FallocateFlags::empty())
    {
        tracing::debug!(%error, "the reserve of shared memory stays at {size} bytes");
    }
}

/// Files of the run in shared memory.
pub(crate) fn files(memory: &SharedMemory) -> impl Iterator<Item = PathBuf> {
    let prefix = memory.prefix.clone();
    let entries = std::fs::read_dir(SHARED_MEMORY).into_iter().flatten().flatten();
    entries
        .filter(move |entry| entry.file_name().to_string_lossy().starts_with(&prefix))
        .map(|entry| entry.path())
}

/// Takes access to the run's files from other users. iceoryx2 gives them one: the file in which its nodes find each other.
pub fn close_to_others(memory: &SharedMemory) {
    for path in files(memory) {
        let is_open = path.metadata().is_ok_and(|data| data.mode() & 0o077 != 0);
        if is_open && let Err(error) = std::fs::set_permissions(&path, Permissions::from_mode(0o600)) {
            tracing::debug!(%error, path = %path.display(), "stays open to other users");
        }
    }
}

/// The pages of a publisher's messages. They are allocated before the messages are first used, in place of as many bytes of the reserve.
///
/// Messages in use are always the first ones of a segment, and a run hardly ever uses all that it may. So a run pays for the pages that
/// it uses; the others stay in the reserve.
#[derive(Debug)]
pub(crate) struct MessagePages {
    memory: SharedMemory,
    channel: Channel,
    path: PathBuf,
    segment: File,
    /// Bytes of the segment's file.
    size: u64,
    /// Address of the first message's payload, in this process and in the file.
    first: (usize, u64),
    /// Bytes from one payload to the next.
    stride: u64,
    payload_bytes: u64,
    /// Most messages that the run has reserved memory for.
    most: u64,
    /// Messages allocated from the first one on.
    allocated: AtomicU64,
}

impl MessagePages {
    /// The pages of a new segment; those of its first messages are allocated. `first` and `second` are the payloads of its first two
    /// messages: a message begins at the same distance behind the one before.
    ///
    /// # Errors
    /// The reserve is used up, and shared memory is full.
    pub(crate) fn of<T>(
        run: &RunFile,
        channel: Channel,
        first: *const T,
        second: *const T,
    ) -> Result<Self, ReserveError> {
        // The very first message may be either of the two.
        let (first, stride) = (
            first.addr().min(second.addr()),
            first.addr().abs_diff(second.addr()) as u64,
        );
        let Some((path, begin)) = mapped_file(first) else {
            let unknown = io::Error::new(io::ErrorKind::NotFound, "the new segment is not mapped");
            return Err(failed(Path::new("/proc/self/maps"), unknown));
        };
        let segment = OpenOptions::new()
            .read(true)
            .write(true)
            .open(&path)
            .map_err(|error| failed(&path, error))?;
        let size = segment.metadata().map_err(|error| failed(&path, error))?.len();
        let pages = Self {
            memory: run.shared_memory.clone(),
            channel,
            path,
            segment,
            size,
            first: (first, begin),
            stride,
            payload_bytes: channel.max_payload(run) as u64,
            most: channel.worst_case_messages(run) as u64,
            allocated: AtomicU64::new(0),
        };
        pages.allocate_up_to(AHEAD)?;
        Ok(pages)
    }

    /// Allocates what the messages after the one at `payload` need: iceoryx2 writes to a message's header before it is known here.
    ///
    /// # Errors
    /// The reserve is used up, and shared memory is full.
    pub(crate) fn follow<T>(&self, payload: *const T) -> Result<(), ReserveError> {
        let message = payload.addr().saturating_sub(self.first.0) as u64 / self.stride.max(1);
        let needed = message + 1 + AHEAD;
        if needed.min(self.most) <= self.allocated.load(Ordering::Relaxed) {
            return Ok(());
        }
        self.allocate_up_to(needed + STEP_BYTES / self.stride.max(1))
    }

    /// Allocates the first `messages`, as far as memory is reserved for them.
    fn allocate_up_to(&self, messages: u64) -> Result<(), ReserveError> {
        let messages = messages.min(self.most);
        let allocated = self.allocated.load(Ordering::Relaxed);
        if messages <= allocated {
            return Ok(());
        }
        let needed_bytes = (messages - allocated) * message_bytes(self.payload_bytes);
        let full = |error| match error {
            Errno::NOSPC => ReserveError::Full {
                what: self.channel.name(),
                needed_bytes,
                free_bytes: free_bytes(),
            },
            error => failed(&self.path, error),
        };
        // The headers of a message lie before its payload: the allocation of one begins where the payload of the one before ends.
        let start = (allocated == 0).then_some((0, self.first.1));
        let ranges = (allocated..messages)
            .map(|message| self.first.1 + message * self.stride)
            .map(|payload| (payload.saturating_sub(HEADER_BYTES), HEADER_BYTES + self.payload_bytes))
            .chain(start)
            .filter(|(offset, _)| *offset < self.size);
        let _held = take(&self.memory, needed_bytes).map_err(full)?;
        for (offset, bytes) in ranges {
            let bytes = bytes.min(self.size - offset);
            allocate(&self.segment, offset, bytes, FallocateFlags::KEEP_SIZE).map_err(full)?;
        }
        self.allocated.fetch_max(messages, Ordering::Relaxed);
        Ok(())
    }
}

/// Frees as many bytes of the reserve as it has, at most `bytes`. Without a reserve it does nothing. The returned lock keeps other
/// processes of the run from the reserve.
fn take(memory: &SharedMemory, bytes: u64) -> Result<Option<File>, Errno> {
    let Ok(reserve) = OpenOptions::new().read(true).write(true).open(path(memory)) else {
        return Ok(None);
    };
    flock(&reserve, FlockOperation::LockExclusive)?;
    shrink(&reserve, bytes)?;
    Ok(Some(reserve))
}

/// Frees at most `bytes` at the end of the reserve. False if it is empty.
fn shrink(reserve: impl AsFd, bytes: u64) -> Result<bool, Errno> {
    let size = u64::try_from(fstat(&reserve)?.st_size).unwrap_or(0);
    ftruncate(reserve, size.saturating_sub(bytes))?;
    Ok(size > 0)
}

fn allocate(file: &File, offset: u64, bytes: u64, flags: FallocateFlags) -> Result<(), Errno> {
    if bytes == 0 {
        return Ok(());
    }
    rustix::io::retry_on_intr(|| fallocate(file, flags, offset, bytes))
}

/// The file that is mapped at `address`, and the place of `address` in it.
fn mapped_file(address: usize) -> Option<(PathBuf, u64)> {
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    maps.lines().find_map(|line| {
        // "begin-end permissions offset device inode   path", numbers in hexadecimal.
        let mut cells = line.split_ascii_whitespace();
        let (begin, end) = cells.next()?.split_once('-')?;
        let number = |text: &str| usize::from_str_radix(text, 16).ok();
        let (begin, end, offset) = (number(begin)?, number(end)?, number(cells.nth(1)?)?);
        let path = cells.nth(2)?;
        let is_here = (begin..end).contains(&address) && path.starts_with(SHARED_MEMORY);
        is_here.then(|| (path.into(), (address - begin + offset) as u64))
    })
}

/// The reserves that the handler of SIGBUS may use.
static RESERVES: [OnceLock<OwnedFd>; MOST_RUNS] = [const { OnceLock::new() }; MOST_RUNS];

/// From now on this process takes pages from the reserve of a run where a write to shared memory would be its end.
pub fn guard(memory: &SharedMemory) {
    static REGISTER: Once = Once::new();
    static KNOWN: Mutex<Vec<PathBuf>> = Mutex::new(Vec::new());
    let path = path(memory);
    let mut known = KNOWN.lock().unwrap_or_else(PoisonError::into_inner);
    if known.contains(&path) {
        return;
    }
    if let Ok(reserve) = OpenOptions::new().read(true).write(true).open(&path) {
        known.push(path);
        let free = RESERVES.iter().find(|place| place.get().is_none());
        if let Some(Err(_)) = free.map(|place| place.set(reserve.into())) {
            tracing::debug!("a reserve of shared memory is not used");
        }
    }
    REGISTER.call_once(|| {
        #[expect(unsafe_code, reason = "the one way to continue after SIGBUS")]
        // SAFETY: all bytes zero is a valid `sigaction` without flags; both pointers are valid for the call; `on_bus_error` has the
        // signature that SA_SIGINFO asks for, and only reads atomics and makes system calls, which is allowed in a signal handler.
        let result = unsafe {
            let mut action: libc::sigaction = std::mem::zeroed();
            action.sa_sigaction = on_bus_error as *const () as usize;
            action.sa_flags = libc::SA_SIGINFO | libc::SA_ONSTACK | libc::SA_RESTART;
            // Rust's own handler is not called: it gives the signal its default effect from then on.
            libc::sigaction(libc::SIGBUS, &raw const action, std::ptr::null_mut())
        };
        if result != 0 {
            tracing::warn!("shared memory that runs out will end this process");
        }
    });
}

/// A write found no page. Frees some of the reserve, and lets the write happen again; without a reserve the process ends as usual.
extern "C" fn on_bus_error(_signal: libc::c_int, info: *const libc::siginfo_t, _context: *const libc::c_void) {
    let free_a_page = || {
        let mut reserves = RESERVES.iter().filter_map(OnceLock::get);
        reserves.any(|reserve| shrink(reserve, STEP_BYTES).unwrap_or(false))
    };
    #[expect(unsafe_code, reason = "the kernel passes a pointer")]
    // SAFETY: with SA_SIGINFO the kernel passes a pointer to the signal's description, valid while the handler runs.
    let code = unsafe { (*info).si_code };
    // A signal that another process has sent has another code.
    if !(code == libc::BUS_ADRERR && free_a_page())
        && signal_hook::low_level::emulate_default_handler(libc::SIGBUS).is_err()
    {
        signal_hook::low_level::abort();
    }
}
