//! One road user in the mirror: how it takes SUMO's states in and what it does in every tick between them.

use ipc_schema::{
    config,
    traffic::{DISCONTINUOUS, Kind, TrafficState, VehicleMeta},
    world::{APPEARED, RESYNCHRONISED, SubStep, VehicleState},
};

use crate::{
    attitude::{Lean, body_from_level},
    curve::Curve,
    dimensions::Dimensions,
    fleet::{Built, Fleet, FleetError},
    hero::{self, Hero},
    lanes::{Drive, Lanes},
    person::Person,
    reference::{Join, Path},
    rigid_body::RigidBody,
    tracking,
    trig::wrap_angle,
    vehicle::{Input, State},
};

/// Times of a run and limits of its vehicles.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Models of the vehicles and their limits.
    pub vehicle: config::Vehicle,
    /// What the road is covered with.
    pub surface: config::Surface,
    /// Length of a tick, seconds.
    pub tick_s: f64,
    /// Nano sub-steps in a tick.
    pub sub_steps: u32,
    /// Ticks in a SUMO step.
    pub ticks_per_step: u32,
}

impl Settings {
    /// The models of these settings.
    ///
    /// # Errors
    /// A class is given a model that does not exist.
    pub fn fleet(&self) -> Result<Fleet, FleetError> {
        Fleet::new(&self.vehicle, self.surface, self.sub_step_s())
    }

    /// Length of a sub-step, seconds.
    #[must_use]
    pub fn sub_step_s(&self) -> f64 {
        self.tick_s / f64::from(self.sub_steps)
    }

    /// Length of a SUMO step, seconds.
    #[must_use]
    pub fn step_s(&self) -> f64 {
        self.tick_s * f64::from(self.ticks_per_step)
    }
}

/// How a road user comes into the current SUMO step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arrival {
    /// It was there a step ago and moves on.
    Continuing,
    /// It was there a step ago and is set onto SUMO at the end of the step.
    Jumping,
    /// It is there from the end of the step on.
    Entering,
}

/// What moves a road user.
#[expect(
    clippy::large_enum_variant,
    reason = "nearly all road users are vehicles, and a box would cost each a cache miss"
)]
#[derive(Debug, Clone, Copy, PartialEq)]
enum Mover {
    /// A vehicle that tracks SUMO's front bumper.
    Vehicle { state: State, path: Path },
    /// A person, moved by SUMO alone.
    Person(Person),
    /// A vehicle that actions move; SUMO follows it.
    Hero(Hero),
}

/// One road user.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoadUser {
    id_hash: u64,
    /// Place of its model in the [`Fleet`].
    model: u32,
    dimensions: Dimensions,
    mover: Mover,
    before: TrafficState,
    now: TrafficState,
    /// Number of the last frame that had it; 0 = none yet.
    seen_frame: u64,
    arrival: Arrival,
    /// Not yet written to any tick.
    new: bool,
}

impl RoadUser {
    /// A road user that SUMO has announced.
    #[must_use]
    pub fn new(meta: &VehicleMeta, fleet: &mut Fleet) -> Self {
        let model = fleet.place(meta);
        let dimensions = fleet.at(model).dimensions;
        let mover = if meta.kind == Kind::Person as u32 {
            Mover::Person(Person::default())
        } else if meta.kind == Kind::Hero as u32 {
            Mover::Hero(Hero::default())
        } else {
            Mover::Vehicle {
                state: State::new(0.0, 0.0, 0.0, 0.0),
                path: Path::from_here(&TrafficState::default(), 0.0),
            }
        };
        Self {
            id_hash: meta.id_hash,
            model,
            dimensions,
            mover,
            before: TrafficState::default(),
            now: TrafficState::default(),
            seen_frame: 0,
            arrival: Arrival::Entering,
            new: true,
        }
    }

    /// Takes SUMO's state at the end of the step in frame number `frame` (counted from 1).
    pub fn accept(&mut self, now: &TrafficState, frame: u64, settings: &Settings) {
        let known = self.seen_frame != 0 && self.seen_frame + 1 == frame;
        (self.before, self.now, self.seen_frame) = (self.now, *now, frame);
        self.arrival = if !known {
            Arrival::Entering
        } else if now.flags & DISCONTINUOUS != 0 {
            Arrival::Jumping
        } else {
            Arrival::Continuing
        };
        match (&mut self.mover, self.arrival) {
            (_, Arrival::Entering) => {}
            // Wherever SUMO has put a hero: it is where its model has brought it.
            (Mover::Hero(_), _) => self.arrival = Arrival::Continuing,
            (Mover::Person(person), Arrival::Jumping) => person.coast(&self.before, settings.step_s()),
            (Mover::Person(person), Arrival::Continuing) => {
                person.advance(&self.before, &self.now, settings.step_s());
            }
            (Mover::Vehicle { path, .. }, Arrival::Jumping) => path.coast(&self.before, settings.step_s()),
            (Mover::Vehicle { path, .. }, Arrival::Continuing) => {
                if path.advance(&self.before, &self.now, self.dimensions.length_m, settings.step_s()) == Join::Broken {
                    path.coast(&self.before, settings.step_s());
                    self.arrival = Arrival::Jumping;
                }
            }
        }
    }

