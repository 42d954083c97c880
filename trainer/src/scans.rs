//! LIDAR scans for Python, copied out of shared memory: a scan that Python keeps does not block the next one.

use ipc_schema::{
    block::{self, BlockError},
    header::MessageHeader,
    pointcloud::{PointcloudLayout, Scan},
    ports::Message,
};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyBytes};

/// The returns of one LIDAR in a tick.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct PointCloud {
    header: MessageHeader,
    /// Dense index of the vehicle within the episode.
    vehicle: u32,
    scan: Py<PyBytes>,
    points: Py<PyBytes>,
}

impl PointCloud {
    pub(crate) fn new(py: Python<'_>, message: &Message) -> PyResult<Self> {
        let header = *message.header();
        let layout = PointcloudLayout::of(&header);
        let bytes = |section| {
            block::view::<u8>(message.payload(), section)
                .map(|bytes| PyBytes::new(py, bytes).unbind())
                .map_err(unreadable)
        };
        let scans: &[Scan] = block::view(message.payload(), layout.scan).map_err(unreadable)?;
        let scan = scans
            .first()
            .ok_or_else(|| PyValueError::new_err("a point cloud without a scan"))?;
        Ok(Self {
            header,
            vehicle: scan.vehicle,
            scan: bytes(layout.scan)?,
            points: bytes(layout.points)?,
        })
    }
}

fn unreadable(error: BlockError) -> PyErr {
    PyValueError::new_err(error.to_string())
}

#[pymethods]
impl PointCloud {
    /// Tick number, 0-based over the run.
    #[getter]
    fn tick(&self) -> u64 {
        self.header.tick
    }

    /// Simulated time at the end of the tick, nanoseconds since the start of the episode.
    #[getter]
    fn sim_time_ns(&self) -> u64 {
        self.header.sim_time_ns
    }

    /// Dense index of the vehicle within the episode.
    #[getter]
    fn vehicle(&self) -> u32 {
        self.vehicle
    }

    /// The bytes of one `Scan`.
    #[getter]
    fn scan(&self, py: Python<'_>) -> Py<PyBytes> {
        self.scan.clone_ref(py)
    }

    /// The bytes of the points, `LidarPoint [count]`.
    #[getter]
    fn points(&self, py: Python<'_>) -> Py<PyBytes> {
        self.points.clone_ref(py)
    }
}
