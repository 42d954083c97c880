//! Lends one section of an observation to Python: a read-only array over shared memory that keeps its message alive.

use std::ffi::{CStr, c_int};

use ipc_schema::{block::Section, header::DIMENSIONS, section::SectionSpec};
use pyo3::{
    exceptions::{PyKeyError, PyValueError},
    ffi,
    prelude::*,
};

use crate::ObservationBlock;

/// Most dimensions of an array: those of a message, and two of an element.
const MAX_DIMENSIONS: usize = DIMENSIONS + 2;

/// The arrays of a payload, without sections of text or records. They are looked up in each tick, where half a microsecond counts.
pub(crate) struct ArrayTable(Vec<ArrayType>);

/// Type and shape of one array of a payload.
struct ArrayType {
    name: &'static str,
    /// The scalar as Python's buffer protocol writes it, and its bytes.
    format: &'static CStr,
    scalar_bytes: usize,
    /// For each dimension that depends on the message, its place in the header's shape.
    of_message: Vec<usize>,
    /// Shape of an element.
    of_element: Vec<usize>,
}

impl ArrayTable {
    /// The arrays of a payload whose header gives the sizes of `dimensions`, in this order.
    pub(crate) fn new(specs: &[SectionSpec], dimensions: &[&str]) -> Self {
        let array = |spec: &SectionSpec| {
            let (scalar, of_element) = (spec.element)();
            let (format, scalar_bytes) = buffer_format(&scalar)?;
            let place = |name: &&str| dimensions.iter().position(|known| known == name);
            Some(ArrayType {
                name: spec.name,
                format,
                scalar_bytes,
                of_message: spec.dimensions.iter().map(place).collect::<Option<_>>()?,
                of_element,
            })
        };
        Self(specs.iter().filter_map(array).collect())
    }

    /// The array `name` in the payload at `payload_address`, which `block` keeps alive. Its shape fills its section exactly.
    pub(crate) fn view<const N: usize>(
        &self,
        name: &str,
        block: Py<ObservationBlock>,
        payload_address: usize,
        sections: [(&'static str, Section); N],
        sizes: [u32; DIMENSIONS],
    ) -> PyResult<SectionView> {
        let unknown = || PyKeyError::new_err(name.to_owned());
        let array = self.0.iter().find(|array| array.name == name).ok_or_else(unknown)?;
        let (_, section) = sections.iter().find(|(known, _)| *known == name).ok_or_else(unknown)?;
        let of_message = array.of_message.iter().map(|&place| sizes[place] as usize);
        let (mut shape, mut dimensions) = ([0; MAX_DIMENSIONS], 0);
        for size in of_message.chain(array.of_element.iter().copied()) {
            shape[dimensions] = ffi::Py_ssize_t::try_from(size)?;
            dimensions += 1;
        }
        let scalar_bytes = ffi::Py_ssize_t::try_from(array.scalar_bytes)?;
        let (mut strides, mut stride) = ([0; MAX_DIMENSIONS], Some(scalar_bytes));
        for dimension in (0..dimensions).rev() {
            strides[dimension] = stride.unwrap_or_default();
            stride = stride.and_then(|bytes| bytes.checked_mul(shape[dimension]));
        }
        let len = ffi::Py_ssize_t::try_from(section.len)?;
        if stride != Some(len) {
            let shape = &shape[..dimensions];
            return Err(PyValueError::new_err(format!(
                "{name}: {shape:?} does not fit a section of {len} bytes"
            )));
        }
        Ok(SectionView {
            _block: block,
            address: payload_address + section.offset,
            len,
            format: array.format,
            scalar_bytes,
            dimensions: c_int::try_from(dimensions)?,
            shape,
            strides,
        })
    }
}

/// A scalar of numpy ("<f4") as Python's buffer protocol writes it, and its bytes; `None` for text and records.
fn buffer_format(scalar: &str) -> Option<(&'static CStr, usize)> {
    Some(match scalar {
        "|u1" => (c"B", 1),
        "<u2" => (c"H", 2),
        "<u4" => (c"I", 4),
        "<u8" => (c"Q", 8),
        "<i4" => (c"i", 4),
        "<f4" => (c"f", 4),
        "<f8" => (c"d", 8),
        _ => return None,
    })
}

/// One array of an observation block as a read-only buffer with its type and shape.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct SectionView {
    /// Keeps the message alive.
    _block: Py<ObservationBlock>,
    address: usize,
    len: ffi::Py_ssize_t,
    format: &'static CStr,
    scalar_bytes: ffi::Py_ssize_t,
    dimensions: c_int,
    /// Sizes, and bytes from one element to the next, of each dimension.
    shape: [ffi::Py_ssize_t; MAX_DIMENSIONS],
    strides: [ffi::Py_ssize_t; MAX_DIMENSIONS],
}

#[pymethods]
impl SectionView {
    /// Buffer protocol, read-only. The consumer holds this object, which holds the block, which holds the message.
    #[expect(unsafe_code, reason = "the buffer protocol of CPython works on raw pointers")]
    unsafe fn __getbuffer__(slf: Bound<'_, Self>, view: *mut ffi::Py_buffer, flags: c_int) -> PyResult<()> {
        let this = slf.get();
        let memory = std::ptr::with_exposed_provenance_mut::<std::ffi::c_void>(this.address);
        // SAFETY: `view` is a valid Py_buffer (CPython's contract for this slot). The block checked at its making that all
        // sections lie inside its payload. PyBuffer_FillInfo takes a reference to `slf`, which owns the block, which owns the
        // message, so the memory outlives the buffer. The last-but-one argument makes it read-only: a request for a writable
        // buffer is refused with BufferError.
        let result = unsafe { ffi::PyBuffer_FillInfo(view, slf.as_ptr(), memory, this.len, 1, flags) };
        if result != 0 {
            return Err(PyErr::fetch(slf.py()));
        }
        let asks_for = |wanted: c_int| flags & wanted == wanted;
        // SAFETY: PyBuffer_FillInfo has filled `view` as bytes. Consumers only read what these pointers point to, as long as they hold
        // `slf`, which is frozen and never moves. `ArrayTable::view` checked that the shape has as many bytes as the section. The
        // array is contiguous, so a consumer that asks for neither shape nor strides is right to take it as bytes.
        unsafe {
            if asks_for(ffi::PyBUF_ND) {
                if asks_for(ffi::PyBUF_FORMAT) {
                    (*view).format = this.format.as_ptr().cast_mut();
                }
                (*view).itemsize = this.scalar_bytes;
                (*view).ndim = this.dimensions;
                (*view).shape = this.shape.as_ptr().cast_mut();
            }
            if asks_for(ffi::PyBUF_STRIDES) {
                (*view).strides = this.strides.as_ptr().cast_mut();
            }
        }
        Ok(())
    }
}
