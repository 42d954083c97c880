//! One road user in the mirror: how it accepts SUMO's states and what it does in every tick between them.

use ipc_schema::{
    config::HeroDriver,
    traffic::{DISCONTINUOUS, Kind, TrafficState, VehicleMeta, class_number},
    world::{APPEARED, GUIDED, RESYNCHRONISED, SubStep, VehicleState},
};

use super::{
    batch::{BatchModel, VehicleBatch, path_limits},
    curve::{ReferenceCurve, ReferencePoint},
    departure::Departure,
    guidance::{self, NarrowTurn},
    hero::Hero,
    pace::PathLimits,
    person::Person,
    preview::PathAhead,
    reference::{LaneJump, PathJoin, ReferencePath},
    resynchronisation::{Guidance, Resynchronisation, ResynchronisationCause},
    settings::MirrorSettings,
    tracking,
};
use crate::{
    models::{
        attitude::{BodyLean, body_from_level},
        catalogue::{ModelCatalogue, SizedModel},
        dimensions::VehicleDimensions,
        rigid_body::RigidBody,
        state::{ControlInput, ModelState},
    },
    scene::shape::OrientedBox,
    trig::wrap_angle,
};

/// How a road user enters the current SUMO step.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Arrival {
    /// It existed a step ago and keeps moving.
    Continuing,
    /// It existed a step ago and is set to SUMO's state at the end of the step.
    Jumping(ResynchronisationCause),
    /// It exists from the end of the step on.
    Entering,
}

/// The model or source that moves a road user.
#[expect(
    clippy::large_enum_variant,
    reason = "nearly all road users are vehicles, and a box would cost each a cache miss"
)]
#[derive(Debug, Clone, Copy, PartialEq)]
enum Mover {
    /// A vehicle that tracks SUMO's front bumper.
    Vehicle { state: ModelState, path: ReferencePath },
    /// A person, which SUMO alone moves.
    Person(Person),
    /// A vehicle that actions move; SUMO follows it.
    Hero(Hero),
}

/// What guidance keeps of a vehicle.
#[derive(Debug, Clone, Copy, PartialEq)]
struct GuidedVehicle {
    cause: ResynchronisationCause,
    /// Its distance from the path when guidance began, metres.
    away_m: f32,
    /// By how much its heading and the rate differ from SUMO's, rad and rad/s.
    turned: [f64; 2],
}

/// One road user.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RoadUser {
    id_hash: u64,
    /// Suites of sensors that it may carry, as flags.
    suites: u32,
    /// Index of its model in the [`ModelCatalogue`].
    model: u32,
    /// SUMO's vehicle class, by its number.
    class: u16,
    dimensions: VehicleDimensions,
    /// Steering-wheel angle by road-wheel angle; 0 for a person.
    steering_ratio: f32,
    mover: Mover,
    before: TrafficState,
    now: TrafficState,
    /// Distance of the path that it follows from SUMO's own, metres.
    deviation_m: f32,
    /// Whether that path is narrower here than its turning circle.
    narrow: NarrowTurn,
    /// It is led along its path.
    guided: Option<GuidedVehicle>,
    /// Number of the last frame that had it; 0 = none yet.
    seen_frame: u64,
    /// Frames until its mirror appears: where the road user enters, the others' mirrors are that many frames late.
    hidden: usize,
    arrival: Arrival,
    /// Not yet written to any tick.
    new: bool,
}

