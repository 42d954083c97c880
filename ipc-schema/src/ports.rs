//! Sending and receiving: typed errors, no copies, no back-pressure other than credits.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU32, AtomicU64, Ordering},
    },
    time::Duration,
};

use iceoryx2::{
    port::{BackpressureAction, listener::ListenerWaitError, notifier::Notifier, publisher, subscriber},
    prelude::{AllocationStrategy, BackpressureStrategy},
    sample, sample_mut,
};

use crate::{
    SCHEMA_VERSION,
    header::MessageHeader,
    reserve::{MessagePages, ReserveError},
    run::RunFile,
    services::{self, Channel, DataService, RunNode, Shm, WakeListener, WakeService},
    storage::{reason_of, retry_on_full_disk},
};

pub use crate::{
    board_port::{BoardError, BoardReader, BoardWriter, RosterWriter},
    control_port::{ControlClient, ControlServer, Pending},
};

/// A message could not be sent or received.
#[derive(Debug, thiserror::Error)]
pub enum PortError {
    /// iceoryx2 refused.
    #[error("{channel}: {action} failed: {reason}")]
    Refused {
        /// Service.
        channel: &'static str,
        /// "sending", "receiving", …
        action: &'static str,
        /// iceoryx2's reason.
        reason: String,
    },
    /// The message is longer than the service was laid out for.
    #[error(
        "{channel}: a message of {needed} bytes is over the {limit} bytes laid out: raise `traffic.max_road_users` (now {max_road_users})"
    )]
    TooLong {
        /// Service.
        channel: &'static str,
        /// Bytes wanted.
        needed: usize,
        /// Bytes there.
        limit: usize,
        /// The setting to raise.
        max_road_users: u32,
    },
    /// The sender speaks another version of the schema.
    #[error("{channel}: message of schema version {found}, this program speaks {SCHEMA_VERSION}")]
    Version {
        /// Service.
        channel: &'static str,
        /// The sender's version.
        found: u32,
    },
    /// Shared memory is full.
    #[error(transparent)]
    Reserve(#[from] ReserveError),
    /// A tick is missing, or came twice.
    #[error("{channel}: expected tick {expected}, received tick {received}")]
    Gap {
        /// Service.
        channel: &'static str,
        /// The next tick in order.
        expected: u64,
        /// What came.
        received: u64,
    },
}

pub(crate) fn refused(channel: &'static str, action: &'static str) -> impl FnOnce(&dyn std::fmt::Debug) -> PortError {
    move |reason| PortError::Refused {
        channel,
        action,
        reason: reason_of(reason),
    }
}

/// The sending end of a data service.
#[derive(Debug)]
pub struct Publisher {
    port: publisher::Publisher<Shm, [u8], MessageHeader>,
    pages: MessagePages,
    channel: Channel,
    limit: usize,
    max_road_users: u32,
    drops: Arc<AtomicU64>,
}

impl Publisher {
    pub(crate) fn create(service: &DataService, channel: Channel, run: &RunFile) -> Result<Self, PortError> {
        let drops = Arc::new(AtomicU64::new(0));
        let limit = channel.max_payload(run);
        let create = || {
            let counter = Arc::clone(&drops);
            service
                .publisher_builder()
                .initial_max_slice_len(limit.max(1))
                .allocation_strategy(AllocationStrategy::Static)
                .max_loaned_samples(2)
                .backpressure_strategy(BackpressureStrategy::DiscardData)
                .set_backpressure_handler(move |_| {
                    counter.fetch_add(1, Ordering::Relaxed);
                    BackpressureAction::DiscardData
                })
                .create()
        };
        let port = retry_on_full_disk(create).map_err(|e| refused(channel.name(), "creation of the publisher")(&e))?;
        let pages = {
            let loan = || port.loan_slice_uninit(limit.max(1));
            let first = loan().map_err(|e| refused(channel.name(), "loan")(&e))?;
            let second = loan().map_err(|e| refused(channel.name(), "loan")(&e))?;
            MessagePages::of(run, channel, first.payload().as_ptr(), second.payload().as_ptr())?
        };
        Ok(Self {
            port,
            pages,
            channel,
            limit,
            max_road_users: run.config.traffic.max_road_users,
            drops,
        })
    }