    /// What a hero is asked for from now on; others do not listen.
    pub fn ask(&mut self, input: Input) {
        if let Mover::Hero(hero) = &mut self.mover {
            hero.ask(input);
        }
    }

    /// True if the road user has a state in all ticks of the current SUMO step, not only in the last.
    #[must_use]
    pub fn is_in_whole_step(&self) -> bool {
        self.arrival != Arrival::Entering
    }

    /// True if the road user is a vehicle that moves through tick `tick` (0-based within the SUMO step) by itself: its tick
    /// goes through [`RoadUser::load`] and [`RoadUser::store`], any other's through [`RoadUser::write_unmoved`].
    #[must_use]
    pub fn moves(&self, tick: u32, settings: &Settings) -> bool {
        matches!(self.mover, Mover::Vehicle { .. }) && !self.is_set_in(tick, settings)
    }

    /// True if the road user is set onto SUMO at the end of this tick.
    fn is_set_in(&self, tick: u32, settings: &Settings) -> bool {
        self.arrival != Arrival::Continuing && tick + 1 == settings.ticks_per_step
    }

    /// Place of its model in the [`Fleet`].
    #[must_use]
    pub fn model(&self) -> u32 {
        self.model
    }

    /// Puts the vehicle into a lane for one tick.
    pub fn load<P: Drive<N>, const N: usize>(
        &mut self,
        tick: u32,
        settings: &Settings,
        params: &P,
        lanes: &mut Lanes<P, N>,
        lane: usize,
    ) {
        if let Mover::Vehicle { state, path } = &mut self.mover {
            let start_s = f64::from(tick) * settings.tick_s;
            let spread_s = settings.vehicle.lane_change_s;
            let curve = path.tick(start_s, settings.tick_s, state.speed_mps, spread_s, &params.ability());
            let rise = path.road(start_s).1;
            lanes.load(lane, params, state, (&curve, &rise), self.dimensions.front_m());
        }
    }

    /// Takes the vehicle out of its lane and writes the tick. Returns true if it has been set onto its path because it was
    /// too far away.
    pub fn store<P: Drive<N>, const N: usize>(
        &mut self,
        tick: u32,
        settings: &Settings,
        lanes: &Lanes<P, N>,
        lane: usize,
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) -> bool {
        self.describe(out);
        let front_m = self.dimensions.front_m();
        let Mover::Vehicle { state, path } = &mut self.mover else {
            return false;
        };
        *state = lanes.state(lane);
        let start_s = f64::from(tick) * settings.tick_s;
        let end_s = start_s + settings.tick_s;
        *state = state.settled();
        lanes.write(lane, rows);
        write_moved(state, lanes.road(lane), path.road(start_s).0, rows, out);
        out.reference_offset_m = path.offset_m(end_s, settings.step_s()) as f32;
        let target = lanes.curve(lane).at(settings.tick_s);
        let error = tracking::error(state, front_m, &target);
        let square = error.lateral_m * error.lateral_m + error.longitudinal_m * error.longitudinal_m;
        let limit = settings.vehicle.resynchronise_m;
        let lost = square > limit * limit || path.undriven_m() > settings.vehicle.leave_path_m;
        if lost {
            *state = set_onto(&path.resynchronise(end_s), front_m, path.heading_at(end_s));
            out.reference_offset_m = 0.0;
            write_set(state, path, end_s, front_m, out, rows);
        } else {
            out.tracking_lateral_m = error.lateral_m as f32;
            out.tracking_longitudinal_m = error.longitudinal_m as f32;
        }
        self.flag(lost, out)
    }

