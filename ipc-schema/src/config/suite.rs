//! Suites: named sets of mounted sensors, the vehicles that carry them, and carriers that stand beside the road (docs/suites.md).

use std::{convert::Infallible, fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error as _, ser::Error as _};
use serde_json::{Map, Value};

use super::{CameraConfig, Config, LidarConfig, RadarConfig, text::serde_as_text};
use crate::sensor::SensorKind;

/// Most suites of a run: each has a bit in [`crate::world::VehicleState::flags`].
pub const MOST_SUITES: usize = 16;
/// Keys of a sensor's section that a sensor of a suite does not have: the suite decides what carries it, and blackouts belong to a kind.
pub const KEYS_OF_A_KIND: [&str; 3] = ["vehicles", "blackout_length_s", "blackout_gap_s"];
/// `sensor` in the messages of the sensor that a section of the configuration describes (`lidar.vehicles`, `camera.vehicles`, …). Those
/// of suites count from 1.
pub const OWN_SENSOR: u32 = 0;

/// A named set of mounted sensors, and the vehicles that carry it. A vehicle carries the first suite whose rule it satisfies.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SuiteConfig {
    /// Its name.
    pub name: String,
    /// SUMO's vehicle classes of its carriers; none = every class.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub classes: Vec<String>,
    /// SUMO's vehicle types of its carriers; none = every type.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub types: Vec<String>,
    /// SUMO ids of its carriers; none = every id.
    #[serde(default, skip_serializing_if = "Vec::is_empty")]
    pub ids: Vec<IdPattern>,
    /// Share of these vehicles that carry it, by a hash of the run's seed and the id.
    #[serde(default = "whole")]
    pub share: f64,
    /// Of these the ones in the first so many slots; `None` = in all slots.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub first: Option<u32>,
    /// Its sensors.
    #[serde(rename = "sensor")]
    pub sensors: Vec<SuiteSensor>,
}

fn whole() -> f64 {
    1.0
}

/// A pattern of SUMO ids in which `*` stands for any text.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct IdPattern(Vec<String>);

serde_as_text!(IdPattern);

impl FromStr for IdPattern {
    type Err = Infallible;

    fn from_str(text: &str) -> Result<Self, Infallible> {
        Ok(Self(text.split('*').map(str::to_owned).collect()))
    }
}

impl fmt::Display for IdPattern {
    fn fmt(&self, formatter: &mut fmt::Formatter<'_>) -> fmt::Result {
        formatter.write_str(&self.0.join("*"))
    }
}

impl IdPattern {
    /// True if `id` has this pattern.
    #[must_use]
    pub fn matches(&self, id: &str) -> bool {
        let [first, rest @ ..] = self.0.as_slice() else {
            return false;
        };
        let [middle @ .., last] = rest else {
            return id == first;
        };
        let Some(mut left) = id.strip_prefix(first.as_str()) else {
            return false;
        };
        // The earliest place of each part leaves the most text for the parts after it.
        for part in middle {
            match left.split_once(part.as_str()) {
                Some((_, after)) => left = after,
                None => return false,
            }
        }
        left.ends_with(last.as_str())
    }
}

/// What a rule asks of a vehicle.
#[derive(Debug, Clone, Copy)]
pub struct SuiteCandidate<'a> {
    /// SUMO's id.
    pub id: &'a str,
    /// SUMO's vehicle class.
    pub class: &'a str,
    /// SUMO's vehicle type.
    pub vehicle_type: &'a str,
}

impl SuiteConfig {
    /// True if class, type, id and share let a vehicle carry the suite in a run with this seed.
    #[must_use]
    pub fn admits(&self, seed: u64, vehicle: SuiteCandidate<'_>) -> bool {
        let is_among = |list: &[String], text: &str| list.is_empty() || list.iter().any(|known| known == text);
        is_among(&self.classes, vehicle.class)
            && is_among(&self.types, vehicle.vehicle_type)
            && (self.ids.is_empty() || self.ids.iter().any(|pattern| pattern.matches(vehicle.id)))
            && self.lot(seed, vehicle.id) < self.share
    }

