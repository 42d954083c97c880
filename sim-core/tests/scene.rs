//! The scene of real nets: the town built from its sources, and the motorway of the SUMO wheel.

#![allow(
    clippy::unwrap_used,
    clippy::panic,
    reason = "tests and measurements assert by unwrapping"
)]

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    process::Command,
};

use ipc_schema::{
    config::Config,
    run::{MapInfo, Mode, RunFile, ScenarioOptions, SceneFiles, SharedMemory, Source},
};
use sim_core::scene::{Road, RoadPiece, Scene, SceneError, Solid, SurfaceKind, chart::Chart, shape};

/// The SUMO that `make build` installed, or that `CARAWARE_SUMO_HOME` names.
fn sumo_home() -> PathBuf {
    if let Some(home) = std::env::var_os("CARAWARE_SUMO_HOME").filter(|home| !home.is_empty()) {
        return home.into();
    }
    let lib = Path::new(env!("CARGO_MANIFEST_DIR")).join("../.venv/lib");
    let homes = std::fs::read_dir(lib).unwrap().flatten();
    homes
        .map(|entry| entry.path().join("site-packages/sumo"))
        .find(|home| home.is_dir())
        .unwrap()
}

/// Heights of the road at a place, by lanes where there are any, else by junctions and crossings, metres.
fn road_heights_m(scene: &Scene, point: shape::Point) -> Vec<f64> {
    let road = scene.road();
    let on_lane = road.under(point).any(|(piece, _)| piece.surface == SurfaceKind::Lane);
    let wanted = |surface: SurfaceKind| surface.is_road() && (surface == SurfaceKind::Lane || !on_lane);
    let pieces = road.under(point).filter(|(piece, _)| wanted(piece.surface));
    pieces.map(|(_, height_m)| height_m).collect()
}

/// Height of the road at a point, metres: the lowest where several roads cross, `None` beside the road.
fn road_height_m(scene: &Scene, x_m: f64, y_m: f64) -> Option<f64> {
    road_heights_m(scene, [x_m, y_m]).into_iter().min_by(f64::total_cmp)
}

/// True if a building or prop covers the place.
fn is_in_solid(scene: &Scene, x_m: f64, y_m: f64) -> bool {
    let mut near = Vec::new();
    scene.solids_near(&shape::Bounds::about([x_m, y_m], 0.0), &mut near);
    near.into_iter().any(|number| match scene.solid(number) {
        Solid::Building(building) => building.contains([x_m, y_m]),
        Solid::Prop(prop) => {
            let [ahead_m, left_m] = prop.body.local_from_world([x_m, y_m]);
            ahead_m.abs() <= prop.body.half_m[0] && left_m.abs() <= prop.body.half_m[1]
        }
    })
}

fn maps() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../maps/town")
}

/// A run over these files; `map` places polygons in latitude and longitude.
fn run(net_file: &Path, additional_files: &[PathBuf]) -> RunFile {
    let town = include_str!("../../ipc-schema/tests/town.json");
    let config = Config::from_json(town).unwrap();
    RunFile {
        schema_version: ipc_schema::SCHEMA_VERSION,
        env_index: 0,
        run_id: 0,
        name: "scene".into(),
        run_dir: PathBuf::new(),
        mode: Mode::Simulate,
        supervisor_pid: 0,
        shared_memory: SharedMemory {
            root: PathBuf::new(),
            prefix: String::new(),
        },
        source: Source::Scenario {
            sumocfg: PathBuf::new(),
            own: ScenarioOptions::default(),
        },
        map: MapInfo {
            projection: "+proj=utm +zone=33 +ellps=WGS84 +datum=WGS84 +units=m +no_defs".into(),
            net_offset_m: [-402_990.32, -5_794_389.48],
            bounds_m: [0.0, 0.0, 5_000.0, 5_000.0],
            traffic_lights: 0,
            world_origin_m: [0.0; 2],
        },
        scene_files: SceneFiles {
            net_file: net_file.into(),
            additional_files: additional_files.to_vec(),
        },
        maps: Vec::new(),
        sumo_home: PathBuf::new(),
        config,
        config_hash: String::new(),
        beginning: None,
        restart: None,
        replay: None,
    }
}

/// The town as in a run.
fn town(directory: &Path) -> RunFile {
    let net = directory.join("town.net.xml");
    let output = Command::new(sumo_home().join("bin/netconvert"))
        .arg("-c")
        .arg(maps().join("town.netccfg"))
        .arg("-o")
        .arg(&net)
        .env("SUMO_HOME", sumo_home())
        .env("PROJ_DATA", sumo_home().join("data/proj"))
        .output()
        .unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    run(
        &net,
        &[maps().join("town.vtypes.add.xml"), maps().join("town.poly.xml")],
    )
}

