//! The driving task: checks the actions of heroes, follows heroes along their routes, and ends their episodes.

use std::{collections::BTreeMap, sync::Arc};

use ipc_schema::{
    config,
    ego::EgoPose,
    traffic::{HeroAdvice, Kind, RoutePoint, SignalMeta},
    world::{
        ACTION_REFUSED, AGAINST_TRAFFIC, APPEARED, ARRIVED, BLOCKED, COLLIDED, HERO_ENDS, HeroView, OFF_ROAD,
        RED_LIGHT, ROUTE_AHEAD_M, SIGHT_M, TIME_LIMIT, VehicleState, vehicle_of,
    },
};

pub mod action;
pub mod bodies;
pub mod encounter;
pub mod ports;
pub mod route;
pub mod surroundings;

use crate::{models::state::ControlInput, scene::Scene};
use action::HeroAction;
use bodies::TickBodies;
use route::HeroRoute;
use surroundings::ShownLight;

/// A hero that is beside the road for this long is off the road, seconds.
const OFF_ROAD_AFTER_S: f64 = 0.5;
/// A hero that drives against the traffic for this long has done so, seconds.
const AGAINST_TRAFFIC_AFTER_S: f64 = 1.0;
/// Speed from which a hero drives against the traffic, m/s.
const AGAINST_TRAFFIC_FROM_MPS: f32 = 0.5;
/// A slower hero stands, m/s.
const STANDS_MPS: f32 = 0.1;
/// A hero has arrived when its front bumper is this near to the end of its route, metres.
const ARRIVED_WITHIN_M: f64 = 5.0;
/// Part of the route behind and ahead of its last position that is searched for a hero, metres.
const SEARCH_M: [f64; 2] = [5.0, 20.0];
/// Room beside a hero and another road user that still counts as in the hero's way, metres.
const SIDE_ROOM_M: f64 = 0.2;
/// Room beside a hero and a person ahead of it.
const PERSON_ROOM_M: f64 = 0.8;

/// Ground that has roads (x, y, world frame, metres).
pub trait DrivableGround {
    /// True if vehicles drive there.
    fn is_on_road(&self, x_m: f64, y_m: f64) -> bool;

    /// True if all lanes there lead against the heading `yaw_rad`.
    fn is_against_traffic(&self, x_m: f64, y_m: f64, yaw_rad: f64) -> bool;
}

impl DrivableGround for Arc<Scene> {
    fn is_on_road(&self, x_m: f64, y_m: f64) -> bool {
        Scene::is_on_road(self, x_m, y_m)
    }

    fn is_against_traffic(&self, x_m: f64, y_m: f64, yaw_rad: f64) -> bool {
        Scene::is_against_traffic(self, x_m, y_m, yaw_rad)
    }
}

/// Counts of heroes' episodes and actions, for the run's report.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default, serde::Serialize, serde::Deserialize)]
pub struct HeroCounts {
    /// Episodes of heroes that began.
    pub episodes: u64,
    /// Ended by a collision.
    pub collided: u64,
    /// Ended beside the road.
    pub off_road: u64,
    /// Ended at the end of the route.
    pub arrived: u64,
    /// Ended because they stood for too long.
    #[serde(default)]
    pub blocked: u64,
    /// Cut by the time limit.
    pub time_limit: u64,
    /// Red lights run, whether or not the episode ends there.
    pub red_lights: u64,
    /// Times that a hero drove against the traffic, whether or not its episode ends there.
    pub against_traffic: u64,
    /// Actions that were refused: not a number, or out of range.
    pub refused_actions: u64,
}

/// An action that was refused.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RefusedAction {
    /// "steering" or "acceleration".
    pub part: &'static str,
    /// The value of the action.
    pub value: f32,
    /// The action that is held instead.
    pub held: HeroAction,
}

/// One hero's episode.
#[derive(Debug, Default)]
struct HeroTrip {
    route: HeroRoute,
    /// Station of the rear axle, metres; `None` before the first tick.
    station_m: Option<f64>,
    action: HeroAction,
    refused: bool,
    /// The first refusal has been returned.
    reported: bool,
    off_road_ticks: u32,
    against_ticks: u32,
    /// Station of the front bumper at the last tick, metres.
    front_station_m: Option<f64>,
    ticks: u64,
    /// Since it moved last.
    standing_ticks: u64,
    over: bool,
    /// What SUMO's own driver would have chosen in the last step, m/s².
    advised_accel_mps2: f32,
}

