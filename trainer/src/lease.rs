//! Lends observations one at a time, each until the next is taken: the shortest way from shared memory to a tensor.
//!
//! Shared memory has a fixed number of places for messages. The tensor over a place is made once and returned again whenever a message
//! lies there, so taking a message costs a lookup in a table instead of a dozen new Python objects.

use std::{
    ffi::c_int,
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::{Duration, Instant},
};

use ipc_schema::{
    clock::monotonic_ns,
    header::{self, DIMENSIONS, MessageHeader},
    observation::ObservationLayout,
    ports::Message,
};
use pyo3::{exceptions::PyValueError, ffi, prelude::*};

use crate::{Attachment, POLLS, checked_layout};

/// Longest time that polling holds the GIL: a fifth of Python's own switch interval.
const GIL_HOLD: Duration = Duration::from_millis(1);

/// Address and shape of a message.
type MessagePlace = (usize, [u32; DIMENSIONS]);

/// The newest message and, until the next one is requested, the message before it: releasing a place then delays no tensor.
///
/// While a message is held, the memory of its publisher stays mapped, with the places of all earlier messages. Every tensor over a place
/// therefore holds this.
type Held = Arc<Mutex<[Option<Message>; 2]>>;

struct Lent {
    header: MessageHeader,
    received_ns: u64,
    /// The tensor that was used last comes first, because a publisher takes the place that became free last.
    tensors: Vec<(MessagePlace, Py<PyAny>)>,
}

/// The observations of an attachment, one at a time.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct Lease {
    attachment: Py<Attachment>,
    /// Python function that makes a tensor from a buffer of bytes and the numbers of slots and fields.
    make: Py<PyAny>,
    held: Held,
    lent: Mutex<Lent>,
}

fn lock<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

#[pymethods]
impl Lease {
    #[new]
    fn new(attachment: Py<Attachment>, make: Py<PyAny>) -> Self {
        Self {
            attachment,
            make,
            held: Arc::default(),
            lent: Mutex::new(Lent {
                header: MessageHeader::default(),
                received_ns: 0,
                tensors: Vec::new(),
            }),
        }
    }

    /// Waits for the next tick and returns its tensor; `None` after `timeout_s` seconds. The tick before it is released: the contents of
    /// its tensor are undefined from now on. Busy-polls.
    fn next(&self, py: Python<'_>, timeout_s: f64) -> PyResult<Option<Py<PyAny>>> {
        let deadline = Instant::now()
            + Duration::try_from_secs_f64(timeout_s).map_err(|error| PyValueError::new_err(error.to_string()))?;
        lock(&self.held)[1] = None;
        loop {
            if let Some(message) = self.poll(deadline)? {
                return self.lend(py, message).map(Some);
            }
            py.detach(|| self.attachment.get().wait(Duration::ZERO))?;
            py.check_signals()?;
            if Instant::now() >= deadline {
                return Ok(None);
            }
        }
    }

    /// Number of the newest tick, 0-based over the run.
    #[getter]
    fn tick(&self) -> u64 {
        lock(&self.lent).header.tick
    }

    /// Its episode, 0-based over the run.
    #[getter]
    fn episode(&self) -> u64 {
        lock(&self.lent).header.episode
    }

    /// Its simulated time since the start of the episode, nanoseconds.
    #[getter]
    fn sim_time_ns(&self) -> u64 {
        lock(&self.lent).header.sim_time_ns
    }

    /// Time at which it was taken, on the system's monotonic clock, nanoseconds.
    #[getter]
    fn received_ns(&self) -> u64 {
        lock(&self.lent).received_ns
    }

    /// True if it is the last of its episode.
    #[getter]
    fn episode_last(&self) -> bool {
        lock(&self.lent).header.has(header::LAST_OF_EPISODE)
    }

    /// True if it is the last of the run.
    #[getter]
    fn last(&self) -> bool {
        lock(&self.lent).header.has(header::LAST_OF_RUN)
    }