#[test]
fn the_town_has_its_buildings_with_their_heights() {
    let directory = tempfile::tempdir().unwrap();
    let scene = Scene::of_run(&town(directory.path())).unwrap();
    assert_eq!(scene.buildings().len(), 62);
    let heights: BTreeMap<&str, f64> = scene.buildings().iter().map(|b| (b.id.as_str(), b.height_m)).collect();
    assert_eq!(
        (heights["church"], heights["school"], heights["market_hall"]),
        (14.0, 11.0, 9.0)
    );
    let least = heights.values().copied().fold(f64::INFINITY, f64::min);
    let most = heights.values().copied().fold(0.0, f64::max);
    assert_eq!((least, most), (5.5, 15.5), "as the map's README says");
    assert!(!heights.contains_key("park") && !heights.contains_key("orchard"));
    for building in scene.buildings() {
        assert!(shape::signed_area(&building.outline_m) > 0.0, "{}", building.id);
        assert_eq!(building.base_z_m, 0.0);
    }
}

#[test]
fn lanes_of_the_town_are_road_and_houses_are_not() {
    let directory = tempfile::tempdir().unwrap();
    let scene = Scene::of_run(&town(directory.path())).unwrap();
    let mut checked = BTreeMap::new();
    for piece in scene.road().pieces() {
        *checked.entry(format!("{:?}", piece.surface)).or_insert(0) += 1;
        let Some(half_m) = piece.half_width_m else { continue };
        for pair in piece.shape_m.windows(2) {
            let [a, b] = [pair[0], pair[1]].map(|[x, y, _]| [x, y]);
            for step in 0..=20 {
                let middle = shape::between(a, b, f64::from(step) / 20.0);
                if piece.surface.is_road() {
                    assert!(scene.is_on_road(middle[0], middle[1]), "{} at {middle:?}", piece.id);
                    assert_eq!(road_height_m(&scene, middle[0], middle[1]), Some(0.0));
                }
                // Nothing is built on any part of the surface.
                assert!(!is_in_solid(&scene, middle[0], middle[1]), "{} at {middle:?}", piece.id);
            }
            let is_far_from_junctions = shape::distance(a, b) > 20.0;
            if piece.surface == SurfaceKind::Lane && !piece.id.starts_with(':') && is_far_from_junctions {
                // SUMO drives on the right: beyond the right edge is the sidewalk, beyond the left one the lane back.
                let d = shape::from_to(a, b);
                let right = [d[1], -d[0]].map(|v| v / shape::distance(a, b));
                let beside = |off_m: f64| {
                    let m = shape::between(a, b, 0.5);
                    scene.is_on_road(m[0] + off_m * right[0], m[1] + off_m * right[1])
                };
                assert!(beside(half_m - 0.01) && beside(-half_m - 1.0), "{}", piece.id);
                assert!(!beside(half_m + 0.1) && !beside(half_m + 2.5), "{}", piece.id);
            }
        }
    }
    assert_eq!(checked["Crossing"], 52, "{checked:?}");
    assert_eq!(checked["Junction"], 17, "{checked:?}");
    assert_eq!(checked["Sidewalk"], 52, "{checked:?}");
    for building in scene.buildings() {
        let count = building.outline_m.len() as f64;
        let mean = building
            .outline_m
            .iter()
            .fold([0.0; 2], |sum, p| [sum[0] + p[0] / count, sum[1] + p[1] / count]);
        assert!(!scene.is_on_road(mean[0], mean[1]), "{}", building.id);
        if building.outline_m.len() == 4 {
            assert!(is_in_solid(&scene, mean[0], mean[1]), "{}", building.id);
        }
    }
    assert!(!scene.is_on_road(-500.0, 0.0) && road_height_m(&scene, 1e9, 1e9).is_none());
}

