//! Turns sensor values into a normalised row of the observation.

use ipc_schema::{
    config::{Config, Field, Scale, ULTRASONIC_MOUNTS},
    sensor::SensorKind,
    world::HeroView,
};

use crate::{sensors::gnss::GnssFix, sensors::imu, sensors::speed_steering, sensors::ultrasonic::UltrasonicRanges};

/// The newest samples of one vehicle's sensors.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct SensorReadings {
    /// GNSS.
    pub fix: GnssFix,
    /// IMU and compass.
    pub imu: imu::ImuSample,
    /// Speed and steering.
    pub speed_steering: speed_steering::SpeedSteeringSample,
    /// Nearest points of the nearest objects that the LIDAR sees, forward and left of the rear axle, metres.
    pub objects_m: [[f32; 2]; 4],
    /// Range that each ultrasonic sensor measures, metres.
    pub ultrasonic_m: UltrasonicRanges,
    /// Ages of the newest samples by sensor, seconds.
    pub ages_s: [f32; SensorKind::COUNT],
    /// Bits of the sensors that deliver.
    pub delivering: u32,
    /// Route and traffic ahead of a hero. Only heroes have it: it is larger than everything else that a carrier keeps.
    pub route: Option<Box<HeroView>>,
}

/// What a road user without a route sees of it.
static NO_VIEW: HeroView = HeroView::NONE;

impl SensorReadings {
    /// Readings of a carrier whose sensors have not sampled yet, and of the sensors that it lacks: no object is in sight, and no echo is heard.
    #[must_use]
    pub fn unsensed(config: &Config) -> Self {
        Self {
            objects_m: [[config.lidar.range_m as f32; 2]; 4],
            ultrasonic_m: [config.ultrasonic.range_m as f32; ULTRASONIC_MOUNTS],
            ..Self::default()
        }
    }

    /// Sets route and traffic ahead.
    pub fn set_route(&mut self, view: &HeroView) {
        match &mut self.route {
            Some(route) => **route = *view,
            None => self.route = Some(Box::new(*view)),
        }
    }

    fn view(&self) -> &HeroView {
        self.route.as_deref().unwrap_or(&NO_VIEW)
    }

    #[inline(always)]
    fn value(&self, field: Field) -> f64 {
        let deliver = |bit: u32| f64::from(u8::from(self.delivering & bit != 0));
        match field {
            Field::GnssX => self.fix.x_m,
            Field::GnssY => self.fix.y_m,
            Field::GnssZ => self.fix.z_m,
            Field::GnssAccuracy => self.fix.accuracy_m,
            Field::AccelX => f64::from(self.imu[0]),
            Field::AccelY => f64::from(self.imu[1]),
            Field::AccelZ => f64::from(self.imu[2]),
            Field::GyroX => f64::from(self.imu[3]),
            Field::GyroY => f64::from(self.imu[4]),
            Field::GyroZ => f64::from(self.imu[5]),
            Field::Compass => f64::from(self.imu[6]),
            Field::Speed => self.speed_steering.speed_mps,
            Field::Steering => self.speed_steering.steering_rad,
            Field::GnssAge => f64::from(self.ages_s[SensorKind::Gnss.index()]),
            Field::ImuAge => f64::from(self.ages_s[SensorKind::Imu.index()]),
            Field::SpeedSteeringAge => f64::from(self.ages_s[SensorKind::SpeedSteering.index()]),
            Field::GnssValid => deliver(SensorKind::Gnss.bit()),
            Field::ImuValid => deliver(SensorKind::Imu.bit()),
            Field::SpeedSteeringValid => deliver(SensorKind::SpeedSteering.bit()),
            Field::Object1X => f64::from(self.objects_m[0][0]),
            Field::Object1Y => f64::from(self.objects_m[0][1]),
            Field::Object2X => f64::from(self.objects_m[1][0]),
            Field::Object2Y => f64::from(self.objects_m[1][1]),
            Field::Object3X => f64::from(self.objects_m[2][0]),
            Field::Object3Y => f64::from(self.objects_m[2][1]),
            Field::Object4X => f64::from(self.objects_m[3][0]),
            Field::Object4Y => f64::from(self.objects_m[3][1]),
            Field::RouteX5 => f64::from(self.view().route_m[0][0]),
            Field::RouteY5 => f64::from(self.view().route_m[0][1]),
            Field::RouteX10 => f64::from(self.view().route_m[1][0]),
            Field::RouteY10 => f64::from(self.view().route_m[1][1]),
            Field::RouteX20 => f64::from(self.view().route_m[2][0]),
            Field::RouteY20 => f64::from(self.view().route_m[2][1]),
            Field::RouteX40 => f64::from(self.view().route_m[3][0]),
            Field::RouteY40 => f64::from(self.view().route_m[3][1]),
            Field::SpeedLimit => f64::from(self.view().speed_limit_mps),
            Field::RouteOffset => f64::from(self.view().route_offset_m),
            Field::RouteLeft => f64::from(self.view().route_left_m),
            Field::LeaderGap => f64::from(self.view().leader_gap_m),
            Field::LeaderSpeed => f64::from(self.view().leader_speed_mps),
            Field::SignalGap => f64::from(self.view().signal_gap_m),
            Field::Ultrasonic1 => f64::from(self.ultrasonic_m[0]),
            Field::Ultrasonic2 => f64::from(self.ultrasonic_m[1]),
            Field::Ultrasonic3 => f64::from(self.ultrasonic_m[2]),
            Field::Ultrasonic4 => f64::from(self.ultrasonic_m[3]),
            Field::Ultrasonic5 => f64::from(self.ultrasonic_m[4]),
            Field::Ultrasonic6 => f64::from(self.ultrasonic_m[5]),
            Field::Ultrasonic7 => f64::from(self.ultrasonic_m[6]),
            Field::Ultrasonic8 => f64::from(self.ultrasonic_m[7]),
            Field::Ultrasonic9 => f64::from(self.ultrasonic_m[8]),
            Field::Ultrasonic10 => f64::from(self.ultrasonic_m[9]),
            Field::Ultrasonic11 => f64::from(self.ultrasonic_m[10]),
            Field::Ultrasonic12 => f64::from(self.ultrasonic_m[11]),
            Field::UltrasonicAge => f64::from(self.ages_s[SensorKind::Ultrasonic.index()]),
            Field::AdvisedAccel => f64::from(self.view().advised_accel_mps2),
            Field::UltrasonicValid => deliver(SensorKind::Ultrasonic.bit()),
            around => around
                .place_around()
                .map_or(0.0, |place| f64::from(self.view().around[place])),
        }
    }
}

