//! The table of configuration keys: name, kind, unit, range, meaning. Checking, `--set` and `configs/README.md` follow it.

/// What a key's value may be.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Kind {
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
    /// Observation fields: a preset by name or a list of field names.
    Fields,
    /// A list of texts, which may be empty.
    Texts,
    /// A list of whole numbers from `min` to `max`.
    Integers {
        /// Least value.
        min: i64,
        /// Greatest value.
        max: i64,
    },
}

/// One key.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Key {
    /// Dotted path.
    pub path: &'static str,
    /// Allowed values.
    pub kind: Kind,
    /// Unit, or "" for a plain number or word.
    pub unit: &'static str,
    /// Meaning.
    pub meaning: &'static str,
    /// True if a configuration need not have a value for it.
    pub optional: bool,
}

/// Names of observation fields, in the order of the wire.
pub const FIELD_NAMES: [&str; 25] = [
    "gnss_x",
    "gnss_y",
    "accel_x",
    "accel_y",
    "accel_z",
    "gyro_x",
    "gyro_y",
    "gyro_z",
    "compass",
    "speed",
    "steering",
    "route_x_5",
    "route_y_5",
    "route_x_10",
    "route_y_10",
    "route_x_20",
    "route_y_20",
    "route_x_40",
    "route_y_40",
    "speed_limit",
    "route_offset",
    "route_left",
    "leader_gap",
    "leader_speed",
    "signal_gap",
];

/// Presets of `observation.fields`: name and the part of [`FIELD_NAMES`] that they take.
pub const FIELD_PRESETS: [(&str, std::ops::Range<usize>); 3] =
    [("paper", 0..9), ("caraware", 0..11), ("driving", 9..25)];

/// First of [`FIELD_NAMES`] that only a hero has.
pub const FIRST_HERO_FIELD: usize = 11;

const fn float(path: &'static str, unit: &'static str, min: f64, max: f64, meaning: &'static str) -> Key {
    Key {
        path,
        kind: Kind::Float { min, max },
        unit,
        meaning,
        optional: false,
    }
}

const fn integer(path: &'static str, unit: &'static str, min: i64, max: i64, meaning: &'static str) -> Key {
    Key {
        path,
        kind: Kind::Integer { min, max },
        unit,
        meaning,
        optional: false,
    }
}

const fn other(path: &'static str, kind: Kind, meaning: &'static str) -> Key {
    Key {
        path,
        kind,
        unit: "",
        meaning,
        optional: false,
    }
}

