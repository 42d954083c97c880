//! From sensor values to a normalised row.

use ipc_schema::{
    config::{Field, Observation as Params, Scale},
    world::{HeroView, ROUTE_AHEAD_M, SIGHT_M},
};

use crate::{gnss::Fix, imu, speed_steering};

/// The newest samples of one vehicle's sensors.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Readings {
    /// GNSS.
    pub fix: Fix,
    /// IMU and compass.
    pub imu: imu::Sample,
    /// Speed and steering.
    pub speed_steering: speed_steering::Sample,
    /// What a hero sees of its route.
    pub route: HeroView,
}

/// Range of the distance to the route, metres.
const ROUTE_OFFSET_M: f64 = 5.0;
/// Range of the way left, metres.
const ROUTE_LEFT_M: f64 = 1000.0;

impl Readings {
    fn value(&self, field: Field) -> f64 {
        match field {
            Field::GnssX => self.fix.x_m,
            Field::GnssY => self.fix.y_m,
            Field::AccelX => self.imu.accel_mps2[0],
            Field::AccelY => self.imu.accel_mps2[1],
            Field::AccelZ => self.imu.accel_mps2[2],
            Field::GyroX => self.imu.gyro_radps[0],
            Field::GyroY => self.imu.gyro_radps[1],
            Field::GyroZ => self.imu.gyro_radps[2],
            Field::Compass => self.imu.compass_rad,
            Field::Speed => self.speed_steering.speed_mps,
            Field::Steering => self.speed_steering.steering_rad,
            Field::RouteX5 => f64::from(self.route.route_m[0][0]),
            Field::RouteY5 => f64::from(self.route.route_m[0][1]),
            Field::RouteX10 => f64::from(self.route.route_m[1][0]),
            Field::RouteY10 => f64::from(self.route.route_m[1][1]),
            Field::RouteX20 => f64::from(self.route.route_m[2][0]),
            Field::RouteY20 => f64::from(self.route.route_m[2][1]),
            Field::RouteX40 => f64::from(self.route.route_m[3][0]),
            Field::RouteY40 => f64::from(self.route.route_m[3][1]),
            Field::SpeedLimit => f64::from(self.route.speed_limit_mps),
            Field::RouteOffset => f64::from(self.route.route_offset_m),
            Field::RouteLeft => f64::from(self.route.route_left_m),
            Field::LeaderGap => f64::from(self.route.leader_gap_m),
            Field::LeaderSpeed => f64::from(self.route.leader_speed_mps),
            Field::SignalGap => f64::from(self.route.signal_gap_m),
            _ => 0.0,
        }
    }
}

/// The configured fields with their ranges as affine maps.
#[derive(Debug, Clone, PartialEq)]
pub struct Normaliser {
    /// Field, lower end, upper end.
    fields: Vec<(Field, f64, f64)>,
    scale: Scale,
}

impl Normaliser {
    /// Ranges from the map's bounds `[x_min, y_min, x_max, y_max]` (metres) and the configuration.
    #[must_use]
    pub fn new(params: &Params, bounds_m: [f64; 4]) -> Self {
        let range = |field: &Field| match field {
            Field::GnssX => (bounds_m[0], bounds_m[2]),
            Field::GnssY => (bounds_m[1], bounds_m[3]),
            Field::AccelX | Field::AccelY | Field::AccelZ => (-params.accel_range_mps2, params.accel_range_mps2),
            Field::GyroX | Field::GyroY | Field::GyroZ => (-params.gyro_range_radps, params.gyro_range_radps),
            Field::Compass => (0.0, std::f64::consts::TAU),
            Field::RouteX5 | Field::RouteY5 => (-ROUTE_AHEAD_M[0], ROUTE_AHEAD_M[0]),
            Field::RouteX10 | Field::RouteY10 => (-ROUTE_AHEAD_M[1], ROUTE_AHEAD_M[1]),
            Field::RouteX20 | Field::RouteY20 => (-ROUTE_AHEAD_M[2], ROUTE_AHEAD_M[2]),
            Field::RouteX40 | Field::RouteY40 => (-ROUTE_AHEAD_M[3], ROUTE_AHEAD_M[3]),
            Field::RouteOffset => (-ROUTE_OFFSET_M, ROUTE_OFFSET_M),
            Field::RouteLeft => (0.0, ROUTE_LEFT_M),
            Field::LeaderGap | Field::SignalGap => (0.0, SIGHT_M),
            Field::Speed | Field::SpeedLimit | Field::LeaderSpeed => (0.0, params.speed_range_mps),
            Field::Steering => (-params.steering_range_rad, params.steering_range_rad),
            _ => (0.0, 1.0),
        };
        let fields = params
            .fields
            .iter()
            .map(|field| (*field, range(field).0, range(field).1))
            .collect();
        Self {
            fields,
            scale: params.scale,
        }
    }

