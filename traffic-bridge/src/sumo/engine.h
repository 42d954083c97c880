// The simulation over one engine. Every file that includes this one is compiled twice: over libsumo, and over libtraci, whose functions
// have the same names and types (over_traci.cc).
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <memory>
#include <set>
#include <string>
#include <unordered_map>
#include <utility>
#include <vector>

#ifdef CARAWARE_OVER_TRACI
#include <libsumo/libtraci.h>
#define CARAWARE_ENGINE over_traci
namespace caraware::over_traci {
namespace engine = ::libtraci;
}
#else
#include <libsumo/libsumo.h>
#define CARAWARE_ENGINE over_libsumo
namespace caraware::over_libsumo {
namespace engine = ::libsumo;
}
#endif

#include "traffic-bridge/src/sumo/shim.h"

// SUMO's own (vehicle_object.h).
class MSLane;
class MSVehicle;

namespace caraware {

class ErrorTee;

namespace CARAWARE_ENGINE {

class EngineSimulation final : public Simulation {
public:
    EngineSimulation();
    ~EngineSimulation() override;

    void start(rust::Slice<const rust::String> arguments, rust::Str host, std::uint16_t port, std::uint32_t order) override;
    void close() override;
    void step() override;
    rust::Slice<const RawState> states() const override;
    rust::Slice<const RawEvent> events() const override;
    rust::Slice<const RawSignal> signals() const override;
    rust::String take_messages() override;
    double seconds_in_step() const override;
    double seconds_in_getters() const override;
    double seconds_in_signals() const override;

    std::uint64_t contacts() const override;
    double time() const override;
    double end_time() const override;
    double step_length() const override;
    rust::Vec<double> net_boundary() const override;
    std::int32_t min_expected() const override;

    rust::Vec<RawNetLane> net_lanes() override;
    void read_positions() override;
    std::uint64_t rides() const override;
    std::uint64_t loads() const override;

    rust::String vehicle_class(rust::Str vehicle_type) const override;
    rust::Vec<RawEdge> edges(rust::Str vehicle_class) const override;
    rust::Vec<RawLink> links(rust::Str vehicle_class) const override;
    void scale_speed_limits(double factor) override;

    void add_vehicle(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) override;
    void remove_vehicle(rust::Str id) override;
    void add_vehicle_at_start(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) override;
    void take_over(std::uint32_t index, bool keeps_limits) override;
    void move_vehicle(std::uint32_t index, double x, double y, double angle, double speed, double acceleration) override;
    double own_speed(std::uint32_t index) const override;
    rust::Vec<double> way_past(std::uint32_t index, std::uint32_t hero) const override;
    void ignore_in_junctions(std::uint32_t index, rust::Slice<const std::uint32_t> heroes) override;
    double person_limit(std::uint32_t index) const override;
    void limit_person(std::uint32_t index, double speed) override;
    void remove_by_index(std::uint32_t index) override;
    std::int32_t lane_index(std::uint32_t index) const override;
    rust::Vec<RawLane> route_lanes(std::uint32_t index) const override;
    rust::Vec<RawWay> route_ways(std::uint32_t index) const override;
    std::int32_t route_index(rust::Str id) const override;
    void extend_route(rust::Str id, rust::Slice<const rust::String> more) override;
    std::uint32_t set_destination(rust::Str id, rust::Str edge) override;

    rust::Vec<rust::String> walk(rust::Str from, double from_position, rust::Str to, double to_position) const override;
    void add_person(rust::Str id, rust::Str person_type, rust::Str edge, double position) override;
    void append_walk(rust::Str id, rust::Slice<const rust::String> edges, double arrival_position) override;
    std::int32_t remaining_stages(rust::Str id) const override;

private:
    // Id and kind of the road user at the same place of `states_`.
    struct Live {
        std::string id;
        bool is_person;
        bool gone;
    };

    // The traffic light of a link, by its place in `lights_`, and the number of the link there.
    struct LitLink {
        std::int32_t signal;
        std::uint32_t link;
    };

    const std::string* id_of(std::uint32_t index) const;
    const LitLink* lit_link(const std::string& from, const std::string& to) const;
    const std::string& known_id(std::uint32_t index) const;
    void note_departures();
    void note_arrivals();
    void note_teleports();
    void note_saved();
    void note_contacts();
    void note_loads();
    void depart(const std::string& id, bool is_person);
    void arrive(std::size_t place);
    void read_vehicle(const std::string& id, RawState& state);
    void read_on_road(const std::string& id, const MSVehicle& vehicle, RawState& state);
    void read_by_id(const std::string& id, RawState& state) const;
    std::int32_t lane_place(const std::string& id) const;
    void read_person(const std::string& id, RawState& state);
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
    // By the lanes of the link. Read for the first hero: no signal program of an episode has other links than the first.
    mutable std::map<std::pair<std::string, std::string>, LitLink> lit_links_;
    std::vector<RawSignal> signals_;
    // Place in `live_` of an id; vehicles and persons have separate names. Never iterated.
    std::unordered_map<std::string, std::size_t> vehicle_places_;
    std::unordered_map<std::string, std::size_t> person_places_;
    // Place among the net's lanes of an id; empty if lanes are not read. Never iterated.
    std::unordered_map<std::string, std::int32_t> lane_places_;
    // The same by SUMO's own lanes, of those on which a vehicle has been. Never iterated.
    std::unordered_map<const MSLane*, std::int32_t> lane_object_places_;
    // The same for edges.
    std::unordered_map<std::string, std::int32_t> edge_places_;
    // Of each lane of the net, by its place, that of its edge.
    std::vector<std::int32_t> lane_edges_;
    bool reads_positions_ = false;
    // Times that a person has boarded a vehicle.
    std::uint64_t rides_ = 0;
    // Containers on each vehicle that has some, and the times that one was loaded.
    std::map<std::string, std::set<std::string>> cargo_;
    std::uint64_t loads_ = 0;
    // Collider and victim of the contacts that SUMO listed in the last step, and the number of all that began.
    std::set<std::pair<std::string, std::string>> in_contact_;
    std::uint64_t contacts_ = 0;
    std::uint32_t next_index_ = 0;
    std::uint64_t steps_ = 0;
    std::uint64_t signal_period_steps_ = 1;
    bool has_elevation_ = false;
    bool any_gone_ = false;
    double seconds_in_step_ = 0.0;
    double seconds_in_getters_ = 0.0;
    double seconds_in_signals_ = 0.0;
};

}  // namespace CARAWARE_ENGINE
}  // namespace caraware
