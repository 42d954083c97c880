// The life of the simulation, and the one pass of getters after each step.
#include "traffic-bridge/src/sumo/shim.h"

#include <algorithm>
#include <cstdlib>
#include <ctime>
#include <limits>
#include <utility>

#include <libsumo/libsumo.h>

#include "traffic-bridge/src/sumo/error_tee.h"
#include "traffic-bridge/src/sumo/libsumo.rs.h"
#include "traffic-bridge/src/sumo/text.h"

namespace caraware {

// Lamps change slowly: those of each vehicle are read this often.
constexpr double SIGNAL_PERIOD_S = 0.4;

// A road user that is on no lane of the net.
constexpr std::int32_t NO_LANE = -1;

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
    for (const std::string& lane : libsumo::Lane::getIDList()) {
        for (const libsumo::TraCIPosition& point : libsumo::Lane::getShape(lane).value) {
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
    const std::string type = libsumo::Vehicle::getTypeID(id);
    departure.accel = libsumo::VehicleType::getAccel(type);
    departure.decel = std::max(libsumo::VehicleType::getDecel(type), libsumo::VehicleType::getEmergencyDecel(type));
    departure.max_speed = libsumo::VehicleType::getMaxSpeed(type);
}

}  // namespace

Simulation::Simulation() : errors_(std::make_unique<ErrorTee>()) {}

Simulation::~Simulation() {
    try {
        close();
    } catch (const std::exception&) {
        // A destructor cannot report the error; SUMO has written its reason to standard error.
    }
}

void Simulation::start(rust::Slice<const rust::String> arguments) {
    std::vector<std::string> command{"sumo"};
    const std::vector<std::string> options = texts(arguments);
    command.insert(command.end(), options.begin(), options.end());
    libsumo::Simulation::start(command);
    live_.clear();
    states_.clear();
    events_.clear();
    vehicle_places_.clear();
    person_places_.clear();
    reading_order_.clear();
    late_ = 0;
    lane_places_.clear();
    next_index_ = 0;
    steps_ = 0;
    signal_period_steps_ = static_cast<std::uint64_t>(std::max(1.0, SIGNAL_PERIOD_S / libsumo::Simulation::getDeltaT() + TIME_ROUNDING_S));
    any_gone_ = false;
    has_elevation_ = net_has_elevation();
    signals_.clear();
    lights_.clear();
    std::vector<std::string> ids = libsumo::TrafficLight::getIDList();
    std::sort(ids.begin(), ids.end());
    for (std::string& id : ids) {
        lights_.push_back(Light{std::move(id), "", libsumo::INVALID_DOUBLE_VALUE});
    }
}

void Simulation::close() {
    if (libsumo::Simulation::isLoaded()) {
        libsumo::Simulation::close("");
    }
}

void Simulation::step() {
    const double start = processor_seconds();
    libsumo::Simulation::step();
    const double stepped = processor_seconds();
    events_.clear();
    // SUMO moves first and inserts last: an id that arrives and departs in one step arrived first.
    note_arrivals();
    note_departures();
    note_teleports();
    read_all();
    const double read = processor_seconds();
    read_signals();
    ++steps_;
    seconds_in_step_ += stepped - start;
    seconds_in_getters_ += read - stepped;
    seconds_in_signals_ += processor_seconds() - read;
}

void Simulation::read_signals() {
    signals_.clear();
    if (lights_.empty()) {
        return;
    }
    // The time at which the step began; SUMO's clock stands at its end.
    const double now = libsumo::Simulation::getTime() - libsumo::Simulation::getDeltaT();
    for (std::size_t index = 0; index < lights_.size(); ++index) {
        Light& light = lights_[index];
        const bool may_have_switched = light.next_switch <= now + TIME_ROUNDING_S;
        const bool is_its_turn = (steps_ + index) % SIGNAL_LOOK_STEPS == 0;
        if (!may_have_switched && !is_its_turn) {
            continue;
        }
        light.next_switch = libsumo::TrafficLight::getNextSwitch(light.id);
        std::string state = libsumo::TrafficLight::getRedYellowGreenState(light.id);
        if (state != light.published) {
            light.published = std::move(state);
            signals_.push_back(RawSignal{static_cast<std::uint32_t>(index), rust::String::lossy(light.id),
                                         rust::String::lossy(light.published)});
        }
    }
}

void Simulation::note_arrivals() {
    for (const std::string& id : libsumo::Simulation::getArrivedIDList()) {
        if (const auto place = vehicle_places_.find(id); place != vehicle_places_.end()) {
            arrive(place->second);
        }
    }
    for (const std::string& id : libsumo::Simulation::getArrivedPersonIDList()) {
        if (const auto place = person_places_.find(id); place != person_places_.end()) {
            arrive(place->second);
        }
    }
    forget_gone();
}

void Simulation::note_departures() {
    for (const std::string& id : libsumo::Simulation::getDepartedIDList()) {
        depart(id, false);
    }
    for (const std::string& id : libsumo::Simulation::getDepartedPersonIDList()) {
        depart(id, true);
    }
}

void Simulation::note_teleports() {
    for (const std::string& id : libsumo::Simulation::getStartingTeleportIDList()) {
        if (const auto place = vehicle_places_.find(id); place != vehicle_places_.end()) {
            RawState& state = states_[place->second];
            state.speed = libsumo::INVALID_DOUBLE_VALUE;
            events_.push_back(event(RawEventKind::Teleported, state.index, false, id));
        }
    }
}

void Simulation::depart(const std::string& id, bool is_person) {
    auto& places = is_person ? person_places_ : vehicle_places_;
    if (places.count(id) > 0) {
        return;
    }
    RawEvent departure = event(RawEventKind::Departed, next_index_, is_person, id);
    try {
        if (is_person) {
            describe<libsumo::Person>(departure, id);
        } else {
            describe<libsumo::Vehicle>(departure, id);
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
    states_.push_back(RawState{invalid, invalid, 0.0, 0.0, 0.0, invalid, invalid, 0, next_index_, NO_LANE, 0.0});
    events_.push_back(std::move(departure));
    ++next_index_;
}

void Simulation::arrive(std::size_t place) {
    Live& road_user = live_[place];
    if (!road_user.gone) {
        road_user.gone = true;
        any_gone_ = true;
        events_.push_back(event(RawEventKind::Arrived, states_[place].index, road_user.is_person, road_user.id));
    }
}

void Simulation::read_vehicle(const std::string& id, RawState& state) const {
    const libsumo::TraCIPosition position = libsumo::Vehicle::getPosition3D(id);
    state.previous_speed = state.speed;
    state.x = position.x;
    state.y = position.y;
    state.z = position.z;
    state.angle = libsumo::Vehicle::getAngle(id);
    state.speed = libsumo::Vehicle::getSpeed(id);
    state.lane = NO_LANE;
    if (position.x == libsumo::INVALID_DOUBLE_VALUE) {
        return;
    }
    if (has_elevation_) {
        state.slope = libsumo::Vehicle::getSlope(id);
    }
    if (!lane_places_.empty()) {
        const auto lane = lane_places_.find(libsumo::Vehicle::getLaneID(id));
        state.lane = lane == lane_places_.end() ? NO_LANE : lane->second;
        state.lane_position = libsumo::Vehicle::getLanePosition(id);
    }
    if ((steps_ + state.index) % signal_period_steps_ == 0) {
        state.signals = libsumo::Vehicle::getSignals(id);
    }
}

void Simulation::read_person(const std::string& id, RawState& state) const {
    // A person in a vehicle is not a road user.
    const bool afoot = libsumo::Person::getVehicle(id).empty();
    const libsumo::TraCIPosition position = afoot ? libsumo::Person::getPosition3D(id) : libsumo::TraCIPosition();
    state.previous_speed = state.speed;
    state.x = position.x;
    state.y = position.y;
    state.z = position.z;
    if (position.x == libsumo::INVALID_DOUBLE_VALUE) {
        state.speed = libsumo::INVALID_DOUBLE_VALUE;
        return;
    }
    state.angle = libsumo::Person::getAngle(id);
    state.speed = libsumo::Person::getSpeed(id);
    if (has_elevation_) {
        state.slope = libsumo::Person::getSlope(id);
    }
}

void Simulation::put_in_order() {
    // Sorting takes longer than it saves if few have departed.
    if (late_ * LATE_SHARE <= reading_order_.size()) {
        return;
    }
    std::sort(reading_order_.begin(), reading_order_.end(), [this](std::size_t a, std::size_t b) {
        return live_[a].is_person != live_[b].is_person ? live_[b].is_person : live_[a].id < live_[b].id;
    });
    late_ = 0;
}

void Simulation::read_all() {
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

void Simulation::forget_gone() {
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

rust::Vec<RawNetLane> Simulation::net_lanes() {
    const std::vector<std::string> ids = libsumo::Lane::getIDList();
    std::unordered_map<std::string, std::uint32_t> edges;
    for (std::size_t place = 0; place < ids.size(); ++place) {
        lane_places_.emplace(ids[place], static_cast<std::int32_t>(place));
    }
    rust::Vec<RawNetLane> lanes;
    lanes.reserve(ids.size());
    for (const std::string& id : ids) {
        RawNetLane lane;
        lane.edge = edges.emplace(libsumo::Lane::getEdgeID(id), static_cast<std::uint32_t>(edges.size())).first->second;
        lane.length = libsumo::Lane::getLength(id);
        for (const libsumo::TraCIPosition& point : libsumo::Lane::getShape(id).value) {
            lane.shape.push_back(point.x);
            lane.shape.push_back(point.y);
            lane.shape.push_back(point.z == libsumo::INVALID_DOUBLE_VALUE ? 0.0 : point.z);
        }
        for (const libsumo::TraCIConnection& link : libsumo::Lane::getLinks(id)) {
            const std::string& next = link.approachedInternal.empty() ? link.approachedLane : link.approachedInternal;
            if (const auto place = lane_places_.find(next); place != lane_places_.end()) {
                lane.next.push_back(static_cast<std::uint32_t>(place->second));
            }
        }
        lanes.push_back(std::move(lane));
    }
    return lanes;
}

rust::Slice<const RawState> Simulation::states() const { return {states_.data(), states_.size()}; }

rust::Slice<const RawEvent> Simulation::events() const { return {events_.data(), events_.size()}; }

rust::Slice<const RawSignal> Simulation::signals() const { return {signals_.data(), signals_.size()}; }

rust::String Simulation::take_messages() { return rust::String::lossy(errors_->take()); }

double Simulation::seconds_in_step() const { return seconds_in_step_; }

double Simulation::seconds_in_getters() const { return seconds_in_getters_; }

double Simulation::seconds_in_signals() const { return seconds_in_signals_; }

double Simulation::time() const { return libsumo::Simulation::getTime(); }

double Simulation::end_time() const { return libsumo::Simulation::getEndTime(); }

double Simulation::step_length() const { return libsumo::Simulation::getDeltaT(); }

std::int32_t Simulation::min_expected() const { return libsumo::Simulation::getMinExpectedNumber(); }

double processor_seconds() {
    timespec now{};
    clock_gettime(CLOCK_THREAD_CPUTIME_ID, &now);
    return static_cast<double>(now.tv_sec) + 1e-9 * static_cast<double>(now.tv_nsec);
}

std::unique_ptr<Simulation> new_simulation() { return std::make_unique<Simulation>(); }

void set_environment(rust::Str name, rust::Str value) { setenv(text(name).c_str(), text(value).c_str(), 1); }

}  // namespace caraware
