//! Heroes on SUMO's side: before each step the bridge moves them to where their own model has brought them.
//!
//! SUMO applies a hero's position at the end of the next step, when all other vehicles have moved by a step. The bridge therefore
//! extrapolates the hero by a step, straight ahead at its speed and acceleration. What the model really does reaches SUMO a step
//! later: at a lateral or longitudinal acceleration of 5 m/s² the difference is 25 mm in a step of 0.1 s. Until the end of the step
//! followers react to the hero's true speed and acceleration.

pub mod around;
pub mod passing;
pub mod route;
pub mod standing;
pub mod waiting;

use ipc_schema::{
    block::{self, BlockError},
    config::HeroDriver,
    ego::{EgoPose, EgoPoseLayout},
    ports::Message,
    traffic::{HeroAdvice, Kind, MetaEvent, ROUTE_POINTS_PER_MESSAGE, RoutePoint},
};

use crate::sumo::{
    Sumo, called,
    convention::{heading_deg_from_yaw_rad, net_from_world, world_from_net},
    error::SumoError,
    frame::TrafficFrame,
};

/// The poses in a message.
///
/// # Errors
/// The payload is too short.
pub fn poses(message: &Message) -> Result<&[EgoPose], BlockError> {
    block::view(message.payload(), EgoPoseLayout::of(message.header()).poses)
}

/// Takes control of the heroes that departed in this step, unless SUMO drives them, and returns the points of their routes.
/// With `is_advised` SUMO's own driver can still say what it would do ([`advice`]).
///
/// # Errors
/// SUMO does not know them.
pub fn take_over(
    sumo: &mut Sumo,
    frame: &TrafficFrame,
    driver: HeroDriver,
    is_advised: bool,
) -> Result<Vec<RoutePoint>, SumoError> {
    let mut points = Vec::new();
    let departed = frame
        .events
        .iter()
        .filter(|event| event.kind == Kind::Hero as u32 && event.event == MetaEvent::Departed as u32);
    for event in departed {
        if driver == HeroDriver::Actions {
            let taken = sumo.simulation_mut().take_over(event.vehicle, is_advised);
            called("take over a hero", taken)?;
        }
        let simulation = sumo.simulation();
        let lane = called("report a hero's lane", simulation.lane_index(event.vehicle))?;
        let lanes = called("list the lanes of a route", simulation.route_lanes(event.vehicle))?;
        let ways = called("list the links of a route", simulation.route_ways(event.vehicle))?;
        let first_lane = u32::try_from(lane).unwrap_or(0);
        points.extend(route::line(event.vehicle, first_lane, &lanes, &ways));
    }
    for point in &mut points {
        [point.x_m, point.y_m] = world_from_net([point.x_m, point.y_m], sumo.world_origin_m());
    }
    Ok(points)
}

/// The points in parts that fit into a message.
pub fn parts(points: &[RoutePoint]) -> impl Iterator<Item = &[RoutePoint]> {
    points.chunks(ROUTE_POINTS_PER_MESSAGE)
}

/// Moves the heroes of `frame` to their poses for the next step, unless SUMO drives them, and removes those whose episodes have ended. Skips a hero that
/// SUMO has removed.
///
/// # Errors
/// SUMO refuses.
pub fn apply(sumo: &mut Sumo, frame: &TrafficFrame, poses: &[EgoPose], driver: HeroDriver) -> Result<(), SumoError> {
    for pose in poses {
        let stays = driver == HeroDriver::Sumo && pose.flags == 0;
        // States are in the order of their indices.
        let place = frame.states.binary_search_by_key(&pose.vehicle, |state| state.vehicle);
        if stays || place.is_err() {
            continue;
        }
        let (step_s, world_origin_m) = (sumo.step_s(), sumo.world_origin_m());
        let mut simulation = sumo.simulation_mut();
        let done = if pose.flags == 0 {
            let [x_m, y_m] = net_from_world(extrapolated_position(pose, step_s), world_origin_m);
            simulation.as_mut().move_vehicle(
                pose.vehicle,
                x_m,
                y_m,
                heading_deg_from_yaw_rad(pose.yaw_rad),
                pose.speed_mps,
                pose.accel_mps2,
            )
        } else {
            simulation.as_mut().remove_by_index(pose.vehicle)
        };
        called("move a hero", done)?;
    }
    Ok(())
}

/// What SUMO's own driver would have done in the step of `frame` with the heroes that `poses` had moved before it, as long as they are there.
///
/// # Errors
/// SUMO does not know them.
pub fn advice(sumo: &Sumo, frame: &TrafficFrame, poses: &[EgoPose]) -> Result<Vec<HeroAdvice>, SumoError> {
    let is_there = |pose: &&EgoPose| {
        let states = &frame.states;
        pose.flags == 0
            && states
                .binary_search_by_key(&pose.vehicle, |state| state.vehicle)
                .is_ok()
    };
    let advised = poses.iter().filter(is_there).map(|pose| {
        let own_mps = called("ask a hero's driver", sumo.simulation().own_speed(pose.vehicle))?;
        Ok(HeroAdvice {
            vehicle: pose.vehicle,
            accel_mps2: ((own_mps - pose.speed_mps) / sumo.step_s()) as f32,
        })
    });
    advised.collect()
}

/// Where the front bumper will be after a step straight ahead.
fn extrapolated_position(pose: &EgoPose, step_s: f64) -> [f64; 2] {
    let speed_after_mps = (pose.speed_mps + pose.accel_mps2 * step_s).max(0.0);
    let way_m = 0.5 * (pose.speed_mps + speed_after_mps) * step_s;
    let (sin, cos) = pose.yaw_rad.sin_cos();
    [pose.front_x_m + way_m * cos, pose.front_y_m + way_m * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hero_is_extrapolated_by_a_step_and_never_backwards() {
        let pose = EgoPose {
            front_x_m: 1.0,
            front_y_m: 2.0,
            yaw_rad: std::f64::consts::FRAC_PI_2,
            speed_mps: 10.0,
            accel_mps2: -5.0,
            ..EgoPose::default()
        };
        let [x_m, y_m] = extrapolated_position(&pose, 0.1);
        assert!((x_m - 1.0).abs() < 1e-12 && (y_m - (3.0 - 0.025)).abs() < 1e-12);
        let [_, y_m] = extrapolated_position(&EgoPose { speed_mps: 0.0, ..pose }, 0.1);
        assert_eq!(y_m, 2.0);
    }
}
