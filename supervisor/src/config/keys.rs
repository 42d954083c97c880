//! The table of configuration keys: name, kind, unit, range, meaning. Checks, `--set` and `configs/README.md` derive from it.

use ipc_schema::{
    config::{KEYS_OF_A_KIND, LidarPattern},
    field::{FIELD_PRESETS, FIELDS},
    metric::PolicyMetric,
    neighbours::MOST_CANDIDATES,
};

use super::text_form::TextForm;

/// The values that a key allows.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum ValueKind {
    /// A number from `min` to `max`.
    Float {
        /// Least value.
        min: f64,
        /// Greatest value.
        max: f64,
    },
    /// A whole number from `min` to `max`.
    Integer {
        /// Least value.
        min: i64,
        /// Greatest value.
        max: i64,
    },
    /// true or false.
    Flag,
    /// One of these words.
    Choice(&'static [&'static str]),
    /// Any text.
    Text,
    /// A text of this form.
    TextOf(TextForm),
    /// Observation fields: a preset by name or a list of field names.
    Fields,
    /// The name of a metric of the policy.
    Metric,
    /// A list of any texts, which may be empty.
    Texts,
    /// A list of texts of this form, which may be empty.
    TextsOf(TextForm),
    /// `count` numbers from `min` to `max`; one number stands for all of them.
    Floats {
        /// How many.
        count: usize,
        /// Least value.
        min: f64,
        /// Greatest value.
        max: f64,
    },
    /// A shortest and a longest value, such as durations, from `min` to `max`; one number stands for both.
    Span {
        /// Least value.
        min: f64,
        /// Greatest value.
        max: f64,
    },
    /// A list of whole numbers from `min` to `max`.
    Integers {
        /// Least value.
        min: i64,
        /// Greatest value.
        max: i64,
    },
    /// A list of tables with these keys.
    Tables(&'static [ConfigKey]),
    /// A list of tables with these keys, or a ready-made suite by name.
    Suites(&'static [ConfigKey]),
}

/// One key.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct ConfigKey {
    /// Dotted path.
    pub path: &'static str,
    /// Allowed values.
    pub kind: ValueKind,
    /// Unit, or "" for a plain number or word.
    pub unit: &'static str,
    /// Meaning.
    pub meaning: &'static str,
    /// True if a configuration may leave the key unset.
    pub optional: bool,
}

const fn key(path: &'static str, kind: ValueKind, unit: &'static str, meaning: &'static str) -> ConfigKey {
    ConfigKey {
        path,
        kind,
        unit,
        meaning,
        optional: false,
    }
}

const fn float(path: &'static str, unit: &'static str, min: f64, max: f64, meaning: &'static str) -> ConfigKey {
    key(path, ValueKind::Float { min, max }, unit, meaning)
}

const fn integer(path: &'static str, unit: &'static str, min: i64, max: i64, meaning: &'static str) -> ConfigKey {
    key(path, ValueKind::Integer { min, max }, unit, meaning)
}

const fn floats(
    path: &'static str,
    unit: &'static str,
    count: usize,
    min: f64,
    max: f64,
    meaning: &'static str,
) -> ConfigKey {
    key(path, ValueKind::Floats { count, min, max }, unit, meaning)
}

const fn span(path: &'static str, max: f64, meaning: &'static str) -> ConfigKey {
    key(path, ValueKind::Span { min: 0.0, max }, "s", meaning)
}

const fn optional(path: &'static str, unit: &'static str, min: f64, max: f64, meaning: &'static str) -> ConfigKey {
    ConfigKey {
        optional: true,
        ..float(path, unit, min, max, meaning)
    }
}

const fn other(path: &'static str, kind: ValueKind, meaning: &'static str) -> ConfigKey {
    key(path, kind, "", meaning)
}

/// Keys of a roadside unit.
#[rustfmt::skip]
pub const ROADSIDE_UNIT_KEYS: &[ConfigKey] = &[
    other("v2x.roadside.id", ValueKind::Text, "Name, of which the station id follows; it is the unit's alone."),
    float("v2x.roadside.x_m", "m", -1e6, 1e6, "Place, world frame, within the map."),
    float("v2x.roadside.y_m", "m", -1e6, 1e6, "Place, world frame, within the map."),
    float("v2x.roadside.height_m", "m", 0.5, 100.0, "Height of antenna and sensors above the ground."),
    optional("v2x.roadside.range_m", "m", 1.0, 500.0, "Range in which it perceives road users. Unset = it perceives nothing."),
    optional("v2x.roadside.heading_deg", "deg", -360.0, 360.0, "Middle of its field of view, counter-clockwise from east. Unset = 0."),
    optional("v2x.roadside.field_of_view_deg", "deg", 1.0, 360.0, "Angle of its field of view. Unset = all around."),
    ConfigKey { optional: true, ..other("v2x.roadside.services", ValueKind::TextsOf(TextForm::RoadsideService), "What it sends: CAMs, CPMs of what it perceives, warnings that it heard once more (\"denm\"), and CPMs of everything that it hears and perceives, fused (\"map\", in place of \"cpm\"). Unset = CAMs, and CPMs with `range_m`.") },
];

/// Keys of a stage of the curriculum.
#[rustfmt::skip]
pub const STAGE_KEYS: &[ConfigKey] = &[
    ConfigKey { optional: true, ..integer("curriculum.stages.cavs", "vehicles", 0, 100_000, "Connected vehicles kept alive in this stage. Unset = `traffic.cavs`.") },
    ConfigKey { optional: true, ..integer("curriculum.stages.others", "vehicles", 0, 100_000, "Vehicles without sensors kept alive. Unset = `traffic.others`.") },
    ConfigKey { optional: true, ..integer("curriculum.stages.pedestrians", "persons", 0, 100_000, "Pedestrians kept alive. Unset = `traffic.pedestrians`.") },
    ConfigKey { optional: true, ..integer("curriculum.stages.heroes", "vehicles", 0, 1000, "Heroes kept alive (driving task). Unset = `traffic.heroes`.") },
    ConfigKey { optional: true, ..other("curriculum.stages.hero_turns", ValueKind::Choice(&["any", "left"]), "Routes of heroes. Unset = `traffic.hero_turns`.") },
    ConfigKey { optional: true, ..other("curriculum.stages.traffic_lights", ValueKind::Flag, "Whether traffic lights are on. Unset = `traffic.traffic_lights`.") },
    optional("curriculum.stages.speed_limit_factor", "", 0.1, 2.0, "Factor on all speed limits. Unset = `traffic.speed_limit_factor`."),
    ConfigKey { optional: true, ..integer("curriculum.stages.ticks", "ticks", 1, 1_000_000_000, "Length of a lesson. Unset = `episode.ticks`.") },
    ConfigKey { optional: true, ..other("curriculum.stages.restart", ValueKind::Flag, "True: every lesson begins with all vehicles at new random places. False: it continues where the one before ended. Unset = true.") },
    ConfigKey { optional: true, ..other("curriculum.stages.maps", ValueKind::Texts, "Maps of its lessons, by the names in `curriculum.maps`: a file's name without its ending (\"city\" for \"nets/city.net.xml\"). Unset = the first.") },
    ConfigKey { optional: true, ..other("curriculum.stages.map_choice", ValueKind::Choice(&["in_order", "random", "gradually_random"]), "Map of each lesson: \"in_order\", one map after the other; \"random\", drawn for each; \"gradually_random\", the first, and a share of lessons on a drawn one that grows from none to all over `until_lessons` (without: over what is left of `episode.training_episodes`). Without `restart` a stage stays on the map of its first lesson. Unset = \"in_order\".") },
    optional("curriculum.stages.noise", "", 0.0, 1000.0, "Factor on random errors and biases of all sensors. Unset = 1."),
    optional("curriculum.stages.blackout", "", 0.0, 1000.0, "Factor on the lengths of blackouts (`blackout.enabled`); 0 = none. Unset = 1."),
    optional("curriculum.stages.until_std", "", 0.0, 10.0, "The stage ends once the policy's standard deviation is at most this, in units of half the map."),
    ConfigKey { optional: true, ..other("curriculum.stages.until_metric", ValueKind::Metric, "The stage ends once the mean of this metric of the task in the samples of an update is `until_value` or better, such as until_metric = \"error_m\" with until_value = 6.0.") },
    optional("curriculum.stages.until_value", "", -1e9, 1e9, "The value that `until_metric` must reach, in the metric's unit: at most this for an error, at least this for progress."),
    ConfigKey { optional: true, ..integer("curriculum.stages.until_lessons", "lessons", 1, 1_000_000_000, "The stage ends after this many lessons, if not before. Without a deviation, a metric or a number of lessons it lasts to the end of training.") },
];

