#!/usr/bin/env bash
# Makes synthetic projects of growing size and runs each within a memory budget; prints one table: time of each stage, largest resident set (as the kernel
# counted it) and error against the known albedo.
#   usage: bash tests/bench/scale.sh [POINTS…]        default: 1000000 10000000
# Environment: CHIARO (executable), MEMORY (512MiB), PHOTOGRAPHS (20), SPEC (statue:noise=0.0003,normals=false), SYNTH_OPTIONS (more words for chiaro synth), OUT
# (folder for scratch data, scale.out), KEEP=1. Needs python3. Disk: about 200 bytes a point and a gigabyte for the photographs' rasters, one size at a time.
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro}
memory=${MEMORY:-512MiB} photographs=${PHOTOGRAPHS:-20} spec=${SPEC:-statue:noise=0.0003,normals=false} out=${OUT:-$root/scale.out}
case "${1:-}" in -*) sed -n '2,6s/^# //p' "$0" >&2; exit 2 ;; esac
[ $# -gt 0 ] || set -- 1000000 10000000
[ ! -e "$out" ] || { echo "$out exists: remove it, or set OUT" >&2; exit 1; }
mkdir -p "$out"

# measure NAME WORDS…: runs, leaves NAME.out, NAME.err and "exit seconds peak_KiB" in NAME.measured. wait4 through python's resource module.
measure() {
  local name=$1
  shift
  python3 - "$out/$name" "$@" <<'PY'
import os, sys, time
name, words = sys.argv[1], sys.argv[2:]
start = time.monotonic()
pid = os.fork()
if pid == 0:
    for descriptor, ending in ((1, ".out"), (2, ".err")):
        os.dup2(os.open(name + ending, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o644), descriptor)
    os.execv(words[0], words)
_, status, usage = os.wait4(pid, 0)
code = os.waitstatus_to_exitcode(status)
open(name + ".measured", "w").write(f"{code} {time.monotonic() - start:.1f} {usage.ru_maxrss}\n")
sys.exit(0)
PY
  read -r code seconds peak <"$out/$name.measured"
  [ "$code" -eq 0 ] || { tail -n 5 "$out/$name.err" >&2; echo "$name: exit $code" >&2; exit 1; }
}

echo "$spec, $photographs photographs, --memory $memory, $("$chiaro" --version), $(nproc) cores"
printf '%12s %9s %9s %9s %9s %9s %9s %9s %9s %9s %9s %10s %11s %9s %9s\n' points synth_s ingest_s raycast_s gather_s light_s albedo_s blend_s export_s total_s peak_MiB seen readings err_mean err_median
for points in "$@"; do
  folder=$out/$points
  measure synth "$chiaro" synth "$spec" --points "$points" --project "$folder" --photographs "$photographs" --albedo --quiet ${SYNTH_OPTIONS:-}
  synth_seconds=$seconds
  measure run "$chiaro" run "$folder/project.toml" --out "$folder/out" --memory "$memory" --quiet
  run_seconds=$seconds run_peak=$peak
  measure compare "$chiaro" compare "$folder/out/albedo.ply" "$folder/cloud.ply" --json
  python3 - "$points" "$synth_seconds" "$run_seconds" "$run_peak" "$folder/out/run.json" "$out/compare.out" <<'PY'
import json, sys
points, synth_s, run_s, run_kib, record, compared = sys.argv[1:]
record = json.load(open(record))
seconds = lambda stage: sum(s["seconds"] for s in record["stages"] if s["name"].split("/")[0] == stage)
stages = [seconds(s) for s in ("ingest", "raycast", "gather", "light", "albedo", "blend", "export")]
result = [json.loads(line) for line in open(compared) if line.startswith("{")][-1]
print(f"{int(points):12d} {float(synth_s):9.1f} " + " ".join(f"{s:9.1f}" for s in stages) +
      f" {float(run_s):9.1f} {int(run_kib) / 1024:9.1f} {result['compared']:10d} {record['counts']['samples']:11d} {result['relative']['mean']:9.4f} {result['relative']['median']:9.4f}")
PY
  [ -n "${KEEP:-}" ] || rm -rf "$folder"
done
[ -n "${KEEP:-}" ] || rm -rf "$out"
