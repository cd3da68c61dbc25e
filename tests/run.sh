#!/usr/bin/env bash
# Installs what is missing, builds chiaro, and passes its tests: first the readers of clouds and photographs under the address and
# undefined-behaviour sanitizers, then the whole suite as users build it.   usage: bash tests/run.sh [--quick | --all]
# --quick leaves the sanitizers out, --all has the store under them too
set -euo pipefail
cd "$(dirname "$0")/.."

# What the sanitizers have to see: whatever reads foreign bytes.
sanitized=(base cloud photo)
case "$*" in
  "") ;;
  --quick) sanitized=() ;;
  --all) sanitized+=(store) ;;
  *) sed -n '2,4s/^# //p' "$0" >&2; exit 2 ;;
esac

bash tools/setup.sh
# shellcheck source=tools/building.sh
source tools/building.sh

say() { printf '\n== %s\n' "$*"; }
start=$SECONDS

failed=no
if [ ${#sanitized[@]} -gt 0 ]; then
  say "${sanitized[*]} under the address and undefined-behaviour sanitizers"
  build asan "${sanitized[@]/%/_test}"
  ctest --preset asan -j "$jobs" -R "^($(IFS='|'; echo "${sanitized[*]}"))\\." --quiet --output-log build/asan_tests.log || failed=yes
  [ "$failed" = no ] || cat build/asan_tests.log
  tail -n 3 build/asan_tests.log
fi

say "the whole suite"
build release
ctest --preset release -j "$jobs" --output-on-failure --progress || failed=yes
echo "$((SECONDS - start)) s in all"
[ "$failed" = no ]