impl RoadUser {
    /// A road user that SUMO has announced.
    #[must_use]
    pub fn new(meta: &VehicleMeta, catalogue: &mut ModelCatalogue, settings: &MirrorSettings) -> Self {
        let model = catalogue.index_for(meta);
        let SizedModel {
            dimensions,
            steering_ratio,
            ..
        } = *catalogue.at(model);
        let mover = if meta.kind == Kind::Person as u32 {
            Mover::Person(Person::default())
        } else if meta.kind == Kind::Hero as u32 && settings.hero_driver == HeroDriver::Actions {
            Mover::Hero(Hero::default())
        } else {
            Mover::Vehicle {
                state: ModelState::new(0.0, 0.0, 0.0, 0.0),
                path: ReferencePath::from_here(&TrafficState::default(), 0.0),
            }
        };
        Self {
            id_hash: meta.id_hash,
            suites: settings.suites.as_ref().map_or(0, |rules| rules.flags_of(meta)),
            model,
            class: class_number(&meta.class_text()),
            dimensions,
            steering_ratio: match mover {
                Mover::Person(_) => 0.0,
                Mover::Vehicle { .. } | Mover::Hero(_) => steering_ratio as f32,
            },
            mover,
            before: TrafficState::default(),
            now: TrafficState::default(),
            deviation_m: 0.0,
            narrow: NarrowTurn::None,
            guided: None,
            seen_frame: 0,
            hidden: 0,
            arrival: Arrival::Entering,
            new: true,
        }
    }

    /// Takes SUMO's state at the end of the step in frame number `frame` (counted from 1). With a path ahead the road user follows that,
    /// within what its model can do.
    pub fn accept(
        &mut self,
        now: &TrafficState,
        frame: u64,
        ahead: Option<(&mut PathAhead, &PathLimits)>,
        settings: &MirrorSettings,
    ) {
        let known = self.seen_frame != 0 && self.seen_frame + 1 == frame;
        self.seen_frame = frame;
        self.arrival = if !known {
            Arrival::Entering
        } else if now.flags & DISCONTINUOUS != 0 {
            Arrival::Jumping(ResynchronisationCause::MovedBySumo)
        } else {
            Arrival::Continuing
        };
        let lane_change_m = match ahead {
            // The hero is where its own model is, and its driver sees the others there.
            Some(ahead) if !matches!(self.mover, Mover::Hero(_)) => self.follow(now, ahead, settings.step_s()),
            _ => {
                (self.before, self.now) = (self.now, *now);
                None
            }
        };
        match (&mut self.mover, self.arrival) {
            (_, Arrival::Entering) => {}
            // SUMO's position of a hero does not matter: its model decides where it is.
            (Mover::Hero(_), _) => self.arrival = Arrival::Continuing,
            (Mover::Person(person), Arrival::Jumping(_)) => person.coast(&self.before, settings.step_s()),
            (Mover::Person(person), Arrival::Continuing) => {
                person.advance(&self.before, &self.now, settings.step_s());
            }
            (Mover::Vehicle { path, .. }, Arrival::Jumping(_)) => path.coast(&self.before, settings.step_s()),
            (Mover::Vehicle { path, .. }, Arrival::Continuing) => {
                if let Some(left_m) = lane_change_m {
                    path.change_lane_ahead(left_m);
                }
                if path.advance(
                    &self.before,
                    &self.now,
                    self.dimensions.whole_length_m,
                    settings.step_s(),
                ) == PathJoin::Broken
                {
                    path.coast(&self.before, settings.step_s());
                    self.arrival = Arrival::Jumping(ResynchronisationCause::ImpossibleStep);
                }
            }
        }
    }

