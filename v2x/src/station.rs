//! A station: what it measures of itself, its services, its map, and how its motion becomes a message and back.

use ipc_schema::{
    config::{Config, ImuConvention, V2xListing},
    neighbours::NeighbourSource,
};
use sim_core::geodesy::{Geodetic, NetPosition, Projection};

use crate::{
    local_map::{KnownObject, LocalMap},
    message::{
        GeodeticPoint, StationKind,
        bsm::BsmCore,
        cam::Cam,
        cpm::{Cpm, CpmOrigin, PerceivedObject, SensorRegion},
        denm::{DANGEROUS_SITUATION, Denm, DenmEvent, DenmTermination, EMERGENCY_BRAKE_ENGAGED},
        generation_delta_ms, heading_from_yaw, its_time_ms,
        roadside_cam::RoadsideCam,
        vam::{Vam, VamProfile},
        yaw_from_heading,
    },
    services::{
        MS, MeasuredMotion,
        bsm::BsmService,
        cam::CamService,
        congestion::CongestionControl,
        cpm::{CpmService, ObjectKind, PerceivedMotion},
        denm::{DenmContent, DenmKind, DenmService, REPETITION_NS, VALIDITY_NS},
        edge::{FusedMap, FusedObject},
        relay::WarningRelay,
        turn,
        vam::VamService,
    },
};

/// Half axis of the ellipse that has a normal position with 95 %, in standard deviations of an axis: √(−2 ln 0.05).
const ELLIPSE_95: f64 = 2.447_746_830_680_816;
/// Half of the interval that has a normal number with 95 %, in standard deviations.
const INTERVAL_95: f64 = 1.959_963_984_540_054;
/// Deviation of a position of unknown accuracy, metres: the largest that a message can state.
const UNKNOWN_POSITION_M: f32 = 40.94;
/// Deviation of a speed of unknown accuracy, m/s, and of a heading, radians: the largest that a message can state.
const UNKNOWN_SPEED_MPS: f32 = 1.25;
const UNKNOWN_HEADING_RAD: f32 = 0.22;

/// Size of a person on foot in a map: messages of people do not state one, metres.
const PERSON_M: [f32; 2] = [0.5, 0.5];
/// Deviation of the velocity of a person whose message states none, on each axis, m/s.
const WALKING_MPS: f32 = 1.5;

/// What a station measures of itself at a tick.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct OwnMeasurement {
    /// Newest fix of the rear axle: x and y, world, metres.
    pub fix_m: [f64; 2],
    /// Altitude of the fix, metres.
    pub altitude_m: f64,
    /// Age of the fix, seconds.
    pub fix_age_s: f64,
    /// Standard deviation of the fix as a distance, as the receiver reports it, metres; `None` while it does not deliver.
    pub accuracy_m: Option<f64>,
    /// Wheel speed, m/s.
    pub speed_mps: f64,
    /// Compass, radians counter-clockwise from east.
    pub heading_rad: f64,
    /// Longitudinal acceleration, m/s².
    pub accel_mps2: f64,
    /// Yaw rate, positive to the left, rad/s.
    pub yaw_rate_radps: f64,
}

/// Size of a vehicle, as its station knows it.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct VehicleSize {
    /// Front to rear, trailing bodies in a straight line included, metres.
    pub length_m: f64,
    /// Metres.
    pub width_m: f64,
    /// Rear axle of the leading body to the rear, metres.
    pub rear_overhang_m: f64,
    /// It has trailing bodies.
    pub has_trailer: bool,
}

impl OwnMeasurement {
    /// The point `ahead_m` before the rear axle by fix and compass, metres.
    #[must_use]
    pub fn ahead_m(&self, ahead_m: f64) -> [f64; 2] {
        let (sin, cos) = libm::sincos(self.heading_rad);
        [self.fix_m[0] + ahead_m * cos, self.fix_m[1] + ahead_m * sin]
    }

    /// The middle of the front, which messages name, metres.
    #[must_use]
    pub fn front_m(&self, size: &VehicleSize) -> [f64; 2] {
        self.ahead_m(size.length_m - size.rear_overhang_m)
    }

