//! The fields of an observation, each specified once: name, unit, range, and what it shows. Names, presets, the check of the
//! configuration, the normalisation and the ranges that Python reads derive from [`FIELDS`] (decision 21).

use serde::{Deserialize, Deserializer, Serialize, Serializer, de::Error};

use crate::{
    config::{Config, TaskKind},
    run::MapInfo,
    sensor::SensorKind,
    world::{LONGEST_GAP_S, PERSON_BESIDE_M, ROUTE_AHEAD_M, SENSING_M, SIGHT_M},
};

/// Range of the distance to the route, metres.
const ROUTE_OFFSET_M: f64 = 5.0;
/// Range of the way left, metres.
const ROUTE_LEFT_M: f64 = 1000.0;
/// Range of heights above and below the ground, metres.
const HEIGHT_M: f64 = 100.0;
/// Range of the receiver's estimate of its error, metres.
const ACCURACY_M: f64 = 50.0;

/// What a field shows.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FieldSource {
    /// What a sensor measures: unknown while the sensor is dark.
    Measurement(SensorKind),
    /// How old and how valid a sensor's newest sample is: known while the sensor is dark, too.
    Delivery(SensorKind),
    /// The route and the traffic on it, which only a hero has.
    Route,
    /// Road users, junctions, traffic lights and persons around a hero.
    Around,
    /// What SUMO's own driver would have done with a hero.
    Advice,
}

/// Which values of a field the normalised range stands for.
#[derive(Debug, Clone, Copy)]
pub enum FieldRange {
    /// West to east of the map.
    MapX,
    /// South to north of the map.
    MapY,
    /// From the first to the second.
    Within(f64, f64),
    /// From 0 to this.
    UpTo(fn(&Config) -> f64),
    /// From minus this to plus this.
    PlusMinus(fn(&Config) -> f64),
}

impl FieldRange {
    /// Lower and upper end, in the field's unit, with the map's bounds `[x_min, y_min, x_max, y_max]` (metres).
    #[must_use]
    pub fn ends(self, config: &Config, bounds_m: [f64; 4]) -> (f64, f64) {
        match self {
            Self::MapX => (bounds_m[0], bounds_m[2]),
            Self::MapY => (bounds_m[1], bounds_m[3]),
            Self::Within(low, high) => (low, high),
            Self::UpTo(high) => (0.0, high(config)),
            Self::PlusMinus(limit) => (-limit(config), limit(config)),
        }
    }
}

/// One row of [`FIELDS`].
#[derive(Debug, Clone, Copy)]
pub struct FieldSpec {
    /// The field.
    pub field: Field,
    /// Name in the configuration and in JSON.
    pub name: &'static str,
    /// SI unit, or "" for a number without one.
    pub unit: &'static str,
    /// Which values the normalised range stands for; what is outside is clipped.
    pub range: FieldRange,
    /// What it shows.
    pub source: FieldSource,
}

