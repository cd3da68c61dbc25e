/// What a blend's state on disk depends on, as keys.
#pragma once
#include <span>
#include <string>
#include <vector>

#include "blend/blend.h"
#include "blend/photo_window.h"

namespace chiaro::blend {

/// The order in which photographs are added: by name, so that the caller's order has no influence on the bits.
std::vector<const BlendPhotograph*> in_order_of_names(std::span<const BlendPhotograph> photographs);

/// What lengths and colours are measured against, of all photographs together: medians of footprint (project units) and brightness.
struct Scale {
  float footprint = 0, brightness = 0;
};
Scale scale_of(const std::vector<const BlendPhotograph*>& photographs, Reporter& report);

WindowOptions window_options(const BlendOptions& options, const Scale& scale);

/// Name, camera and content of the rasters: 32 hexadecimal digits.
std::string photograph_key(const BlendPhotograph& photograph);

/// Store and options, without photographs.
std::string options_key(const stream::Store& store, const BlendOptions& options);

}  // namespace chiaro::blend
