//! Reads the options of a `.sumocfg` and the location of a net, before any process starts. A scenario may come from a stranger:
//! docs/decisions/0028-scenario-files-are-not-trusted.md.

pub mod configuration;
pub mod input_check;
mod net;
pub mod options;
mod outputs;
mod saved_state;

use std::{
    fs::File,
    io::Read as _,
    path::{Path, PathBuf},
};

use flate2::read::MultiGzDecoder;
use ipc_schema::run::ScenarioOptions;
use quick_xml::events::BytesStart;

use crate::{config::ConfigError, failure::Exit, install::Install};
use configuration::SumoSetting;
use input_check::{InputCheck, OutputPlace, TRUST};
pub use net::map_info;
use options::OptionEffect;
use outputs::OutputNames;

/// Endings of files that are configurations of SUMO.
const SCENARIO_ENDINGS: [&str; 2] = [".sumocfg", ".cfg"];

/// True if the file name says that the file is a configuration of SUMO: `.sumocfg`, `.sumo.cfg`, `.cfg`.
#[must_use]
pub fn is_scenario(path: &Path) -> bool {
    let name = path.file_name().map(|name| name.to_string_lossy().to_ascii_lowercase());
    name.is_some_and(|name| SCENARIO_ENDINGS.iter().any(|ending| name.ends_with(ending)))
}

/// The options of a `.sumocfg` that the bridge needs.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SumoScenario {
    /// The net.
    pub net_file: PathBuf,
    /// `additional-files`, in order.
    pub additional_files: Vec<PathBuf>,
    /// What SUMO takes from the file unless the run says otherwise.
    pub own: ScenarioOptions,
    /// Its end, if it names one: SUMO's time, seconds.
    pub end_s: Option<f64>,
    /// Outputs that the files place elsewhere, which SUMO writes into the run's directory: each with its place.
    pub moved_outputs: Vec<String>,
}

impl SumoScenario {
    /// The same, beginning at `begin_s` of SUMO's time if it is given.
    #[must_use]
    pub fn beginning_at(mut self, begin_s: Option<f64>) -> Self {
        self.own.begin_s = begin_s.unwrap_or(self.own.begin_s);
        self
    }

    /// Notes in the log of `traffic-bridge` which outputs are not written where the scenario's files say.
    ///
    /// # Errors
    /// The log cannot be written.
    pub fn note_moved_outputs(&self, run_dir: &Path) -> Result<(), Exit> {
        let log = run_dir.join("logs/traffic-bridge.log");
        if self.moved_outputs.is_empty() {
            return Ok(());
        }
        let place = run_dir.join("sumo");
        let notes = self
            .moved_outputs
            .iter()
            .map(|output| format!("{output}: written into {} instead\n", place.display()));
        std::fs::write(&log, notes.collect::<String>()).map_err(|error| Exit::io("write", &log, &error))
    }
}

fn problem(path: &Path, message: impl Into<String>, help: impl Into<String>) -> Exit {
    ConfigError::File {
        path: path.display().to_string(),
        message: message.into(),
        help: help.into(),
    }
    .into()
}

/// The value of attribute `name`, unescaped.
pub(crate) fn attribute(element: &BytesStart<'_>, name: &str) -> Option<String> {
    let attribute = element.try_get_attribute(name).ok().flatten()?;
    attribute
        .normalized_value(quick_xml::XmlVersion::Implicit1_0)
        .ok()
        .map(|value| value.into_owned())
}