#[test]
fn random_props_stand_beside_the_road_and_depend_on_the_seed_alone() {
    let directory = tempfile::tempdir().unwrap();
    let mut file = town(directory.path());
    file.config.scene.random_props = 120;
    file.config.scene.obstacles = vec!["jersey_barrier 60 60 30".parse().unwrap()];
    let scene = Scene::of_run(&file).unwrap();
    assert!(
        scene.props().len() > 100,
        "{} of 120 found a place",
        scene.props().len() - 1
    );
    assert_eq!(scene.props()[0].kind.name, "jersey_barrier");
    let random = &scene.props()[1..];
    for (place, prop) in random.iter().enumerate() {
        let near_m = scene
            .road()
            .nearest(prop.body.centre_m, 15.0, |surface| surface == SurfaceKind::Lane)
            .unwrap()
            .0;
        assert!(near_m < 12.0, "{} is {near_m} m from any lane", prop.kind.name);
        for corner in prop.body.corners() {
            assert!(
                scene.road().under(corner).next().is_none(),
                "{} on the road",
                prop.kind.name
            );
            assert!(
                !scene.buildings().iter().any(|b| b.contains(corner)),
                "{} in a building",
                prop.kind.name
            );
        }
        for other in &random[..place] {
            let touch = |a: &shape::OrientedBox, b: &shape::OrientedBox| {
                a.corners().iter().any(|c| shape::contains(&b.corners(), *c))
            };
            assert!(!touch(&prop.body, &other.body) && !touch(&other.body, &prop.body));
        }
    }
    let kinds: std::collections::BTreeSet<_> = random.iter().map(|prop| prop.kind.name).collect();
    assert!(kinds.len() > 8, "{kinds:?}");
    assert_eq!(Scene::of_run(&file).unwrap().props(), scene.props());
    file.config.scene.random_props = 10;
    let few = Scene::of_run(&file).unwrap();
    assert_eq!(
        few.props(),
        &scene.props()[..few.props().len()],
        "the first are the same"
    );
    file.config.run.seed += 1;
    assert_ne!(Scene::of_run(&file).unwrap().props(), few.props());
}

#[test]
fn a_net_with_elevation_gives_heights_and_distinguishes_bridges() {
    let directory = tempfile::tempdir().unwrap();
    let net = directory.path().join("hill.net.xml");
    std::fs::write(
        &net,
        r#"<net><edge id="low"><lane id="low_0" index="0" width="4" shape="0,0,2 100,0,12"/></edge>
        <edge id="high"><lane id="high_0" index="0" shape="50,-40,15 50,40,15"/></edge>
        <edge id="foot"><lane id="foot_0" index="0" allow="pedestrian" shape="0,4,2 100,4,12"/></edge></net>"#,
    )
    .unwrap();
    let poly = directory.path().join("a.poly.xml");
    std::fs::write(
        &poly,
        r#"<additional><poly id="house" type="building.house" shape="20,10 30,10 30,20 20,20"/>
        <poly id="tower" type="building" height="30" shape="70,10,5 80,10,6 80,20,7 70,20,8"><param key="building:levels" value="4"/></poly></additional>"#,
    )
    .unwrap();
    let scene = Scene::of_run(&run(&net, &[poly])).unwrap();
    assert!((road_height_m(&scene, 25.0, 1.0).unwrap() - 4.5).abs() < 1e-9);
    assert!(
        (road_height_m(&scene, 50.0, 0.0).unwrap() - 7.0).abs() < 1e-9,
        "the lower of two"
    );
    assert_eq!(
        road_heights_m(&scene, [50.0, 0.0]).into_iter().fold(0.0, f64::max),
        15.0
    );
    assert_eq!(road_height_m(&scene, 25.0, 4.0), None, "a sidewalk is no road");
    assert!(scene.is_on_road(25.0, 2.04) && !scene.is_on_road(25.0, 2.2));
    assert!(!scene.is_on_road(-0.5, 0.0), "a road ends where it ends");
    let [house, tower] = scene.buildings() else {
        panic!("{:?}", scene.buildings())
    };
    // Beside the slope, its lowest corners at x = 20 m.
    assert!((house.base_z_m - 4.0).abs() < 1e-9, "{}", house.base_z_m);
    assert_eq!(house.height_m, 7.0);
    assert_eq!((tower.base_z_m, tower.height_m), (5.0, 30.0), "as its own shape says");
}

/// A road is one long segment where it is straight, however far it climbs.
#[test]
fn the_ground_beside_a_slope_is_as_high_as_the_road_beside_it() {
    let piece = |id: &str, half_width_m, shape_m: &[[f64; 3]]| RoadPiece {
        id: id.into(),
        surface: SurfaceKind::Lane,
        shape_m: shape_m.to_vec(),
        half_width_m,
        junctions: [u32::MAX; 2],
    };
    let lane = piece("climb_0", Some(3.0), &[[0.0, 0.0, 100.0], [1000.0, 0.0, 160.0]]);
    let square = [
        [1000.0, -40.0, 160.0],
        [1080.0, -40.0, 164.0],
        [1080.0, 40.0, 164.0],
        [1000.0, 40.0, 160.0],
    ];
    let road = Road::new(vec![lane, piece(":top_0", None, &square)]);
    let scene = Scene::new(road, Vec::new(), Vec::new());
    for x_m in [0.0, 1.0, 250.0, 499.0, 750.0, 940.0] {
        for y_m in [0.0, 2.9, 3.2, -10.0, 24.0, -60.0] {
            let off_m = scene.ground_height_m(x_m, y_m) - (100.0 + 0.06 * x_m);
            assert!(off_m.abs() < 1e-9, "{off_m} at {x_m}, {y_m}");
        }
    }
    // Beside the square, along its edge of 80 m.
    for x_m in [1010.0, 1040.0, 1075.0] {
        let off_m = scene.ground_height_m(x_m, 55.0) - (160.0 + 0.05 * (x_m - 1000.0));
        assert!(off_m.abs() < 1e-9, "{off_m} at {x_m}");
    }
}

