//! The sensors of a connected road user: one row of [`SENSORS`] for each kind. Commands, the command line, the curriculum, the
//! fan-out's counts, the HUD and the bits that Python knows derive from it (decision 21).

use std::fmt;

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use crate::config::Config;

/// A kind of sensor; its number is its place in [`SENSORS`] and in the ages of an observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
#[repr(u8)]
pub enum SensorKind {
    /// GNSS receiver.
    Gnss = 0,
    /// Inertial measurement unit with compass.
    Imu = 1,
    /// Wheel speed and steering-wheel angle.
    SpeedSteering = 2,
    /// Spinning LIDAR.
    Lidar = 3,
    /// Ultrasonic sensors in the bumpers.
    Ultrasonic = 4,
    /// Camera.
    Camera = 5,
    /// Radar.
    Radar = 6,
}

/// Which road users carry a sensor.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SensorCarriers {
    /// Connected vehicles, heroes and pedestrians with a smartphone.
    VehiclesAndPersons,
    /// Connected vehicles and heroes.
    Vehicles,
}

/// What a sample of a sensor depends on.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SensorInput {
    /// The motion of its carrier.
    Motion,
    /// The surfaces around its carrier, static and moving.
    Surroundings,
}

/// What a sensor reads of the static scene.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SceneUse {
    /// Nothing: the motion of its carrier is enough.
    Unused,
    /// The sky between buildings.
    Sky,
    /// Rays that hit surfaces.
    Rays,
    /// Distances to buildings and props.
    Solids,
    /// Images of surfaces and of the ground.
    Images,
    /// Surfaces that return echoes.
    Echoes,
}

/// A random stream. Its number goes into the counter of every draw, so a new stream takes a number that was never used.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u32)]
pub enum NoiseStream {
    /// GNSS receiver, white noise: east, north, up.
    Gnss = 1,
    /// IMU, white noise: accelerometer, and x of the gyroscope.
    ImuFront = 2,
    /// IMU, white noise: y and z of the gyroscope, compass.
    ImuBack = 3,
    /// Wheel speed and steering angle.
    SpeedSteering = 4,
    /// LIDAR: the key of a scan, and its rays.
    Lidar = 5,
    /// Ultrasonic sensors: the range of each.
    Ultrasonic = 6,
    /// Radar: the key of a scan, and its cells.
    Radar = 7,
    /// Camera: the key of an image, and its pixels.
    Camera = 8,
    /// GNSS receiver, correlated noise: east, north, up.
    GnssCorrelated = 32,
    /// IMU, walk of the biases of the accelerometer and of x of the gyroscope.
    WalkFront = 33,
    /// IMU, walk of the biases of y and z of the gyroscope.
    WalkBack = 34,
    /// Scale errors of wheel speed and steering angle.
    Scale = 35,
    /// GNSS receiver, constant error of a unit: east, north, up.
    GnssUnit = 36,
    /// IMU, constant biases of a unit: accelerometer, and x of the gyroscope.
    ImuUnitFront = 37,
    /// IMU, constant biases of a unit: y and z of the gyroscope.
    ImuUnitBack = 38,
    /// Blackouts of the GNSS receiver.
    GnssBlackout = 40,
    /// Blackouts of the IMU.
    ImuBlackout = 41,
    /// Blackouts of the speed and steering sensor.
    SpeedSteeringBlackout = 42,
    /// Blackouts of the LIDAR.
    LidarBlackout = 43,
    /// Blackouts of the ultrasonic sensors.
    UltrasonicBlackout = 44,
    /// Blackouts of the camera.
    CameraBlackout = 45,
    /// Blackouts of the radar.
    RadarBlackout = 46,
}

/// Lengths and gaps of a sensor's blackouts, shortest and longest, seconds.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BlackoutSpans {
    /// Length of a blackout; [0, 0] = none.
    pub length_s: [f64; 2],
    /// Time between two blackouts.
    pub gap_s: [f64; 2],
}