/// Declares [`Field`] and [`FIELDS`] from one list: variant, name, unit, range and source of each field.
macro_rules! fields {
    ($($(#[$doc:meta])* $field:ident: $name:literal, $unit:literal, $range:expr, $source:expr;)+) => {
        /// One field of the observation.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[repr(u8)]
        pub enum Field {
            $($(#[$doc])* $field,)+
        }

        /// Every field, by [`Field`].
        pub const FIELDS: &[FieldSpec] = &[
            $(FieldSpec { field: Field::$field, name: $name, unit: $unit, range: $range, source: $source },)+
        ];
    };
}

use FieldRange::{MapX, MapY, PlusMinus, UpTo, Within};
use FieldSource::{Advice, Around, Delivery, Measurement, Route};
use SensorKind::{Gnss, Imu, Lidar, SpeedSteering, Ultrasonic};

const ACCELERATION: FieldRange = PlusMinus(|config| config.observation.accel_range_mps2);
const ROTATION: FieldRange = PlusMinus(|config| config.observation.gyro_range_radps);
const SPEED: FieldRange = UpTo(|config| config.observation.speed_range_mps);
const AGE: FieldRange = UpTo(|config| config.observation.age_range_s);
const VALIDITY: FieldRange = Within(0.0, 1.0);
/// The end of the range stands for no object.
const OBJECT: FieldRange = PlusMinus(|config| config.lidar.range_m);
/// The end of the range stands for no echo.
const ECHO: FieldRange = UpTo(|config| config.ultrasonic.range_m);
/// The end of the range stands for nothing in sight.
const SIGHT: FieldRange = Within(0.0, SIGHT_M);

/// Within this distance a hero senses road users.
const NEAR: FieldRange = Within(-SENSING_M, SENSING_M);
const VELOCITY: FieldRange = PlusMinus(|config| config.observation.speed_range_mps);
const SINE: FieldRange = Within(-1.0, 1.0);
const LENGTH: FieldRange = Within(0.0, 20.0);
const WIDTH: FieldRange = Within(0.0, 4.0);
/// The end of the range stands for no rival.
const GAP: FieldRange = Within(0.0, LONGEST_GAP_S);
const AHEAD: FieldRange = Within(0.0, SENSING_M);
const BESIDE: FieldRange = Within(-PERSON_BESIDE_M, PERSON_BESIDE_M);
const WALKING: FieldRange = Within(-3.0, 3.0);

/// Range of the route at the `index`-th of [`ROUTE_AHEAD_M`].
const fn ahead(index: usize) -> FieldRange {
    Within(-ROUTE_AHEAD_M[index], ROUTE_AHEAD_M[index])
}

fields! {
    /// GNSS fix, east, world frame.
    GnssX: "gnss_x", "m", MapX, Measurement(Gnss);
    /// GNSS fix, north, world frame.
    GnssY: "gnss_y", "m", MapY, Measurement(Gnss);
    /// Accelerometer, forward.
    AccelX: "accel_x", "m/s²", ACCELERATION, Measurement(Imu);
    /// Accelerometer, left.
    AccelY: "accel_y", "m/s²", ACCELERATION, Measurement(Imu);
    /// Accelerometer, up.
    AccelZ: "accel_z", "m/s²", ACCELERATION, Measurement(Imu);
    /// Gyroscope, roll rate.
    GyroX: "gyro_x", "rad/s", ROTATION, Measurement(Imu);
    /// Gyroscope, pitch rate.
    GyroY: "gyro_y", "rad/s", ROTATION, Measurement(Imu);
    /// Gyroscope, yaw rate.
    GyroZ: "gyro_z", "rad/s", ROTATION, Measurement(Imu);
    /// Heading clockwise from north.
    Compass: "compass", "rad", Within(0.0, std::f64::consts::TAU), Measurement(Imu);
    /// Wheel speed.
    Speed: "speed", "m/s", SPEED, Measurement(SpeedSteering);
    /// Steering-wheel angle.
    Steering: "steering", "rad", PlusMinus(|config| config.observation.steering_range_rad), Measurement(SpeedSteering);
    /// GNSS fix, height in the world frame about its origin.
    GnssZ: "gnss_z", "m", Within(-HEIGHT_M, HEIGHT_M), Measurement(Gnss);
    /// GNSS receiver's own estimate of its horizontal error (1σ of the distance).
    GnssAccuracy: "gnss_accuracy", "m", Within(0.0, ACCURACY_M), Measurement(Gnss);
    /// Age of the newest GNSS fix.
    GnssAge: "gnss_age", "s", AGE, Delivery(Gnss);
    /// 1 while the GNSS receiver delivers, 0 in a blackout.
    GnssValid: "gnss_valid", "", VALIDITY, Delivery(Gnss);
    /// Age of the newest IMU sample.
    ImuAge: "imu_age", "s", AGE, Delivery(Imu);
    /// 1 while the IMU delivers, 0 in a blackout.
    ImuValid: "imu_valid", "", VALIDITY, Delivery(Imu);
    /// Age of the newest speed and steering sample.
    SpeedSteeringAge: "speed_steering_age", "s", AGE, Delivery(SpeedSteering);
    /// 1 while the speed and steering sensor delivers, 0 in a blackout.
    SpeedSteeringValid: "speed_steering_valid", "", VALIDITY, Delivery(SpeedSteering);
    /// Nearest object that the LIDAR sees: its nearest point, forward of the rear axle.
    Object1X: "object_1_x", "m", OBJECT, Measurement(Lidar);
    /// Nearest object: its nearest point, to the left of the rear axle.
    Object1Y: "object_1_y", "m", OBJECT, Measurement(Lidar);
    /// Second nearest object, forward.
    Object2X: "object_2_x", "m", OBJECT, Measurement(Lidar);
    /// Second nearest object, left.
    Object2Y: "object_2_y", "m", OBJECT, Measurement(Lidar);
    /// Third nearest object, forward.
    Object3X: "object_3_x", "m", OBJECT, Measurement(Lidar);
    /// Third nearest object, left.
    Object3Y: "object_3_y", "m", OBJECT, Measurement(Lidar);
    /// Fourth nearest object, forward.
    Object4X: "object_4_x", "m", OBJECT, Measurement(Lidar);
    /// Fourth nearest object, left.
    Object4Y: "object_4_y", "m", OBJECT, Measurement(Lidar);
    /// The route 5 m ahead, forward of the rear axle.
    RouteX5: "route_x_5", "m", ahead(0), Route;
    /// The route 5 m ahead, to the left of the rear axle.
    RouteY5: "route_y_5", "m", ahead(0), Route;
    /// The route 10 m ahead, forward of the rear axle.
    RouteX10: "route_x_10", "m", ahead(1), Route;
    /// The route 10 m ahead, to the left of the rear axle.
    RouteY10: "route_y_10", "m", ahead(1), Route;
    /// The route 20 m ahead, forward of the rear axle.
    RouteX20: "route_x_20", "m", ahead(2), Route;
    /// The route 20 m ahead, to the left of the rear axle.
    RouteY20: "route_y_20", "m", ahead(2), Route;
    /// The route 40 m ahead, forward of the rear axle.
    RouteX40: "route_x_40", "m", ahead(3), Route;
    /// The route 40 m ahead, to the left of the rear axle.
    RouteY40: "route_y_40", "m", ahead(3), Route;
    /// Speed limit.
    SpeedLimit: "speed_limit", "m/s", SPEED, Route;
    /// Centre line of the route as seen from the rear axle, positive to the left.
    RouteOffset: "route_offset", "m", Within(-ROUTE_OFFSET_M, ROUTE_OFFSET_M), Route;
    /// Distance to the end of the route.
    RouteLeft: "route_left", "m", Within(0.0, ROUTE_LEFT_M), Route;
    /// Gap to the next road user on the route.
    LeaderGap: "leader_gap", "m", SIGHT, Route;
    /// Speed of that road user along the route.
    LeaderSpeed: "leader_speed", "m/s", SPEED, Route;
    /// Distance to the next stop line whose signal is not green.
    SignalGap: "signal_gap", "m", SIGHT, Route;
    /// Range of the ultrasonic sensor in mount 1.
    Ultrasonic1: "ultrasonic_1", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 2.
    Ultrasonic2: "ultrasonic_2", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 3.
    Ultrasonic3: "ultrasonic_3", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 4.
    Ultrasonic4: "ultrasonic_4", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 5.
    Ultrasonic5: "ultrasonic_5", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 6.
    Ultrasonic6: "ultrasonic_6", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 7.
    Ultrasonic7: "ultrasonic_7", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 8.
    Ultrasonic8: "ultrasonic_8", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 9.
    Ultrasonic9: "ultrasonic_9", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 10.
    Ultrasonic10: "ultrasonic_10", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 11.
    Ultrasonic11: "ultrasonic_11", "m", ECHO, Measurement(Ultrasonic);
    /// Range of the ultrasonic sensor in mount 12.
    Ultrasonic12: "ultrasonic_12", "m", ECHO, Measurement(Ultrasonic);
    /// Age of the newest ultrasonic sample.
    UltrasonicAge: "ultrasonic_age", "s", AGE, Delivery(Ultrasonic);
    /// 1 while the ultrasonic sensors deliver, 0 in a blackout.
    UltrasonicValid: "ultrasonic_valid", "", VALIDITY, Delivery(Ultrasonic);
    /// Nearest road user: its middle, forward of the rear axle.
    User1X: "user_1_x", "m", NEAR, Around;
    /// Nearest road user: its middle, to the left of the rear axle.
    User1Y: "user_1_y", "m", NEAR, Around;
    /// Nearest road user: cosine of its heading from the hero's.
    User1Cos: "user_1_cos", "", SINE, Around;
    /// Nearest road user: sine of its heading from the hero's.
    User1Sin: "user_1_sin", "", SINE, Around;
    /// Nearest road user: velocity, forward.
    User1Forward: "user_1_forward", "m/s", VELOCITY, Around;
    /// Nearest road user: velocity, to the left.
    User1Left: "user_1_left", "m/s", VELOCITY, Around;
    /// Nearest road user: length, 0 for none.
    User1Length: "user_1_length", "m", LENGTH, Around;
    /// Nearest road user: width, 0 for none.
    User1Width: "user_1_width", "m", WIDTH, Around;
    /// Nearest road user: distance along the route to where it will be in the hero's way.
    User1Way: "user_1_way", "m", AHEAD, Around;
    /// Nearest road user: time until the hero is there at its speed.
    User1Reaches: "user_1_reaches", "s", GAP, Around;
    /// Nearest road user: time until its front is in the middle of the hero's way.
    User1Enters: "user_1_enters", "s", GAP, Around;
    /// Nearest road user: time until its rear has left the middle of the hero's way.
    User1Leaves: "user_1_leaves", "s", GAP, Around;
    /// Nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User1Turn: "user_1_turn", "", SINE, Around;
    /// Second nearest road user: its middle, forward of the rear axle.
    User2X: "user_2_x", "m", NEAR, Around;
    /// Second nearest road user: its middle, to the left of the rear axle.
    User2Y: "user_2_y", "m", NEAR, Around;
    /// Second nearest road user: cosine of its heading from the hero's.
    User2Cos: "user_2_cos", "", SINE, Around;
    /// Second nearest road user: sine of its heading from the hero's.
    User2Sin: "user_2_sin", "", SINE, Around;
    /// Second nearest road user: velocity, forward.
    User2Forward: "user_2_forward", "m/s", VELOCITY, Around;
    /// Second nearest road user: velocity, to the left.
    User2Left: "user_2_left", "m/s", VELOCITY, Around;
    /// Second nearest road user: length, 0 for none.
    User2Length: "user_2_length", "m", LENGTH, Around;
    /// Second nearest road user: width, 0 for none.
    User2Width: "user_2_width", "m", WIDTH, Around;
    /// Second nearest road user: distance along the route to where it will be in the hero's way.
    User2Way: "user_2_way", "m", AHEAD, Around;
    /// Second nearest road user: time until the hero is there at its speed.
    User2Reaches: "user_2_reaches", "s", GAP, Around;
    /// Second nearest road user: time until its front is in the middle of the hero's way.
    User2Enters: "user_2_enters", "s", GAP, Around;
    /// Second nearest road user: time until its rear has left the middle of the hero's way.
    User2Leaves: "user_2_leaves", "s", GAP, Around;
    /// Second nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User2Turn: "user_2_turn", "", SINE, Around;
    /// Third nearest road user: its middle, forward of the rear axle.
    User3X: "user_3_x", "m", NEAR, Around;
    /// Third nearest road user: its middle, to the left of the rear axle.
    User3Y: "user_3_y", "m", NEAR, Around;
    /// Third nearest road user: cosine of its heading from the hero's.
    User3Cos: "user_3_cos", "", SINE, Around;
    /// Third nearest road user: sine of its heading from the hero's.
    User3Sin: "user_3_sin", "", SINE, Around;
    /// Third nearest road user: velocity, forward.
    User3Forward: "user_3_forward", "m/s", VELOCITY, Around;
    /// Third nearest road user: velocity, to the left.
    User3Left: "user_3_left", "m/s", VELOCITY, Around;
    /// Third nearest road user: length, 0 for none.
    User3Length: "user_3_length", "m", LENGTH, Around;
    /// Third nearest road user: width, 0 for none.
    User3Width: "user_3_width", "m", WIDTH, Around;
    /// Third nearest road user: distance along the route to where it will be in the hero's way.
    User3Way: "user_3_way", "m", AHEAD, Around;
    /// Third nearest road user: time until the hero is there at its speed.
    User3Reaches: "user_3_reaches", "s", GAP, Around;
    /// Third nearest road user: time until its front is in the middle of the hero's way.
    User3Enters: "user_3_enters", "s", GAP, Around;
    /// Third nearest road user: time until its rear has left the middle of the hero's way.
    User3Leaves: "user_3_leaves", "s", GAP, Around;
    /// Third nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User3Turn: "user_3_turn", "", SINE, Around;
    /// Fourth nearest road user: its middle, forward of the rear axle.
    User4X: "user_4_x", "m", NEAR, Around;
    /// Fourth nearest road user: its middle, to the left of the rear axle.
    User4Y: "user_4_y", "m", NEAR, Around;
    /// Fourth nearest road user: cosine of its heading from the hero's.
    User4Cos: "user_4_cos", "", SINE, Around;
    /// Fourth nearest road user: sine of its heading from the hero's.
    User4Sin: "user_4_sin", "", SINE, Around;
    /// Fourth nearest road user: velocity, forward.
    User4Forward: "user_4_forward", "m/s", VELOCITY, Around;
    /// Fourth nearest road user: velocity, to the left.
    User4Left: "user_4_left", "m/s", VELOCITY, Around;
    /// Fourth nearest road user: length, 0 for none.
    User4Length: "user_4_length", "m", LENGTH, Around;
    /// Fourth nearest road user: width, 0 for none.
    User4Width: "user_4_width", "m", WIDTH, Around;
    /// Fourth nearest road user: distance along the route to where it will be in the hero's way.
    User4Way: "user_4_way", "m", AHEAD, Around;
    /// Fourth nearest road user: time until the hero is there at its speed.
    User4Reaches: "user_4_reaches", "s", GAP, Around;
    /// Fourth nearest road user: time until its front is in the middle of the hero's way.
    User4Enters: "user_4_enters", "s", GAP, Around;
    /// Fourth nearest road user: time until its rear has left the middle of the hero's way.
    User4Leaves: "user_4_leaves", "s", GAP, Around;
    /// Fourth nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User4Turn: "user_4_turn", "", SINE, Around;
    /// Fifth nearest road user: its middle, forward of the rear axle.
    User5X: "user_5_x", "m", NEAR, Around;
    /// Fifth nearest road user: its middle, to the left of the rear axle.
    User5Y: "user_5_y", "m", NEAR, Around;
    /// Fifth nearest road user: cosine of its heading from the hero's.
    User5Cos: "user_5_cos", "", SINE, Around;
    /// Fifth nearest road user: sine of its heading from the hero's.
    User5Sin: "user_5_sin", "", SINE, Around;
    /// Fifth nearest road user: velocity, forward.
    User5Forward: "user_5_forward", "m/s", VELOCITY, Around;
    /// Fifth nearest road user: velocity, to the left.
    User5Left: "user_5_left", "m/s", VELOCITY, Around;
    /// Fifth nearest road user: length, 0 for none.
    User5Length: "user_5_length", "m", LENGTH, Around;
    /// Fifth nearest road user: width, 0 for none.
    User5Width: "user_5_width", "m", WIDTH, Around;
    /// Fifth nearest road user: distance along the route to where it will be in the hero's way.
    User5Way: "user_5_way", "m", AHEAD, Around;
    /// Fifth nearest road user: time until the hero is there at its speed.
    User5Reaches: "user_5_reaches", "s", GAP, Around;
    /// Fifth nearest road user: time until its front is in the middle of the hero's way.
    User5Enters: "user_5_enters", "s", GAP, Around;
    /// Fifth nearest road user: time until its rear has left the middle of the hero's way.
    User5Leaves: "user_5_leaves", "s", GAP, Around;
    /// Fifth nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User5Turn: "user_5_turn", "", SINE, Around;
    /// Sixth nearest road user: its middle, forward of the rear axle.
    User6X: "user_6_x", "m", NEAR, Around;
    /// Sixth nearest road user: its middle, to the left of the rear axle.
    User6Y: "user_6_y", "m", NEAR, Around;
    /// Sixth nearest road user: cosine of its heading from the hero's.
    User6Cos: "user_6_cos", "", SINE, Around;
    /// Sixth nearest road user: sine of its heading from the hero's.
    User6Sin: "user_6_sin", "", SINE, Around;
    /// Sixth nearest road user: velocity, forward.
    User6Forward: "user_6_forward", "m/s", VELOCITY, Around;
    /// Sixth nearest road user: velocity, to the left.
    User6Left: "user_6_left", "m/s", VELOCITY, Around;
    /// Sixth nearest road user: length, 0 for none.
    User6Length: "user_6_length", "m", LENGTH, Around;
    /// Sixth nearest road user: width, 0 for none.
    User6Width: "user_6_width", "m", WIDTH, Around;
    /// Sixth nearest road user: distance along the route to where it will be in the hero's way.
    User6Way: "user_6_way", "m", AHEAD, Around;
    /// Sixth nearest road user: time until the hero is there at its speed.
    User6Reaches: "user_6_reaches", "s", GAP, Around;
    /// Sixth nearest road user: time until its front is in the middle of the hero's way.
    User6Enters: "user_6_enters", "s", GAP, Around;
    /// Sixth nearest road user: time until its rear has left the middle of the hero's way.
    User6Leaves: "user_6_leaves", "s", GAP, Around;
    /// Sixth nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User6Turn: "user_6_turn", "", SINE, Around;
    /// Seventh nearest road user: its middle, forward of the rear axle.
    User7X: "user_7_x", "m", NEAR, Around;
    /// Seventh nearest road user: its middle, to the left of the rear axle.
    User7Y: "user_7_y", "m", NEAR, Around;
    /// Seventh nearest road user: cosine of its heading from the hero's.
    User7Cos: "user_7_cos", "", SINE, Around;
    /// Seventh nearest road user: sine of its heading from the hero's.
    User7Sin: "user_7_sin", "", SINE, Around;
    /// Seventh nearest road user: velocity, forward.
    User7Forward: "user_7_forward", "m/s", VELOCITY, Around;
    /// Seventh nearest road user: velocity, to the left.
    User7Left: "user_7_left", "m/s", VELOCITY, Around;
    /// Seventh nearest road user: length, 0 for none.
    User7Length: "user_7_length", "m", LENGTH, Around;
    /// Seventh nearest road user: width, 0 for none.
    User7Width: "user_7_width", "m", WIDTH, Around;
    /// Seventh nearest road user: distance along the route to where it will be in the hero's way.
    User7Way: "user_7_way", "m", AHEAD, Around;
    /// Seventh nearest road user: time until the hero is there at its speed.
    User7Reaches: "user_7_reaches", "s", GAP, Around;
    /// Seventh nearest road user: time until its front is in the middle of the hero's way.
    User7Enters: "user_7_enters", "s", GAP, Around;
    /// Seventh nearest road user: time until its rear has left the middle of the hero's way.
    User7Leaves: "user_7_leaves", "s", GAP, Around;
    /// Seventh nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User7Turn: "user_7_turn", "", SINE, Around;
    /// Eighth nearest road user: its middle, forward of the rear axle.
    User8X: "user_8_x", "m", NEAR, Around;
    /// Eighth nearest road user: its middle, to the left of the rear axle.
    User8Y: "user_8_y", "m", NEAR, Around;
    /// Eighth nearest road user: cosine of its heading from the hero's.
    User8Cos: "user_8_cos", "", SINE, Around;
    /// Eighth nearest road user: sine of its heading from the hero's.
    User8Sin: "user_8_sin", "", SINE, Around;
    /// Eighth nearest road user: velocity, forward.
    User8Forward: "user_8_forward", "m/s", VELOCITY, Around;
    /// Eighth nearest road user: velocity, to the left.
    User8Left: "user_8_left", "m/s", VELOCITY, Around;
    /// Eighth nearest road user: length, 0 for none.
    User8Length: "user_8_length", "m", LENGTH, Around;
    /// Eighth nearest road user: width, 0 for none.
    User8Width: "user_8_width", "m", WIDTH, Around;
    /// Eighth nearest road user: distance along the route to where it will be in the hero's way.
    User8Way: "user_8_way", "m", AHEAD, Around;
    /// Eighth nearest road user: time until the hero is there at its speed.
    User8Reaches: "user_8_reaches", "s", GAP, Around;
    /// Eighth nearest road user: time until its front is in the middle of the hero's way.
    User8Enters: "user_8_enters", "s", GAP, Around;
    /// Eighth nearest road user: time until its rear has left the middle of the hero's way.
    User8Leaves: "user_8_leaves", "s", GAP, Around;
    /// Eighth nearest road user: 1 if it indicates a turn to the left, -1 to the right.
    User8Turn: "user_8_turn", "", SINE, Around;
    /// Next junction of the route: distance to its stop line.
    Junction1Gap: "junction_1_gap", "m", SIGHT, Around;
    /// Next junction of the route: 1 with right of way, 0 without.
    Junction1Priority: "junction_1_priority", "", VALIDITY, Around;
    /// Next junction of the route: time until the next rival reaches the hero's way.
    Junction1Rival: "junction_1_rival", "s", GAP, Around;
    /// Second next junction of the route: distance to its stop line.
    Junction2Gap: "junction_2_gap", "m", SIGHT, Around;
    /// Second next junction of the route: 1 with right of way, 0 without.
    Junction2Priority: "junction_2_priority", "", VALIDITY, Around;
    /// Second next junction of the route: time until the next rival reaches the hero's way.
    Junction2Rival: "junction_2_rival", "s", GAP, Around;
    /// Third next junction of the route: distance to its stop line.
    Junction3Gap: "junction_3_gap", "m", SIGHT, Around;
    /// Third next junction of the route: 1 with right of way, 0 without.
    Junction3Priority: "junction_3_priority", "", VALIDITY, Around;
    /// Third next junction of the route: time until the next rival reaches the hero's way.
    Junction3Rival: "junction_3_rival", "s", GAP, Around;
    /// Next traffic light of the route: distance to its stop line.
    Light1Gap: "light_1_gap", "m", SIGHT, Around;
    /// Next traffic light of the route: 1 green, 0 red, yellow between them.
    Light1Green: "light_1_green", "", VALIDITY, Around;
    /// Second next traffic light of the route: distance to its stop line.
    Light2Gap: "light_2_gap", "m", SIGHT, Around;
    /// Second next traffic light of the route: 1 green, 0 red, yellow between them.
    Light2Green: "light_2_green", "", VALIDITY, Around;
    /// Nearest person beside the route: distance along the route.
    Person1Ahead: "person_1_ahead", "m", AHEAD, Around;
    /// Nearest person beside the route: distance to the left of the route.
    Person1Left: "person_1_left", "m", BESIDE, Around;
    /// Nearest person beside the route: speed to the left.
    Person1Speed: "person_1_speed", "m/s", WALKING, Around;
    /// Second nearest person beside the route: distance along the route.
    Person2Ahead: "person_2_ahead", "m", AHEAD, Around;
    /// Second nearest person beside the route: distance to the left of the route.
    Person2Left: "person_2_left", "m", BESIDE, Around;
    /// Second nearest person beside the route: speed to the left.
    Person2Speed: "person_2_speed", "m/s", WALKING, Around;
    /// Acceleration that SUMO's own driver would have chosen in the last step, from where the hero was before it.
    AdvisedAccel: "advised_accel", "m/s²", PlusMinus(|config| config.vehicle.max_decel_mps2), Advice;
}

/// Some fields of a preset.
#[derive(Debug, Clone, Copy)]
enum PresetPart {
    Named(&'static [Field]),
    All(FieldSource),
}

/// A choice of fields that has a name.
#[derive(Debug, Clone, Copy)]
pub struct FieldPreset {
    /// Name in `observation.fields`.
    pub name: &'static str,
    parts: &'static [PresetPart],
}

/// The paper's observation: position, acceleration, rotation and heading.
const PAPER: PresetPart = PresetPart::Named(&[
    Field::GnssX,
    Field::GnssY,
    Field::AccelX,
    Field::AccelY,
    Field::AccelZ,
    Field::GyroX,
    Field::GyroY,
    Field::GyroZ,
    Field::Compass,
]);
/// What the wheels say.
const WHEELS: PresetPart = PresetPart::Named(&[Field::Speed, Field::Steering]);

/// Every preset of `observation.fields`.
pub const FIELD_PRESETS: [FieldPreset; 6] = [
    FieldPreset {
        name: "paper",
        parts: &[PAPER],
    },
    FieldPreset {
        name: "caraware",
        parts: &[PAPER, WHEELS],
    },
    FieldPreset {
        name: "driving",
        parts: &[WHEELS, PresetPart::All(Route)],
    },
    FieldPreset {
        name: "driver",
        parts: &[WHEELS, PresetPart::All(Route), PresetPart::All(Around)],
    },
    FieldPreset {
        name: "advised-driver",
        parts: &[
            WHEELS,
            PresetPart::All(Route),
            PresetPart::All(Around),
            PresetPart::All(Advice),
        ],
    },
    FieldPreset {
        name: "ultrasonic",
        parts: &[PAPER, WHEELS, PresetPart::All(Measurement(Ultrasonic))],
    },
];

impl FieldPreset {
    /// The preset with this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        FIELD_PRESETS.into_iter().find(|preset| preset.name == name)
    }

    /// Its fields, in the order of the row.
    #[must_use]
    pub fn fields(&self) -> Vec<Field> {
        let fields = |part: &PresetPart| match part {
            PresetPart::Named(fields) => fields.to_vec(),
            PresetPart::All(source) => {
                let rows = FIELDS.iter().filter(|spec| spec.source == *source);
                rows.map(|spec| spec.field).collect()
            }
        };
        self.parts.iter().flat_map(fields).collect()
    }
}

impl FieldSource {
    /// The sensor that has to be there.
    #[must_use]
    pub fn sensor(self) -> Option<SensorKind> {
        match self {
            Measurement(sensor) | Delivery(sensor) => Some(sensor),
            Route | Around | Advice => None,
        }
    }

    /// The task that has to be set.
    #[must_use]
    pub fn task(self) -> Option<TaskKind> {
        match self {
            Measurement(_) | Delivery(_) => None,
            Route | Around | Advice => Some(TaskKind::Driving),
        }
    }
}

impl Field {
    /// Its row.
    #[must_use]
    pub const fn spec(self) -> &'static FieldSpec {
        &FIELDS[self as usize]
    }

    /// Name in the configuration and in JSON.
    #[must_use]
    pub const fn name(self) -> &'static str {
        self.spec().name
    }

    /// The field with this name.
    #[must_use]
    pub fn by_name(name: &str) -> Option<Self> {
        FIELDS.iter().find(|spec| spec.name == name).map(|spec| spec.field)
    }

    /// Place of the field in [`crate::world::HeroView::around`]; `None` for one that shows something else.
    #[must_use]
    pub const fn place_around(self) -> Option<usize> {
        match self.spec().source {
            Around => Some(self as usize - Self::User1X as usize),
            _ => None,
        }
    }

    /// Bit of the sensor that the field is a measurement of; 0 for what is known while every sensor is dark.
    #[must_use]
    pub const fn measurement_bit(self) -> u32 {
        match self.spec().source {
            Measurement(sensor) => sensor.bit(),
            Delivery(_) | Route | Around | Advice => 0,
        }
    }
}

impl Serialize for Field {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(self.name())
    }
}

impl<'de> Deserialize<'de> for Field {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let name = String::deserialize(deserializer)?;
        Self::by_name(&name).ok_or_else(|| D::Error::custom(format!("unknown observation field `{name}`")))
    }
}

