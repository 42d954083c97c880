#!/bin/sh
# Makes sure that the viewer's test has a Chromium: the one that is there, else, for root, Debian's. Exit code 3 if there is none.
for name in "$CARAWARE_BROWSER" chromium chromium-browser google-chrome google-chrome-stable; do
    if [ -n "$name" ] && command -v "$name" >/dev/null 2>&1; then
        exit 0
    fi
done

if [ "$(id -u)" -eq 0 ] && command -v apt-get >/dev/null 2>&1; then
    echo "installing Chromium for the viewer's test"
    apt-get update -qq
    if DEBIAN_FRONTEND=noninteractive apt-get install -y -qq --no-install-recommends chromium >/dev/null; then
        exit 0
    fi
fi

echo "missing: Chromium, in which the viewer is tested" >&2
echo "         → apt-get install chromium, or set CARAWARE_BROWSER to a Chromium or Chrome" >&2
exit 3
