//! Lends one section of an observation to Python: a read-only buffer over shared memory that keeps its message alive.

use std::ffi::c_int;

use ipc_schema::block::Section;
use pyo3::{ffi, prelude::*, types::PyTuple};

use crate::ObservationBlock;

/// One array of an observation block as a read-only buffer of bytes.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct SectionView {
    /// Keeps the message alive.
    _block: Py<ObservationBlock>,
    /// Address of the payload that has the section.
    payload_address: usize,
    section: Section,
    scalar: String,
    shape: Vec<usize>,
}

impl SectionView {
    pub(crate) fn new(
        block: Py<ObservationBlock>,
        payload_address: usize,
        section: Section,
        scalar: String,
        shape: Vec<usize>,
    ) -> Self {
        Self {
            _block: block,
            payload_address,
            section,
            scalar,
            shape,
        }
    }
}

#[pymethods]
impl SectionView {
    /// Scalar of the array, as numpy writes it: "<f4".
    #[getter]
    fn scalar(&self) -> &str {
        &self.scalar
    }

    /// Shape of the array.
    #[getter]
    fn shape<'py>(&self, py: Python<'py>) -> PyResult<Bound<'py, PyTuple>> {
        PyTuple::new(py, &self.shape)
    }

    /// Buffer protocol, read-only. The consumer holds this object, which holds the block, which holds the message.
    #[expect(unsafe_code, reason = "the buffer protocol of CPython works on raw pointers")]
    unsafe fn __getbuffer__(slf: Bound<'_, Self>, view: *mut ffi::Py_buffer, flags: c_int) -> PyResult<()> {
        let this = slf.get();
        let address = this.payload_address + this.section.offset;
        let memory = std::ptr::with_exposed_provenance_mut::<std::ffi::c_void>(address);
        let length = ffi::Py_ssize_t::try_from(this.section.len)?;
        // SAFETY: `view` is a valid Py_buffer (CPython's contract for this slot). The block checked at its making that all
        // sections lie inside its payload. PyBuffer_FillInfo takes a reference to `slf`, which owns the block, which owns the
        // message, so the memory outlives the buffer. The last-but-one argument makes it read-only: a request for a writable
        // buffer is refused with BufferError.
        let result = unsafe { ffi::PyBuffer_FillInfo(view, slf.as_ptr(), memory, length, 1, flags) };
        if result == 0 {
            Ok(())
        } else {
            Err(PyErr::fetch(slf.py()))
        }
    }
}