/// A field as a run's own: with the ends of its range. Part of the run file, for readers in other languages.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct RunField {
    /// Name in `observation.fields`.
    pub name: &'static str,
    /// SI unit, or "".
    pub unit: &'static str,
    /// Lower and upper end of the range, in that unit.
    pub range: [f64; 2],
}

/// Every field with its range under this configuration on this map.
#[must_use]
pub fn run_fields(config: &Config, map: &MapInfo) -> Vec<RunField> {
    let fields = FIELDS.iter().map(|spec| {
        let (low, high) = spec.range.ends(config, map.bounds_m);
        RunField {
            name: spec.name,
            unit: spec.unit,
            range: [low, high],
        }
    });
    fields.collect()
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;
    use crate::world::AROUND;

    #[test]
    fn names_are_unique_and_lead_back_to_their_field() {
        let names: BTreeSet<&str> = FIELDS.iter().map(|spec| spec.name).collect();
        assert_eq!(names.len(), FIELDS.len());
        for spec in FIELDS {
            assert_eq!(Field::by_name(spec.name), Some(spec.field));
            assert_eq!(spec.field.name(), spec.name);
        }
    }

    #[test]
    fn ages_and_validities_are_named_after_their_sensor() {
        for spec in FIELDS {
            if let Delivery(sensor) = spec.source {
                assert!(
                    spec.name == format!("{}_age", sensor.name()) || spec.name == format!("{}_valid", sensor.name())
                );
            }
        }
    }

    #[test]
    fn presets_are_those_of_the_papers_and_of_every_run_so_far() {
        let names = |preset: &str| -> Vec<&str> {
            let preset = FieldPreset::by_name(preset).unwrap();
            preset.fields().into_iter().map(Field::name).collect()
        };
        let paper = [
            "gnss_x", "gnss_y", "accel_x", "accel_y", "accel_z", "gyro_x", "gyro_y", "gyro_z", "compass",
        ];
        assert_eq!(names("paper"), paper);
        assert_eq!(names("caraware"), [&paper[..], &["speed", "steering"]].concat());
        let driving = [
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
        assert_eq!(names("driving"), driving);
        let driver = names("driver");
        assert_eq!(driver[..16], driving);
        assert_eq!(driver.len(), 16 + AROUND);
        assert_eq!((driver[16], driver[138]), ("user_1_x", "person_2_speed"));
        assert_eq!(names("advised-driver"), [&driver[..], &["advised_accel"]].concat());
        let (ultrasonic, caraware) = (names("ultrasonic"), names("caraware"));
        assert_eq!(ultrasonic[..11], caraware);
        assert_eq!(
            (ultrasonic.len(), ultrasonic[11], ultrasonic[22]),
            (23, "ultrasonic_1", "ultrasonic_12")
        );
    }
}
