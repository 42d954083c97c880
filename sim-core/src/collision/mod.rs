//! Contacts of connected vehicles and heroes with everything: vehicles, persons, buildings and props, from the states of a finished tick.
//!
//! Broad phase: a grid of all road users, built again each tick, and a fixed grid of static objects. Narrow phase: exact for upright
//! boxes, capsules and prisms with their heights, so that a vehicle under a bridge touches nothing on it. In a net without
//! elevation the junctions show where roads cross at different levels ([`crate::scene::Road::are_levels_apart`]). The order of
//! events depends on the road users' indices alone.

use std::sync::Arc;

use ipc_schema::{
    event::{Collision, Struck},
    traffic::{Kind, id_hash},
    world::{COLLIDED, VehicleState, road_users_of, vehicle_of},
};

use crate::scene::{
    Grid, Scene, Solid,
    shape::{Bounds, OrientedBox, smallest_rectangle},
};

pub mod body;
mod broad;
mod record;

use body::{CollisionBody, box_touches_prism, boxes_touch, common_height, common_point};
use broad::{BroadPhase, LARGE_M};
pub use record::{CollisionCounts, ContactReporter, ContactState};

/// Reaches of vehicles (cars, lorries) up to which the cell of the centre holds every solid nearby: one index for each, metres.
const REACHES_M: [f64; 2] = [3.2, 11.0];
/// Size of a cell of the index over solids, metres.
const CELL_M: f64 = 8.0;

/// A contact in a tick. Ordered by the vehicle, then by what it touches.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Contact {
    /// Dense index of the vehicle: of two watched ones the lower.
    vehicle: u32,
    class: u32,
    /// Dense index of the other road user, or number in the scene.
    other: u32,
    /// Rows of the bodies in the world; of a solid its number in the scene.
    rows: (u32, u32),
}

impl Contact {
    fn key(&self) -> (u32, u32, u32) {
        (self.vehicle, self.class, self.other)
    }
}

/// Finds contacts, and separates those that begin from those that last.
#[derive(Debug)]
pub struct CollisionDetector {
    scene: Arc<Scene>,
    /// Rectangle of any heading about each solid.
    rectangles: Vec<OrientedBox>,
    solid_hashes: Vec<u64>,
    /// Over solids grown by [`REACHES_M`].
    indices: [Grid; 2],
    bodies: Vec<CollisionBody>,
    /// By body: whether its contacts matter by themselves.
    watched: Vec<bool>,
    /// By body: row of the road user that it belongs to.
    owners: Vec<u32>,
    broad: BroadPhase,
    near: Vec<u32>,
    episode: Option<u64>,
    contacts: Vec<Contact>,
    before: Vec<Contact>,
    begun: Vec<Collision>,
}

impl CollisionDetector {
    /// A detector over a scene.
    #[must_use]
    pub fn new(scene: Arc<Scene>) -> Self {
        let bounds: Vec<Bounds> = scene.bounds().collect();
        let within = |reach_m: f64| -> Vec<Bounds> { bounds.iter().map(|bounds| bounds.grown(reach_m)).collect() };
        let indices = REACHES_M.map(|reach_m| Grid::new(&within(reach_m), CELL_M));
        let rectangles = (0..bounds.len() as u32).map(|number| match scene.solid(number) {
            Solid::Building(building) => smallest_rectangle(&building.outline_m, building.z_m()),
            Solid::Prop(prop) => prop.body,
        });
        let buildings = scene.buildings().iter().map(|building| id_hash(&building.id));
        let props = scene.props().iter().map(|prop| id_hash(prop.kind.name));
        Self {
            solid_hashes: buildings.chain(props).collect(),
            rectangles: rectangles.collect(),
            indices,
            scene,
            bodies: Vec::new(),
            watched: Vec::new(),
            owners: Vec::new(),
            broad: BroadPhase::default(),
            near: Vec::new(),
            episode: None,
            contacts: Vec::new(),
            before: Vec::new(),
            begun: Vec::new(),
        }
    }

