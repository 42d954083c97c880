//! One road user in the mirror: how it takes SUMO's states in and what it does in every tick between them.

use ipc_schema::{
    config,
    traffic::{DISCONTINUOUS, Kind, TrafficState, VehicleMeta},
    world::{APPEARED, RESYNCHRONISED, SubStep, VehicleState},
};

use crate::{
    curve::Curve,
    dimensions::Dimensions,
    hero::{self, Hero},
    lanes::Lanes,
    person::Person,
    reference::{Join, Path},
    tracking,
    trig::wrap_angle,
    vehicle::{Input, State},
};

/// Times of a run and limits of its vehicles.
#[derive(Debug, Clone, PartialEq)]
pub struct Settings {
    /// Limits of the vehicle model.
    pub vehicle: config::Vehicle,
    /// Length of a tick, seconds.
    pub tick_s: f64,
    /// Nano sub-steps in a tick.
    pub sub_steps: u32,
    /// Ticks in a SUMO step.
    pub ticks_per_step: u32,
}

impl Settings {
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
    pub fn new(meta: &VehicleMeta) -> Self {
        let [length, width, height] = [meta.length_m, meta.width_m, meta.height_m].map(f64::from);
        let dimensions = Dimensions::new(&meta.vehicle_class, length, width, height);
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

    /// Puts the vehicle into a lane for one tick.
    pub fn load(&mut self, tick: u32, settings: &Settings, lanes: &mut Lanes, lane: usize) {
        if let Mover::Vehicle { state, path } = &mut self.mover {
            let curve = path.tick(f64::from(tick) * settings.tick_s, settings.tick_s, state.speed_mps);
            lanes.load(
                lane,
                state,
                &curve,
                self.dimensions.front_m(),
                self.dimensions.wheelbase_m,
            );
        }
    }

    /// Takes the vehicle out of its lane and writes the tick. Returns true if it has been set onto its path because it was
    /// too far away.
    pub fn store(
        &mut self,
        tick: u32,
        settings: &Settings,
        lanes: &Lanes,
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
        write_rows(state, lanes, lane, rows);
        *state = state.settled();
        write_state(state, out);
        if let Some(last) = rows.last() {
            out.accel_body_mps2 = last.accel_body_mps2;
            out.angular_rate_body_radps = last.angular_rate_body_radps;
        }
        let end_s = f64::from(tick + 1) * settings.tick_s;
        let target = lanes.curve(lane).at(settings.tick_s);
        let error = tracking::error(state, front_m, &target);
        let square = error.lateral_m * error.lateral_m + error.longitudinal_m * error.longitudinal_m;
        let limit = settings.vehicle.resynchronise_m;
        let lost = square > limit * limit;
        if lost {
            let curve = Curve::straight(target.position_m, target.velocity_mps);
            *state = set_onto(&curve, front_m, path.heading_at(end_s));
            write_set(state, out, rows);
        } else {
            out.tracking_lateral_m = error.lateral_m as f32;
            out.tracking_longitudinal_m = error.longitudinal_m as f32;
        }
        write_road(
            &self.before,
            &self.now,
            end_s / settings.step_s(),
            settings,
            front_m,
            out,
            rows,
        );
        self.flag(lost, out)
    }

    /// Writes the tick of a person, or of a vehicle that is set onto SUMO in it. Returns true if a road user that was already
    /// there has been set.
    pub fn write_unmoved(
        &mut self,
        tick: u32,
        settings: &Settings,
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
                    self.before = self.now;
                } else {
                    let model = hero::model(settings, &self.dimensions);
                    hero.advance(&model, settings.sub_step_s(), out, rows);
                }
                write_road(&self.before, &self.now, 1.0, settings, front_m, out, rows);
            }
            Mover::Vehicle { state, path } => {
                let front_m = self.dimensions.front_m();
                *path = Path::from_here(&self.now, settings.step_s());
                *state = set_onto(
                    &path.tick(0.0, settings.tick_s, 0.0),
                    front_m,
                    f64::from(self.now.yaw_rad),
                );
                write_set(state, out, rows);
                write_road(&self.now, &self.now, 1.0, settings, front_m, out, rows);
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

/// Writes the sub-steps of a lane, relative to the state at the end of the tick.
fn write_rows(end: &State, lanes: &Lanes, lane: usize, rows: &mut [SubStep]) {
    for (row, moved) in rows.iter_mut().zip(&lanes.rows) {
        *row = SubStep {
            dx_m: (moved.x_m[lane] - end.x_m) as f32,
            dy_m: (moved.y_m[lane] - end.y_m) as f32,
            dyaw_rad: (moved.yaw_rad[lane] - end.yaw_rad) as f32,
            speed_mps: moved.speed_mps[lane] as f32,
            accel_body_mps2: [moved.accel_x_mps2[lane] as f32, moved.accel_y_mps2[lane] as f32, 0.0],
            angular_rate_body_radps: [0.0, 0.0, moved.yaw_rate_radps[lane] as f32],
            road_wheel_angle_rad: moved.road_wheel_angle_rad[lane] as f32,
            ..SubStep::default()
        };
    }
}

fn write_state(state: &State, out: &mut VehicleState) {
    out.x_m = state.x_m;
    out.y_m = state.y_m;
    out.yaw_rad = state.yaw_rad;
    out.velocity_body_mps = [state.speed_mps as f32, 0.0, 0.0];
    out.road_wheel_angle_rad = state.road_wheel_angle_rad as f32;
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

/// Writes a state that was set, not reached: all sub-steps show it, nothing accelerates or turns.
fn write_set(state: &State, out: &mut VehicleState, rows: &mut [SubStep]) {
    write_state(state, out);
    out.accel_body_mps2 = [0.0; 3];
    out.angular_rate_body_radps = [0.0; 3];
    rows.fill(SubStep {
        speed_mps: state.speed_mps as f32,
        ..SubStep::default()
    });
}

/// Height and slope follow the road, linearly over the SUMO step (`share` of it is done).
fn write_road(
    before: &TrafficState,
    now: &TrafficState,
    share: f64,
    settings: &Settings,
    front_m: f64,
    out: &mut VehicleState,
    rows: &mut [SubStep],
) {
    let slope_change = f64::from(now.pitch_rad) - f64::from(before.pitch_rad);
    let pitch = f64::from(now.pitch_rad) - (1.0 - share) * slope_change;
    let front_z = now.front_z_m - (1.0 - share) * (now.front_z_m - before.front_z_m);
    out.pitch_rad = pitch as f32;
    out.z_m = front_z;
    if pitch == 0.0 && slope_change == 0.0 {
        return;
    }
    out.z_m = front_z - front_m * libm::tan(pitch);
    // Nose up is a rotation about the body's right, so its rate about the left is negative.
    let rate = (-slope_change / settings.step_s()) as f32;
    out.angular_rate_body_radps[1] = rate;
    rows.iter_mut().for_each(|row| row.angular_rate_body_radps[1] = rate);
}
