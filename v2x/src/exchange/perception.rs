//! What a station perceives with its own sensors.

use ipc_schema::{traffic::Kind, world::VehicleState};
use sim_core::scene::shape::Bounds;

use crate::{
    radio::obstruction::{Antenna, Obstacles},
    random::{LinkKey, RadioDraw, RadioRandom},
    station::{Perception, PerceptionSpec, rotate, station_id},
};

/// A vehicle that perceives others at a tick.
pub struct Observer<'a> {
    /// Its antenna.
    pub antenna: &'a Antenna,
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
}

impl Observer<'_> {
    /// Objects that the vehicle sees: in range, and neither a building nor another road user in the way of their centre.
    #[must_use]
    pub fn perceive(&self, spec: &PerceptionSpec) -> Vec<Perception> {
        let Self { states, obstacles, .. } = self;
        let (bodies, state) = (obstacles.bodies(), &states[self.antenna.row as usize]);
        let own = &bodies[self.antenna.row as usize];
        let front_m = own.world_from_local([own.half_m[0], 0.0]);
        let mut near = Vec::new();
        obstacles.road_users_near(&Bounds::about(own.centre_m, spec.range_m), &mut near);
        let object = |row: &u32| {
            let (body, other) = (&bodies[*row as usize], &states[*row as usize]);
            let [dx, dy] = [0, 1].map(|axis: usize| body.centre_m[axis] - own.centre_m[axis]);
            if *row == self.antenna.row || dx * dx + dy * dy > spec.range_m * spec.range_m {
                return None;
            }
            let target = Antenna {
                position_m: body.centre_m,
                z_m: body.z_m[1],
                row: *row,
            };
            let hidden = obstacles.meets_building(self.antenna, &target)
                || obstacles.highest_vehicle_m(self.antenna, &target).is_some();
            if hidden {
                return None;
            }
            let key = LinkKey {
                sender: self.station,
                receiver: station_id(other.id_hash),
                message: self.tick,
            };
            let [ex, ey, ev, ew] = self.random.normals(key, RadioDraw::Perception, 0).map(f64::from);
            let offset = [body.centre_m[0] - front_m[0], body.centre_m[1] - front_m[1]];
            let [ahead, left] = rotate(offset, -state.yaw_rad);
            let velocity = rotate(
                [
                    f64::from(other.velocity_body_mps[0]),
                    f64::from(other.velocity_body_mps[1]),
                ],
                other.yaw_rad - state.yaw_rad,
            );
            Some(Perception {
                object: (other.vehicle % 65_535) as u16,
                position_body_m: [ahead + spec.position_std_m * ex, left + spec.position_std_m * ey],
                velocity_body_mps: [
                    velocity[0] + spec.speed_std_mps * ev,
                    velocity[1] + spec.speed_std_mps * ew,
                ],
                turn_rad: other.yaw_rad - state.yaw_rad,
                size_m: [other.length_m.into(), other.width_m.into()],
                is_person: other.kind == Kind::Person as u32,
            })
        };
        near.iter().filter_map(object).collect()
    }
}
