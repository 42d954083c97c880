//! The command line.

use std::{ffi::OsString, path::PathBuf};

use clap::{
    Args, Parser, Subcommand, ValueEnum,
    builder::{PossibleValue, PossibleValuesParser, TypedValueParser},
};
use ipc_schema::{config::ChunkCompression, sensor::SensorSelection};

use serde::{
    Deserialize,
    de::{
        IntoDeserializer,
        value::{Error as ValueError, StrDeserializer},
    },
};

use crate::{failure::Exit, import::BoundingBox, scenario_settings};

/// Co-simulation bridge: SUMO traffic with sensing vehicles, for a learner in another process.
#[derive(Debug, Parser)]
#[command(name = "caraware", version, about, long_about = LONG, after_help = AFTER, max_term_width = 110)]
pub struct Cli {
    /// The subcommand.
    #[command(subcommand)]
    pub command: Subcommands,
}

const LONG: &str = "Co-simulation bridge: SUMO traffic with sensing vehicles, for a learner in another process.\n\n\
SUMO moves the traffic; a nanoscopic core mirrors every vehicle with real dynamics; sensors observe it; a PyTorch process learns \
from the observations where every vehicle is. Each part is its own process, and all processes share memory.";

const AFTER: &str = "Examples:
  caraware train                                  learn on the town with the default preset
  caraware train --set traffic.cavs=8 --set run.seed=7
  caraware simulate my.sumocfg                    your own scenario, every vehicle sensing
  caraware train --viewer                         learn, and open a viewer
  caraware play town-1                            compare what the run has learnt with a Kalman filter
  caraware ps                                     list the processes of live runs, from another terminal
  caraware view --web                             watch a live run in a browser
  caraware panel                                  start, steer and compare runs in a browser
  caraware import quarter.osm quarter            make a scenario from a map: quarter/city.sumocfg
  caraware generate city --vehicles 20000         write a scenario of any size: city/city.sumocfg
  caraware bench lidar                            measure rays per second, compared with Open3D
  caraware handover town-1                        replace the trainer of a live run; nothing is lost
  caraware stop                                   end the run; a trainer writes a checkpoint first

Exit codes: 0 done, 1 the run failed, 2 usage or configuration, 3 something is missing on this machine, 130 interrupted.
All configuration keys: configs/README.md, or `caraware keys`";