/// Keys of a suite.
#[rustfmt::skip]
pub const SUITE_KEYS: &[ConfigKey] = &[
    ConfigKey { optional: true, ..other("suite.preset", ValueKind::TextOf(TextForm::Suite), "Ready-made suite whose sensors it has; those of `suite.sensor` come beside them.") },
    ConfigKey { optional: true, ..other("suite.name", ValueKind::Text, "Name of the suite in messages and for `[[roadside]]`. Unset = that of `suite.preset`.") },
    ConfigKey { optional: true, ..other("suite.classes", ValueKind::TextsOf(TextForm::VehicleClass), "SUMO's vehicle classes of its carriers. Unset = every class.") },
    ConfigKey { optional: true, ..other("suite.types", ValueKind::Texts, "SUMO's vehicle types of its carriers (the first 32 bytes of a name count). Unset = every type.") },
    ConfigKey { optional: true, ..other("suite.ids", ValueKind::Texts, "SUMO ids of its carriers; `*` stands for any text. Unset = every id.") },
    optional("suite.share", "", 0.0, 1.0, "Share of the connected vehicles with these classes, types and ids that carry it, by a hash of `run.seed` and the id. Unset = 1."),
    ConfigKey { optional: true, ..integer("suite.first", "slots", 0, 100_000, "Of these vehicles, those in the first slots of the observation, this many. Unset = all slots.") },
    ConfigKey { optional: true, ..other("suite.sensor", ValueKind::Tables(SUITE_SENSOR_KEYS), "Its sensors, each a `[[suite.sensor]]`.") },
];

/// Keys of a sensor of a suite beside those of its section.
#[rustfmt::skip]
pub const SUITE_SENSOR_KEYS: &[ConfigKey] = &[
    other("suite.sensor.kind", ValueKind::Choice(&["gnss", "imu", "lidar", "camera", "radar"]), "What it is. Every other key of its section, such as `mount` and `width`, may follow and replaces the section's value for this sensor (\"gnss\" and \"imu\": `mount` alone)."),
    other("suite.sensor.name", ValueKind::Text, "Its name, unique in the suite."),
    ConfigKey { optional: true, ..integer("suite.sensor.period_ticks", "ticks", 1, 1_000_000, "Ticks between two samples. Unset = its `period_s`, or that of its section; a LIDAR: 1.") },
];

/// Keys of a carrier beside the road.
#[rustfmt::skip]
pub const ROADSIDE_KEYS: &[ConfigKey] = &[
    other("roadside.name", ValueKind::Text, "Its name in messages."),
    other("roadside.suite", ValueKind::Text, "Name of the suite that it carries. Heights of mounts count from its foot."),
    optional("roadside.x_m", "m", -1e7, 1e7, "Place in the world frame; with `y_m`."),
    optional("roadside.y_m", "m", -1e7, 1e7, "Place in the world frame; with `x_m`."),
    optional("roadside.longitude_deg", "deg", -180.0, 180.0, "Place; with `latitude_deg`, in the place of `x_m` and `y_m`."),
    optional("roadside.latitude_deg", "deg", -89.9, 89.9, "Place; with `longitude_deg`."),
    optional("roadside.z_m", "m", -10_000.0, 10_000.0, "Height of its foot. Unset = on the ground."),
    optional("roadside.yaw_deg", "deg", -360.0, 360.0, "Direction of its x axis, counter-clockwise from east. Unset = 0."),
];

/// Keys of entries of lists of tables.
const ENTRY_KEYS: [&[ConfigKey]; 5] = [
    STAGE_KEYS,
    SUITE_KEYS,
    SUITE_SENSOR_KEYS,
    ROADSIDE_KEYS,
    ROADSIDE_UNIT_KEYS,
];

/// Path of the sensors of a suite.
pub const SUITE_SENSORS: &str = "suite.sensor";

/// The key that a sensor of a suite of this kind takes from its section under this name.
#[must_use]
pub fn of_section(kind: &str, name: &str) -> Option<&'static ConfigKey> {
    let is_taken = match kind {
        "gnss" | "imu" => name == "mount",
        _ => !KEYS_OF_A_KIND.contains(&name),
    };
    let mut keys = KEYS.iter();
    keys.find(|key| is_taken && key.path.split_once('.') == Some((kind, name)))
}

/// Former names of keys, with the names that they have now.
const RENAMED_KEYS: &[(&str, &str)] = &[
    ("curriculum.steps", "curriculum.stages"),
    ("curriculum.stages.until_error_m", "curriculum.stages.until_metric"),
];

/// The name that a key has now, if `path` is a former name.
#[must_use]
pub fn renamed_to(path: &str) -> Option<&'static str> {
    let mut renamed = RENAMED_KEYS.iter();
    renamed.find_map(|(former, now)| (*former == path).then_some(*now))
}