/// One field with its range.
#[derive(Debug, Clone, Copy, PartialEq)]
struct Column {
    field: Field,
    low: f64,
    span: f64,
    /// Bit of its sensor.
    sensor: u32,
}

/// The configured fields with their ranges as affine maps.
#[derive(Debug, Clone, PartialEq)]
pub struct Normaliser {
    columns: Vec<Column>,
    /// Factor and offset from 0 … 1 to the configured scale.
    scale: [f64; 2],
}

impl Normaliser {
    /// Takes the ranges from the configuration and the map's bounds `[x_min, y_min, x_max, y_max]` (metres).
    #[must_use]
    pub fn new(config: &Config, bounds_m: [f64; 4]) -> Self {
        let columns = config.observation.fields.iter().map(|field| {
            let (low, high) = field.spec().range.ends(config, bounds_m);
            Column {
                field: *field,
                low,
                span: high - low,
                sensor: field.measurement_bit(),
            }
        });
        Self {
            columns: columns.collect(),
            scale: match config.observation.scale {
                Scale::ZeroToOne => [1.0, 0.0],
                Scale::MinusOneToOne => [2.0, -1.0],
            },
        }
    }

    /// Number of fields.
    #[must_use]
    pub fn width(&self) -> usize {
        self.columns.len()
    }

    /// Bits of the sensors that the fields show.
    #[must_use]
    pub fn needs(&self) -> u32 {
        self.columns.iter().fold(0, |bits, column| bits | column.sensor)
    }