    /// The centre, metres.
    #[must_use]
    pub fn centre_m(&self, size: &VehicleSize) -> [f64; 2] {
        self.ahead_m(0.5 * size.length_m - size.rear_overhang_m)
    }

    /// The motion that generation rules watch.
    #[must_use]
    pub fn motion(&self, size: &VehicleSize) -> MeasuredMotion {
        MeasuredMotion {
            position_m: self.front_m(size),
            speed_mps: self.speed_mps,
            heading_rad: self.heading_rad,
        }
    }
}

/// What a run's sensors are known to deviate by.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorDeviations {
    /// Wheel speed, m/s.
    pub speed_mps: f64,
    /// Compass, radians.
    pub heading_rad: f64,
    /// The IMU's y and z axes point the other way.
    pub is_left_handed: bool,
}

impl SensorDeviations {
    /// Those of a configuration.
    #[must_use]
    pub fn new(config: &Config) -> Self {
        Self {
            speed_mps: config.speed_steering.speed_noise_std_mps,
            heading_rad: config.imu.compass_noise_std_rad,
            is_left_handed: config.imu.convention == ImuConvention::Carla,
        }
    }
}

/// A station, as long as its vehicle has its slot.
#[derive(Debug, Clone)]
pub struct Station {
    /// Hash of the vehicle's SUMO id.
    pub id_hash: u64,
    /// Station id: the low half of the hash, and never 0.
    pub station: u32,
    /// It is a person's.
    pub is_person: bool,
    /// It has a radio.
    pub is_equipped: bool,
    /// Time within a tick at which its messages are handed to the radio, nanoseconds.
    pub phase_ns: u64,
    /// Cooperative awareness.
    pub cam: CamService,
    /// Collective perception.
    pub cpm: CpmService,
    /// Basic safety.
    pub bsm: BsmService,
    /// Awareness of a person.
    pub vam: VamService,
    /// Warnings.
    pub denm: DenmService,
    /// The warning that is repeated.
    pub warning: Option<Denm>,
    /// What its own sensors perceived at the last tick, as others would know it.
    pub perceived: Vec<KnownObject>,
    /// Messages task: what its own sensors perceive at this tick, the nearest first; `None` if it cannot tell of it.
    pub sighted: Option<Vec<Perception>>,
    /// Places of the objects among those that its next message lists, ascending, where they are chosen.
    pub chosen: Vec<usize>,
    /// The map of an edge service.
    pub edge: FusedMap,
    /// Warnings of others that a roadside unit has yet to send once more.
    pub relay: WarningRelay,
    /// Congestion control.
    pub congestion: CongestionControl,
    /// What it knows.
    pub map: LocalMap,
}

/// The station id of a vehicle.
#[must_use]
pub fn station_id(id_hash: u64) -> u32 {
    (id_hash as u32).max(1)
}

fn tenths(value_m: f64) -> f64 {
    (value_m * 10.0).round()
}

/// A confidence in the unit of a message: 1 … 125, 126 = more.
fn confidence(deviation: f64, unit: f64) -> u8 {
    (INTERVAL_95 * deviation / unit).ceil().clamp(1.0, 126.0) as u8
}

/// The reference position of a message.
///
/// `None` where the map's projection does not reach.
fn reference(projection: &Projection, own: &OwnMeasurement, [x_m, y_m]: [f64; 2]) -> Option<GeodeticPoint> {
    let place = projection.geodetic_from_net(NetPosition { x_m, y_m }).ok()?;
    let axis_cm = own
        .accuracy_m
        .map(|accuracy| (ELLIPSE_95 * accuracy / std::f64::consts::SQRT_2 * 100.0).round());
    Some(GeodeticPoint {
        latitude: (place.latitude_deg * 1e7).round() as i32,
        longitude: (place.longitude_deg * 1e7).round() as i32,
        accuracy_cm: axis_cm.map(|axis| axis.clamp(1.0, 4094.0) as u16),
        altitude_cm: Some((own.altitude_m * 100.0).round().clamp(-100_000.0, 800_000.0) as i32),
    })
}