/// A link of a traffic light.
#[derive(Debug, Clone, Copy, Default)]
struct SignalLink {
    /// SUMO's letter.
    letter: u8,
    /// Tick of the episode since which it is shown.
    since: u64,
}

/// All heroes of the current episode.
#[derive(Debug)]
pub struct DrivingTask<G> {
    ground: G,
    limits: config::VehicleConfig,
    off_road_ticks: u32,
    against_ticks: u32,
    ends_at_infractions: bool,
    time_limit_ticks: u64,
    /// `None`: no hero is ever blocked.
    blocked_ticks: Option<u64>,
    episode: Option<u64>,
    trips: BTreeMap<u32, HeroTrip>,
    /// Links of each traffic light.
    signals: BTreeMap<u32, Vec<SignalLink>>,
    tick_s: f64,
    /// Of this episode.
    ticks: u64,
    counts: HeroCounts,
}

impl<G: DrivableGround> DrivingTask<G> {
    /// No heroes yet.
    #[must_use]
    pub fn new(config: &config::Config, ground: G) -> Self {
        let ticks = |seconds: f64| libm::round(seconds / config.run.tick_s).max(1.0);
        Self {
            ground,
            limits: config.vehicle.clone(),
            off_road_ticks: ticks(OFF_ROAD_AFTER_S) as u32,
            against_ticks: ticks(AGAINST_TRAFFIC_AFTER_S) as u32,
            ends_at_infractions: config.task.ends_at_infractions,
            time_limit_ticks: ticks(config.task.time_limit_s) as u64,
            blocked_ticks: config.task.blocked_s.map(|seconds| ticks(seconds) as u64),
            episode: None,
            trips: BTreeMap::new(),
            signals: BTreeMap::new(),
            tick_s: config.run.tick_s,
            ticks: 0,
            counts: HeroCounts::default(),
        }
    }

    /// The ground of the map that the next episode is on.
    pub fn set_ground(&mut self, ground: G) {
        self.ground = ground;
    }

    /// Counts so far.
    #[must_use]
    pub fn counts(&self) -> HeroCounts {
        self.counts
    }

    /// Continues from the counts of an earlier process.
    pub fn restore_counts(&mut self, counts: HeroCounts) {
        self.counts = counts;
    }

    /// Forgets everything when a new episode begins.
    pub fn enter_episode(&mut self, episode: u64) {
        if self.episode != Some(episode) {
            self.episode = Some(episode);
            self.trips.clear();
            self.signals.clear();
            self.ticks = 0;
        }
    }

    /// Takes points of routes; a point with number 0 begins one.
    pub fn add_route(&mut self, points: &[RoutePoint]) {
        for point in points {
            let trip = self.trips.entry(point.vehicle).or_default();
            if point.index == 0 {
                trip.route = HeroRoute::default();
            }
            trip.route.push(point);
        }
    }

    /// Takes what SUMO's own driver would have done in this tick.
    pub fn add_advice(&mut self, advice: &[HeroAdvice]) {
        for HeroAdvice { vehicle, accel_mps2 } in advice {
            if let Some(trip) = self.trips.get_mut(vehicle) {
                trip.advised_accel_mps2 = *accel_mps2;
            }
        }
    }

    /// Takes states of traffic lights.
    pub fn add_signals(&mut self, signals: &[SignalMeta]) {
        for signal in signals {
            let links = self.signals.entry(signal.signal).or_default();
            links.resize((signal.links as usize).min(signal.state.len()), SignalLink::default());
            for (link, letter) in links.iter_mut().zip(signal.state) {
                if link.letter != letter {
                    *link = SignalLink {
                        letter,
                        since: self.ticks,
                    };
                }
            }
        }
    }

    /// Accepts the action for the hero `vehicle` and returns its control input. An unusable action is refused and counted, and the
    /// last valid action is held. Returns the first refusal in a hero's episode, for the log.
    pub fn apply_action(&mut self, vehicle: u32, action: HeroAction) -> (ControlInput, Option<RefusedAction>) {
        let trip = self.trips.entry(vehicle).or_default();
        let mut refusal = None;
        match action::fault(action) {
            None => trip.action = action,
            Some((part, value)) => {
                trip.refused = true;
                self.counts.refused_actions += 1;
                if !std::mem::replace(&mut trip.reported, true) {
                    refusal = Some(RefusedAction {
                        part,
                        value,
                        held: trip.action,
                    });
                }
            }
        }
        (action::input(trip.action, &self.limits), refusal)
    }

