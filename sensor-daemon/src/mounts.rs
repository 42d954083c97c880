//! Mountings: which sensors of which suite a carrier has, when each of them samples, and where antenna and inertial unit are.

use ipc_schema::{
    config::{Config, MountedModel, OWN_SENSOR},
    sensor::SensorKind,
    world::{SUITES_SHIFT, SubStep},
};

/// Places of the antenna and of the inertial unit of a vehicle, and what the unit feels there.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct LeverArms {
    /// Antenna: x, y, z from the centre of the rear axle on the ground, metres.
    pub antenna_m: [f64; 3],
    /// Inertial unit: x, y, z from the centre of the rear axle on the ground, metres.
    pub imu_m: [f64; 3],
    /// Angular rate of the last sub-step of the tick before, rad/s; `None` at the first tick.
    rate_before_radps: Option<[f32; 3]>,
    /// The sub-steps of the tick, as the inertial unit feels them.
    felt: Vec<SubStep>,
}

impl LeverArms {
    /// Arms to these places.
    #[must_use]
    pub fn new(antenna_m: [f64; 3], imu_m: [f64; 3]) -> Self {
        Self {
            antenna_m,
            imu_m,
            ..Self::default()
        }
    }

    /// The sub-steps of a tick as a unit at `imu_m` feels them. A rigid body's points accelerate by `a + ω̇ × r + ω × (ω × r)` (H. Goldstein,
    /// *Classical Mechanics*, 3rd edition, section 4.10). `a` and `ω` are means over a sub-step of `sub_step_s`; `ω̇` is the change of
    /// `ω` since the sub-step before.
    #[inline]
    pub fn felt<'a>(&'a mut self, rows: &'a [SubStep], sub_step_s: f64) -> &'a [SubStep] {
        if self.imu_m == [0.0; 3] {
            return rows;
        }
        let arm = self.imu_m;
        self.felt.clear();
        for row in rows {
            let rate = row.angular_rate_body_radps;
            let before = self.rate_before_radps.unwrap_or(rate);
            let turn = rate.map(f64::from);
            let growth: [f64; 3] = std::array::from_fn(|axis| (turn[axis] - f64::from(before[axis])) / sub_step_s);
            let (tangential, centripetal) = (cross(growth, arm), cross(turn, cross(turn, arm)));
            self.felt.push(SubStep {
                accel_body_mps2: std::array::from_fn(|axis| {
                    (f64::from(row.accel_body_mps2[axis]) + tangential[axis] + centripetal[axis]) as f32
                }),
                ..*row
            });
            self.rate_before_radps = Some(rate);
        }
        &self.felt
    }

    /// Passes over a tick in which the inertial unit does not sample.
    #[inline]
    pub fn skip(&mut self, rows: &[SubStep]) {
        if let Some(last) = rows.last() {
            self.rate_before_radps = Some(last.angular_rate_body_radps);
        }
    }
}

fn cross([ax, ay, az]: [f64; 3], [bx, by, bz]: [f64; 3]) -> [f64; 3] {
    [ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx]
}

/// A sensor of a suite.
#[derive(Debug, Clone, Copy, PartialEq)]
struct MountedUnit {
    kind: SensorKind,
    /// Its number among those of its kind.
    sensor: u32,
    period_ticks: u32,
}

/// A suite as carriers have it.
#[derive(Debug, Clone, PartialEq)]
struct MountedSuite {
    /// Slots whose road users may carry it.
    slots: usize,
    /// Bits of the kinds of its sensors.
    kinds: u32,
    units: Vec<MountedUnit>,
    antenna_m: Option<[f64; 3]>,
    imu_m: Option<[f64; 3]>,
}

/// The suites of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct MountedSuites {
    suites: Vec<MountedSuite>,
    /// Places of the antenna and of the inertial unit of a vehicle whose suite has none.
    antenna_m: [f64; 3],
    imu_m: [f64; 3],
}

/// A sensor that samples at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DueUnit {
    /// Slot of its carrier; `None` beside the road.
    pub slot: Option<usize>,
    /// Row of its carrier: in the world, or behind it for one beside the road.
    pub row: usize,
    /// Its number among those of its kind.
    pub sensor: u32,
    /// It is the first of its kind on its carrier.
    pub is_first: bool,
}

