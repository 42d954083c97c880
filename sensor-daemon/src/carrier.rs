//! A carrier of sensors: the state that a slot keeps from tick to tick.

use ipc_schema::sensor::SensorKind;

use crate::{
    blackout::BlackoutPhase,
    mounts::LeverArms,
    observation::fields::SensorReadings,
    sensors::{gnss::GnssState, imu::ImuAxes, speed_steering::SpeedSteeringScales},
};

/// State of one road user's sensors. Every trajectory begins with a new one.
#[derive(Debug, Clone)]
pub struct SensorCarrier {
    /// Newest samples, their ages, and the sensors that deliver.
    pub readings: SensorReadings,
    /// State of the GNSS receiver.
    pub gnss: GnssState,
    /// The IMU's own constant biases, and the random walk of the biases so far.
    pub walk: ImuAxes,
    /// Constant scale factors of its speed and steering angle.
    pub scales: SpeedSteeringScales,
    /// Position of each sensor in its sequence of blackouts; of those that have none, the start.
    pub phases: [BlackoutPhase; SensorKind::COUNT],
    /// Time at which the first of these phases ends, nanoseconds.
    pub phases_until_ns: u64,
    /// Sensors that are in a blackout, by their phases.
    pub blacked_out: u32,
    /// Step of the newest sample of each sensor.
    pub sampled: [u32; SensorKind::COUNT],
    /// Sensors that the road user has.
    pub present: u32,
    /// Those of them that a section of the configuration gives it, rather than a suite.
    pub own: u32,
    /// Place of its suite among those of the run.
    pub suite: Option<usize>,
    /// Places of its antenna and of its inertial unit; `None` if both are at the centre of the rear axle on the ground.
    pub arms: Option<Box<LeverArms>>,
    /// Sensors that a command has switched off.
    pub off: u32,
    /// Sensors that have delivered at least once.
    pub known: u32,
    /// The trajectory has had a valid observation.
    pub is_seen: bool,
}

impl SensorCarrier {
    /// A carrier with the sensors `present`, and with the readings `unsensed` until they sample.
    #[must_use]
    pub fn new(
        present: u32,
        gnss: GnssState,
        walk: ImuAxes,
        scales: SpeedSteeringScales,
        unsensed: SensorReadings,
    ) -> Self {
        Self {
            readings: unsensed,
            gnss,
            walk,
            scales,
            phases: [BlackoutPhase::default(); SensorKind::COUNT],
            phases_until_ns: u64::MAX,
            blacked_out: 0,
            sampled: [0; SensorKind::COUNT],
            present,
            own: present,
            suite: None,
            arms: None,
            off: 0,
            known: 0,
            is_seen: false,
        }
    }

    /// Sensors of the carrier that are neither in a blackout nor switched off.
    #[must_use]
    #[inline(always)]
    pub fn awake(&self) -> u32 {
        self.present & !(self.off | self.blacked_out)
    }

    /// Records a sample of `sensor` at `step`.
    #[inline(always)]
    pub fn record(&mut self, sensor: SensorKind, step: u32) {
        self.sampled[sensor.index()] = step;
        self.known |= sensor.bit();
    }

    /// Sets the ages and the delivering sensors at `step`, with ticks of `tick_s`. A sensor that the carrier lacks has age 0 s.
    #[inline(always)]
    pub fn update_ages(&mut self, step: u32, tick_s: f64) {
        let fix = if self.gnss.has_fix {
            u32::MAX
        } else {
            !SensorKind::Gnss.bit()
        };
        self.readings.delivering = self.awake() & fix & self.known;
        // The ages of the sensors that it lacks stay 0.
        let mut present = self.present;
        while present != 0 {
            let sensor = present.trailing_zeros() as usize % SensorKind::COUNT;
            present &= present - 1;
            let sampled = self.sampled[sensor];
            // Most are fresh.
            self.readings.ages_s[sensor] = match sampled == step {
                true => 0.0,
                false => (f64::from(step - sampled) * tick_s) as f32,
            };
        }
    }

    /// Sensors of the carrier that do not deliver now.
    #[must_use]
    #[inline]
    pub fn dark(&self) -> u32 {
        self.present & !self.readings.delivering
    }
}