/// The subcommands.
#[derive(Debug, Subcommand)]
pub enum Subcommands {
    /// Simulate and learn
    #[command(after_help = RESUME)]
    Train(TrainArgs),
    /// Run the policy of a checkpoint without learning, until Ctrl-C
    #[command(after_help = PLAY)]
    Play(PlayArgs),
    /// Simulate without learning; a `.sumocfg` runs to its end
    Simulate(RunArgs),
    /// Show the processes of every live run
    Ps {
        /// Name of a run; all live runs if not given
        run: Option<String>,
        /// Print JSON, for other programs
        #[arg(long)]
        json: bool,
    },
    /// Print how a live run fares as lines of JSON, or serve it to Prometheus
    #[command(after_help = METRICS)]
    Metrics(MetricsArgs),
    /// Write what runs have reached, with plots and a comparison, as Markdown or HTML
    #[command(
        disable_help_flag = true,
        after_help = "`caraware report --help` lists the options; docs/metrics.md describes what is written."
    )]
    Report {
        /// The runs and the options, as the module `caraware.report.document` takes them
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT")]
        arguments: Vec<OsString>,
    },
    /// Replace the trainer of a live run; the simulation continues, and no observation is lost
    #[command(after_help = HANDOVER)]
    Handover(HandoverArgs),
    /// The former name of `handover`; the refusal names the new one.
    #[command(hide = true, disable_help_flag = true)]
    Swap {
        /// Anything.
        #[arg(trailing_var_arg = true, allow_hyphen_values = true)]
        arguments: Vec<OsString>,
    },
    /// Pause, step or reset a live simulation, switch sensors, place vehicles
    #[command(after_help = CONTROL)]
    Control(ControlArgs),
    /// End a run in order, with a report; a trainer writes a checkpoint first
    Stop {
        /// Name of the run, or its directory; may be left out if only one is alive
        run: Option<String>,
    },
    /// Watch a live run: map, vehicles, estimates, point clouds and figures, in a window or a browser
    #[command(after_help = VIEW)]
    View(ViewArgs),
    /// Start, steer and compare runs in a browser on this machine; each of its actions is a command, which it shows
    #[command(after_help = PANEL)]
    Panel(PanelArgs),
    /// List the configuration keys: default, allowed values, unit and meaning
    Keys {
        /// A key, or the beginning of keys, such as `trainer`; all keys if not given
        prefix: Option<String>,
        /// Print JSON, with the presets, for other programs
        #[arg(long, conflicts_with = "prefix")]
        json: bool,
    },
    /// Show in which settings and results runs differ
    Compare(CompareArgs),
    /// Record a live run into a file; the run does not wait for it (`train --record` records without loss)
    Record(RecordArgs),
    /// Name the first tick and field in which two recordings differ
    Diff(DiffArgs),
    /// Write a recording in the format of other tools, one part for each episode, with a data card
    Export(ExportArgs),
    /// Play a recording to viewers, or to a trainer in the place of the simulators
    #[command(after_help = REPLAY)]
    Replay(ReplayArgs),
    /// Write a city and its traffic, of any size, as a scenario of SUMO
    Generate(GenerateArgs),
    /// Make a scenario of SUMO from a map: roads, signals, pavements, buildings, trees and traffic
    #[command(after_help = IMPORT)]
    Import(ImportArgs),
    /// Measure a part of caraware on this machine, compared with its peers
    #[command(
        disable_help_flag = true,
        after_help = "`caraware bench --help` lists the parts and the options."
    )]
    Bench {
        /// The part to measure and its options, as the program `caraware-bench` takes them
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT")]
        arguments: Vec<OsString>,
    },
    /// Search for the values of keys with which runs do best
    #[command(
        disable_help_flag = true,
        after_help = "`caraware study --help` lists the options; docs/trials.md describes them."
    )]
    Study {
        /// The study and its options, as the module `caraware.trials` takes them
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT")]
        arguments: Vec<OsString>,
    },
    /// Measure a table of the docs again, and fail where a figure leaves its interval
    #[command(
        disable_help_flag = true,
        after_help = "`caraware reproduce --help` lists the tables and the options; docs/reproduce.md describes them."
    )]
    Reproduce {
        /// The table and its options, as the module `caraware.study.reproduce` takes them
        #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ARGUMENT")]
        arguments: Vec<OsString>,
    },
    /// Report what is missing on this machine and what dead runs left
    Doctor {
        /// Remove what dead runs left in shared memory
        #[arg(long)]
        clean: bool,
    },
}

const HANDOVER: &str = "Examples:
  caraware handover                                      replace the trainer by its present code, after an upgrade
  caraware handover town-1 --set trainer.learning_rate=0.001
  caraware handover --checkpoint runs/town-0/checkpoints/update-000400
  caraware handover --now --timeout-s 30                 do not wait for the next update

The successor starts beside the old trainer. Once it is ready, the old trainer writes a checkpoint and leaves. If the successor
fails, the handover is refused and the old trainer continues; if it fails before its first commit, the one before it returns.
Trainers that learn together are replaced together. With --now they do not write a checkpoint: their successors begin at the
newest one that all have, and learn again from what came after it (docs/parallel.md).";

const RESUME: &str = "Examples:
  caraware train                                             the default preset, from the beginning
  caraware train --resume town-1                             continues from its newest sound checkpoint, in runs/town-1
  caraware train --resume runs/town-1/checkpoints/update-000300    starts another run from this checkpoint
  caraware train --restart                                   resumes the run by itself when its supervisor is killed

A run that was cut off before its first checkpoint resumes from its beginning.

On a CPU a resumed run ends with the same parameters, bit for bit, as a run that was never stopped.
Trainers that learn together resume together: torchrun … -m caraware.parallel --resume RUN (docs/parallel.md).";

const PLAY: &str = "Examples:
  caraware play town-1                                       the best checkpoint of the run, on its own map, on unseen seeds
  caraware play runs/town-1/checkpoints/update-000300
  caraware play town-1 my/scenario.sumocfg                   on other roads; the observation must have the same size
  caraware play town-1 --set run.real_time_factor=1          in real time, for a viewer

Shows the position errors of the policy and of an extended Kalman filter on the same samples, for each vehicle. It ends with
Ctrl-C or `caraware stop`, and then prints a report. On a terminal the table is live; otherwise a line appears every few seconds.
Viewers show the predictions.";

