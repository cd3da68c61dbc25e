#!/usr/bin/env bash
# A small tree with one violation of each kind, and right lines beside them: the check must name each wrong line and no other.
set -euo pipefail
check=$(cd "$(dirname "$0")" && pwd)/include_order.sh
tree=$(mktemp -d)
trap 'rm -rf "$tree"' EXIT
cd "$tree"
mkdir -p stream/base stream/cloud surfels optimize blend tools

printf '#include <vector>\n#include <Eigen/Core>\n#include "stream/base/b.h"\n' > stream/base/a.h
printf '#include <embree3/rtcore.h>\n#include "stream/base/a.h"\n#include "surfels/a.h"\n' > surfels/right.cpp
printf '#include "blend/a.h"\n#include "optimize/a.h"\n#include <nlohmann/json.hpp>\n' > tools/right.cpp
printf '#include <nlohmann/json.hpp>\n' > tools/some_json.h
printf '#include <toml++/toml.h>\n' > tools/some_toml.h
bash "$check" "$tree" || { echo "a tree without violations was refused"; exit 1; }

printf '#include "surfels/a.h"\n' > stream/cloud/up.cpp
printf '#include "blend/a.h"\n' > optimize/sibling.cpp
printf '#include "tests/support/a.h"\n' > tools/tests.cpp
printf '#include "a.h"\n' > blend/local.cpp
printf '#include "stream/cloud/a.h"\n' > stream/base/base_up.cpp
printf '#pragma once\n#  include <nanoflann.hpp>\n' > optimize/library.h

printf '#include <nlohmann/json.hpp>\n' > blend/some_json.h
printf '#include <nlohmann/json.hpp>\n' > tools/other_toml.h

if found=$(bash "$check" "$tree"); then echo "violations were not found"; exit 1; fi
expected='blend/local.cpp:1 blend/some_json.h:1 optimize/library.h:2 optimize/sibling.cpp:1 stream/base/base_up.cpp:1 stream/cloud/up.cpp:1 tools/other_toml.h:1 tools/tests.cpp:1'
lines=$(cut -d: -f1,2 <<<"$found" | sort | tr '\n' ' ')
[ "$lines" = "$expected " ] || { printf 'expected %s\nfound    %s\n' "$expected" "$lines"; exit 1; }
