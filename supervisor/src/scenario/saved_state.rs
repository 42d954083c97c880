//! The time at which a saved state of SUMO was written.

use std::{io::BufReader, path::Path};

use quick_xml::{Reader, events::Event};

use super::{attribute, configuration, input_check};

/// SUMO's time in the saved state `file`, seconds; `None` if it names none, which SUMO itself refuses.
pub(super) fn time_s(file: &Path) -> Option<f64> {
    let mut reader = Reader::from_reader(BufReader::new(input_check::open(file).ok()?));
    let mut buffer = Vec::new();
    loop {
        match reader.read_event_into(&mut buffer).ok()? {
            Event::Start(element) | Event::Empty(element) => {
                return configuration::time_s(&attribute(&element, "time")?);
            }
            Event::Eof => return None,
            _ => buffer.clear(),
        }
    }
}