/// Arguments of `train`.
#[derive(Debug, Args, Clone)]
pub struct TrainArgs {
    /// Continue a run (its name or directory), or begin another run from one of its checkpoints (a directory)
    #[arg(long, value_name = "RUN", conflicts_with_all = ["config", "commands"])]
    pub resume: Option<String>,
    /// Resume the run by itself if its supervisor is killed; Ctrl-C, `caraware stop` and failures end it as always
    #[arg(long)]
    pub restart: bool,
    /// The run.
    #[command(flatten)]
    pub run: RunArgs,
}

/// Arguments of `play`.
#[derive(Debug, Args, Clone)]
pub struct PlayArgs {
    /// Name or directory of a run, to use its best checkpoint, or a checkpoint directory
    #[arg(value_name = "RUN|CHECKPOINT")]
    pub checkpoint: String,
    /// End after this many episodes of `episode.ticks` each [default: never]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    pub episodes: Option<u64>,
    /// The run; without CONFIG it has the configuration of the run that learnt.
    #[command(flatten)]
    pub run: RunArgs,
}

const CONTROL: &str = "Examples:
  caraware control pause
  caraware control step 10                       make ten ticks, then pause again
  caraware control sensor cav.3 gnss off         switch a sensor off until the episode ends
  caraware control sensor all lidar on
  caraware control start cav.3 A1B1              start a vehicle in place of cav.3 from edge A1B1
  caraware control destination cav.3 C2D2
  caraware control reset                         start the same episode again

Every command takes effect at a tick, which the answer names. The run's commands.jsonl lists those that change the simulation:
`caraware train --commands FILE` with the same configuration makes the same run again. From another host: `caraware-viewer command`.";

/// Arguments of `control`.
#[derive(Debug, Args, Clone)]
pub struct ControlArgs {
    /// Name of the run, or its directory; may be left out if only one is alive
    #[arg(long, global = true, value_name = "NAME")]
    pub run: Option<String>,
    /// Environment of the run [default: all of them]
    #[arg(long, global = true, value_name = "N")]
    pub env: Option<u32>,
    /// The command
    #[command(subcommand)]
    pub action: ControlAction,
}

/// The commands to a live simulation.
#[derive(Debug, Clone, Subcommand)]
pub enum ControlAction {
    /// Stop making ticks
    Pause,
    /// Continue making ticks
    Resume,
    /// Make some ticks, in whole SUMO steps, and pause again
    Step {
        /// Number of ticks
        #[arg(default_value_t = 1)]
        ticks: u64,
    },
    /// Start the episode again, with its own seed
    Reset,
    /// Switch a sensor until the episode ends
    Sensor {
        /// SUMO's id of the vehicle, or `all`
        vehicle: String,
        /// Which sensor
        #[arg(value_parser = sensors())]
        sensor: SensorSelection,
        /// On or off
        state: SwitchState,
    },
    /// Start a vehicle again from an edge
    Start {
        /// SUMO's id of the vehicle
        #[arg(allow_hyphen_values = true)]
        vehicle: String,
        /// SUMO's id of the edge
        #[arg(allow_hyphen_values = true)]
        edge: String,
    },
    /// Send a vehicle to an edge
    Destination {
        /// SUMO's id of the vehicle
        #[arg(allow_hyphen_values = true)]
        vehicle: String,
        /// SUMO's id of the edge
        #[arg(allow_hyphen_values = true)]
        edge: String,
    },
}

/// Parses the name of a sensor, or `all`.
fn sensors() -> impl TypedValueParser<Value = SensorSelection> {
    let choices = SensorSelection::every().map(|choice| PossibleValue::new(choice.name()).help(choice.description()));
    PossibleValuesParser::new(choices).try_map(|name| SensorSelection::by_name(&name).ok_or("no such sensor"))
}

/// State of a switched sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum SwitchState {
    /// The sensor delivers samples
    On,
    /// The sensor delivers nothing
    Off,
}

