//! Heroes on SUMO's side: before each step they are set to where their own dynamics has brought them.
//!
//! SUMO places a hero at the end of the step before which it is told, when everybody else has moved on by a step. So a hero is
//! told on by a step, straight ahead at its speed and acceleration; what its model then really does reaches SUMO a step later.
//! At a lateral or longitudinal acceleration of 5 m/s² that is 25 mm in a step of 0.1 s. Until the end of the step followers
//! reckon with its true speed and acceleration.

use ipc_schema::{
    block::{self, BlockError, Section},
    ego::EgoPose,
    ports::Message,
    traffic::{Kind, MetaEvent, ROUTE_POINTS_PER_MESSAGE, RoutePoint},
};

use crate::{
    convention::heading_deg_from_yaw_rad,
    error::SumoError,
    frame::Frame,
    hero_route,
    session::{Session, called},
};

/// The poses in a message.
///
/// # Errors
/// The payload is too short.
pub fn poses(message: &Message) -> Result<&[EgoPose], BlockError> {
    let len = message.header().count as usize * size_of::<EgoPose>();
    block::view(message.payload(), Section { offset: 0, len })
}

/// Takes over the heroes that departed in this step and returns the points of their routes.
///
/// # Errors
/// SUMO does not know them.
pub fn take_over(session: &mut Session, frame: &Frame) -> Result<Vec<RoutePoint>, SumoError> {
    let mut points = Vec::new();
    let departed = frame
        .events
        .iter()
        .filter(|event| event.kind == Kind::Hero as u32 && event.event == MetaEvent::Departed as u32);
    for event in departed {
        called("take over a hero", session.sumo_mut().take_over(event.vehicle))?;
        let sumo = session.sumo();
        let lane = called("tell a hero's lane", sumo.lane_index(event.vehicle))?;
        let lanes = called("list the lanes of a route", sumo.route_lanes(event.vehicle))?;
        let ways = called("list the ways of a route", sumo.route_ways(event.vehicle))?;
        let first_lane = u32::try_from(lane).unwrap_or(0);
        points.extend(hero_route::line(event.vehicle, first_lane, &lanes, &ways));
    }
    Ok(points)
}

/// The points in parts that fit into a message.
pub fn parts(points: &[RoutePoint]) -> impl Iterator<Item = &[RoutePoint]> {
    points.chunks(ROUTE_POINTS_PER_MESSAGE)
}

/// Sets the heroes of `frame` to their poses for the next step, and takes out those whose episodes have ended. A hero that SUMO
/// has let go is passed over.
///
/// # Errors
/// SUMO refuses.
pub fn apply(session: &mut Session, frame: &Frame, poses: &[EgoPose]) -> Result<(), SumoError> {
    for pose in poses {
        if frame.states.iter().all(|state| state.vehicle != pose.vehicle) {
            continue;
        }
        let step_s = session.step_s();
        let mut sumo = session.sumo_mut();
        let done = if pose.flags == 0 {
            let [x_m, y_m] = a_step_on(pose, step_s);
            sumo.as_mut().move_vehicle(
                pose.vehicle,
                x_m,
                y_m,
                heading_deg_from_yaw_rad(pose.yaw_rad),
                pose.speed_mps,
                pose.accel_mps2,
            )
        } else {
            sumo.as_mut().remove_by_index(pose.vehicle)
        };
        called("move a hero", done)?;
    }
    Ok(())
}

/// Where the front bumper will be after a step straight ahead.
fn a_step_on(pose: &EgoPose, step_s: f64) -> [f64; 2] {
    let speed_after_mps = (pose.speed_mps + pose.accel_mps2 * step_s).max(0.0);
    let way_m = 0.5 * (pose.speed_mps + speed_after_mps) * step_s;
    let (sin, cos) = pose.yaw_rad.sin_cos();
    [pose.front_x_m + way_m * cos, pose.front_y_m + way_m * sin]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_hero_is_told_on_by_a_step_and_never_backwards() {
        let pose = EgoPose {
            front_x_m: 1.0,
            front_y_m: 2.0,
            yaw_rad: std::f64::consts::FRAC_PI_2,
            speed_mps: 10.0,
            accel_mps2: -5.0,
            ..EgoPose::default()
        };
        let [x_m, y_m] = a_step_on(&pose, 0.1);
        assert!((x_m - 1.0).abs() < 1e-12 && (y_m - (3.0 - 0.025)).abs() < 1e-12);
        let [_, y_m] = a_step_on(&EgoPose { speed_mps: 0.0, ..pose }, 0.1);
        assert_eq!(y_m, 2.0);
    }
}
