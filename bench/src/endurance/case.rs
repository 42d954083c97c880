//! The runs that are disturbed: small ones of four kinds, so that many disturbances meet a start, an update, a commit or an evaluation.

use std::{
    path::{Path, PathBuf},
    process::{Command, Stdio},
};

use caraware::{failure::Exit, install::Install};

use crate::target::Target;

/// Settings of all cases: few road users, short episodes with evaluations between, a checkpoint after every second update. A process that
/// hangs is replaced soon.
const SETTINGS: [&str; 8] = [
    "run.stall_s=15",
    "run.on_stall=replace",
    "episode.training_episodes=6",
    "episode.evaluation_interval=2",
    "trainer.horizon=600",
    "trainer.batch_size=300",
    "trainer.checkpoint_interval=2",
    "trainer.matmul_precision=float32",
];
/// The first is of the case with messages between vehicles.
static TOWN: [&str; 6] = [
    "v2x.share=0.5",
    "traffic.cavs=6",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "episode.ticks=300",
    "episode.evaluation_ticks=50",
];
/// The world waits for the policy's actions at every tick.
const HEROES: [&str; 8] = [
    "traffic.heroes=4",
    "traffic.others=3",
    "traffic.pedestrians=3",
    "task.time_limit_s=10",
    "episode.ticks=300",
    "episode.evaluation_ticks=50",
    "trainer.network=mlp",
    "trainer.hidden=[16]",
];
const GRID: [&str; 6] = [
    "run.envs=2",
    "record.manner=lossless",
    "episode.ticks=200",
    "episode.evaluation_ticks=50",
    "map.origin_latitude_deg=52",
    "map.origin_longitude_deg=10",
];
/// A vehicle enters the grid every second for five minutes.
const VEHICLES: u32 = 300;
const ROUTES: [&str; 4] = [
    "A0A1 A1A2 A2A3 A3B3 B3C3",
    "D3D2 D2C2 C2B2 B2B1 B1A1",
    "C0C1 C1C2 C2D2 D2D3",
    "B3B2 B2B1 B1C1 C1D1 D1D0",
];

/// A configuration whose runs are disturbed.
#[derive(Debug)]
pub struct EnduranceCase {
    /// Its name in the report.
    pub name: &'static str,
    /// What `caraware train` runs.
    input: PathBuf,
    settings: &'static [&'static str],
    /// Number of environments.
    pub envs: u32,
    /// The process that the other cases' runs do not have, if there is one.
    own: Option<Target>,
    /// A handover goes to a learner of another kind and back, instead of to the same.
    pub learners_take_turns: bool,
    /// False in the driving task: a simulator that dies is made again with logged actions, and a full disk leaves gaps in their log.
    pub survives_a_full_disk: bool,
}

impl EnduranceCase {
    /// The town with a step of 0.1 s, with one learner, with two in turn and with heroes, and in `directory` a generated `.sumocfg` with a
    /// step of 1 s and two environments.
    ///
    /// # Errors
    /// SUMO's programs are missing, or the directory is not writable.
    pub fn all(directory: &Path) -> Result<[Self; 4], Exit> {
        let sumocfg = generate(directory)?;
        Ok([
            Self {
                name: "town",
                input: "town".into(),
                settings: &TOWN,
                envs: 1,
                own: Some(Target::V2x),
                learners_take_turns: false,
                survives_a_full_disk: true,
            },
            Self {
                name: "grid",
                input: sumocfg,
                settings: &GRID,
                envs: 2,
                own: Some(Target::Recorder),
                learners_take_turns: false,
                survives_a_full_disk: true,
            },
            Self {
                name: "learners",
                input: "town".into(),
                settings: &TOWN[1..],
                envs: 1,
                own: None,
                learners_take_turns: true,
                survives_a_full_disk: true,
            },
            Self {
                name: "heroes",
                input: "driving".into(),
                settings: &HEROES,
                envs: 1,
                own: None,
                learners_take_turns: false,
                survives_a_full_disk: false,
            },
        ])
    }

    /// True if its runs have such a process.
    #[must_use]
    pub fn has(&self, target: Target) -> bool {
        self.own == Some(target) || !matches!(target, Target::V2x | Target::Recorder)
    }

    /// Arguments that train on it as the run `name`, at `pace` simulated seconds per second (0: as fast as possible), with the fan-out
    /// on `port`.
    #[must_use]
    pub fn arguments(&self, name: &str, pace: f64, port: Option<u16>) -> Vec<String> {
        let fanout = port.map_or_else(
            || "fanout.enabled=false".to_owned(),
            |port| format!("fanout.listen=tcp/127.0.0.1:{port}"),
        );
        let settings = SETTINGS
            .iter()
            .chain(self.settings)
            .map(|setting| (*setting).to_owned());
        let settings = settings.chain([fanout, format!("run.real_time_factor={pace}")]);
        let head = [
            "train".to_owned(),
            self.input.display().to_string(),
            "--name".to_owned(),
            name.to_owned(),
        ];
        head.into_iter()
            .chain(settings.flat_map(|setting| ["--set".to_owned(), setting]))
            .collect()
    }
}

/// Writes a grid with a vehicle every second and its `.sumocfg`.
fn generate(directory: &Path) -> Result<PathBuf, Exit> {
    let netgenerate = Install::find()?.sumo_program("netgenerate");
    let status = Command::new(&netgenerate)
        .args(["--grid", "--grid.number", "4", "--seed", "3", "-o", "grid.net.xml"])
        .current_dir(directory)
        // Without it netgenerate warns that it does not validate what it writes.
        .env("SUMO_HOME", netgenerate.ancestors().nth(2).unwrap_or(directory))
        .stdout(Stdio::null())
        .status()
        .map_err(|error| Exit::io("start", &netgenerate, &error))?;
    if !status.success() {
        return Err(Exit::run(
            format!("netgenerate ended with {status}"),
            "its message is above",
        ));
    }
    let vehicles: String = (0..VEHICLES)
        .zip(ROUTES.iter().cycle())
        .map(|(second, route)| {
            format!("<vehicle id=\"{second}\" depart=\"{second}\"><route edges=\"{route}\"/></vehicle>\n")
        })
        .collect();
    write(
        &directory.join("grid.rou.xml"),
        &format!("<routes>\n{vehicles}</routes>\n"),
    )?;
    let input = "<input><net-file value=\"grid.net.xml\"/><route-files value=\"grid.rou.xml\"/></input>";
    let time = "<time><step-length value=\"1\"/></time>";
    let sumocfg = directory.join("grid.sumocfg");
    write(&sumocfg, &format!("<configuration>{input}{time}</configuration>\n"))?;
    Ok(sumocfg)
}

fn write(path: &Path, text: &str) -> Result<(), Exit> {
    std::fs::write(path, text).map_err(|error| Exit::io("write", path, &error))
}