impl MountedSuites {
    /// The suites of a configuration.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        let units: Vec<_> = config.all_sensor_units();
        let suites = config.suites.iter().enumerate().map(|(index, suite)| {
            let of_suite = units.iter().filter(|unit| unit.suite_index == Some(index));
            let units: Vec<MountedUnit> = of_suite
                .map(|unit| MountedUnit {
                    kind: unit.kind,
                    sensor: unit.sensor,
                    period_ticks: unit.period_ticks.max(1),
                })
                .collect();
            let models = || suite.sensors.iter().map(|sensor| &sensor.model);
            MountedSuite {
                slots: suite.first.map_or(usize::MAX, |first| first as usize),
                kinds: units.iter().fold(0, |bits, unit| bits | unit.kind.bit()),
                units,
                antenna_m: models().find_map(|model| match model {
                    MountedModel::Gnss(arm) => Some(arm.mount),
                    _ => None,
                }),
                imu_m: models().find_map(|model| match model {
                    MountedModel::Imu(arm) => Some(arm.mount),
                    _ => None,
                }),
            }
        });
        Self {
            suites: suites.collect(),
            antenna_m: config.gnss.mount,
            imu_m: config.imu.mount,
        }
    }

    /// The suite of a vehicle with these flags in this slot: the first whose rule it satisfies.
    #[must_use]
    pub fn suite_of(&self, flags: u32, slot: usize) -> Option<usize> {
        let mut suites = self.suites.iter().enumerate();
        suites
            .find(|(index, suite)| flags >> SUITES_SHIFT >> index & 1 != 0 && slot < suite.slots)
            .map(|(index, _)| index)
    }

    /// Bits of the kinds of a suite's sensors that look at their surroundings.
    #[must_use]
    pub fn kinds(&self, suite: Option<usize>) -> u32 {
        self.at(suite).map_or(0, |suite| suite.kinds)
    }

    /// Antenna and inertial unit of a vehicle with this suite; `None` if both are at the centre of the rear axle on the ground.
    #[must_use]
    pub fn arms(&self, suite: Option<usize>) -> Option<Box<LeverArms>> {
        let suite = self.at(suite);
        let antenna_m = suite.and_then(|suite| suite.antenna_m).unwrap_or(self.antenna_m);
        let imu_m = suite.and_then(|suite| suite.imu_m).unwrap_or(self.imu_m);
        let is_central = [antenna_m, imu_m] == [[0.0; 3]; 2];
        (!is_central).then(|| Box::new(LeverArms::new(antenna_m, imu_m)))
    }

    /// Numbers of a suite's sensors of this kind that sample at this step of their carrier, each with whether it is the suite's first.
    pub fn due(&self, suite: Option<usize>, kind: SensorKind, step: u32) -> impl Iterator<Item = (u32, bool)> {
        let units = self.at(suite).map_or(&[][..], |suite| &suite.units);
        let of_kind = units.iter().filter(move |unit| unit.kind == kind).enumerate();
        of_kind
            .filter(move |(_, unit)| step.is_multiple_of(unit.period_ticks))
            .map(|(place, unit)| (unit.sensor, place == 0))
    }

    /// [`OWN_SENSOR`] is not a sensor of a suite.
    fn at(&self, suite: Option<usize>) -> Option<&MountedSuite> {
        suite.and_then(|index| self.suites.get(index))
    }
}

impl DueUnit {
    /// The sensor that a section of the configuration describes, on the road user in this slot and row.
    #[must_use]
    pub fn own(slot: usize, row: usize) -> Self {
        Self {
            slot: Some(slot),
            row,
            sensor: OWN_SENSOR,
            is_first: true,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Angular rates by sub-step, and what a unit at `arm` feels beside the vehicle's own acceleration.
    fn felt(arm: [f64; 3], rates: &[[f32; 3]], sub_step_s: f64) -> Vec<[f32; 3]> {
        let mut arms = LeverArms::new([0.0; 3], arm);
        let rows: Vec<SubStep> = rates
            .iter()
            .map(|rate| SubStep {
                accel_body_mps2: [1.0, 2.0, 3.0],
                angular_rate_body_radps: *rate,
                ..SubStep::default()
            })
            .collect();
        let felt = arms.felt(&rows, sub_step_s).iter().map(|row| row.accel_body_mps2);
        felt.collect()
    }

    #[test]
    fn at_the_origin_the_motion_is_left_alone() {
        assert_eq!(
            felt([0.0; 3], &[[0.1, 0.2, 0.3], [1.0, 2.0, 3.0]], 0.01),
            [[1.0, 2.0, 3.0]; 2]
        );
    }

    /// On a circle the unit feels `−ω² r` towards the axis.
    #[test]
    fn a_steady_turn_pulls_towards_the_axis() {
        let [x, y] = [1.5, -0.4];
        let rate = 0.5_f32;
        for accel in felt([x, y, 0.7], &[[0.0, 0.0, rate]; 4], 0.01) {
            let square = f64::from(rate * rate);
            let expected = [1.0 - square * x, 2.0 - square * y, 3.0];
            assert!(
                accel
                    .iter()
                    .zip(expected)
                    .all(|(a, b)| (f64::from(*a) - b).abs() < 1e-6),
                "{accel:?}"
            );
        }
    }

    /// A turn that grows by `α` each second adds `α × r`: with α about z, −α y ahead and α x to the left.
    #[test]
    fn a_growing_turn_pushes_across_the_arm() {
        let (growth, sub_step_s, [x, y]) = (2.0, 0.01, [1.5, -0.4]);
        let rates: Vec<[f32; 3]> = (0..50_u8)
            .map(|step| [0.0, 0.0, (growth * sub_step_s * f64::from(step)) as f32])
            .collect();
        for (accel, rate) in felt([x, y, 0.0], &rates, sub_step_s).iter().zip(&rates).skip(1) {
            let square = f64::from(rate[2]).powi(2);
            let expected = [1.0 - growth * y - square * x, 2.0 + growth * x - square * y, 3.0];
            assert!(
                accel
                    .iter()
                    .zip(expected)
                    .all(|(a, b)| (f64::from(*a) - b).abs() < 1e-4),
                "{accel:?} {expected:?}"
            );
        }
    }

    /// The second derivative of a rotating point, by differences of its path, is what the unit feels in the body's axes.
    #[test]
    fn the_path_of_the_unit_has_the_acceleration_that_it_feels() {
        let (step_s, arm, rate) = (1e-3_f64, [0.9, 0.5, 0.0], 1.2_f64);
        let place = |time_s: f64| {
            let (sin, cos) = (rate * time_s).sin_cos();
            [cos * arm[0] - sin * arm[1], sin * arm[0] + cos * arm[1]]
        };
        let (before, at, after) = (place(-step_s), place(0.0), place(step_s));
        let accel: [f64; 2] =
            std::array::from_fn(|axis| (before[axis] - 2.0 * at[axis] + after[axis]) / (step_s * step_s));
        let felt = felt(arm, &[[0.0, 0.0, rate as f32]; 2], 0.01)[1];
        assert!(
            (f64::from(felt[0]) - 1.0 - accel[0]).abs() < 1e-5 && (f64::from(felt[1]) - 2.0 - accel[1]).abs() < 1e-5
        );
    }
}
