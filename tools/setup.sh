#!/usr/bin/env bash
# Installs the Debian packages that building and running chiaro needs; does nothing where all are there.
# Written for Debian 12. Root, or a user with sudo.
set -euo pipefail

packages=(
  g++ cmake ninja-build ccache pkg-config git ca-certificates   # to build
  libeigen3-dev libtbb-dev libboost-dev nlohmann-json3-dev libcli11-dev libtomlplusplus-dev   # base, command line, project file
  libembree-dev libnanoflann-dev                                # rays and neighbours
  libopenexr-dev libimath-dev libtiff-dev libpng-dev libjpeg-dev libraw-dev libblosc-dev libpugixml-dev   # photographs and cameras
  libpcl-dev                                                    # PCD files, outliers, alignment of scans
  libgtest-dev libgmock-dev                                     # tests
)

# LAZ and E57 are read through Rust crates. Debian's own rustc is too old; its -web packages follow the current one. A newer one of the user's will do.
rust_will_do() {
  command -v cargo >/dev/null && rustc --version 2>/dev/null | awk '{ split($2, v, "."); exit !(v[1] > 1 || v[2] >= 82) }'
}
rust_will_do || packages+=(cargo-web rustc-web)

say() { printf 'setup: %s\n' "$*" >&2; }

distribution=unknown
# shellcheck disable=SC1091
[ -r /etc/os-release ] && distribution=$(. /etc/os-release && echo "${ID:-unknown} ${VERSION_ID:-}")
[ "$distribution" = "debian 12" ] || say "this is $distribution; chiaro is tried on Debian 12 only. Going on; package names and versions may differ."

if ! command -v dpkg-query >/dev/null || ! command -v apt-get >/dev/null; then
  say "no apt-get here. Install these by your system's own means: ${packages[*]}"
  exit 0   # the configure step names what is missing
fi

missing_packages() {
  local installed
  installed=$(dpkg-query -W -f='${Package} ${db:Status-Status}\n' "${packages[@]}" 2>/dev/null | sed -n 's/ installed$//p' || true)
  printf '%s\n' "${packages[@]}" | grep -vxF -e "$installed" || true
}

missing=$(missing_packages)
[ -n "$missing" ] || exit 0

as_root=()
if [ "$(id -u)" -ne 0 ]; then
  command -v sudo >/dev/null || { say "packages are missing and this user is neither root nor has sudo. As root: apt-get install $(echo $missing)"; exit 1; }
  as_root=(sudo)
fi
# shellcheck disable=SC2086
say "installing" $missing
apt=("${as_root[@]}" env DEBIAN_FRONTEND=noninteractive apt-get -q -y -o DPkg::Lock::Timeout=600 -o Dpkg::Use-Pty=0 -o Acquire::Retries=3)
log=$(mktemp)
trap 'rm -f "$log"' EXIT
start=$SECONDS
quietly() { "$@" >"$log" 2>&1 || { tail -n 30 "$log" >&2; say "failed: $*"; exit 1; }; }
quietly "${apt[@]}" update
for package in cargo-web rustc-web; do   # without them all but LAZ and E57 works
  [[ " $missing " == *[[:space:]]"$package"[[:space:]]* ]] || continue
  apt-cache show "$package" >/dev/null 2>&1 && continue
  say "$package is not to be had here: LAZ and E57 will not be read"
  missing=$(grep -vx "$package" <<<"$missing" || true)
done
[ -n "$missing" ] || exit 0
# shellcheck disable=SC2086
quietly "${apt[@]}" install --no-install-recommends $missing
say "$(echo "$missing" | wc -l) packages installed with what they need, $((SECONDS - start)) s"
