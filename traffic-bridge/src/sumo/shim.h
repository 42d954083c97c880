// SUMO behind a narrow interface, used by libsumo.rs alone. engine.h implements it over libsumo, which runs in this process, and over
// libtraci, which talks to a SUMO of its own process.
//
// Contract: one `Simulation` per process, used by one thread. Every function returns or throws a `std::exception`.
// Values are libsumo's own; convention.rs converts them to the project's units and frames.
#pragma once

#include <cstdint>
#include <memory>
#include <string>

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

class Simulation {
public:
    Simulation() = default;
    virtual ~Simulation() = default;
    Simulation(const Simulation&) = delete;
    Simulation& operator=(const Simulation&) = delete;

    // libsumo takes SUMO's options; libtraci connects to this host and port, as this client in the order (0: the only one).
    virtual void start(rust::Slice<const rust::String> arguments, rust::Str host, std::uint16_t port, std::uint32_t order) = 0;
    virtual void close() = 0;
    virtual void step() = 0;
    virtual rust::Slice<const RawState> states() const = 0;
    virtual rust::Slice<const RawEvent> events() const = 0;
    virtual rust::Slice<const RawSignal> signals() const = 0;
    virtual rust::String take_messages() = 0;
    virtual double seconds_in_step() const = 0;
    virtual double seconds_in_getters() const = 0;
    virtual double seconds_in_signals() const = 0;

    virtual std::uint64_t contacts() const = 0;
    virtual double time() const = 0;
    virtual double end_time() const = 0;
    virtual double step_length() const = 0;
    virtual rust::Vec<double> net_boundary() const = 0;
    virtual std::int32_t min_expected() const = 0;

    virtual rust::Vec<RawNetLane> net_lanes() = 0;
    virtual void read_positions() = 0;
    virtual std::uint64_t rides() const = 0;
    virtual std::uint64_t loads() const = 0;

    virtual rust::String vehicle_class(rust::Str vehicle_type) const = 0;
    virtual rust::Vec<RawEdge> edges(rust::Str vehicle_class) const = 0;
    virtual rust::Vec<RawLink> links(rust::Str vehicle_class) const = 0;
    virtual void scale_speed_limits(double factor) = 0;

    virtual void add_vehicle(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) = 0;
    virtual void remove_vehicle(rust::Str id) = 0;
    virtual void add_vehicle_at_start(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) = 0;
    virtual void take_over(std::uint32_t index, bool keeps_limits) = 0;
    virtual void move_vehicle(std::uint32_t index, double x, double y, double angle, double speed, double acceleration) = 0;
    virtual double own_speed(std::uint32_t index) const = 0;
    virtual rust::Vec<double> way_past(std::uint32_t index, std::uint32_t hero) const = 0;
    virtual void ignore_in_junctions(std::uint32_t index, rust::Slice<const std::uint32_t> heroes) = 0;
    virtual double person_limit(std::uint32_t index) const = 0;
    virtual void limit_person(std::uint32_t index, double speed) = 0;
    virtual void remove_by_index(std::uint32_t index) = 0;
    virtual std::int32_t lane_index(std::uint32_t index) const = 0;
    virtual rust::Vec<RawLane> route_lanes(std::uint32_t index) const = 0;
    virtual rust::Vec<RawWay> route_ways(std::uint32_t index) const = 0;
    virtual std::int32_t route_index(rust::Str id) const = 0;
    virtual void extend_route(rust::Str id, rust::Slice<const rust::String> more) = 0;
    virtual std::uint32_t set_destination(rust::Str id, rust::Str edge) = 0;

    virtual rust::Vec<rust::String> walk(rust::Str from, double from_position, rust::Str to, double to_position) const = 0;
    virtual void add_person(rust::Str id, rust::Str person_type, rust::Str edge, double position) = 0;
    virtual void append_walk(rust::Str id, rust::Slice<const rust::String> edges, double arrival_position) = 0;
    virtual std::int32_t remaining_stages(rust::Str id) const = 0;
};

// Processor time of this thread: the cost of a step, independent of other load on the machine.
double processor_seconds();

// Paths that SUMO has taken from its options, its files and its outputs in this process (xml_paths.cc).
std::uint64_t paths_passed_to_sumo();

// SUMO in this process.
std::unique_ptr<Simulation> new_simulation();
// SUMO in a process of its own.
std::unique_ptr<Simulation> new_remote_simulation();
void set_environment(rust::Str name, rust::Str value);

}  // namespace caraware