/// Every key there is.
#[rustfmt::skip]
pub const KEYS: &[Key] = &[
    integer("run.seed", "", 0, i64::MAX, "Seed of everything random: traffic, noise, the learner. The same seed gives the same bytes."),
    float("run.tick_s", "s", 0.001, 10.0, "Length of a tick: one observation of every connected vehicle."),
    integer("run.sub_steps", "", 1, 1000, "Nanoscopic sub-steps in a tick (10 in 0.1 s: dynamics at 100 Hz)."),
    integer("run.window_ticks", "ticks", 1, 256, "Ticks that traffic, dynamics and sensors may each be ahead of the next process."),
    float("run.real_time_factor", "s/s", 0.0, 1000.0, "Simulated seconds per wall second; 0 = as fast as possible."),
    float("traffic.step_s", "s", 0.001, 10.0, "Length of a SUMO step: a whole number of ticks. A `.sumocfg` that sets `step-length` decides it."),
    integer("traffic.cavs", "vehicles", 0, 100_000, "Connected vehicles kept alive on random routes (maps with population control); at least 1 but in the driving task."),
    integer("traffic.others", "vehicles", 0, 100_000, "Vehicles without sensors kept alive (maps with population control)."),
    integer("traffic.pedestrians", "persons", 0, 100_000, "Pedestrians kept alive (maps with population control)."),
    integer("traffic.heroes", "vehicles", 0, 1000, "Vehicles driven by actions and kept alive (maps with population control; the driving task only)."),
    other("traffic.hero_route", Kind::Texts, "Edges of the route of every hero, from its first to its last (maps with population control); [] = at random."),
    other("traffic.hero_ids", Kind::Texts, "Vehicles of a `.sumocfg` that are driven by actions, by their ids (the driving task only)."),
    float("traffic.cav_share", "", 0.0, 1.0, "Share of a `.sumocfg`'s vehicles that carry sensors."),
    integer("traffic.max_road_users", "", 1, 1_000_000, "Most road users alive at once; shared memory is laid out for them."),
    Key { path: "map.origin_latitude_deg", kind: Kind::Float { min: -89.9, max: 89.9 }, unit: "deg", meaning: "Latitude of the net's (0, 0); only for a net without projection.", optional: true },
    Key { path: "map.origin_longitude_deg", kind: Kind::Float { min: -180.0, max: 180.0 }, unit: "deg", meaning: "Longitude of the net's (0, 0); only for a net without projection.", optional: true },
    integer("episode.ticks", "ticks", 1, 1_000_000_000, "Length of a training episode; its end respawns everybody at random places."),
    integer("episode.training_episodes", "", 1, 1_000_000_000, "Training episodes of the run."),
    integer("episode.evaluation_interval", "episodes", 0, 1_000_000_000, "Training episodes between two evaluations; 0 = only at the end."),
    integer("episode.evaluation_ticks", "ticks", 1, 1_000_000_000, "Length of an evaluation episode."),
    integer("episode.final_evaluations", "", 1, 1_000_000, "Evaluation episodes at the end, whose mean error is reported."),
    other("task.kind", Kind::Choice(&["localisation", "driving"]), "What the trainer's output means: a position for every connected vehicle, or steering and acceleration of every hero."),
    float("task.time_limit_s", "s", 0.1, 1e6, "Longest episode of a hero; then it is cut (truncated) and begins anew elsewhere."),
    other("vehicle.cav_model", Kind::Choice(&["kinematic", "dynamic"]), "Model of connected vehicles: without slip, or with tyres, load transfer, roll and pitch."),
    other("vehicle.other_model", Kind::Choice(&["kinematic", "dynamic"]), "Model of vehicles without sensors."),
    other("vehicle.hero_model", Kind::Choice(&["kinematic", "dynamic", "rigid_body"]), "Model of heroes; \"rigid_body\" is a body on four ray-cast wheels."),
    other("vehicle.class_models", Kind::Texts, "Models by SUMO vehicle class, such as [\"truck=kinematic\", \"bus=dynamic\"]; they win over the three above."),
    float("vehicle.lane_change_s", "s", 0.1, 60.0, "Time over which SUMO's instantaneous lane change is spread."),
    float("vehicle.max_road_wheel_angle_rad", "rad", 0.05, 1.5, "Largest steering angle of the front wheels."),
    float("vehicle.max_road_wheel_rate_radps", "rad/s", 0.05, 20.0, "Largest rate of that angle."),
    float("vehicle.max_accel_mps2", "m/s²", 0.1, 50.0, "Largest acceleration of the mirrored vehicle."),
    float("vehicle.max_decel_mps2", "m/s²", 0.1, 50.0, "Largest deceleration of the mirrored vehicle."),
    float("vehicle.steering_ratio", "", 1.0, 100.0, "Steering-wheel angle per road-wheel angle."),
    float("vehicle.resynchronise_m", "m", 0.1, 1000.0, "Tracking error (reference minus front bumper) beyond which a vehicle is set onto SUMO's, flagged and counted."),
    float("vehicle.leave_path_m", "m", 0.1, 1000.0, "How far the reference may leave SUMO's path where that cannot be driven; beyond, as above."),
    other("road.surface", Kind::Choice(&["dry", "wet", "snow"]), "What the road is covered with: it scales the friction of the tyres."),
    other("scene.obstacles", Kind::Texts, "Obstacles, each \"name x y heading\": a prop by name, its centre (m, world), its heading (degrees counter-clockwise from east, 0 if left out)."),
    integer("scene.random_props", "", 0, 1_000_000, "Props placed at random beside the road, the same for the same `run.seed`."),
    float("scene.building_height_m", "m", 0.1, 1000.0, "Height of a building whose polygon and type name none."),
    other("collision.detect", Kind::Flag, "Look for contacts of connected vehicles and heroes with everything."),
    other("collision.ends_trajectory", Kind::Flag, "A contact ends the trajectory of a connected vehicle (terminated), as it always ends a hero's."),
    float("gnss.period_s", "s", 0.001, 100.0, "Time between fixes: a whole number of ticks."),
    float("gnss.noise_std_deg", "deg", 0.0, 1.0, "Standard deviation of latitude and longitude (5e-5: 5.57 m on each axis)."),
    float("gnss.bias_deg", "deg", -1.0, 1.0, "Bias of latitude and longitude."),
    float("imu.period_s", "s", 0.001, 100.0, "Time between samples: a whole number of ticks."),
    float("imu.accel_noise_std_mps2", "m/s²", 0.0, 100.0, "Standard deviation of each accelerometer axis."),
    float("imu.gyro_noise_std_radps", "rad/s", 0.0, 100.0, "Standard deviation of each gyroscope axis."),
    float("imu.gyro_bias_radps", "rad/s", -10.0, 10.0, "Bias of each gyroscope axis."),
    float("imu.compass_noise_std_rad", "rad", 0.0, 10.0, "Standard deviation of the compass."),
    float("imu.gravity_mps2", "m/s²", 0.0, 20.0, "Gravity in the accelerometer: 9.81 = specific force, 0 = kinematic acceleration."),
    float("speed_steering.period_s", "s", 0.001, 100.0, "Time between samples: a whole number of ticks."),
    float("speed_steering.speed_noise_std_mps", "m/s", 0.0, 100.0, "Standard deviation of the wheel speed."),
    float("speed_steering.steering_noise_std_rad", "rad", 0.0, 10.0, "Standard deviation of the steering-wheel angle."),
    other("observation.fields", Kind::Fields, "Fields of the observation in order: \"paper\" (nine: GNSS and IMU), \"caraware\" (eleven: with speed and steering), \"driving\" (sixteen: speed, steering, the route ahead), or a list of names; those from \"route_x_5\" on are a hero's."),
    other("observation.scale", Kind::Choice(&["zero_to_one", "minus_one_to_one"]), "Range that every field is normalised to: the paper's text says 0 … 1, CarAware's code −1 … 1."),
    float("observation.accel_range_mps2", "m/s²", 0.1, 1000.0, "Full scale of the accelerometer fields."),
    float("observation.gyro_range_radps", "rad/s", 0.01, 1000.0, "Full scale of the gyroscope fields."),
    float("observation.speed_range_mps", "m/s", 0.1, 1000.0, "Full scale of the speed field."),
    float("observation.steering_range_rad", "rad", 0.1, 1000.0, "Full scale of the steering field."),
    other("trainer.module", Kind::Text, "Python module that is run as the trainer; your own takes its part through `caraware.channel`."),
    float("trainer.learning_rate", "", 1e-9, 1.0, "Learning rate of Adam at the start."),
    float("trainer.learning_rate_decay", "", 0.01, 1.0, "Factor on the learning rate after each update."),
    float("trainer.discount", "", 0.0, 1.0, "Discount γ. A prediction does not change what comes next, so 0 is exact and has the least variance."),
    float("trainer.gae_lambda", "", 0.0, 1.0, "λ of generalised advantage estimation."),
    float("trainer.clip_epsilon", "", 0.01, 1.0, "ε: the probability ratio is clipped to 1 ± ε."),
    float("trainer.initial_std", "", 0.001, 10.0, "Standard deviation of the policy at the start, in units of half the map."),
    float("trainer.entropy_scale", "", 0.0, 10.0, "Weight of the entropy bonus."),
    float("trainer.value_scale", "", 0.0, 100.0, "Weight of the value loss."),
    float("trainer.max_grad_norm", "", 0.0001, 1e6, "Largest norm of the gradient."),
    integer("trainer.horizon", "samples", 1, 100_000_000, "Samples in one update."),
    integer("trainer.batch_size", "samples", 1, 100_000_000, "Samples in one gradient step; at most the horizon."),
    integer("trainer.epochs", "", 1, 1000, "Passes over a horizon."),
    other("trainer.hidden", Kind::Integers { min: 1, max: 65536 }, "Widths of the hidden layers of the policy and of the value network."),
    other("trainer.reward", Kind::Choice(&["inverse", "bounded_inverse", "exponential"]), "Reward of a prediction at distance d from the truth: 1/d, 1/(1+d/scale), exp(−d/scale)."),
    float("trainer.reward_scale_m", "m", 0.001, 1e6, "The scale in those."),
    integer("trainer.threads", "", 0, 1024, "Threads of torch; 0 = one for each core."),
    other("trainer.device", Kind::Choice(&["cpu", "auto"]), "\"auto\" uses a GPU if there is one."),
    other("trainer.matmul_precision", Kind::Choice(&["auto", "float32", "bfloat16"]), "Precision of the inputs of matrix products; \"auto\" takes bfloat16 where the processor multiplies it in hardware (AMX)."),
    integer("trainer.checkpoint_interval", "updates", 1, 1_000_000, "Updates between two checkpoints; the last is always written."),
    integer("trainer.checkpoints_kept", "", 1, 1_000_000, "Newest checkpoints that are kept."),
    other("fanout.enabled", Kind::Flag, "Start the fan-out process, which lets viewers attach."),
    other("fanout.listen", Kind::Text, "zenoh endpoint that viewers connect to."),
    float("fanout.rate_hz", "1/s", 0.1, 1000.0, "Most frames per wall second and topic."),
];