    /// A number in [0, 1) that belongs to the seed, the suite and the id.
    fn lot(&self, seed: u64, id: &str) -> f64 {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&seed.to_le_bytes()).update(self.name.as_bytes());
        hasher.update(&[0]).update(id.as_bytes());
        let mut first = [0_u8; 8];
        first.copy_from_slice(&hasher.finalize().as_bytes()[..8]);
        #[expect(clippy::cast_precision_loss, reason = "the 53 high bits are exact")]
        let high = (u64::from_le_bytes(first) >> 11) as f64;
        high / (1_u64 << 53) as f64
    }

    /// True if the suite has a rule for vehicles.
    #[must_use]
    pub fn has_rule(&self) -> bool {
        let lists = [self.classes.is_empty(), self.types.is_empty(), self.ids.is_empty()];
        lists.contains(&false) || self.share < 1.0 || self.first.is_some()
    }
}

/// A sensor of a suite.
#[derive(Debug, Clone, PartialEq)]
pub struct SuiteSensor {
    /// Its name, unique within the suite.
    pub name: String,
    /// Ticks between two samples; 1 for an antenna or inertial unit, whose sections have the period.
    pub period_ticks: u32,
    /// What it is and how it is set up.
    pub model: MountedModel,
}

/// Kind and parameters of a sensor of a suite: those of its section, except what the suite says.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(tag = "kind", rename_all = "snake_case")]
pub enum MountedModel {
    /// The antenna of the GNSS receiver.
    Gnss(LeverArm),
    /// The inertial unit.
    Imu(LeverArm),
    /// A LIDAR.
    Lidar(Box<LidarConfig>),
    /// A camera.
    Camera(Box<CameraConfig>),
    /// A radar.
    Radar(Box<RadarConfig>),
}

/// Place of an antenna or inertial unit, whose axes are those of the vehicle.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LeverArm {
    /// x, y, z from the centre of the rear axle on the ground, metres.
    pub mount: [f64; 3],
}

impl MountedModel {
    /// Its kind.
    #[must_use]
    pub fn kind(&self) -> SensorKind {
        match self {
            Self::Gnss(_) => SensorKind::Gnss,
            Self::Imu(_) => SensorKind::Imu,
            Self::Lidar(_) => SensorKind::Lidar,
            Self::Camera(_) => SensorKind::Camera,
            Self::Radar(_) => SensorKind::Radar,
        }
    }

    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    #[must_use]
    pub fn mount(&self) -> [f64; 6] {
        match self {
            Self::Gnss(arm) | Self::Imu(arm) => [arm.mount[0], arm.mount[1], arm.mount[2], 0.0, 0.0, 0.0],
            Self::Lidar(lidar) => lidar.mount,
            Self::Camera(camera) => camera.mount,
            Self::Radar(radar) => radar.mount,
        }
    }

    /// True if it looks at its surroundings and sends messages of its own.
    #[must_use]
    pub fn has_messages(&self) -> bool {
        !matches!(self, Self::Gnss(_) | Self::Imu(_))
    }
}

impl Serialize for SuiteSensor {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut value = serde_json::to_value(&self.model).map_err(S::Error::custom)?;
        if let Value::Object(fields) = &mut value {
            fields.retain(|key, _| !KEYS_OF_A_KIND.contains(&key.as_str()));
            fields.insert("name".into(), self.name.as_str().into());
            if self.model.has_messages() {
                fields.insert("period_ticks".into(), self.period_ticks.into());
            }
        }
        value.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for SuiteSensor {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let mut fields = Map::deserialize(deserializer)?;
        let name = fields.remove("name").ok_or_else(|| D::Error::missing_field("name"))?;
        let name = String::deserialize(name).map_err(D::Error::custom)?;
        let mut period_ticks = 1;
        if !matches!(fields.get("kind").and_then(Value::as_str), Some("gnss" | "imu")) {
            let given = fields.remove("period_ticks");
            let given = given.ok_or_else(|| D::Error::missing_field("period_ticks"))?;
            period_ticks = u32::deserialize(given).map_err(D::Error::custom)?;
            let [vehicles, length, gap] = KEYS_OF_A_KIND.map(str::to_owned);
            fields.insert(vehicles, 0.into());
            fields.insert(length, [0.0, 0.0].as_slice().into());
            fields.insert(gap, [0.0, 0.0].as_slice().into());
        }
        let model = MountedModel::deserialize(Value::Object(fields)).map_err(D::Error::custom)?;
        Ok(Self {
            name,
            period_ticks,
            model,
        })
    }
}

/// A carrier that stands beside the road.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct RoadsideConfig {
    /// Its name.
    pub name: String,
    /// Name of the suite that it carries.
    pub suite: String,
    /// Place in the world frame, metres; with `y_m`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub x_m: Option<f64>,
    /// Place in the world frame, metres; with `x_m`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub y_m: Option<f64>,
    /// Longitude, degrees; with `latitude_deg`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub longitude_deg: Option<f64>,
    /// Latitude, degrees; with `longitude_deg`.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub latitude_deg: Option<f64>,
    /// Height of its foot, metres; `None` = on the ground.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub z_m: Option<f64>,
    /// Direction of its x axis, degrees counter-clockwise from east.
    #[serde(default)]
    pub yaw_deg: f64,
}

