//! Scenario files come from strangers: what they make SUMO do stays within the run's directory, or is refused with its name.

use std::path::{Path, PathBuf};

use crate::common::{BARE_NET_SETTINGS, Workplace, sumo_program, text, tool, tree};
use caraware::scenario::{self, ScenarioReading, options::OptionEffect};
use quick_xml::events::{BytesStart, Event};

/// A grid with three vehicles, and a `.sumocfg` that has `options` besides.
fn scenario(workplace: &Workplace, options: &str) -> PathBuf {
    if !workplace.path().join("grid.net.xml").exists() {
        let grid = ["--grid", "--grid.number", "3", "-o", "grid.net.xml"];
        tool(&sumo_program("netgenerate"), &grid, workplace.path());
    }
    workplace.write(
        "grid.rou.xml",
        "<routes>\n<vType id=\"car\"><param key=\"has.ssm.device\" value=\"true\"/></vType>\n\
         <flow id=\"f\" type=\"car\" begin=\"0\" end=\"3\" number=\"3\" from=\"A0A1\" to=\"B2C2\"/></routes>",
    );
    let input = "<net-file value=\"grid.net.xml\"/>\n<route-files value=\"grid.rou.xml\"/>\n<end value=\"12\"/>";
    workplace.write(
        "a.sumocfg",
        &format!("<configuration>\n{input}\n{options}\n</configuration>"),
    )
}

fn simulate(workplace: &Workplace, more: &[&str]) -> (Option<i32>, String) {
    let output = workplace.run(&[&["simulate", "a.sumocfg", "--name", "a"], &BARE_NET_SETTINGS[..], more].concat());
    let said = text(&output).replace(['│', '×', '╰', '─', '▶'], " ");
    (
        output.status.code(),
        said.split_whitespace().collect::<Vec<_>>().join(" "),
    )
}

/// The program refuses the scenario and says each of `parts`.
fn assert_refused(workplace: &Workplace, parts: &[&str]) {
    let (code, said) = simulate(workplace, &[]);
    assert_eq!(code, Some(2), "{said}");
    for part in parts {
        assert!(said.contains(part), "`{part}` is not in: {said}");
    }
    assert!(!workplace.path().join("runs/a").exists(), "a run directory was left");
    workplace.assert_nothing_left();
}

fn attribute(element: &BytesStart<'_>, name: &str) -> String {
    let value = element.try_get_attribute(name).unwrap();
    value.map_or_else(String::new, |value| value.value.into_owned())
}

/// Options of the installed SUMO: section, names, type.
fn sumo_options(directory: &Path) -> Vec<(String, Vec<String>, String)> {
    tool(&sumo_program("sumo"), &["--save-template", "options.xml"], directory);
    let text = std::fs::read_to_string(directory.join("options.xml")).unwrap();
    let mut reader = quick_xml::Reader::from_str(&text);
    let (mut section, mut options) = (String::new(), Vec::new());
    loop {
        match reader.read_event().unwrap() {
            Event::Start(element) => section = element.name().as_ref().to_owned(),
            Event::Empty(element) => {
                let mut names = vec![element.name().as_ref().to_owned()];
                names.extend(attribute(&element, "synonymes").split_whitespace().map(str::to_owned));
                options.push((section.clone(), names, attribute(&element, "type")));
            }
            Event::Eof => return options,
            _ => {}
        }
    }
}