/// The key of this dotted path.
#[must_use]
pub fn find(path: &str) -> Option<&'static Key> {
    KEYS.iter().find(|key| key.path == path)
}

/// The existing path most like `path`, if any is near.
#[must_use]
pub fn nearest(path: &str) -> Option<&'static str> {
    let last = |p: &str| p.rsplit('.').next().unwrap_or_default().to_owned();
    KEYS.iter()
        .map(|key| {
            let whole = strsim::jaro_winkler(path, key.path);
            let leaf = strsim::jaro_winkler(&last(path), &last(key.path));
            (key.path, whole.max(leaf))
        })
        .filter(|(_, likeness)| *likeness > 0.8)
        .max_by(|a, b| a.1.total_cmp(&b.1))
        .map(|(path, _)| path)
}

impl Key {
    /// The allowed values, for people.
    #[must_use]
    pub fn range(&self) -> String {
        match self.kind {
            Kind::Float { min, max } => format!("{min} … {max}"),
            Kind::Integer { min, max: i64::MAX } => format!("{min} …"),
            Kind::Integer { min, max } => format!("{min} … {max}"),
            Kind::Flag => "true, false".into(),
            Kind::Choice(words) => words
                .iter()
                .map(|word| format!("\"{word}\""))
                .collect::<Vec<_>>()
                .join(", "),
            Kind::Text => "text".into(),
            Kind::Texts => "list of texts".into(),
            Kind::Fields => format!(
                "\"paper\", \"caraware\", \"driving\", or a list of {}",
                FIELD_NAMES.join(", ")
            ),
            Kind::Integers { min, max } => format!("list of {min} … {max}"),
        }
    }
}