#[test]
fn outlines_of_strips_have_the_strips_width() {
    let net = "<net><edge id=\"a\"><lane id=\"a_0\" index=\"0\" width=\"4\" shape=\"0,0 10,0 10,10\"/></edge></net>";
    let directory = tempfile::tempdir().unwrap();
    let path = directory.path().join("a.net.xml");
    std::fs::write(&path, net).unwrap();
    let scene = Scene::of_run(&run(&path, &[])).unwrap();
    let outline = scene.road().pieces()[0].outline();
    let flat: Vec<[f64; 2]> = outline.iter().map(|[x, y, _]| [*x, *y]).collect();
    let expected = [
        [0.0, -2.0],
        [12.0, -2.0],
        [12.0, 10.0],
        [8.0, 10.0],
        [8.0, 2.0],
        [0.0, 2.0],
    ];
    for (point, wanted) in flat.iter().zip(expected) {
        assert!(shape::distance(*point, wanted) < 1e-9, "{flat:?}");
    }
    assert!(shape::signed_area(&flat) > 0.0);
}

#[test]
fn polygons_in_degrees_are_projected_onto_the_map() {
    let directory = tempfile::tempdir().unwrap();
    let net = directory.path().join("a.net.xml.gz");
    let mut packed = flate2::write::GzEncoder::new(std::fs::File::create(&net).unwrap(), flate2::Compression::fast());
    std::io::Write::write_all(&mut packed, b"<net></net>").unwrap();
    packed.finish().unwrap();
    let poly = directory.path().join("a.poly.xml");
    let text = r#"<additional><poly id="a" geo="true" type="building" shape="13.6,52.3 13.601,52.3 13.601,52.301 13.6,52.301"/></additional>"#;
    std::fs::write(&poly, text).unwrap();
    let mut file = run(&net, &[poly]);
    let scene = Scene::of_run(&file).unwrap();
    // A thousandth of a degree of latitude is 111.3 m here, one of longitude 68.2 m.
    let area_m2 = shape::signed_area(&scene.buildings()[0].outline_m);
    assert!((area_m2 / (111.27 * 68.20) - 1.0).abs() < 2e-3, "{area_m2}");
    assert!(scene.buildings()[0].bounds.min_m[0] > 1000.0 && scene.buildings()[0].bounds.max_m[0] < 5000.0);
    assert_eq!(scene.buildings()[0].height_m, file.config.scene.building_height_m);
    file.map.projection = "!".into();
    assert!(matches!(Scene::of_run(&file), Err(SceneError::Geodetic { .. })));
}

#[test]
fn bad_files_are_named_with_their_line() {
    let directory = tempfile::tempdir().unwrap();
    let net = directory.path().join("a.net.xml");
    let refused = |text: &str| {
        std::fs::write(&net, text).unwrap();
        Scene::of_run(&run(&net, &[])).unwrap_err()
    };
    let error = refused("<net>\n<edge id=\"a\">\n<lane id=\"a_0\" shape=\"1,2 3,x\"/></edge></net>");
    assert!(
        error
            .to_string()
            .contains("a.net.xml, line 3: \"3,x\" is not a usable shape"),
        "{error}"
    );
    let error = refused("<net>\n<edge id=\"a\"><lane id=\"a_0\" width=\"-1\" shape=\"1,2 3,4\"/></edge></net>");
    assert!(
        error.to_string().contains("line 2: \"-1\" is not a usable width"),
        "{error}"
    );
    assert!(matches!(refused("<net><edge></net>"), SceneError::Malformed { .. }));
    let missing = Scene::of_run(&run(Path::new("/no/such.net.xml"), &[])).unwrap_err();
    assert!(missing.to_string().contains("/no/such.net.xml"), "{missing}");
}