/// A new SUMO with an option that names a file fails here, until the table says what SUMO does with it.
#[test]
fn every_option_of_sumo_that_may_name_a_file_or_a_port_is_classified() {
    let directory = tempfile::tempdir().unwrap();
    let options = sumo_options(directory.path());
    assert!(options.len() > 400, "{}", options.len());
    let mut checked = 0;
    for (section, names, kind) in options {
        let is_text = kind.starts_with("STR") && matches!(section.as_str(), "output" | "traci_server");
        let named = names[0].ends_with(".file") || names[0].ends_with("-port") || section == "traci_server";
        if kind != "FILE" && !is_text && !named {
            continue;
        }
        for name in &names {
            let effect = OptionEffect::listed(name);
            assert!(effect.is_some(), "`{name}` ({section}, {kind}) is not in SUMO_OPTIONS");
            assert_eq!(effect, OptionEffect::listed(&names[0]), "`{name}`");
        }
        let writes = names[0].ends_with("output") && kind == "FILE" && section != "gui_only";
        assert!(
            !writes
                || matches!(
                    OptionEffect::of(&names[0]),
                    OptionEffect::Writes | OptionEffect::Escapes
                ),
            "{names:?}"
        );
        checked += 1;
    }
    assert!(checked > 70, "{checked}");
}

/// SUMO itself runs with every output that it has, each with an absolute path: nothing appears outside the run's directory.
#[test]
fn every_output_is_written_into_the_run_directory() {
    let workplace = Workplace::new();
    let outside = workplace.path().join("outside");
    std::fs::create_dir(&outside).unwrap();
    let directory = tempfile::tempdir().unwrap();
    let place = outside.display();
    // JuPedSim is not part of the wheel, and saved states end a run with vehicles on the way.
    let left_out = |name: &str| name.contains("jupedsim") || name.starts_with("save-state");
    let outputs: String = sumo_options(directory.path())
        .into_iter()
        .map(|(_, names, _)| names[0].clone())
        .filter(|name| OptionEffect::of(name) == OptionEffect::Writes && !left_out(name))
        .map(|name| format!("<{name} value=\"{place}/{name}.xml\"/>\n"))
        .collect();
    let more = format!(
        "<save-state.times value=\"5\"/><save-state.prefix>{place}/state</save-state.prefix><additional-files value=\"a.add.xml\"/>"
    );
    scenario(&workplace, &(outputs + &more));
    workplace.write(
        "a.add.xml",
        &format!(
            "<additional><e1Detector id=\"d\" lane=\"A0A1_0\" pos=\"1\" period=\"5\" file=\"{place}/e1.xml\"/>\
             <edgeData id=\"e\" period=\"5\" file=\"../{name}/outside/edges.xml\"/>\
             <vTypeProbe id=\"p\" period=\"5\" file=\"{place}/probe.xml\"/>\
             <routeProbe id=\"q\" edge=\"A0A1\" period=\"5\" file=\"{place}/routes.xml\"/></additional>",
            name = workplace.path().file_name().unwrap().to_string_lossy()
        ),
    );
    let before = tree(workplace.path());
    let (code, said) = simulate(&workplace, &[]);
    assert_eq!(code, Some(0), "{said}");
    let run = workplace.path().join("runs");
    let mut after = tree(workplace.path());
    after.retain(|path, _| !path.starts_with(&run));
    assert_eq!(after, before, "nothing was written outside the run's directory");
    let written = tree(&run.join("a/sumo"));
    for name in [
        "fcd-output.xml",
        "tripinfo-output.xml",
        "e1.xml",
        "edges.xml",
        "probe.xml",
        "routes.xml",
        "log.xml",
    ] {
        assert!(
            written.contains_key(&run.join("a/sumo").join(name)),
            "{name} is not in {written:?}"
        );
    }
    let log = std::fs::read_to_string(run.join("a/logs/traffic-bridge.log")).unwrap();
    let notes = log.lines().filter(|line| line.contains("written into")).count();
    assert!(notes > 40, "{notes} notes:\n{log}");
}

