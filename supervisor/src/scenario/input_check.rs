//! Checks the files of a scenario before SUMO reads them: what they are, what they unpack to, and what their elements make SUMO do.

use std::{
    collections::BTreeSet,
    fs::{File, FileType},
    io::{self, BufRead as _, BufReader, Read},
    os::unix::fs::FileTypeExt as _,
    path::{Component, Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use quick_xml::{
    Reader,
    events::{BytesStart, Event},
};

use super::{
    attribute,
    outputs::{ElementOutput, plain_path},
    problem,
};
use crate::failure::Exit;

/// Bytes that any packed file may unpack to.
const UNPACKED_FREELY: u64 = 64 << 20;
/// Beyond that, unpacked bytes for each packed one. SUMO's files reach about 30.
const UNPACKED_RATIO: u64 = 200;
/// The error of a file that exceeds both.
pub const UNPACKS_TO_TOO_MUCH: &str = "it unpacks to more than 200 times its size";
/// First bytes of a gzip file.
const GZIP: [u8; 2] = [0x1f, 0x8b];
/// Encodings in which every ASCII character is itself: a check of the ASCII characters sees the same elements as SUMO.
const ENCODINGS: [&str; 6] = ["utf-8", "utf8", "us-ascii", "ascii", "iso-8859-1", "windows-1252"];
/// Names with which SUMO opens no file.
pub(super) const NO_FILE: [&str; 8] = ["", "NUL", "nul", "/dev/null", "-", "stdout", "STDOUT", "stderr"];
/// Elements whose attribute `file` is read.
const READING: [&str; 3] = ["calibrator", "rerouter", "variableSpeedSign"];
/// The advice for a file that the user knows.
pub const TRUST: &str = "or, if you know where the scenario comes from, start with --trust-scenario";

/// Returns why a file cannot stand in a regular file's place: reading a pipe or a device may never end.
///
/// # Errors
/// It is no regular file, or it cannot be looked at.
pub fn require_regular(path: &Path) -> Result<(), String> {
    let kind = std::fs::metadata(path).map_err(|error| error.to_string())?.file_type();
    match kind.is_file() {
        true => Ok(()),
        false => Err(format!("is {}, not a regular file", name_of(kind))),
    }
}

fn name_of(kind: FileType) -> &'static str {
    if kind.is_dir() {
        "a directory"
    } else if kind.is_fifo() {
        "a named pipe"
    } else if kind.is_socket() {
        "a socket"
    } else {
        "a device"
    }
}

/// Most bytes that a file of `packed_bytes` may unpack to.
#[must_use]
pub fn unpacked_limit(packed_bytes: u64) -> u64 {
    UNPACKED_FREELY.max(packed_bytes.saturating_mul(UNPACKED_RATIO))
}

/// Where SUMO writes the outputs of a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OutputPlace {
    /// Into the run's directory: SUMO is started with a prefix.
    RunDirectory,
    /// Wherever the file says.
    Anywhere,
}

/// Checks of the inputs of one scenario.
#[derive(Debug)]
pub struct InputCheck {
    outputs: OutputPlace,
    seen: BTreeSet<PathBuf>,
    /// Files that are being read, each included by the one before.
    open: Vec<PathBuf>,
    /// Outputs that a file places outside the run's directory: each with its place in the file.
    pub moved: Vec<String>,
    /// Outputs that elements of the files name.
    pub outputs_of_elements: Vec<ElementOutput>,
}

impl InputCheck {
    /// No file has been checked.
    #[must_use]
    pub fn new(outputs: OutputPlace) -> Self {
        Self {
            outputs,
            seen: BTreeSet::new(),
            open: Vec::new(),
            moved: Vec::new(),
            outputs_of_elements: Vec::new(),
        }
    }

    /// Checks an XML file with all files that it includes.
    ///
    /// # Errors
    /// It is not a regular file or not XML, it unpacks to too much, or one of its elements reaches beyond the run's directory.
    pub fn check_xml(&mut self, path: &Path) -> Result<(), Exit> {
        let path = path.canonicalize().unwrap_or_else(|_| path.to_owned());
        if self.open.contains(&path) {
            return Err(problem(&path, "includes itself", "remove the <include>"));
        }
        if !self.seen.insert(path.clone()) {
            return Ok(());
        }
        require_regular(&path)
            .map_err(|reason| problem(&path, reason, "name a file that SUMO's own tools have written"))?;
        self.open.push(path.clone());
        let checked = self.check_elements(&path);
        self.open.pop();
        checked
    }

