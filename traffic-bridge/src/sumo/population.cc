// Calls of population control between two steps: roads, routes, new road users.
#include <algorithm>

#include "traffic-bridge/src/sumo/error_tee.h"
#include "traffic-bridge/src/sumo/lanes.h"
#include "traffic-bridge/src/sumo/engine.h"
#include "traffic-bridge/src/sumo/libsumo.rs.h"
#include "traffic-bridge/src/sumo/text.h"

namespace caraware::CARAWARE_ENGINE {

rust::String EngineSimulation::vehicle_class(rust::Str vehicle_type) const {
    return rust::String::lossy(engine::VehicleType::getVehicleClass(text(vehicle_type)));
}

rust::Vec<RawEdge> EngineSimulation::edges(rust::Str vehicle_class) const {
    rust::Vec<RawEdge> result;
    for (const std::string& edge : engine::Edge::getIDList()) {
        if (is_internal(edge)) {
            continue;
        }
        const std::vector<std::string> lanes = lanes_for(edge, text(vehicle_class));
        if (!lanes.empty()) {
            const std::string& lane = lanes.front();
            result.push_back(RawEdge{rust::String::lossy(edge), engine::Lane::getLength(lane),
                                     engine::Lane::getMaxSpeed(lane)});
        }
    }
    return result;
}

rust::Vec<RawLink> EngineSimulation::links(rust::Str vehicle_class) const {
    const std::string species = text(vehicle_class);
    rust::Vec<RawLink> result;
    for (const std::string& edge : engine::Edge::getIDList()) {
        if (is_internal(edge)) {
            continue;
        }
        for (const std::string& lane : lanes_for(edge, species)) {
            for (const libsumo::TraCIConnection& link : engine::Lane::getLinks(lane)) {
                const std::string next = engine::Lane::getEdgeID(link.approachedLane);
                if (!is_internal(next) && allows(link.approachedLane, species)) {
                    result.push_back(RawLink{rust::String::lossy(edge), rust::String::lossy(next), link.direction == "l"});
                }
            }
        }
    }
    return result;
}

void EngineSimulation::scale_speed_limits(double factor) {
    for (const std::string& lane : engine::Lane::getIDList()) {
        engine::Lane::setMaxSpeed(lane, factor * engine::Lane::getMaxSpeed(lane));
    }
}

void EngineSimulation::add_vehicle(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) {
    const std::string name = text(id);
    engine::Route::add(name, texts(route));
    engine::Vehicle::add(name, name, text(vehicle_type), "now", "best", "random_free", "max");
}

void EngineSimulation::remove_vehicle(rust::Str id) { engine::Vehicle::remove(text(id)); }

std::int32_t EngineSimulation::route_index(rust::Str id) const { return engine::Vehicle::getRouteIndex(text(id)); }

void EngineSimulation::extend_route(rust::Str id, rust::Slice<const rust::String> more) {
    const std::string name = text(id);
    const std::vector<std::string> route = engine::Vehicle::getRoute(name);
    const int index = std::max(engine::Vehicle::getRouteIndex(name), 0);
    std::vector<std::string> ahead(route.begin() + index, route.end());
    for (std::size_t i = 1; i < more.size(); ++i) {
        ahead.emplace_back(more[i]);
    }
    engine::Vehicle::setRoute(name, ahead);
}

std::uint32_t EngineSimulation::set_destination(rust::Str id, rust::Str edge) {
    const std::string name = text(id);
    engine::Vehicle::changeTarget(name, text(edge));
    return static_cast<std::uint32_t>(engine::Vehicle::getRoute(name).size());
}

rust::Vec<rust::String> EngineSimulation::walk(rust::Str from, double from_position, rust::Str to,
                                         double to_position) const {
    std::vector<std::string> edges;
    for (const libsumo::TraCIStage& stage : engine::Simulation::findIntermodalRoute(
             text(from), text(to), "", -1.0, 0, -1.0, -1.0, from_position, to_position)) {
        if (stage.type == libsumo::STAGE_WALKING) {
            edges.insert(edges.end(), stage.edges.begin(), stage.edges.end());
        }
    }
    return rust_texts(edges);
}

void EngineSimulation::add_person(rust::Str id, rust::Str person_type, rust::Str edge, double position) {
    engine::Person::add(text(id), text(edge), position, libsumo::DEPARTFLAG_NOW, text(person_type));
}

void EngineSimulation::append_walk(rust::Str id, rust::Slice<const rust::String> edges, double arrival_position) {
    engine::Person::appendWalkingStage(text(id), texts(edges), arrival_position);
}

std::int32_t EngineSimulation::remaining_stages(rust::Str id) const {
    return engine::Person::getRemainingStages(text(id));
}

}  // namespace caraware::CARAWARE_ENGINE