/// One row of [`SENSORS`]: what the rest of the system has to know of a sensor.
#[derive(Debug, Clone, Copy)]
pub struct SensorSpec {
    /// The kind.
    pub kind: SensorKind,
    /// Name in commands, keys, fields and JSON.
    pub name: &'static str,
    /// Name in the HUD.
    pub label: &'static str,
    /// Name in help texts.
    pub description: &'static str,
    /// Which road users carry it.
    pub carriers: SensorCarriers,
    /// Random streams of its measurements.
    pub noise: &'static [NoiseStream],
    /// Random stream of its blackouts.
    pub blackout_noise: NoiseStream,
    /// Number of vehicles that carry the one of its section, those in the first slots; `u32::MAX` = every vehicle. Suites come beside it.
    pub vehicles: fn(&Config) -> u32,
    /// What its samples depend on.
    pub input: SensorInput,
    /// What it reads of the static scene.
    pub scene: fn(&Config) -> SceneUse,
    /// Time between two samples, seconds.
    pub period_s: fn(&Config) -> f64,
    /// Its blackouts.
    pub blackouts: fn(&Config) -> BlackoutSpans,
    /// Multiplies its random errors and biases by a factor: `noise` of a stage of a curriculum.
    pub scale_noise: fn(&mut Config, f64),
    /// Multiplies the length of its blackouts by a factor: `blackout` of a stage of a curriculum.
    pub scale_blackouts: fn(&mut Config, f64),
}

/// Spans of the blackouts of the table `$table` of the configuration.
macro_rules! blackouts {
    ($table:ident) => {
        |config| BlackoutSpans {
            length_s: config.$table.blackout_length_s,
            gap_s: config.$table.blackout_gap_s,
        }
    };
}

/// Scales the length of the blackouts of the table `$table` of the configuration.
macro_rules! scale_blackouts {
    ($table:ident) => {
        |config, factor| {
            config
                .$table
                .blackout_length_s
                .iter_mut()
                .for_each(|length_s| *length_s *= factor);
        }
    };
}

