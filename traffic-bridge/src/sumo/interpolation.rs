//! The frames between two of SUMO's steps, where SUMO steps more slowly than a mirror needs.
//!
//! In a second a vehicle drives through a whole junction: the straight line between its two positions cuts the corner. It moves along
//! the lanes instead, evenly, as SUMO means it: the speed at the end of a step holds for the whole step. What its positions are beside the
//! centre lines (sublanes) is kept. A change of lanes on a road stays a jump from one frame to the next; at a junction it is driven evenly.

use ipc_schema::{
    lane_position::{LanePosition, NO_INDEX},
    traffic::{DISCONTINUOUS, Kind, TrafficState},
};

use super::{
    convention::single,
    frame::TrafficFrame,
    lanes::{LaneGraph, LanePlace, LaneSwitch, LaneWay},
};

/// Sideways distance that SUMO does not drive within a lane: a change of lanes, metres.
const LANE_JUMP_M: f64 = 1.0;
/// How much longer than the distance at its speed a way may be, as a factor and metres.
const DETOUR: (f64, f64) = (1.5, 5.0);

/// A vehicle's place on the lanes, and its length.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct VehiclePlace {
    /// `None`: it is on no lane.
    pub lane: Option<LanePlace>,
    /// Of the body, metres.
    pub length_m: f64,
}

/// A road user at the end of a step.
#[derive(Debug, Clone, Copy)]
struct PlacedState {
    state: TrafficState,
    place: VehiclePlace,
}

/// What a road user does in a step.
#[derive(Debug, Clone)]
enum StepMotion {
    /// It drives along lanes, beside their centre lines by so much at the beginning and at the end.
    Lanes { way: LaneWay, beside: [LaneOffset; 2] },
    /// It moves straight ahead to the position at the end.
    Straight { to: TrafficState },
    /// It continues at its speed, because it will be elsewhere at the end of the step.
    Coast,
    /// It leaves the net during the step, at the end of its lane.
    RollOut { way: LaneWay },
}

/// A road user of the step before, and its motion since.
#[derive(Debug, Clone)]
struct MovingState {
    from: TrafficState,
    length_m: f64,
    motion: StepMotion,
}

/// The place of a vehicle relative to its lane's centre line, metres.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
struct LaneOffset {
    ahead: f64,
    left: f64,
    up: f64,
}

/// Makes the frames between two steps.
#[derive(Debug)]
pub struct StepInterpolation {
    lanes: LaneGraph,
    /// Frames in a step.
    frames: u64,
    step_s: f64,
    before: Vec<PlacedState>,
    /// [`TrafficFrame::positions`] of the step before and of this one.
    positions: [Vec<LanePosition>; 2],
    moving: Vec<MovingState>,
}

impl StepInterpolation {
    /// For steps of `step_s` with `frames` frames each.
    #[must_use]
    pub fn new(lanes: LaneGraph, frames: u64, step_s: f64) -> Self {
        Self {
            lanes,
            frames,
            step_s,
            before: Vec::new(),
            positions: [Vec::new(), Vec::new()],
            moving: Vec::new(),
        }
    }

    /// Takes the next step of SUMO.
    pub fn take_step(&mut self, frame: &TrafficFrame) {
        self.moving.clear();
        let mut steps = frame.states.iter().zip(&frame.places).peekable();
        // Both are in ascending order of the index.
        for before in &self.before {
            let now = loop {
                match steps.peek() {
                    Some((state, _)) if state.vehicle < before.state.vehicle => {
                        steps.next();
                    }
                    Some((state, _)) if state.vehicle == before.state.vehicle => break steps.next(),
                    _ => break None,
                }
            };
            let motion = match now {
                Some((state, place)) => Some(motion(&self.lanes, self.step_s, before, state, place)),
                None => roll_out(&self.lanes, before),
            };
            if let Some(motion) = motion {
                self.moving.push(MovingState {
                    from: before.state,
                    length_m: before.place.length_m,
                    motion,
                });
            }
        }
        self.before.clear();
        let placed = frame.states.iter().zip(&frame.places);
        self.before
            .extend(placed.map(|(&state, &place)| PlacedState { state, place }));
        self.positions.swap(0, 1);
        self.positions[1].clone_from(&frame.positions);
    }

    /// Fills `frame` with the road users of frame number `number` of the step, counted from 1. The last frame is SUMO's own.
    pub fn fill(&self, number: u64, frame: &mut TrafficFrame) {
        frame.events.clear();
        frame.signals.clear();
        frame.states.clear();
        frame.places.clear();
        frame.positions.clear();
        frame.cavs = 0;
        let share = number as f64 / self.frames as f64;
        for moving in &self.moving {
            if let Some(state) = self.state(moving, share) {
                frame.cavs += u32::from(state.kind == Kind::Cav as u32 || state.kind == Kind::Hero as u32);
                frame.states.push(state);
            }
        }
        self.fill_positions(share, &mut frame.positions);
    }

