// Calls of population control between two steps: roads, routes, new road users.
#include <algorithm>

#include <libsumo/libsumo.h>

#include "traffic-bridge/src/sumo/error_tee.h"
#include "traffic-bridge/src/sumo/lanes.h"
#include "traffic-bridge/src/sumo/shim.h"
#include "traffic-bridge/src/sumo/libsumo.rs.h"
#include "traffic-bridge/src/sumo/text.h"

namespace caraware {

rust::String Simulation::vehicle_class(rust::Str vehicle_type) const {
    return rust::String::lossy(libsumo::VehicleType::getVehicleClass(text(vehicle_type)));
}

rust::Vec<RawEdge> Simulation::edges(rust::Str vehicle_class) const {
    rust::Vec<RawEdge> result;
    for (const std::string& edge : libsumo::Edge::getIDList()) {
        if (is_internal(edge)) {
            continue;
        }
        const std::vector<std::string> lanes = lanes_for(edge, text(vehicle_class));
        if (!lanes.empty()) {
            const std::string& lane = lanes.front();
            result.push_back(RawEdge{rust::String::lossy(edge), libsumo::Lane::getLength(lane),
                                     libsumo::Lane::getMaxSpeed(lane)});
        }
    }
    return result;
}

rust::Vec<RawLink> Simulation::links(rust::Str vehicle_class) const {
    const std::string species = text(vehicle_class);
    rust::Vec<RawLink> result;
    for (const std::string& edge : libsumo::Edge::getIDList()) {
        if (is_internal(edge)) {
            continue;
        }
        for (const std::string& lane : lanes_for(edge, species)) {
            for (const libsumo::TraCIConnection& link : libsumo::Lane::getLinks(lane)) {
                const std::string next = libsumo::Lane::getEdgeID(link.approachedLane);
                if (!is_internal(next) && allows(link.approachedLane, species)) {
                    result.push_back(RawLink{rust::String::lossy(edge), rust::String::lossy(next)});
                }
            }
        }
    }
    return result;
}

void Simulation::add_vehicle(rust::Str id, rust::Str vehicle_type, rust::Slice<const rust::String> route) {
    const std::string name = text(id);
    libsumo::Route::add(name, texts(route));
    libsumo::Vehicle::add(name, name, text(vehicle_type), "now", "best", "random_free", "max");
}

void Simulation::remove_vehicle(rust::Str id) { libsumo::Vehicle::remove(text(id)); }

std::int32_t Simulation::route_index(rust::Str id) const { return libsumo::Vehicle::getRouteIndex(text(id)); }

void Simulation::extend_route(rust::Str id, rust::Slice<const rust::String> more) {
    const std::string name = text(id);
    const std::vector<std::string> route = libsumo::Vehicle::getRoute(name);
    const int index = std::max(libsumo::Vehicle::getRouteIndex(name), 0);
    std::vector<std::string> ahead(route.begin() + index, route.end());
    for (std::size_t i = 1; i < more.size(); ++i) {
        ahead.emplace_back(more[i]);
    }
    libsumo::Vehicle::setRoute(name, ahead);
}

std::uint32_t Simulation::set_destination(rust::Str id, rust::Str edge) {
    const std::string name = text(id);
    libsumo::Vehicle::changeTarget(name, text(edge));
    return static_cast<std::uint32_t>(libsumo::Vehicle::getRoute(name).size());
}

rust::Vec<rust::String> Simulation::walk(rust::Str from, double from_position, rust::Str to,
                                         double to_position) const {
    std::vector<std::string> edges;
    for (const libsumo::TraCIStage& stage : libsumo::Simulation::findIntermodalRoute(
             text(from), text(to), "", -1.0, 0, -1.0, -1.0, from_position, to_position)) {
        if (stage.type == libsumo::STAGE_WALKING) {
            edges.insert(edges.end(), stage.edges.begin(), stage.edges.end());
        }
    }
    return rust_texts(edges);
}

void Simulation::add_person(rust::Str id, rust::Str person_type, rust::Str edge, double position) {
    libsumo::Person::add(text(id), text(edge), position, libsumo::DEPARTFLAG_NOW, text(person_type));
}

void Simulation::append_walk(rust::Str id, rust::Slice<const rust::String> edges, double arrival_position) {
    libsumo::Person::appendWalkingStage(text(id), texts(edges), arrival_position);
}

std::int32_t Simulation::remaining_stages(rust::Str id) const {
    return libsumo::Person::getRemainingStages(text(id));
}

}  // namespace caraware
