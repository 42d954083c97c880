// Takes the place of two functions of SUMO, which convert a path to and from the encoding of the system's locale. SUMO's keep the
// converted text of every path for ever: some 1.5 KiB at each start. The dynamic linker prefers the program's own definition, so libsumo
// calls these. The paths of a run are UTF-8, and so are those that the system takes: nothing has to be converted.
#include <atomic>
#include <cstdint>
#include <string>

#include "traffic-bridge/src/sumo/shim.h"

namespace {
std::atomic<std::uint64_t> passed_paths{0};
}

// SUMO's own class (utils/xml/XMLSubSys.h), of which the wheel has no header.
class XMLSubSys {
public:
    static std::string transcodeToLocal(const std::string& utf8);
    static std::string transcodeFromLocal(const std::string& local);
};

std::string XMLSubSys::transcodeToLocal(const std::string& utf8) {
    ++passed_paths;
    return utf8;
}

std::string XMLSubSys::transcodeFromLocal(const std::string& local) {
    ++passed_paths;
    return local;
}

namespace caraware {
std::uint64_t paths_passed_to_sumo() { return passed_paths; }
}  // namespace caraware
