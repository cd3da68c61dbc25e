#!/usr/bin/env bash
# Blending at growing sizes: time, readings a second, bytes touched against the memory bandwidth of the machine, peak memory. A synthetic wall, photographs
# taken as the colour itself.
#   usage: bash tests/bench/blend_scale.sh OUT [POINTS:PHOTOGRAPHS[:WxH] …]     default: 1000000:10 4000000:10 1000000:40, of 800x600; OUT: a folder, emptied case by case
# Readings are visited three times (compare, inspect, add up). Bytes touched: four pixels of 64 bytes at each visit, from caches or not; and 592 bytes of state and
# geometry a point (a ballot of 96 bytes written and read again, then read twice; sums of 80 bytes read and written; 16 bytes of geometry each time), once for a
# group of photographs that memory holds together; one group is counted. The bandwidth is measured after each case (target `bandwidth`), as other work counts.
# Core seconds are those of a run that only blends, into a second layer, less those of the same once more, which finds everything done.
# Environment: CHIARO and BANDWIDTH (executables), CHIARO_RUN_OPTIONS (e.g. "--memory 512MiB --threads 2").
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro} bandwidth=${BANDWIDTH:-$root/build/release/tests/bench/bandwidth}
out=${1:?folder for the runs}
shift
[ $# -gt 0 ] || set -- 1000000:10 4000000:10 1000000:40
echo "| points | photographs | pixels each | points seen | readings | blend, s | core-s | ns of a core a visit | touched, GB/s | of the copy bandwidth | peak of the run, MiB | state on disk, MiB |"
echo "| ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: | ---: |"
for case in "$@"; do
  IFS=: read -r points photographs size <<<"$case"
  size=${size:-800x600}
  rm -rf "$out/project" "$out/run"
  mkdir -p "$out"
  "$chiaro" synth wall --points "$points" --project "$out/project" --photographs "$photographs" --size "$size" --samples 1 --quiet >/dev/null 2>"$out/log.txt"
  python3 - "$chiaro" "$bandwidth" "$out" "$points" "$photographs" "$size" ${CHIARO_RUN_OPTIONS:-} <<'PY'
import json
import os
import subprocess
import sys

chiaro, bandwidth, out, points, photographs, size, *options = sys.argv[1:]


def run(layer):
    """Core seconds and record."""
    words = [chiaro, "run", f"{out}/project/project.toml", "--out", f"{out}/run", "--set", "solve.method=none", "--set", f"blend.layer={layer}", "--set", "export.file=points.ply", "--quiet", *options]
    with open(f"{out}/log.txt", "a") as log:
        child = subprocess.Popen(words, stdout=log, stderr=log)
        _, status, usage = os.wait4(child.pid, 0)
    if status != 0:
        sys.exit(f"{' '.join(words)}: status {status}, see {out}/log.txt")
    return usage.ru_utime + usage.ru_stime, json.load(open(f"{out}/run/run.json"))


_, first = run("first")
blending, record = run("second")
nothing, _ = run("second")
machine = json.loads(subprocess.check_output([bandwidth]))
seconds = sum(s["seconds"] for s in record["stages"] if s["name"].startswith("blend"))
counts = record["counts"]
touched = (3 * 256 * counts["samples"] + 592 * counts["points_seen"]) / seconds
print(f"| {points} | {photographs} | {size} | {counts['points_seen']} | {counts['samples']} | {seconds:.1f} | {blending - nothing:.1f} | {1e9 * (blending - nothing) / (3 * counts['samples']):.0f} | {touched / 1e9:.2f} | "
      f"{100 * touched / machine['copy_bytes_per_s']:.0f} % of {machine['copy_bytes_per_s'] / 1e9:.1f} GB/s | {max(r['memory']['peak_bytes'] for r in (first, record)) / 2**20:.0f} | {record['blending']['scratch_bytes'] / 2**20:.0f} |", flush=True)
PY
done
rm -rf "$out/project" "$out/run"
