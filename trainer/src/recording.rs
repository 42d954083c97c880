//! Recordings for Python: chunk by chunk, as bytes.

use std::path::PathBuf;

use pyo3::{exceptions::PyValueError, prelude::*, types::PyBytes};
use recorder::file::{
    RecordingError,
    reader::{RecordedMessage, RecordingReader},
};

/// An opened recording.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct RecordingFile(RecordingReader);

fn refused(error: &RecordingError) -> PyErr {
    let failure = ipc_schema::failure::Failure::from_error(ipc_schema::failure::FailureKind::Config, error);
    PyValueError::new_err(failure.message)
}

/// A message: its topic, its header, and its payload; the header of a line of a log is empty.
type Parts = (&'static str, Py<PyBytes>, Py<PyBytes>);

#[pymethods]
impl RecordingFile {
    /// Opens the recording; one that is damaged opens up to there. Raises `ValueError` if that is not possible.
    #[new]
    fn new(path: PathBuf) -> PyResult<Self> {
        RecordingReader::open(&path).map(Self).map_err(|error| refused(&error))
    }

    /// The versions, the run, the seed and the channels, as JSON.
    #[getter]
    fn start_json(&self) -> PyResult<String> {
        serde_json::to_string(&self.0.start).map_err(|error| PyValueError::new_err(error.to_string()))
    }

    /// Content of an attached file of the run; `None` if the recording lacks it.
    fn attachment<'py>(&self, py: Python<'py>, name: &str) -> Option<Bound<'py, PyBytes>> {
        self.0.attachment(name).map(|content| PyBytes::new(py, content))
    }

    /// Number of chunks.
    #[getter]
    fn chunks(&self) -> usize {
        self.0.chunk_count()
    }

    /// Byte and reason of the damage, if the file was cut off or its structure is damaged.
    #[getter]
    fn damage(&self) -> Option<(u64, String)> {
        self.0.damage().map(|damage| (damage.offset, damage.reason.clone()))
    }

    /// The messages of a chunk in their order. Raises `ValueError` if it is damaged.
    fn chunk(&self, py: Python<'_>, index: usize) -> PyResult<Vec<Parts>> {
        let messages = py.detach(|| self.0.chunk(index)).map_err(|error| refused(&error))?;
        let bytes = |bytes: &[u8]| PyBytes::new(py, bytes).unbind();
        let parts = messages.iter().map(|message| match message {
            RecordedMessage::Channel(message) => (
                message.channel.name(),
                bytes(message.header_bytes()),
                bytes(message.payload()),
            ),
            RecordedMessage::Line(topic, line) => (topic.name(), bytes(&[]), bytes(line.as_bytes())),
        });
        Ok(parts.collect())
    }
}
