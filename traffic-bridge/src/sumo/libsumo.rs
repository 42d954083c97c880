//! The whole foreign surface: everything that C++ sees of Rust and Rust sees of SUMO. Values are SUMO's own; only
//! [`super::convention`] converts them.

#![expect(unsafe_code, reason = "cxx generates the calls; the shim's contract is in shim.h")]
#![expect(
    missing_docs,
    reason = "cxx generates items of its own; ours document what their names do not say"
)]
#![expect(unused_qualifications, reason = "in code that cxx generates")]

// SAFETY: `Simulation` is the only owner of libsumo's global state (`Sumo` keeps one per process and never sends it
// to another thread), every call throws `std::exception` or returns, and slices live as long as the borrow of `Simulation`.
#[cxx::bridge(namespace = "caraware")]
pub mod ffi {
    /// A road user after a step, as SUMO sees it. Off the road its position is SUMO's "invalid" value.
    #[derive(Debug, Clone, Copy, PartialEq)]
    struct RawState {
        x: f64,
        y: f64,
        z: f64,
        /// Degrees clockwise from north.
        angle: f64,
        /// Degrees, positive uphill.
        slope: f64,
        /// m/s.
        speed: f64,
        /// Speed after the step before; SUMO's "invalid" value if it was not on the road or jumped since.
        previous_speed: f64,
        signals: i32,
        /// Dense index within the episode.
        index: u32,
        /// Place of its lane among `Simulation::net_lanes`; negative if lanes are not read, for persons and off the road.
        lane: i32,
        /// Position of the front bumper on that lane, metres of the lane's own length.
        lane_position: f64,
        /// Place of its edge among the edges of `Simulation::net_lanes`; negative as `lane`. Persons have it if positions are read.
        edge: i32,
        /// Place of its edge in its route; negative if positions are not read, for persons and off the road.
        route_index: i32,
        /// Metres since departure, if positions are read; SUMO's "invalid" value for persons.
        odometer: f64,
        /// Index of the vehicle in which a person rides; negative afoot.
        carrier: i32,
    }

    /// A lane of the net, junctions included.
    #[derive(Debug, Clone, PartialEq)]
    struct RawNetLane {
        id: String,
        edge_id: String,
        /// Number of its edge; lanes of one edge lie beside each other.
        edge: u32,
        /// The lane's own length, which positions refer to, metres.
        length: f64,
        /// x, y, z, x, y, z, … of the centre line.
        shape: Vec<f64>,
        /// Places of the lanes that follow.
        next: Vec<u32>,
    }

    /// The kind of an event.
    #[derive(Debug, Clone, Copy, PartialEq, Eq)]
    enum RawEventKind {
        Departed,
        Arrived,
        Teleported,
    }

    /// An event of a road user; the fields after `id` are filled for departures only.
    #[derive(Debug, Clone, PartialEq)]
    struct RawEvent {
        kind: RawEventKind,
        index: u32,
        is_person: bool,
        id: String,
        vehicle_type: String,
        vehicle_class: String,
        length: f64,
        width: f64,
        height: f64,
        /// Limits of the vehicle type, m/s² and m/s; 0 for persons.
        accel: f64,
        decel: f64,
        max_speed: f64,
    }

    /// A traffic light that has changed.
    #[derive(Debug, Clone, PartialEq, Eq)]
    struct RawSignal {
        /// Place in the order of the sorted ids.
        index: u32,
        id: String,
        /// A letter for each link.
        state: String,
    }

    /// A road that a class of road users may use.
    #[derive(Debug, Clone, PartialEq)]
    struct RawEdge {
        id: String,
        /// Metres.
        length: f64,
        /// m/s.
        speed_limit: f64,
    }

    /// A way from one road to another for a class of road users.
    #[derive(Debug, Clone, PartialEq)]
    struct RawLink {
        from: String,
        to: String,
        /// It turns left.
        is_left: bool,
    }

    /// A lane on a vehicle's route.
    #[derive(Debug, Clone, PartialEq)]
    struct RawLane {
        /// Place of its edge in the route.
        edge: u32,
        /// Number of the lane on its edge, from the right.
        lane: u32,
        /// m/s.
        speed_limit: f64,
        /// x, y, x, y, … of the centre line.
        shape: Vec<f64>,
    }