    /// Takes the state into the path ahead, and the mirror's place on it as the state that the road user follows. Returns the lane change
    /// in this step, metres to the left. A step that no vehicle can drive is a jump, and the path begins anew.
    fn follow(
        &mut self,
        now: &TrafficState,
        (path, limits): (&mut PathAhead, &PathLimits),
        step_s: f64,
    ) -> Option<f64> {
        let limits = match self.mover {
            Mover::Vehicle { .. } => Some(limits),
            Mover::Person(_) | Mover::Hero(_) => None,
        };
        let step = match self.arrival {
            Arrival::Continuing => {
                self.before = self.now;
                path.advance(now, self.dimensions.whole_length_m, limits, step_s, &mut self.now)
            }
            Arrival::Entering | Arrival::Jumping(_) => None,
        };
        let Some(step) = step else {
            if self.arrival == Arrival::Continuing {
                self.arrival = Arrival::Jumping(ResynchronisationCause::ImpossibleStep);
            }
            (self.before, self.now) = (self.now, path.restart(now, step_s));
            self.deviation_m = 0.0;
            if self.arrival == Arrival::Entering {
                self.hidden = path.delay();
            }
            return None;
        };
        if self.hidden > 0 {
            self.hidden -= 1;
            self.arrival = Arrival::Entering;
        }
        if let Some(LaneJump { vector_m, .. }) = step.lane_change {
            self.before.front_x_m += vector_m[0];
            self.before.front_y_m += vector_m[1];
        }
        self.deviation_m = path.deviation_m() as f32;
        self.narrow = match (path.is_narrow(), path.turns_narrowly()) {
            (false, _) => NarrowTurn::None,
            (true, false) => NarrowTurn::Near,
            (true, true) => NarrowTurn::Begins,
        };
        step.lane_change.map(|jump| jump.left_m)
    }

    /// By how much the mirror that `out` describes is not where SUMO has it.
    #[must_use]
    pub fn departure(&self, ahead: Option<&PathAhead>, out: &VehicleState) -> Departure {
        let Mover::Vehicle { path, .. } = &self.mover else {
            return Departure::default();
        };
        Departure {
            is_led: out.flags & GUIDED != 0,
            lane_change_m: path.lane_change_m(),
            late_m: ahead.map_or(0.0, PathAhead::late_m),
            path_m: f64::from(self.deviation_m) + path.undriven_m(),
            tracking_m: libm::hypot(out.tracking_lateral_m.into(), out.tracking_longitudinal_m.into()),
        }
    }

    /// The boxes in which SUMO has it at the mirror's time, a frame more or less, newest first.
    pub fn sumo_boxes(&self, ahead: Option<&PathAhead>) -> Vec<OrientedBox> {
        let VehicleDimensions {
            whole_length_m: length_m,
            width_m,
            height_m,
            ..
        } = self.dimensions;
        let solid = |state: &TrafficState| {
            let (sin, cos) = libm::sincos(f64::from(state.yaw_rad));
            OrientedBox {
                centre_m: [
                    state.front_x_m - 0.5 * length_m * cos,
                    state.front_y_m - 0.5 * length_m * sin,
                ],
                along: [cos, sin],
                half_m: [0.5 * length_m, 0.5 * width_m],
                z_m: [state.front_z_m, state.front_z_m + height_m],
            }
        };
        match ahead {
            Some(path) => path.delayed().map(solid).collect(),
            None => [self.now, self.before].iter().map(solid).collect(),
        }
    }

    /// Sets the control input of a hero from now on; other road users ignore it.
    pub fn set_input(&mut self, input: ControlInput) {
        if let Mover::Hero(hero) = &mut self.mover {
            hero.set_input(input);
        }
    }

    /// True if the road user is in SUMO, but its mirror is not yet in the world.
    #[must_use]
    pub fn is_hidden(&self) -> bool {
        self.hidden > 0
    }

    /// True for a hero.
    #[must_use]
    pub fn is_hero(&self) -> bool {
        self.now.kind == Kind::Hero as u32
    }

    /// True if the road user has a state in all ticks of the current SUMO step, not only in the last.
    #[must_use]
    pub fn is_in_whole_step(&self) -> bool {
        self.arrival != Arrival::Entering
    }

    /// True if the road user is a vehicle that moves through tick `tick` (0-based within the SUMO step) by itself: its tick
    /// takes [`RoadUser::load`] and [`RoadUser::store`], any other [`RoadUser::write_unmoved`].
    #[must_use]
    pub fn moves(&self, tick: u32, settings: &MirrorSettings) -> bool {
        matches!(self.mover, Mover::Vehicle { .. }) && self.guided.is_none() && !self.is_set_in(tick, settings)
    }

