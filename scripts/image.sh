#!/bin/sh
# Builds the image of Containerfile with the first engine that is installed: scripts/image.sh NAME [ARGUMENT=VALUE…]
set -e
cd "$(dirname "$0")/.."
name=$1
shift
set -- $(printf -- '--build-arg %s ' "$@")

for engine in podman buildah docker; do
    command -v "$engine" >/dev/null 2>&1 || continue
    # Docker's command may be there without its daemon.
    "$engine" info >/dev/null 2>&1 || continue
    exec "$engine" build "$@" --file Containerfile --tag "$name" .
done
echo "missing: podman, buildah or docker, which builds the image" >&2
echo "         → apt-get install podman" >&2
exit 3