    fn check_elements(&mut self, path: &Path) -> Result<(), Exit> {
        let unreadable = |error: &dyn std::fmt::Display, line: Option<usize>| {
            let place = line.map_or_else(String::new, |line| format!("line {line}: "));
            let help = "correct the file; SUMO's own `sumo` must be able to read it";
            problem(path, format!("{place}cannot be read: {error}"), help)
        };
        let mut reader = Reader::from_reader(BufReader::new(open(path).map_err(|error| unreadable(&error, None))?));
        let (mut buffer, mut has_root) = (Vec::new(), false);
        loop {
            let position = reader.buffer_position();
            buffer.clear();
            match reader.read_event_into(&mut buffer) {
                Ok(Event::Start(element) | Event::Empty(element)) => {
                    has_root = true;
                    self.check_element(path, &element)
                        .map_err(|(message, help)| at_line(path, position, &message, &help))?;
                }
                Ok(Event::DocType(_)) => {
                    let message = "a document type declaration makes SUMO read other files and addresses, or expand entities without end";
                    return Err(at_line(
                        path,
                        position,
                        message,
                        &format!("remove <!DOCTYPE …>, {TRUST}"),
                    ));
                }
                Ok(Event::Decl(declaration)) => {
                    let encoding = declaration.encoding().and_then(Result::ok).unwrap_or_default();
                    if !encoding.is_empty() && !ENCODINGS.contains(&&*encoding.to_ascii_lowercase()) {
                        let message = format!("the encoding {encoding} hides what SUMO reads");
                        return Err(at_line(path, position, &message, "save the file as UTF-8"));
                    }
                }
                // A byte order mark has become three of these letters.
                Ok(Event::Text(text)) if !has_root && !text.trim_matches('_').trim().is_empty() => {
                    return Err(at_line(
                        path,
                        position,
                        "is not XML",
                        "name a file that SUMO's own tools have written",
                    ));
                }
                Ok(Event::Eof) => return Ok(()),
                Ok(_) => {}
                Err(error) => return Err(unreadable(&error, line_at(path, reader.error_position()))),
            }
        }
    }

    /// Checks what an element makes SUMO do. The error is a message and its help.
    fn check_element(&mut self, path: &Path, element: &BytesStart<'_>) -> Result<(), (String, String)> {
        let name = element.local_name();
        let name = name.as_ref();
        if name == "param" {
            let key = attribute(element, "key").unwrap_or_default();
            if key == "file" || key.ends_with(".file") || key.ends_with("output") {
                let value = attribute(element, "value").unwrap_or_default();
                return self.check_output(path, &format!("<param key=\"{key}\">"), &value);
            }
            return Ok(());
        }
        for attribute in element.attributes().with_checks(false) {
            let attribute = attribute.map_err(|error| (error.to_string(), "correct the file".to_owned()))?;
            let local = attribute.key.local_name();
            let which = local.as_ref();
            let is_input = matches!((name, which), ("include", "href") | (_, "edgesFile"))
                || which == "file" && READING.contains(&name);
            if !is_input && !matches!(which, "file" | "dest" | "output") {
                continue;
            }
            let value = attribute
                .normalized_value(quick_xml::XmlVersion::Implicit1_0)
                .map_err(|error| (error.to_string(), "correct the file".to_owned()))?;
            match is_input {
                true => self.check_input(path, &format!("<{name} {which}=…>"), &value)?,
                false => self.check_output(path, &format!("<{name} {which}=…>"), &value)?,
            }
        }
        Ok(())
    }

    /// Checks a file that an element of `path` names.
    fn check_input(&mut self, path: &Path, what: &str, value: &str) -> Result<(), (String, String)> {
        let input = path.parent().unwrap_or(Path::new(".")).join(value);
        // SUMO names a file that does not exist, and opens none with these names.
        if NO_FILE.contains(&value) || !input.exists() {
            return Ok(());
        }
        let wrong = |reason: String| {
            (
                format!("{what} names {}: {reason}", input.display()),
                "correct the path".into(),
            )
        };
        require_regular(&input).map_err(wrong)?;
        self.check_xml(&input).map_err(|exit| {
            let (message, help) = exit.summary();
            (format!("{what}: {message}"), help.unwrap_or_default())
        })
    }