    /// True if the road user is set to SUMO's state at the end of this tick.
    fn is_set_in(&self, tick: u32, settings: &MirrorSettings) -> bool {
        self.arrival != Arrival::Continuing && tick + 1 == settings.ticks_per_step
    }

    /// Index of its model in the [`ModelCatalogue`].
    #[must_use]
    pub fn model(&self) -> u32 {
        self.model
    }

    /// Loads the vehicle into a batch for one tick.
    pub fn load<P: BatchModel<N>, const N: usize>(
        &mut self,
        tick: u32,
        settings: &MirrorSettings,
        params: &P,
        batch: &mut VehicleBatch<P, N>,
        member: usize,
    ) {
        if let Mover::Vehicle { state, path } = &mut self.mover {
            let start_s = f64::from(tick) * settings.tick_s;
            let spread_s = settings.vehicle.lane_change_s;
            batch.set_model(member, self.model, params, settings.vehicle.preview_s > 0.0);
            let limits = batch.limits(member);
            let curve = path.tick(start_s, settings.tick_s, state.speed_mps, spread_s, limits);
            let rise = path.road(start_s).1;
            batch.load(member, state, (&curve, &rise), self.dimensions.front_m());
        }
    }

    /// Takes the vehicle from its batch and writes the tick, whose sub-steps the batch has written. Returns the jump if the vehicle was set to its path because it was too far
    /// away. A vehicle with a path ahead is led from then on instead ([`GUIDED`]).
    pub fn store<P: BatchModel<N>, const N: usize>(
        &mut self,
        tick: u32,
        settings: &MirrorSettings,
        batch: &VehicleBatch<P, N>,
        member: usize,
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) -> Option<Resynchronisation> {
        self.describe(out);
        let front_m = self.dimensions.front_m();
        let Mover::Vehicle { state, path } = &mut self.mover else {
            return None;
        };
        // At once: a processor waits if it loads as a vector what it has just stored number by number.
        *state = batch.state(member).settled();
        let start_s = f64::from(tick) * settings.tick_s;
        let end_s = start_s + settings.tick_s;
        let road = batch.road(member);
        write_moved(state, road, path.road(start_s).0, rows, out);
        // Only their own sensors read it.
        if settings.wheel_slip && out.kind != Kind::Other as u32 {
            out.rear_wheel_slip = batch.params(member).rear_wheel_slip(state, road[2]) as f32;
        }
        out.reference_offset_m = path.offset_m(end_s, settings.step_s()) as f32 + self.deviation_m;
        let target = batch.curve(member).at(settings.tick_s);
        let error = tracking::error(state, front_m, &target);
        let square = error.lateral_m * error.lateral_m + error.longitudinal_m * error.longitudinal_m;
        let undriven_m = path.undriven_m();
        if settings.vehicle.preview_s > 0.0 {
            let away_m = [square.sqrt(), undriven_m];
            if let Some(cause) = guidance::cause(state, away_m, path.lane_change_m(), self.narrow) {
                self.guided = Some(GuidedVehicle {
                    cause,
                    away_m: (away_m[0] + away_m[1]) as f32,
                    turned: begin_guidance(state, path, front_m, &target, end_s),
                });
            }
        }
        let limit = settings.vehicle.resynchronise_m;
        let lost = if self.guided.is_some() {
            None
        } else if square > limit * limit {
            Some(ResynchronisationCause::TrackingError)
        } else if undriven_m > settings.vehicle.leave_path_m {
            Some(ResynchronisationCause::LeftPath)
        } else {
            None
        };
        let lost = lost.map(|cause| match self.narrow {
            NarrowTurn::None => cause,
            NarrowTurn::Near | NarrowTurn::Begins => ResynchronisationCause::NarrowTurn,
        });
        let mut jump_m = 0.0;
        if lost.is_some() {
            let before = (state.x_m, state.y_m);
            *state = set_onto(&path.resynchronise(end_s), front_m, path.heading_at(end_s));
            jump_m = distance_m(before, (state.x_m, state.y_m));
            out.reference_offset_m = 0.0;
            write_set(state, path, end_s, front_m, out, rows);
        } else {
            out.tracking_lateral_m = error.lateral_m as f32;
            out.tracking_longitudinal_m = error.longitudinal_m as f32;
        }
        let set = self.flag(lost, jump_m, out);
        if self.guided.is_some() {
            out.flags |= GUIDED;
        }
        set
    }

