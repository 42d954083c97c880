//! Figures of the `status` topic: ticks per second, road users by kind, sensors that deliver, and errors of position.

use std::time::Duration;

use ipc_schema::{
    block::view,
    header::MessageHeader,
    observation::{EMPTY_SLOT, GNSS_COLUMNS, ObservationLayout, TRUTH_COLUMNS, VALID},
    prediction::PredictionLayout,
    sensor::SensorKind,
    traffic::Kind,
    world::{VehicleState, WorldLayout},
};
use serde::{Serialize, Serializer};

/// Time over which the rate is measured.
const RATE_PERIOD: Duration = Duration::from_secs(2);

/// Measures ticks per wall second, over the last two seconds.
#[derive(Debug, Clone, Default)]
pub struct TickRate {
    /// When the current period began, and the ticks by then.
    begun: Option<(Duration, u64)>,
    per_s: f64,
}

impl TickRate {
    /// Records that `ticks` have arrived by `now`.
    pub fn update(&mut self, now: Duration, ticks: u64) {
        let (since, then) = *self.begun.get_or_insert((now, ticks));
        let elapsed = now.saturating_sub(since);
        if elapsed >= RATE_PERIOD || (self.per_s == 0.0 && elapsed >= RATE_PERIOD / 4) {
            self.per_s = ticks.saturating_sub(then) as f64 / elapsed.as_secs_f64();
            self.begun = Some((now, ticks));
        }
    }

    /// Ticks per wall second.
    #[must_use]
    pub fn per_s(&self) -> f64 {
        self.per_s
    }
}

/// Numbers of road users by kind.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize)]
pub struct RoadUserCounts {
    /// Connected vehicles.
    pub cav: u32,
    /// Vehicles without sensors.
    pub other: u32,
    /// Pedestrians.
    pub person: u32,
    /// Vehicles driven by actions.
    pub hero: u32,
}

impl RoadUserCounts {
    /// Counts the road users of a `world` message; `None` if its payload is shorter than its header promises.
    #[must_use]
    pub fn of(header: &MessageHeader, payload: &[u8]) -> Option<Self> {
        let states: &[VehicleState] = view(payload, WorldLayout::of(header).road_users()).ok()?;
        let mut count = Self::default();
        for state in states {
            match state.kind {
                kind if kind == Kind::Cav as u32 => count.cav += 1,
                kind if kind == Kind::Person as u32 => count.person += 1,
                kind if kind == Kind::Hero as u32 => count.hero += 1,
                _ => count.other += 1,
            }
        }
        Some(count)
    }
}

/// Number of vehicles on which each sensor delivers, by [`SensorKind`]; in JSON by the sensor's name.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct DeliveringSensors([u32; SensorKind::COUNT]);

impl DeliveringSensors {
    /// Counts the sensors of one vehicle, given as bits.
    fn count(mut self, sensors: u32) -> Self {
        for kind in SensorKind::ALL {
            self.0[kind.index()] += u32::from(kind.is_in(sensors));
        }
        self
    }
}

impl Serialize for DeliveringSensors {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_map(SensorKind::ALL.map(|kind| (kind.name(), self.0[kind.index()])))
    }
}

/// Mean distances from the truth over the valid rows of one tick, metres.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize)]
pub struct PositionErrors {
    /// Of the policy's predictions.
    pub policy: Option<f64>,
    /// Of the newest GNSS fixes.
    pub raw_gnss: Option<f64>,
    /// Of the extended Kalman filter's estimates.
    pub ekf: Option<f64>,
}

/// Figures of the newest set of messages that was published.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct TickFigures {
    /// Road users by kind.
    pub road_users: RoadUserCounts,
    /// Vehicles on which each sensor delivers.
    pub sensors: DeliveringSensors,
    /// Mean errors of position, metres.
    pub errors_m: PositionErrors,
}

/// The sections of an `observation` message from which figures are taken.
#[derive(Debug, Clone, Copy)]
pub struct ObservationView<'a> {
    truth: &'a [[f32; TRUTH_COLUMNS]],
    gnss_m: &'a [[f32; GNSS_COLUMNS]],
    vehicle: &'a [u32],
    flags: &'a [u32],
    sensors: &'a [u32],
}

impl<'a> ObservationView<'a> {
    /// Views a message; `None` if its payload is shorter than its header promises.
    #[must_use]
    pub fn of(header: &MessageHeader, payload: &'a [u8]) -> Option<Self> {
        let layout = ObservationLayout::of(header);
        Some(Self {
            truth: view(payload, layout.truth).ok()?,
            gnss_m: view(payload, layout.gnss_m).ok()?,
            vehicle: view(payload, layout.vehicle).ok()?,
            flags: view(payload, layout.flags).ok()?,
            sensors: view(payload, layout.sensors).ok()?,
        })
    }

