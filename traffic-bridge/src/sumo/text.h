// Conversion of SUMO's ids between C++ and Rust.
#pragma once

#include <string>
#include <vector>

#include "rust/cxx.h"

namespace caraware {

inline std::string text(rust::Str value) { return std::string(value); }

inline std::vector<std::string> texts(rust::Slice<const rust::String> values) {
    std::vector<std::string> result;
    result.reserve(values.size());
    for (const rust::String& value : values) {
        result.emplace_back(value);
    }
    return result;
}

inline rust::Vec<rust::String> rust_texts(const std::vector<std::string>& values) {
    rust::Vec<rust::String> result;
    for (const std::string& value : values) {
        result.push_back(rust::String::lossy(value));
    }
    return result;
}

}  // namespace caraware
