#!/usr/bin/env bash
# The table of figures: runs every scene of a folder from scratch and compares with its truth.
#   usage: bash tools/figures.sh [SCENES] [METHOD …]        default: data, methods joint and direct
# SCENES holds one folder a scene: project*.toml, cloud, photographs, truth/albedo.npy in the order of the points, novel/views.toml with what to compare.
# Prints Markdown; results stay in figures.out. Environment: CHIARO (executable), CHIARO_RUN_OPTIONS (e.g. "--memory 512MiB").
set -euo pipefail
root=$(cd "$(dirname "$0")/.." && pwd)
chiaro=${CHIARO:-$root/build/release/chiaro}
[ -x "$chiaro" ] || { echo "no $chiaro: build it first, e.g. by tools/demo.sh" >&2; exit 1; }
scenes=${1:-$root/data}
[ $# -gt 0 ] && shift
[ $# -gt 0 ] || set -- joint direct
methods=("$@")
out=$root/figures.out
read -ra options <<<"${CHIARO_RUN_OPTIONS:-}"

mean_median() { sed -n "s/.*\"$1\":{\"mean\":\([-+.eE0-9]*\),\"median\":\([-+.eE0-9]*\).*/\1 \2/p" | awk 'END { printf "%.2f / %.2f", 100 * $1, 100 * $2 }'; }
number() { sed -n "s/.*\"$1\":\([-+.eE0-9]*\).*/\1/p" | tail -n 1; }
top_level() { sed -n "s/^  \"$1\": *\([-+.eE0-9]*\),*$/\1/p" "$2" | tail -n 1; }
anywhere() { sed -n "s/.*\"$1\": *\([0-9]*\).*/\1/p" "$2" | tail -n 1; }

# PSNR of each new view inside its mask, values clipped to white (1), in the order of their names.
psnr_of_views() {   # scene folder, run folder
  [ -f "$1/novel/views.toml" ] || { printf -- '–'; return 0; }
  "$chiaro" render "$2" --views "$1/novel/views.toml" --out "$2.novel" --quiet >/dev/null 2>>"$out/log.txt" || { printf 'failed'; return 0; }
  local view first=yes
  for view in "$1"/novel/*.exr; do
    local name
    name=$(basename "$view" .exr)
    [ "$first" = yes ] || printf ', '
    first=no
    "$chiaro" compare "$2.novel/$name.exr" "$view" --mask "$1/masks/$name.png" --clip --json 2>>"$out/log.txt" | number psnr | awk '{ printf "%.1f", $1 }'
  done
}

row() {   # project file, method, or "" for the project's own
  local scene name folder code=0
  scene=$(dirname "$1")
  name=$(basename "$scene")/$(basename "$1" .toml)
  folder=$out/${name//\//.}.${2:-own}
  rm -rf "$folder" "$folder.novel"
  "$chiaro" run "$1" --out "$folder" --quiet ${2:+--set "solve.method=$2"} ${options[@]+"${options[@]}"} >/dev/null 2>>"$out/log.txt" || code=$?
  if [ "$code" -ne 0 ] && [ "$code" -ne 3 ]; then
    printf '| %s | %s | exit %s, see figures.out/log.txt |\n' "$name" "${2:-as set}" "$code"
    return 0
  fi
  local found views
  found=$("$chiaro" compare "$folder/albedo.ply" "$scene/truth/albedo.npy" --json 2>>"$out/log.txt")
  case "${2:-none}" in direct | none) views=– ;; *) views=$(psnr_of_views "$scene" "$folder") ;; esac
  printf '| %s | %s | %s | %s | %s | %s | %.0f | %.0f |\n' "$name" "${2:-as set}" "$(number compared <<<"$found")" "$(mean_median relative <<<"$found")" \
    "$(mean_median relative_scaled <<<"$found")" "$views" "$(top_level seconds "$folder/run.json")" "$(awk -v b="$(anywhere peak_bytes "$folder/run.json")" 'BEGIN { print b / 1048576 }')"
}

mkdir -p "$out"
: >"$out/log.txt"
echo "| project | method | points seen | albedo error, mean / median, % | after one common factor, % | new views, PSNR dB | s | peak, MiB |"
echo "| --- | --- | ---: | ---: | ---: | ---: | ---: | ---: |"
for project in "$scenes"/*/project*.toml; do
  if grep -Eq '^method *= *"none"' "$project"; then
    row "$project" ""
    continue
  fi
  for method in "${methods[@]}"; do row "$project" "$method"; done
done