/// Every sensor, by [`SensorKind`].
pub const SENSORS: [SensorSpec; 7] = [
    SensorSpec {
        kind: SensorKind::Gnss,
        name: "gnss",
        label: "GNSS",
        description: "GNSS receiver",
        carriers: SensorCarriers::VehiclesAndPersons,
        noise: &[NoiseStream::Gnss, NoiseStream::GnssCorrelated, NoiseStream::GnssUnit],
        blackout_noise: NoiseStream::GnssBlackout,
        vehicles: |_| u32::MAX,
        input: SensorInput::Motion,
        scene: |config| match config.gnss.sky_view {
            true => SceneUse::Sky,
            false => SceneUse::Unused,
        },
        period_s: |config| config.gnss.period_s,
        blackouts: blackouts!(gnss),
        scale_noise: |config, factor| config.gnss.scale_noise(factor),
        scale_blackouts: scale_blackouts!(gnss),
    },
    SensorSpec {
        kind: SensorKind::Imu,
        name: "imu",
        label: "IMU",
        description: "Inertial unit with compass",
        carriers: SensorCarriers::VehiclesAndPersons,
        noise: &[
            NoiseStream::ImuFront,
            NoiseStream::ImuBack,
            NoiseStream::WalkFront,
            NoiseStream::WalkBack,
            NoiseStream::ImuUnitFront,
            NoiseStream::ImuUnitBack,
        ],
        blackout_noise: NoiseStream::ImuBlackout,
        vehicles: |_| u32::MAX,
        input: SensorInput::Motion,
        scene: |_| SceneUse::Unused,
        period_s: |config| config.imu.period_s,
        blackouts: blackouts!(imu),
        scale_noise: |config, factor| config.imu.scale_noise(factor),
        scale_blackouts: scale_blackouts!(imu),
    },
    SensorSpec {
        kind: SensorKind::SpeedSteering,
        name: "speed_steering",
        label: "speed+steering",
        description: "Speed and steering angle",
        carriers: SensorCarriers::Vehicles,
        noise: &[NoiseStream::SpeedSteering, NoiseStream::Scale],
        blackout_noise: NoiseStream::SpeedSteeringBlackout,
        vehicles: |_| u32::MAX,
        input: SensorInput::Motion,
        scene: |_| SceneUse::Unused,
        period_s: |config| config.speed_steering.period_s,
        blackouts: blackouts!(speed_steering),
        scale_noise: |config, factor| config.speed_steering.scale_noise(factor),
        scale_blackouts: scale_blackouts!(speed_steering),
    },
    SensorSpec {
        kind: SensorKind::Lidar,
        name: "lidar",
        label: "LIDAR",
        description: "LIDAR",
        carriers: SensorCarriers::Vehicles,
        noise: &[NoiseStream::Lidar],
        blackout_noise: NoiseStream::LidarBlackout,
        vehicles: |config| config.lidar.vehicles,
        input: SensorInput::Surroundings,
        scene: |config| match config.carries(SensorKind::Lidar) {
            true => SceneUse::Rays,
            false => SceneUse::Unused,
        },
        // It scans at every tick.
        period_s: |config| config.run.tick_s,
        blackouts: blackouts!(lidar),
        // A curriculum leaves its noise as it is.
        scale_noise: |_, _| (),
        scale_blackouts: scale_blackouts!(lidar),
    },
    SensorSpec {
        kind: SensorKind::Ultrasonic,
        name: "ultrasonic",
        label: "ultrasonic",
        description: "Ultrasonic sensors in the bumpers",
        carriers: SensorCarriers::Vehicles,
        noise: &[NoiseStream::Ultrasonic],
        blackout_noise: NoiseStream::UltrasonicBlackout,
        vehicles: |config| config.ultrasonic.vehicles,
        input: SensorInput::Surroundings,
        scene: |config| match config.ultrasonic.vehicles {
            0 => SceneUse::Unused,
            _ => SceneUse::Solids,
        },
        period_s: |config| config.ultrasonic.period_s,
        blackouts: blackouts!(ultrasonic),
        scale_noise: |config, factor| config.ultrasonic.scale_noise(factor),
        scale_blackouts: scale_blackouts!(ultrasonic),
    },
    SensorSpec {
        kind: SensorKind::Camera,
        name: "camera",
        label: "camera",
        description: "Camera",
        carriers: SensorCarriers::Vehicles,
        noise: &[NoiseStream::Camera],
        blackout_noise: NoiseStream::CameraBlackout,
        vehicles: |config| config.camera.vehicles,
        input: SensorInput::Surroundings,
        scene: |config| match config.carries(SensorKind::Camera) {
            true => SceneUse::Images,
            false => SceneUse::Unused,
        },
        period_s: |config| config.camera.period_s,
        blackouts: blackouts!(camera),
        scale_noise: |config, factor| config.camera.scale_noise(factor),
        scale_blackouts: scale_blackouts!(camera),
    },
    SensorSpec {
        kind: SensorKind::Radar,
        name: "radar",
        label: "radar",
        description: "Radar",
        carriers: SensorCarriers::Vehicles,
        noise: &[NoiseStream::Radar],
        blackout_noise: NoiseStream::RadarBlackout,
        vehicles: |config| config.radar.vehicles,
        input: SensorInput::Surroundings,
        scene: |config| match config.carries(SensorKind::Radar) {
            true => SceneUse::Echoes,
            false => SceneUse::Unused,
        },
        period_s: |config| config.radar.period_s,
        blackouts: blackouts!(radar),
        // A curriculum leaves its errors as they are.
        scale_noise: |_, _| (),
        scale_blackouts: scale_blackouts!(radar),
    },
];

/// Each row stands at the place of its kind.
const _: () = {
    let mut row = 0;
    while row < SENSORS.len() {
        assert!(SENSORS[row].kind as usize == row);
        row += 1;
    }
};

/// The bits of all sensors.
pub const ALL_SENSORS: u32 = (1 << SensorKind::COUNT) - 1;

/// Bits of the sensors that any road user of a run with this configuration carries.
#[must_use]
pub fn fitted_sensors(config: &Config) -> u32 {
    let fitted = SENSORS.iter().filter(|spec| config.carries(spec.kind));
    fitted.fold(0, |bits, spec| bits | spec.kind.bit())
}

impl SensorKind {
    /// Number of kinds.
    pub const COUNT: usize = SENSORS.len();

    /// Every kind, in the order of [`SENSORS`].
    pub const ALL: [Self; Self::COUNT] = {
        let mut kinds = [SENSORS[0].kind; Self::COUNT];
        let mut row = 0;
        while row < Self::COUNT {
            kinds[row] = SENSORS[row].kind;
            row += 1;
        }
        kinds
    };