    /// Checks the name of an output.
    ///
    /// # Errors
    /// A message and its help: SUMO would connect to an address, or write outside the run's directory.
    pub fn check_output(&mut self, path: &Path, what: &str, value: &str) -> Result<(), (String, String)> {
        let value = value.trim();
        if NO_FILE.contains(&value) {
            return Ok(());
        }
        let refuse = |effect: &str| {
            let help = format!("give the output a plain file name, {TRUST}");
            Err((format!("{what} = \"{value}\" {effect}"), help))
        };
        if value.contains(':') {
            return refuse("makes SUMO connect to an address and send its output there");
        }
        if value.contains("${") {
            return refuse("puts an environment variable into the name of an output");
        }
        if self.outputs == OutputPlace::Anywhere {
            return refuse("makes a net write a file");
        }
        if what.starts_with('<') {
            let file = plain_path(&path.parent().unwrap_or(Path::new(".")).join(value));
            let named_by = format!("{}: {what}", path.display());
            self.outputs_of_elements.push(ElementOutput { named_by, file });
        }
        let leaves = |part: Component<'_>| matches!(part, Component::RootDir | Component::ParentDir);
        if Path::new(value).components().any(leaves) {
            self.moved.push(format!("{}: {what} = \"{value}\"", path.display()));
        }
        Ok(())
    }
}

fn at_line(path: &Path, position: u64, message: &str, help: &str) -> Exit {
    let place = line_at(path, position).map_or_else(String::new, |line| format!("line {line}: "));
    problem(path, format!("{place}{message}"), help)
}

/// Line of the first character at or after `position` that is not white space, from 1.
fn line_at(path: &Path, position: u64) -> Option<usize> {
    let mut reader = BufReader::new(open(path).ok()?);
    let (mut line, mut left) = (1, position);
    loop {
        let bytes = reader.fill_buf().ok()?;
        if bytes.is_empty() {
            return Some(line);
        }
        for byte in bytes {
            if left == 0 && !byte.is_ascii_whitespace() {
                return Some(line);
            }
            line += usize::from(*byte == b'\n');
            left = left.saturating_sub(1);
        }
        let read = bytes.len();
        reader.consume(read);
    }
}

/// Opens a file, which may be packed, as ASCII: every other byte becomes `_`.
pub(super) fn open(path: &Path) -> io::Result<AsciiReader> {
    let mut file = File::open(path)?;
    let packed_bytes = file.metadata()?.len();
    let mut start = Vec::new();
    (&mut file).take(2).read_to_end(&mut start)?;
    let is_packed = start == GZIP;
    let whole = io::Cursor::new(start).chain(file);
    Ok(match is_packed {
        true => AsciiReader {
            inner: Box::new(MultiGzDecoder::new(BufReader::new(whole))),
            left: unpacked_limit(packed_bytes),
        },
        false => AsciiReader {
            inner: Box::new(whole),
            left: u64::MAX,
        },
    })
}

/// A file as ASCII, up to a limit.
pub(super) struct AsciiReader {
    inner: Box<dyn Read>,
    /// Bytes that may still come.
    left: u64,
}

