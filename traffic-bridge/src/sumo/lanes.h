// The lanes that a class of road users may use.
#pragma once

#include <algorithm>
#include <string>
#include <utility>
#include <vector>

#include "traffic-bridge/src/sumo/engine.h"

namespace caraware::CARAWARE_ENGINE {


inline bool is_internal(const std::string& edge) { return edge.empty() || edge.front() == ':'; }

inline bool allows(const std::string& lane, const std::string& vehicle_class) {
    const std::vector<std::string> refused = engine::Lane::getDisallowed(lane);
    return std::find(refused.begin(), refused.end(), vehicle_class) == refused.end();
}

// Lanes of `edge` that `vehicle_class` may use.
inline std::vector<std::string> lanes_for(const std::string& edge, const std::string& vehicle_class) {
    std::vector<std::string> result;
    for (int i = 0; i < engine::Edge::getLaneNumber(edge); ++i) {
        std::string lane = edge + "_" + std::to_string(i);
        if (allows(lane, vehicle_class)) {
            result.push_back(std::move(lane));
        }
    }
    return result;
}

}  // namespace caraware::CARAWARE_ENGINE
