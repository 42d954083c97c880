#!/usr/bin/env bash
# Cargo's RUSTC_WORKSPACE_WRAPPER in `make lint`: `cargo build` lints the crates of the workspace, as errors, instead of compiling them.
#
# `cargo clippy` would check every third-party crate, and `cargo build` compile each of them again for the tests. With this wrapper both
# read the same ones. A crate of the workspace gets metadata only, as in `cargo check`, which its dependents read in place of the code.
set -euo pipefail
rustc=$1
shift

is_build_script=
for argument in "$@"; do
	if [[ $argument == build_script_* ]]; then is_build_script=1; fi
done

arguments=()
for argument in "$@"; do
	# A build script is run, so it needs its code.
	if [[ -z $is_build_script ]]; then
		case $argument in
		--emit=*)
			argument=--emit=dep-info,metadata
			;;
		*=*.rlib)
			if [[ ! -e ${argument#*=} ]]; then argument=${argument%.rlib}.rmeta; fi
			;;
		esac
	fi
	arguments+=("$argument")
done
exec clippy-driver "$rustc" "${arguments[@]}" -D warnings
