# What tests/run.sh and tools/demo.sh share: building quietly, with as many compilers at once as there are cores and memory for. Sourced, from the root.

# 1.7 GB for the hungriest file (PCL's templates).
jobs=$(nproc)
memory_jobs=$(awk '/^MemAvailable/ { print int($2 / 1700000) }' /proc/meminfo)
[ "$memory_jobs" -ge "$jobs" ] || jobs=$memory_jobs
[ "$jobs" -ge 1 ] || jobs=1

# Headers are compiled once and for all, which makes a build from scratch a third shorter; ccache has to be told that it may follow. In its depend mode
# it costs nothing where it knows nothing yet.
export CCACHE_SLOPPINESS=${CCACHE_SLOPPINESS:-pch_defines,time_macros} CCACHE_DEPEND=${CCACHE_DEPEND:-1}

# build PRESET [TARGETS…]: one line when it works, the end of the log when it does not.
build() {
  local preset=$1 log=build/$1.log began=$SECONDS
  shift
  local configure=(cmake --preset "$preset" -DCHIARO_PCH=ON) compile=(cmake --build --preset "$preset" --parallel "$jobs")
  [ $# -eq 0 ] || compile+=(--target "$@")
  mkdir -p build
  if ! { "${configure[@]}" && "${compile[@]}"; } >"$log" 2>&1; then
    tail -n 60 "$log"
    printf '\nbuilding %s failed; the whole log is in %s\n' "$preset" "$log" >&2
    exit 1
  fi
  echo "$preset built in $((SECONDS - began)) s"
}
