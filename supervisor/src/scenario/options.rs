//! What SUMO does with an option of a `.sumocfg`: the table of all options that name files, ports or other configurations.
//!
//! An option that is not listed holds a plain value. The test `scenario_trust` compares the table with the options of the installed SUMO,
//! so a new option that names a file has to be added here first.

/// What SUMO does with the value of an option.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum OptionEffect {
    /// Reads these XML files.
    ReadsXml,
    /// Reads these files, which may be other than XML.
    Reads,
    /// Writes this file. The run's own `--output-prefix` puts it into the run's directory.
    Writes,
    /// Makes the value a part of the names of outputs.
    NamesOutputs,
    /// Chooses how XML is validated. Some choices load schemas from the network.
    Validates,
    /// Reads another configuration, or writes past the prefix.
    Escapes,
    /// Opens a port on all interfaces and waits for a client before the first step.
    Listens,
    /// Is of no effect in a run: the run sets the option itself, or only SUMO's window uses it.
    Unused,
    /// Is a plain value: SUMO opens nothing.
    Plain,
}

use OptionEffect::{Escapes, Listens, NamesOutputs, Plain, Reads, ReadsXml, Unused, Validates, Writes};

/// Options with the same effect: each by its name and its synonyms.
type OptionGroup = (OptionEffect, &'static [&'static [&'static str]]);

/// All options of SUMO that name files, ports or configurations, and those of its output section that take any text.
#[rustfmt::skip]
pub const SUMO_OPTIONS: &[OptionGroup] = &[
    (ReadsXml, &[
        &["net-file", "n", "net"], &["route-files", "r", "routes"], &["additional-files", "a", "additional"],
        &["weight-files", "w", "weights"], &["load-state"], &["device.fcd-replay.files", "device.fcd-replay.file"],
    ]),
    (Reads, &[
        &["fcd-output.filter-edges.input-file"], &["device.ssm.filter-edges.input-file"], &["astar.all-distances"],
        &["astar.landmark-distances"],
    ]),
    (Writes, &[
        &["netstate-dump", "ndump", "netstate", "netstate-output"], &["emission-output"], &["battery-output"], &["elechybrid-output"],
        &["chargingstations-output"], &["overheadwiresegments-output"], &["substations-output"], &["fcd-output"],
        &["person-fcd-output", "person-fcd"], &["full-output"], &["queue-output"], &["amitran-output"],
        &["summary-output", "summary"], &["person-summary-output"], &["tripinfo-output", "tripinfo"],
        &["personinfo-output", "personinfo"], &["vehroute-output", "vehroutes"], &["personroute-output", "personroutes"],
        &["link-output"], &["railsignal-block-output"], &["railsignal-vehicle-output"], &["bt-output"], &["lanechange-output"],
        &["stop-output"], &["collision-output"], &["edgedata-output"], &["lanedata-output"],
        &["statistic-output", "statistics-output"], &["deadlock-output"], &["save-state.prefix"], &["save-state.files"],
        &["pedestrian.jupedsim.wkt"], &["pedestrian.jupedsim.py"], &["device.rerouting.output"], &["device.ssm.file"],
        &["device.toc.file"], &["device.taxi.dispatch-algorithm.output"], &["device.taxi.idle-algorithm.output"],
        &["log", "l", "log-file"], &["message-log"], &["error-log"],
    ]),
    (NamesOutputs, &[&["output-suffix"], &["save-state.suffix"]]),
    (Validates, &[&["xml-validation", "X"], &["xml-validation.net"], &["xml-validation.routes"]]),
    (Escapes, &[
        &["configuration-file", "c", "configuration"], &["save-configuration", "C", "save-config"], &["save-template"], &["save-schema"],
        // SUMO writes a file for each step, and forgets the prefix.
        &["vtk-output"],
    ]),
    (Listens, &[&["remote-port"]]),
    (Unused, &[
        &["output-prefix"], &["gui-settings-file", "g"], &["edgedata-files", "data-files", "m"], &["alternative-net-file", "N"],
        &["selection-file"], &["gui-testing.setting-output"],
    ]),
    (Plain, &[
        &["output.compression"], &["output.format"], &["output.column-header"], &["output.column-separator"],
        &["emission-output.attributes"], &["fcd-output.params"], &["fcd-output.attributes"], &["fcd-output.filter-shapes"],
        &["save-state.times"], &["num-clients"], &["phemlight-path"],
    ]),
];

impl OptionEffect {
    /// The effect of the option `name`, which may be a synonym; `None` if it is not in the table.
    #[must_use]
    pub fn listed(name: &str) -> Option<Self> {
        let has_name = |(_, options): &&OptionGroup| options.iter().any(|names| names.contains(&name));
        SUMO_OPTIONS.iter().find(has_name).map(|(effect, _)| *effect)
    }

    /// The effect of the option `name`.
    #[must_use]
    pub fn of(name: &str) -> Self {
        Self::listed(name).unwrap_or(Plain)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_name_is_listed_once() {
        let mut names: Vec<&str> = SUMO_OPTIONS
            .iter()
            .flat_map(|(_, options)| options.iter().copied().flatten())
            .copied()
            .collect();
        let all = names.len();
        names.sort_unstable();
        names.dedup();
        assert_eq!(names.len(), all);
        assert_eq!(OptionEffect::of("summary"), Writes);
        assert_eq!(OptionEffect::of("step-length"), Plain);
    }
}