/// Simulated time of the newest fix, ms.
fn fix_time_ns(now_ns: u64, own: &OwnMeasurement) -> u64 {
    now_ns.saturating_sub((own.fix_age_s * 1e9) as u64)
}

/// What a station may be said to perceive: the object in the frame of its own vehicle, with errors.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Perception {
    /// Row of the road user in the world: no station knows it.
    pub row: u32,
    /// Number of the object at the station.
    pub object: u16,
    /// Its centre before and to the left of the middle of the vehicle's front, metres.
    pub position_body_m: [f64; 2],
    /// Velocity along the vehicle and to its left, m/s.
    pub velocity_body_mps: [f64; 2],
    /// Heading relative to the vehicle's, radians.
    pub turn_rad: f64,
    /// Length and width, metres.
    pub size_m: [f64; 2],
    /// It is a person.
    pub is_person: bool,
    /// Standard deviation of the place on each axis, metres.
    pub position_std_m: f64,
    /// Standard deviation of the velocity on each axis, m/s.
    pub speed_std_mps: f64,
}

impl Perception {
    /// Distance from the middle of the vehicle's front, metres.
    #[must_use]
    pub fn distance_m(&self) -> f64 {
        libm::hypot(self.position_body_m[0], self.position_body_m[1])
    }

    /// The object in the world, by the station's own fix and compass.
    #[must_use]
    pub fn motion(&self, own: &OwnMeasurement, size: &VehicleSize) -> MeasuredMotion {
        let front_m = own.front_m(size);
        let offset_m = rotate(self.position_body_m, own.heading_rad);
        let [vx, vy] = rotate(self.velocity_body_mps, own.heading_rad);
        MeasuredMotion {
            position_m: [front_m[0] + offset_m[0], front_m[1] + offset_m[1]],
            speed_mps: libm::hypot(vx, vy),
            heading_rad: own.heading_rad + self.turn_rad,
        }
    }
}

/// A vector turned by an angle.
#[must_use]
pub fn rotate([x, y]: [f64; 2], angle_rad: f64) -> [f64; 2] {
    let (sin, cos) = libm::sincos(angle_rad);
    [x * cos - y * sin, x * sin + y * cos]
}

/// Standard deviations of perceived objects, and the range in which a station perceives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PerceptionSpec {
    /// Metres.
    pub range_m: f64,
    /// On each axis, metres.
    pub position_std_m: f64,
    /// On each axis, m/s.
    pub speed_std_mps: f64,
    /// Angle of the field of view, radians, its middle straight ahead; none = all around.
    pub opening_rad: Option<f64>,
}

impl PerceptionSpec {
    /// The region for a sensor information container.
    fn region(&self, heading_rad: f64) -> SensorRegion {
        let angle = |half: f64, opening_rad: f64| {
            let angle = (heading_rad + half * opening_rad).to_degrees() * 10.0;
            angle.round().rem_euclid(3600.0) as u16
        };
        SensorRegion {
            range_10cm: tenths(self.range_m).min(4095.0) as u16,
            opening: self
                .opening_rad
                .map(|opening| [angle(-0.5, opening), angle(0.5, opening)]),
        }
    }
}

/// Composes the messages of one station at one tick.
#[derive(Debug, Clone, Copy)]
pub struct MessageComposer<'a> {
    /// Station id.
    pub station: u32,
    /// Type of the station.
    pub kind: StationKind,
    /// Simulated time, nanoseconds.
    pub now_ns: u64,
    /// What the station measures of itself.
    pub own: &'a OwnMeasurement,
    /// Size of its vehicle.
    pub size: &'a VehicleSize,
    /// What its sensors deviate by.
    pub deviations: &'a SensorDeviations,
    /// Projection of the map.
    pub projection: &'a Projection,
}

