#!/usr/bin/env bash
# From nothing to pictures: installs what is missing, builds chiaro, recovers the albedo of the bundled scan (data/tower, rendered, so that the
# truth is known), and prints how far the result is from the truth and where the pictures are.   usage: bash tools/demo.sh
set -euo pipefail
cd "$(dirname "$0")/.."
start=$SECONDS
say() { printf '\n== %s\n' "$*"; }

bash tools/setup.sh
# shellcheck source=tools/building.sh
source tools/building.sh

say "building (build/release)"
build release chiaro
chiaro=build/release/chiaro
scene=data/tower
out=demo.out

# Exit code 3 means: done, with something left out that the record names.
run() {
  local code=0
  "$@" || code=$?
  [ "$code" -eq 0 ] || [ "$code" -eq 3 ] || exit "$code"
}

say "albedo from 7 flash photographs: the whole way"
run "$chiaro" run "$scene/project.toml" --out "$out/tower"
say "the standard way for comparison: flash only, no ambient light, no bounces"
run "$chiaro" run "$scene/project.toml" --out "$out/tower_direct" --set solve.method=direct
# fresh FILE: made after the points and by this executable.
fresh() { [ "$1" -nt "$out/tower/albedo.ply" ] && [ "$1" -nt "$chiaro" ]; }

# The tables below come from `chiaro compare A B --json`, whose result is one line; these pick numbers out of it.
number() { sed -n "s/.*\"$1\":\([-+.eE0-9]*\).*/\1/p" | tail -n 1; }                       # number NAME
of() { sed -n "s/.*\"$1\":{\"mean\":\([-+.eE0-9]*\),\"median\":\([-+.eE0-9]*\).*/\1 \2/p" | tail -n 1; }   # of NAME: mean and median
percent() { awk -v m="$1" -v d="$2" 'BEGIN { printf "%6.1f %% / %5.1f %%", 100 * m, 100 * d }'; }
points_row() {   # points_row TITLE FOLDER
  # shellcheck disable=SC2046
  printf '  %-34s %s\n' "$1" "$(percent $("$chiaro" compare "$2/albedo.ply" "$scene/truth/albedo.npy" --json | of relative))"
}
view_row() {   # view_row NAME
  local found
  found=$("$chiaro" compare "$out/novel/$1.exr" "$scene/novel/$1.exr" --mask "$scene/masks/$1.png" --clip --json)
  printf '  %-34s PSNR %.1f dB, SSIM %.3f\n' "$1" "$(number psnr <<<"$found")" "$(number ssim <<<"$found")"
}
count() { sed -n "s/.*\"$1\": *\([0-9]*\).*/\1/p" "$out/tower/run.json" | tail -n 1; }

say "two photographs that nobody took: other cameras, other flash positions"
fresh "$out/novel/novel_01.exr" || run "$chiaro" render "$out/tower" --views "$scene/novel/views.toml" --out "$out/novel"
fresh "$out/tower/report/index.html" || run "$chiaro" report "$out/tower" --quiet >/dev/null

say "did it work?"
echo "  $(count points_seen) of $(count points_out) points were seen and have an albedo, from $(count photographs_used) photographs"
say "how far from the truth?"
echo "  relative error of the albedo of the points seen: mean / median"
points_row "chiaro" "$out/tower"
points_row "standard way" "$out/tower_direct"
echo "  new views against photographs that were never shown to it"
view_row novel_00
view_row novel_01
say "where are the pictures?"
here=$(pwd)
echo "  report, for a browser     $here/$out/tower/report/index.html"
echo "  points with albedo        $here/$out/tower/albedo.ply"
echo "  every photograph's parts  $here/$out/tower/photographs/"
echo "  new views, linear EXR     $here/$out/novel/"
printf '\n%s s in all\n' "$((SECONDS - start))"
