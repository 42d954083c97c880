// The same code over libtraci.
#define CARAWARE_OVER_TRACI 1

#include "traffic-bridge/src/sumo/heroes.cc"
#include "traffic-bridge/src/sumo/population.cc"
#include "traffic-bridge/src/sumo/shim.cc"