#[test]
fn an_option_that_reaches_beyond_the_run_directory_is_refused_with_its_line() {
    let workplace = Workplace::new();
    for (option, parts) in [
        (
            "<save-configuration value=\"/tmp/x\"/>",
            ["save-configuration", "outside the run's directory"],
        ),
        ("<C v=\"x\"/>", ["C = \"x\"", "outside the run's directory"]),
        (
            "<save-template>x</save-template>",
            ["save-template", "outside the run's directory"],
        ),
        (
            "<configuration-file value=\"b.sumocfg\"/>",
            ["configuration-file", "write or load files"],
        ),
        (
            "<fcd-output value=\"example.com:80\"/>",
            ["fcd-output = \"example.com:80\"", "connect to an address"],
        ),
        (
            "<output-suffix value=\"/../x\"/>",
            ["output-suffix", "may place outputs outside"],
        ),
        (
            "<xml-validation value=\"always\"/>",
            ["xml-validation", "set it to \"local\""],
        ),
        (
            "<x><remote-port>8813</remote-port></x>",
            ["remote-port = \"8813\"", "remove remote-port"],
        ),
        (
            "<remote-port>88&#49;3</remote-port>",
            ["remote-port = \"8813\"", "remove remote-port"],
        ),
    ] {
        let path = scenario(&workplace, option);
        assert_refused(&workplace, &[&["a.sumocfg", "line 5"], &parts[..]].concat());
        let trusted = scenario::read(&path, ScenarioReading::Trusted);
        assert_eq!(
            trusted.is_ok(),
            !option.contains("remote-port"),
            "{option}: {trusted:?}"
        );
    }
}

#[test]
fn a_file_that_reaches_beyond_the_run_directory_is_refused_with_its_line() {
    let workplace = Workplace::new();
    workplace.write("secret.xml", "<a/>");
    for (content, parts) in [
        (
            "<!DOCTYPE a SYSTEM \"http://example.com/a.dtd\"><a/>",
            ["line 1", "document type declaration", "--trust-scenario"],
        ),
        (
            "<a>\n<e2Detector file=\"example.com:80\"/></a>",
            ["line 2", "<e2Detector file=…>", "connect to an address"],
        ),
        (
            "<a>\n<include href=\"b.add.xml\"/></a>",
            ["line 2", "<include href=…>", "includes itself"],
        ),
        (
            "<a>\n<include href=\"/dev/zero\"/></a>",
            ["line 2", "/dev/zero", "is a device, not a regular file"],
        ),
        ("<a>\n<b></a>", ["b.add.xml", "line 2", "cannot be read"]),
    ] {
        workplace.write("b.add.xml", content);
        scenario(&workplace, "<additional-files value=\"b.add.xml\"/>");
        assert_refused(&workplace, &[&["b.add.xml"], &parts[..]].concat());
    }
}

/// Reading a pipe or a device never ends.
#[test]
fn a_pipe_or_a_device_in_a_files_place_is_refused() {
    let workplace = Workplace::new();
    let pipe = |name: &str| {
        let path = workplace.path().join(name);
        let mode = rustix::fs::Mode::RUSR | rustix::fs::Mode::WUSR;
        rustix::fs::mknodat(rustix::fs::CWD, &path, rustix::fs::FileType::Fifo, mode, 0).unwrap();
    };
    for name in ["pipe.xml", "pipe.sumocfg", "pipe.toml", "pipe.jsonl"] {
        pipe(name);
    }
    std::fs::create_dir(workplace.path().join("folder.xml")).unwrap();
    for (option, kind) in [
        (
            "<route-files value=\"pipe.xml\"/>",
            "pipe.xml, which is a named pipe, not a regular file",
        ),
        (
            "<weight-files value=\"/dev/zero\"/>",
            "/dev/zero, which is a device, not a regular file",
        ),
        (
            "<additional-files value=\"folder.xml\"/>",
            "folder.xml, which is a directory, not a regular file",
        ),
    ] {
        scenario(&workplace, option);
        assert_refused(&workplace, &["a.sumocfg", "line 5", kind]);
    }
    for arguments in [
        &["simulate", "pipe.sumocfg"][..],
        &["simulate", "pipe.toml"],
        &["simulate", "town", "--commands", "pipe.jsonl"],
    ] {
        let output = workplace.run(&[arguments, &BARE_NET_SETTINGS[4..]].concat());
        let said = text(&output);
        assert!(
            output.status.code() == Some(2) && said.contains("named pipe"),
            "{arguments:?}: {said}"
        );
    }
}