#[test]
fn the_motorway_of_the_wheel_has_road_and_a_shopping_centre() {
    let game = sumo_home().join("tools/game/A10KW");
    let mut file = run(&game.join("osm.net.xml"), &[game.join("osm.poly.xml")]);
    file.config.scene.building_height_m = 6.5;
    let scene = Scene::of_run(&file).unwrap();
    // 14 × building.yes and 1 × building.retail; the 2 × building.roof are open below.
    assert_eq!(scene.buildings().len(), 15);
    let retail = scene.buildings().iter().find(|b| b.id == "219816203").unwrap();
    assert_eq!(retail.height_m, 6.0, "by type");
    assert_eq!(
        scene.buildings().iter().filter(|b| b.height_m == 6.5).count(),
        14,
        "by configuration"
    );
    for piece in scene
        .road()
        .pieces()
        .iter()
        .filter(|piece| piece.surface == SurfaceKind::Lane)
    {
        for [x, y, _] in &piece.shape_m {
            assert!(scene.is_on_road(*x, *y), "{} at {x}, {y}", piece.id);
        }
    }
}

#[test]
fn the_chart_for_viewers_has_lanes_lights_and_houses() {
    let directory = tempfile::tempdir().unwrap();
    let run = town(directory.path());
    let scene = Scene::of_run(&run).unwrap();
    let chart = Chart::of_run(&run, &scene).unwrap();
    let count = |kind, inside| {
        let lanes = chart.lanes.iter();
        lanes.filter(|lane| lane.kind == kind && lane.inside == inside).count()
    };
    assert_eq!(
        (count("car", false), count("sidewalk", false), count("crossing", true)),
        (52, 52, 52)
    );
    assert!(
        chart
            .lanes
            .iter()
            .all(|lane| (lane.left == "none") == lane.inside && lane.points_m.len() > 1)
    );
    assert_eq!((chart.buildings.len(), chart.signals.len()), (62, 4));
    for signal in &chart.signals {
        assert!(signal.links.len() > 3, "{signal:?}");
        for (number, link) in signal.links.iter().enumerate() {
            assert_eq!(link.link as usize, number);
            let lane = chart.lanes.iter().find(|lane| lane.id == link.lane).unwrap();
            let end = if lane.kind == "crossing" {
                lane.points_m.first()
            } else {
                lane.points_m.last()
            };
            assert_eq!(Some(&link.position_m), end);
        }
    }
    let path = directory.path().join("map/chart.json");
    chart.write(&path).unwrap();
    let written: serde_json::Value = serde_json::from_slice(&std::fs::read(&path).unwrap()).unwrap();
    assert_eq!(written["lanes"].as_array().unwrap().len(), chart.lanes.len());
}

/// A net and its objects as they lie in raw UTM coordinates, and the same files in a run whose world frame begins beside them.
#[test]
fn far_nets_trees_and_files_that_include_each_other_are_read() {
    let folder = tempfile::tempdir().unwrap();
    let write = |name: &str, text: &str| {
        let path = folder.path().join(name);
        std::fs::write(&path, text).unwrap();
        path
    };
    let net = write(
        "a.net.xml",
        "<net><edge id=\"e\"><lane id=\"e_0\" shape=\"691010,5334010 691110,5334010\" width=\"4\"/></edge></net>",
    );
    let first = write(
        "a.add.xml",
        "<add><include href=\"b.add.xml\"/><poi id=\"t\" type=\"natural.tree\" x=\"691020\" y=\"5334020\"/>\
         <poi id=\"s\" type=\"shop\" x=\"691030\" y=\"5334020\"/></add>",
    );
    write(
        "b.add.xml",
        "<add><include href=\"./a.add.xml\"/><poly id=\"h\" type=\"building\" \
         shape=\"691050,5334020 691060,5334020 691060,5334030 691050,5334030\"/></add>",
    );
    let mut run = run(&net, &[first]);
    run.map.world_origin_m = [691_000.0, 5_334_000.0];
    let scene = Scene::of_run(&run).unwrap();
    assert!(scene.is_on_road(60.0, 11.0) && !scene.is_on_road(60.0, 13.0));
    assert_eq!(scene.buildings()[0].outline_m[0], [50.0, 20.0]);
    let trees: Vec<_> = scene
        .props()
        .iter()
        .map(|prop| (prop.kind.name, prop.body.centre_m))
        .collect();
    assert_eq!(trees, [("tree", [20.0, 20.0])]);
    let chart = Chart::of_run(&run, &scene).unwrap();
    assert_eq!(chart.lanes[0].points_m[0], [10.0, 10.0, 0.0]);
}