/// Arguments of `handover`.
#[derive(Debug, Args, Clone)]
pub struct HandoverArgs {
    /// Name of the run, or its directory; may be left out if only one is alive
    pub run: Option<String>,
    /// Change one setting of the trainer, e.g. --set trainer.learning_rate=0.001 (repeatable)
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Use the parameters of this checkpoint (a directory) instead of the run's newest
    #[arg(long, value_name = "DIRECTORY")]
    pub checkpoint: Option<PathBuf>,
    /// The old trainer leaves at the next tick, not after its next update: the successor gets again what it has not learnt
    #[arg(long)]
    pub now: bool,
    /// Refuse the handover, and keep the old trainer, if it has not left after this time
    #[arg(long, value_name = "SECONDS", value_parser = clap::value_parser!(f64))]
    pub timeout_s: Option<f64>,
}

const VIEW: &str = "Examples:
  caraware view                          show the run on this machine in a window (in a browser if there is no screen)
  caraware view --web                    print an address, for any number of browsers
  caraware view --save run.rrd           record
  caraware view run.rrd                  show the recording, with a time line
  caraware view town-2                   show one of several runs
  caraware view --vehicle cav.3 --lidar all
  caraware view --camera cav.3@front --radar cav.3
  caraware view --region 0 0 500 300     a part of a large map, in full detail
  caraware view --messages               what a vehicle knows from V2X messages, and its links
  caraware view tcp/127.0.0.1:7448       connect to an endpoint (`fanout.listen` of a run)

Several viewers may connect and leave at any time: no viewer delays the run. Ctrl-C ends only the viewer.
Another machine needs neither Rust nor this command, only the viewer (pip install ./viewer):
  ssh -N -L 7447:127.0.0.1:7447 HOST &
  caraware-viewer";

/// Arguments of `view`.
#[derive(Debug, Args, Clone)]
pub struct ViewArgs {
    /// Name of a run on this machine, an endpoint as tcp/HOST:PORT, or a file of --save [default: the only run alive]
    pub endpoint: Option<String>,
    /// Serve browsers on this machine, and print the address
    #[arg(long)]
    pub web: bool,
    /// Port of that address [default: 9090 if it is free]
    #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(1..))]
    pub web_port: Option<u16>,
    /// Record to a file; with --web, in addition to the browser
    #[arg(long, value_name = "F.rrd")]
    pub save: Option<PathBuf>,
    /// A vehicle to show (repeatable): figures and point cloud; the first is in the 3-D view, with its camera and radar
    #[arg(long, value_name = "ID")]
    pub vehicle: Vec<String>,
    /// Show the rectangle from X, Y to X, Y alone, in full detail (world metres)
    #[arg(long, value_names = ["X", "Y", "X", "Y"], num_args = 4, allow_negative_numbers = true)]
    pub region: Vec<f64>,
    /// Most frames drawn per second [default: 10]
    #[arg(long, value_name = "HZ")]
    pub rate: Option<f64>,
    /// Points of the LIDARs: those on road users, with the range ring (interest); all; or none (off) [default: interest]
    #[arg(long, value_parser = ["interest", "all", "off"])]
    pub lidar: Option<String>,
    /// A camera to show beside the 3-D view (repeatable), by its carrier, with @ and its name if it is a suite's; or "off" [default: that of the followed vehicle]
    #[arg(long, value_name = "ID[@SENSOR]")]
    pub camera: Vec<String>,
    /// A radar to show in the 3-D view (repeatable), in the same way; or "off" [default: that of the followed vehicle]
    #[arg(long, value_name = "ID[@SENSOR]")]
    pub radar: Vec<String>,
    /// What the followed vehicle knows from V2X messages, its links, and which stations have just sent
    #[arg(long)]
    pub messages: bool,
    /// Environment of the run [default: its first]
    #[arg(long, value_name = "N")]
    pub env: Option<u32>,
    /// Name of the run, if an endpoint has several
    #[arg(long, value_name = "NAME")]
    pub run: Option<String>,
    /// Credentials of the viewer.
    #[command(flatten)]
    pub credentials: Credentials,
}

const PANEL: &str = "Examples:
  caraware panel                    print an address, for a browser on this machine
  caraware panel --port 9191

The address holds a key that allows commands in your name: keep it to yourself. Ctrl-C ends the panel, and in order the runs and
viewers that it has started. Runs that were started elsewhere continue (docs/panel.md).";

/// Arguments of `panel`.
#[derive(Debug, Args, Clone)]
pub struct PanelArgs {
    /// Port of its address, on loopback [default: 9091 if it is free]
    #[arg(long, value_name = "PORT", value_parser = clap::value_parser!(u16).range(1..))]
    pub port: Option<u16>,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
}

