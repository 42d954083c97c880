//! Cost of the bridge on top of SUMO, in microseconds of processor time per road user and step: `cargo bench -p traffic-bridge`.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use traffic_bridge::{
    population::{HeroRoutes, Population, PopulationSize},
    sumo::{Sumo, error::SumoError, frame::TrafficFrame, options::SumoOptions, processor_time_s},
};

const STEPS: usize = 3000;
const WARM_UP_STEPS: usize = 100;
const SIZE: PopulationSize = PopulationSize {
    cavs: 250,
    others: 250,
    heroes: 0,
    pedestrians: 0,
};

/// A grid of 12 × 12 junctions, 150 m apart, of this type.
fn grid(sumo_home: &Path, folder: &Path, junctions: &str) -> std::io::Result<PathBuf> {
    let net = folder.join("grid.net.xml");
    let size = [
        "--grid",
        "--grid.number",
        "12",
        "--grid.length",
        "150",
        "--default.lanenumber",
        "2",
        "-o",
    ];
    Command::new(sumo_home.join("bin/netgenerate"))
        .env("SUMO_HOME", sumo_home)
        .args(["--default-junction-type", junctions])
        .args(size)
        .arg(&net)
        .output()?;
    Ok(net)
}

fn measure(net: &Path, sumo_home: &Path) -> Result<(), SumoError> {
    let mut sumo = Sumo::start(SumoOptions::population(sumo_home, net, &[], 0.1, 1)?)?;
    let mut population = Population::start(&mut sumo, SIZE, HeroRoutes::default(), 1)?;
    let (mut frame, mut control_s, mut step_s, mut rows) = (TrafficFrame::default(), 0.0, 0.0, 0);
    let mut before = sumo.cost();
    for step in 0..WARM_UP_STEPS + STEPS {
        if step == WARM_UP_STEPS {
            (control_s, step_s, rows, before) = (0.0, 0.0, 0, sumo.cost());
        }
        let start = processor_time_s();
        sumo.step(&mut frame)?;
        step_s += processor_time_s() - start;
        let start = processor_time_s();
        population.after_step(&mut sumo, &frame)?;
        control_s += processor_time_s() - start;
        rows += frame.states.len();
    }
    let cost = sumo.cost();
    let (sumo_s, getters_s) = (cost.step_s - before.step_s, cost.getters_s - before.getters_s);
    #[expect(clippy::cast_precision_loss, reason = "a count of rows")]
    let micros = |seconds: f64| seconds * 1e6 / rows as f64;
    println!(
        "{} road users, {STEPS} steps; microseconds of processor time per road user and step:",
        frame.states.len()
    );
    println!("  SUMO's own step     {:.3}", micros(sumo_s));
    println!("  pass of getters     {:.3}   (budget 0.5)", micros(getters_s));
    let signals_s = cost.signals_s - before.signals_s;
    println!(
        "  traffic lights      {:.3}   ({:.2} % of SUMO's step)",
        micros(signals_s),
        100.0 * signals_s / sumo_s
    );
    println!(
        "  conversion to frame {:.3}",
        micros(step_s - sumo_s - getters_s - signals_s)
    );
    println!("  population control  {:.3}", micros(control_s));
    Ok(())
}

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let folder = tempfile::tempdir()?;
    let sumo_home = Path::new(env!("CARAWARE_BUILD_SUMO_HOME"));
    for junctions in ["priority", "traffic_light"] {
        println!("12 × 12 junctions of type {junctions}:");
        measure(&grid(sumo_home, folder.path(), junctions)?, sumo_home)?;
    }
    Ok(())
}
