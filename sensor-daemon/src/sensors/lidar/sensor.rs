//! The pose of the sensor from the carrier's pose and the mounting.

use super::targets::Pose;

/// A rotation; rows are world axes, columns the turned ones.
pub(in crate::sensors) type Rotation = [[f64; 3]; 3];

/// Sensor at one time.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub(in crate::sensors) struct SensorPose {
    pub(in crate::sensors) position_m: [f64; 3],
    pub(in crate::sensors) world_from_sensor: Rotation,
}

/// Mounting of a sensor on its carrier.
#[derive(Debug, Clone, Copy)]
pub(in crate::sensors) struct SensorMount {
    position_m: [f64; 3],
    body_from_sensor: Rotation,
    pub(in crate::sensors) is_upright: bool,
}

/// `Rz(yaw) Ry(−pitch) Rx(roll)`: pitch is positive nose up, roll right side down (as in `sim_core::attitude`).
pub(in crate::sensors) fn rotation([roll, pitch, yaw]: [f64; 3]) -> Rotation {
    let ((sr, cr), (sp, cp), (sy, cy)) = (sincos(roll), sincos(pitch), libm::sincos(yaw));
    [
        [cy * cp, -sy * cr - cy * sp * sr, sy * sr - cy * sp * cr],
        [sy * cp, cy * cr - sy * sp * sr, -cy * sr - sy * sp * cr],
        [sp, cp * sr, cp * cr],
    ]
}

/// Sine and cosine; most sensors stand upright.
#[inline(always)]
fn sincos(angle: f64) -> (f64, f64) {
    if angle == 0.0 { (0.0, 1.0) } else { libm::sincos(angle) }
}

fn product(a: &Rotation, b: &Rotation) -> Rotation {
    std::array::from_fn(|row| std::array::from_fn(|column| (0..3).map(|i| a[row][i] * b[i][column]).sum()))
}

/// `rotation · vector`
pub(in crate::sensors) fn turned(rotation: &Rotation, vector: [f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| (0..3).map(|i| rotation[row][i] * vector[i]).sum())
}

impl SensorMount {
    pub(in crate::sensors) fn new([x, y, z, roll, pitch, yaw]: [f64; 6]) -> Self {
        Self {
            position_m: [x, y, z],
            body_from_sensor: rotation([roll, pitch, yaw]),
            is_upright: roll == 0.0 && pitch == 0.0,
        }
    }

    /// The sensor on a carrier in this pose.
    #[inline(always)]
    pub(in crate::sensors) fn sensor(&self, carrier: &Pose) -> SensorPose {
        let world_from_body = rotation(carrier.attitude_rad);
        let arm = turned(&world_from_body, self.position_m);
        SensorPose {
            position_m: std::array::from_fn(|axis| carrier.position_m[axis] + arm[axis]),
            world_from_sensor: product(&world_from_body, &self.body_from_sensor),
        }
    }

    /// A point of the sensor's frame in the carrier's.
    pub(in crate::sensors) fn body_from_point(&self, point: [f64; 3]) -> [f64; 3] {
        let turned = turned(&self.body_from_sensor, point);
        std::array::from_fn(|axis| self.position_m[axis] + turned[axis])
    }
}

impl SensorPose {
    /// Roll, pitch and heading.
    pub(in crate::sensors) fn attitude_rad(&self) -> [f64; 3] {
        let r = &self.world_from_sensor;
        [
            libm::atan2(r[2][1], r[2][2]),
            libm::asin(r[2][0].clamp(-1.0, 1.0)),
            libm::atan2(r[1][0], r[0][0]),
        ]
    }
}
