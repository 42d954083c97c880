//! Writes a map as OpenStreetMap's XML.

use std::io::{self, Write};

use super::elements::{OsmElement, OsmPlace};

const UNITS_PER_DEGREE: u32 = 10_000_000;

/// Writes elements one by one.
pub(super) struct OsmXml<W: Write> {
    output: W,
}

impl<W: Write> OsmXml<W> {
    /// Begins a map.
    ///
    /// # Errors
    /// The output cannot be written.
    pub(super) fn begin(mut output: W) -> io::Result<Self> {
        output
            .write_all(b"<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n<osm version=\"0.6\" generator=\"caraware\">\n")?;
        Ok(Self { output })
    }

    /// Writes an element.
    ///
    /// # Errors
    /// The output cannot be written.
    pub(super) fn write(&mut self, element: &OsmElement<'_>) -> io::Result<()> {
        match element {
            OsmElement::Node {
                id,
                place,
                version,
                tags,
            } => {
                self.open("node", *id, *version)?;
                self.place(*place)?;
                if tags.is_empty() {
                    return self.output.write_all(b"/>\n");
                }
                self.output.write_all(b">\n")?;
                self.close("node", tags)
            }
            OsmElement::Way {
                id,
                nodes,
                version,
                tags,
            } => {
                self.open("way", *id, *version)?;
                self.output.write_all(b">\n")?;
                for node in *nodes {
                    writeln!(self.output, "  <nd ref=\"{node}\"/>")?;
                }
                self.close("way", tags)
            }
            OsmElement::Relation {
                id,
                members,
                version,
                tags,
            } => {
                self.open("relation", *id, *version)?;
                self.output.write_all(b">\n")?;
                for member in *members {
                    write!(
                        self.output,
                        "  <member type=\"{}\" ref=\"{}\" role=\"",
                        member.kind.name(),
                        member.id
                    )?;
                    self.text(member.role)?;
                    self.output.write_all(b"\"/>\n")?;
                }
                self.close("relation", tags)
            }
        }
    }

    /// Ends the map.
    ///
    /// # Errors
    /// The output cannot be written.
    pub(super) fn finish(mut self) -> io::Result<W> {
        self.output.write_all(b"</osm>\n")?;
        self.output.flush()?;
        Ok(self.output)
    }

    fn open(&mut self, name: &str, id: i64, version: Option<i32>) -> io::Result<()> {
        write!(self.output, " <{name} id=\"{id}\" visible=\"true\"")?;
        match version {
            Some(version) => write!(self.output, " version=\"{version}\""),
            None => Ok(()),
        }
    }

    fn place(&mut self, place: OsmPlace) -> io::Result<()> {
        for (name, value) in [("lat", place.latitude), ("lon", place.longitude)] {
            let sign = if value < 0 { "-" } else { "" };
            let size = value.unsigned_abs();
            let (degrees, decimals) = (size / UNITS_PER_DEGREE, size % UNITS_PER_DEGREE);
            write!(self.output, " {name}=\"{sign}{degrees}.{decimals:07}\"")?;
        }
        Ok(())
    }

    fn close(&mut self, name: &str, tags: &[(&str, &str)]) -> io::Result<()> {
        for (key, value) in tags {
            self.output.write_all(b"  <tag k=\"")?;
            self.text(key)?;
            self.output.write_all(b"\" v=\"")?;
            self.text(value)?;
            self.output.write_all(b"\"/>\n")?;
        }
        writeln!(self.output, " </{name}>")
    }

    /// Writes the value of an attribute. Controls that XML does not have become U+FFFD.
    fn text(&mut self, text: &str) -> io::Result<()> {
        let mut written = 0;
        for (at, letter) in text.char_indices() {
            let name = match letter {
                '&' => "&amp;",
                '<' => "&lt;",
                '>' => "&gt;",
                '"' => "&quot;",
                '\t' => "&#9;",
                '\n' => "&#10;",
                '\r' => "&#13;",
                '\u{0}'..='\u{1f}' | '\u{fffe}' | '\u{ffff}' => "\u{fffd}",
                _ => continue,
            };
            self.output.write_all(&text.as_bytes()[written..at])?;
            self.output.write_all(name.as_bytes())?;
            written = at + letter.len_utf8();
        }
        self.output.write_all(&text.as_bytes()[written..])
    }
}