    /// Place in [`SENSORS`] and in the ages of an observation.
    #[must_use]
    pub const fn index(self) -> usize {
        self as usize
    }

    /// Bit in an observation's `sensors`.
    #[must_use]
    pub const fn bit(self) -> u32 {
        1 << self as u32
    }

    /// True if its bit is among `bits`.
    #[must_use]
    pub const fn is_in(self, bits: u32) -> bool {
        bits & self.bit() != 0
    }

    /// Its row.
    #[must_use]
    pub const fn spec(self) -> &'static SensorSpec {
        const ROWS: &[SensorSpec] = &SENSORS;
        &ROWS[self as usize]
    }

    /// Name in commands, keys, fields and JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    /// The sensor with this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|kind| kind.name() == name)
    }
}

/// The sensors that a command switches: one, or all of them.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum SensorSelection {
    /// This one.
    One(SensorKind),
    /// Every sensor.
    All,
}

impl SensorSelection {
    /// Name of [`SensorSelection::All`].
    const ALL_NAME: &'static str = "all";

    /// Every selection, in the order in which help texts list them.
    pub fn every() -> impl Iterator<Item = Self> {
        SensorKind::ALL.into_iter().map(Self::One).chain([Self::All])
    }

    /// Name in commands and JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::One(kind) => kind.name(),
            Self::All => Self::ALL_NAME,
        }
    }

    /// Name in help texts.
    #[must_use]
    pub const fn description(self) -> &'static str {
        match self {
            Self::One(kind) => kind.spec().description,
            Self::All => "Every sensor",
        }
    }

    /// The selection with this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        Self::every().find(|selection| selection.name() == name)
    }

    /// Bits as in an observation's `sensors`.
    #[must_use]
    pub const fn bits(self) -> u32 {
        match self {
            Self::One(kind) => kind.bit(),
            Self::All => ALL_SENSORS,
        }
    }

    /// The selection with these bits.
    #[must_use]
    pub fn from_bits(bits: u32) -> Option<Self> {
        Self::every().find(|selection| selection.bits() == bits)
    }
}

impl fmt::Display for SensorSelection {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

impl Serialize for SensorSelection {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for SensorSelection {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::by_name(&name).ok_or_else(|| {
            let known: Vec<&str> = Self::every().map(Self::name).collect();
            D::Error::custom(format!("unknown sensor `{name}`, expected one of {}", known.join(", ")))
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_random_stream_belongs_to_one_sensor_and_fits_its_place_in_the_counter() {
        let mut numbers: Vec<u32> = SENSORS
            .iter()
            .flat_map(|spec| spec.noise.iter().chain([&spec.blackout_noise]))
            .map(|stream| *stream as u32)
            .collect();
        numbers.sort_unstable();
        // The numbers that every run so far was drawn with: one that changes changes every observation.
        assert_eq!(
            numbers,
            [
                1, 2, 3, 4, 5, 6, 7, 8, 32, 33, 34, 35, 36, 37, 38, 40, 41, 42, 43, 44, 45, 46
            ]
        );
        // A stream has the low eight bits of a word, a part of a sample the others.
        assert!(numbers.iter().all(|number| (1..256).contains(number)));
    }

    #[test]
    fn names_and_bits_lead_back_to_their_sensor() {
        for (index, spec) in SENSORS.iter().enumerate() {
            assert_eq!(spec.kind.bit(), 1 << index);
            assert_eq!(SensorKind::by_name(spec.name), Some(spec.kind));
        }
        for selection in SensorSelection::every() {
            assert_eq!(SensorSelection::from_bits(selection.bits()), Some(selection));
            assert_eq!(SensorSelection::by_name(selection.name()), Some(selection));
        }
        assert_eq!(SensorSelection::from_bits(0), None);
        assert_eq!(SensorKind::by_name("nose"), None);
        let refused = serde_json::from_str::<SensorSelection>("\"nose\"").unwrap_err();
        assert_eq!(
            refused.to_string(),
            "unknown sensor `nose`, expected one of gnss, imu, speed_steering, lidar, ultrasonic, camera, radar, all"
        );
    }
}