/// Where a [`RoadsideConfig`] stands.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum RoadsidePlace {
    /// x and y in the world frame, metres.
    World([f64; 2]),
    /// Longitude and latitude, degrees.
    Geodetic([f64; 2]),
}

impl RoadsideConfig {
    /// Where it stands; `None` unless exactly one of the two pairs is given.
    #[must_use]
    pub fn place(&self) -> Option<RoadsidePlace> {
        match (self.x_m, self.y_m, self.longitude_deg, self.latitude_deg) {
            (Some(x_m), Some(y_m), None, None) => Some(RoadsidePlace::World([x_m, y_m])),
            (None, None, Some(longitude), Some(latitude)) => Some(RoadsidePlace::Geodetic([longitude, latitude])),
            _ => None,
        }
    }
}

/// A sensor that sends messages of its own: one of a suite, or that of a section. `run.json` lists them all (`sensor_units`).
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct SensorUnit {
    /// Its kind.
    #[serde(serialize_with = "kind_name")]
    pub kind: SensorKind,
    /// Number among the sensors of its kind, `sensor` in messages; [`OWN_SENSOR`] for that of a section.
    pub sensor: u32,
    /// Place of its suite among those of the run; `None` for that of a section.
    #[serde(skip)]
    pub suite_index: Option<usize>,
    /// Name of its suite; "" for that of a section.
    pub suite: String,
    /// Its name; that of the kind for that of a section.
    pub name: String,
    /// Where it is mounted: x, y, z from the centre of the rear axle on the ground (metres), then roll, pitch (nose up), yaw (radians).
    pub mount: [f64; 6],
    /// Ticks between two samples.
    pub period_ticks: u32,
    /// Place among the sensors of its suite.
    #[serde(skip)]
    place: usize,
}

#[expect(clippy::trivially_copy_pass_by_ref, reason = "serde calls it so")]
fn kind_name<S: Serializer>(kind: &SensorKind, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(kind.name())
}

impl SensorUnit {
    /// Joins the seed of an episode in the keys of the sensor's random numbers, so that two sensors of a vehicle differ. 0 for that of
    /// a section.
    #[must_use]
    pub fn noise_key(&self) -> u64 {
        match self.suite_index {
            None => 0,
            Some(_) => crate::traffic::id_hash(&format!("{}/{}", self.suite, self.name)),
        }
    }
}

impl Config {
    /// The sensors of this kind that send messages, in the order of their numbers.
    #[must_use]
    pub fn sensor_units(&self, kind: SensorKind) -> Vec<SensorUnit> {
        let own = self.has_own(kind).then(|| SensorUnit {
            kind,
            sensor: OWN_SENSOR,
            suite_index: None,
            suite: String::new(),
            name: kind.name().to_owned(),
            mount: match kind {
                SensorKind::Lidar => self.lidar.mount,
                SensorKind::Camera => self.camera.mount,
                SensorKind::Radar => self.radar.mount,
                _ => [0.0; 6],
            },
            period_ticks: self.period_ticks(kind),
            place: 0,
        });
        let placed = self.suites.iter().enumerate().flat_map(|(index, suite)| {
            let sensors = suite.sensors.iter().enumerate();
            sensors.map(move |(place, sensor)| (index, suite, place, sensor))
        });
        let of_kind = placed.filter(|(.., sensor)| sensor.model.kind() == kind && sensor.model.has_messages());
        let numbered = (OWN_SENSOR + 1..).zip(of_kind);
        let of_suites = numbered.map(|(number, (index, suite, place, sensor))| SensorUnit {
            kind,
            sensor: number,
            suite_index: Some(index),
            suite: suite.name.clone(),
            name: sensor.name.clone(),
            mount: sensor.model.mount(),
            period_ticks: sensor.period_ticks,
            place,
        });
        own.into_iter().chain(of_suites).collect()
    }

    /// Every sensor that sends messages of its own.
    #[must_use]
    pub fn all_sensor_units(&self) -> Vec<SensorUnit> {
        let kinds = [SensorKind::Lidar, SensorKind::Camera, SensorKind::Radar];
        kinds.into_iter().flat_map(|kind| self.sensor_units(kind)).collect()
    }