    /// The scene.
    #[must_use]
    pub fn scene(&self) -> &Scene {
        &self.scene
    }

    /// Contacts that began in the last tick, in the order of the vehicles' indices.
    #[must_use]
    pub fn begun(&self) -> &[Collision] {
        &self.begun
    }

    /// Looks for contacts at the end of a tick and sets [`COLLIDED`] where one begins; [`CollisionDetector::begun`] lists them. `states`
    /// are those of a `world` message: what a trailing body touches, its vehicle touches, and the bodies of one vehicle do not touch
    /// each other.
    pub fn detect(&mut self, episode: u64, states: &mut [VehicleState]) {
        if self.episode != Some(episode) {
            self.episode = Some(episode);
            self.contacts.clear();
        }
        std::mem::swap(&mut self.contacts, &mut self.before);
        self.contacts.clear();
        self.begun.clear();
        let reach_m = self.collect_bodies(states);
        if self.watched.contains(&true) {
            self.find_contacts_with_road_users(states, reach_m);
            self.find_contacts_with_solids(states);
        }
        self.flag_new_contacts(states);
    }

    /// Takes the bodies of all road users and returns the farthest reach of those that are not large.
    fn collect_bodies(&mut self, states: &[VehicleState]) -> f64 {
        self.bodies.clear();
        self.watched.clear();
        self.owners.clear();
        let mut most_m = 0.0;
        for (row, state) in (0_u32..).zip(states) {
            let body = CollisionBody::of(state);
            let reach_m = body.reach_m();
            if reach_m <= LARGE_M && reach_m > most_m {
                most_m = reach_m;
            }
            self.bodies.push(body);
            // The bodies of a vehicle follow all road users, whose indices ascend.
            let is_trailing = state.kind == Kind::Trailing as u32;
            let owner = match is_trailing {
                true => owner_of(state, states).unwrap_or(row),
                false => row,
            };
            let kind = states[owner as usize].kind;
            self.owners.push(owner);
            self.watched.push(kind == Kind::Cav as u32 || kind == Kind::Hero as u32);
        }
        most_m
    }

    fn find_contacts_with_road_users(&mut self, states: &[VehicleState], reach_m: f64) {
        for &(a, b) in self.broad.pairs(&self.bodies, &self.watched, reach_m) {
            let (one, two) = (a as usize, b as usize);
            if self.owners[one] == self.owners[two] {
                continue;
            }
            let bodies = [&self.bodies[one], &self.bodies[two]];
            if !bodies[0].touches(bodies[1]) || self.scene.road().are_levels_apart(bodies.map(|body| &body.solid)) {
                continue;
            }
            // Rows of road users are in ascending order of the index.
            let is_first = self.owners[one] < self.owners[two];
            let (low, high) = if is_first { (one, two) } else { (two, one) };
            let (vehicle, other) = if self.watched[low] { (low, high) } else { (high, low) };
            let is_person = self.bodies[other].is_capsule;
            self.contacts.push(Contact {
                vehicle: vehicle_of(states[vehicle].vehicle),
                class: if is_person { Struck::Person } else { Struck::Vehicle } as u32,
                other: vehicle_of(states[other].vehicle),
                rows: (vehicle as u32, other as u32),
            });
        }
    }

    fn find_contacts_with_solids(&mut self, states: &[VehicleState]) {
        if self.rectangles.is_empty() {
            return;
        }
        for (row, body) in self.bodies.iter().enumerate() {
            if !self.watched[row] {
                continue;
            }
            let reach_m = body.reach_m();
            let near = match REACHES_M.iter().position(|most_m| reach_m <= *most_m) {
                Some(index) => self.indices[index].at(body.solid.centre_m),
                None => {
                    self.scene.solids_near(&body.solid.bounds(), &mut self.near);
                    &self.near
                }
            };
            for &number in near {
                if !boxes_touch(&body.solid, &self.rectangles[number as usize]) {
                    continue;
                }
                if let Some(class) = struck(&self.scene, number, body) {
                    self.contacts.push(Contact {
                        vehicle: vehicle_of(states[row].vehicle),
                        class: class as u32,
                        other: number,
                        rows: (row as u32, number),
                    });
                }
            }
        }
    }