impl MessageComposer<'_> {
    /// The middle of the front of the vehicle, which messages name.
    fn front(&self) -> Option<GeodeticPoint> {
        reference(self.projection, self.own, self.own.front_m(self.size))
    }

    /// The middle of the road user.
    fn centre(&self) -> Option<GeodeticPoint> {
        reference(self.projection, self.own, self.own.centre_m(self.size))
    }

    /// A warning of the own emergency braking, and the place that its packet names: as the last one, `before`, where that is repeated.
    /// `None` where the projection does not reach.
    #[must_use]
    pub fn denm(&self, content: &DenmContent, before: Option<Denm>) -> Option<Denm> {
        let is_news = matches!(content.kind, DenmKind::New | DenmKind::Update);
        if let Some(before) = before.filter(|before| !is_news && before.sequence == content.sequence) {
            return Some(match content.kind {
                DenmKind::Cancellation => Denm {
                    reference_ms: its_time_ms(self.now_ns),
                    termination: Some(DenmTermination::Cancellation),
                    event: None,
                    ..before
                },
                _ => before,
            });
        }
        Some(Denm {
            station: self.station,
            kind: self.kind,
            originator: self.station,
            sequence: content.sequence,
            detected_ms: its_time_ms(content.detected_ns),
            reference_ms: its_time_ms(self.now_ns),
            termination: None,
            position: self.front()?,
            // Below 500 m, traffic that comes from behind.
            relevance: Some(3),
            traffic: Some(1),
            validity_s: (VALIDITY_NS / (1000 * MS)) as u32,
            interval_ms: Some((REPETITION_NS / MS) as u16),
            event: Some(DenmEvent {
                quality: 0,
                cause: [DANGEROUS_SITUATION, EMERGENCY_BRAKE_ENGAGED],
                speed_cmps: Some(self.speed_cmps()),
                heading: Some(heading_from_yaw(self.own.heading_rad)),
            }),
        })
    }

    /// A person's awareness message; `None` where the projection does not reach. A phone measures no speed.
    #[must_use]
    pub fn vam(&self, has_low_frequency: bool) -> Option<Vam> {
        Some(Vam {
            station: self.station,
            kind: StationKind::PEDESTRIAN,
            generation_delta_ms: generation_delta_ms(its_time_ms(fix_time_ns(self.now_ns, self.own))),
            position: self.centre()?,
            heading: Some(heading_from_yaw(self.own.heading_rad)),
            heading_confidence: Some(confidence(self.deviations.heading_rad.to_degrees(), 0.1)),
            speed_cmps: None,
            speed_confidence: None,
            acceleration: None,
            profile: has_low_frequency.then_some(VamProfile {
                subprofile: 1,
                size_class: 0,
            }),
        })
    }

    /// The core of a basic safety message; `None` where the projection does not reach.
    #[must_use]
    pub fn bsm(&self, count: u8) -> Option<BsmCore> {
        let Self { own, size, .. } = self;
        let place = self.centre()?;
        let units = |value: f64, unit: f64, range: [f64; 2]| (value / unit).round().clamp(range[0], range[1]);
        // Half axes at one standard deviation, of which the fix has one on both axes.
        let axis = own
            .accuracy_m
            .map(|accuracy| units(accuracy / std::f64::consts::SQRT_2, 0.05, [0.0, 254.0]) as u8);
        let measured_ms = its_time_ms(fix_time_ns(self.now_ns, own));
        Some(BsmCore {
            count,
            id: self.station,
            second_mark_ms: Some((measured_ms % 60_000) as u16),
            latitude: Some(place.latitude),
            longitude: Some(place.longitude),
            elevation_10cm: Some(units(own.altitude_m, 0.1, [-4095.0, 61_439.0]) as i32),
            accuracy_5cm: axis.map(|axis| [axis; 2]),
            transmission: 7,
            speed: Some(units(own.speed_mps.max(0.0), 0.02, [0.0, 8190.0]) as u16),
            heading: Some(units(90.0 - own.heading_rad.to_degrees(), 0.0125, [-1e9, 1e9]).rem_euclid(28_800.0) as u16),
            steering_wheel: None,
            acceleration: [Some(units(own.accel_mps2, 0.01, [-2000.0, 2000.0]) as i16), None],
            // Positive to the right.
            yaw_rate: units(-own.yaw_rate_radps.to_degrees(), 0.01, [-32_767.0, 32_767.0]) as i16,
            wheel_brakes: None,
            width_cm: units(size.width_m, 0.01, [1.0, 1023.0]) as u16,
            length_cm: units(size.length_m, 0.01, [1.0, 4095.0]) as u16,
        })
    }

    fn speed_cmps(&self) -> u16 {
        (self.own.speed_mps.max(0.0) * 100.0).round().min(16_382.0) as u16
    }

    /// A cooperative awareness message; `None` where the projection does not reach.
    #[must_use]
    pub fn cam(&self, has_low_frequency: bool) -> Option<Cam> {
        let Self { own, size, .. } = self;
        Some(Cam {
            station: self.station,
            kind: self.kind,
            generation_delta_ms: generation_delta_ms(its_time_ms(fix_time_ns(self.now_ns, own))),
            position: self.front()?,
            heading: Some(heading_from_yaw(own.heading_rad)),
            heading_confidence: Some(confidence(self.deviations.heading_rad.to_degrees(), 0.1)),
            speed_cmps: Some(self.speed_cmps()),
            speed_confidence: Some(confidence(self.deviations.speed_mps, 0.01)),
            length_10cm: tenths(size.length_m).clamp(1.0, 1022.0) as u16,
            has_trailer: size.has_trailer,
            width_10cm: tenths(size.width_m).clamp(1.0, 61.0) as u8,
            acceleration: Some((own.accel_mps2 * 10.0).round().clamp(-160.0, 160.0) as i16),
            yaw_rate: Some(
                (own.yaw_rate_radps.to_degrees() * 100.0)
                    .round()
                    .clamp(-32_766.0, 32_766.0) as i16,
            ),
            // The path driven is not kept.
            path: has_low_frequency.then(Vec::new),
        })
    }

    /// A roadside unit's awareness message; `None` where the projection does not reach.
    #[must_use]
    pub fn roadside_cam(&self) -> Option<RoadsideCam> {
        Some(RoadsideCam {
            station: self.station,
            generation_delta_ms: generation_delta_ms(its_time_ms(self.now_ns)),
            position: self.centre()?,
        })
    }

    /// What the station's own sensors perceive, as others would know it from a message, and the point that it is measured from: with the
    /// station's name and without a size.
    #[must_use]
    pub fn own_view(&self, perceived: &[Perception]) -> Vec<KnownObject> {
        let Self { own, now_ns, .. } = *self;
        let own_std_m = own.accuracy_m.map_or(UNKNOWN_POSITION_M, |accuracy| {
            (accuracy / std::f64::consts::SQRT_2) as f32
        });
        let reference = KnownObject {
            station: self.station,
            heard_from: self.station,
            object: 0,
            source: NeighbourSource::Own,
            position_m: own.front_m(self.size),
            velocity_mps: rotate([own.speed_mps, 0.0], own.heading_rad),
            heading_rad: turn(0.0, own.heading_rad),
            size_m: [0.0; 2],
            measured_ms: (fix_time_ns(now_ns, own) / 1_000_000) as i64,
            deviations: [
                own_std_m,
                self.deviations.speed_mps as f32,
                self.deviations.heading_rad as f32,
            ],
        };
        let objects = perceived.iter().map(|object| {
            let motion = object.motion(own, self.size);
            KnownObject {
                station: 0,
                object: u32::from(object.object) + 1,
                position_m: motion.position_m,
                velocity_mps: rotate(object.velocity_body_mps, own.heading_rad),
                heading_rad: turn(0.0, motion.heading_rad),
                size_m: object.size_m.map(|value| value as f32),
                measured_ms: (now_ns / 1_000_000) as i64,
                deviations: [
                    libm::hypotf(own_std_m, object.position_std_m as f32),
                    object.speed_std_mps as f32,
                    UNKNOWN_HEADING_RAD,
                ],
                ..reference
            }
        });
        std::iter::once(reference).chain(objects).collect()
    }

    /// An object of the map of an edge service as if the station perceived it.
    #[must_use]
    pub fn perception_of(&self, object: &FusedObject) -> Perception {
        let (own, origin_m) = (self.own, self.own.front_m(self.size));
        let offset_m = [0, 1].map(|axis: usize| object.position_m[axis] - origin_m[axis]);
        Perception {
            row: u32::MAX,
            object: object.number,
            position_body_m: rotate(offset_m, -own.heading_rad),
            velocity_body_mps: rotate(object.velocity_mps, -own.heading_rad),
            turn_rad: object.heading_rad - own.heading_rad,
            size_m: object.size_m.map(f64::from),
            is_person: object.is_person(),
            position_std_m: object.position_std_m,
            speed_std_mps: object.speed_std_mps,
        }
    }

    /// What the rules of collective perception watch of an object.
    #[must_use]
    pub fn motion_of(&self, object: &Perception) -> PerceivedMotion {
        PerceivedMotion {
            object: object.object.into(),
            kind: match object.is_person {
                true => ObjectKind::Person,
                false => ObjectKind::Vehicle,
            },
            motion: object.motion(self.own, self.size),
        }
    }

    /// A collective perception message with the objects at `included`; `None` where the projection does not reach.
    #[must_use]
    pub fn cpm(
        &self,
        spec: &PerceptionSpec,
        perceived: &[Perception],
        included: &[usize],
        has_sensor_information: bool,
    ) -> Option<Cpm> {
        let Self { own, now_ns, .. } = *self;
        let measured_ns = fix_time_ns(now_ns, own);
        let delta_ms = ((now_ns - measured_ns) / 1_000_000).min(2047) as i16;
        let (origin, region_rad) = match self.kind {
            // Its region is given from east on, a vehicle's from ahead.
            StationKind::ROADSIDE_UNIT => (CpmOrigin::Roadside, own.heading_rad),
            _ => {
                let heading = heading_from_yaw(own.heading_rad);
                (CpmOrigin::Vehicle { heading }, 0.0)
            }
        };
        let objects = included.iter().map(|place| {
            let object = &perceived[*place];
            let position = rotate(object.position_body_m, own.heading_rad);
            let velocity = rotate(object.velocity_body_mps, own.heading_rad);
            PerceivedObject {
                object: object.object,
                delta_ms,
                position_cm: position.map(|value| (value * 100.0).round().clamp(-131_072.0, 131_071.0) as i32),
                position_confidence_cm: (INTERVAL_95 * object.position_std_m * 100.0).ceil().clamp(1.0, 4095.0) as u16,
                velocity_cmps: velocity.map(|value| (value * 100.0).round().clamp(-16_383.0, 16_382.0) as i16),
                velocity_confidence: confidence(object.speed_std_mps, 0.01),
                angle: ((own.heading_rad + object.turn_rad).to_degrees() * 10.0)
                    .round()
                    .rem_euclid(3600.0) as u16,
                size_10cm: object.size_m.map(|value| tenths(value).clamp(1.0, 255.0) as u16),
                quality: 15,
                is_person: object.is_person,
            }
        });
        Some(Cpm {
            station: self.station,
            reference_time_ms: its_time_ms(measured_ns),
            position: self.front()?,
            origin,
            sensor: has_sensor_information.then(|| spec.region(region_rad)),
            perceived: perceived.len().min(255) as u8,
            objects: objects.take(255).collect(),
        })
    }
}