/// Arguments of `compare`.
#[derive(Debug, Args, Clone)]
pub struct CompareArgs {
    /// Names or directories of two or more runs; a live run has no results yet
    #[arg(required = true, num_args = 2.., value_name = "RUN")]
    pub compared: Vec<String>,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
}

/// Credentials of a viewer, if the run requires them (docs/remote.md).
#[derive(Debug, Args, Clone, Default, PartialEq, Eq)]
#[command(next_help_heading = "Credentials, if the run requires them")]
pub struct Credentials {
    /// User name
    #[arg(long, value_name = "NAME", requires = "password_file")]
    pub user: Option<String>,
    /// File with the user's password, readable by you alone
    #[arg(long, value_name = "FILE", requires = "user")]
    pub password_file: Option<PathBuf>,
    /// Certificate of the authority behind a tls/ endpoint (PEM)
    #[arg(long, value_name = "FILE")]
    pub ca: Option<PathBuf>,
    /// Your own certificate, if the run requires one (PEM)
    #[arg(long, value_name = "FILE", requires = "key")]
    pub certificate: Option<PathBuf>,
    /// Its private key (PEM)
    #[arg(long, value_name = "FILE", requires = "certificate")]
    pub key: Option<PathBuf>,
}

/// How a viewer beside a run is shown.
#[derive(Debug, Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ViewerKind {
    /// In a window, or in a browser if there is no screen
    Window,
    /// In a browser; the address is printed
    Web,
}

const IMPORT: &str = "Examples:
  caraware import quarter.osm quarter        an extract of OpenStreetMap (its Export page, or osmium)
  caraware import land.osm.pbf quarter --bbox 13.68,51.99,13.69,52.01
  caraware import road.xodr road --duration-s 600 --demand 2
  caraware simulate quarter/city.sumocfg

The map stays under its own licence: data of OpenStreetMap under the ODbL, with attribution (docs/import.md).";

/// Arguments of `import`.
#[derive(Debug, Args, Clone)]
pub struct ImportArgs {
    /// The map: .osm, .osm.gz, .osm.pbf or .xodr
    pub file: PathBuf,
    /// Where to write city.sumocfg and its files: a new or empty directory
    pub directory: PathBuf,
    /// Simulated time, seconds
    #[arg(long, default_value_t = 3600.0)]
    pub duration_s: f64,
    /// Factor on the traffic of every kind
    #[arg(long, default_value_t = 1.0)]
    pub demand: f64,
    /// Seed of the trips and of SUMO: the same seed gives the same trips
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(..0x8000_0000))]
    pub seed: u32,
    /// The part of an .osm.pbf to import: degrees of west,south,east,north, such as --bbox 13.68,51.99,13.69,52.01
    #[arg(long, value_name = "W,S,E,N", allow_hyphen_values = true)]
    pub bbox: Option<BoundingBox>,
    /// An option for netconvert, such as --netconvert=--lefthand (repeatable)
    #[arg(long, value_name = "OPTION", allow_hyphen_values = true)]
    pub netconvert: Vec<String>,
}

/// Arguments of `generate`.
#[derive(Debug, Args, Clone)]
pub struct GenerateArgs {
    /// Where to write city.sumocfg, city.net.xml and city.rou.xml
    pub directory: PathBuf,
    /// Vehicles, all on the road from the first step to the last
    #[arg(long, default_value_t = 5000)]
    pub vehicles: u32,
    /// Simulated time, seconds
    #[arg(long, default_value_t = 60.0)]
    pub duration_s: f64,
    /// SUMO's step, seconds
    #[arg(long, default_value_t = 0.1)]
    pub step_s: f64,
    /// Seed of the routes and of SUMO: the same seed gives the same files
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Junctions along each side of the grid [default: enough for ten vehicles on a kilometre of lane]
    #[arg(long)]
    pub junctions: Option<u32>,
    /// Distance between two junctions, metres
    #[arg(long, default_value_t = 200.0)]
    pub block_m: f64,
    /// Lanes in each direction
    #[arg(long, default_value_t = 1)]
    pub lanes: u32,
    /// Speed limit, km/h
    #[arg(long, default_value_t = 50.0)]
    pub speed_kmh: f64,
}

const METRICS: &str = "Examples:
  caraware metrics                               a line of JSON each second until the run ends
  caraware metrics town-1 --interval-s 10 > town-1.jsonl
  caraware metrics --prometheus                  http://127.0.0.1:9464/metrics