    /// Number of fields.
    #[must_use]
    pub fn width(&self) -> usize {
        self.fields.len()
    }

    /// Fills `row` (one number for each field); true if a value was outside its range and has been clipped.
    pub fn fill(&self, readings: &Readings, row: &mut [f32]) -> bool {
        let mut clipped = false;
        for (place, (field, low, high)) in row.iter_mut().zip(&self.fields) {
            let unit = (readings.value(*field) - low) / (high - low);
            clipped |= !(0.0..=1.0).contains(&unit);
            let unit = unit.clamp(0.0, 1.0);
            *place = match self.scale {
                Scale::ZeroToOne => unit,
                Scale::MinusOneToOne => 2.0 * unit - 1.0,
            } as f32;
        }
        clipped
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;
    use proptest::prelude::*;

    fn params(fields: Vec<Field>, scale: Scale) -> Params {
        Params {
            fields,
            scale,
            ..town().observation
        }
    }

    const BOUNDS_M: [f64; 4] = [0.0, 100.0, 200.0, 300.0];

    #[test]
    fn a_row_holds_the_fields_in_their_order_and_range() {
        let readings = Readings {
            fix: Fix {
                x_m: 50.0,
                y_m: 300.0,
                ..Fix::default()
            },
            imu: imu::Sample {
                accel_mps2: [-20.0, 0.0, 10.0],
                gyro_radps: [0.0; 3],
                compass_rad: std::f64::consts::PI,
            },
            speed_steering: speed_steering::Sample {
                speed_mps: 15.0,
                steering_rad: 5.0,
            },
            route: HeroView::default(),
        };
        let fields = vec![
            Field::Speed,
            Field::GnssX,
            Field::GnssY,
            Field::AccelX,
            Field::AccelZ,
            Field::Compass,
            Field::Steering,
        ];
        let mut row = [9.0; 7];
        assert!(!Normaliser::new(&params(fields.clone(), Scale::ZeroToOne), BOUNDS_M).fill(&readings, &mut row));
        assert_eq!(row, [0.5, 0.25, 1.0, 0.0, 0.75, 0.5, 0.75]);
        assert!(!Normaliser::new(&params(fields, Scale::MinusOneToOne), BOUNDS_M).fill(&readings, &mut row));
        assert_eq!(row, [0.0, -0.5, 1.0, -1.0, 0.5, 0.0, 0.5]);
    }

    #[test]
    fn a_heros_route_is_normalised_by_its_distances() {
        let readings = Readings {
            route: HeroView {
                route_m: [[5.0, 0.0], [8.0, 5.0], [20.0, -20.0], [0.0, 40.0]],
                speed_limit_mps: 15.0,
                route_offset_m: -2.5,
                route_left_m: 250.0,
                leader_gap_m: 100.0,
                leader_speed_mps: 0.0,
                signal_gap_m: 25.0,
                ..HeroView::default()
            },
            ..Readings::default()
        };
        let fields = vec![
            Field::RouteX5,
            Field::RouteY10,
            Field::RouteY20,
            Field::RouteX40,
            Field::SpeedLimit,
            Field::RouteOffset,
            Field::RouteLeft,
            Field::LeaderGap,
            Field::LeaderSpeed,
            Field::SignalGap,
        ];
        let mut row = [9.0; 10];
        assert!(!Normaliser::new(&params(fields, Scale::MinusOneToOne), BOUNDS_M).fill(&readings, &mut row));
        assert_eq!(row, [1.0, 0.5, -1.0, 0.0, 0.0, -0.5, -0.5, 1.0, -1.0, -0.5]);
    }

    proptest! {
        #[test]
        fn every_value_stays_in_its_scale_and_clipping_is_told(x in -1e6_f64..1e6) {
            let readings = Readings { fix: Fix { x_m: x, ..Fix::default() }, ..Readings::default() };
            for (scale, low) in [(Scale::ZeroToOne, 0.0), (Scale::MinusOneToOne, -1.0)] {
                let mut row = [9.0];
                let clipped = Normaliser::new(&params(vec![Field::GnssX], scale), BOUNDS_M).fill(&readings, &mut row);
                prop_assert!((low..=1.0).contains(&row[0]));
                prop_assert_eq!(clipped, !(0.0..=200.0).contains(&x));
            }
        }
    }
}