    /// This configuration with the sensor `unit` in the place of the one that its section describes.
    #[must_use]
    pub fn with_unit(&self, unit: &SensorUnit) -> Self {
        let mut config = self.clone();
        let suite = unit.suite_index.and_then(|index| self.suites.get(index));
        match suite
            .and_then(|suite| suite.sensors.get(unit.place))
            .map(|sensor| &sensor.model)
        {
            Some(MountedModel::Lidar(lidar)) => config.lidar = LidarConfig::clone(lidar),
            Some(MountedModel::Camera(camera)) => config.camera = CameraConfig::clone(camera),
            Some(MountedModel::Radar(radar)) => config.radar = RadarConfig::clone(radar),
            Some(MountedModel::Gnss(_) | MountedModel::Imu(_)) | None => {}
        }
        config
    }

    /// True if a section of the configuration gives vehicles a sensor of this kind.
    #[must_use]
    pub fn has_own(&self, kind: SensorKind) -> bool {
        (kind.spec().vehicles)(self) > 0
    }

    /// True if any carrier of the run has a sensor of this kind.
    #[must_use]
    pub fn carries(&self, kind: SensorKind) -> bool {
        let mut sensors = self.suites.iter().flat_map(|suite| &suite.sensors);
        self.has_own(kind) || sensors.any(|sensor| sensor.model.kind() == kind)
    }