    /// Number of vehicles on which each sensor delivers.
    #[must_use]
    pub fn delivering(&self) -> DeliveringSensors {
        let held = self
            .vehicle
            .iter()
            .zip(self.sensors)
            .filter(|(vehicle, _)| **vehicle != EMPTY_SLOT);
        held.fold(DeliveringSensors::default(), |count, (_, sensors)| {
            count.count(*sensors)
        })
    }

    /// Mean distances from the truth of the GNSS fixes, and of the positions of `prediction` if it holds positions.
    #[must_use]
    pub fn position_errors(&self, prediction: Option<(&MessageHeader, &[u8])>) -> PositionErrors {
        let xy = |rows: &'a [[f32; GNSS_COLUMNS]]| rows.iter().map(|[x, y, _]| [*x, *y]);
        let (policy, ekf) =
            prediction
                .filter(|(header, _)| header.shape[1] == 2)
                .map_or((None, None), |(header, payload)| {
                    let layout = PredictionLayout::of(header);
                    let rows = |section| view::<[f32; 2]>(payload, section).ok().filter(|rows| !rows.is_empty());
                    (rows(layout.prediction), rows(layout.estimate_m))
                });
        PositionErrors {
            policy: policy.and_then(|rows| self.mean_m(rows.iter().copied())),
            raw_gnss: self.mean_m(xy(self.gnss_m)),
            ekf: ekf.and_then(|rows| self.mean_m(rows.iter().copied())),
        }
    }

    /// Mean distance of `rows` from the truth, over valid rows; `None` without any.
    fn mean_m(&self, rows: impl Iterator<Item = [f32; 2]>) -> Option<f64> {
        let held = self.vehicle.iter().zip(self.flags);
        let (mut sum, mut count) = (0.0, 0_u32);
        for (([x, y], truth), (vehicle, flags)) in rows.zip(self.truth).zip(held) {
            let distance_m = f64::from(x - truth[0]).hypot(f64::from(y - truth[1]));
            if *vehicle != EMPTY_SLOT && flags & VALID != 0 && distance_m.is_finite() {
                sum += distance_m;
                count += 1;
            }
        }
        (count > 0).then(|| sum / f64::from(count))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use bytemuck::cast_slice_mut;
    use ipc_schema::block::view_mut;

    #[test]
    fn errors_are_means_over_valid_rows() {
        let header = MessageHeader {
            shape: ObservationLayout::new(3, 1, 0).shape,
            ..MessageHeader::default()
        };
        let layout = ObservationLayout::of(&header);
        let mut words = vec![0_u64; layout.len / 8];
        let bytes: &mut [u8] = cast_slice_mut(&mut words);
        view_mut::<[f32; 3]>(bytes, layout.gnss_m).unwrap().copy_from_slice(&[
            [3.0, 4.0, 9.0],
            [0.0, 1.0, 0.0],
            [99.0; 3],
        ]);
        view_mut::<u32>(bytes, layout.vehicle)
            .unwrap()
            .copy_from_slice(&[0, 1, EMPTY_SLOT]);
        view_mut::<u32>(bytes, layout.flags).unwrap().fill(VALID);
        view_mut::<u32>(bytes, layout.sensors)
            .unwrap()
            .fill(SensorKind::Gnss.bit() | SensorKind::Lidar.bit());
        let observation = ObservationView::of(&header, bytemuck::cast_slice(&words)).unwrap();
        let predicted = MessageHeader {
            shape: PredictionLayout::new(3, 2, true).shape,
            ..header
        };
        let layout = PredictionLayout::of(&predicted);
        let mut words = vec![0_u64; layout.len / 8];
        let bytes: &mut [u8] = cast_slice_mut(&mut words);
        view_mut::<[f32; 2]>(bytes, layout.prediction).unwrap().fill([2.0, 0.0]);
        view_mut::<[f32; 2]>(bytes, layout.estimate_m)
            .unwrap()
            .copy_from_slice(&[[f32::NAN; 2], [0.0, 0.5], [0.0; 2]]);
        let errors = observation.position_errors(Some((&predicted, bytemuck::cast_slice(&words))));
        assert_eq!(
            (errors.policy, errors.raw_gnss, errors.ekf),
            (Some(2.0), Some(3.0), Some(0.5))
        );
        assert_eq!(observation.position_errors(None).policy, None);
        let delivering = serde_json::to_value(observation.delivering()).unwrap();
        for kind in SensorKind::ALL {
            let is_counted = matches!(kind, SensorKind::Gnss | SensorKind::Lidar);
            assert_eq!(
                delivering[kind.name()],
                if is_counted { 2 } else { 0 },
                "{}",
                kind.name()
            );
        }
        assert!(ObservationView::of(&header, &[0; 64]).is_none());
    }

    #[test]
    fn the_rate_follows_the_ticks() {
        let mut rate = TickRate::default();
        (0..=100_u64).for_each(|i| rate.update(Duration::from_millis(100 * i), 5 * i));
        assert!((rate.per_s() - 50.0).abs() < 1e-9);
    }
}