/// Reads a `.sumocfg` and checks every file that it names. Unless it is `trusted`, whatever reaches beyond the run's directory is refused.
///
/// # Errors
/// The file is unreadable or malformed, it names no net, a file that it names is missing or no regular file, or an option or an element
/// makes SUMO connect, listen, load another configuration, or write outside the run's directory. Each error has its file and line.
pub fn read(path: &Path, reading: ScenarioReading) -> Result<SumoScenario, Exit> {
    let trusted = reading != ScenarioReading::Checked;
    let unreadable = |reason: String| problem(path, reason, "give the path of an existing .sumocfg");
    if path.exists() {
        input_check::require_regular(path).map_err(unreadable)?;
    }
    let bytes = std::fs::read(path).map_err(|error| unreadable(format!("cannot be read: {error}")))?;
    let configuration = configuration::parse(&bytes, &variable).map_err(|(line, reason)| {
        let help = "correct the file; SUMO's own check: `sumo -c FILE`";
        problem(path, format!("line {line}: not valid XML: {reason}"), help)
    })?;
    let mut reader = ScenarioReader {
        path,
        directory: path.parent().unwrap_or(Path::new(".")),
        scenario: SumoScenario::default(),
        reading,
        check: (!trusted).then(|| InputCheck::new(OutputPlace::RunDirectory)),
        outputs: OutputNames::default(),
        state_s: None,
        begin_s: None,
    };
    if let (Some(line), false) = (configuration.doctype_line, trusted) {
        let help = format!("remove <!DOCTYPE …>, {TRUST}");
        return Err(reader.problem(line, "a document type declaration makes SUMO read other files", help));
    }
    for setting in &configuration.settings {
        reader.read_setting(setting)?;
    }
    let mut scenario = reader.scenario;
    // A saved state brings its time along; `begin` has precedence.
    scenario.own.begin_s = reader.begin_s.or(reader.state_s).unwrap_or(0.0);
    let mut outputs = reader.outputs;
    if let Some(check) = reader.check {
        scenario.moved_outputs = check.moved;
        outputs.add_elements(check.outputs_of_elements);
    }
    scenario.own.renamed_outputs = outputs.renamed().map_err(|message| {
        let help = "give one of the two outputs another name: all outputs of a run are written into one directory";
        problem(path, message, help)
    })?;
    if scenario.net_file.as_os_str().is_empty() {
        return Err(problem(
            path,
            "names no net-file",
            "add <input><net-file value=\"…\"/></input>",
        ));
    }
    Ok(scenario)
}

/// A variable that a `.sumocfg` may use. SUMO itself runs with the `SUMO_HOME` of the installation.
fn variable(name: &str) -> Option<String> {
    let sumo_home = match name {
        "SUMO_HOME" => Install::find().map(|install| install.sumo_home).unwrap_or_default(),
        _ => PathBuf::new(),
    };
    configuration::environment(&sumo_home, name)
}

/// Checks the net of a map with population control, for which SUMO has no directory of outputs.
///
/// # Errors
/// As [`read`]; a net may not write at all.
pub fn check_net(net: &Path, trusted: bool) -> Result<(), Exit> {
    match trusted {
        true => {
            input_check::require_regular(net).map_err(|reason| problem(net, reason, "give a net built by netconvert"))
        }
        false => InputCheck::new(OutputPlace::Anywhere).check_xml(net),
    }
}

/// How much the files of a scenario may do.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum ScenarioReading {
    /// What reaches beyond the run's directory is refused.
    Checked,
    /// The user trusts them: all that SUMO can do without a client.
    Trusted,
    /// The user has started SUMO with them; the run attaches to it.
    Attached,
}

impl ScenarioReading {
    /// The reading of a run with `traffic.trust_scenario` and `traffic.traci_host`.
    #[must_use]
    pub fn of(trusted: bool, traci_host: &str) -> Self {
        match (traci_host.is_empty(), trusted) {
            (false, _) => Self::Attached,
            (true, true) => Self::Trusted,
            (true, false) => Self::Checked,
        }
    }
}

/// Takes over the options of one `.sumocfg`.
struct ScenarioReader<'a> {
    path: &'a Path,
    directory: &'a Path,
    scenario: SumoScenario,
    reading: ScenarioReading,
    /// `None` if the scenario is trusted.
    check: Option<InputCheck>,
    /// Names of all outputs.
    outputs: OutputNames,
    /// Time of the saved state that the scenario begins with, seconds.
    state_s: Option<f64>,
    /// `begin`, if set, seconds.
    begin_s: Option<f64>,
}

