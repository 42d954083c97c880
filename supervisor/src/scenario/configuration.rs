//! Reads a `.sumocfg` into its options exactly as SUMO does: as an attribute `value` or `v`, or as the text of an element.

use quick_xml::{
    Reader, XmlVersion,
    events::{BytesRef, BytesStart, Event},
};

/// An option that a `.sumocfg` sets.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct SumoSetting {
    /// Name or synonym.
    pub name: String,
    /// Value.
    pub value: String,
    /// Line, from 1.
    pub line: usize,
}

/// A `.sumocfg` as it is read.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct SumoConfiguration {
    /// The options in order.
    pub settings: Vec<SumoSetting>,
    /// Line of a document type declaration, if there is one.
    pub doctype_line: Option<usize>,
}

/// Collects options. SUMO keeps the name of the newest element until a text has been its value.
#[derive(Default)]
struct OptionCollector {
    found: SumoConfiguration,
    element: String,
    text: String,
    text_line: usize,
}

impl OptionCollector {
    fn begin(&mut self, element: &BytesStart<'_>, line: usize) -> Result<(), quick_xml::Error> {
        element.name().as_ref().clone_into(&mut self.element);
        self.text.clear();
        for attribute in element.attributes() {
            let attribute = attribute?;
            if matches!(attribute.key.as_ref(), "value" | "v") {
                self.found.settings.push(SumoSetting {
                    name: self.element.clone(),
                    value: attribute.normalized_value(XmlVersion::Implicit1_0)?.into_owned(),
                    line,
                });
            }
        }
        Ok(())
    }

    fn add_text(&mut self, text: &str, line: usize) {
        if self.text.trim().is_empty() {
            self.text_line = line;
        }
        self.text.push_str(text);
    }

    fn add_reference(&mut self, reference: &BytesRef<'_>, line: usize) -> Result<(), quick_xml::Error> {
        let resolved = match reference.resolve_char_ref()? {
            Some(letter) => letter.to_string(),
            None => quick_xml::escape::unescape(&format!("&{};", &**reference))?.into_owned(),
        };
        self.add_text(&resolved, line);
        Ok(())
    }

    fn end(&mut self) {
        if !self.element.is_empty() && !self.text.trim().is_empty() {
            self.found.settings.push(SumoSetting {
                name: std::mem::take(&mut self.element),
                value: std::mem::take(&mut self.text).trim().to_owned(),
                line: self.text_line,
            });
        }
    }
}

/// Reads the text of a `.sumocfg`.
///
/// # Errors
/// It is not XML: the line and the reason.
pub fn parse(text: &str) -> Result<SumoConfiguration, (usize, String)> {
    let mut reader = Reader::from_str(text);
    let mut collector = OptionCollector::default();
    loop {
        let line = line_of(text, reader.buffer_position());
        let event = reader.read_event().map_err(|error| (line, error.to_string()))?;
        let read = match &event {
            Event::Start(element) | Event::Empty(element) => collector.begin(element, line),
            Event::End(_) => {
                collector.end();
                Ok(())
            }
            Event::Text(text) => {
                collector.add_text(&text.xml10_content(), line);
                Ok(())
            }
            Event::CData(text) => {
                collector.add_text(&text.xml10_content(), line);
                Ok(())
            }
            Event::GeneralRef(reference) => collector.add_reference(reference, line),
            Event::DocType(_) => {
                collector.found.doctype_line = Some(line);
                Ok(())
            }
            Event::Eof => return Ok(collector.found),
            Event::Comment(_) | Event::Decl(_) | Event::PI(_) => Ok(()),
        };
        read.map_err(|error| (line, error.to_string()))?;
    }
}

/// Line of the first character at or after `position` that is not white space, from 1.
fn line_of(text: &str, position: u64) -> usize {
    let end = usize::try_from(position).unwrap_or(usize::MAX).min(text.len());
    let start = text.as_bytes()[end..]
        .iter()
        .take_while(|byte| byte.is_ascii_whitespace())
        .count();
    text.as_bytes()[..end + start]
        .iter()
        .filter(|byte| **byte == b'\n')
        .count()
        + 1
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(text: &str) -> Vec<(String, String, usize)> {
        let read = parse(text).unwrap();
        read.settings.into_iter().map(|s| (s.name, s.value, s.line)).collect()
    }

    /// Each form was tried with SUMO 1.28: all of them open the port.
    #[test]
    fn an_option_is_found_in_every_form_that_sumo_reads() {
        for form in [
            "<c>\n<remote-port value=\"88\"/></c>",
            "<c>\n<remote-port v='88'/></c>",
            "<c>\n<x><remote-port>88</remote-port></x></c>",
            "<c>\n<remote-port><![CDATA[88]]></remote-port></c>",
            "<c>\n<remote-port>&#56;8</remote-port></c>",
            "<c>\n<remote-port value=\"&#x38;8\"/></c>",
        ] {
            assert_eq!(settings(form), [("remote-port".into(), "88".into(), 2)], "{form}");
        }
    }

    #[test]
    fn a_document_type_and_a_mistake_have_their_line() {
        assert_eq!(parse("\n<!DOCTYPE c []>\n<c/>").unwrap().doctype_line, Some(2));
        assert_eq!(parse("<c>\n<a></b></c>").unwrap_err().0, 2);
        assert_eq!(parse("<c>\n<a>&unknown;</a></c>").unwrap_err().0, 2);
    }
}
