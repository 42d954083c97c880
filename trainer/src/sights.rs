//! Images, radar scans, lane positions and road users for Python, copied out of shared memory: one that Python keeps does not block the next one.

use ipc_schema::{
    block::{self, BlockError, Section},
    header::MessageHeader,
    image::ImageLayout,
    lane_position::LanePositionLayout,
    ports::Message,
    radar::RadarLayout,
    services::Channel,
    world::WorldLayout,
};
use pyo3::{exceptions::PyValueError, prelude::*, types::PyBytes};

/// What one camera or one radar has sent at a tick, or where all road users are.
#[pyclass(frozen, module = "caraware._native")]
pub(crate) struct SightMessage {
    header: MessageHeader,
    sections: Vec<Py<PyBytes>>,
}

impl SightMessage {
    pub(crate) fn new(py: Python<'_>, channel: Channel, message: &Message) -> PyResult<Self> {
        let header = *message.header();
        let sections: Vec<Section> = match channel {
            Channel::Image => {
                let layout = ImageLayout::of(&header);
                vec![layout.head, layout.planes, layout.objects, layout.events]
            }
            Channel::LanePosition => {
                let layout = LanePositionLayout::of(&header);
                vec![layout.sumo_time_s, layout.positions]
            }
            Channel::World => vec![WorldLayout::of(&header).states],
            _ => {
                let layout = RadarLayout::of(&header);
                vec![layout.scan, layout.detections]
            }
        };
        let bytes = |section| {
            block::view::<u8>(message.payload(), section)
                .map(|bytes| PyBytes::new(py, bytes).unbind())
                .map_err(|error: BlockError| PyValueError::new_err(error.to_string()))
        };
        Ok(Self {
            header,
            sections: sections.into_iter().map(bytes).collect::<PyResult<_>>()?,
        })
    }
}

#[pymethods]
impl SightMessage {
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

    /// The bytes of each section, in the order of the message.
    #[getter]
    fn sections(&self, py: Python<'_>) -> Vec<Py<PyBytes>> {
        self.sections.iter().map(|section| section.clone_ref(py)).collect()
    }
}