    /// The road users in SUMO's terms after a share of the step.
    fn fill_positions(&self, share: f64, positions: &mut Vec<LanePosition>) {
        let [before, now] = &self.positions;
        // All are in ascending order of the index.
        let (mut moving, mut now) = (self.moving.iter().peekable(), now.iter().peekable());
        for from in before {
            while moving.next_if(|moving| moving.from.vehicle < from.vehicle).is_some() {}
            while now.next_if(|now| now.vehicle < from.vehicle).is_some() {}
            let to = now.next_if(|now| now.vehicle == from.vehicle);
            match moving.next_if(|moving| moving.from.vehicle == from.vehicle) {
                Some(moving) => positions.push(self.position(moving, from, to, share)),
                // It rides in a vehicle.
                None if from.carrier != NO_INDEX => positions.push(*from),
                None => {}
            }
        }
    }

    /// A road user in SUMO's terms after a share of the step: on its way, or as in the nearer step.
    fn position(
        &self,
        moving: &MovingState,
        from: &LanePosition,
        to: Option<&LanePosition>,
        share: f64,
    ) -> LanePosition {
        let (way, driven_m) = match &moving.motion {
            StepMotion::Lanes { way, .. } => (way, share * way.length_m()),
            StepMotion::RollOut { way } => (way, f64::from(moving.from.speed_mps) * share * self.step_s),
            StepMotion::Straight { .. } | StepMotion::Coast => {
                return *to.filter(|_| share >= 0.5).unwrap_or(from);
            }
        };
        let Some(on_way) = self.lanes.place(way, driven_m) else {
            return *from;
        };
        let odometer_m = match to {
            Some(to) => from.odometer_m + share * (to.odometer_m - from.odometer_m),
            None => from.odometer_m + driven_m,
        };
        LanePosition {
            lane_position_m: on_way.place.position_m,
            odometer_m,
            lane: on_way.place.lane,
            edge: self.lanes.edge(on_way.place.lane),
            route_edge: from.route_edge.saturating_add(on_way.entered_edges),
            ..*from
        }
    }

    /// The state of a road user after a share of the step; `None` if it has left the net.
    fn state(&self, moving: &MovingState, share: f64) -> Option<TrafficState> {
        let from = TrafficState {
            flags: 0,
            ..moving.from
        };
        match &moving.motion {
            StepMotion::Lanes { way, beside } => Some(self.on_way(moving, way, *beside, share)),
            StepMotion::Straight { to } => Some(between(&from, to, share, self.step_s)),
            StepMotion::Coast => {
                let driven_m = f64::from(from.speed_mps) * share * self.step_s;
                let (sin, cos) = libm::sincos(f64::from(from.yaw_rad));
                Some(TrafficState {
                    front_x_m: from.front_x_m + driven_m * cos,
                    front_y_m: from.front_y_m + driven_m * sin,
                    accel_mps2: 0.0,
                    ..from
                })
            }
            StepMotion::RollOut { way } => {
                let driven_m = f64::from(from.speed_mps) * share * self.step_s;
                let share = driven_m / way.length_m();
                let beside = self.offset(way, 0.0, &from);
                (share < 1.0).then(|| TrafficState {
                    speed_mps: from.speed_mps,
                    ..self.on_way(moving, way, [beside; 2], share)
                })
            }
        }
    }

    /// The state after a share of a way.
    fn on_way(
        &self,
        MovingState { from, length_m, .. }: &MovingState,
        way: &LaneWay,
        beside: [LaneOffset; 2],
        share: f64,
    ) -> TrafficState {
        let at = |driven_m: f64| {
            let share = driven_m / way.length_m().max(f64::MIN_POSITIVE);
            self.point(way, driven_m, LaneOffset::between(beside, share.clamp(0.0, 1.0)))
        };
        let driven_m = share * way.length_m();
        let front = at(driven_m);
        // The rear bumper follows the front one, at first where the body stood before the step.
        let rear = if driven_m >= *length_m {
            at(driven_m - length_m)
        } else {
            let (sin, cos) = libm::sincos(f64::from(from.yaw_rad));
            let (begin, left_m) = (at(0.0), length_m - driven_m);
            [begin[0] - left_m * cos, begin[1] - left_m * sin, begin[2]]
        };
        let body = [front[0] - rear[0], front[1] - rear[1]];
        let yaw_rad = match body == [0.0; 2] {
            true => from.yaw_rad,
            false => single(libm::atan2(body[1], body[0])),
        };
        TrafficState {
            front_x_m: front[0],
            front_y_m: front[1],
            front_z_m: front[2],
            yaw_rad,
            speed_mps: single(way.length_m() / self.step_s),
            flags: 0,
            ..*from
        }
    }