impl Read for AsciiReader {
    fn read(&mut self, buffer: &mut [u8]) -> io::Result<usize> {
        let read = self.inner.read(buffer)?;
        self.left = self
            .left
            .checked_sub(read as u64)
            .ok_or_else(|| io::Error::other(UNPACKS_TO_TOO_MUCH))?;
        for byte in &mut buffer[..read] {
            match byte {
                0 => return Err(io::Error::other("it has a zero byte: it is not UTF-8")),
                128.. => *byte = b'_',
                _ => {}
            }
        }
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use std::io::Write as _;

    use super::*;

    /// Checks `text` as a file of a scenario whose outputs have the place `outputs`.
    fn check(outputs: OutputPlace, bytes: &[u8]) -> Result<Vec<String>, String> {
        let directory = tempfile::tempdir().unwrap();
        let path = directory.path().join("a.add.xml");
        std::fs::write(&path, bytes).unwrap();
        let mut check = InputCheck::new(outputs);
        check.check_xml(&path).map_err(|exit| exit.summary().0)?;
        Ok(check.moved)
    }

    fn confined(text: &str) -> Result<Vec<String>, String> {
        check(OutputPlace::RunDirectory, text.as_bytes())
    }

    #[test]
    fn ordinary_files_of_any_ascii_encoding_pass() {
        let text =
            "<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?>\n<add><poly id=\"Stra\u{df}e\" shape=\"0,0\"/></add>";
        assert_eq!(confined(text), Ok(vec![]));
        assert_eq!(check(OutputPlace::RunDirectory, b"\xef\xbb\xbf<add/>"), Ok(vec![]));
        assert_eq!(check(OutputPlace::RunDirectory, b"<add name='\xe4'/>"), Ok(vec![]));
    }

    #[test]
    fn outputs_that_leave_the_directory_are_moved_and_addresses_refused() {
        assert_eq!(confined("<a><e1Detector file=\"out.xml\"/></a>"), Ok(vec![]));
        let moved = confined("<a><e1Detector file=\"/etc/x\"/><timedEvent dest='a/../../y'/></a>").unwrap();
        assert!(
            moved.len() == 2 && moved[0].contains("<e1Detector file=…> = \"/etc/x\""),
            "{moved:?}"
        );
        for text in [
            "<a>\n<edgeData file=\"example.com:80\"/></a>",
            "<a>\n<edgeData file='example.com&#58;80'/></a>",
            "<a>\n<vType><param key=\"device.ssm.file\" value=\"example.com:80\"/></vType></a>",
            "<a>\n<routeProbe x:file=\"[::1]:80\"/></a>",
        ] {
            let said = confined(text).unwrap_err();
            assert!(said.contains("line 2") && said.contains("connect"), "{text}: {said}");
        }
        let said = check(OutputPlace::Anywhere, b"<net><e1Detector file=\"a.xml\"/></net>").unwrap_err();
        assert!(said.contains("makes a net write a file"), "{said}");
        assert_eq!(
            check(OutputPlace::Anywhere, b"<net><param key='file' value='NUL'/></net>"),
            Ok(vec![])
        );
    }

    #[test]
    fn entities_and_hidden_encodings_are_refused() {
        let bomb = "<?xml version=\"1.0\"?>\n<!DOCTYPE a [<!ENTITY b \"&c;&c;\">]><a>&b;</a>";
        let said = confined(bomb).unwrap_err();
        assert!(said.contains("line 2") && said.contains("document type"), "{said}");
        assert!(confined("<a>&#x26;</a>").is_ok());
        let wide: Vec<u8> = "<a/>".encode_utf16().flat_map(u16::to_le_bytes).collect();
        assert!(
            check(OutputPlace::RunDirectory, &wide)
                .unwrap_err()
                .contains("zero byte")
        );
        let said = confined("<?xml version=\"1.0\" encoding=\"IBM037\"?><a/>").unwrap_err();
        assert!(said.contains("IBM037"), "{said}");
        assert!(confined("L\u{6f}plain text").unwrap_err().contains("not XML"));
    }

    #[test]
    fn a_packed_file_may_not_unpack_to_hundreds_of_times_its_size() {
        let pack = |text: &mut dyn Read| {
            let mut encoder = flate2::write::GzEncoder::new(Vec::new(), flate2::Compression::fast());
            io::copy(text, &mut encoder).unwrap();
            encoder.finish().unwrap()
        };
        assert_eq!(check(OutputPlace::RunDirectory, &pack(&mut &b"<a/>"[..])), Ok(vec![]));
        let spaces = io::repeat(b' ').take(UNPACKED_FREELY + 1);
        let bomb = pack(&mut (&b"<a>"[..]).chain(spaces).chain(&b"</a>"[..]));
        let said = check(OutputPlace::RunDirectory, &bomb).unwrap_err();
        assert!(said.contains("unpacks to more than"), "{said}");
    }

    #[test]
    fn what_is_no_regular_file_is_refused_by_its_kind() {
        let directory = tempfile::tempdir().unwrap();
        let pipe = directory.path().join("pipe");
        rustix::fs::mknodat(
            rustix::fs::CWD,
            &pipe,
            rustix::fs::FileType::Fifo,
            rustix::fs::Mode::RUSR,
            0,
        )
        .unwrap();
        for (path, kind) in [
            (&*pipe, "a named pipe"),
            (Path::new("/dev/zero"), "a device"),
            (directory.path(), "a directory"),
        ] {
            let mut check = InputCheck::new(OutputPlace::RunDirectory);
            let said = check.check_xml(path).unwrap_err().summary().0;
            assert!(said.contains(&format!("is {kind}, not a regular file")), "{said}");
            let outer = directory.path().join("outer.xml");
            write!(
                File::create(&outer).unwrap(),
                "<a>\n<include href=\"{}\"/></a>",
                path.display()
            )
            .unwrap();
            let said = check.check_xml(&outer).unwrap_err().summary().0;
            assert!(
                said.contains("line 2: <include href=…>") && said.contains(kind),
                "{said}"
            );
        }
    }

    #[test]
    fn a_file_that_includes_itself_is_refused() {
        let directory = tempfile::tempdir().unwrap();
        std::fs::write(directory.path().join("a.xml"), "<a><include href='b.xml'/></a>").unwrap();
        std::fs::write(directory.path().join("b.xml"), "<b>\n<include href='./a.xml'/></b>").unwrap();
        let mut check = InputCheck::new(OutputPlace::RunDirectory);
        let said = check
            .check_xml(&directory.path().join("a.xml"))
            .unwrap_err()
            .summary()
            .0;
        assert!(
            said.contains("a.xml: line 1") && said.contains("includes itself"),
            "{said}"
        );
    }
}
