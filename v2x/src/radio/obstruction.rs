//! Whether buildings or vehicles stand between two antennas, from the scene and the road users of a tick.

use std::ops::{ControlFlow, Range};

use ipc_schema::{
    traffic::Kind,
    world::{VehicleState, road_users_of},
};
use sim_core::scene::{
    Grid, Scene,
    shape::{Bounds, OrientedBox, Point, cross, dot, edges, from_to},
};

use super::path_loss::LinkState;

/// Size of the cells of the index over buildings, metres.
const BUILDING_CELL_M: f64 = 25.0;
/// Size of the cells of the index over vehicles, metres.
const VEHICLE_CELL_M: f64 = 20.0;

/// An antenna.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Antenna {
    /// x and y, world, metres.
    pub position_m: Point,
    /// Height, world, metres.
    pub z_m: f64,
    /// The road user that carries it, which does not obstruct its own links: its row in the world.
    pub row: u32,
}

/// What is between two antennas.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LinkObstruction {
    /// The state of the link.
    pub state: LinkState,
    /// For a link behind vehicles: whether each antenna is higher than the highest of them.
    pub above: [bool; 2],
}

impl LinkObstruction {
    /// Nothing.
    pub const CLEAR: Self = Self {
        state: LinkState::Clear,
        above: [true; 2],
    };

    /// Road users, of which this is the top of the highest, metres.
    #[must_use]
    pub fn behind(top_m: Option<f64>, a: &Antenna, b: &Antenna) -> Self {
        match top_m {
            None => Self::CLEAR,
            Some(top_m) => Self {
                state: LinkState::Vehicles,
                above: [a.z_m > top_m, b.z_m > top_m],
            },
        }
    }
}

/// A wall of a building.
#[derive(Debug, Clone, Copy)]
struct BuildingWall {
    from_m: Point,
    to_m: Point,
    /// Top of the building, metres.
    roof_m: f64,
    building: u32,
}

/// A building as links see it.
#[derive(Debug, Clone)]
struct WalledBuilding {
    bounds: Bounds,
    /// Its walls among all.
    walls: Range<u32>,
}

/// A circle about a road user.
#[derive(Debug, Clone, Copy)]
struct RoadUserCircle {
    centre_m: Point,
    /// Square of a radius that is a little too large, m².
    radius2_m2: f64,
    /// Top of the road user, metres.
    top_m: f64,
}

/// Obstacles of a tick.
#[derive(Debug, Default)]
pub struct Obstacles {
    buildings: Vec<WalledBuilding>,
    walls: Vec<BuildingWall>,
    building_grid: Grid,
    bodies: Vec<OrientedBox>,
    /// How many of `bodies` are road users; those behind them are trailing bodies.
    road_users: usize,
    /// By row, as `bodies`.
    circles: Vec<RoadUserCircle>,
    vehicles: Grid,
}

/// The box about a road user.
#[must_use]
pub fn body_of(state: &VehicleState) -> OrientedBox {
    let (sin, cos) = libm::sincos(state.yaw_rad);
    let half_length_m = 0.5 * f64::from(state.length_m);
    // From the rear axle; a person's origin is its centre.
    let ahead_m = match state.kind == Kind::Person as u32 {
        true => 0.0,
        false => half_length_m - f64::from(state.rear_overhang_m),
    };
    OrientedBox {
        centre_m: [state.x_m + ahead_m * cos, state.y_m + ahead_m * sin],
        along: [cos, sin],
        half_m: [half_length_m, 0.5 * f64::from(state.width_m)],
        z_m: [state.z_m, state.z_m + f64::from(state.height_m)],
    }
}

impl Obstacles {
    /// The buildings of a scene, and no vehicles.
    #[must_use]
    pub fn new(scene: &Scene) -> Self {
        let mut obstacles = Self::default();
        for (number, building) in (0_u32..).zip(scene.buildings()) {
            let from = obstacles.walls.len() as u32;
            let walls = edges(&building.outline_m).map(|(from_m, to_m)| BuildingWall {
                from_m,
                to_m,
                roof_m: building.z_m()[1],
                building: number,
            });
            obstacles.walls.extend(walls);
            obstacles.buildings.push(WalledBuilding {
                bounds: building.bounds,
                walls: from..obstacles.walls.len() as u32,
            });
        }
        let bounds: Vec<Bounds> = obstacles.buildings.iter().map(|building| building.bounds).collect();
        obstacles.building_grid = Grid::new(&bounds, BUILDING_CELL_M);
        obstacles
    }