    /// A zeroed message of `len` payload bytes in shared memory, to be filled and sent.
    ///
    /// # Errors
    /// Longer than laid out, or all messages are in use.
    pub fn loan(&self, header: MessageHeader, len: usize) -> Result<Draft, PortError> {
        self.check_length(len)?;
        let mut draft = self.loan_unwritten(header, len)?;
        draft.payload_mut().fill(0);
        Ok(draft)
    }

    /// A message of `len` payload bytes in shared memory that still has the bytes of an older message. The caller writes all that is to
    /// be read: zeroing a long message takes longer than filling it.
    ///
    /// # Errors
    /// As [`Publisher::loan`].
    pub fn loan_unwritten(&self, header: MessageHeader, len: usize) -> Result<Draft, PortError> {
        self.check_length(len)?;
        let sample = self
            .port
            .loan_slice_uninit(len)
            .map_err(|e| refused(self.channel.name(), "loan")(&e))?;
        self.pages.follow(sample.payload().as_ptr())?;
        #[expect(unsafe_code, reason = "the bytes are initialised, only not by this program")]
        // SAFETY: the payload lies in a shared-memory file that the kernel has filled with zeros and that processes of this run have
        // written since; every byte has a value, and every value is a valid `u8`.
        let mut sample = unsafe { sample.assume_init() };
        *sample.user_header_mut() = header;
        Ok(Draft {
            sample,
            channel: self.channel,
        })
    }

    fn check_length(&self, len: usize) -> Result<(), PortError> {
        if len <= self.limit {
            return Ok(());
        }
        Err(PortError::TooLong {
            channel: self.channel.name(),
            needed: len,
            limit: self.limit,
            max_road_users: self.max_road_users,
        })
    }

    /// Messages that a subscriber did not get because its queue was full.
    #[must_use]
    pub fn drops(&self) -> u64 {
        self.drops.load(Ordering::Relaxed)
    }
}

/// A message in shared memory that is being written.
#[derive(Debug)]
pub struct Draft {
    sample: sample_mut::SampleMut<Shm, [u8], MessageHeader>,
    channel: Channel,
}

impl Draft {
    /// The payload.
    pub fn payload_mut(&mut self) -> &mut [u8] {
        self.sample.payload_mut()
    }

    /// The payload as written so far.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.sample.payload()
    }

    /// The header.
    pub fn header_mut(&mut self) -> &mut MessageHeader {
        self.sample.user_header_mut()
    }

    /// Hands the message to all subscribers; never blocks. Returns how many got it.
    ///
    /// # Errors
    /// A connection is broken.
    pub fn send(self) -> Result<usize, PortError> {
        self.sample
            .send()
            .map_err(|e| refused(self.channel.name(), "sending")(&e))
    }
}

/// The receiving end of a data service.
#[derive(Debug)]
pub struct Subscriber {
    port: subscriber::Subscriber<Shm, [u8], MessageHeader>,
    channel: Channel,
    run_id: u64,
    /// The newest incarnation of the sender; an older message is stale.
    incarnation: AtomicU32,
    /// The newest incarnation that a message was addressed to; a message to an older one is stale.
    addressee: AtomicU32,
    refused: AtomicU64,
}

impl Subscriber {
    /// The receiving end of an opened service for a watcher, which takes no part in the run. It may miss messages, and no process waits
    /// for it.
    ///
    /// # Errors
    /// iceoryx2 refuses.
    pub fn create(service: &DataService, channel: Channel, run: &RunFile) -> Result<Self, PortError> {
        let port = retry_on_full_disk(|| service.subscriber_builder().create())
            .map_err(|e| refused(channel.name(), "creation of the subscriber")(&e))?;
        Ok(Self {
            port,
            channel,
            run_id: run.run_id,
            incarnation: AtomicU32::new(0),
            addressee: AtomicU32::new(0),
            refused: AtomicU64::new(0),
        })
    }

    /// Refuses messages of senders before `incarnation` from now on.
    pub fn refuse_senders_before(&self, incarnation: u32) {
        self.incarnation.fetch_max(incarnation, Ordering::Relaxed);
    }

