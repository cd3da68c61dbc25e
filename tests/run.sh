#!/usr/bin/env bash
# Installs what is missing, builds chiaro, and passes its tests: first the readers under the address and undefined-behaviour sanitizers,
# then the whole suite as users build it.   usage: bash tests/run.sh [--quick]     --quick leaves the sanitizers out
set -euo pipefail
cd "$(dirname "$0")/.."

quick=no
for word in "$@"; do
  case "$word" in
    --quick) quick=yes ;;
    *) sed -n '2,3s/^# //p' "$0" >&2; exit 2 ;;
  esac
done

# Readers of foreign bytes, and the files and store that are written: what the sanitizers have to see.
sanitized_targets=(base_test cloud_test photo_test store_test)
sanitized_names='^(base|cloud|photo|store)\.'

bash tools/setup.sh
# shellcheck source=tools/building.sh
source tools/building.sh

say() { printf '\n== %s\n' "$*"; }
start=$SECONDS

failed=no
if [ "$quick" = no ]; then
  say "readers under the address and undefined-behaviour sanitizers"
  build asan "${sanitized_targets[@]}"
  ctest --preset asan -j "$jobs" -R "$sanitized_names" --quiet --output-log build/asan_tests.log || failed=yes
  [ "$failed" = no ] || cat build/asan_tests.log
  tail -n 3 build/asan_tests.log
fi

say "the whole suite"
build release
ctest --preset release -j "$jobs" --output-on-failure --progress || failed=yes
echo "$((SECONDS - start)) s in all"
[ "$failed" = no ]