impl ScenarioReader<'_> {
    fn problem(&self, line: usize, message: impl std::fmt::Display, help: impl Into<String>) -> Exit {
        problem(self.path, format!("line {line}: {message}"), help)
    }

    /// Takes one option over into the scenario, or refuses it.
    fn read_setting(&mut self, setting: &SumoSetting) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let effect = OptionEffect::of(name);
        match effect {
            OptionEffect::ReadsXml | OptionEffect::Reads => self.read_files(setting, effect)?,
            // No client can connect to a SUMO of the run's own, trusted or not.
            OptionEffect::Listens if value.trim() != "0" && self.reading != ScenarioReading::Attached => {
                return Err(self.problem(
                    *line,
                    format!("remote-port = \"{value}\" makes SUMO wait for a TraCI client, but no client can connect to a run"),
                    "remove remote-port from the .sumocfg, or keep a copy without it; for TraCI scripts set traffic.engine = \"traci\", and \
                     traffic.traci_host = \"localhost\" to attach to a SUMO that you start",
                ));
            }
            _ => self.check_setting(setting, effect)?,
        }
        if effect == OptionEffect::Writes {
            self.outputs.add_option(name, value, *line, self.directory);
        }
        match name.as_str() {
            "step-length" => self.scenario.own.step_s = self.time(setting)?,
            "begin" | "b" => self.begin_s = Some(self.time(setting)?),
            "end" | "e" => self.scenario.end_s = Some(self.time(setting)?).filter(|end_s| *end_s >= 0.0),
            "seed" => self.scenario.own.seed = self.seed(setting)?,
            "random" => self.scenario.own.is_random = configuration::is_true(value),
            "mesosim" if configuration::is_true(value) => {
                return Err(self.problem(
                    *line,
                    "mesosim = true: SUMO's mesoscopic model moves queues of vehicles from segment to segment and gives them no place \
                     within a lane, no lane changes and no lateral position, so there is nothing for mirrors and sensors to follow",
                    "remove mesosim, or run a copy of the .sumocfg without it: the microscopic model takes the same net and routes",
                ));
            }
            _ => {}
        }
        Ok(())
    }

    /// A time in any of SUMO's forms, seconds.
    fn time(&self, setting: &SumoSetting) -> Result<f64, Exit> {
        let SumoSetting { name, value, line } = setting;
        configuration::time_s(value).ok_or_else(|| {
            let message = format!("{name} = \"{value}\" is no time");
            self.problem(*line, message, "write seconds such as 0.5, or H:M:S such as 0:10:0")
        })
    }

    /// SUMO's seed: a whole number of 32 bits with a sign.
    fn seed(&self, setting: &SumoSetting) -> Result<u64, Exit> {
        let SumoSetting { name, value, line } = setting;
        let seed: i32 = value.trim().parse().map_err(|_| {
            let message = format!("{name} = \"{value}\" is no seed of SUMO");
            self.problem(*line, message, "write a whole number from -2147483648 to 2147483647")
        })?;
        Ok(u64::from(seed.cast_unsigned()))
    }

    /// Refuses an option that reaches beyond the run's directory, unless the scenario is trusted.
    fn check_setting(&mut self, setting: &SumoSetting, effect: OptionEffect) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let Some(check) = &mut self.check else { return Ok(()) };
        let (message, help) = match effect {
            OptionEffect::Writes => {
                let outputs = value
                    .split(',')
                    .try_for_each(|output| check.check_output(self.path, name, output));
                match outputs {
                    Ok(()) => return Ok(()),
                    Err(refused) => refused,
                }
            }
            OptionEffect::NamesOutputs if value.contains(['/', '\\', '$']) => (
                format!("{name} = \"{value}\" may place outputs outside the run's directory"),
                format!("use a suffix without \"/\" and \"$\", {TRUST}"),
            ),
            OptionEffect::Validates if !["never", "local", ""].contains(&value.trim()) => (
                format!(
                    "{name} = \"{value}\" makes SUMO load schemas and entities from addresses that its input files name"
                ),
                format!("set it to \"local\" or \"never\", {TRUST}"),
            ),
            OptionEffect::Escapes if !value.trim().is_empty() => (
                format!("{name} = \"{value}\" makes SUMO write or load files outside the run's directory"),
                format!("remove it, {TRUST}"),
            ),
            _ => return Ok(()),
        };
        Err(self.problem(*line, message, help))
    }

    /// Checks the files of an option, and takes the net and the additional files over into the scenario.
    fn read_files(&mut self, setting: &SumoSetting, effect: OptionEffect) -> Result<(), Exit> {
        let SumoSetting { name, value, line } = setting;
        let files = files(value, self.directory);
        for file in &files {
            let shown = file.display();
            if !file.exists() {
                let message = format!("{name} names {shown}, which does not exist");
                let help = "paths in a .sumocfg are relative to the .sumocfg itself";
                return Err(self.problem(*line, message, help));
            }
            input_check::require_regular(file).map_err(|reason| {
                let message = format!("{name} names {shown}, which {reason}");
                self.problem(*line, message, "name a file that SUMO's own tools have written")
            })?;
            if file.extension().is_some_and(|kind| kind == "gz") {
                check_gzip(file, self.check.is_none()).map_err(|error| {
                    let message = format!("{name} names {shown}, which cannot be unpacked: {error}");
                    self.problem(*line, message, "copy or pack the file again; `gzip -t FILE` checks it")
                })?;
            }
            if let (Some(check), OptionEffect::ReadsXml) = (&mut self.check, effect) {
                check.check_xml(file)?;
            }
        }
        self.scenario.own.inputs.extend(files.iter().cloned());
        match name.as_str() {
            "net-file" | "net" | "n" => self.scenario.net_file = files.into_iter().next().unwrap_or_default(),
            "additional-files" | "additional" | "a" => self.scenario.additional_files = files,
            "load-state" => self.state_s = files.first().and_then(|file| saved_state::time_s(file)),
            _ => {}
        }
        Ok(())
    }
}