    /// Ends a tick, after all road users have moved and contacts are known: sets the flags of heroes in `states` and returns their poses
    /// for SUMO.
    pub fn end_tick(&mut self, states: &mut [VehicleState]) -> Vec<EgoPose> {
        self.ticks += 1;
        let mut poses = Vec::new();
        for state in states.iter_mut().filter(|state| state.kind == Kind::Hero as u32) {
            let mut trip = self.trips.remove(&state.vehicle).unwrap_or_default();
            let station_m = trip.follow(state);
            let infractions = self.infractions(&mut trip, state, station_m);
            let flags = self.end_flags(&mut trip, state, station_m, infractions);
            state.flags |= flags;
            poses.push(pose(state));
            self.trips.insert(state.vehicle, trip);
        }
        poses
    }

    /// Fills `views`, one for each hero in their order, after the tick has ended.
    pub fn write_views(&self, states: &[VehicleState], views: &mut [HeroView]) {
        let bodies = TickBodies::of(states);
        let rows = (0..states.len()).filter(|&row| states[row].kind == Kind::Hero as u32);
        for (row, view) in rows.zip(views) {
            if let Some(trip) = self.trips.get(&states[row].vehicle) {
                *view = HeroView {
                    advised_accel_mps2: trip.advised_accel_mps2,
                    ..self.view(&trip.route, trip.station_m.unwrap_or(0.0), row, (states, &bodies))
                };
            }
        }
    }

    /// Counts the rules that a hero breaks in a tick; their bits, if they end its episode.
    fn infractions(&mut self, trip: &mut HeroTrip, state: &VehicleState, station_m: f64) -> u32 {
        let front_station_m = station_m + front_m(state);
        let before_m = trip.front_station_m.replace(front_station_m);
        let ran_red = before_m.is_some_and(|before_m| {
            let crossed = |stop: &&route::StopLine| before_m < stop.station_m && stop.station_m <= front_station_m;
            let is_red = |stop: &route::StopLine| matches!(self.letter(stop), Some(b'r' | b'R'));
            trip.route.stop_lines().iter().filter(crossed).any(is_red)
        });
        let is_moving = state.velocity_body_mps[0] > AGAINST_TRAFFIC_FROM_MPS;
        let is_against = is_moving && self.ground.is_against_traffic(state.x_m, state.y_m, state.yaw_rad);
        trip.against_ticks = if is_against { trip.against_ticks + 1 } else { 0 };
        let drove_against = trip.against_ticks == self.against_ticks;
        if !trip.over {
            self.counts.red_lights += u64::from(ran_red);
            self.counts.against_traffic += u64::from(drove_against);
        }
        let bits = if ran_red { RED_LIGHT } else { 0 } | if drove_against { AGAINST_TRAFFIC } else { 0 };
        if self.ends_at_infractions { bits } else { 0 }
    }

    /// The letter of the link at a stop line; `None` if its traffic light is not known.
    fn letter(&self, stop: &route::StopLine) -> Option<u8> {
        self.link(stop).map(|link| link.letter)
    }

    fn link(&self, stop: &route::StopLine) -> Option<&SignalLink> {
        self.signals.get(&stop.signal)?.get(stop.link as usize)
    }

    /// What a stop line's traffic light shows; `None` if it is not known.
    fn light(&self, stop: &route::StopLine) -> Option<ShownLight> {
        let link = self.link(stop)?;
        Some(ShownLight {
            letter: link.letter,
            shown_s: (self.ticks - link.since) as f64 * self.tick_s,
        })
    }

