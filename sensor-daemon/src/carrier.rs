//! One carrier of sensors: what a slot remembers from tick to tick.

use ipc_schema::observation::{GNSS, IMU, LIDAR, SENSORS, SPEED_STEERING};

use crate::{blackout::Phase, fields::Readings, imu, speed_steering::Scales};

/// All sensors by index, as in the ages of an observation.
pub const BITS: [u32; SENSORS] = [GNSS, IMU, SPEED_STEERING, LIDAR];

/// What the sensors of one road user remember. It begins anew with every trajectory.
#[derive(Debug, Clone)]
pub struct Carrier {
    /// Newest samples, their ages, and who delivers.
    pub readings: Readings,
    /// Correlated error of the GNSS receiver, unit variance.
    pub correlated: [f32; 3],
    /// What the biases of the IMU have walked.
    pub walk: imu::Axes,
    /// Constant factors of its speed and steering angle.
    pub scales: Scales,
    /// Factor on the errors of its GNSS receiver.
    pub gnss_factor: f64,
    /// Where each sensor is in its sequence of blackouts.
    pub phases: [Phase; SENSORS],
    /// Step of the newest sample of each sensor.
    pub sampled: [u32; SENSORS],
    /// Sensors that it has.
    pub present: u32,
    /// Sensors that a command has switched off.
    pub off: u32,
    /// Sensors that have delivered at least once.
    pub known: u32,
    /// The receiver had satellites enough when it last looked.
    pub has_fix: bool,
    /// An observation of this trajectory has been valid.
    pub is_seen: bool,
}

impl Carrier {
    /// A carrier of the sensors `present` that has sensed nothing yet.
    #[must_use]
    pub fn new(present: u32, scales: Scales, gnss_factor: f64, no_object_m: f32) -> Self {
        Self {
            readings: Readings {
                objects_m: [[no_object_m; 2]; 4],
                ..Readings::default()
            },
            correlated: [0.0; 3],
            walk: [0.0; 8],
            scales,
            gnss_factor,
            phases: [Phase::default(); SENSORS],
            sampled: [0; SENSORS],
            present,
            off: 0,
            known: 0,
            has_fix: true,
            is_seen: false,
        }
    }

    /// Sensors that are neither in a blackout nor switched off, of those that it has.
    #[must_use]
    #[inline(always)]
    pub fn awake(&self) -> u32 {
        let awake = (0..SENSORS).filter(|i| !self.phases[*i].is_dark());
        awake.fold(0, |bits, i| bits | BITS[i]) & self.present & !self.off
    }

    /// Takes note of a sample of the sensor with this index at `step`.
    #[inline(always)]
    pub fn note(&mut self, sensor: usize, step: u32) {
        self.sampled[sensor] = step;
        self.known |= BITS[sensor];
    }

    /// Sets the ages and says who delivers at `step`, with ticks of `tick_s`. Sensors that it does not have are 0 s old.
    #[inline(always)]
    pub fn age(&mut self, step: u32, tick_s: f64) {
        let fix = if self.has_fix { u32::MAX } else { !GNSS };
        self.readings.delivering = self.awake() & fix & self.known;
        for (sensor, bit) in BITS.into_iter().enumerate() {
            // Most are fresh.
            let is_old = self.present & bit != 0 && self.sampled[sensor] != step;
            self.readings.ages_s[sensor] = if is_old {
                (f64::from(step - self.sampled[sensor]) * tick_s) as f32
            } else {
                0.0
            };
        }
    }

    /// Sensors that it has and that do not deliver now.
    #[must_use]
    #[inline]
    pub fn dark(&self) -> u32 {
        self.present & !self.readings.delivering
    }
}
