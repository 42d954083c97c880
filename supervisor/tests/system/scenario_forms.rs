//! Scenarios in every form that bare SUMO opens: how they are written, where they lie, when they begin and end, what they hold.

use std::{path::PathBuf, process::Output};

use crate::common::{BARE_NET_SETTINGS, Workplace, sumo_program, text, tool};
use caraware::config::{LayeredSettings, PRESETS};
use ipc_schema::run::{RunFile, VEHICLE_IDS};
use serde_json::Value;

/// A grid, and cars on it that depart in the first ten seconds.
fn grid(workplace: &Workplace) {
    let arguments = [
        "--grid",
        "--grid.number",
        "3",
        "--sidewalks.guess",
        "-o",
        "grid.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &arguments, workplace.path());
    workplace.write(
        "cars.rou.xml",
        "<routes><flow id=\"f\" begin=\"0\" end=\"10\" number=\"5\" from=\"A0A1\" to=\"B2C2\"/></routes>",
    );
}

const INPUT: &str = "<net-file value=\"grid.net.xml\"/><route-files value=\"cars.rou.xml\"/>";

fn scenario(workplace: &Workplace, name: &str, options: &str) -> PathBuf {
    workplace.write(name, &format!("<configuration>{options}</configuration>"))
}

fn start(workplace: &Workplace, sumocfg: &str, name: &str, more: &[&str], variable: Option<&str>) -> Output {
    let arguments = [&["simulate", sumocfg, "--name", name], &BARE_NET_SETTINGS[..], more].concat();
    let mut command = workplace.command(&arguments);
    if let Some(value) = variable {
        command.env("CARAWARE_TEST_PLACE", value);
    }
    command.output().unwrap()
}

/// Simulates, and returns the report.
fn simulate(workplace: &Workplace, sumocfg: &str, name: &str, more: &[&str]) -> Value {
    let place = workplace.path().display().to_string();
    let output = start(workplace, sumocfg, name, more, Some(&place));
    assert!(output.status.success(), "{sumocfg}: {}", text(&output));
    workplace.report(name)
}

/// Records of persons in vehicles.
fn riders(fcd: &str) -> usize {
    fcd.matches(" vehicle=\"").count() - fcd.matches(" vehicle=\"\"").count()
}

/// What presets say of maps and their traffic does not hold for a scenario, the rest does. Vehicles depart late, so the first ticks have
/// none.
#[test]
fn a_trainer_learns_from_a_scenario_with_any_preset() {
    let workplace = Workplace::new();
    grid(&workplace);
    workplace.write(
        "cars.rou.xml",
        "<routes><trip id=\"a\" depart=\"1.5\" from=\"A0A1\" to=\"B2C2\"/><trip id=\"b\" depart=\"1.5\" from=\"A1B1\" to=\"B2C2\"/></routes>",
    );
    scenario(
        &workplace,
        "late.sumocfg",
        &format!("{INPUT}<end value=\"8\"/><step-length value=\"0.1\"/>"),
    );
    let small = [
        "episode.training_episodes=1",
        "episode.ticks=30",
        "episode.evaluation_ticks=20",
        "episode.final_evaluations=1",
        "trainer.plots=false",
    ];
    for (preset, _) in PRESETS {
        let hero = match preset {
            "driving" | "lap" => Some("traffic.hero_ids=[\"a\"]"),
            _ => None,
        };
        let settings = small.into_iter().chain(hero).flat_map(|setting| ["--set", setting]);
        let arguments: Vec<&str> = ["train", "late.sumocfg", "--preset", preset, "--name", preset]
            .into_iter()
            .chain(settings)
            .chain(BARE_NET_SETTINGS)
            .collect();
        workplace.succeed(&arguments);
        let report = workplace.report(preset);
        // A script does not count what it has lost.
        let lost = report["lost_ticks"].as_u64().unwrap_or(0);
        assert_eq!(
            (&report["result"], lost),
            (&"completed".into(), 0),
            "{preset}: {report:#}"
        );
        // What belongs to the preset alone is that of the preset.
        let run = RunFile::read(&workplace.path().join("runs").join(preset).join("run.json")).unwrap();
        let settings = LayeredSettings::defaults().unwrap().with_named_preset(preset).unwrap();
        let is_observed = |field: &Value| {
            run.config
                .observation
                .fields
                .iter()
                .any(|observed| field == observed.name())
        };
        let fields = settings.value("observation.fields");
        assert!(fields.as_array().unwrap().iter().all(is_observed), "{preset}: {fields}");
        assert_eq!(
            Some(run.config.trainer.module.as_str()),
            settings.text("trainer.module"),
            "{preset}"
        );
    }
}

#[test]
fn a_scenario_may_be_written_in_every_way_that_sumo_reads() {
    let workplace = Workplace::new();
    grid(&workplace);
    let folder = workplace.path().join("my place");
    std::fs::create_dir(&folder).unwrap();
    for file in ["grid.net.xml", "cars.rou.xml"] {
        std::fs::copy(workplace.path().join(file), folder.join(file)).unwrap();
        let umlaut = format!("stra\u{df}e.{file}");
        std::fs::copy(workplace.path().join(file), workplace.path().join(umlaut)).unwrap();
    }
    let span = "<end value=\"0:0:12\"/><step-length value=\"0:0:0.1\"/>";
    scenario(
        &workplace,
        "plain.sumocfg",
        &format!("{INPUT}<end value=\"12\"/><step-length value=\"0.1\"/>"),
    );
    scenario(
        &workplace,
        "run.sumo.cfg",
        &format!(
            "<net>my place/grid.net.xml</net><r v=\"${{CARAWARE_TEST_PLACE}}/my place/cars.rou.xml${{CARAWARE_TEST_NONE}}\"/>{span}"
        ),
    );
    let latin = format!(
        "<?xml version=\"1.0\" encoding=\"ISO-8859-1\"?><configuration>{}{span}</configuration>",
        INPUT.replace("value=\"", "value=\"stra#e.")
    );
    let latin: Vec<u8> = latin
        .bytes()
        .map(|byte| if byte == b'#' { 0xdf } else { byte })
        .collect();
    std::fs::write(workplace.path().join("latin.sumocfg"), latin).unwrap();
    let plain = simulate(&workplace, "plain.sumocfg", "plain", &[]);
    for other in ["run.sumo.cfg", "latin.sumocfg"] {
        let report = simulate(&workplace, other, "other", &[]);
        assert_eq!(report["observation_hash"], plain["observation_hash"], "{other}");
        std::fs::remove_dir_all(workplace.path().join("runs/other")).unwrap();
    }
    // A negative seed is another seed, and stays so with `--seed` of the same bits.
    scenario(
        &workplace,
        "seed.sumocfg",
        &format!("{INPUT}{span}<seed value=\"-5\"/>"),
    );
    let negative = simulate(&workplace, "seed.sumocfg", "seed", &[]);
    assert_eq!(negative["seed"], 4_294_967_291_u64);
    assert_ne!(negative["observation_hash"], plain["observation_hash"]);
}

#[test]
fn begin_end_and_steps_are_sumos_own() {
    let workplace = Workplace::new();
    grid(&workplace);
    let output = "<fcd-output value=\"fcd.xml\"/>";
    scenario(
        &workplace,
        "a.sumocfg",
        &format!("{INPUT}{output}<step-length value=\"0.25\"/><end value=\"600\"/>"),
    );
    let report = simulate(&workplace, "a.sumocfg", "span", &["--begin", "0:0:5", "--end", "11.5"]);
    // 6.5 s in 26 steps of two ticks.
    assert_eq!(report["ticks"], 52, "{report:#}");
    let fcd = std::fs::read_to_string(workplace.path().join("runs/span/sumo/fcd.xml")).unwrap();
    assert!(
        fcd.contains("<timestep time=\"5.00\"") && fcd.contains("<timestep time=\"11.25\""),
        "{fcd}"
    );
    let steps = fcd.matches("<timestep ").count();
    assert_eq!(steps, 26, "as `sumo --begin 5 --end 11.5` writes");
    for (step_s, ticks) in [("0.05", 40), ("0.15", 28)] {
        scenario(
            &workplace,
            "b.sumocfg",
            &format!("{INPUT}<step-length value=\"{step_s}\"/>"),
        );
        let report = simulate(&workplace, "b.sumocfg", step_s, &["--end", "2"]);
        assert_eq!(report["ticks"], ticks, "{step_s}: {report:#}");
    }
    for (more, said) in [
        (["--set", "episode.ticks=5"], "limit the run with --end"),
        (["--end", "0:5"], "--end 0:5 is no time"),
        (["--begin", "600"], "begins at 600 s"),
    ] {
        let output = start(&workplace, "a.sumocfg", "refused", &more, None);
        let text = text(&output)
            .split(['│', '\n'])
            .map(str::trim)
            .collect::<Vec<_>>()
            .join(" ");
        assert!(
            output.status.code() == Some(2) && text.contains(said),
            "{more:?}: {text}"
        );
    }
}

#[test]
fn saved_states_riders_and_long_ids_are_mirrored_and_outputs_of_one_name_kept_apart() {
    let workplace = Workplace::new();
    grid(&workplace);
    let long = "x".repeat(150);
    workplace.write(
        "more.rou.xml",
        &format!(
            "<routes><vehicle id=\"{long}1\" depart=\"0\"><route edges=\"A0A1 A1A2\"/></vehicle>\
             <vehicle id=\"bus\" depart=\"triggered\" departPos=\"20\"><route edges=\"B0B1 B1B2\"/></vehicle>\
             <person id=\"rider\" depart=\"0\"><walk edges=\"B0B1\" arrivalPos=\"20\"/><ride from=\"B0B1\" to=\"B1B2\" lines=\"bus\"/></person>\
             <container id=\"box\" depart=\"0\"><tranship edges=\"A0B0 B0C0\" speed=\"5\"/></container>\
             <vehicle id=\"{long}2\" depart=\"1\"><route edges=\"A0A1 A1A2\"/></vehicle></routes>"
        ),
    );
    let input = INPUT.replace("cars.rou.xml", "cars.rou.xml,more.rou.xml");
    std::fs::create_dir(workplace.path().join("one")).unwrap();
    std::fs::create_dir(workplace.path().join("two")).unwrap();
    scenario(
        &workplace,
        "a.sumocfg",
        &format!(
            "{input}<step-length value=\"0.1\"/><end value=\"35\"/><tripinfo-output value=\"one/out.xml\"/>\
             <fcd-output value=\"two/out.xml\"/><fcd-output.attributes value=\"x,y,vehicle\"/>"
        ),
    );
    let report = simulate(&workplace, "a.sumocfg", "all", &[]);
    let sumo = workplace.path().join("runs/all/sumo");
    assert!(
        std::fs::read_to_string(sumo.join("out.xml"))
            .unwrap()
            .contains("<tripinfo")
    );
    let fcd = std::fs::read_to_string(sumo.join("two_out.xml")).unwrap();
    let riding = fcd.matches(" vehicle=\"bus\"").count();
    assert!(riding > 0, "no person rode");
    let seen = fcd.matches("<vehicle ").count() + fcd.matches("<person ").count() - riding;
    assert_eq!(report["traffic"]["vehicle_steps"], seen, "{report:#}");
    assert_eq!(report["traffic"]["departed"]["passenger"], 8, "{report:#}");
    assert_eq!(
        (&report["traffic"]["rides"], &report["traffic"]["container_loads"]),
        (&1.into(), &0.into()),
        "the box is carried by no vehicle: {report:#}"
    );
    let ids = std::fs::read_to_string(workplace.path().join("runs/all").join(VEHICLE_IDS)).unwrap();
    assert!(
        ids.contains(&format!("\"{long}1\"\n")) && ids.contains(&format!("\"{long}2\"\n")),
        "{ids}"
    );

    // The second half alone, from a saved state: as many vehicle records as bare SUMO.
    let save = [
        "-c",
        "a.sumocfg",
        "-e",
        "21",
        "--save-state.times",
        "20",
        "--save-state.files",
        "state.xml.gz",
    ];
    let save = [&save[..], &["--output-prefix", "saving-", "--no-step-log"]].concat();
    tool(&sumo_program("sumo"), &save, workplace.path());
    scenario(
        &workplace,
        "warm.sumocfg",
        &format!("{input}<load-state value=\"saving-state.xml.gz\"/><step-length value=\"0.1\"/><end value=\"30\"/>"),
    );
    let bare = [
        "-c",
        "warm.sumocfg",
        "--no-step-log",
        "--fcd-output",
        "warm.xml",
        "--fcd-output.attributes",
        "x,y,vehicle",
    ];
    tool(&sumo_program("sumo"), &bare, workplace.path());
    let fcd = std::fs::read_to_string(workplace.path().join("warm.xml")).unwrap();
    let seen = fcd.matches("<vehicle ").count() + fcd.matches("<person ").count() - riders(&fcd);
    let report = simulate(&workplace, "warm.sumocfg", "warm", &[]);
    assert_eq!(
        (&report["traffic"]["vehicle_steps"], &report["ticks"]),
        (&seen.into(), &100.into()),
        "{report:#}"
    );
    assert!(
        report["traffic"]["departed"]["passenger"].as_u64() > Some(4),
        "{report:#}"
    );
    let run = std::fs::read_to_string(workplace.path().join("runs/warm/run.json")).unwrap();
    let run: Value = serde_json::from_str(&run).unwrap();
    assert_eq!(
        run["source"]["scenario"]["own"]["begin_s"], 20.0,
        "SUMO's time of the saved state"
    );
}

/// Containers as in SUMO's own tests: at stops, by line, more than a vehicle holds, on a vehicle that waits for one, and moved by none.
#[test]
fn containers_are_carried_as_in_bare_sumo_and_counted() {
    let workplace = Workplace::new();
    grid(&workplace);
    workplace.write(
        "stops.add.xml",
        "<additional><containerStop id=\"first\" lane=\"A0A1_1\" startPos=\"30\" endPos=\"60\"/>\
         <containerStop id=\"second\" lane=\"B1B2_1\" startPos=\"30\" endPos=\"60\"/></additional>",
    );
    workplace.write(
        "boxes.rou.xml",
        "<routes><vType id=\"truck\" vClass=\"truck\" containerCapacity=\"2\"/>\
         <vehicle id=\"waits\" type=\"truck\" depart=\"0\"><route edges=\"C0C1 C1C2\"/>\
         <stop lane=\"C0C1_1\" startPos=\"20\" endPos=\"40\" triggered=\"container\" parking=\"false\"/></vehicle>\
         <container id=\"a\" depart=\"0\" departPos=\"50\"><transport from=\"A0A1\" containerStop=\"second\" lines=\"l1\"/>\
         <tranship edges=\"B1B2 B2C2\" speed=\"5\"/></container>\
         <container id=\"b\" depart=\"0\" departPos=\"50\"><transport from=\"A0A1\" containerStop=\"second\" lines=\"l1\"/></container>\
         <container id=\"c\" depart=\"0\" departPos=\"50\"><transport from=\"A0A1\" containerStop=\"second\" lines=\"l1\"/></container>\
         <container id=\"alone\" depart=\"0\"><tranship edges=\"A0B0 B0C0\" speed=\"5\"/></container>\
         <flow id=\"shuttle\" type=\"truck\" line=\"l1\" begin=\"0\" end=\"60\" number=\"2\"><route edges=\"A0A1 A1B1 B1B2 B2C2\"/>\
         <stop containerStop=\"first\" duration=\"20\"/><stop containerStop=\"second\" duration=\"20\"/></flow>\
         <container id=\"awaited\" depart=\"5\" departPos=\"40\"><transport from=\"C0C1\" to=\"C1C2\" lines=\"waits\"/></container></routes>",
    );
    let input = INPUT.replace(
        "cars.rou.xml\"/>",
        "cars.rou.xml,boxes.rou.xml\"/><additional-files value=\"stops.add.xml\"/>",
    );
    scenario(
        &workplace,
        "boxes.sumocfg",
        &format!(
            "{input}<tripinfo-output value=\"trips.xml\"/><fcd-output value=\"fcd.xml\"/>\
             <fcd-output.attributes value=\"x,y,vehicle\"/><end value=\"900\"/>"
        ),
    );
    let bare = ["-c", "boxes.sumocfg", "--no-step-log", "--output-prefix", "bare-"];
    tool(&sumo_program("sumo"), &bare, workplace.path());
    let report = simulate(&workplace, "boxes.sumocfg", "boxes", &[]);
    let body = |path: PathBuf| {
        let text = std::fs::read_to_string(path).unwrap();
        text.split_once("-->").unwrap().1.to_owned()
    };
    let ours = workplace.path().join("runs/boxes/sumo");
    for name in ["trips.xml", "fcd.xml"] {
        let theirs = body(workplace.path().join(format!("bare-{name}")));
        assert!(body(ours.join(name)) == theirs, "{name} differs from bare SUMO's");
    }
    let trips = body(ours.join("trips.xml"));
    assert_eq!(
        report["traffic"]["container_loads"],
        trips.matches("<transport ").count(),
        "{trips}"
    );
    assert_eq!(report["traffic"]["container_loads"], 4, "{trips}");
    // Only what moves by itself is mirrored.
    assert_eq!(
        report["traffic"]["vehicle_steps"],
        body(ours.join("fcd.xml")).matches("<vehicle ").count(),
        "{report:#}"
    );
    workplace.assert_nothing_left();
}

#[test]
fn a_net_in_raw_utm_coordinates_gives_the_observations_of_the_same_net_beside_its_origin() {
    let workplace = Workplace::new();
    let place = [("near", "0.00,0.00", "0"), ("far", "691000.00,5334000.00", "offset")];
    let nodes = |x: f64, y: f64| {
        format!(
            "<nodes><node id=\"a\" x=\"{}\" y=\"{}\"/><node id=\"b\" x=\"{}\" y=\"{}\"/><node id=\"c\" x=\"{}\" y=\"{}\"/></nodes>",
            x + 10.0,
            y + 10.0,
            x + 210.0,
            y + 10.0,
            x + 210.0,
            y + 210.0
        )
    };
    workplace.write(
        "e.edg.xml",
        "<edges><edge id=\"ab\" from=\"a\" to=\"b\"/><edge id=\"bc\" from=\"b\" to=\"c\"/></edges>",
    );
    workplace.write(
        "cars.rou.xml",
        "<routes><flow id=\"f\" begin=\"0\" end=\"10\" number=\"5\" from=\"ab\" to=\"bc\"/></routes>",
    );
    let mut truths = Vec::new();
    for (name, _, kind) in place {
        let (x, y) = if kind == "offset" {
            (691_000.0, 5_334_000.0)
        } else {
            (0.0, 0.0)
        };
        workplace.write("n.nod.xml", &nodes(x, y));
        let net = format!("{name}.net.xml");
        let arguments = [
            "-n",
            "n.nod.xml",
            "-e",
            "e.edg.xml",
            "--offset.disable-normalization",
            "-o",
            &net,
        ];
        tool(&sumo_program("netconvert"), &arguments, workplace.path());
        // The same place on the globe: the net's own grid is UTM.
        let path = workplace.path().join(&net);
        let text = std::fs::read_to_string(&path).unwrap();
        let offset = if kind == "offset" {
            "0.00,0.00"
        } else {
            "-691000.00,-5334000.00"
        };
        let text = text
            .replace("netOffset=\"0.00,0.00\"", &format!("netOffset=\"{offset}\""))
            .replace(
                "projParameter=\"!\"",
                "projParameter=\"+proj=utm +zone=32 +ellps=WGS84 +datum=WGS84 +units=m +no_defs\"",
            );
        std::fs::write(&path, text).unwrap();
        let sumocfg = format!("{name}.sumocfg");
        let input = INPUT.replace("grid.net.xml", &net);
        scenario(
            &workplace,
            &sumocfg,
            &format!("{input}<step-length value=\"0.1\"/><end value=\"20\"/>"),
        );
        let report = simulate(&workplace, &sumocfg, name, &[]);
        assert_eq!(report["dynamics"]["resynchronisations"], 0, "{report:#}");
        truths.push(report["raw_gnss_mean_error_m"].as_f64().unwrap());
        let run = std::fs::read_to_string(workplace.path().join("runs").join(name).join("run.json")).unwrap();
        let run: Value = serde_json::from_str(&run).unwrap();
        let origin_m = if kind == "offset" {
            [691_000.0, 5_334_000.0]
        } else {
            [0.0, 0.0]
        };
        assert_eq!(run["map"]["world_origin_m"], serde_json::json!(origin_m));
    }
    // In single precision of absolute coordinates the error would change by decimetres.
    assert!((truths[0] - truths[1]).abs() < 1e-3, "{truths:?}");
}

/// One junction whose light controls more than 128 links.
#[test]
fn a_light_of_many_links_and_a_net_without_ways_across_junctions_run() {
    let workplace = Workplace::new();
    let cross = [
        "--grid",
        "--grid.number",
        "3",
        "-L",
        "6",
        "-j",
        "traffic_light",
        "--no-turnarounds",
        "-o",
        "grid.net.xml",
    ];
    tool(&sumo_program("netgenerate"), &cross, workplace.path());
    let cut = ["-s", "grid.net.xml", "--no-internal-links", "-o", "cut.net.xml"];
    tool(&sumo_program("netconvert"), &cut, workplace.path());
    let join = [
        "-s",
        "grid.net.xml",
        "--tls.join",
        "--tls.join-dist",
        "300",
        "-o",
        "joined.net.xml",
    ];
    tool(&sumo_program("netconvert"), &join, workplace.path());
    let joined = std::fs::read_to_string(workplace.path().join("joined.net.xml")).unwrap();
    let links = joined
        .split("state=\"")
        .skip(1)
        .map(|state| state.find('"').unwrap())
        .max()
        .unwrap();
    assert!(links > 128, "{links} links");
    workplace.write(
        "cars.rou.xml",
        "<routes><flow id=\"f\" begin=\"0\" end=\"10\" number=\"5\" from=\"A0A1\" to=\"B2C2\"/></routes>",
    );
    for net in ["joined.net.xml", "cut.net.xml"] {
        let input = INPUT.replace("grid.net.xml", net);
        scenario(
            &workplace,
            "a.sumocfg",
            &format!("{input}<step-length value=\"0.1\"/><end value=\"12\"/>"),
        );
        let report = simulate(&workplace, "a.sumocfg", net, &[]);
        assert!(report["vehicle_steps"].as_u64() > Some(100), "{net}: {report:#}");
    }
}