    /// Refuses messages that are addressed to incarnations before `incarnation`, also before a newer one has come.
    #[must_use]
    pub(crate) fn since_incarnation(self, incarnation: u32) -> Self {
        self.addressee.store(incarnation, Ordering::Relaxed);
        self
    }

    /// The next message, if one is waiting; it stays readable until dropped. Messages of another run and of an incarnation that has been
    /// replaced are refused and counted.
    ///
    /// # Errors
    /// The connection is broken, or the sender speaks another schema version.
    pub fn receive(&self) -> Result<Option<Message>, PortError> {
        loop {
            let Some(sample) = self
                .port
                .receive()
                .map_err(|e| refused(self.channel.name(), "receiving")(&e))?
            else {
                return Ok(None);
            };
            let header = *sample.user_header();
            if header.schema_version != SCHEMA_VERSION {
                return Err(PortError::Version {
                    channel: self.channel.name(),
                    found: header.schema_version,
                });
            }
            // A load is cheaper than an atomic maximum, and nearly every message has the newest incarnations.
            let is_current = |newest: &AtomicU32, incarnation| {
                incarnation == newest.load(Ordering::Relaxed)
                    || incarnation >= newest.fetch_max(incarnation, Ordering::Relaxed)
            };
            if header.run_id == self.run_id
                && is_current(&self.incarnation, header.incarnation)
                && is_current(&self.addressee, header.addressee)
            {
                return Ok(Some(Message { header, sample }));
            }
            self.refused.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// The channel that it receives.
    #[must_use]
    pub fn channel(&self) -> Channel {
        self.channel
    }

    /// Messages of other runs and of replaced incarnations that were refused.
    #[must_use]
    pub fn refused(&self) -> u64 {
        self.refused.load(Ordering::Relaxed)
    }
}

/// A received message, read in place in shared memory.
#[derive(Debug)]
pub struct Message {
    header: MessageHeader,
    sample: sample::Sample<Shm, [u8], MessageHeader>,
}

impl Message {
    /// The header, copied out before anything in it is trusted.
    #[must_use]
    pub fn header(&self) -> &MessageHeader {
        &self.header
    }

    /// The payload in shared memory.
    #[must_use]
    pub fn payload(&self) -> &[u8] {
        self.sample.payload()
    }
}

/// Wakes another process.
#[derive(Debug)]
pub struct Waker(Notifier<Shm>);

impl Waker {
    pub(crate) fn create(service: &WakeService) -> Result<Self, PortError> {
        Ok(Self(
            retry_on_full_disk(|| service.notifier_builder().create())
                .map_err(|e| refused("wake", "creation of the notifier")(&e))?,
        ))
    }

    /// Wakes `process` of environment `env_index`, for a program that is no process of the run itself.
    ///
    /// # Errors
    /// The service does not exist, or as many processes as may wake it already do.
    pub fn open(
        node: &RunNode,
        run: &RunFile,
        env_index: u32,
        process: crate::process::Process,
    ) -> Result<Self, BoardError> {
        Ok(Self::create(&services::open_wake(node, run, env_index, process)?)?)
    }

    /// Wakes the process if it waits; harmless if it does not or is gone.
    pub fn wake(&self) {
        if let Err(error) = self.0.notify() {
            tracing::trace!(?error, "wake-up not delivered");
        }
    }
}

/// The socket below counts in microseconds and takes zero of them for ever.
const SHORTEST_WAIT: Duration = Duration::from_micros(10);

/// Waits until another process wakes this one or `timeout` has passed. Look for work before waiting, and again after.
///
/// # Errors
/// The listener is broken.
pub fn wait(listener: &WakeListener, timeout: Duration) -> Result<(), PortError> {
    match listener.timed_wait(|_| (), timeout.max(SHORTEST_WAIT)) {
        // A signal ends the wait early, like a wake-up: the caller looks at its stop flag.
        Ok(_) | Err(ListenerWaitError::InterruptSignal) => Ok(()),
        Err(error) => Err(refused("wake", "waiting")(&error)),
    }
}