/// Time since `delta_ms`, the low 16 bits of a time not later than `now_ms`, ms.
fn age_ms(now_ms: u64, delta_ms: u16) -> i64 {
    i64::from(generation_delta_ms(now_ms).wrapping_sub(delta_ms))
}

/// Reference point of a message in the world, metres.
fn world_from(projection: &Projection, point: &GeodeticPoint) -> Option<[f64; 2]> {
    let geodetic = Geodetic {
        latitude_deg: f64::from(point.latitude) * 1e-7,
        longitude_deg: f64::from(point.longitude) * 1e-7,
    };
    let NetPosition { x_m, y_m } = projection.net_from_geodetic(geodetic).ok()?;
    Some([x_m, y_m])
}

/// Standard deviation on an axis of a stated accuracy, metres.
fn position_deviation_m(point: &GeodeticPoint) -> f32 {
    point
        .accuracy_cm
        .map_or(UNKNOWN_POSITION_M, |axis| (f64::from(axis) / 100.0 / ELLIPSE_95) as f32)
}

/// What a receiver knows of the sender of a cooperative awareness message.
#[must_use]
pub fn object_of_cam(cam: &Cam, now_ns: u64, projection: &Projection) -> Option<KnownObject> {
    let front_m = world_from(projection, &cam.position)?;
    let heading_rad = yaw_from_heading(cam.heading?);
    let speed_mps = f64::from(cam.speed_cmps?) / 100.0;
    let (sin, cos) = libm::sincos(heading_rad);
    let length_m = f64::from(cam.length_10cm) / 10.0;
    let now_ms = now_ns / 1_000_000;
    Some(KnownObject {
        station: cam.station,
        heard_from: cam.station,
        object: 0,
        source: NeighbourSource::Cam,
        position_m: [front_m[0] - 0.5 * length_m * cos, front_m[1] - 0.5 * length_m * sin],
        velocity_mps: [speed_mps * cos, speed_mps * sin],
        heading_rad,
        size_m: [length_m as f32, f32::from(cam.width_10cm) / 10.0],
        measured_ms: now_ms as i64 - age_ms(its_time_ms(now_ns), cam.generation_delta_ms),
        deviations: [
            position_deviation_m(&cam.position),
            stated_deviation(cam.speed_confidence, 0.01, UNKNOWN_SPEED_MPS),
            stated_deviation(cam.heading_confidence, 0.1_f64.to_radians(), UNKNOWN_HEADING_RAD),
        ],
    })
}