    /// A way across a junction from a lane of the route to a lane of its next edge.
    #[derive(Debug, Clone, PartialEq)]
    struct RawWay {
        /// Place of the edge it leaves in the route.
        edge: u32,
        from_lane: u32,
        to_lane: u32,
        /// m/s.
        speed_limit: f64,
        /// x, y, x, y, … of the centre line.
        shape: Vec<f64>,
        /// Place of the traffic light among SUMO's sorted ids, negative where there is none.
        signal: i32,
        /// Number of the way at that traffic light.
        link: u32,
        /// No vehicle has precedence over it, where no traffic light decides.
        has_right_of_way: bool,
    }

    unsafe extern "C++" {
        include!("traffic-bridge/src/sumo/shim.h");

        /// SUMO, loaded or not.
        type Simulation;

        /// SUMO in this process.
        fn new_simulation() -> UniquePtr<Simulation>;
        /// SUMO in a process of its own, over TraCI.
        fn new_remote_simulation() -> UniquePtr<Simulation>;
        /// Sets an environment variable of this process, as SUMO and PROJ read it.
        fn set_environment(name: &str, value: &str);

        /// Starts libsumo with `arguments`, or connects to the SUMO that listens on `port` of `host`, as number `order` of its clients
        /// (0: the only one): then it returns when all of them are there.
        fn start(self: Pin<&mut Simulation>, arguments: &[String], host: &str, port: u16, order: u32) -> Result<()>;
        /// Ends the simulation; its output files are complete afterwards.
        fn close(self: Pin<&mut Simulation>) -> Result<()>;
        /// One simulation step and one pass of getters over all road users.
        fn step(self: Pin<&mut Simulation>) -> Result<()>;
        /// All road users after the last step, ordered by index.
        fn states(self: &Simulation) -> &[RawState];
        /// Events of the last step.
        fn events(self: &Simulation) -> &[RawEvent];
        /// Traffic lights that changed in the last step; all of them after the first.
        fn signals(self: &Simulation) -> &[RawSignal];
        /// What SUMO wrote to standard error since the last call (the last few kilobytes).
        fn take_messages(self: Pin<&mut Simulation>) -> String;
        /// Processor time of this thread, seconds.
        fn processor_seconds() -> f64;
        /// Paths that SUMO has taken in this process through the functions of `xml_paths.cc`, which keep nothing.
        fn paths_passed_to_sumo() -> u64;
        /// Processor time spent in SUMO's own step, in the pass of getters and in that over traffic lights since the start, seconds.
        fn seconds_in_step(self: &Simulation) -> f64;
        fn seconds_in_getters(self: &Simulation) -> f64;
        fn seconds_in_signals(self: &Simulation) -> f64;

        /// Contacts that SUMO has reported since the start.
        fn contacts(self: &Simulation) -> u64;

        fn time(self: &Simulation) -> Result<f64>;
        fn end_time(self: &Simulation) -> Result<f64>;
        fn step_length(self: &Simulation) -> Result<f64>;
        /// x_min, y_min, x_max, y_max of the net, metres.
        fn net_boundary(self: &Simulation) -> Result<Vec<f64>>;
        fn min_expected(self: &Simulation) -> Result<i32>;

        /// All lanes of the net. From now on each step reads on which lane a vehicle is.
        fn net_lanes(self: Pin<&mut Simulation>) -> Result<Vec<RawNetLane>>;
        /// From now on each step also reads positions on routes, and the lanes of persons. Call `net_lanes` before.
        fn read_positions(self: Pin<&mut Simulation>);
        /// Times that a person has boarded a vehicle since the start.
        fn rides(self: &Simulation) -> u64;
        /// Times that a container has been loaded onto a vehicle since the start.
        fn loads(self: &Simulation) -> u64;

        fn vehicle_class(self: &Simulation, vehicle_type: &str) -> Result<String>;
        fn edges(self: &Simulation, vehicle_class: &str) -> Result<Vec<RawEdge>>;
        fn links(self: &Simulation, vehicle_class: &str) -> Result<Vec<RawLink>>;
        /// Multiplies the speed limits of all lanes.
        fn scale_speed_limits(self: Pin<&mut Simulation>, factor: f64) -> Result<()>;

        /// Adds a vehicle at a free position of the first edge of `route`, at the speed of traffic there.
        fn add_vehicle(self: Pin<&mut Simulation>, id: &str, vehicle_type: &str, route: &[String]) -> Result<()>;
        fn remove_vehicle(self: Pin<&mut Simulation>, id: &str) -> Result<()>;
        /// Adds a vehicle at the beginning of the first edge of `route`, as soon as there is room.
        fn add_vehicle_at_start(
            self: Pin<&mut Simulation>,
            id: &str,
            vehicle_type: &str,
            route: &[String],
        ) -> Result<()>;
        /// From now on SUMO no longer controls speed and lane of the vehicle with this dense index. With `keeps_limits` SUMO's own driver
        /// still has its rules and the speed limits, so that `own_speed` says what it would do; else the vehicle may have any speed.
        fn take_over(self: Pin<&mut Simulation>, index: u32, keeps_limits: bool) -> Result<()>;
        /// Puts the vehicle's front bumper there at the end of the next step (`angle` in degrees clockwise from north);
        /// until then other vehicles react to this speed and acceleration.
        fn move_vehicle(
            self: Pin<&mut Simulation>,
            index: u32,
            x: f64,
            y: f64,
            angle: f64,
            speed: f64,
            acceleration: f64,
        ) -> Result<()>;
        /// Speed that SUMO's own driver would have brought the vehicle to in the last step, m/s.
        fn own_speed(self: &Simulation, index: u32) -> Result<f64>;
        /// The way of a vehicle through the junction ahead or around it (x, y, x, y, …; net, metres), if it waits for a hero that is in a
        /// junction and not before it on its own lane; empty if it does not.
        fn way_past(self: &Simulation, index: u32, hero: u32) -> Result<Vec<f64>>;
        /// From now on the vehicle does not wait in junctions for these, and for no others than these.
        fn ignore_in_junctions(self: Pin<&mut Simulation>, index: u32, heroes: &[u32]) -> Result<()>;
        /// The limit of a person's speed, m/s.
        fn person_limit(self: &Simulation, index: u32) -> Result<f64>;
        /// Sets it.
        fn limit_person(self: Pin<&mut Simulation>, index: u32, speed: f64) -> Result<()>;
        /// Removes the vehicle with this dense index; does nothing if there is no such vehicle.
        fn remove_by_index(self: Pin<&mut Simulation>, index: u32) -> Result<()>;
        /// Number of the lane on which the vehicle is, from the right.
        fn lane_index(self: &Simulation, index: u32) -> Result<i32>;
        /// Lanes on the vehicle's route that it may use, edge by edge.
        fn route_lanes(self: &Simulation, index: u32) -> Result<Vec<RawLane>>;
        /// Ways between those lanes.
        fn route_ways(self: &Simulation, index: u32) -> Result<Vec<RawWay>>;
        /// Index of the edge of its route where the vehicle is; negative before it departs.
        fn route_index(self: &Simulation, id: &str) -> Result<i32>;
        /// Continues the vehicle's route by `more`, which begins with its last edge.
        fn extend_route(self: Pin<&mut Simulation>, id: &str, more: &[String]) -> Result<()>;
        /// Routes the vehicle from its position to `edge` by SUMO's own choice; returns the number of edges of its route.
        fn set_destination(self: Pin<&mut Simulation>, id: &str, edge: &str) -> Result<u32>;

        /// Walk along sidewalks and crossings, both ends included; empty if there is none.
        fn walk(self: &Simulation, from: &str, from_position: f64, to: &str, to_position: f64) -> Result<Vec<String>>;
        fn add_person(self: Pin<&mut Simulation>, id: &str, person_type: &str, edge: &str, position: f64)
        -> Result<()>;
        fn append_walk(self: Pin<&mut Simulation>, id: &str, edges: &[String], arrival_position: f64) -> Result<()>;
        fn remaining_stages(self: &Simulation, id: &str) -> Result<i32>;
    }
}