    /// Writes the tick of a person, or of a vehicle that is set onto SUMO in it. Returns true if a road user that was already
    /// there has been set.
    pub fn write_unmoved(
        &mut self,
        tick: u32,
        settings: &Settings,
        (built, body): (&Built, Option<&mut RigidBody>),
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) -> bool {
        self.describe(out);
        let set = self.is_set_in(tick, settings);
        match &mut self.mover {
            Mover::Person(person) => {
                if set {
                    person.set(&self.now, settings.step_s());
                }
                let start_s = f64::from(tick) * settings.tick_s;
                let left = if set {
                    0.0
                } else {
                    1.0 - (start_s + settings.tick_s) / settings.step_s()
                };
                let z_m = self.now.front_z_m - left * (self.now.front_z_m - self.before.front_z_m);
                person.write(start_s, settings, z_m, out, rows);
            }
            Mover::Hero(hero) => {
                let front_m = self.dimensions.front_m();
                if set {
                    hero.set(&self.now, front_m, out, rows);
                } else {
                    let road = [&self.before, &self.now];
                    let models = (&hero::model(built), body);
                    hero.advance(models, road, front_m, settings.sub_step_s(), out, rows);
                }
            }
            Mover::Vehicle { state, path } => {
                let front_m = self.dimensions.front_m();
                *path = Path::from_here(&self.now, settings.step_s());
                *state = set_onto(&path.start(), front_m, f64::from(self.now.yaw_rad));
                write_set(state, path, 0.0, front_m, out, rows);
            }
        }
        self.flag(set, out)
    }

    /// Flags the first tick and a set pose; returns true if the pose was set on a road user that was already there.
    fn flag(&mut self, set: bool, out: &mut VehicleState) -> bool {
        let appeared = std::mem::take(&mut self.new);
        out.flags = if appeared { APPEARED } else { 0 } | if set { RESYNCHRONISED } else { 0 };
        set && !appeared
    }

    fn describe(&self, out: &mut VehicleState) {
        let Dimensions {
            length_m,
            width_m,
            height_m,
            wheelbase_m,
            rear_overhang_m,
        } = self.dimensions;
        // Whatever lay there before.
        *out = VehicleState::default();
        out.id_hash = self.id_hash;
        out.vehicle = self.now.vehicle;
        out.kind = self.now.kind;
        out.signals = self.now.signals;
        out.length_m = length_m as f32;
        out.width_m = width_m as f32;
        out.height_m = height_m as f32;
        if !matches!(self.mover, Mover::Person(_)) {
            out.wheelbase_m = wheelbase_m as f32;
            out.rear_overhang_m = rear_overhang_m as f32;
        }
    }
}

/// Writes the state at the end of a tick: `road` is that of the lane (see [`Lanes::road`]), `height_m` that of the road under the
/// front bumper at the start of the tick.
fn write_moved(state: &State, road: [f64; 3], height_m: f64, rows: &[SubStep], out: &mut VehicleState) {
    let lean = Lean::of(state, road[2]);
    out.x_m = state.x_m;
    out.y_m = state.y_m;
    out.z_m = height_m + road[0];
    out.yaw_rad = state.yaw_rad;
    out.roll_rad = lean.roll_rad as f32;
    out.pitch_rad = lean.pitch_rad as f32;
    let velocity = [state.speed_mps, state.lateral_mps, road[1]];
    out.velocity_body_mps = body_from_level(&lean, velocity).map(|part| part as f32);
    out.road_wheel_angle_rad = state.road_wheel_angle_rad as f32;
    if let Some(last) = rows.last() {
        out.accel_body_mps2 = last.accel_body_mps2;
        out.angular_rate_body_radps = last.angular_rate_body_radps;
    }
}

/// A state with the front bumper at the start of the curve, rolling straight ahead.
fn set_onto(curve: &Curve, front_m: f64, yaw_rad: f64) -> State {
    let [vx, vy] = curve.cubic[0];
    let mut state = State::new(
        curve.start_m[0],
        curve.start_m[1],
        wrap_angle(yaw_rad),
        (vx * vx + vy * vy).sqrt(),
    );
    [state.x_m, state.y_m] = state.point_ahead(-front_m);
    state
}

/// Writes a state that was set, not reached: all sub-steps show it, nothing accelerates or turns. It stands on the road of its
/// path at `time_s`.
fn write_set(state: &State, path: &Path, time_s: f64, front_m: f64, out: &mut VehicleState, rows: &mut [SubStep]) {
    let (height_m, rise) = path.road(time_s);
    let [_, climb_mps, slope_rad, slope_rate] = rise.at(0.0);
    let lean = Lean {
        roll_rad: 0.0,
        pitch_rad: slope_rad,
    };
    let velocity = [state.speed_mps, 0.0, climb_mps - front_m * slope_rate];
    out.x_m = state.x_m;
    out.y_m = state.y_m;
    out.z_m = height_m - front_m * slope_rad;
    out.yaw_rad = state.yaw_rad;
    out.roll_rad = 0.0;
    out.pitch_rad = slope_rad as f32;
    out.velocity_body_mps = body_from_level(&lean, velocity).map(|part| part as f32);
    out.road_wheel_angle_rad = 0.0;
    out.accel_body_mps2 = [0.0; 3];
    out.angular_rate_body_radps = [0.0; 3];
    rows.fill(SubStep {
        pitch_rad: out.pitch_rad,
        speed_mps: state.speed_mps as f32,
        ..SubStep::default()
    });
}
