#!/bin/sh
# Builds the image of Containerfile with the first engine that is installed: scripts/image.sh NAME [ARGUMENT=VALUE…]
# scripts/image.sh --possible succeeds if there is one that has the base image, or can fetch it.
set -e
cd "$(dirname "$0")/.."

engine() {
    for name in podman buildah docker; do
        command -v "$name" >/dev/null 2>&1 || continue
        # Docker's command may be there without its daemon.
        "$name" info >/dev/null 2>&1 || continue
        echo "$name"
        return 0
    done
    return 3
}

if [ "$1" = --possible ]; then
    base=$(sed -n 's/^FROM \([^ ]*\) AS build$/\1/p' Containerfile)
    found=$(engine) && { "$found" inspect --type image "$base" || "$found" pull "$base"; } >/dev/null 2>&1
    exit
fi
name=$1
shift
set -- $(printf -- '--build-arg %s ' "$@")
if found=$(engine); then
    exec "$found" build "$@" --file Containerfile --tag "$name" .
fi
echo "missing: podman, buildah or docker, which builds the image" >&2
echo "         → apt-get install podman" >&2
exit 3