/// All keys.
#[rustfmt::skip]
pub const KEYS: &[ConfigKey] = &[
    integer("run.seed", "", 0, i64::MAX, "Seed of all random numbers: traffic, noise, the learner. The same seed gives the same bytes."),
    integer("run.envs", "", 1, 64, "Environments side by side, each with its own SUMO, dynamics and sensors and a seed derived from `run.seed`; one trainer learns from all (docs/parallel.md)."),
    integer("run.first_env", "", 0, 1_000_000, "Number of this run's first environment among those of all runs that learn together; `caraware.parallel` sets it."),
    float("run.tick_s", "s", 0.001, 10.0, "Length of a tick, the observation period: one observation of every connected vehicle."),
    integer("run.sub_steps", "", 1, 1000, "Sub-steps in a tick (10 in 0.1 s: dynamics at 100 Hz)."),
    integer("run.window_ticks", "ticks", 1, 256, "Ticks that `traffic-bridge`, `sim-core` and `sensor-daemon` may each be ahead of the next process. Where a SUMO step has several ticks, `traffic-bridge` may be at least three steps ahead."),
    integer("run.journal_mib", "MiB", 1, 1_048_576, "Limit of memory (the first 64) and disk for the journal, from which a restarted trainer receives observations again. At the limit the oldest are dropped."),
    float("run.real_time_factor", "s/s", 0.0, 1000.0, "Simulated seconds per wall second; 0 = as fast as possible."),
    float("run.stall_s", "s", 1.0, 1e6, "A process that makes no progress for this long, although no other process holds it up, hangs: it is named in its log, in the progress line, by `caraware ps` and in the viewer. It must be longer than the longest SUMO step and the longest update."),
    other("run.on_stall", ValueKind::Choice(&["report", "replace"]), "What else happens to a process that hangs: \"report\", nothing; \"replace\", it is killed and started again, as after any death."),
    float("run.ready_s", "s", 1.0, 1e6, "A process that is not ready this long after its start is killed. The first start of a run then fails, and a handover is refused. Raise it for a net that SUMO loads for minutes."),
    float("traffic.step_s", "s", 0.001, 10.0, "Length of a SUMO step: a whole number of ticks. Unset with a `.sumocfg` = its `step-length`, and a tick that divides it (unless `run.tick_s` is set)."),
    integer("traffic.cavs", "vehicles", 0, 100_000, "Connected vehicles kept alive on random routes (maps with population control); at least 1, except in the driving task."),
    integer("traffic.others", "vehicles", 0, 100_000, "Vehicles without sensors kept alive (maps with population control)."),
    integer("traffic.pedestrians", "persons", 0, 100_000, "Pedestrians kept alive (maps with population control)."),
    integer("traffic.heroes", "vehicles", 0, 1000, "Heroes, driven by actions, kept alive (maps with population control; driving task only)."),
    other("traffic.hero_route", ValueKind::Texts, "Edges of the route of every hero, from its first to its last (maps with population control); [] = at random."),
    other("traffic.hero_turns", ValueKind::Choice(&["any", "left"]), "Routes of heroes that are drawn at random: any, or those with at least one left turn at a junction that has other ways, too (maps with population control)."),
    other("traffic.traffic_lights", ValueKind::Flag, "Traffic lights are on. False = all are off, and vehicles give way by the rules of the junction (maps with population control)."),
    float("traffic.speed_limit_factor", "", 0.1, 2.0, "Factor on all speed limits (maps with population control)."),
    other("traffic.hero_ids", ValueKind::Texts, "Ids of the vehicles of a `.sumocfg` that are heroes, driven by actions (driving task only)."),
    float("traffic.cav_share", "", 0.0, 1.0, "Share of a `.sumocfg`'s vehicles that carry sensors."),
    integer("traffic.max_cavs", "vehicles", 0, 100_000, "Limit of vehicles with sensors at a time: a departing vehicle gets sensors while fewer are on the road; 0 = no limit."),
    float("traffic.held_out_trips", "", 0.0, 0.9, "Fraction of origin–destination pairs reserved for evaluation: training episodes never use them, and evaluation episodes use no others (maps with population control); 0 = none reserved."),
    optional("traffic.scale", "", 0.001, 1000.0, "Factor on the demand of a `.sumocfg`, as SUMO's `--scale`; unset = the scenario's own."),
    other("traffic.engine", ValueKind::Choice(&["libsumo", "traci", "traci_gui"]), "Where SUMO runs: \"libsumo\", inside `traffic-bridge`; \"traci\", in a process of its own that TraCI scripts connect to as well; \"traci_gui\", the same with SUMO's window (docs/traci.md)."),
    other("traffic.traci_host", ValueKind::Text, "Host of a SUMO that runs already and waits on `traffic.traci_port` for `traffic-bridge`; \"\" = `traffic-bridge` starts SUMO (docs/traci.md)."),
    integer("traffic.traci_order", "", 1, 1_000_000, "Place of `traffic-bridge` among the clients of that SUMO (TraCI's `setOrder`)."),
    integer("traffic.traci_port", "", 1024, 65535, "Port on which SUMO's own process listens; that of environment n is n higher. A SUMO that `traffic-bridge` starts listens on all interfaces."),
    integer("traffic.traci_clients", "", 1, 64, "TraCI clients that it waits for before it begins, `traffic-bridge` among them: 2 for one script."),
    other("traffic.lane_positions", ValueKind::Flag, "Read where SUMO has each road user – lane, edge, place on its route – and send it with SUMO's absolute time on the channel `lane-position` (docs/recording.md). False = these are not read."),
    optional("traffic.begin_s", "s", -1e9, 1e9, "SUMO's time at the begin of a `.sumocfg`, as `--begin` and SUMO's own `--begin` set it; unset = the scenario's own."),
    optional("traffic.end_s", "s", -1e9, 1e9, "SUMO's time at the end of a `.sumocfg`, as `--end` and SUMO's own `--end` set it; unset = the scenario's own."),
    other("traffic.trust_scenario", ValueKind::Flag, "Let the files of a `.sumocfg` do all that SUMO can, as `--trust-scenario` does; false = refuse what connects, writes outside the run's directory or loads another configuration."),
    integer("traffic.max_road_users", "", 1, 1_000_000, "Limit of road users alive at once; it sets the size of shared memory."),
    optional("map.origin_latitude_deg", "deg", -89.9, 89.9, "Latitude of the net's (0, 0); only for a net without projection."),
    optional("map.origin_longitude_deg", "deg", -180.0, 180.0, "Longitude of the net's (0, 0); only for a net without projection."),
    integer("episode.ticks", "ticks", 1, 1_000_000_000, "Length of a training episode. At its end all road users start again at random places."),
    integer("episode.training_episodes", "", 1, 1_000_000_000, "Training episodes of the run."),
    integer("episode.evaluation_interval", "episodes", 0, 1_000_000_000, "Training episodes between two evaluations; 0 = only at the end."),
    integer("episode.evaluation_ticks", "ticks", 1, 1_000_000_000, "Length of an evaluation episode."),
    integer("episode.final_evaluations", "", 1, 1_000_000, "Evaluation episodes at the end of the run; their mean error is reported."),
    other("episode.whole_scenario", ValueKind::Flag, "Train on a `.sumocfg` unchanged: one episode with its own seed, to its own end."),
    other("curriculum.stages", ValueKind::Tables(STAGE_KEYS), "Stages of training in order, each a `[[curriculum.stages]]`; [] = none. Training then consists of lessons of `episode.ticks` ticks (or the stage's `ticks`), at most `episode.training_episodes` of them. Evaluations use the base configuration (docs/curriculum.md)."),
    other("curriculum.maps", ValueKind::TextsOf(TextForm::Map), "The map, or several that stages choose from: \"town\", \"avenue\" (roads of up to three lanes), a `.net.xml`, or a `.sumocfg`, of which the net and the buildings are used; all with population control. Evaluations use the first. Predictions and normalised positions are in the smallest box that holds all maps. [] = [\"town\"]."),
    other("curriculum.log", ValueKind::Text, "`curriculum.jsonl` of a run, whose stages `caraware simulate` repeats without a learner; \"\" = none."),
    other("task.kind", ValueKind::Choice(&["localisation", "driving", "lane", "messages"]), "Meaning of the trainer's output: a position for every connected vehicle; steering and acceleration for every hero; the lane and the lateral position in it of every connected vehicle (docs/seeing.md); or which perceived objects every connected vehicle tells others of (docs/messages.md)."),
    other("task.action", ValueKind::Choice(&["place", "correction"]), "What an action of the localisation task names: a place in the box of the map, as in the paper, or a correction of the newest fix. `caraware train SCENARIO` corrects, unless it is set."),
    float("task.time_limit_s", "s", 0.1, 1e6, "Longest trajectory of a hero. Then it is truncated, and another hero starts."),
    optional("task.blocked_s", "s", 0.1, 1e6, "A hero that stands for so long is blocked: its trajectory is terminated. Unset = never."),
    other("task.driver", ValueKind::Choice(&["actions", "sumo"]), "What moves the heroes: the trainer's actions, or SUMO's own driver, which the trainer then only watches (docs/driving.md)."),
    other("task.ends_at_infractions", ValueKind::Flag, "A red light that a hero runs, and a second of driving against the traffic, end its episode; otherwise they are only counted."),
    float("task.message_cost", "s/kB", 0.0, 1e6, "Messages task: what 1000 bytes of CPMs cost, in seconds for which another station newly knows an object."),
    other("task.reward", ValueKind::Text, "Reward of the driving task: \"\" for its own, or a Python function \"package.module:function\" (docs/driving.md)."),
    other("task.begin_from", ValueKind::Text, "Checkpoint directory or `.safetensors` file whose parameters a new policy begins with, such as a clone of SUMO's driver; \"\" for none."),
    other("vehicle.cav_model", ValueKind::Choice(&["kinematic", "dynamic"]), "Model of connected vehicles: without slip, or with tyres, load transfer, roll and pitch."),
    other("vehicle.other_model", ValueKind::Choice(&["kinematic", "dynamic"]), "Model of vehicles without sensors."),
    other("vehicle.hero_model", ValueKind::Choice(&["kinematic", "dynamic", "rigid_body"]), "Model of heroes; \"rigid_body\" is a body on four ray-cast wheels."),
    other("vehicle.class_models", ValueKind::TextsOf(TextForm::ClassModel), "Models by SUMO vehicle class, such as [\"truck=kinematic\", \"bus=dynamic\"]; they have precedence over the three above."),
    float("vehicle.preview_s", "s", 0.0, 3.0, "How far ahead a mirror sees SUMO's path, and how far it is behind SUMO, at least half a frame. It then bends, brakes and starts as gradually as a vehicle can, and brakes before a bend that is too fast for it. With a `.sumocfg`, or with `curriculum.maps`, 1.5 unless you set it or the task is driving."),
    float("vehicle.lane_change_s", "s", 0.1, 60.0, "Time over which SUMO's instantaneous lane change is spread."),
    float("vehicle.max_road_wheel_angle_rad", "rad", 0.05, 1.5, "Largest steering angle of the front wheels."),
    float("vehicle.max_road_wheel_rate_radps", "rad/s", 0.05, 20.0, "Largest rate of that angle."),
    float("vehicle.max_accel_mps2", "m/s²", 0.1, 50.0, "Largest acceleration of the mirrored vehicle, unless its SUMO type accelerates more."),
    float("vehicle.max_decel_mps2", "m/s²", 0.1, 50.0, "Largest deceleration of the mirrored vehicle, unless its SUMO type brakes harder."),
    float("vehicle.steering_ratio", "", 0.0, 100.0, "Steering-wheel angle per road-wheel angle of every vehicle; 0 = each that of its parameter set."),
    float("vehicle.resynchronise_m", "m", 0.1, 1000.0, "Tracking error (reference minus front bumper) above which a vehicle is resynchronised: set onto SUMO's position, flagged and counted."),
    float("vehicle.leave_path_m", "m", 0.1, 1000.0, "Distance that the reference may leave SUMO's path where that cannot be driven; above it the vehicle is resynchronised."),
    other("region.polygon_m", ValueKind::TextsOf(TextForm::Corner), "Vehicles sense only inside this polygon: its corners in order, each \"x y\" (m, world). All traffic is simulated. [] = no polygon."),
    floats("region.centre_m", "m", 2, -1e7, 1e7, "Centre x, y (world) of the circle inside which vehicles sense (`region.radius_m`)."),
    float("region.radius_m", "m", 0.0, 1e7, "Radius of that circle; 0 = no circle."),
    other("road.surface", ValueKind::Choice(&["dry", "wet", "snow"]), "Condition of the road: it scales the friction of the tyres."),
    other("scene.obstacles", ValueKind::TextsOf(TextForm::Obstacle), "Obstacles, each \"name x y heading\": a prop by name, its centre (m, world), its heading (degrees counter-clockwise from east, 0 if left out)."),
    integer("scene.random_props", "", 0, 1_000_000, "Props placed at random beside the road, the same for the same `run.seed`."),
    float("scene.building_height_m", "m", 0.1, 1000.0, "Height of a building whose polygon and type state none."),
    other("scene.meshes", ValueKind::TextsOf(TextForm::Mesh), "Triangle meshes that LIDARs see, each \"file.obj x y heading\": its origin on the ground (m, world), its heading (degrees counter-clockwise from east, 0 if left out)."),
    other("collision.detect", ValueKind::Flag, "Detect contacts of connected vehicles and heroes with road users, buildings and obstacles."),
    other("collision.ends_trajectory", ValueKind::Flag, "A contact ends the trajectory of a connected vehicle (terminated), as it always ends a hero's."),
    float("weather.rain_mmph", "mm/h", 0.0, 200.0, "Rain: a dry road becomes wet, and LIDAR returns grow weaker and get lost (2.5 light, 10 moderate, 50 violent)."),
    float("weather.visibility_m", "m", 10.0, 1e6, "Meteorological optical range; fog (below 1000 m) attenuates LIDAR returns."),
    float("weather.sun_elevation_deg", "deg", -90.0, 90.0, "Height of the sun above the horizon; below 0 it is night."),
    float("weather.sun_azimuth_deg", "deg", 0.0, 360.0, "Direction of the sun, clockwise from north."),
    float("weather.sunlight", "", 0.0, 1.0, "Direct sunlight: 1 = clear sky, 0 = overcast. It adds noise to LIDAR ranges, most towards the sun."),
    float("weather.air_temperature_c", "°C", -60.0, 60.0, "Temperature of the air, for thermal images (`camera.infrared`)."),
    float("gnss.period_s", "s", 0.001, 100.0, "Time between fixes: a whole number of ticks."),
    floats("gnss.noise_std_deg", "deg", 2, 0.0, 1.0, "Standard deviation of latitude and longitude (5e-5: 5.57 m), degrees of arc on the ground."),
    floats("gnss.bias_deg", "deg", 2, -1.0, 1.0, "Bias of latitude and longitude, degrees of arc on the ground."),
    floats("gnss.noise_std_m", "m", 3, 0.0, 10_000.0, "Standard deviation east, north and up, in addition to `gnss.noise_std_deg`."),
    floats("gnss.bias_m", "m", 3, -10_000.0, 10_000.0, "Bias east, north and up, in addition to `gnss.bias_deg`."),
    floats("gnss.unit_bias_std_m", "m", 3, 0.0, 10_000.0, "Standard deviation over receivers of a constant error east, north and up: each receiver has its own."),
    floats("gnss.mount", "m", 3, -100.0, 100.0, "Place of a vehicle's antenna: x, y, z from the centre of the rear axle on the ground. The fix is that of the antenna, the truth that of the rear axle."),
    floats("gnss.correlated_std_m", "m", 3, 0.0, 10_000.0, "Standard deviation of the slow error (first-order Gauss–Markov) east, north and up."),
    float("gnss.correlation_time_s", "s", 0.001, 1e6, "Time in which the correlation of the slow error falls to 1/e."),
    other("gnss.sky_view", ValueKind::Flag, "Buildings block satellites: fewer of them, a worse fix, reflections off walls."),
    other("gnss.pedestrians", ValueKind::Flag, "Pedestrians carry a smartphone: a slot in the observation with GNSS and IMU (localisation task only)."),
    float("gnss.pedestrian_noise_factor", "", 0.0, 1000.0, "Errors of a smartphone's fix as a multiple of a vehicle's."),
    span("gnss.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("gnss.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    float("imu.period_s", "s", 0.00001, 100.0, "Time between samples: a whole number of sub-steps; all samples of a tick are delivered."),
    other("imu.convention", ValueKind::Choice(&["kinematic", "specific_force", "carla"]), "\"kinematic\": no gravity; \"specific_force\": at rest 9.80665 m/s² upwards; \"carla\": the same in CARLA's left-handed frame (y right)."),
    floats("imu.mount", "m", 3, -100.0, 100.0, "Place of a vehicle's unit: x, y, z from the centre of the rear axle on the ground. Away from it the accelerometer also feels the turning of the vehicle."),
    floats("imu.accel_unit_bias_std_mps2", "m/s²", 3, 0.0, 100.0, "Standard deviation over units of a constant bias of the accelerometer by axis: each unit has its own."),
    floats("imu.gyro_unit_bias_std_radps", "rad/s", 3, 0.0, 10.0, "Standard deviation over units of a constant bias of the gyroscope by axis: each unit has its own."),
    floats("imu.accel_noise_std_mps2", "m/s²", 3, 0.0, 100.0, "White noise of an accelerometer sample, standard deviation by axis; in addition to the density."),
    floats("imu.accel_noise_density", "m/s²/√Hz", 3, 0.0, 100.0, "White noise of the accelerometer by axis as a density (velocity random walk)."),
    floats("imu.accel_bias_mps2", "m/s²", 3, -100.0, 100.0, "Constant bias of the accelerometer by axis."),
    floats("imu.accel_bias_walk", "m/s³/√Hz", 3, 0.0, 100.0, "Random walk of that bias by axis."),
    floats("imu.accel_range_mps2", "m/s²", 3, 0.1, 1e6, "Full scale of the accelerometer by axis: samples beyond it are clamped."),
    floats("imu.accel_resolution_mps2", "m/s²", 3, 0.0, 100.0, "Resolution of the accelerometer by axis; 0 = continuous."),
    floats("imu.gyro_noise_std_radps", "rad/s", 3, 0.0, 100.0, "White noise of a gyroscope sample, standard deviation by axis; in addition to the density."),
    floats("imu.gyro_noise_density", "rad/s/√Hz", 3, 0.0, 100.0, "White noise of the gyroscope by axis as a density (angle random walk)."),
    floats("imu.gyro_bias_radps", "rad/s", 3, -10.0, 10.0, "Constant bias of the gyroscope by axis."),
    floats("imu.gyro_bias_walk", "rad/s²/√Hz", 3, 0.0, 100.0, "Random walk of that bias by axis."),
    floats("imu.gyro_range_radps", "rad/s", 3, 0.01, 1e6, "Full scale of the gyroscope by axis: samples beyond it are clamped."),
    floats("imu.gyro_resolution_radps", "rad/s", 3, 0.0, 100.0, "Resolution of the gyroscope by axis; 0 = continuous."),
    float("imu.compass_noise_std_rad", "rad", 0.0, 10.0, "Standard deviation of the compass."),
    float("imu.compass_bias_rad", "rad", -10.0, 10.0, "Constant error of the compass, clockwise."),
    span("imu.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("imu.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    float("speed_steering.period_s", "s", 0.001, 100.0, "Time between samples: a whole number of ticks."),
    float("speed_steering.speed_noise_std_mps", "m/s", 0.0, 100.0, "Standard deviation of the wheel speed."),
    float("speed_steering.speed_scale_std", "", 0.0, 0.5, "Scale error of the wheel speed (tyre radius): standard deviation over vehicles, constant for each."),
    float("speed_steering.steering_noise_std_rad", "rad", 0.0, 10.0, "Standard deviation of the steering-wheel angle."),
    float("speed_steering.steering_scale_std", "", 0.0, 0.5, "Scale error of the steering-wheel angle: standard deviation over vehicles, constant for each."),
    float("speed_steering.steering_bias_rad", "rad", -10.0, 10.0, "Constant error of the steering-wheel angle."),
    other("speed_steering.wheel_slip", ValueKind::Flag, "The rear wheels slip when they drive or brake: the wheel speed is theirs, not that of the ground under them."),
    span("speed_steering.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("speed_steering.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    integer("lidar.vehicles", "vehicles", 0, 100_000, "Vehicles that carry a LIDAR: those in the first slots of the observation, this many; 0 = none."),
    other("lidar.pattern", ValueKind::Choice(&LidarPattern::NAMES), "Rays: \"uniform\" (`lidar.channels` between the two elevations), a unit by name (\"vlp16\", \"hdl32e\", \"hdl64e\", \"pandar40p\", \"os1_32\", \"os1_64\", \"os1_128\", \"vls128\"), or \"table\"."),
    other("lidar.ray_table", ValueKind::Text, "CSV file of pattern \"table\": a line for each ray with azimuth_deg (counter-clockwise from ahead) and elevation_deg; \"\" = none."),
    integer("lidar.channels", "", 1, 1024, "Lasers one above the other (pattern \"uniform\")."),
    integer("lidar.points_per_second", "1/s", 1, 20_000_000, "Rays per second of all channels together."),
    float("lidar.rotation_hz", "1/s", 0.1, 1000.0, "Rotations per second: a whole number of rotations per tick, or of ticks per rotation."),
    float("lidar.min_range_m", "m", 0.0, 100.0, "Nearest return."),
    float("lidar.range_m", "m", 0.1, 1000.0, "Farthest return."),
    float("lidar.upper_fov_deg", "deg", -90.0, 90.0, "Elevation of the highest channel (pattern \"uniform\")."),
    float("lidar.lower_fov_deg", "deg", -90.0, 90.0, "Elevation of the lowest channel (pattern \"uniform\")."),
    float("lidar.horizontal_fov_deg", "deg", 0.1, 360.0, "Field of view about straight ahead; 360 = all around."),
    floats("lidar.mount", "m, rad", 6, -100.0, 100.0, "Mounting pose: x, y, z from the centre of the rear axle on the ground (m), then roll, pitch (nose up), yaw (rad)."),
    float("lidar.range_noise_std_m", "m", 0.0, 100.0, "Standard deviation of the range."),
    float("lidar.attenuation_per_m", "1/m", 0.0, 10.0, "Attenuation of the intensity by clear air: exp(−attenuation × range)."),
    float("lidar.dropoff", "", 0.0, 1.0, "Share of returns lost whatever their intensity."),
    float("lidar.dropoff_intensity", "", 0.0, 1.0, "Intensity above which no return is lost for being weak."),
    float("lidar.dropoff_zero_intensity", "", 0.0, 1.0, "Share of returns lost at intensity 0, falling linearly to none at `lidar.dropoff_intensity`."),
    other("lidar.rolling_shutter", ValueKind::Flag, "True: each azimuth fires at its own time, while all road users move. False: the whole scan shows the end of the tick."),
    other("lidar.mode", ValueKind::Choice(&["all", "interest"]), "\"all\" returns, or those of \"interest\": vehicles, persons and `lidar.interest_props`."),
    other("lidar.interest_props", ValueKind::TextsOf(TextForm::Prop), "Props that are of interest, by name (docs/scene.md)."),
    other("lidar.axes", ValueKind::Choice(&["forward", "paper"]), "Axes of the points: x forward, y left, z up; or the paper's: y backward, x left, z down."),
    span("lidar.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("lidar.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    integer("ultrasonic.vehicles", "vehicles", 0, 100_000, "Vehicles that carry ultrasonic sensors in their bumpers: those in the first slots of the observation, this many; 0 = none."),
    integer("ultrasonic.mounts", "", 1, 12, "Sensors of a vehicle: the first mounts, this many. The others hear nothing."),
    float("ultrasonic.period_s", "s", 0.001, 100.0, "Time between samples: a whole number of ticks."),
    floats("ultrasonic.mount_ahead", "", 12, -1.0, 1.0, "Place of each mount along the vehicle, as a share of half its length: 1 = front bumper, −1 = rear bumper."),
    floats("ultrasonic.mount_left", "", 12, -1.0, 1.0, "Place of each mount across the vehicle, as a share of half its width: 1 = left side, −1 = right side."),
    floats("ultrasonic.mount_yaw_deg", "deg", 12, -180.0, 180.0, "Direction of each mount, counter-clockwise from straight ahead."),
    float("ultrasonic.mount_height_m", "m", 0.0, 3.0, "Height of the mounts above the ground."),
    float("ultrasonic.horizontal_half_angle_deg", "deg", 1.0, 85.0, "Largest angle to the left and to the right of a mount's direction at which it hears."),
    float("ultrasonic.vertical_half_angle_deg", "deg", 1.0, 30.0, "Largest angle above and below a mount's direction at which it hears."),
    float("ultrasonic.min_range_m", "m", 0.0, 1.0, "Nearest range that is measured; what is nearer reads as this."),
    float("ultrasonic.range_m", "m", 1.0, 20.0, "Farthest range that is measured; no echo reads as this."),
    float("ultrasonic.range_noise_std_m", "m", 0.0, 1.0, "Standard deviation of the range."),
    span("ultrasonic.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("ultrasonic.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    integer("camera.vehicles", "vehicles", 0, 100_000, "Vehicles that carry a camera: those in the first slots of the observation, this many; 0 = none."),
    float("camera.period_s", "s", 0.001, 100.0, "Time between images: a whole number of ticks."),
    integer("camera.width", "", 1, 4096, "Columns of an image."),
    integer("camera.height", "", 1, 4096, "Rows of an image."),
    float("camera.horizontal_fov_deg", "deg", 1.0, 170.0, "Horizontal field of view; pixels are square."),
    float("camera.range_m", "m", 1.0, 2000.0, "Depth at which an image ends: what is farther is sky."),
    floats("camera.distortion", "", 5, -10.0, 10.0, "Lens distortion by Brown's model: k1, k2, p1, p2, k3, as OpenCV orders them; zeros = a pinhole. The field of view is that without distortion."),
    float("camera.readout_s", "s", 0.0, 100.0, "Rolling shutter: time from the readout of the first row to that of the last one, which is the end of the tick; at most `run.tick_s`. 0 = all rows show the end of the tick (global shutter)."),
    floats("camera.mount", "m, rad", 6, -100.0, 100.0, "Mounting pose: x, y, z from the centre of the rear axle on the ground (m), then roll, pitch (nose up), yaw (rad)."),
    other("camera.depth", ValueKind::Flag, "Images have the distance along the optical axis."),
    other("camera.instance", ValueKind::Flag, "Images have the object that each pixel sees."),
    other("camera.semantic", ValueKind::Flag, "Images have classes: CityScapes' label ids, and markings."),
    other("camera.rgb", ValueKind::Flag, "Images have shaded colours."),
    other("camera.binary", ValueKind::Flag, "Images have road users and `lidar.interest_props` in white, the paper's binary camera."),
    other("camera.infrared", ValueKind::Flag, "Images have apparent temperatures in the thermal infrared (8 to 14 µm), in hundredths of a kelvin."),
    other("camera.flow", ValueKind::Flag, "Images have the optical flow: how far what each pixel shows has moved in the image within `camera.period_s`."),
    other("camera.events", ValueKind::Flag, "Images have the events of a dynamic vision sensor: pixels that became brighter or darker, each with its time within the tick. It samples at every tick: `camera.period_s` = `run.tick_s`."),
    float("camera.event_threshold", "", 0.01, 10.0, "Change of the natural logarithm of a pixel's brightness that is an event."),
    float("camera.full_well_e", "electrons", 0.0, 1e9, "Electrons of a pixel at full brightness: shot noise of the colours; 0 = colours have no noise."),
    float("camera.read_noise_e", "electrons", 0.0, 1e6, "Standard deviation of the noise of reading a pixel, beside the shot noise."),
    float("camera.infrared_noise_k", "K", 0.0, 100.0, "Standard deviation of apparent temperatures (noise-equivalent temperature difference)."),
    other("camera.observed", ValueKind::Choice(&["none", "semantic", "rgb", "binary"]), "The plane that observations hold of the newest image of each camera, for learners that see: nothing is lost, and it stands under the observation hash. \"none\" = observations hold no images (docs/seeing.md)."),
    span("camera.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("camera.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    integer("radar.vehicles", "vehicles", 0, 100_000, "Vehicles that carry a radar: those in the first slots of the observation, this many; 0 = none."),
    float("radar.period_s", "s", 0.001, 100.0, "Time between scans: a whole number of ticks."),
    floats("radar.mount", "m, rad", 6, -100.0, 100.0, "Mounting pose: x, y, z from the centre of the rear axle on the ground (m), then roll, pitch (nose up), yaw (rad)."),
    float("radar.frequency_ghz", "GHz", 1.0, 300.0, "Carrier frequency."),
    float("radar.bandwidth_mhz", "MHz", 1.0, 10_000.0, "Bandwidth of a chirp; the resolution of the range is c / 2B."),
    float("radar.chirp_us", "µs", 1.0, 1000.0, "Time from chirp to chirp; velocities beyond ± λ / 4T are ambiguous."),
    integer("radar.chirps", "", 2, 8192, "Chirps of a scan; the resolution of the velocity is λ / 2NT."),
    float("radar.transmit_dbm", "dBm", -50.0, 100.0, "Transmitted power."),
    float("radar.antenna_gain_dbi", "dBi", 0.0, 60.0, "Gain of the transmitting and of the receiving antenna, each."),
    float("radar.noise_and_losses_db", "dB", 0.0, 100.0, "Noise figure of the receiver and losses, together."),
    float("radar.false_alarm_probability", "", 1e-12, 1e-4, "Probability that noise alone is detected in a resolution cell."),
    float("radar.range_m", "m", 1.0, 500.0, "Farthest range."),
    float("radar.horizontal_fov_deg", "deg", 1.0, 150.0, "Horizontal field of view."),
    float("radar.vertical_fov_deg", "deg", 0.5, 90.0, "Vertical field of view."),
    float("radar.azimuth_resolution_deg", "deg", 0.1, 30.0, "Resolution of the azimuth."),
    span("radar.blackout_length_s", 1e6, "Length of a blackout, shortest and longest, drawn each time; [0, 0] = none."),
    span("radar.blackout_gap_s", 1e6, "Time between two blackouts, shortest and longest."),
    ConfigKey { optional: true, ..other("suite", ValueKind::Suites(SUITE_KEYS), "Named sets of mounted sensors, each a `[[suite]]`. A connected vehicle carries the first one whose rule it satisfies, beside the sensors of the sections (docs/suites.md).") },
    ConfigKey { optional: true, ..other("roadside", ValueKind::Tables(ROADSIDE_KEYS), "Carriers of a suite that stand beside the road, each a `[[roadside]]`. A suite without classes, types, ids, share and first that one of them carries is carried by no vehicle.") },
    float("v2x.share", "", 0.0, 1.0, "Share of the connected road users that have a radio; 0 = no messages and no process `v2x`."),
    other("v2x.awareness", ValueKind::Choice(&["cam", "bsm"]), "Message by which vehicles make themselves known: ETSI's CAM, or SAE's BSM (core data) every 0.1 s."),
    other("v2x.denm", ValueKind::Flag, "Vehicles warn of their emergency braking (DENM)."),
    other("v2x.vam", ValueKind::Flag, "Pedestrians with a smartphone (`gnss.pedestrians`) are connected road users of `v2x.share`, and send VAMs."),
    integer("v2x.neighbours", "objects", 1, 256, "Nearest known objects in a row of the block `neighbours`."),
    other("v2x.listing", ValueKind::Choice(&["merged", "separate"]), "Descriptions of objects in a row of `neighbours`: one for each object, never of the road user itself (\"merged\"); or every station's view of every object, of the road user itself too, and what its own sensors perceive (\"separate\")."),
    other("v2x.roadside", ValueKind::Tables(ROADSIDE_UNIT_KEYS), "Roadside units, each a `[[v2x.roadside]]`: stations at fixed places, with perception of their own (docs/v2x.md); [] = none."),
    other("v2x.pcap", ValueKind::Flag, "Write every message on air into `messages/episode-N.pcap` of the environment, which protocol analysers open."),
    other("v2x.path_loss", ValueKind::Choice(&["urban", "highway"]), "Formulas of 3GPP TR 37.885 for the path loss. Whether buildings or vehicles obstruct a link follows from the scene."),
    float("v2x.power_dbm", "dBm", -20.0, 40.0, "Transmit power, with the gain of both antennas."),
    float("v2x.noise_figure_db", "dB", 0.0, 30.0, "Noise figure of a receiver."),
    float("v2x.carrier_sense_dbm", "dBm", -110.0, -40.0, "Received power from which a radio finds the channel busy."),
    float("v2x.range_m", "m", 10.0, 5000.0, "Longest link that is computed."),
    other("v2x.fading", ValueKind::Flag, "Draw shadowing and fast fading; false = path loss alone."),
    other("v2x.congestion_control", ValueKind::Choice(&["off", "reactive", "adaptive"]), "Decentralised congestion control: none, by a table of states, or by a control loop (ETSI TS 102 687)."),
    float("v2x.perception_range_m", "m", 0.0, 500.0, "Range in which a vehicle perceives objects for its collective perception messages; 0 = no such messages."),
    other("v2x.inclusion", ValueKind::Choice(&["standard", "all", "needed", "policy"]), "Which of the objects that a vehicle perceives its CPMs list: those that the rules of ETSI TS 103 324 name; all, at every tick; those that a station nearby lacks, as if all maps were known; or those that the trainer chooses (`task.kind` = \"messages\")."),
    integer("v2x.candidates", "objects", 1, MOST_CANDIDATES as i64, "Messages task: the nearest perceived objects that the policy chooses from (docs/messages.md)."),
    float("v2x.awareness_range_m", "m", 1.0, 1000.0, "Messages task: range in which a station is to know all road users."),
    float("v2x.perception_position_std_m", "m", 0.0, 10.0, "Standard deviation of the position of a perceived object on each axis."),
    float("v2x.perception_speed_std_mps", "m/s", 0.0, 10.0, "Standard deviation of the velocity of a perceived object on each axis."),
    float("v2x.object_lifetime_s", "s", 0.1, 60.0, "Time after which a known object that was not heard of again is forgotten."),
    integer("v2x.threads", "threads", 1, 64, "Threads that compute links and maps. The result does not depend on it."),
    other("blackout.enabled", ValueKind::Flag, "Switch for the blackouts of all sensors."),
    other("blackout.policy", ValueKind::Choice(&["hold", "nan", "drop"]), "During a blackout the fields hold the last sample (\"hold\") or not-a-number (\"nan\"), or the row is invalid (\"drop\")."),
    other("observation.fields", ValueKind::Fields, "Fields of the observation in order: \"paper\" (nine: GNSS and IMU), \"caraware\" (eleven: with speed and steering), \"driving\" (sixteen: speed, steering, the route ahead), \"driver\" (a hundred and thirty-nine: \"driving\", and road users, junctions, traffic lights and persons around the hero), \"advised-driver\" (\"driver\", and the acceleration that SUMO's own driver would have chosen), \"ultrasonic\" (twenty-three: \"caraware\" and twelve ranges), or a list of names. Fields from \"route_x_5\" to \"signal_gap\" and from \"user_1_x\" to \"person_2_speed\", and \"advised_accel\", exist for heroes only; those that begin with \"object_\" need a LIDAR, and those that begin with \"ultrasonic_\" need ultrasonic sensors."),
    integer("observation.history", "ticks", 1, 64, "Ticks stacked in one row: the newest last, earlier ones before it (frame stack)."),
    other("observation.scale", ValueKind::Choice(&["zero_to_one", "minus_one_to_one"]), "Range to which every field is normalised: 0 … 1 in the paper's text, −1 … 1 in CarAware's code."),
    float("observation.accel_range_mps2", "m/s²", 0.1, 1000.0, "Full scale of the accelerometer fields."),
    float("observation.gyro_range_radps", "rad/s", 0.01, 1000.0, "Full scale of the gyroscope fields."),
    float("observation.speed_range_mps", "m/s", 0.1, 1000.0, "Full scale of the speed field."),
    float("observation.steering_range_rad", "rad", 0.1, 1000.0, "Full scale of the steering field."),
    float("observation.age_range_s", "s", 0.001, 1e6, "Full scale of the fields of ages."),
    other("trainer.module", ValueKind::Text, "Python module that runs as the trainer; your own reads observations through `caraware.ipc.channel`."),
    float("trainer.learning_rate", "", 1e-9, 1.0, "Learning rate of Adam at the start."),
    float("trainer.learning_rate_decay", "", 0.01, 1.0, "Factor on the learning rate after each update."),
    optional("trainer.learning_rate_final", "", 0.0, 1.0, "Learning rate at the end of training. If set, the rate falls linearly with the training episodes instead of by `trainer.learning_rate_decay`."),
    float("trainer.discount", "", 0.0, 1.0, "Discount γ. A prediction does not change what comes next, so 0 is exact and has the least variance."),
    float("trainer.gae_lambda", "", 0.0, 1.0, "λ of generalised advantage estimation."),
    float("trainer.clip_epsilon", "", 0.01, 1.0, "ε: the probability ratio is clipped to 1 ± ε."),
    optional("trainer.clip_epsilon_final", "", 0.01, 1.0, "ε at the end of training, reached linearly with the training episodes."),
    float("trainer.initial_std", "", 0.001, 10.0, "Standard deviation of the policy at the start, in units of half the map."),
    float("trainer.entropy_scale", "", 0.0, 10.0, "Weight of the entropy bonus."),
    optional("trainer.entropy_scale_final", "", 0.0, 10.0, "Weight of the entropy bonus at the end of training, reached linearly with the training episodes."),
    float("trainer.value_scale", "", 0.0, 100.0, "Weight of the value loss."),
    optional("trainer.value_clip", "", 0.0, 1e6, "Largest change of a value in one update; unset = unbounded."),
    optional("trainer.target_kl", "", 1e-9, 1e6, "An update of the policy ends with the first epoch whose mean KL divergence from the policy before the update is larger; unset = all epochs."),
    integer("trainer.value_updates", "updates", 0, 1_000_000, "Updates at the beginning that teach the value network alone, while the policy keeps its parameters: for a policy that begins from a file without a value network (`task.begin_from`). A policy that follows the advantages of an untrained one unlearns."),
    float("trainer.max_grad_norm", "", 0.0001, 1e6, "Largest norm of the gradient."),
    integer("trainer.actions_per_observation", "", 1, 1024, "Actions tried on every observation (`trainer.discount` = 0 only). Predictions do not influence the world, so the reward of each is known, and more of them make the gradient less noisy at little cost. An even number is drawn in pairs on both sides of the mean."),
    integer("trainer.horizon", "samples", 1, 100_000_000, "Samples in one update."),
    integer("trainer.batch_size", "samples", 1, 100_000_000, "Samples in one gradient step; at most the horizon. Of `caraware.fusion.train`: pieces of episodes in a pass."),
    integer("trainer.epochs", "", 1, 1000, "Passes over a horizon. Of `caraware.fusion.train`: passes after each episode, over pieces drawn from all so far."),
    other("trainer.network", ValueKind::TextOf(TextForm::Network), "Networks of policy and value: hidden layers alone (\"mlp\"), with a gated recurrent unit in place of the last layer, which remembers a vehicle's earlier ticks (\"gru\"), with convolutions over images before them (\"cnn\"), or a Python class of your own (docs/networks.md)."),
    other("trainer.hidden", ValueKind::Integers { min: 1, max: 65536 }, "Widths of the hidden layers of the policy and of the value network."),
    other("trainer.activation", ValueKind::Choice(&["relu", "tanh"]), "Activation of the hidden layers; that of the policy's last hidden layer is always tanh."),
    integer("trainer.truncation_ticks", "ticks", 1, 100_000, "Ticks over which a gradient propagates back in a network with memory."),
    integer("trainer.frames", "images", 1, 64, "Images in a stack that a network \"cnn\" sees: the newest one and those of the ticks before."),
    other("trainer.supervised", ValueKind::Flag, "Train a network of the policy's size by regression to the truth, for comparison (docs/baselines.md)."),
    other("trainer.road_users", ValueKind::Flag, "Let the trainer read the states and boxes of all road users at each tick (`channel.road_users()`, docs/environments.md): its queue of the channel `world` is made long enough. False = it is as long as the simulators need."),
    other("trainer.reward", ValueKind::Choice(&["inverse", "bounded_inverse", "exponential"]), "Reward of a prediction at distance d from the truth: 1/d, 1/(1+d/scale), exp(−d/scale)."),
    float("trainer.reward_scale_m", "m", 0.001, 1e6, "The scale in `trainer.reward`."),
    integer("trainer.ranks", "", 1, 1024, "Trainers that learn one policy together by torch.distributed, each in its own run; `caraware.parallel` sets it (docs/parallel.md)."),
    integer("trainer.threads", "", 0, 1024, "Threads of torch; 0 = one for each core."),
    other("trainer.device", ValueKind::Choice(&["cpu", "auto"]), "\"auto\" uses a GPU if there is one."),
    other("trainer.matmul_precision", ValueKind::Choice(&["auto", "float32", "bfloat16"]), "Precision of the inputs of matrix products; \"auto\" uses bfloat16 where the processor multiplies it in hardware (AMX)."),
    integer("trainer.checkpoint_interval", "updates", 1, 1_000_000, "Updates between two checkpoints; the last is always written."),
    integer("trainer.checkpoints_kept", "", 1, 1_000_000, "Number of newest checkpoints that are kept; the one with the best evaluation is kept as well."),
    integer("trainer.checkpoint_keep_every", "updates", 0, 1_000_000, "Every checkpoint after a multiple of this many updates is kept for good; 0 = none."),
    other("trainer.estimates", ValueKind::Choice(&["paced", "always", "never"]), "When the Kalman filter runs beside the policy for viewers: in runs paced by `run.real_time_factor`, always, or never. At full speed it costs more than the policy."),
    other("trainer.plots", ValueKind::Flag, "Draw `plots/` when the run ends, which takes the trainer about a second. The same figures are in `learning.jsonl` and in TensorBoard's events, and `caraware report` draws its own plots."),
    other("fusion.map", ValueKind::Flag, "The learned estimator of `caraware.fusion.train` uses the lanes of the net."),
    integer("fusion.segment_ticks", "ticks", 1, 1_000_000, "The estimator learns from episodes in pieces of this many ticks, side by side."),
    integer("fusion.truncation_ticks", "ticks", 1, 1_000_000, "Ticks between two gradient steps, over which a gradient propagates back; divides `fusion.segment_ticks`."),
    other("fanout.enabled", ValueKind::Flag, "Start the fan-out process, which lets viewers attach."),
    other("fanout.listen", ValueKind::TextOf(TextForm::Endpoint), "zenoh endpoint for viewers: tcp/HOST:PORT or tls/HOST:PORT. On tcp and loopback it admits your own user and root. Beyond, and on tls, it needs `fanout.users` or `fanout.tls_client_ca` (docs/remote.md)."),
    other("fanout.users", ValueKind::Text, "File of the users that may connect, one line user:password each, readable by its owner alone; \"\" = on loopback your own user and root, without a password."),
    other("fanout.tls_certificate", ValueKind::Text, "Certificate of this machine (PEM file), for an endpoint tls/…"),
    other("fanout.tls_private_key", ValueKind::Text, "Its private key (PEM file)."),
    other("fanout.tls_client_ca", ValueKind::Text, "Certificate of the authority (PEM file) that must have signed the viewers' certificates; \"\" = viewers need none."),
    other("fanout.commanders", ValueKind::Texts, "Users that may send commands from the network, by user name or common name of the certificate; \"*\" = every connected user."),
    float("fanout.world_hz", "1/s", 0.0, 1000.0, "Limit of `world` frames per wall second; 0 = none."),
    float("fanout.observation_hz", "1/s", 0.0, 1000.0, "Limit of `observation` frames per wall second; 0 = none."),
    float("fanout.prediction_hz", "1/s", 0.0, 1000.0, "Limit of `prediction` frames per wall second; 0 = none."),
    float("fanout.neighbours_hz", "1/s", 0.0, 1000.0, "Limit of `neighbours` frames (what road users know from messages) per wall second, while a viewer subscribes to them; 0 = none."),
    float("fanout.pointcloud_hz", "1/s", 0.0, 1000.0, "Limit of frames of each LIDAR per wall second, while a viewer subscribes to it; 0 = none."),
    float("fanout.image_hz", "1/s", 0.0, 1000.0, "Limit of images of each camera per wall second, while a viewer subscribes to it; 0 = none."),
    float("fanout.radar_hz", "1/s", 0.0, 1000.0, "Limit of frames of each radar per wall second, while a viewer subscribes to it; 0 = none."),
    float("fanout.event_hz", "1/s", 0.0, 1000.0, "Limit of contact messages per wall second; 0 = none."),
    float("fanout.signals_hz", "1/s", 0.0, 1000.0, "Limit of traffic-light frames per wall second, after changes; 0 = none."),
    float("fanout.vehicles_hz", "1/s", 0.0, 1000.0, "Limit of road-user tables per wall second; 0 = none."),
    float("fanout.status_hz", "1/s", 0.0, 1000.0, "Limit of status reports per wall second; 0 = none."),
    other("record.manner", ValueKind::Choice(&["off", "watching", "lossless"]), "Record the run into a file (docs/recording.md): \"watching\", no process waits for `recorder`, and what it misses is counted; \"lossless\", the run waits for it, and nothing is missed."),
    other("record.channels", ValueKind::Texts, "Recorded channels, by their names (ipc-schema/src/lib.rs). A channel that the run does not use adds nothing."),
    other("record.compression", ValueKind::Choice(&["none", "zstd"]), "How chunks are compressed. \"none\" takes about half the processor time of \"zstd\", and the file is as large as the messages are."),
    integer("record.compression_level", "", -50, 19, "Level of zstd: higher is smaller and slower; 0 is zstd's own default."),
    integer("record.chunk_mib", "MiB", 1, 64, "Size of a chunk before compression. A kill loses at most the newest chunk."),
    other("record.on_full_disk", ValueKind::Choice(&["wait", "stop_recording", "end_run"]), "On a full disk `recorder` waits for space, and with \"lossless\" the run with it (\"wait\"); the recording ends and the run continues (\"stop_recording\"); or the run ends (\"end_run\")."),
    other("record.on_death", ValueKind::Choice(&["continue", "end_run"]), "After its death `recorder` starts again and records the rest into another file (\"continue\"), or the run ends (\"end_run\")."),
];

/// All keys, those of entries of lists of tables last.
fn all() -> impl Iterator<Item = &'static ConfigKey> {
    KEYS.iter().chain(ENTRY_KEYS.into_iter().flatten())
}

/// The key of this dotted path.
#[must_use]
pub fn find(path: &str) -> Option<&'static ConfigKey> {
    all().find(|key| key.path == path)
}

/// Keys of earlier versions, and the keys that replaced them.
const RENAMED: [(&str, &str); 2] = [
    ("imu.gravity_mps2", "imu.convention"),
    ("fanout.rate_hz", "fanout.world_hz"),
];

/// The key that replaced `path`, or the most similar key, if one is similar enough.
#[must_use]
pub fn nearest(path: &str) -> Option<&'static str> {
    if let Some((_, now)) = RENAMED.iter().find(|(then, _)| *then == path) {
        return Some(now);
    }
    let last = |p: &str| p.rsplit('.').next().unwrap_or_default().to_owned();
    all()
        .map(|key| {
            let whole = strsim::jaro_winkler(path, key.path);
            let leaf = strsim::jaro_winkler(&last(path), &last(key.path));
            (key.path, whole.max(leaf))
        })
        .filter(|(_, likeness)| *likeness > 0.8)
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(path, _)| path)
}

impl ConfigKey {
    /// The last part of the path.
    #[must_use]
    pub fn leaf(&self) -> &'static str {
        self.path.rsplit('.').next().unwrap_or(self.path)
    }

    /// The allowed values, as messages and pages show them.
    #[must_use]
    pub fn range(&self) -> String {
        match self.kind {
            ValueKind::Float { min, max } => format!("{min} … {max}"),
            ValueKind::Integer { min, max: i64::MAX } => format!("{min} …"),
            ValueKind::Integer { min, max } => format!("{min} … {max}"),
            ValueKind::Flag => "true, false".into(),
            ValueKind::Choice(words) => quoted(words),
            ValueKind::Text => "text".into(),
            ValueKind::TextOf(form) => form.allowed(),
            ValueKind::Texts => "list of texts".into(),
            ValueKind::TextsOf(form) => format!("list of {}", form.allowed()),
            ValueKind::Fields => {
                let presets = FIELD_PRESETS.map(|preset| format!("\"{}\"", preset.name));
                let names: Vec<&str> = FIELDS.iter().map(|spec| spec.name).collect();
                format!("{}, or a list of {}", presets.join(", "), names.join(", "))
            }
            ValueKind::Metric => {
                let names: Vec<&str> = PolicyMetric::all().map(|metric| metric.spec().name).collect();
                quoted(&names)
            }
            ValueKind::Floats { count, min, max } => format!("{count} × {min} … {max}, or one for all"),
            ValueKind::Span { min, max } => format!("[shortest, longest] in {min} … {max}"),
            ValueKind::Integers { min, max } => format!("list of {min} … {max}"),
            ValueKind::Tables(keys) => format!(
                "list of tables with {}",
                keys.iter().map(|key| key.leaf()).collect::<Vec<_>>().join(", ")
            ),
            ValueKind::Suites(keys) => format!(
                "{}, or a list of tables with {}",
                TextForm::Suite.allowed(),
                keys.iter().map(|key| key.leaf()).collect::<Vec<_>>().join(", ")
            ),
        }
    }
}

/// The words in quotation marks, separated by commas.
fn quoted(words: &[&str]) -> String {
    let quoted: Vec<String> = words.iter().map(|word| format!("\"{word}\"")).collect();
    quoted.join(", ")
}
