//! What a row of the observation holds, and how it is scaled.

use serde::{Deserialize, Serialize};

/// Scale of the normalised observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scale {
    /// The paper's text: 0 … 1.
    ZeroToOne,
    /// CarAware's code: −1 … 1.
    MinusOneToOne,
}

/// One field of the observation.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Field {
    /// GNSS fix, x in the world frame; range: the map's bounds.
    GnssX,
    /// GNSS fix, y in the world frame; range: the map's bounds.
    GnssY,
    /// Accelerometer, forward; range ± `accel_range_mps2`.
    AccelX,
    /// Accelerometer, left.
    AccelY,
    /// Accelerometer, up.
    AccelZ,
    /// Gyroscope, roll rate; range ± `gyro_range_radps`.
    GyroX,
    /// Gyroscope, pitch rate.
    GyroY,
    /// Gyroscope, yaw rate.
    GyroZ,
    /// Heading clockwise from north; range 0 … 2π.
    Compass,
    /// Wheel speed; range 0 … `speed_range_mps`.
    Speed,
    /// Steering-wheel angle; range ± `steering_range_rad`.
    Steering,
    /// GNSS fix, height in the world frame; range ± 100 m about its origin.
    GnssZ,
    /// GNSS receiver's own estimate of its horizontal error (1σ of the distance); range 0 … 50 m.
    GnssAccuracy,
    /// Age of the newest GNSS fix; range 0 … `age_range_s`.
    GnssAge,
    /// 1 while the GNSS receiver delivers, 0 in a blackout.
    GnssValid,
    /// Age of the newest IMU sample; range 0 … `age_range_s`.
    ImuAge,
    /// 1 while the IMU delivers, 0 in a blackout.
    ImuValid,
    /// Age of the newest speed and steering sample; range 0 … `age_range_s`.
    SpeedSteeringAge,
    /// 1 while the speed and steering sensor delivers, 0 in a blackout.
    SpeedSteeringValid,
    /// Nearest object that the LIDAR sees: its nearest point, forward of the rear axle; range ± `lidar.range_m`, which stands for none.
    #[serde(rename = "object_1_x")]
    Object1X,
    /// Nearest object: its nearest point, to the left of the rear axle; range ± `lidar.range_m`.
    #[serde(rename = "object_1_y")]
    Object1Y,
    /// Second nearest object, forward.
    #[serde(rename = "object_2_x")]
    Object2X,
    /// Second nearest object, left.
    #[serde(rename = "object_2_y")]
    Object2Y,
    /// Third nearest object, forward.
    #[serde(rename = "object_3_x")]
    Object3X,
    /// Third nearest object, left.
    #[serde(rename = "object_3_y")]
    Object3Y,
    /// Fourth nearest object, forward.
    #[serde(rename = "object_4_x")]
    Object4X,
    /// Fourth nearest object, left.
    #[serde(rename = "object_4_y")]
    Object4Y,
    /// Hero: its route 5 m ahead, forward of the rear axle; range ± 5 m.
    #[serde(rename = "route_x_5")]
    RouteX5,
    /// Hero: its route 5 m ahead, to the left of the rear axle; range ± 5 m.
    #[serde(rename = "route_y_5")]
    RouteY5,
    /// Hero: its route 10 m ahead, forward of the rear axle; range ± 10 m.
    #[serde(rename = "route_x_10")]
    RouteX10,
    /// Hero: its route 10 m ahead, to the left of the rear axle; range ± 10 m.
    #[serde(rename = "route_y_10")]
    RouteY10,
    /// Hero: its route 20 m ahead, forward of the rear axle; range ± 20 m.
    #[serde(rename = "route_x_20")]
    RouteX20,
    /// Hero: its route 20 m ahead, to the left of the rear axle; range ± 20 m.
    #[serde(rename = "route_y_20")]
    RouteY20,
    /// Hero: its route 40 m ahead, forward of the rear axle; range ± 40 m.
    #[serde(rename = "route_x_40")]
    RouteX40,
    /// Hero: its route 40 m ahead, to the left of the rear axle; range ± 40 m.
    #[serde(rename = "route_y_40")]
    RouteY40,
    /// Hero: speed limit; range 0 … `speed_range_mps`.
    SpeedLimit,
    /// Hero: centre line of its route as seen from the rear axle, positive to the left; range ± 5 m.
    RouteOffset,
    /// Hero: way to the end of its route; range 0 … 1000 m.
    RouteLeft,
    /// Hero: gap to the next road user on its route; range 0 … 100 m, 100 = none.
    LeaderGap,
    /// Hero: speed of that road user along the route; range 0 … `speed_range_mps`.
    LeaderSpeed,
    /// Hero: way to the next stop line whose signal is not green; range 0 … 100 m, 100 = none.
    SignalGap,
}

/// Fields and normalisation of the observation.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Observation {
    /// Fields in order.
    pub fields: Vec<Field>,
    /// Ticks in a row: the newest and those before it, oldest first.
    pub history: u32,
    /// Scale of every field.
    pub scale: Scale,
    /// Full scale of the accelerometer, m/s².
    pub accel_range_mps2: f64,
    /// Full scale of the gyroscope, rad/s.
    pub gyro_range_radps: f64,
    /// Full scale of the speed, m/s.
    pub speed_range_mps: f64,
    /// Full scale of the steering-wheel angle, radians.
    pub steering_range_rad: f64,
    /// Full scale of the ages of samples, seconds.
    pub age_range_s: f64,
}
