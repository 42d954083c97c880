// SUMO's own vehicle objects. `libsumo::Vehicle` searches a tree of all vehicles by id for each value that it returns, which takes
// longer than to read the value. So an object is found once in each step.
//
// The functions are those that `libsumo::Vehicle` calls, exported by the same library but declared in none of its headers. If a version
// of SUMO lacks one, the linker says so. `traffic-bridge/tests/sumo/objects.rs` compares what they return with libsumo's getters.
#pragma once

#include <string>

#include <libsumo/TraCIDefs.h>

class MSLane;

// The classes of SUMO 1.28, without their members.
class MSBaseVehicle {
public:
    double getOdometer() const;
    int getRoutePosition() const;
};

// What SUMO's `Position` holds: metres.
struct MSVehiclePosition {
    double x;
    double y;
    double z;
};

class MSVehicle : public MSBaseVehicle {
public:
    bool isOnRoad() const;
    MSVehiclePosition getPosition(double offset) const;
    double getAngle() const;
    double getSpeed() const;
    double getSlope() const;
    double getPositionOnLane() const;
    const MSLane* getLane() const;
};

class GeomHelper {
public:
    static double naviDegree(double angle);
};

namespace libsumo {
class Helper {
public:
    static MSBaseVehicle* getVehicle(const std::string& id);
};
}  // namespace libsumo

// Of the table of virtual functions of the class, the address of the third entry stands at the beginning of each of its objects.
extern "C" const void* const _ZTV9MSVehicle[];

namespace caraware {

// The object of a vehicle; null with `mesosim`, whose vehicles are of another class. It is valid until the next step or command. Throws
// if SUMO has no such vehicle.
inline const MSVehicle* vehicle_object(const std::string& id) {
    constexpr int FIRST_FUNCTION = 2;
    const MSBaseVehicle* const vehicle = libsumo::Helper::getVehicle(id);
    const void* const functions = *reinterpret_cast<const void* const*>(vehicle);
    return functions == &_ZTV9MSVehicle[FIRST_FUNCTION] ? static_cast<const MSVehicle*>(vehicle) : nullptr;
}

}  // namespace caraware