/// What a receiver knows of the person that sends an awareness message.
#[must_use]
pub fn object_of_vam(vam: &Vam, now_ns: u64, projection: &Projection) -> Option<KnownObject> {
    let position_m = world_from(projection, &vam.position)?;
    let heading_rad = yaw_from_heading(vam.heading?);
    let (sin, cos) = libm::sincos(heading_rad);
    let speed_mps = vam.speed_cmps.map_or(0.0, |speed| f64::from(speed) / 100.0);
    let now_ms = now_ns / 1_000_000;
    Some(KnownObject {
        station: vam.station,
        heard_from: vam.station,
        object: 0,
        source: NeighbourSource::Vam,
        position_m,
        velocity_mps: [speed_mps * cos, speed_mps * sin],
        heading_rad,
        size_m: PERSON_M,
        measured_ms: now_ms as i64 - age_ms(its_time_ms(now_ns), vam.generation_delta_ms),
        deviations: [
            position_deviation_m(&vam.position),
            match vam.speed_cmps {
                Some(_) => stated_deviation(vam.speed_confidence, 0.01, UNKNOWN_SPEED_MPS),
                None => WALKING_MPS,
            },
            stated_deviation(vam.heading_confidence, 0.1_f64.to_radians(), UNKNOWN_HEADING_RAD),
        ],
    })
}