    /// Number of tensors made so far: one for each place in shared memory that held a message.
    #[getter]
    fn places(&self) -> usize {
        lock(&self.lent).tensors.len()
    }
}

impl Lease {
    /// Polls until a message arrives, the deadline has passed, or other threads of Python must run.
    fn poll(&self, deadline: Instant) -> PyResult<Option<Message>> {
        let mut inner = self.attachment.get().lock()?;
        let until = deadline.min(Instant::now() + GIL_HOLD);
        loop {
            for _ in 0..POLLS {
                if let Some(messages) = inner.next_message()? {
                    return Ok(Some(messages.observation));
                }
                std::hint::spin_loop();
            }
            inner.follow_sender();
            if Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    /// Holds `message` as the newest, and returns the tensor over its place.
    fn lend(&self, py: Python<'_>, message: Message) -> PyResult<Py<PyAny>> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        let address = message.payload().as_ptr().expose_provenance();
        let place = (address, header.shape);
        // Most messages lie in a place that has a tensor already.
        let known = {
            let mut lent = lock(&self.lent);
            (lent.header, lent.received_ns) = (header, received_ns);
            let at = lent.tensors.iter().position(|(known, _)| *known == place);
            at.map(|at| {
                lent.tensors.swap(0, at);
                lent.tensors[0].1.clone_ref(py)
            })
        };
        if let Some(tensor) = known {
            hold(&self.held, message);
            return Ok(tensor);
        }
        // The first message in a place makes its tensor.
        let layout = checked_layout(&message)?;
        let view = LentView::new(Arc::clone(&self.held), address, layout);
        hold(&self.held, message);
        let tensor = self.make.call1(py, (view, header.shape[0], header.shape[1]))?;
        let tensors = &mut lock(&self.lent).tensors;
        // If the layout of a place has changed, with more slots, its old tensor is useless.
        tensors.retain(|((known, ..), _)| *known != address);
        tensors.push((place, tensor.clone_ref(py)));
        Ok(tensor)
    }
}

/// Holds `message` as the newest, and the message before it until the next call.
fn hold(held: &Held, message: Message) {
    let mut held = lock(held);
    held[1] = held[0].replace(message);
}

/// The observation of the message in one place of shared memory, as a read-only buffer of bytes.
#[pyclass(frozen, module = "caraware._native")]
struct LentView {
    _held: Held,
    address: usize,
    len: usize,
}

impl LentView {
    fn new(held: Held, address: usize, layout: ObservationLayout) -> Self {
        Self {
            _held: held,
            address: address + layout.observation.offset,
            len: layout.observation.len,
        }
    }
}

#[pymethods]
impl LentView {
    /// Buffer protocol, read-only. The consumer holds this object, which holds the newest message, which keeps the memory mapped.
    #[expect(unsafe_code, reason = "the buffer protocol of CPython works on raw pointers")]
    unsafe fn __getbuffer__(slf: Bound<'_, Self>, view: *mut ffi::Py_buffer, flags: c_int) -> PyResult<()> {
        let this = slf.get();
        let memory = std::ptr::with_exposed_provenance_mut::<std::ffi::c_void>(this.address);
        let length = ffi::Py_ssize_t::try_from(this.len)?;
        // SAFETY: `view` is a valid Py_buffer (CPython's contract for this slot). The layout was checked to lie inside the message that
        // this place was first seen with, so the place is that long. PyBuffer_FillInfo takes a reference to `slf`, which holds a message
        // of the same publisher at any time, and a message keeps all of its publisher's memory mapped: there is one sensor-daemon in a
        // run, whose memory is one segment laid out at its start. The last-but-one argument makes the buffer read-only.
        let result = unsafe { ffi::PyBuffer_FillInfo(view, slf.as_ptr(), memory, length, 1, flags) };
        if result == 0 {
            Ok(())
        } else {
            Err(PyErr::fetch(slf.py()))
        }
    }
}