    /// Fills `row` with one number for each field, and with not-a-number where the field's sensor is among the bits `blank`. Returns
    /// true if a value was outside its range and has been clipped; not-a-number is never clipped.
    #[inline(always)]
    pub fn fill(&self, readings: &SensorReadings, blank: u32, row: &mut [f32]) -> bool {
        let (mut below, mut above) = (0.0_f64, 1.0_f64);
        let [factor, shift] = self.scale;
        for (place, column) in row.iter_mut().zip(&self.columns) {
            let value = if column.sensor & blank == 0 {
                readings.value(column.field)
            } else {
                f64::NAN
            };
            let unit = (value - column.low) / column.span;
            // Every comparison is false for not-a-number, which passes through.
            below = if unit < below { unit } else { below };
            above = if unit > above { unit } else { above };
            let unit = if unit < 0.0 { 0.0 } else { unit };
            let unit = if unit > 1.0 { 1.0 } else { unit };
            *place = (factor * unit + shift) as f32;
        }
        below < 0.0 || above > 1.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::preset::town;
    use proptest::prelude::*;

    fn config(fields: Vec<Field>, scale: Scale) -> Config {
        let mut config = town();
        (config.observation.fields, config.observation.scale) = (fields, scale);
        config
    }

    const BOUNDS_M: [f64; 4] = [0.0, 100.0, 200.0, 300.0];

    #[test]
    fn a_row_holds_the_fields_in_their_order_and_range() {
        let readings = SensorReadings {
            fix: GnssFix {
                x_m: 50.0,
                y_m: 300.0,
                ..GnssFix::default()
            },
            imu: [-20.0, 0.0, 10.0, 0.0, 0.0, 0.0, std::f32::consts::PI],
            speed_steering: speed_steering::SpeedSteeringSample {
                speed_mps: 15.0,
                steering_rad: 5.0,
            },
            ..SensorReadings::default()
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
        assert!(!Normaliser::new(&config(fields.clone(), Scale::ZeroToOne), BOUNDS_M).fill(&readings, 0, &mut row));
        let near = |row: [f32; 7], expected: [f32; 7]| (0..7).all(|i| (row[i] - expected[i]).abs() < 1e-7);
        assert!(near(row, [0.5, 0.25, 1.0, 0.0, 0.75, 0.5, 0.75]), "{row:?}");
        assert!(!Normaliser::new(&config(fields, Scale::MinusOneToOne), BOUNDS_M).fill(&readings, 0, &mut row));
        assert!(near(row, [0.0, -0.5, 1.0, -1.0, 0.5, 0.0, 0.5]), "{row:?}");
    }

    #[test]
    fn a_heros_route_is_normalised_by_its_distances() {
        let readings = SensorReadings {
            route: Some(Box::new(HeroView {
                route_m: [[5.0, 0.0], [8.0, 5.0], [20.0, -20.0], [0.0, 40.0]],
                speed_limit_mps: 15.0,
                route_offset_m: -2.5,
                route_left_m: 250.0,
                leader_gap_m: 100.0,
                leader_speed_mps: 0.0,
                signal_gap_m: 25.0,
                ..HeroView::default()
            })),
            ..SensorReadings::default()
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
        assert!(!Normaliser::new(&config(fields, Scale::MinusOneToOne), BOUNDS_M).fill(&readings, 0, &mut row));
        assert_eq!(row, [1.0, 0.5, -1.0, 0.0, 0.0, -0.5, -0.5, 1.0, -1.0, -0.5]);
    }

    #[test]
    fn height_accuracy_ages_validity_and_objects_have_their_ranges() {
        let readings = SensorReadings {
            fix: GnssFix {
                z_m: 50.0,
                accuracy_m: 12.5,
                ..GnssFix::default()
            },
            ages_s: [2.5, 0.0, 10.0, 0.0, 0.0, 0.0, 0.0],
            delivering: SensorKind::Imu.bit(),
            objects_m: [[80.0, -40.0], [0.0, 0.0], [0.0, 0.0], [20.0, 80.0]],
            ..SensorReadings::default()
        };
        let fields = vec![
            Field::GnssZ,
            Field::GnssAccuracy,
            Field::GnssAge,
            Field::GnssValid,
            Field::ImuAge,
            Field::ImuValid,
            Field::SpeedSteeringAge,
            Field::SpeedSteeringValid,
            Field::Object1X,
            Field::Object1Y,
            Field::Object4X,
            Field::Object4Y,
        ];
        let mut config = config(fields, Scale::ZeroToOne);
        config.lidar.range_m = 80.0;
        let normaliser = Normaliser::new(&config, BOUNDS_M);
        assert_eq!(normaliser.needs(), SensorKind::Gnss.bit() | SensorKind::Lidar.bit());
        let mut row = [9.0; 12];
        assert!(!normaliser.fill(&readings, 0, &mut row));
        assert_eq!(row, [0.75, 0.25, 0.25, 0.0, 0.0, 1.0, 1.0, 0.0, 1.0, 0.25, 0.625, 1.0]);
    }

    #[test]
    fn a_blank_sensor_is_not_a_number_and_that_is_not_clipped() {
        let readings = SensorReadings {
            fix: GnssFix {
                x_m: -5000.0,
                ..GnssFix::default()
            },
            ..SensorReadings::default()
        };
        let fields = vec![Field::GnssX, Field::Speed, Field::GnssAge, Field::AccelX];
        let normaliser = Normaliser::new(&config(fields, Scale::ZeroToOne), BOUNDS_M);
        let mut row = [9.0; 4];
        assert!(!normaliser.fill(&readings, SensorKind::Gnss.bit() | SensorKind::Imu.bit(), &mut row));
        assert!(row[0].is_nan() && row[3].is_nan());
        assert_eq!(row[1..3], [0.0, 0.0]);
        assert!(normaliser.fill(&readings, SensorKind::Imu.bit(), &mut row));
        assert_eq!(row[0], 0.0);
    }

    proptest! {
        #[test]
        fn every_value_stays_in_its_scale_and_clipping_is_reported(x in -1e6_f64..1e6) {
            let readings = SensorReadings { fix: GnssFix { x_m: x, ..GnssFix::default() }, ..SensorReadings::default() };
            for (scale, low) in [(Scale::ZeroToOne, 0.0), (Scale::MinusOneToOne, -1.0)] {
                let mut row = [9.0];
                let clipped = Normaliser::new(&config(vec![Field::GnssX], scale), BOUNDS_M).fill(&readings, 0, &mut row);
                prop_assert!((low..=1.0).contains(&row[0]));
                prop_assert_eq!(clipped, !(0.0..=200.0).contains(&x));
            }
        }
    }
}