What has no password listens on this machine alone, unless you give another address.";

/// Arguments of `metrics`.
#[derive(Debug, Args, Clone)]
pub struct MetricsArgs {
    /// Name of the run, or its directory; may be left out if only one is alive
    pub run: Option<String>,
    /// Wall time between two measurements, seconds
    #[arg(long, value_name = "SECONDS", default_value = "1", value_parser = interval)]
    pub interval_s: f64,
    /// Answer Prometheus at this address until the run ends
    #[arg(long, value_name = "HOST:PORT", num_args = 0..=1, require_equals = true, default_missing_value = "127.0.0.1:9464")]
    pub prometheus: Option<String>,
}

/// How a recording is compressed, by the names of `record.compression`.
fn compression() -> impl TypedValueParser<Value = ChunkCompression> {
    PossibleValuesParser::new(["none", "zstd"]).try_map(|name| {
        let name: StrDeserializer<'_, ValueError> = name.as_str().into_deserializer();
        ChunkCompression::deserialize(name)
    })
}

/// Parses a time between two measurements.
fn interval(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if (0.5..=86_400.0).contains(&seconds) => Ok(seconds),
        _ => Err("0.5 to 86400 seconds".to_owned()),
    }
}

/// Arguments of `export`.
#[derive(Debug, Args, Clone)]
pub struct ExportArgs {
    /// A recording: its file, or the directory or name of its run
    pub recording: PathBuf,
    /// Format: tables of vehicle-ticks (parquet, csv), a table of radar detections (radar), SUMO's floating car data (fcd),
    /// cooperative perception (opv2v), points and images with boxes (kitti, nuscenes), offline reinforcement learning (minari), or
    /// messages for the tools of robotics (foxglove, ros2)
    #[arg(long, value_name = "FORMAT", value_parser = ["parquet", "csv", "radar", "fcd", "opv2v", "kitti", "nuscenes", "minari", "foxglove", "ros2"])]
    pub to: String,
    /// Directory to write to; parts that it has are kept [default: export-FORMAT beside the recording]
    #[arg(long, value_name = "DIRECTORY")]
    pub output: Option<PathBuf>,
    /// Processes that write at a time [default: one for each core]
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    pub jobs: Option<u32>,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
}

const REPLAY: &str = "Examples:
  caraware replay town-1                         show the recording of the run town-1, in real time, to `caraware view`
  caraware replay runs/town-1/recording.mcap --viewer --speed 4 --from-s 120
  caraware replay town-1 --learn                 learn from the recording, at full speed
  caraware replay town-1 --learn --set trainer.learning_rate=1e-3

Learning from a lossless recording ends with the parameters of the recorded run, bit for bit, if no setting is changed.";

/// Arguments of `replay`.
#[derive(Debug, Args, Clone)]
pub struct ReplayArgs {
    /// A recording: its file, or the directory or name of its run
    pub recording: PathBuf,
    /// Play it to a trainer, which learns from it
    #[arg(long)]
    pub learn: bool,
    /// Simulated seconds per wall second; 0 = as fast as possible [default: 1, and 0 with --learn]
    #[arg(long, value_name = "FACTOR", value_parser = clap::value_parser!(f64))]
    pub speed: Option<f64>,
    /// Begin at this time of the run, seconds
    #[arg(long, value_name = "SECONDS", default_value_t = 0.0, conflicts_with = "learn")]
    pub from_s: f64,
    /// Change one setting of the trainer or of the fan-out (repeatable)
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Show no progress and no summary, only errors
    #[arg(long)]
    pub quiet: bool,
    /// Name of the replay's own run [default: that of the recorded run, "-replay" and the first free number]
    #[arg(long)]
    pub name: Option<String>,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
    /// Open a viewer: in a window, or with --viewer=web in a browser
    #[arg(long, value_name = "WHERE", num_args = 0..=1, require_equals = true, default_missing_value = "window")]
    pub viewer: Option<ViewerKind>,
    /// Credentials of that viewer.
    #[command(flatten)]
    pub credentials: Credentials,
}

