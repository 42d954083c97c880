// The life of the simulation, and the one pass of getters after each step.
#include "traffic-bridge/src/sumo/engine.h"

#include <algorithm>
#include <cstdlib>
#include <ctime>
#include <iterator>
#include <limits>
#include <set>
#include <sstream>
#include <utility>

#include "traffic-bridge/src/sumo/error_tee.h"
#include "traffic-bridge/src/sumo/libsumo.rs.h"
#include "traffic-bridge/src/sumo/text.h"
#ifndef CARAWARE_OVER_TRACI
#include "traffic-bridge/src/sumo/vehicle_object.h"
#endif

namespace caraware::CARAWARE_ENGINE {

// Lamps change slowly: those of each vehicle are read this often.
constexpr double SIGNAL_PERIOD_S = 0.4;

// A road user that is on no lane of the net, or in no vehicle.
constexpr std::int32_t NO_LANE = -1;
constexpr std::int32_t AFOOT = -1;

// A traffic light changes when SUMO has announced it. Another signal program may start in between (WAUT), so each light is also
// read once in this many steps.
constexpr std::uint64_t SIGNAL_LOOK_STEPS = 50;

// Road users are sorted again when more than one in this many has departed since the last sort.
constexpr std::size_t LATE_SHARE = 16;

// Marks the place of a road user that has left.
constexpr std::size_t GONE = std::numeric_limits<std::size_t>::max();

// SUMO counts milliseconds.
constexpr double TIME_ROUNDING_S = 0.0005;

namespace {

bool net_has_elevation() {
    for (const std::string& lane : engine::Lane::getIDList()) {
        for (const libsumo::TraCIPosition& point : engine::Lane::getShape(lane).value) {
            if (point.z != 0.0 && point.z != libsumo::INVALID_DOUBLE_VALUE) {
                return true;
            }
        }
    }
    return false;
}

RawEvent event(RawEventKind kind, std::uint32_t index, bool is_person, const std::string& id) {
    return RawEvent{kind, index, is_person, rust::String::lossy(id), rust::String(), rust::String(), 0.0, 0.0, 0.0, 0.0, 0.0, 0.0};
}

template <typename Species>
void describe(RawEvent& departure, const std::string& id) {
    departure.vehicle_type = rust::String::lossy(Species::getTypeID(id));
    departure.vehicle_class = rust::String::lossy(Species::getVehicleClass(id));
    departure.length = Species::getLength(id);
    departure.width = Species::getWidth(id);
    departure.height = Species::getHeight(id);
}

// What the vehicle type lets SUMO do: the mirror must be able to follow.
void describe_limits(RawEvent& departure, const std::string& id) {
    const std::string type = engine::Vehicle::getTypeID(id);
    departure.accel = engine::VehicleType::getAccel(type);
    departure.decel = std::max(engine::VehicleType::getDecel(type), engine::VehicleType::getEmergencyDecel(type));
    departure.max_speed = engine::VehicleType::getMaxSpeed(type);
}

}  // namespace

EngineSimulation::EngineSimulation() : errors_(std::make_unique<ErrorTee>()) {}

EngineSimulation::~EngineSimulation() {
    try {
        close();
    } catch (const std::exception&) {
        // A destructor cannot report the error; SUMO has written its reason to standard error.
    }
}

void EngineSimulation::start(rust::Slice<const rust::String> arguments, rust::Str host, std::uint16_t port, std::uint32_t order) {
#ifdef CARAWARE_OVER_TRACI
    // SUMO runs already. Rust tries again while it does not listen yet.
    static_cast<void>(arguments);
    engine::Simulation::init(port, 0, text(host));
    if (order > 0) {
        engine::Simulation::setOrder(static_cast<int>(order));
    }
#else
    static_cast<void>(host);
    static_cast<void>(port);
    static_cast<void>(order);
    std::vector<std::string> command{"sumo"};
    const std::vector<std::string> options = texts(arguments);
    command.insert(command.end(), options.begin(), options.end());
    engine::Simulation::start(command);
#endif
    live_.clear();
    states_.clear();
    events_.clear();
    vehicle_places_.clear();
    person_places_.clear();
    reading_order_.clear();
    late_ = 0;
    lane_places_.clear();
    lane_object_places_.clear();
    edge_places_.clear();
    lane_edges_.clear();
    reads_positions_ = false;
    rides_ = 0;
    cargo_.clear();
    loads_ = 0;
    next_index_ = 0;
    steps_ = 0;
    contacts_ = 0;
    in_contact_.clear();
    signal_period_steps_ = static_cast<std::uint64_t>(std::max(1.0, SIGNAL_PERIOD_S / engine::Simulation::getDeltaT() + TIME_ROUNDING_S));
    any_gone_ = false;
    has_elevation_ = net_has_elevation();
    signals_.clear();
    lights_.clear();
    lit_links_.clear();
    std::vector<std::string> ids = engine::TrafficLight::getIDList();
    std::sort(ids.begin(), ids.end());
    for (std::string& id : ids) {
        lights_.push_back(Light{std::move(id), "", libsumo::INVALID_DOUBLE_VALUE});
    }
}

void EngineSimulation::close() {
    if (engine::Simulation::isLoaded()) {
        engine::Simulation::close("");
    }
}

void EngineSimulation::step() {
    const double start = processor_seconds();
    engine::Simulation::step();
    const double stepped = processor_seconds();
    events_.clear();
    // SUMO moves first and inserts last: an id that arrives and departs in one step arrived first.
    note_arrivals();
    note_departures();
    note_teleports();
    note_contacts();
    note_loads();
    read_all();
    const double read = processor_seconds();
    read_signals();
    ++steps_;
    seconds_in_step_ += stepped - start;
    seconds_in_getters_ += read - stepped;
    seconds_in_signals_ += processor_seconds() - read;
}

void EngineSimulation::read_signals() {
    signals_.clear();
    if (lights_.empty()) {
        return;
    }
    // The time at which the step began; SUMO's clock stands at its end.
    const double now = engine::Simulation::getTime() - engine::Simulation::getDeltaT();
    for (std::size_t index = 0; index < lights_.size(); ++index) {
        Light& light = lights_[index];
        const bool may_have_switched = light.next_switch <= now + TIME_ROUNDING_S;
        const bool is_its_turn = (steps_ + index) % SIGNAL_LOOK_STEPS == 0;
        if (!may_have_switched && !is_its_turn) {
            continue;
        }
        light.next_switch = engine::TrafficLight::getNextSwitch(light.id);
        std::string state = engine::TrafficLight::getRedYellowGreenState(light.id);
        if (state != light.published) {
            light.published = std::move(state);
            signals_.push_back(RawSignal{static_cast<std::uint32_t>(index), rust::String::lossy(light.id),
                                         rust::String::lossy(light.published)});
        }
    }
}

void EngineSimulation::note_arrivals() {
    for (const std::string& id : engine::Simulation::getArrivedIDList()) {
        if (const auto place = vehicle_places_.find(id); place != vehicle_places_.end()) {
            arrive(place->second);
        }
    }
    for (const std::string& id : engine::Simulation::getArrivedPersonIDList()) {
        if (const auto place = person_places_.find(id); place != person_places_.end()) {
            arrive(place->second);
        }
    }
    forget_gone();
}

void EngineSimulation::note_departures() {
    for (const std::string& id : engine::Simulation::getDepartedIDList()) {
        depart(id, false);
    }
    for (const std::string& id : engine::Simulation::getDepartedPersonIDList()) {
        depart(id, true);
    }
    if (steps_ == 0) {
        note_saved();
    }
}

// Road users of a saved state are on the road without having departed.
void EngineSimulation::note_saved() {
    for (const bool is_person : {false, true}) {
        std::vector<std::string> ids = is_person ? engine::Person::getIDList() : engine::Vehicle::getIDList();
        std::sort(ids.begin(), ids.end());
        for (const std::string& id : ids) {
            depart(id, is_person);
        }
    }
}

// SUMO lists a contact in every step in which it lasts.
void EngineSimulation::note_contacts() {
    std::set<std::pair<std::string, std::string>> now;
    for (const libsumo::TraCICollision& contact : engine::Simulation::getCollisions()) {
        const auto pair = std::make_pair(contact.collider, contact.victim);
        contacts_ += in_contact_.count(pair) == 0 && now.count(pair) == 0 ? 1 : 0;
        now.insert(pair);
    }
    in_contact_.swap(now);
}

// libsumo has no calls for containers, but a vehicle names those that it carries. They change while it stops.
void EngineSimulation::note_loads() {
    for (const std::string& id : engine::Simulation::getStopEndingVehiclesIDList()) {
        if (vehicle_places_.count(id) == 0 || engine::Vehicle::getParameter(id, "has.container.device") != "true") {
            continue;
        }
        std::istringstream names(engine::Vehicle::getParameter(id, "device.container.IDList"));
        const std::set<std::string> now{std::istream_iterator<std::string>(names), std::istream_iterator<std::string>()};
        std::set<std::string>& cargo = cargo_[id];
        for (const std::string& container : now) {
            loads_ += cargo.count(container) == 0 ? 1 : 0;
        }
        cargo = now;
    }
}

void EngineSimulation::note_teleports() {
    for (const std::string& id : engine::Simulation::getStartingTeleportIDList()) {
        if (const auto place = vehicle_places_.find(id); place != vehicle_places_.end()) {
            RawState& state = states_[place->second];
            state.speed = libsumo::INVALID_DOUBLE_VALUE;
            events_.push_back(event(RawEventKind::Teleported, state.index, false, id));
        }
    }
}

void EngineSimulation::depart(const std::string& id, bool is_person) {
    auto& places = is_person ? person_places_ : vehicle_places_;
    if (places.count(id) > 0) {
        return;
    }
    RawEvent departure = event(RawEventKind::Departed, next_index_, is_person, id);
    try {
        if (is_person) {
            describe<engine::Person>(departure, id);
        } else {
            describe<engine::Vehicle>(departure, id);
            describe_limits(departure, id);
        }
    } catch (const libsumo::TraCIException&) {
        return;  // It departed and left within the step.
    }
    const double invalid = libsumo::INVALID_DOUBLE_VALUE;
    places.emplace(id, live_.size());
    reading_order_.push_back(live_.size());
    ++late_;
    live_.push_back(Live{id, is_person, false});
    states_.push_back(RawState{invalid, invalid, 0.0, 0.0, 0.0, invalid, invalid, 0, next_index_, NO_LANE, 0.0, NO_LANE, NO_LANE, invalid, AFOOT});
    events_.push_back(std::move(departure));
    ++next_index_;
}

void EngineSimulation::arrive(std::size_t place) {
    Live& road_user = live_[place];
    if (!road_user.gone) {
        road_user.gone = true;
        any_gone_ = true;
        events_.push_back(event(RawEventKind::Arrived, states_[place].index, road_user.is_person, road_user.id));
        if (!road_user.is_person) {
            cargo_.erase(road_user.id);
        }
    }
}

void EngineSimulation::read_vehicle(const std::string& id, RawState& state) {
    state.previous_speed = state.speed;
    state.lane = NO_LANE;
#ifdef CARAWARE_OVER_TRACI
    const bool is_on_road = false;
#else
    // In every step: SUMO may have deleted the vehicle without listing it as arrived, and then this throws.
    const MSVehicle* const vehicle = vehicle_object(id);
    const bool is_on_road = vehicle != nullptr && vehicle->isOnRoad();
    if (is_on_road) {
        read_on_road(id, *vehicle, state);
    }
#endif
    if (!is_on_road) {
        read_by_id(id, state);
    }
    if (state.x == libsumo::INVALID_DOUBLE_VALUE) {
        return;
    }
    if (reads_positions_) {
        state.edge = state.lane == NO_LANE ? NO_LANE : lane_edges_[static_cast<std::size_t>(state.lane)];
    }
    if ((steps_ + state.index) % signal_period_steps_ == 0) {
        state.signals = engine::Vehicle::getSignals(id);
    }
}

#ifndef CARAWARE_OVER_TRACI
// As `read_by_id`, without a search by id for each value.
void EngineSimulation::read_on_road(const std::string& id, const MSVehicle& vehicle, RawState& state) {
    const MSVehiclePosition position = vehicle.getPosition(0.0);
    state.x = position.x;
    state.y = position.y;
    state.z = position.z;
    state.angle = GeomHelper::naviDegree(vehicle.getAngle());
    state.speed = vehicle.getSpeed();
    if (has_elevation_) {
        state.slope = vehicle.getSlope();
    }
    if (!lane_places_.empty()) {
        const auto [place, is_new] = lane_object_places_.try_emplace(vehicle.getLane(), NO_LANE);
        if (is_new) {
            place->second = lane_place(engine::Vehicle::getLaneID(id));
        }
        state.lane = place->second;
        state.lane_position = vehicle.getPositionOnLane();
    }
    if (reads_positions_) {
        state.route_index = vehicle.getRoutePosition();
        state.odometer = vehicle.getOdometer();
    }
}
#endif

void EngineSimulation::read_by_id(const std::string& id, RawState& state) const {
    const libsumo::TraCIPosition position = engine::Vehicle::getPosition3D(id);
    state.x = position.x;
    state.y = position.y;
    state.z = position.z;
    state.angle = engine::Vehicle::getAngle(id);
    state.speed = engine::Vehicle::getSpeed(id);
    if (position.x == libsumo::INVALID_DOUBLE_VALUE) {
        return;
    }
    if (has_elevation_) {
        // A hero beside the road is on no lane, and has no slope for SUMO: it keeps its last.
        const double slope = engine::Vehicle::getSlope(id);
        if (slope != libsumo::INVALID_DOUBLE_VALUE) {
            state.slope = slope;
        }
    }
    if (!lane_places_.empty()) {
        state.lane = lane_place(engine::Vehicle::getLaneID(id));
        state.lane_position = engine::Vehicle::getLanePosition(id);
    }
    if (reads_positions_) {
        state.route_index = engine::Vehicle::getRouteIndex(id);
        state.odometer = engine::Vehicle::getDistance(id);
    }
}

std::int32_t EngineSimulation::lane_place(const std::string& id) const {
    const auto place = lane_places_.find(id);
    return place == lane_places_.end() ? NO_LANE : place->second;
}

void EngineSimulation::read_person(const std::string& id, RawState& state) {
    // A person in a vehicle is not a road user.
    const std::string carrier = engine::Person::getVehicle(id);
    const bool afoot = carrier.empty();
    if (!afoot && state.carrier == AFOOT) {
        ++rides_;
    }
    const auto place = afoot ? vehicle_places_.end() : vehicle_places_.find(carrier);
    state.carrier = place == vehicle_places_.end() ? AFOOT : static_cast<std::int32_t>(states_[place->second].index);
    const libsumo::TraCIPosition position = afoot ? engine::Person::getPosition3D(id) : libsumo::TraCIPosition();
    state.previous_speed = state.speed;
    state.x = position.x;
    state.y = position.y;
    state.z = position.z;
    if (position.x == libsumo::INVALID_DOUBLE_VALUE) {
        state.speed = libsumo::INVALID_DOUBLE_VALUE;
        return;
    }
    if (reads_positions_) {
        const auto lane = lane_places_.find(engine::Person::getLaneID(id));
        const auto edge = edge_places_.find(engine::Person::getRoadID(id));
        state.lane = lane == lane_places_.end() ? NO_LANE : lane->second;
        state.edge = edge == edge_places_.end() ? NO_LANE : edge->second;
        state.lane_position = engine::Person::getLanePosition(id);
    }
    state.angle = engine::Person::getAngle(id);
    state.speed = engine::Person::getSpeed(id);
    if (has_elevation_) {
        state.slope = engine::Person::getSlope(id);
    }
}

void EngineSimulation::put_in_order() {
    // Sorting takes longer than it saves if few have departed.
    if (late_ * LATE_SHARE <= reading_order_.size()) {
        return;
    }
    std::sort(reading_order_.begin(), reading_order_.end(), [this](std::size_t a, std::size_t b) {
        return live_[a].is_person != live_[b].is_person ? live_[b].is_person : live_[a].id < live_[b].id;
    });
    late_ = 0;
}

void EngineSimulation::read_all() {
    put_in_order();
    for (const std::size_t place : reading_order_) {
        const Live& road_user = live_[place];
        try {
            if (road_user.is_person) {
                read_person(road_user.id, states_[place]);
            } else {
                read_vehicle(road_user.id, states_[place]);
            }
        } catch (const libsumo::TraCIException&) {
            arrive(place);  // SUMO removed it without listing it among the arrivals.
        }
    }
    forget_gone();
}

void EngineSimulation::forget_gone() {
    if (!any_gone_) {
        return;
    }
    std::size_t kept = 0;
    moved_.assign(live_.size(), GONE);
    for (std::size_t place = 0; place < live_.size(); ++place) {
        auto& places = live_[place].is_person ? person_places_ : vehicle_places_;
        if (live_[place].gone) {
            places.erase(live_[place].id);
            continue;
        }
        moved_[place] = kept;
        if (kept != place) {
            places[live_[place].id] = kept;
            live_[kept] = std::move(live_[place]);
            states_[kept] = states_[place];
        }
        ++kept;
    }
    live_.erase(live_.begin() + static_cast<std::ptrdiff_t>(kept), live_.end());
    states_.erase(states_.begin() + static_cast<std::ptrdiff_t>(kept), states_.end());
    for (std::size_t& place : reading_order_) {
        place = moved_[place];
    }
    reading_order_.erase(std::remove(reading_order_.begin(), reading_order_.end(), GONE), reading_order_.end());
    any_gone_ = false;
}

rust::Vec<RawNetLane> EngineSimulation::net_lanes() {
    std::vector<std::string> ids = engine::Lane::getIDList();
    // The same indices for the same net, whatever the order in which SUMO keeps its lanes.
    std::sort(ids.begin(), ids.end());
    for (std::size_t place = 0; place < ids.size(); ++place) {
        lane_places_.emplace(ids[place], static_cast<std::int32_t>(place));
    }
    rust::Vec<RawNetLane> lanes;
    lanes.reserve(ids.size());
    for (const std::string& id : ids) {
        RawNetLane lane;
        const std::string edge = engine::Lane::getEdgeID(id);
        const std::int32_t edge_place = edge_places_.emplace(edge, static_cast<std::int32_t>(edge_places_.size())).first->second;
        lane_edges_.push_back(edge_place);
        lane.id = rust::String::lossy(id);
        lane.edge_id = rust::String::lossy(edge);
        lane.edge = static_cast<std::uint32_t>(edge_place);
        lane.length = engine::Lane::getLength(id);
        for (const libsumo::TraCIPosition& point : engine::Lane::getShape(id).value) {
            lane.shape.push_back(point.x);
            lane.shape.push_back(point.y);
            lane.shape.push_back(point.z == libsumo::INVALID_DOUBLE_VALUE ? 0.0 : point.z);
        }
        for (const libsumo::TraCIConnection& link : engine::Lane::getLinks(id)) {
            const std::string& next = link.approachedInternal.empty() ? link.approachedLane : link.approachedInternal;
            if (const auto place = lane_places_.find(next); place != lane_places_.end()) {
                lane.next.push_back(static_cast<std::uint32_t>(place->second));
            }
        }
        lanes.push_back(std::move(lane));
    }
    return lanes;
}

void EngineSimulation::read_positions() { reads_positions_ = true; }

std::uint64_t EngineSimulation::rides() const { return rides_; }

std::uint64_t EngineSimulation::loads() const { return loads_; }

rust::Slice<const RawState> EngineSimulation::states() const { return {states_.data(), states_.size()}; }

rust::Slice<const RawEvent> EngineSimulation::events() const { return {events_.data(), events_.size()}; }

rust::Slice<const RawSignal> EngineSimulation::signals() const { return {signals_.data(), signals_.size()}; }

rust::String EngineSimulation::take_messages() { return rust::String::lossy(errors_->take()); }

double EngineSimulation::seconds_in_step() const { return seconds_in_step_; }

double EngineSimulation::seconds_in_getters() const { return seconds_in_getters_; }

double EngineSimulation::seconds_in_signals() const { return seconds_in_signals_; }

std::uint64_t EngineSimulation::contacts() const { return contacts_; }

double EngineSimulation::time() const { return engine::Simulation::getTime(); }

double EngineSimulation::end_time() const { return engine::Simulation::getEndTime(); }

double EngineSimulation::step_length() const { return engine::Simulation::getDeltaT(); }

rust::Vec<double> EngineSimulation::net_boundary() const {
    rust::Vec<double> corners;
    for (const libsumo::TraCIPosition& corner : engine::Simulation::getNetBoundary().value) {
        corners.push_back(corner.x);
        corners.push_back(corner.y);
    }
    return corners;
}

std::int32_t EngineSimulation::min_expected() const { return engine::Simulation::getMinExpectedNumber(); }

}  // namespace caraware::CARAWARE_ENGINE

namespace caraware {

#ifdef CARAWARE_OVER_TRACI
std::unique_ptr<Simulation> new_remote_simulation() { return std::make_unique<over_traci::EngineSimulation>(); }
#else
double processor_seconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

std::unique_ptr<Simulation> new_simulation() { return std::make_unique<over_libsumo::EngineSimulation>(); }

void set_environment(rust::Str name, rust::Str value) { setenv(text(name).c_str(), text(value).c_str(), 1); }
#endif

}  // namespace caraware