    /// The point beside the centre lines at a distance from the beginning of a way.
    fn point(&self, way: &LaneWay, driven_m: f64, beside: LaneOffset) -> [f64; 3] {
        let Some(line) = self.lanes.at(way, driven_m) else {
            return [0.0; 3];
        };
        let ([x, y, z], [cos, sin]) = (line.position_m, line.direction);
        [
            x + beside.ahead * cos - beside.left * sin,
            y + beside.ahead * sin + beside.left * cos,
            z + beside.up,
        ]
    }

    /// The place of a state beside the centre lines at a distance from the beginning of a way.
    fn offset(&self, way: &LaneWay, driven_m: f64, state: &TrafficState) -> LaneOffset {
        LaneOffset::of(&self.lanes, way, driven_m, state).unwrap_or_default()
    }
}

impl LaneOffset {
    fn of(lanes: &LaneGraph, way: &LaneWay, driven_m: f64, state: &TrafficState) -> Option<Self> {
        let line = lanes.at(way, driven_m)?;
        let ([x, y, z], [cos, sin]) = (line.position_m, line.direction);
        let (dx, dy) = (state.front_x_m - x, state.front_y_m - y);
        Some(Self {
            ahead: dx * cos + dy * sin,
            left: dy * cos - dx * sin,
            up: state.front_z_m - z,
        })
    }

    fn between([from, to]: [Self; 2], share: f64) -> Self {
        let between = |from: f64, to: f64| from + share * (to - from);
        Self {
            ahead: between(from.ahead, to.ahead),
            left: between(from.left, to.left),
            up: between(from.up, to.up),
        }
    }
}

/// How a road user came from its state before the step to its state after it.
fn motion(
    lanes: &LaneGraph,
    step_s: f64,
    before: &PlacedState,
    now: &TrafficState,
    place: &VehiclePlace,
) -> StepMotion {
    if now.flags & DISCONTINUOUS != 0 {
        return StepMotion::Coast;
    }
    let straight = StepMotion::Straight { to: *now };
    let (Some(from), Some(to)) = (before.place.lane, place.lane) else {
        return straight;
    };
    let fastest_mps = f64::from(before.state.speed_mps.max(now.speed_mps));
    let Some(way) = lanes.way(from, to, DETOUR.0 * fastest_mps * step_s + DETOUR.1) else {
        return straight;
    };
    let ends = [
        LaneOffset::of(lanes, &way, 0.0, &before.state),
        LaneOffset::of(lanes, &way, way.length_m(), now),
    ];
    let [Some(mut first), Some(mut last)] = ends else {
        return straight;
    };
    // A change of lanes at a junction is a part of the turn: it is driven evenly over the step.
    if (last.left - first.left).abs() > LANE_JUMP_M && !way.leaves_lane() {
        match way.switch() {
            // The jump is in the first frame, …
            LaneSwitch::AtStart => first = last,
            // … or in the last, which is SUMO's own state.
            LaneSwitch::None | LaneSwitch::AtEnd => last = first,
        }
    }
    StepMotion::Lanes {
        way,
        beside: [first, last],
    }
}

/// The motion of a road user that is no longer on the road: a vehicle drives on to the end of its lane.
fn roll_out(lanes: &LaneGraph, before: &PlacedState) -> Option<StepMotion> {
    let way = lanes.rest(before.place.lane?);
    (way.length_m() > 0.0).then_some(StepMotion::RollOut { way })
}

/// The state on the straight line to another.
fn between(from: &TrafficState, to: &TrafficState, share: f64, step_s: f64) -> TrafficState {
    let mix = |from: f64, to: f64| from + share * (to - from);
    let turn_rad = f64::from(to.yaw_rad) - f64::from(from.yaw_rad);
    let turn_rad = turn_rad - std::f64::consts::TAU * (turn_rad / std::f64::consts::TAU).round();
    let moved_m = libm::hypot(to.front_x_m - from.front_x_m, to.front_y_m - from.front_y_m);
    TrafficState {
        front_x_m: mix(from.front_x_m, to.front_x_m),
        front_y_m: mix(from.front_y_m, to.front_y_m),
        front_z_m: mix(from.front_z_m, to.front_z_m),
        yaw_rad: single(f64::from(from.yaw_rad) + share * turn_rad),
        pitch_rad: single(mix(from.pitch_rad.into(), to.pitch_rad.into())),
        speed_mps: single(moved_m / step_s),
        ..*from
    }
}
