#!/bin/sh
# Names whatever this machine lacks for building and running, with the package to install. Exit code 3 if anything is missing.
python=$1
missing=0

lacks() {
    missing=1
    printf 'missing: %s\n         → %s\n' "$1" "$2" >&2
}

command -v cargo >/dev/null 2>&1 || lacks "a Rust toolchain (cargo)" "install Rust: https://rustup.rs"
if ! command -v c++ >/dev/null 2>&1 && ! command -v g++ >/dev/null 2>&1; then
    lacks "a C++ compiler" "apt-get install g++"
fi
if [ -z "$python" ] || ! "$python" -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then
    lacks "Python 3.11 or newer" "apt-get install python3 (or set PYTHON=/path/to/python3.x)"
elif ! "$python" -c 'import venv, ensurepip' 2>/dev/null; then
    lacks "the venv module of $python" "apt-get install python3-venv"
fi
for pair in libX11.so.6:libx11-6 libXext.so.6:libxext6 libXrender.so.1:libxrender1 libatomic.so.1:libatomic1 libexpat.so.1:libexpat1 libz.so.1:zlib1g libGL.so.1:libgl1; do
    library=${pair%%:*}
    if ! { ldconfig -p 2>/dev/null || /sbin/ldconfig -p; } | grep -q "$library"; then
        lacks "the library $library, which SUMO links" "apt-get install ${pair##*:}"
    fi
done

if [ $missing -ne 0 ]; then
    echo "on Debian and Ubuntu, all of it: apt-get install g++ make python3 python3-venv libx11-6 libxext6 libxrender1 libgl1" >&2
    exit 3
fi
