//! Observations one by one, each lent until the next is taken: the way with the least between shared memory and a tensor.
//!
//! Shared memory has a fixed number of places for messages. The tensor over a place is made once and handed out again whenever a
//! message lies there, so that taking one costs a look into a table instead of a dozen Python objects.

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

use crate::{Attachment, POLLS, checked_layout, failed};

/// Longest time that it looks without letting other threads of Python run: a fifth of the time that they leave each other.
const KEEPS_PYTHON: Duration = Duration::from_millis(1);

/// Where a message lies and how it is laid out: address and shape.
type MessagePlace = (usize, [u32; DIMENSIONS]);

/// The newest message, and until the next is asked for the one before it: nobody has to wait while a place is given back. While a
/// message is held, its publisher's memory stays mapped, that of all earlier messages included: whoever has a tensor over any of them
/// holds this.
type Held = Arc<Mutex<[Option<Message>; 2]>>;

struct Lent {
    header: MessageHeader,
    received_ns: u64,
    /// The one used last first: a publisher takes the place that has become free last.
    tensors: Vec<(MessagePlace, Py<PyAny>)>,
}

/// The observations of an attachment, one at a time.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct Lease {
    attachment: Py<Attachment>,
    /// Makes a tensor of a buffer of bytes, slots and fields.
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

    /// The tensor of the next tick, `None` after `timeout_s` seconds. The one before it is given back: what it shows is undefined from
    /// now on. Keeps its core and looks again and again.
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

    /// Tick number of the newest, 0-based over the run.
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

    /// When it was taken, on the system's monotonic clock, nanoseconds.
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

    /// Number of tensors that have been made: one for each place in shared memory that a message has come to lie in.
    #[getter]
    fn places(&self) -> usize {
        lock(&self.lent).tensors.len()
    }
}

impl Lease {
    /// Looks until a message is there, the deadline has passed, or it is time to let others run.
    fn poll(&self, deadline: Instant) -> PyResult<Option<Message>> {
        let mut inner = self.attachment.get().lock()?;
        let until = deadline.min(Instant::now() + KEEPS_PYTHON);
        loop {
            for _ in 0..POLLS {
                if let Some(message) = inner.next_message()? {
                    return Ok(Some(message));
                }
                std::hint::spin_loop();
            }
            if Instant::now() >= until {
                return Ok(None);
            }
        }
    }

    /// The tensor over the place of `message`, which is held from now on in place of the one before.
    fn lend(&self, py: Python<'_>, message: Message) -> PyResult<Py<PyAny>> {
        let received_ns = monotonic_ns();
        let header = *message.header();
        let address = message.payload().as_ptr().expose_provenance();
        let place = (address, header.shape);
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
        let layout = checked_layout(&message)?;
        let view = LentView::new(Arc::clone(&self.held), address, layout);
        hold(&self.held, message);
        let tensor = self.make.call1(py, (view, header.shape[0], header.shape[1]))?;
        let tensors = &mut lock(&self.lent).tensors;
        // Of a place that is laid out anew, with more slots, the old tensor is of no more use.
        tensors.retain(|((known, ..), _)| *known != address);
        tensors.push((place, tensor.clone_ref(py)));
        Ok(tensor)
    }
}

/// Keeps `message` as the newest.
fn hold(held: &Held, message: Message) {
    let mut held = lock(held);
    held[1] = held[0].replace(message);
}

/// The observation of whatever message lies in a place of shared memory, as a read-only buffer of bytes.
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
    /// Buffer protocol: refuses writers; the consumer holds this object, which holds the newest message, which holds the mapping.
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
