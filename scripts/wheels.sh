#!/bin/sh
# Makes the wheels of the trainer and of the viewer from what `make build` has compiled: scripts/wheels.sh PYTHON DIRECTORY
set -e
python=$1
out=$(mkdir -p "$2" && cd "$2" && pwd)
cd "$(dirname "$0")/.."
work=$(mktemp -d)
trap 'rm -rf "$work"' EXIT

for package in trainer viewer; do
    # Setuptools keeps what it has copied once, so every wheel is made in a directory of its own.
    printf '[build]\nbuild_base = %s/build-%s\n[egg_info]\negg_base = %s\n' "$work" "$package" "$work" >"$work/$package.cfg"
    CARAWARE_BUILT=1 DIST_EXTRA_CONFIG="$work/$package.cfg" "$python" -m pip wheel --quiet --disable-pip-version-check \
        --no-deps --no-build-isolation --wheel-dir "$out" "./$package"
done