fn files(value: &str, directory: &Path) -> Vec<PathBuf> {
    value
        .split(',')
        .map(str::trim)
        .filter(|name| !name.is_empty())
        .map(|name| directory.join(name))
        // Processes of a resumed run may have another directory.
        .map(|file| std::path::absolute(&file).unwrap_or(file))
        .collect()
}

/// Reads a gzip file to its end, or to the limit of what it may unpack to. SUMO would stop at damage without naming the file.
fn check_gzip(file: &Path, trusted: bool) -> std::io::Result<u64> {
    let limit = match trusted {
        true => u64::MAX,
        false => input_check::unpacked_limit(file.metadata()?.len()),
    };
    let mut unpacked = MultiGzDecoder::new(File::open(file)?).take(limit);
    let bytes = std::io::copy(&mut unpacked, &mut std::io::sink())?;
    match bytes == limit {
        true => Err(std::io::Error::other(input_check::UNPACKS_TO_TOO_MUCH)),
        false => Ok(bytes),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn write(directory: &Path, name: &str, text: &str) -> PathBuf {
        let path = directory.join(name);
        std::fs::write(&path, text).unwrap();
        path
    }

    fn message(exit: Exit) -> (String, String) {
        match exit {
            Exit::Config(error) => (
                error.to_string(),
                miette::Diagnostic::help(&*error).unwrap().to_string(),
            ),
            other => panic!("{other:?}"),
        }
    }

    const NET: &str = r#"<net><location netOffset="1.0,-2.5" convBoundary="0,0,100,50" origBoundary="0,0,1,1" projParameter="P"/></net>"#;

    #[test]
    fn options_are_read_relative_to_the_file() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "a.net.xml", NET);
        let cfg = write(
            directory.path(),
            "a.sumocfg",
            "<configuration>\n<input>\n<net-file value=\"a.net.xml\"/></input><time><step-length value=\"0.5\"/></time></configuration>",
        );
        let scenario = read(&cfg, ScenarioReading::Checked).unwrap();
        assert_eq!(
            scenario,
            SumoScenario {
                net_file: directory.path().join("a.net.xml"),
                additional_files: Vec::new(),
                own: ScenarioOptions {
                    step_s: 0.5,
                    inputs: vec![directory.path().join("a.net.xml")],
                    ..ScenarioOptions::default()
                },
                end_s: None,
                moved_outputs: Vec::new(),
            }
        );
    }

    #[test]
    fn a_missing_route_file_is_named_with_its_line() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "a.net.xml", NET);
        let cfg = write(
            directory.path(),
            "a.sumocfg",
            "<configuration>\n  <input>\n    <net-file value=\"a.net.xml\"/>\n    <route-files value=\"b.rou.xml\"/>\n  </input>\n</configuration>",
        );
        let (text, help) = message(read(&cfg, ScenarioReading::Checked).unwrap_err());
        assert!(
            text.contains("line 4: route-files names") && text.contains("b.rou.xml"),
            "{text}"
        );
        assert!(help.contains("relative to the .sumocfg"), "{help}");
    }

    /// All of these run in bare SUMO 1.28.
    #[test]
    fn whatever_sumo_reads_is_read() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "my net.net.xml", NET);
        let options = |text: &str| {
            let text = format!("<c><net-file value=\"my net.net.xml\"/>{text}</c>");
            let cfg = write(directory.path(), "run.sumo.cfg", &text);
            assert!(is_scenario(&cfg));
            read(&cfg, ScenarioReading::Checked).map(|scenario| (scenario.own, scenario.end_s))
        };
        let (own, end_s) =
            options("<step-length value=\"0:0:1\"/><seed value=\"-5\"/><b value=\"0:1:0\"/><end>0:2:0.5</end>")
                .unwrap();
        assert_eq!(
            (own.step_s, own.seed, own.begin_s, end_s),
            (1.0, 4_294_967_291, 60.0, Some(120.5))
        );
        assert!(options("<random value=\"1\"/>").unwrap().0.is_random);
        assert_eq!(options("<end value=\"-1\"/>").unwrap().1, None);
        for (text, said) in [
            (
                "\n<seed value=\"4294967291\"/>",
                "line 2: seed = \"4294967291\" is no seed",
            ),
            ("<end value=\"0:5\"/>", "end = \"0:5\" is no time"),
            ("<mesosim value=\"true\"/>", "mesosim = true"),
        ] {
            let refused = options(text).unwrap_err().summary().0;
            assert!(refused.contains(said), "{text}: {refused}");
        }
        assert!(options("<mesosim value=\"false\"/>").is_ok());
    }

    #[test]
    fn a_saved_state_brings_its_time_along_unless_the_scenario_begins_elsewhere() {
        let directory = tempfile::tempdir().unwrap();
        write(directory.path(), "a.net.xml", NET);
        write(
            directory.path(),
            "s.xml",
            "<?xml version=\"1.0\"?>\n<!-- a state -->\n<snapshot version=\"1.28.0\" time=\"600.50\"/>",
        );
        let begin_s = |more: &str| {
            let text = format!("<c><net-file value=\"a.net.xml\"/><load-state value=\"s.xml\"/>{more}</c>");
            read(&write(directory.path(), "a.sumocfg", &text), ScenarioReading::Checked)
                .unwrap()
                .own
                .begin_s
        };
        assert_eq!((begin_s(""), begin_s("<begin value=\"0:0:7\"/>")), (600.5, 7.0));
    }
}