    /// Flags and describes contacts that did not exist in the tick before.
    fn flag_new_contacts(&mut self, states: &mut [VehicleState]) {
        self.contacts.sort_unstable();
        // Of two vehicles that touch with several bodies, the first pair of bodies describes the contact.
        self.contacts.dedup_by_key(|contact| contact.key());
        for contact in &self.contacts {
            let known = self.before.binary_search_by_key(&contact.key(), Contact::key);
            if known.is_ok() {
                continue;
            }
            let collision = self.describe(contact, states);
            self.begun.push(collision);
            let owner = |row: u32| self.owners[row as usize] as usize;
            states[owner(contact.rows.0)].flags |= COLLIDED;
            if contact.class == Struck::Vehicle as u32 || contact.class == Struck::Person as u32 {
                states[owner(contact.rows.1)].flags |= COLLIDED;
            }
        }
    }

    fn describe(&self, contact: &Contact, states: &[VehicleState]) -> Collision {
        let (row, other) = (contact.rows.0 as usize, contact.rows.1 as usize);
        let (state, body) = (&states[row], &self.bodies[row]);
        let velocity = world_velocity(state, body);
        let is_solid = contact.class == Struck::Building as u32 || contact.class == Struck::Obstacle as u32;
        let (position_m, other_id_hash, other_velocity) = if is_solid {
            (
                self.contact_with_solid(contact.other, body),
                self.solid_hashes[other],
                [0.0; 3],
            )
        } else {
            let (other_state, other_body) = (&states[other], &self.bodies[other]);
            let velocity = world_velocity(other_state, other_body);
            (body.contact_m(other_body), other_state.id_hash, velocity)
        };
        let difference = [0, 1, 2].map(|axis: usize| velocity[axis] - other_velocity[axis]);
        Collision {
            position_m,
            id_hash: state.id_hash,
            other_id_hash,
            vehicle: contact.vehicle,
            other: contact.other,
            other_class: contact.class,
            relative_speed_mps: difference.iter().map(|v| v * v).sum::<f64>().sqrt() as f32,
        }
    }

    fn contact_with_solid(&self, number: u32, body: &CollisionBody) -> [f64; 3] {
        let (flat, z_m) = match self.scene.solid(number) {
            Solid::Building(building) => (common_point(&body.solid, &building.outline_m), building.z_m()),
            Solid::Prop(prop) => (common_point(&body.solid, &prop.body.corners()), prop.body.z_m),
        };
        [flat[0], flat[1], common_height(body.solid.z_m, z_m)]
    }
}

/// Row of the vehicle that a trailing body belongs to.
fn owner_of(body: &VehicleState, states: &[VehicleState]) -> Option<u32> {
    let vehicle = vehicle_of(body.vehicle);
    let row = road_users_of(states).binary_search_by_key(&vehicle, |state| state.vehicle);
    row.ok().map(|row| row as u32)
}

/// The class of the solid, if `body`, which touches the rectangle about it, also touches the solid.
fn struck(scene: &Scene, number: u32, body: &CollisionBody) -> Option<Struck> {
    match scene.solid(number) {
        Solid::Building(building) => {
            box_touches_prism(&body.solid, &building.outline_m, building.z_m()).then_some(Struck::Building)
        }
        Solid::Prop(_) => Some(Struck::Obstacle),
    }
}

/// Velocity of the origin in the world frame, m/s.
fn world_velocity(state: &VehicleState, body: &CollisionBody) -> [f64; 3] {
    let [ahead, left, up] = state.velocity_body_mps.map(f64::from);
    let [cos, sin] = body.solid.along;
    [ahead * cos - left * sin, ahead * sin + left * cos, up]
}