/// What a receiver knows of the sender of a basic safety message.
#[must_use]
pub fn object_of_bsm(bsm: &BsmCore, now_ns: u64, projection: &Projection) -> Option<KnownObject> {
    let point = GeodeticPoint {
        latitude: bsm.latitude?,
        longitude: bsm.longitude?,
        ..GeodeticPoint::default()
    };
    let heading_rad = yaw_from_heading(0) - f64::from(bsm.heading?) * 0.0125_f64.to_radians();
    let (sin, cos) = libm::sincos(heading_rad);
    let speed_mps = f64::from(bsm.speed?) * 0.02;
    let position_std_m = bsm
        .accuracy_5cm
        .map_or(UNKNOWN_POSITION_M, |axes| 0.05 * f32::from(axes[0]));
    // Milliseconds of the minute, not later than now.
    let its_ms = its_time_ms(now_ns);
    let age_ms = (its_ms % 60_000 + 60_000 - u64::from(bsm.second_mark_ms?) % 60_000) % 60_000;
    Some(KnownObject {
        station: bsm.id,
        heard_from: bsm.id,
        object: 0,
        source: NeighbourSource::Bsm,
        position_m: world_from(projection, &point)?,
        velocity_mps: [speed_mps * cos, speed_mps * sin],
        heading_rad: turn(0.0, heading_rad),
        size_m: [f32::from(bsm.length_cm) / 100.0, f32::from(bsm.width_cm) / 100.0],
        measured_ms: (now_ns / 1_000_000) as i64 - age_ms as i64,
        deviations: [position_std_m, UNKNOWN_SPEED_MPS, UNKNOWN_HEADING_RAD],
    })
}