    /// Ticks between two samples of the sensor that a section describes: validated to be a whole number.
    #[must_use]
    pub fn period_ticks(&self, kind: SensorKind) -> u32 {
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "clamped to the numbers of its type"
        )]
        let ticks = ((kind.spec().period_s)(self) / self.run.tick_s)
            .round()
            .clamp(1.0, f64::from(u32::MAX)) as u32;
        ticks
    }

    /// True if no vehicle carries this suite: it has no rule, and a carrier beside the road names it.
    #[must_use]
    pub fn is_roadside_only(&self, suite: &SuiteConfig) -> bool {
        !suite.has_rule() && self.roadsides.iter().any(|roadside| roadside.suite == suite.name)
    }

    /// Bits of the suites whose classes, types, ids and shares admit a vehicle, as in [`crate::world::VehicleState::flags`] above
    /// [`crate::world::SUITES_SHIFT`].
    #[must_use]
    pub fn suites_of(&self, seed: u64, vehicle: SuiteCandidate<'_>) -> u32 {
        let suites = (0_u32..).zip(self.suites.iter().take(MOST_SUITES));
        let admitted = suites.filter(|(_, suite)| !self.is_roadside_only(suite) && suite.admits(seed, vehicle));
        admitted.fold(0, |bits, (number, _)| bits | 1 << number)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> Config {
        Config::from_json(include_str!("../../tests/town.json")).unwrap()
    }

    fn camera(name: &str) -> SuiteSensor {
        SuiteSensor {
            name: name.into(),
            period_ticks: 2,
            model: MountedModel::Camera(Box::new(CameraConfig {
                width: 42,
                blackout_gap_s: [0.0; 2],
                ..config().camera
            })),
        }
    }

    fn suite(name: &str) -> SuiteConfig {
        SuiteConfig {
            name: name.into(),
            classes: Vec::new(),
            types: Vec::new(),
            ids: Vec::new(),
            share: 1.0,
            first: None,
            sensors: vec![camera("left"), camera("right")],
        }
    }

    const BUS: SuiteCandidate<'_> = SuiteCandidate {
        id: "bus.7",
        class: "bus",
        vehicle_type: "citaro",
    };

    #[test]
    fn a_star_stands_for_any_text() {
        let matches = |pattern: &str, id: &str| pattern.parse::<IdPattern>().unwrap().matches(id);
        for (pattern, id) in [
            ("a", "a"),
            ("*", ""),
            ("a*", "ab"),
            ("*b", "ab"),
            ("a*c*e", "abcde"),
            ("a*b*b", "abb"),
            ("**", "x"),
        ] {
            assert!(matches(pattern, id), "{pattern} {id}");
        }
        for (pattern, id) in [
            ("a", "ab"),
            ("a*", "ba"),
            ("*b", "ba"),
            ("a*a", "a"),
            ("a*c*e", "aec"),
            ("a*b*b", "ab"),
            ("", "a"),
        ] {
            assert!(!matches(pattern, id), "{pattern} {id}");
        }
        assert_eq!("cav.*".parse::<IdPattern>().unwrap().to_string(), "cav.*");
    }

    #[test]
    fn class_type_id_and_share_all_have_to_hold() {
        let with = |change: fn(&mut SuiteConfig)| {
            let mut suite = suite("a");
            change(&mut suite);
            suite.admits(1, BUS)
        };
        assert!(with(|_| ()));
        assert!(with(|suite| suite.classes = vec!["truck".into(), "bus".into()]));
        assert!(!with(|suite| suite.classes = vec!["truck".into()]));
        assert!(with(|suite| suite.types = vec!["citaro".into()]));
        assert!(!with(|suite| suite.types = vec!["Citaro".into()]));
        assert!(with(|suite| suite.ids = vec!["bus.*".parse().unwrap()]));
        assert!(!with(|suite| suite.ids = vec!["cav.*".parse().unwrap()]));
        assert!(!with(|suite| suite.share = 0.0));
    }

    #[test]
    fn a_share_is_fair_and_belongs_to_seed_suite_and_id() {
        let mut a = suite("a");
        a.share = 0.3;
        let chosen = |suite: &SuiteConfig, seed: u64| -> Vec<u32> {
            let admitted = (0..10_000).filter(|number| {
                let id = format!("cav.{number}");
                suite.admits(seed, SuiteCandidate { id: &id, ..BUS })
            });
            admitted.collect()
        };
        let first = chosen(&a, 1);
        // Binomial: 5 standard deviations are 229.
        assert!((2_771..=3_229).contains(&first.len()), "{}", first.len());
        assert_eq!(first, chosen(&a, 1));
        assert_ne!(first, chosen(&a, 2));
        a.name = "b".into();
        assert_ne!(first, chosen(&a, 1));
    }

    #[test]
    fn sensors_of_a_kind_are_numbered_and_differ_in_their_noise() {
        let mut config = config();
        assert!(config.sensor_units(SensorKind::Camera).is_empty());
        config.camera.vehicles = 1;
        config.suites = vec![suite("a"), suite("b")];
        let units = config.sensor_units(SensorKind::Camera);
        let named: Vec<_> = units
            .iter()
            .map(|unit| (unit.sensor, unit.suite.as_str(), unit.name.as_str(), unit.period_ticks))
            .collect();
        assert_eq!(
            named,
            [
                (0, "", "camera", 1),
                (1, "a", "left", 2),
                (2, "a", "right", 2),
                (3, "b", "left", 2),
                (4, "b", "right", 2)
            ]
        );
        let mut keys: Vec<u64> = units.iter().map(SensorUnit::noise_key).collect();
        assert_eq!(keys[0], 0);
        keys.sort_unstable();
        keys.dedup();
        assert_eq!(keys.len(), 5);
        assert_eq!(config.with_unit(&units[0]), config);
        assert_eq!(config.with_unit(&units[2]).camera.width, 42);
        // A sensor of a suite keeps its number without that of the section.
        config.camera.vehicles = 0;
        assert_eq!(config.sensor_units(SensorKind::Camera), units[1..]);
    }

    #[test]
    fn a_suite_survives_json_without_the_keys_of_its_kind() {
        let suite = suite("a");
        let text = serde_json::to_string(&suite).unwrap();
        assert!(!text.contains("blackout") && !text.contains("vehicles"), "{text}");
        let again: SuiteConfig = serde_json::from_str(&text).unwrap();
        assert_eq!(again.sensors[0].model.kind(), SensorKind::Camera);
        assert_eq!(serde_json::to_string(&again).unwrap(), text);
        assert!(serde_json::from_str::<SuiteConfig>(&text.replace("width", "widht")).is_err());
    }

    #[test]
    fn a_suite_without_a_rule_that_stands_beside_the_road_is_carried_by_no_vehicle() {
        let mut config = config();
        config.suites = vec![suite("mast"), suite("car")];
        assert_eq!(config.suites_of(1, BUS), 0b11);
        config.roadsides = vec![RoadsideConfig {
            name: "m".into(),
            suite: "mast".into(),
            x_m: Some(1.0),
            y_m: Some(2.0),
            longitude_deg: None,
            latitude_deg: None,
            z_m: None,
            yaw_deg: 0.0,
        }];
        assert_eq!(config.suites_of(1, BUS), 0b10);
        config.suites[0].first = Some(3);
        assert_eq!(config.suites_of(1, BUS), 0b11);
        assert_eq!(config.roadsides[0].place(), Some(RoadsidePlace::World([1.0, 2.0])));
        config.roadsides[0].latitude_deg = Some(3.0);
        assert_eq!(config.roadsides[0].place(), None);
    }
}