    /// Takes the road users of a tick, and the trailing bodies behind them.
    pub fn update(&mut self, states: &[VehicleState]) {
        self.road_users = road_users_of(states).len();
        self.bodies.clear();
        self.bodies.extend(states.iter().map(body_of));
        self.circles.clear();
        self.circles.extend(self.bodies.iter().map(|body| RoadUserCircle {
            centre_m: body.centre_m,
            radius2_m2: dot(body.half_m, body.half_m) * (1.0 + 1e-6) + 1e-6,
            top_m: body.z_m[1],
        }));
        let bounds: Vec<Bounds> = self.bodies.iter().map(OrientedBox::bounds).collect();
        self.vehicles = Grid::new(&bounds, VEHICLE_CELL_M);
    }

    /// The boxes about the road users, by row.
    #[must_use]
    pub fn bodies(&self) -> &[OrientedBox] {
        &self.bodies
    }

    /// Rows of the bodies whose bounds may meet `bounds`, ascending, into `found`.
    pub fn bodies_near(&self, bounds: &Bounds, found: &mut Vec<u32>) {
        self.vehicles.near(bounds, found);
    }

    /// The same of road users alone, whose trailing bodies do not count.
    pub fn road_users_near(&self, bounds: &Bounds, found: &mut Vec<u32>) {
        self.bodies_near(bounds, found);
        found.retain(|row| (*row as usize) < self.road_users);
    }

    /// What is between two antennas.
    #[must_use]
    pub fn between(&self, a: &Antenna, b: &Antenna) -> LinkObstruction {
        match self.wall_between(a, b) {
            Some(_) => LinkObstruction {
                state: LinkState::Building,
                above: [true; 2],
            },
            None => self.vehicles_between(a, b),
        }
    }

    /// What is between two antennas that no building obstructs.
    #[must_use]
    pub fn vehicles_between(&self, a: &Antenna, b: &Antenna) -> LinkObstruction {
        LinkObstruction::behind(self.highest_vehicle_m(a, b), a, b)
    }

    /// True if a building meets the line between two antennas.
    #[must_use]
    pub fn meets_building(&self, a: &Antenna, b: &Antenna) -> bool {
        self.wall_between(a, b).is_some()
    }

    /// The number of a wall that meets the line between two antennas.
    #[must_use]
    pub fn wall_between(&self, a: &Antenna, b: &Antenna) -> Option<u32> {
        let line = Bounds::of([a.position_m, b.position_m]);
        let mut met = None;
        self.building_grid.along(a.position_m, b.position_m, |found| {
            met = found
                .iter()
                .find_map(|number| self.wall_of(&self.buildings[*number as usize], &line, a, b));
            match met {
                Some(_) => ControlFlow::Break(()),
                None => ControlFlow::Continue(()),
            }
        });
        met
    }

    /// The number of a wall that meets the line between two antennas, if one of the building with the wall `known` does.
    #[must_use]
    pub fn wall_beside(&self, known: u32, a: &Antenna, b: &Antenna) -> Option<u32> {
        let wall = self.walls.get(known as usize)?;
        if wall.surely_meets(a, b) {
            return Some(known);
        }
        let line = Bounds::of([a.position_m, b.position_m]);
        self.wall_of(&self.buildings[wall.building as usize], &line, a, b)
    }

    /// The number of a wall of a building that meets the line between two antennas, whose bounds are `line`.
    fn wall_of(&self, building: &WalledBuilding, line: &Bounds, a: &Antenna, b: &Antenna) -> Option<u32> {
        if !building.bounds.meets(line) {
            return None;
        }
        let way = from_to(a.position_m, b.position_m);
        building.walls.clone().find(|number| {
            let wall = &self.walls[*number as usize];
            share_of_crossing(a.position_m, way, wall.from_m, wall.to_m)
                .is_some_and(|share| a.z_m + share * (b.z_m - a.z_m) < wall.roof_m)
        })
    }

    /// Top of the highest road user that meets the line between two antennas, metres. Those that carry the antennas do not count.
    #[must_use]
    pub fn highest_vehicle_m(&self, a: &Antenna, b: &Antenna) -> Option<f64> {
        let mut top_m: Option<f64> = None;
        let way = from_to(a.position_m, b.position_m);
        let length2 = dot(way, way);
        self.vehicles.along(a.position_m, b.position_m, |found| {
            for row in found {
                let circle = &self.circles[*row as usize];
                // Most are beside the line.
                let area = cross(way, from_to(a.position_m, circle.centre_m));
                if area * area <= circle.radius2_m2 * length2 {
                    top_m = self.higher_of(top_m, *row, a, b);
                }
            }
            ControlFlow::Continue(())
        });
        top_m
    }