#[test]
fn a_packed_bomb_is_refused_before_it_fills_the_memory() {
    let workplace = Workplace::new();
    let packed = std::fs::File::create(workplace.path().join("bomb.rou.xml.gz")).unwrap();
    let mut encoder = flate2::write::GzEncoder::new(packed, flate2::Compression::fast());
    std::io::copy(&mut std::io::Read::take(std::io::repeat(b' '), 80 << 20), &mut encoder).unwrap();
    encoder.finish().unwrap();
    scenario(&workplace, "<route-files value=\"bomb.rou.xml.gz\"/>");
    assert_refused(
        &workplace,
        &["a.sumocfg", "line 5", "bomb.rou.xml.gz", "unpacks to more than"],
    );
}

#[test]
fn a_net_that_crashes_sumo_is_named() {
    let workplace = Workplace::new();
    scenario(&workplace, "");
    let net = std::fs::read_to_string(workplace.path().join("grid.net.xml")).unwrap();
    let without = |remove: &dyn Fn(&str) -> bool| -> String {
        net.lines()
            .filter(|line| !remove(line))
            .map(|line| format!("{line}\n"))
            .collect()
    };
    workplace.write("grid.net.xml", &without(&|line| line.contains("<connection ")));
    assert_refused(&workplace, &["grid.net.xml", "no <connection>", "netconvert"]);
    // Such damage is found only by SUMO, which dies of it.
    workplace.write(
        "grid.net.xml",
        &without(&|line| line.contains("<connection from=\":A1")),
    );
    let (code, said) = simulate(&workplace, &[]);
    assert_eq!(code, Some(2), "{said}");
    let parts = [
        "traffic-bridge",
        "ended while SUMO was reading",
        "a.sumocfg",
        "grid.net.xml",
        "build the net again",
    ];
    assert!(parts.iter().all(|part| said.contains(part)), "{said}");
    workplace.assert_nothing_left();
}

/// A net of a map with population control has no directory for outputs.
#[test]
fn a_net_that_writes_is_refused_as_a_map() {
    let workplace = Workplace::new();
    scenario(&workplace, "");
    let net = std::fs::read_to_string(workplace.path().join("grid.net.xml")).unwrap();
    let detector = "<e1Detector id=\"d\" lane=\"A0A1_0\" pos=\"1\" period=\"1\" file=\"outside.xml\"/></net>";
    let path = workplace.write("grid.net.xml", &net.replace("</net>", detector));
    let said = scenario::check_net(&path, false).unwrap_err().summary().0;
    assert!(
        said.contains("<e1Detector file=…>") && said.contains("makes a net write a file"),
        "{said}"
    );
    scenario::check_net(&path, true).unwrap();
}

/// SUMO's own scenarios pass the check, and one of them runs.
#[test]
fn the_games_of_the_wheel_are_harmless() {
    let workplace = Workplace::new();
    let games = sumo_program("sumo")
        .parent()
        .unwrap()
        .parent()
        .unwrap()
        .join("tools/game");
    for name in ["A10KW", "bs3d", "DRT", "cross", "grid6", "corridor"] {
        let path = games.join(name).with_extension("sumocfg");
        let read = scenario::read(&path, ScenarioReading::Checked);
        assert!(read.is_ok(), "{name}: {read:?}");
    }
    let before = tree(&games);
    let path = games.join("cross.sumocfg").to_string_lossy().into_owned();
    workplace.succeed(
        &[
            &["simulate", &path, "--name", "cross", "--quiet"],
            &BARE_NET_SETTINGS[..],
        ]
        .concat(),
    );
    assert_eq!(tree(&games), before, "nothing was written into the wheel");
    assert!(workplace.path().join("runs/cross/sumo/tlsstate.xml").is_file());
}