    /// Flags of a hero at the end of a tick: why its episode ends, and whether its action was refused.
    fn end_flags(&mut self, trip: &mut HeroTrip, state: &VehicleState, station_m: f64, infractions: u32) -> u32 {
        let counts = &mut self.counts;
        counts.episodes += u64::from(state.flags & APPEARED != 0);
        let on_road = [0.0, front_m(state)].iter().all(|ahead_m| {
            let [x_m, y_m] = ahead(state, *ahead_m);
            self.ground.is_on_road(x_m, y_m)
        });
        trip.off_road_ticks = if on_road { 0 } else { trip.off_road_ticks + 1 };
        trip.ticks += 1;
        let stands = state.velocity_body_mps[0] < STANDS_MPS;
        trip.standing_ticks = if stands { trip.standing_ticks + 1 } else { 0 };
        let has_route = trip.route.length_m() > 0.0;
        let refused = if std::mem::take(&mut trip.refused) {
            ACTION_REFUSED
        } else {
            0
        };
        let mut flags = refused | infractions;
        for (bit, holds) in [
            (OFF_ROAD, trip.off_road_ticks >= self.off_road_ticks),
            (
                BLOCKED,
                self.blocked_ticks.is_some_and(|limit| trip.standing_ticks >= limit),
            ),
            (
                ARRIVED,
                has_route && f64::from(trip.route.left_m(station_m + front_m(state))) <= ARRIVED_WITHIN_M,
            ),
        ] {
            flags |= if holds { bit } else { 0 };
        }
        // A hero whose episode has ended by itself is not cut by the time limit.
        if (flags | state.flags) & HERO_ENDS == 0 && trip.ticks >= self.time_limit_ticks {
            flags |= TIME_LIMIT;
        }
        let ends = (flags | state.flags) & HERO_ENDS;
        if ends != 0 && !std::mem::replace(&mut trip.over, true) {
            counts.collided += u64::from(ends & COLLIDED != 0);
            counts.off_road += u64::from(ends & OFF_ROAD != 0);
            counts.arrived += u64::from(ends & ARRIVED != 0);
            counts.blocked += u64::from(ends & BLOCKED != 0);
            counts.time_limit += u64::from(ends & TIME_LIMIT != 0);
        }
        flags
    }

    /// The view of the hero in `row` at `station_m` of its route.
    fn view(
        &self,
        route: &HeroRoute,
        station_m: f64,
        row: usize,
        (states, bodies): (&[VehicleState], &TickBodies),
    ) -> HeroView {
        let hero = &states[row];
        let (sin, cos) = libm::sincos(hero.yaw_rad);
        let seen = |[x, y]: [f64; 2]| {
            let (dx, dy) = (x - hero.x_m, y - hero.y_m);
            [(cos * dx + sin * dy) as f32, (cos * dy - sin * dx) as f32]
        };
        let straight = |ahead_m: f64| [hero.x_m + ahead_m * cos, hero.y_m + ahead_m * sin];
        let front_station_m = station_m + front_m(hero);
        let here = route
            .project([hero.x_m, hero.y_m], station_m, station_m)
            .unwrap_or_default();
        let (leader_gap_m, leader_speed_mps) = leader(route, station_m, row, (states, bodies));
        HeroView {
            route_m: ROUTE_AHEAD_M.map(|ahead_m| seen(route.at(station_m + ahead_m).unwrap_or(straight(ahead_m)))),
            speed_limit_mps: route.speed_limit_mps(station_m),
            route_offset_m: -here.left_m as f32,
            route_left_m: route.left_m(front_station_m),
            leader_gap_m: leader_gap_m as f32,
            leader_speed_mps: leader_speed_mps as f32,
            signal_gap_m: self.signal_gap_m(route, front_station_m) as f32,
            advised_accel_mps2: 0.0,
            vehicle: hero.vehicle,
            around: surroundings::HeroSurroundings {
                route,
                states,
                bodies,
                row,
                station_m,
                front_station_m,
            }
            .numbers(|stop| self.light(stop)),
        }
    }

    /// Distance to the next stop line whose signal is not green, metres.
    fn signal_gap_m(&self, route: &HeroRoute, front_station_m: f64) -> f64 {
        let is_closed = |stop: &&route::StopLine| matches!(self.letter(stop), Some(b'r' | b'R' | b'y' | b'Y' | b'u'));
        let ahead = |stop: &&route::StopLine| stop.station_m >= front_station_m;
        route
            .stop_lines()
            .iter()
            .filter(|stop| ahead(stop) && is_closed(stop))
            .map(|stop| stop.station_m - front_station_m)
            .fold(SIGHT_M, f64::min)
    }
}

