//! One carrier of sensors: what a slot remembers from tick to tick.

use ipc_schema::sensor::SensorKind;

use crate::{blackout::Phase, fields::Readings, imu, speed_steering::Scales};

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
    pub phases: [Phase; SensorKind::COUNT],
    /// Step of the newest sample of each sensor.
    pub sampled: [u32; SensorKind::COUNT],
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
            phases: [Phase::default(); SensorKind::COUNT],
            sampled: [0; SensorKind::COUNT],
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
        let awake = SensorKind::ALL
            .into_iter()
            .filter(|kind| !self.phases[kind.index()].is_dark());
        awake.fold(0, |bits, kind| bits | kind.bit()) & self.present & !self.off
    }

    /// Takes note of a sample of `sensor` at `step`.
    #[inline(always)]
    pub fn note(&mut self, sensor: SensorKind, step: u32) {
        self.sampled[sensor.index()] = step;
        self.known |= sensor.bit();
    }

    /// Sets the ages and says who delivers at `step`, with ticks of `tick_s`. Sensors that it does not have are 0 s old.
    #[inline(always)]
    pub fn age(&mut self, step: u32, tick_s: f64) {
        let fix = if self.has_fix {
            u32::MAX
        } else {
            !SensorKind::Gnss.bit()
        };
        self.readings.delivering = self.awake() & fix & self.known;
        for sensor in SensorKind::ALL {
            let sampled = self.sampled[sensor.index()];
            // Most are fresh.
            let is_old = sensor.is_in(self.present) && sampled != step;
            self.readings.ages_s[sensor.index()] = if is_old {
                (f64::from(step - sampled) * tick_s) as f32
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