    /// The higher of a top and that of a road user, if the road user meets the line between two antennas.
    #[inline]
    pub(super) fn higher_of(&self, top_m: Option<f64>, row: u32, a: &Antenna, b: &Antenna) -> Option<f64> {
        let body_top_m = self.circles[row as usize].top_m;
        let counts = row != a.row && row != b.row && top_m.is_none_or(|top_m| body_top_m > top_m);
        match counts && meets_box(&self.bodies[row as usize], a, b) {
            true => Some(body_top_m),
            false => top_m,
        }
    }

    /// Both ends of the walls of the buildings near `bounds`, into `found`; some come several times.
    pub(super) fn walls_near(&self, bounds: &Bounds, found: &mut Vec<[Point; 2]>) {
        found.clear();
        self.building_grid.visit_near(bounds, |buildings| {
            for building in buildings.iter().map(|number| &self.buildings[*number as usize]) {
                let walls = &self.walls[building.walls.start as usize..building.walls.end as usize];
                found.extend(walls.iter().map(|wall| [wall.from_m, wall.to_m]));
            }
        });
    }

    /// Calls `visit` with row, centre and radius of circles about the bodies near `bounds`, with some several times.
    pub(super) fn visit_circles(&self, bounds: &Bounds, mut visit: impl FnMut(u32, Point, f64)) {
        self.vehicles.visit_near(bounds, |rows| {
            for row in rows {
                let circle = &self.circles[*row as usize];
                visit(*row, circle.centre_m, circle.radius2_m2.sqrt());
            }
        });
    }
}

impl BuildingWall {
    /// True if the line between two antennas crosses the wall away from its ends and below the roof: [`share_of_crossing`] finds it too,
    /// whatever is rounded. The most frequent answer, without a division.
    fn surely_meets(&self, a: &Antenna, b: &Antenna) -> bool {
        const MARGIN: f64 = 1e-6;
        let way = from_to(a.position_m, b.position_m);
        let wall = from_to(self.from_m, self.to_m);
        let area = cross(way, wall);
        let offset = from_to(a.position_m, self.from_m);
        let (share, along) = (cross(offset, wall) * area.signum(), cross(offset, way) * area.signum());
        let area = area.abs();
        let inside = MARGIN * area..(1.0 - MARGIN) * area;
        area > MARGIN && inside.contains(&share) && inside.contains(&along) && a.z_m.max(b.z_m) < self.roof_m - MARGIN
    }
}

/// Share of the way from `a` at which it crosses a wall, if it does.
fn share_of_crossing(a: Point, way: Point, from: Point, to: Point) -> Option<f64> {
    let wall = from_to(from, to);
    let area = cross(way, wall);
    if area == 0.0 {
        return None;
    }
    let offset = from_to(a, from);
    let (share, along) = (cross(offset, wall) / area, cross(offset, way) / area);
    ((0.0..=1.0).contains(&share) && (0.0..=1.0).contains(&along)).then_some(share)
}

