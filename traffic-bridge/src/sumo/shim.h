// SUMO behind a narrow interface: one object that owns libsumo's global simulation, used by libsumo.rs alone.
//
// Contract: one `Simulation` per process, used by one thread. Every function returns or throws a `std::exception`.
// Values are libsumo's own; convention.rs converts them to the project's units and frames.
#pragma once

#include <cstddef>
#include <cstdint>
#include <memory>
#include <string>
#include <unordered_map>
#include <vector>

#include "rust/cxx.h"

namespace caraware {

struct RawState;
struct RawEvent;
struct RawSignal;
struct RawEdge;
struct RawLink;
struct RawLane;
struct RawWay;
struct RawNetLane;
class ErrorTee;

class Simulation {
public:
    Simulation();
    ~Simulation();
    Simulation(const Simulation&) = delete;
    Simulation& operator=(const Simulation&) = delete;

    void start(rust::Slice<const rust::String> arguments);
    void close();
    void step();
    rust::Slice<const RawState> states() const;
    rust::Slice<const RawEvent> events() const;
    rust::Slice<const RawSignal> signals() const;
    rust::String take_messages();
    double seconds_in_step() const;
    double seconds_in_getters() const;
    double seconds_in_signals() const;

    double time() const;
    double end_time() const;
    double step_length() const;
    std::int32_t min_expected() const;

    rust::Vec<RawNetLane> net_lanes();

    rust::String vehicle_class(rust::Str vehicle_type) const;
    rust::Vec<RawEdge> edges(rust::Str vehicle_class) const;
    rust::Vec<RawLink> links(rust::Str vehicle_class) const;

    void add_vehicle(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route);
    void remove_vehicle(rust::Str id);
    void add_vehicle_at_start(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route);
    void take_over(std::uint32_t index);
    void move_vehicle(std::uint32_t index, double x, double y, double angle, double speed, double acceleration);
    void remove_by_index(std::uint32_t index);
    std::int32_t lane_index(std::uint32_t index) const;
    rust::Vec<RawLane> route_lanes(std::uint32_t index) const;
    rust::Vec<RawWay> route_ways(std::uint32_t index) const;
    std::int32_t route_index(rust::Str id) const;
    void extend_route(rust::Str id, rust::Slice<const rust::String> more);
    std::uint32_t set_destination(rust::Str id, rust::Str edge);

    rust::Vec<rust::String> walk(rust::Str from, double from_position, rust::Str to, double to_position) const;
    void add_person(rust::Str id, rust::Str person_type, rust::Str edge, double position);
    void append_walk(rust::Str id, rust::Slice<const rust::String> edges, double arrival_position);
    std::int32_t remaining_stages(rust::Str id) const;

private:
    // Id and kind of the road user at the same place of `states_`.
    struct Live {
        std::string id;
        bool is_person;
        bool gone;
    };

    const std::string* id_of(std::uint32_t index) const;
    const std::string& known_id(std::uint32_t index) const;
    void note_departures();
    void note_arrivals();
    void note_teleports();
    void depart(const std::string& id, bool is_person);
    void arrive(std::size_t place);
    void read_vehicle(const std::string& id, RawState& state) const;
    void read_person(const std::string& id, RawState& state) const;
    void read_all();
    void put_in_order();
    void read_signals();
    void forget_gone();

    std::unique_ptr<ErrorTee> errors_;
    std::vector<Live> live_;
    std::vector<RawState> states_;
    // Places in `live_` in the order of their ids, except for the newest `late_`: SUMO finds a vehicle by its id in a tree, and
    // neighbours in the tree share their path and their cache lines.
    std::vector<std::size_t> reading_order_;
    std::size_t late_ = 0;
    // New places of the road users when others are removed. Reused.
    std::vector<std::size_t> moved_;
    std::vector<RawEvent> events_;
    // A traffic light, with the state last published ("" before the first) and the time at which SUMO updates it again.
    struct Light {
        std::string id;
        std::string published;
        double next_switch;
    };

    // In the order of their sorted ids.
    std::vector<Light> lights_;
    std::vector<RawSignal> signals_;
    // Place in `live_` of an id; vehicles and persons have separate names. Never iterated.
    std::unordered_map<std::string, std::size_t> vehicle_places_;
    std::unordered_map<std::string, std::size_t> person_places_;
    // Place among the net's lanes of an id; empty if lanes are not read. Never iterated.
    std::unordered_map<std::string, std::int32_t> lane_places_;
    std::uint32_t next_index_ = 0;
    std::uint64_t steps_ = 0;
    std::uint64_t signal_period_steps_ = 1;
    bool has_elevation_ = false;
    bool any_gone_ = false;
    double seconds_in_step_ = 0.0;
    double seconds_in_getters_ = 0.0;
    double seconds_in_signals_ = 0.0;
};

// Processor time of this thread: the cost of a step, independent of other load on the machine.
double processor_seconds();
std::unique_ptr<Simulation> new_simulation();
void set_environment(rust::Str name, rust::Str value);

}  // namespace caraware
