#!/usr/bin/env bash
# Checks what the compiler cannot: folders include only what stands below them (stream, surfels, {optimize, blend}, tools), nothing includes
# tests, includes start at the repository root, and headers name no third-party library but Eigen.   usage: include_order.sh [ROOT]
set -euo pipefail
cd "${1:-$(dirname "$0")/../..}"

awk_program='
function rank(folder) { return folder == "stream" ? 1 : folder == "surfels" ? 2 : folder == "optimize" || folder == "blend" ? 3 : folder == "tools" ? 4 : 0 }
function complain(text) { printf "%s:%d: %s\n", FILENAME, FNR, text; bad = 1 }
/^[ \t]*#[ \t]*include[ \t]*[<"]/ {
  name = $0; sub(/^[^<"]*/, "", name)
  quoted = substr(name, 1, 1) == "\""
  name = substr(name, 2); sub(/[>"].*/, "", name)
  split(FILENAME, here, "/"); split(name, there, "/")
  if (quoted) {
    if (there[1] == "tests") complain("includes " name ": nothing includes tests")
    else if (rank(there[1]) == 0) complain("includes \"" name "\": quoted includes start at the repository root")
    else if (here[1] != there[1] && rank(there[1]) >= rank(here[1])) complain(here[1] " includes " name ": only folders below it may be included")
    else if (FILENAME ~ /^stream\/base\// && name !~ /^stream\/base\//) complain("stream/base includes " name ": it stands below everything")
  } else if (FILENAME ~ /^tools\/[a-z_]*_(json|toml)\.h$/ && name ~ (FILENAME ~ /_json\.h$/ ? "^nlohmann" : "^toml\\+\\+")) {
    # The one exception: helpers for JSON and TOML themselves, at the top of the order where nothing else includes them.
  } else if (FILENAME ~ /\.h$/ && name ~ library) complain("a header names <" name ">: third-party libraries stay inside .cpp files")
}
END { exit bad }'

# Headers of libraries by the start of their path.
library='^(embree|OpenEXR|Imath|Imf|Iex|half\.h|libraw|tbb|oneapi|nanoflann|pcl|CLI|nlohmann|toml\+\+|pugixml|tiff|png|jpeglib|boost|gtest|gmock)'

find stream surfels optimize blend tools \( -name '*.h' -o -name '*.cpp' \) -print0 | sort -z | xargs -0 awk -v library="$library" "$awk_program"