    /// The guidance that began in the tick that [`RoadUser::store`] has written.
    #[must_use]
    pub fn guidance(&self, out: &VehicleState) -> Option<Guidance> {
        self.guided.map(|guided| Guidance {
            vehicle: out.vehicle,
            cause: guided.cause,
            position_m: [out.x_m, out.y_m, out.z_m],
            away_m: guided.away_m.into(),
        })
    }

    /// Writes the tick of a person, a hero or a guided vehicle, or of a vehicle that is set to SUMO's state in it. Returns the jump of
    /// a road user that already existed.
    pub fn write_unmoved(
        &mut self,
        tick: u32,
        settings: &MirrorSettings,
        (built, body): (&SizedModel, Option<&mut RigidBody>),
        out: &mut VehicleState,
        rows: &mut [SubStep],
    ) -> Option<Resynchronisation> {
        self.describe(out);
        let (set, was_guided) = (self.is_set_in(tick, settings), self.guided.is_some());
        let mut before = (self.before.front_x_m, self.before.front_y_m);
        let mut now = (self.now.front_x_m, self.now.front_y_m);
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
                    let models = (&built.model, body);
                    hero.advance(models, road, front_m, settings.sub_step_s(), out, rows);
                    if settings.wheel_slip {
                        out.rear_wheel_slip = hero.rear_wheel_slip(&built.model, self.now.pitch_rad.into()) as f32;
                    }
                }
            }
            Mover::Vehicle { state, path } if !set => {
                let (start_s, end_s) = (f64::from(tick) * settings.tick_s, f64::from(tick + 1) * settings.tick_s);
                let guided = path.guided_tick(start_s, settings.tick_s, settings.vehicle.lane_change_s);
                let height_m = path.road(start_s).0;
                if let Some(vehicle) = &mut self.guided {
                    let road = guidance::lead(state, &mut vehicle.turned, &guided, built, settings.sub_step_s(), rows);
                    write_moved(state, road, height_m, rows, out);
                }
                out.reference_offset_m = path.offset_m(end_s, settings.step_s()) as f32 + self.deviation_m;
                let away_m = path.undriven_m() + path.lane_change_m();
                if guidance::ends(state, away_m, self.narrow != NarrowTurn::None, &path_limits(built)) {
                    self.guided = None;
                }
            }
            Mover::Vehicle { state, path } => {
                self.guided = None;
                let front_m = self.dimensions.front_m();
                *path = ReferencePath::from_here(&self.now, settings.step_s());
                before = (state.x_m, state.y_m);
                *state = set_onto(&path.start(), front_m, f64::from(self.now.yaw_rad));
                now = (state.x_m, state.y_m);
                write_set(state, path, 0.0, front_m, out, rows);
            }
        }
        let cause = match self.arrival {
            _ if !set => None,
            Arrival::Jumping(cause) => Some(cause),
            Arrival::Entering | Arrival::Continuing => Some(ResynchronisationCause::Returned),
        };
        let set = self.flag(cause, distance_m(before, now), out);
        if was_guided && cause.is_none() {
            out.flags |= GUIDED;
        }
        set
    }

    /// Flags the first tick and a set pose; returns the jump of a road user that already existed.
    fn flag(
        &mut self,
        set: Option<ResynchronisationCause>,
        jump_m: f64,
        out: &mut VehicleState,
    ) -> Option<Resynchronisation> {
        let appeared = std::mem::take(&mut self.new);
        out.flags = self.suites;
        out.flags |= if appeared { APPEARED } else { 0 } | if set.is_some() { RESYNCHRONISED } else { 0 };
        set.filter(|_| !appeared).map(|cause| Resynchronisation {
            vehicle: out.vehicle,
            cause,
            position_m: [out.x_m, out.y_m, out.z_m],
            jump_m,
        })
    }

    fn describe(&self, out: &mut VehicleState) {
        let VehicleDimensions {
            length_m,
            width_m,
            height_m,
            wheelbase_m,
            rear_overhang_m,
            whole_length_m,
        } = self.dimensions;
        // Overwrites whatever the loan of shared memory contained.
        *out = VehicleState::default();
        out.id_hash = self.id_hash;
        out.vehicle = self.now.vehicle;
        (out.kind, out.class) = (self.now.kind, self.class);
        out.signals = self.now.signals;
        out.steering_ratio = self.steering_ratio;
        out.length_m = length_m as f32;
        out.width_m = width_m as f32;
        out.height_m = height_m as f32;
        out.whole_length_m = whole_length_m as f32;
        if !matches!(self.mover, Mover::Person(_)) {
            out.wheelbase_m = wheelbase_m as f32;
            out.rear_overhang_m = rear_overhang_m as f32;
        }
    }
}

