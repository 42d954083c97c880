//! Reads a `.sumocfg` into its options exactly as SUMO does: as an attribute `value` or `v`, or as the text of an element, in UTF-8 or
//! ISO-8859-1, with `${NAME}` replaced by variables of the environment. No other program of a run parses a `.sumocfg`.

use std::{borrow::Cow, path::Path};

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

/// A variable of the environment by its name.
pub type Variables<'a> = &'a dyn Fn(&str) -> Option<String>;

/// The environment of this process, with `SUMO_HOME` as `traffic-bridge` sets it.
#[must_use]
pub fn environment(sumo_home: &Path, name: &str) -> Option<String> {
    match name {
        "SUMO_HOME" => Some(sumo_home.to_string_lossy().into_owned()),
        name => std::env::var(name).ok(),
    }
}

/// `text` with every `${NAME}` replaced. As in SUMO a variable that is not set is empty.
#[must_use]
pub fn with_variables(text: &str, variables: Variables<'_>) -> String {
    let (mut replaced, mut rest) = (String::new(), text);
    while let Some((before, name, after)) = rest
        .split_once("${")
        .and_then(|(before, tail)| tail.split_once('}').map(|(name, after)| (before, name, after)))
    {
        replaced.push_str(before);
        replaced.push_str(&variables(name).unwrap_or_default());
        rest = after;
    }
    replaced + rest
}

/// A time as SUMO writes it: seconds, `H:M:S` or `D:H:M:S`. In seconds, to the millisecond that SUMO counts in.
#[must_use]
pub fn time_s(text: &str) -> Option<f64> {
    let parts: Vec<&str> = text.split(':').collect();
    let number = |part: &str| part.parse::<f64>().ok().filter(|number| number.is_finite());
    let seconds = match parts.as_slice() {
        [seconds] => number(seconds)?,
        [parts @ .., seconds] if (2..=3).contains(&parts.len()) => {
            let whole: Vec<f64> = parts.iter().map(|part| number(part)).collect::<Option<_>>()?;
            let [days, hours, minutes] = match *whole.as_slice() {
                [hours, minutes] => [0.0, hours, minutes],
                [days, hours, minutes] => [days, hours, minutes],
                _ => return None,
            };
            ((days * 24.0 + hours) * 60.0 + minutes) * 60.0 + number(seconds)?
        }
        _ => return None,
    };
    Some((seconds * 1000.0).round() / 1000.0)
}

/// True if `text` is one of SUMO's words for true.
#[must_use]
pub fn is_true(text: &str) -> bool {
    matches!(
        text.trim().to_ascii_lowercase().as_str(),
        "true" | "t" | "1" | "yes" | "on" | "x" | "+"
    )
}

/// The text of a file that declares its encoding: UTF-8, or one byte for each letter.
fn decoded(bytes: &[u8]) -> Result<Cow<'_, str>, String> {
    let bytes = bytes.strip_prefix(b"\xef\xbb\xbf").unwrap_or(bytes);
    let first_line = String::from_utf8_lossy(&bytes[..bytes.len().min(200)]).to_ascii_lowercase();
    let declaration = first_line.split_once("?>").map_or("", |(declaration, _)| declaration);
    if ["iso-8859-1", "latin1", "windows-1252"]
        .iter()
        .any(|name| declaration.contains(name))
    {
        return Ok(Cow::Owned(bytes.iter().copied().map(char::from).collect()));
    }
    std::str::from_utf8(bytes).map(Cow::Borrowed).map_err(|error| {
        format!(
            "{error}: save the file as UTF-8, or declare its encoding: <?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>"
        )
    })
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

/// Reads the content of a `.sumocfg`.
///
/// # Errors
/// It is not XML, or not in the encoding that it declares: the line and the reason.
pub fn parse(bytes: &[u8], variables: Variables<'_>) -> Result<SumoConfiguration, (usize, String)> {
    let text = decoded(bytes).map_err(|reason| (1, reason))?;
    let mut found = parse_text(&text)?;
    for setting in &mut found.settings {
        setting.value = with_variables(&setting.value, variables);
    }
    Ok(found)
}

fn parse_text(text: &str) -> Result<SumoConfiguration, (usize, String)> {
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

    fn variable(name: &str) -> Option<String> {
        (name == "WHERE").then(|| "/data".to_owned())
    }

    fn parse(text: &str) -> Result<SumoConfiguration, (usize, String)> {
        super::parse(text.as_bytes(), &variable)
    }

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

    /// Each was tried with SUMO 1.28.
    #[test]
    fn times_are_read_as_sumo_reads_them() {
        let times = [
            ("5", Some(5.0)),
            ("0.25", Some(0.25)),
            ("-1", Some(-1.0)),
            ("1e1", Some(10.0)),
            ("0:0:1", Some(1.0)),
            ("0:0:20.5", Some(20.5)),
            ("1:2:3:4", Some(93_784.0)),
            ("0:5", None),
            ("5s", None),
            ("", None),
            ("1:2:3:4:5", None),
        ];
        for (text, seconds) in times {
            assert_eq!(time_s(text), seconds, "{text}");
        }
    }

    #[test]
    fn variables_of_the_environment_are_replaced_and_missing_ones_are_empty() {
        let read = settings("<c><net-file value=\"${WHERE}/${NONE}a b.net.xml\"/><x>${WHERE</x></c>");
        assert_eq!(
            (read[0].1.as_str(), read[1].1.as_str()),
            ("/data/a b.net.xml", "${WHERE")
        );
    }

    #[test]
    fn letters_of_one_byte_are_read_where_the_file_declares_them() {
        let declared =
            b"<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>\n<c><net-file value=\"stra\xdfe.net.xml\"/></c>";
        let read = super::parse(declared, &variable).unwrap();
        assert_eq!(read.settings[0].value, "stra\u{df}e.net.xml");
        let (line, reason) = super::parse(b"<c><net-file value=\"stra\xdfe\"/></c>", &variable).unwrap_err();
        assert!(line == 1 && reason.contains("save the file as UTF-8"), "{reason}");
    }

    #[test]
    fn a_document_type_and_a_mistake_have_their_line() {
        assert_eq!(parse("\n<!DOCTYPE c []>\n<c/>").unwrap().doctype_line, Some(2));
        assert_eq!(parse("<c>\n<a></b></c>").unwrap_err().0, 2);
        assert_eq!(parse("<c>\n<a>&unknown;</a></c>").unwrap_err().0, 2);
    }
}
