//! What a station perceives with its own sensors.

use ipc_schema::{traffic::Kind, world::VehicleState};
use sim_core::scene::shape::{Bounds, Point};

use super::outgoing::StationTick;
use crate::{
    radio::{
        obstruction::{Antenna, Obstacles},
        open_strips::{OpenStrips, SharedStrip},
    },
    random::{LinkKey, RadioDraw, RadioRandom},
    roadside::RoadsideUnit,
    services::turn,
    station::{Perception, PerceptionSpec, rotate, station_id},
};

/// A station that perceives road users at a tick.
pub struct Observer<'a> {
    /// Its antenna.
    pub antenna: &'a Antenna,
    /// Its middle, from which the range counts, metres.
    pub centre_m: Point,
    /// The point that objects are measured from, metres.
    pub origin_m: Point,
    /// Where it points, radians counter-clockwise from east.
    pub yaw_rad: f64,
    /// Id of its station.
    pub station: u32,
    /// The tick.
    pub tick: u32,
    /// Road users of the tick.
    pub states: &'a [VehicleState],
    /// Buildings and road users.
    pub obstacles: &'a Obstacles,
    /// Random numbers of the episode.
    pub random: &'a RadioRandom,
    /// Its radio, where the strips of radios are known: what is in one strip with it is found sooner.
    pub radio: Option<ObservingRadio<'a>>,
}

/// A radio of an observer.
#[derive(Clone, Copy)]
pub struct ObservingRadio<'a> {
    number: u32,
    strips: &'a OpenStrips,
    radio_of_row: &'a [u32],
}

impl<'a> ObservingRadio<'a> {
    /// The radio of this number of a tick.
    #[must_use]
    pub fn new(number: u32, tick: &StationTick<'a>) -> Self {
        Self {
            number,
            strips: tick.strips,
            radio_of_row: tick.radio_of_row,
        }
    }

    /// A strip that it shares with the radio of the road user at a row: both are at the middles of their road users.
    fn shared(&self, row: u32) -> Option<SharedStrip> {
        let other = *self.radio_of_row.get(row as usize)?;
        match other {
            u32::MAX => None,
            other => self.strips.shared(self.number as usize, other as usize),
        }
    }
}

impl<'a> Observer<'a> {
    /// The vehicle that carries the antenna.
    #[must_use]
    pub fn at(
        antenna: &'a Antenna,
        station: u32,
        tick: u32,
        states: &'a [VehicleState],
        obstacles: &'a Obstacles,
        random: &'a RadioRandom,
    ) -> Self {
        let body = &obstacles.bodies()[antenna.row as usize];
        Self {
            antenna,
            centre_m: body.centre_m,
            origin_m: body.world_from_local([body.half_m[0], 0.0]),
            yaw_rad: states[antenna.row as usize].yaw_rad,
            station,
            tick,
            states,
            obstacles,
            random,
            radio: None,
        }
    }

    /// A roadside unit of the tick, whose radio has a number.
    #[must_use]
    pub fn of_roadside(unit: &'a RoadsideUnit, radio: u32, station: u32, tick: &StationTick<'a>) -> Self {
        Self {
            antenna: &unit.antenna,
            centre_m: unit.antenna.position_m,
            origin_m: unit.antenna.position_m,
            yaw_rad: unit.own.heading_rad,
            station,
            tick: tick.tick,
            states: tick.states,
            obstacles: tick.obstacles,
            random: tick.random,
            radio: Some(ObservingRadio::new(radio, tick)),
        }
    }

    /// True if a building or another road user is in the way of a place.
    fn is_hidden(&self, target: &Antenna) -> bool {
        let obstacles = self.obstacles;
        let shared = self
            .radio
            .and_then(|radio| Some((radio.strips, radio.shared(target.row)?)));
        match shared {
            Some((strips, shared)) => strips
                .highest_vehicle_m(&shared, obstacles, self.antenna, target)
                .is_some(),
            None => {
                obstacles.meets_building(self.antenna, target)
                    || obstacles.highest_vehicle_m(self.antenna, target).is_some()
            }
        }
    }

    /// Objects that the station sees: in range and in its field of view, and neither a building nor another road user in the way of their
    /// centre.
    #[must_use]
    pub fn perceive(&self, spec: &PerceptionSpec) -> Vec<Perception> {
        let Self { states, obstacles, .. } = self;
        let (bodies, yaw_rad) = (obstacles.bodies(), self.yaw_rad);
        let mut near = Vec::new();
        obstacles.bodies_near(&Bounds::about(self.centre_m, spec.range_m), &mut near);
        let object = |row: &u32| {
            let (body, other) = (&bodies[*row as usize], &states[*row as usize]);
            let [dx, dy] = [0, 1].map(|axis: usize| body.centre_m[axis] - self.centre_m[axis]);
            if *row == self.antenna.row || dx * dx + dy * dy > spec.range_m * spec.range_m {
                return None;
            }
            let is_outside = |opening_rad: f64| turn(yaw_rad, libm::atan2(dy, dx)).abs() > 0.5 * opening_rad;
            if spec.opening_rad.is_some_and(is_outside) {
                return None;
            }
            let target = Antenna {
                position_m: body.centre_m,
                z_m: body.z_m[1],
                row: *row,
            };
            if self.is_hidden(&target) {
                return None;
            }
            let key = LinkKey {
                sender: self.station,
                receiver: station_id(other.id_hash),
                message: self.tick,
            };
            let [ex, ey, ev, ew] = self.random.normals(key, RadioDraw::Perception, 0).map(f64::from);
            let offset = [body.centre_m[0] - self.origin_m[0], body.centre_m[1] - self.origin_m[1]];
            let [ahead, left] = rotate(offset, -yaw_rad);
            let velocity = rotate(
                [
                    f64::from(other.velocity_body_mps[0]),
                    f64::from(other.velocity_body_mps[1]),
                ],
                other.yaw_rad - yaw_rad,
            );
            Some(Perception {
                row: *row,
                object: (other.vehicle % 65_535) as u16,
                position_body_m: [ahead + spec.position_std_m * ex, left + spec.position_std_m * ey],
                velocity_body_mps: [
                    velocity[0] + spec.speed_std_mps * ev,
                    velocity[1] + spec.speed_std_mps * ew,
                ],
                turn_rad: other.yaw_rad - yaw_rad,
                size_m: [other.length_m.into(), other.width_m.into()],
                is_person: other.kind == Kind::Person as u32,
                position_std_m: spec.position_std_m,
                speed_std_mps: spec.speed_std_mps,
            })
        };
        near.iter().filter_map(object).collect()
    }
}