/// Moves the reference of a vehicle onto its front bumper, whose own reference is `target`. Returns by how much its heading and the rate
/// differ from SUMO's at `end_s`, rad and rad/s.
#[cold]
fn begin_guidance(
    state: &ModelState,
    path: &mut ReferencePath,
    front_m: f64,
    target: &ReferencePoint,
    end_s: f64,
) -> [f64; 2] {
    let front = state.point_ahead(front_m);
    let across = state.lateral_mps + front_m * state.yaw_rate_radps;
    let [cos, sin] = state.heading;
    let velocity = [
        state.speed_mps * cos - across * sin,
        state.speed_mps * sin + across * cos,
    ];
    let [away, leaving] = [(front, target.position_m), (velocity, target.velocity_mps)]
        .map(|(ours, its)| [ours[0] - its[0], ours[1] - its[1]]);
    path.move_reference(target, away, leaving);
    path.turned_from(end_s, [state.yaw_rad, state.yaw_rate_radps])
}

fn distance_m(from: (f64, f64), to: (f64, f64)) -> f64 {
    libm::hypot(to.0 - from.0, to.1 - from.1)
}

/// Writes the state at the end of a tick: `road` is that of the lane (see [`VehicleBatch::road`]), `height_m` that of the road under the
/// front bumper at the start of the tick.
fn write_moved(state: &ModelState, road: [f64; 3], height_m: f64, rows: &[SubStep], out: &mut VehicleState) {
    let lean = BodyLean::of(state, road[2]);
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
fn set_onto(curve: &ReferenceCurve, front_m: f64, yaw_rad: f64) -> ModelState {
    let [vx, vy] = curve.cubic[0];
    let mut state = ModelState::new(
        curve.start_m[0],
        curve.start_m[1],
        wrap_angle(yaw_rad),
        (vx * vx + vy * vy).sqrt(),
    );
    [state.x_m, state.y_m] = state.point_ahead(-front_m);
    state
}

/// Writes a state that was set, not reached by moving: all sub-steps show it, without acceleration or rotation. The vehicle stands
/// on the road of its path at `time_s`.
fn write_set(
    state: &ModelState,
    path: &ReferencePath,
    time_s: f64,
    front_m: f64,
    out: &mut VehicleState,
    rows: &mut [SubStep],
) {
    let (height_m, rise) = path.road(time_s);
    let [_, climb_mps, slope_rad, slope_rate] = rise.at(0.0);
    let lean = BodyLean {
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