/// Standard deviation that a confidence states in its unit; `unknown` where it states none.
fn stated_deviation(confidence: Option<u8>, unit: f64, unknown: f32) -> f32 {
    match confidence {
        Some(stated) if stated < 126 => (f64::from(stated) * unit / INTERVAL_95) as f32,
        _ => unknown,
    }
}

/// What a receiver knows from a collective perception message, into `known`.
pub fn objects_of_cpm(
    cpm: &Cpm,
    now_ns: u64,
    projection: &Projection,
    listing: V2xListing,
    known: &mut Vec<KnownObject>,
) {
    let Some(reference_m) = world_from(projection, &cpm.position) else {
        return;
    };
    let own_deviation_m = position_deviation_m(&cpm.position);
    let reference_ms = (now_ns / 1_000_000) as i64 - (its_time_ms(now_ns) as i64 - cpm.reference_time_ms as i64);
    if listing == V2xListing::Separate {
        known.push(reference_of_cpm(cpm, reference_m, reference_ms));
    }
    known.extend(cpm.objects.iter().map(|object| {
        let position_std_m = f64::from(object.position_confidence_cm) / 100.0 / INTERVAL_95;
        KnownObject {
            station: 0,
            heard_from: cpm.station,
            object: u32::from(object.object) + 1,
            source: NeighbourSource::Cpm,
            position_m: [0, 1].map(|axis: usize| reference_m[axis] + f64::from(object.position_cm[axis]) / 100.0),
            velocity_mps: object.velocity_cmps.map(|value| f64::from(value) / 100.0),
            heading_rad: f64::from(object.angle).to_radians() / 10.0,
            size_m: object.size_10cm.map(|value| f32::from(value) / 10.0),
            measured_ms: reference_ms + i64::from(object.delta_ms),
            deviations: [
                libm::hypotf(own_deviation_m, position_std_m as f32),
                (f64::from(object.velocity_confidence) * 0.01 / INTERVAL_95) as f32,
                UNKNOWN_HEADING_RAD,
            ],
        }
    }));
}

/// Number of the point at a station that its objects are measured from, beyond those of the objects.
const REFERENCE_OBJECT: u32 = 1 << 16 | 1;

/// The point that a message's objects are measured from, as the station measures it: with the station's name and without a size.
fn reference_of_cpm(cpm: &Cpm, position_m: [f64; 2], measured_ms: i64) -> KnownObject {
    KnownObject {
        station: cpm.station,
        heard_from: cpm.station,
        object: REFERENCE_OBJECT,
        source: NeighbourSource::Cpm,
        position_m,
        velocity_mps: [0.0; 2],
        heading_rad: match cpm.origin {
            CpmOrigin::Vehicle { heading } => yaw_from_heading(heading),
            CpmOrigin::Roadside => 0.0,
        },
        size_m: [0.0; 2],
        measured_ms,
        deviations: [
            position_deviation_m(&cpm.position),
            UNKNOWN_SPEED_MPS,
            UNKNOWN_HEADING_RAD,
        ],
    }
}