/// Arguments of `record`.
#[derive(Debug, Args, Clone)]
pub struct RecordArgs {
    /// Name of the run, or its directory; may be left out if only one is alive
    pub run: Option<String>,
    /// The new file [default: recording.mcap in the run's directory, or the next free name]
    #[arg(long, value_name = "FILE")]
    pub output: Option<PathBuf>,
    /// A channel to record (repeatable) [default: those of `record.channels`]
    #[arg(long, value_name = "NAME")]
    pub channel: Vec<String>,
    /// How chunks are compressed [default: `record.compression` of the run]
    #[arg(long, value_name = "HOW", value_parser = compression())]
    pub compression: Option<ChunkCompression>,
    /// Environment of the run [default: its first]
    #[arg(long, value_name = "N")]
    pub env: Option<u32>,
}

/// Arguments of `diff`.
#[derive(Debug, Args, Clone)]
pub struct DiffArgs {
    /// A recording: its file, or the directory or name of its run
    pub first: PathBuf,
    /// Another
    pub second: PathBuf,
    /// Compare predictions as well, whose last bits depend on how many ticks were waiting for the network
    #[arg(long)]
    pub predictions: bool,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
}

/// Arguments of `train` and `simulate`.
#[derive(Debug, Args, Clone, Default)]
pub struct RunArgs {
    /// Preset name, .toml file, or .sumocfg file [default: town]
    pub config: Option<String>,
    /// Preset that a .toml or a .sumocfg begins from [default: the `preset` of the .toml, or town]
    #[arg(long, value_name = "NAME", requires = "config")]
    pub preset: Option<String>,
    /// Change one setting, e.g. --set traffic.cavs=8 (repeatable; see configs/README.md)
    #[arg(long, value_name = "KEY=VALUE")]
    pub set: Vec<String>,
    /// Environments side by side, each with its own seed, for one trainer; short for --set run.envs=N
    #[arg(long, value_name = "N")]
    pub envs: Option<u32>,
    /// Show no progress and no summary, only errors
    #[arg(long)]
    pub quiet: bool,
    /// Name of the run [default: CONFIG and the first free number]
    #[arg(long)]
    pub name: Option<String>,
    /// Repeat the commands of another run's commands.jsonl, each at its tick
    #[arg(long, value_name = "FILE")]
    pub commands: Option<PathBuf>,
    /// Begin a .sumocfg at this time of SUMO, in seconds or as H:M:S, as SUMO's own --begin
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub begin: Option<String>,
    /// End a .sumocfg at this time of SUMO, in seconds or as H:M:S, as SUMO's own --end
    #[arg(long, value_name = "TIME", allow_hyphen_values = true)]
    pub end: Option<String>,
    /// Let the files of a .sumocfg do all that SUMO can; short for --set traffic.trust_scenario=true
    #[arg(long)]
    pub trust_scenario: bool,
    /// Directory that holds run directories
    #[arg(long, default_value = "runs")]
    pub runs: PathBuf,
    /// Record the run into recording.mcap, without loss, or with --record=watching as far as `recorder` keeps up; short for --set
    /// record.manner=…
    #[arg(long, value_name = "MANNER", num_args = 0..=1, require_equals = true, default_missing_value = "lossless", value_parser = ["lossless", "watching"])]
    pub record: Option<String>,
    /// Open a viewer, as `caraware view` does: in a window, or with --viewer=web in a browser
    #[arg(long, value_name = "WHERE", num_args = 0..=1, require_equals = true, default_missing_value = "window")]
    pub viewer: Option<ViewerKind>,
    /// Credentials of that viewer.
    #[command(flatten)]
    pub credentials: Credentials,
}

impl RunArgs {
    /// Returns the arguments with every shorthand option replaced by the setting that it stands for.
    ///
    /// # Errors
    /// A time is no time.
    pub fn with_shorthands(&self) -> Result<Self, Exit> {
        let mut args = self.clone();
        for (option, key, time) in [
            ("--begin", "traffic.begin_s", args.begin.take()),
            ("--end", "traffic.end_s", args.end.take()),
        ] {
            if let Some(time) = time {
                let seconds = scenario_settings::time_argument(option, &time)?;
                args.set.push(format!("{key}={seconds}"));
            }
        }
        args.set.extend(args.envs.take().map(|envs| format!("run.envs={envs}")));
        args.set
            .extend(args.record.take().map(|manner| format!("record.manner={manner}")));
        if std::mem::take(&mut args.trust_scenario) {
            args.set.push("traffic.trust_scenario=true".to_owned());
        }
        Ok(args)
    }
}
