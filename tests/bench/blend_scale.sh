#!/usr/bin/env bash
# Blending at growing sizes: time, readings a second, traffic of its state, peak memory. A synthetic wall, photographs taken as the colour itself.
#   usage: bash tests/bench/blend_scale.sh OUT [POINTS:PHOTOGRAPHS …]        default: 1000000:10 4000000:10 1000000:40; OUT: a folder, emptied case by case
# Readings are counted three times, as every photograph is visited three times (compare, inspect, add up). State: ballots 96 and sums 80 bytes a surfel, two slots each.
# Environment: CHIARO (executable), CHIARO_RUN_OPTIONS (e.g. "--memory 512MiB --threads 2").
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro}
out=${1:?folder for the runs}
shift
[ $# -gt 0 ] || set -- 1000000:10 4000000:10 1000000:40
read -ra options <<<"${CHIARO_RUN_OPTIONS:-}"
echo "| points | photographs | points seen | readings | blend, s | readings visited a second | peak of the run, MiB |"
echo "| ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
for case in "$@"; do
  points=${case%%:*} photographs=${case##*:}
  rm -rf "$out/project" "$out/run"
  mkdir -p "$out"
  "$chiaro" synth wall --points "$points" --project "$out/project" --photographs "$photographs" --size 800x600 --samples 1 --quiet >/dev/null 2>"$out/log.txt"
  "$chiaro" run "$out/project/project.toml" --out "$out/run" --set solve.method=none --quiet ${options[@]+"${options[@]}"} >/dev/null 2>>"$out/log.txt"
  python3 - "$out/run/run.json" "$points" "$photographs" <<'PY'
import json
import sys

record = json.load(open(sys.argv[1]))
seconds = sum(s["seconds"] for s in record["stages"] if s["name"] == "blend")
counts = record["counts"]
print(f"| {sys.argv[2]} | {sys.argv[3]} | {counts['points_seen']} | {counts['samples']} | {seconds:.1f} | {3 * counts['samples'] / seconds:.2e} | {record['memory']['peak_bytes'] / 2**20:.0f} |", flush=True)
PY
done
