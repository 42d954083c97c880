//! Reading SUMO's XML, plain or gzip, element by element.

use std::{
    io::Read as _,
    path::{Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use quick_xml::{
    Reader, XmlVersion,
    events::{BytesStart, Event},
};

use super::SceneError;

/// File and line of an element, for messages.
#[derive(Debug, Clone)]
pub(super) struct ElementPosition<'a> {
    path: &'a Path,
    text: &'a str,
    position: u64,
}

impl ElementPosition<'_> {
    fn line(&self) -> usize {
        let end = usize::try_from(self.position)
            .unwrap_or(usize::MAX)
            .min(self.text.len());
        self.text.as_bytes()[..end]
            .iter()
            .filter(|byte| **byte == b'\n')
            .count()
            + 1
    }

    /// An error for an attribute whose value is not usable.
    pub(super) fn value(&self, what: &'static str, value: &str) -> SceneError {
        SceneError::Value {
            path: self.path.into(),
            line: self.line(),
            what,
            value: value.chars().take(60).collect(),
        }
    }
}

/// The begin or the end of an element.
pub(super) enum XmlTag<'a> {
    /// An element begins.
    Open(&'a BytesStart<'a>),
    /// The element of this name ends.
    Close(&'a str),
}

fn read(path: &Path) -> Result<String, SceneError> {
    let unreadable = |source| SceneError::Unreadable {
        path: PathBuf::from(path),
        source,
    };
    let bytes = std::fs::read(path).map_err(unreadable)?;
    let mut text = String::new();
    if bytes.starts_with(&[0x1f, 0x8b]) {
        MultiGzDecoder::new(bytes.as_slice())
            .read_to_string(&mut text)
            .map_err(unreadable)?;
        return Ok(text);
    }
    // Ids in other encodings do not matter.
    Ok(String::from_utf8(bytes).unwrap_or_else(|error| String::from_utf8_lossy(error.as_bytes()).into_owned()))
}

/// Calls `visit` at the begin and end of every element.
pub(super) fn for_each_tag(
    path: &Path,
    mut visit: impl FnMut(XmlTag<'_>, &ElementPosition<'_>) -> Result<(), SceneError>,
) -> Result<(), SceneError> {
    let text = read(path)?;
    let mut reader = Reader::from_str(&text);
    let place = |position| ElementPosition {
        path,
        text: &text,
        position,
    };
    loop {
        let position = reader.buffer_position();
        match reader.read_event() {
            Ok(Event::Start(element)) => visit(XmlTag::Open(&element), &place(position))?,
            Ok(Event::Empty(element)) => {
                visit(XmlTag::Open(&element), &place(position))?;
                visit(XmlTag::Close(element.local_name().as_ref()), &place(position))?;
            }
            Ok(Event::End(element)) => visit(XmlTag::Close(element.local_name().as_ref()), &place(position))?,
            Ok(Event::Eof) => return Ok(()),
            Ok(_) => {}
            Err(error) => {
                return Err(SceneError::Malformed {
                    path: path.into(),
                    line: place(reader.error_position()).line(),
                    reason: error.to_string(),
                });
            }
        }
    }
}

/// The value of an attribute, if it exists and is readable.
pub(super) fn attribute(element: &BytesStart<'_>, name: &str) -> Option<String> {
    let attribute = element.try_get_attribute(name).ok()??;
    Some(attribute.normalized_value(XmlVersion::Implicit1_0).ok()?.into_owned())
}

/// The `shape` attribute: "x,y x,y" or "x,y,z x,y,z", metres (or degrees). Without z, z is not a number.
pub(super) fn points(text: &str, place: &ElementPosition<'_>) -> Result<Vec<[f64; 3]>, SceneError> {
    let point = |word: &str| {
        let mut numbers = word
            .split(',')
            .map(|number| number.parse().ok().filter(|n: &f64| n.is_finite()));
        let point = [
            numbers.next()??,
            numbers.next()??,
            numbers.next().unwrap_or(Some(f64::NAN))?,
        ];
        numbers.next().is_none().then_some(point)
    };
    text.split_whitespace()
        .map(|word| point(word).ok_or_else(|| place.value("shape", word)))
        .collect()
}
