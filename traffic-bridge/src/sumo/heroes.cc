// Heroes: vehicles that SUMO does not move, and the lanes ahead of them.
#include <algorithm>
#include <stdexcept>
#include <utility>

#include "traffic-bridge/src/sumo/error_tee.h"
#include "traffic-bridge/src/sumo/lanes.h"
#include "traffic-bridge/src/sumo/engine.h"
#include "traffic-bridge/src/sumo/libsumo.rs.h"
#include "traffic-bridge/src/sumo/text.h"

namespace caraware::CARAWARE_ENGINE {

namespace {

// moveToXY: any lane nearby, and the exact position even where there is none.
constexpr int FREE_MOVEMENT = 2;
// Largest distance from a lane at which SUMO still matches a hero to it, metres.
constexpr double MATCH_THRESHOLD_M = 20.0;
// SUMO's own driver gives way at junctions and stops at red; what it would do is not done, so nothing else is checked.
constexpr int GIVES_WAY_AND_STOPS = 8 + 16;
// Factor on speed limits, speed (m/s) and deceleration (m/s²) that no hero reaches.
constexpr double UNLIMITED = 100.0;
// A link through a junction has at most two internal lanes in sequence; more would be a loop.
constexpr int MAX_INTERNAL_LANES = 8;

// How far a vehicle looks for what it waits for, metres.
constexpr double LOOKS_AHEAD_M = 30.0;

using LaneShape = rust::Vec<double>;

bool is_in_junction(const std::string& lane) { return !lane.empty() && lane.front() == ':'; }

void append(LaneShape& shape, const std::string& lane) {
    for (const libsumo::TraCIPosition& point : engine::Lane::getShape(lane).value) {
        shape.push_back(point.x);
        shape.push_back(point.y);
    }
}

std::uint32_t number_of(const std::string& lane) {
    return static_cast<std::uint32_t>(std::stoul(lane.substr(lane.rfind('_') + 1)));
}

bool is_for_people_alone(const std::string& lane) {
    return engine::Lane::getAllowed(lane) == std::vector<std::string>{"pedestrian"};
}

// Whether no vehicle has precedence over a link where no traffic light decides. SUMO's letter of a major link ("M") is not enough:
// one that gives way to a crossing alone has that of a minor link ("m"), or that of right before left ("=").
bool has_right_of_way(const std::string& from, const libsumo::TraCIConnection& link) {
    if (link.state != "m" && link.state != "=") {
        return link.state == "M";
    }
    const std::vector<std::string> foes = engine::Lane::getFoes(from, link.approachedLane);
    return std::all_of(foes.begin(), foes.end(), is_for_people_alone);
}

RawWay way(std::uint32_t edge, const std::string& from, const libsumo::TraCIConnection& link) {
    RawWay result{edge, number_of(from), number_of(link.approachedLane), engine::Lane::getMaxSpeed(from), {}, -1, 0,
                  has_right_of_way(from, link)};
    std::string internal = link.approachedInternal;
    for (int count = 0; !internal.empty() && count < MAX_INTERNAL_LANES; ++count) {
        append(result.shape, internal);
        result.speed_limit = engine::Lane::getMaxSpeed(internal);
        const std::vector<libsumo::TraCIConnection> onward = engine::Lane::getLinks(internal);
        internal = onward.empty() ? std::string() : onward.front().approachedInternal;
    }
    return result;
}

}  // namespace

const std::string* EngineSimulation::id_of(std::uint32_t index) const {
    const auto found = std::lower_bound(states_.begin(), states_.end(), index,
                                        [](const RawState& state, std::uint32_t wanted) { return state.index < wanted; });
    if (found == states_.end() || found->index != index) {
        return nullptr;
    }
    return &live_[static_cast<std::size_t>(found - states_.begin())].id;
}

const std::string& EngineSimulation::known_id(std::uint32_t index) const {
    const std::string* id = id_of(index);
    if (id == nullptr) {
        throw std::out_of_range("no road user has the index " + std::to_string(index));
    }
    return *id;
}

void EngineSimulation::add_vehicle_at_start(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) {
    const std::string name = text(id);
    engine::Route::add(name, texts(route));
    engine::Vehicle::add(name, name, text(vehicle_type), "now", "best", "base", "0");
}

void EngineSimulation::take_over(std::uint32_t index, bool keeps_limits) {
    const std::string& id = known_id(index);
    engine::Vehicle::setLaneChangeMode(id, 0);
    if (keeps_limits) {
        engine::Vehicle::setSpeedMode(id, GIVES_WAY_AND_STOPS);
        engine::Vehicle::setImperfection(id, 0.0);
        engine::Vehicle::setSpeedFactor(id, 1.0);
        engine::Vehicle::setEmergencyDecel(id, UNLIMITED);
        return;
    }
    engine::Vehicle::setSpeedMode(id, 0);
    // SUMO computes a moved vehicle's speed from the distance it covers, but never above these limits.
    engine::Vehicle::setSpeedFactor(id, UNLIMITED);
    engine::Vehicle::setMaxSpeed(id, UNLIMITED);
    engine::Vehicle::setEmergencyDecel(id, UNLIMITED);
}

void EngineSimulation::move_vehicle(std::uint32_t index, double x, double y, double angle, double speed, double acceleration) {
    const std::string& id = known_id(index);
    engine::Vehicle::moveToXY(id, "", -1, x, y, angle, FREE_MOVEMENT, MATCH_THRESHOLD_M);
    engine::Vehicle::setPreviousSpeed(id, speed, acceleration);
}

double EngineSimulation::own_speed(std::uint32_t index) const { return engine::Vehicle::getSpeedWithoutTraCI(known_id(index)); }

rust::Vec<double> EngineSimulation::way_past(std::uint32_t index, std::uint32_t hero) const {
    LaneShape result;
    const std::string& id = known_id(index);
    const std::string& hero_id = known_id(hero);
    const std::string hero_lane = engine::Vehicle::getLaneID(hero_id);
    const std::string lane = engine::Vehicle::getLaneID(id);
    if (lane.empty() || lane == hero_lane || !is_in_junction(hero_lane)) {
        return result;
    }
    const auto foes = engine::Vehicle::getJunctionFoes(id, LOOKS_AHEAD_M);
    const bool gives_way = std::any_of(foes.begin(), foes.end(), [&](const libsumo::TraCIJunctionFoe& foe) {
        return foe.foeId == hero_id && foe.egoResponse;
    });
    if (!gives_way && engine::Vehicle::getLeader(id, LOOKS_AHEAD_M).first != hero_id) {
        return result;
    }
    append(result, lane);
    const std::vector<libsumo::TraCIConnection> onward = engine::Vehicle::getNextLinks(id);
    if (onward.empty()) {
        return result;
    }
    std::string internal = onward.front().approachedInternal;
    for (int count = 0; !internal.empty() && count < MAX_INTERNAL_LANES; ++count) {
        append(result, internal);
        const std::vector<libsumo::TraCIConnection> after = engine::Lane::getLinks(internal);
        internal = after.empty() ? std::string() : after.front().approachedInternal;
    }
    append(result, onward.front().approachedLane);
    return result;
}

void EngineSimulation::ignore_in_junctions(std::uint32_t index, rust::Slice<const std::uint32_t> heroes) {
    std::string ids;
    for (const std::uint32_t hero : heroes) {
        ids += (ids.empty() ? "" : " ") + known_id(hero);
    }
    engine::Vehicle::setParameter(known_id(index), "junctionModel.ignoreIDs", ids);
}

double EngineSimulation::person_limit(std::uint32_t index) const { return engine::Person::getMaxSpeed(known_id(index)); }

void EngineSimulation::limit_person(std::uint32_t index, double speed) { engine::Person::setMaxSpeed(known_id(index), speed); }

void EngineSimulation::remove_by_index(std::uint32_t index) {
    if (const std::string* id = id_of(index); id != nullptr) {
        engine::Vehicle::remove(*id);
    }
}

std::int32_t EngineSimulation::lane_index(std::uint32_t index) const { return engine::Vehicle::getLaneIndex(known_id(index)); }

rust::Vec<RawLane> EngineSimulation::route_lanes(std::uint32_t index) const {
    const std::string& id = known_id(index);
    const std::string species = engine::Vehicle::getVehicleClass(id);
    rust::Vec<RawLane> result;
    std::uint32_t place = 0;
    for (const std::string& edge : engine::Vehicle::getRoute(id)) {
        for (const std::string& lane : lanes_for(edge, species)) {
            RawLane raw{place, number_of(lane), engine::Lane::getMaxSpeed(lane), {}};
            append(raw.shape, lane);
            result.push_back(std::move(raw));
        }
        ++place;
    }
    return result;
}

const EngineSimulation::LitLink* EngineSimulation::lit_link(const std::string& from, const std::string& to) const {
    if (lit_links_.empty()) {
        for (std::size_t signal = 0; signal < lights_.size(); ++signal) {
            const auto links = engine::TrafficLight::getControlledLinks(lights_[signal].id);
            for (std::size_t link = 0; link < links.size(); ++link) {
                for (const libsumo::TraCILink& way : links[link]) {
                    lit_links_.insert({{way.fromLane, way.toLane},
                                       LitLink{static_cast<std::int32_t>(signal), static_cast<std::uint32_t>(link)}});
                }
            }
        }
    }
    const auto found = lit_links_.find({from, to});
    return found == lit_links_.end() ? nullptr : &found->second;
}

rust::Vec<RawWay> EngineSimulation::route_ways(std::uint32_t index) const {
    const std::string& id = known_id(index);
    const std::string species = engine::Vehicle::getVehicleClass(id);
    const std::vector<std::string> route = engine::Vehicle::getRoute(id);
    rust::Vec<RawWay> result;
    for (std::size_t place = 0; place + 1 < route.size(); ++place) {
        for (const std::string& lane : lanes_for(route[place], species)) {
            for (const libsumo::TraCIConnection& link : engine::Lane::getLinks(lane)) {
                if (engine::Lane::getEdgeID(link.approachedLane) != route[place + 1] ||
                    !allows(link.approachedLane, species)) {
                    continue;
                }
                RawWay raw = way(static_cast<std::uint32_t>(place), lane, link);
                if (const LitLink* lit = lit_link(lane, link.approachedLane); lit != nullptr) {
                    raw.signal = lit->signal;
                    raw.link = lit->link;
                }
                result.push_back(std::move(raw));
            }
        }
    }
    return result;
}

}  // namespace caraware::CARAWARE_ENGINE