impl HeroTrip {
    /// Follows the hero along its route; returns the station of its rear axle, metres.
    fn follow(&mut self, state: &VehicleState) -> f64 {
        let point = [state.x_m, state.y_m];
        let (from_m, to_m) = match self.station_m {
            Some(station_m) => (station_m - SEARCH_M[0], station_m + SEARCH_M[1]),
            None => (0.0, self.route.first_edge_m()),
        };
        if let Some(place) = self.route.project(point, from_m, to_m) {
            self.station_m = Some(place.station_m);
        }
        self.station_m.unwrap_or(0.0)
    }
}

/// Gap to and speed of the next body in the way of the hero in `row`: metres, m/s.
fn leader(
    route: &HeroRoute,
    station_m: f64,
    row: usize,
    (states, bodies): (&[VehicleState], &TickBodies),
) -> (f64, f64) {
    let hero = &states[row];
    let front_station_m = station_m + front_m(hero);
    let way = route.window(station_m, front_station_m + SIGHT_M);
    let mut found = (SIGHT_M, 0.0);
    // The part of the way on which a nearer one would be.
    let mut nearer = way.clone();
    let half_width_m = 0.5 * f64::from(hero.width_m);
    for (number, (middle_m, radius_m)) in bodies.discs().enumerate() {
        // Most are beside the way, or behind what was found. Its own trailing bodies are behind it.
        if !nearer.may_be_within(middle_m, radius_m + half_width_m)
            || number == row
            || is_trailing_body_of(&states[number], hero)
        {
            continue;
        }
        let body = bodies.body(number);
        let reach_m = SIGHT_M + f64::from(hero.length_m + body.length_m);
        if libm::hypot(body.origin_m[0] - hero.x_m, body.origin_m[1] - hero.y_m) > reach_m {
            continue;
        }
        let corridor_m = 0.5 * f64::from(hero.width_m + body.width_m) + SIDE_ROOM_M;
        // A person may step into the way ahead. One beside the hero waits until it has passed.
        let ahead_m = match body.is_person {
            true => corridor_m - SIDE_ROOM_M + PERSON_ROOM_M,
            false => corridor_m,
        };
        let in_the_way = body.spine_m.into_iter().filter_map(|point| {
            let place = way.project_within(point, ahead_m)?;
            let is_ahead = place.station_m > front_station_m;
            let is_beside = place.station_m > station_m + 0.5 * front_m(hero) && place.left_m.abs() < corridor_m;
            (is_ahead || is_beside).then_some(place)
        });
        for place in in_the_way {
            let gap_m = (place.station_m - front_station_m).max(0.0);
            if gap_m < found.0 {
                found = (gap_m, body.speed_along(place.direction));
                nearer = way.before(front_station_m + gap_m);
            }
        }
    }
    found
}

/// True if a state is that of a trailing body of a vehicle.
fn is_trailing_body_of(body: &VehicleState, vehicle: &VehicleState) -> bool {
    body.kind == Kind::Trailing as u32 && vehicle_of(body.vehicle) == vehicle.vehicle
}

/// From the rear axle to the front bumper, metres.
fn front_m(state: &VehicleState) -> f64 {
    f64::from(state.length_m - state.rear_overhang_m)
}

/// The point `ahead_m` in front of the origin.
fn ahead(state: &VehicleState, ahead_m: f64) -> [f64; 2] {
    let (sin, cos) = libm::sincos(state.yaw_rad);
    ahead_by(state, ahead_m, [sin, cos])
}

/// The same with sine and cosine of its heading.
fn ahead_by(state: &VehicleState, ahead_m: f64, [sin, cos]: [f64; 2]) -> [f64; 2] {
    [state.x_m + ahead_m * cos, state.y_m + ahead_m * sin]
}

fn pose(state: &VehicleState) -> EgoPose {
    let [front_x_m, front_y_m] = ahead(state, front_m(state));
    EgoPose {
        front_x_m,
        front_y_m,
        yaw_rad: state.yaw_rad,
        speed_mps: f64::from(state.velocity_body_mps[0]),
        accel_mps2: f64::from(state.accel_body_mps2[0]),
        vehicle: state.vehicle,
        flags: state.flags & HERO_ENDS,
    }
}

#[cfg(test)]
mod tests;