/// True if the line between two antennas passes through a box.
fn meets_box(body: &OrientedBox, a: &Antenna, b: &Antenna) -> bool {
    let start = body.local_from_world(a.position_m);
    let way = from_to(start, body.local_from_world(b.position_m));
    let (mut enter, mut leave) = (0.0_f64, 1.0_f64);
    for axis in 0..2 {
        let half_m = body.half_m[axis];
        if way[axis] == 0.0 {
            if start[axis].abs() > half_m {
                return false;
            }
            continue;
        }
        let (near, far) = ((-half_m - start[axis]) / way[axis], (half_m - start[axis]) / way[axis]);
        enter = enter.max(near.min(far));
        leave = leave.min(near.max(far));
    }
    // The line's lowest point over the box.
    let height_m = |share: f64| a.z_m + share * (b.z_m - a.z_m);
    enter <= leave && height_m(enter).min(height_m(leave)) < body.z_m[1]
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sim_core::scene::{Prism, Road, SolidClass};

    use super::*;

    fn house(x_m: f64, y_m: f64, height_m: f64) -> Prism {
        let outline = vec![
            [x_m, y_m],
            [x_m + 10.0, y_m],
            [x_m + 10.0, y_m + 10.0],
            [x_m, y_m + 10.0],
        ];
        Prism::new("house".into(), SolidClass::Building, outline, 0.0, height_m).unwrap()
    }

    fn antenna(x_m: f64, y_m: f64, z_m: f64, row: u32) -> Antenna {
        Antenna {
            position_m: [x_m, y_m],
            z_m,
            row,
        }
    }

    fn vehicle(x_m: f64, y_m: f64, height_m: f32) -> VehicleState {
        VehicleState {
            x_m,
            y_m,
            length_m: 4.0,
            width_m: 2.0,
            height_m,
            rear_overhang_m: 1.0,
            ..VehicleState::default()
        }
    }

    #[test]
    fn a_house_is_in_the_way_up_to_its_roof() {
        let scene = Scene::new(Road::default(), vec![house(50.0, -5.0, 8.0)], Vec::new());
        let obstacles = Obstacles::new(&scene);
        let state = |y_m, z_m| {
            obstacles
                .between(&antenna(0.0, y_m, z_m, 0), &antenna(100.0, y_m, z_m, 1))
                .state
        };
        assert_eq!(state(0.0, 1.5), LinkState::Building);
        assert_eq!(state(0.0, 8.1), LinkState::Clear);
        assert_eq!(state(5.1, 1.5), LinkState::Clear);
    }

    #[test]
    fn a_vehicle_is_in_the_way_and_its_height_counts() {
        let mut obstacles = Obstacles::default();
        obstacles.update(&[
            vehicle(0.0, 0.0, 1.5),
            vehicle(100.0, 0.0, 1.5),
            vehicle(50.0, 0.0, 3.5),
            vehicle(70.0, 0.0, 1.5),
        ]);
        let (a, b) = (antenna(1.0, 0.0, 1.6, 0), antenna(101.0, 0.0, 1.6, 1));
        let between = obstacles.between(&a, &b);
        assert_eq!((between.state, between.above), (LinkState::Vehicles, [false, false]));
        // Over the lorry, and past it.
        let high = obstacles.between(&Antenna { z_m: 5.4, ..a }, &b);
        assert_eq!((high.state, high.above), (LinkState::Vehicles, [true, false]));
        assert_eq!(
            obstacles
                .between(&Antenna { z_m: 8.0, ..a }, &Antenna { z_m: 8.0, ..b })
                .state,
            LinkState::Clear
        );
        let aside = |antenna: Antenna| Antenna {
            position_m: [antenna.position_m[0], 1.1],
            ..antenna
        };
        assert_eq!(obstacles.between(&aside(a), &aside(b)).state, LinkState::Clear);
    }

    proptest! {
        /// Beside the plain test of all walls and boxes.
        #[test]
        fn the_index_finds_what_a_search_of_everything_finds(
            houses in prop::collection::vec(prop::array::uniform2(-300.0_f64..300.0), 0..30),
            cars in prop::collection::vec((prop::array::uniform2(-300.0_f64..300.0), -3.1_f64..3.1, 1.0_f32..4.0), 0..30),
            from in prop::array::uniform2(-400.0_f64..400.0), to in prop::array::uniform2(-400.0_f64..400.0), z_m in 0.5_f64..4.0,
        ) {
            let houses: Vec<Prism> = houses.into_iter().map(|[x, y]| house(x, y, 3.0)).collect();
            let states: Vec<VehicleState> = cars
                .into_iter()
                .map(|([x, y], yaw_rad, height_m)| VehicleState { yaw_rad, ..vehicle(x, y, height_m) })
                .collect();
            let (a, b) = (antenna(from[0], from[1], z_m, u32::MAX), antenna(to[0], to[1], 1.5, u32::MAX));
            let mut obstacles = Obstacles::new(&Scene::new(Road::default(), houses.clone(), Vec::new()));
            obstacles.update(&states);
            let way = from_to(from, to);
            let house_met = houses.iter().any(|house| edges(&house.outline_m).any(|(c, d)| {
                share_of_crossing(from, way, c, d).is_some_and(|share| z_m + share * (1.5 - z_m) < 3.0)
            }));
            prop_assert_eq!(obstacles.meets_building(&a, &b), house_met);
            // Each wall, as one that was met before.
            for number in 0..obstacles.walls.len() as u32 {
                let wall = &obstacles.walls[number as usize];
                let meets = |wall: &BuildingWall| {
                    share_of_crossing(from, way, wall.from_m, wall.to_m).is_some_and(|share| z_m + share * (1.5 - z_m) < 3.0)
                };
                prop_assert!(meets(wall) || !wall.surely_meets(&a, &b));
                let met = obstacles.wall_beside(number, &a, &b);
                prop_assert!(met.is_none_or(|met| meets(&obstacles.walls[met as usize])));
                prop_assert!(met.is_some() || !meets(wall));
            }
            let tops = states.iter().map(body_of).filter(|body| meets_box(body, &a, &b)).map(|body| body.z_m[1]);
            prop_assert_eq!(obstacles.highest_vehicle_m(&a, &b), tops.reduce(f64::max));
        }
    }
}
