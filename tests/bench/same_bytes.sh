#!/usr/bin/env bash
# Runs a project with one thread, with two, and with two while the process is killed (SIGKILL) at five random moments and goes on; says whether all leave the same bytes.
#   usage: bash tests/bench/same_bytes.sh PROJECT.toml [SEED]        default seed: the time. Results stay in same_bytes.out/. Environment: CHIARO (executable).
set -euo pipefail
root=$(cd "$(dirname "$0")/../.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro}
[ $# -ge 1 ] || { sed -n '2,3s/^# //p' "$0" >&2; exit 2; }
project=$1 seed=${2:-$(date +%s)} out=$root/same_bytes.out
RANDOM=$((seed % 32768))
rm -rf "$out"
mkdir -p "$out"

finish() {   # finish FOLDER THREADS: exit 3 means done, with something left out
  local code=0
  "$chiaro" run "$project" --out "$out/$1" --threads "$2" --quiet >"$out/$1.log" 2>&1 || code=$?
  [ "$code" -eq 0 ] || [ "$code" -eq 3 ] || { cat "$out/$1.log" >&2; exit "$code"; }
}
# What a run is for: points, lights, every raster and layer. Not the records, which hold times.
sums() { (cd "$out/$1" && find . -type f ! -name run.json ! -path './work/tasks/*' ! -path './report/*' ! -name project.json -print0 | sort -z | xargs -0 sha256sum) >"$out/$1.sums"; }

start=$(date +%s%N)
finish one 1
finish two 2
whole_ms=$((($(date +%s%N) - start) / 2000000))
kills=0
while [ "$kills" -lt 5 ]; do
  "$chiaro" run "$project" --out "$out/killed" --threads 2 --quiet >"$out/killed.log" 2>&1 &
  child=$!
  pause=$((RANDOM * whole_ms / 4 / 32768 + 50))
  sleep "$((pause / 1000)).$(printf %03d $((pause % 1000)))"
  kill -9 "$child" 2>/dev/null || { echo "it was done before kill $((kills + 1)): the pauses add up to more than a run" ; wait "$child" || true; break; }
  wait "$child" 2>/dev/null || true
  kills=$((kills + 1))
  echo "killed after $pause ms"
done
finish killed 2
for folder in one two killed; do sums "$folder"; done
same=yes
for folder in two killed; do diff -q "$out/one.sums" "$out/$folder.sums" >/dev/null || { same=no; diff "$out/one.sums" "$out/$folder.sums" | head -n 10; }; done
echo "$(wc -l <"$out/one.sums") files; one thread, two threads, $kills kills (seed $seed): same bytes: $same"
[ "$same" = yes ]
