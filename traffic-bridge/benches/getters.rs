//! What the bridge adds to SUMO, in microseconds of processor time per road user and step: `cargo bench -p traffic-bridge`.

use std::{
    path::{Path, PathBuf},
    process::Command,
};

use traffic_bridge::{
    error::SumoError,
    frame::Frame,
    options::Options,
    population::{Population, Size},
    session::{Session, processor_time_s},
};

const STEPS: usize = 3000;
const WARM_UP_STEPS: usize = 100;
const SIZE: Size = Size {
    cavs: 250,
    others: 250,
    heroes: 0,
    pedestrians: 0,
};

/// A grid of 12 × 12 junctions, 150 m apart, of this type.
fn grid(sumo: &Path, folder: &Path, junctions: &str) -> std::io::Result<PathBuf> {
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
    Command::new(sumo.join("bin/netgenerate"))
        .env("SUMO_HOME", sumo)
        .args(["--default-junction-type", junctions])
        .args(size)
        .arg(&net)
        .output()?;
    Ok(net)
}

fn measure(net: &Path, sumo: &Path) -> Result<(), SumoError> {
    let mut session = Session::start(Options::population(sumo, net, &[], 0.1, 1)?)?;
    let mut population = Population::start(&mut session, SIZE, &[], 1)?;
    let (mut frame, mut control_s, mut step_s, mut rows) = (Frame::default(), 0.0, 0.0, 0);
    let mut before = session.cost();
    for step in 0..WARM_UP_STEPS + STEPS {
        if step == WARM_UP_STEPS {
            (control_s, step_s, rows, before) = (0.0, 0.0, 0, session.cost());
        }
        let start = processor_time_s();
        session.step(&mut frame)?;
        step_s += processor_time_s() - start;
        let start = processor_time_s();
        population.after_step(&mut session, &frame)?;
        control_s += processor_time_s() - start;
        rows += frame.states.len();
    }
    let cost = session.cost();
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
    let sumo = Path::new(env!("CARAWARE_BUILD_SUMO_HOME"));
    for junctions in ["priority", "traffic_light"] {
        println!("12 × 12 junctions of type {junctions}:");
        measure(&grid(sumo, folder.path(), junctions)?, sumo)?;
    }
    Ok(())
}
