#!/usr/bin/env bash
# Blending at growing sizes: time, readings a second, traffic of its state against the memory bandwidth of the machine, peak memory. A synthetic wall,
# photographs taken as the colour itself.
#   usage: bash tests/bench/blend_scale.sh OUT [POINTS:PHOTOGRAPHS[:WxH] …]     default: 1000000:10 4000000:10 1000000:40, of 800x600; OUT: a folder, emptied case by case
# Readings are visited three times, as every photograph is (compare, inspect, add up). What the state moves for each at the least, where all surfels of a
# leaf are seen: a ballot of 96 bytes read and written, then read; sums of 80 bytes read and written, with the ballot read; 16 bytes of geometry each time:
# 592 bytes. Leaves that are seen in part move whole. The bandwidth is measured after each case (target `bandwidth`), as other work on the machine counts.
# Environment: CHIARO and BANDWIDTH (executables), CHIARO_RUN_OPTIONS (e.g. "--memory 512MiB --threads 2").
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro} bandwidth=${BANDWIDTH:-$root/build/release/tests/bench/bandwidth}
out=${1:?folder for the runs}
shift
[ $# -gt 0 ] || set -- 1000000:10 4000000:10 1000000:40
read -ra options <<<"${CHIARO_RUN_OPTIONS:-}"
echo "| points | photographs | pixels each | points seen | readings | blend, s | readings visited a second | state moved, GB/s | of the copy bandwidth | peak of the run, MiB | state on disk, MiB |"
echo "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
for case in "$@"; do
  IFS=: read -r points photographs size <<<"$case"
  size=${size:-800x600}
  rm -rf "$out/project" "$out/run"
  mkdir -p "$out"
  "$chiaro" synth wall --points "$points" --project "$out/project" --photographs "$photographs" --size "$size" --samples 1 --quiet >/dev/null 2>"$out/log.txt"
  "$chiaro" run "$out/project/project.toml" --out "$out/run" --set solve.method=none --quiet ${options[@]+"${options[@]}"} >/dev/null 2>>"$out/log.txt"
  python3 - "$out/run/run.json" "$points" "$photographs" "$size" "$("$bandwidth")" <<'PY'
import json
import sys

record, machine = json.load(open(sys.argv[1])), json.loads(sys.argv[5])
seconds = sum(s["seconds"] for s in record["stages"] if s["name"] == "blend")
counts = record["counts"]
moved = 592 * counts["samples"] / seconds
print(f"| {sys.argv[2]} | {sys.argv[3]} | {sys.argv[4]} | {counts['points_seen']} | {counts['samples']} | {seconds:.1f} | {3 * counts['samples'] / seconds:.2e} | {moved / 1e9:.2f} | "
      f"{100 * moved / machine['copy_bytes_per_s']:.0f} % of {machine['copy_bytes_per_s'] / 1e9:.1f} GB/s | {record['memory']['peak_bytes'] / 2**20:.0f} | {record['blending']['scratch_bytes'] / 2**20:.0f} |", flush=True)
PY
done
rm -rf "$out/project" "$out/run"
