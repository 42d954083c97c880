# Two commands: `make train` runs the main job, `make test` runs all tests. Both install and build what they need.

PYTHON ?= $(shell for p in python3 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV := .venv
PYTHON310 ?= python3.10
CARGO_FLAGS := --release --locked
# Cargo looks for a job server of make where there is none.
CARGO := MAKEFLAGS= cargo
# Extra arguments of `make train`, e.g. make train ARGS="--set run.seed=7"
ARGS ?=
# 1 installs CUDA's libraries, which torch asks for and which need 4 GB. Without a driver none is called: see scripts/without_cuda.py.
GPU ?= $(if $(wildcard /dev/nvidiactl /dev/dxg /proc/driver/nvidia/version),1,0)
# Directory of `make install`, and what the installed package can do beside training: extras of trainer/pyproject.toml.
PREFIX ?=
EXTRAS ?= envs,data,metrics,study

.PHONY: train test build install wheels image programs programs-and-tests prerequisites browser lint lint-rust lint-python format test-rust test-trainer test-packages \
	timed-packages timed-programs with-cuda newcomer pictures model miri deny bench peers peers-metadrive peers-smarts faces puffer site clean

train: build ## build everything and learn on the town
	target/release/caraware train $(ARGS)

# Most of Rust's tests, the trainer's, and all others run side by side: all start whole runs, which wait a lot.
test: prerequisites browser $(VENV)/.sumo ## all tests
	@$(MAKE) --no-print-directory --jobs=2 $(VENV)/.installed programs-and-tests
	$(EXTENSION)
	$(COMMAND)
	$(MAKE) --jobs=3 --output-sync=line test-rust test-trainer test-packages

# Python's packages are downloaded and unpacked while Rust's are compiled.
build: prerequisites ## virtual environment, SUMO, all programs, the Python extension
	@scripts/stages.sh begin
	@scripts/stages.sh time "SUMO" $(MAKE) --no-print-directory $(VENV)/.sumo
	@$(MAKE) --no-print-directory --jobs=2 timed-packages timed-programs
	$(EXTENSION)
	$(COMMAND)
	@scripts/stages.sh show

timed-packages:
	@scripts/stages.sh time "Python's packages" $(MAKE) --no-print-directory $(VENV)/.installed

timed-programs:
	@scripts/stages.sh time "beside them programs" $(MAKE) --no-print-directory programs

programs:
	$(CARGO) build $(CARGO_FLAGS)

# One selection of targets for the tests and the extension. Third-party crates have the features of `programs` (fanout/Cargo.toml
# says how), so neither compiles them again after the other.
programs-and-tests:
	$(CARGO) build $(CARGO_FLAGS) --lib --bins --tests --examples

# `install` replaces the file, so that a trainer that runs keeps the one it has loaded.
EXTENSION = install -m 755 target/release/lib_native.so trainer/python/caraware/_native.abi3.so

# `source .venv/bin/activate` then gives `caraware`, which finds the other programs beside the file that the link names.
COMMAND = ln -sfn ../../target/release/caraware $(VENV)/bin/caraware

prerequisites:
	@scripts/prerequisites.sh "$(PYTHON)"

browser: ## a Chromium for the viewer's test
	@scripts/browser.sh

# SUMO comes before the other packages: `traffic-bridge` is compiled against it.
$(VENV)/.sumo: requirements.lock
	$(PYTHON) -m venv $(VENV)
	$(VENV)/bin/pip install --disable-pip-version-check --quiet $$(grep '^eclipse-sumo==' requirements.lock)
	touch $@

# The pins are in requirements.lock; the packages of this project are installed in place.
$(VENV)/.installed: $(VENV)/.sumo requirements.lock trainer/requirements-devkits.txt trainer/pyproject.toml viewer/pyproject.toml bench/pyproject.toml
	@echo "installing Python's packages into $(VENV): $(if $(filter 1,$(GPU)),7 GB on disk,3.3 GB on disk, and no CUDA: GPU=1 installs it)"
	$(call PINS,$(VENV))
	$(VENV)/bin/pip install --disable-pip-version-check --quiet --no-deps -r trainer/requirements-devkits.txt
	printf '%s\n' "$(CURDIR)/trainer/python" "$(CURDIR)/bench/python" \
		> $$($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/caraware.pth
	$(VENV)/bin/pip install --disable-pip-version-check --quiet --no-deps --no-build-isolation --editable ./viewer
	$(call COMPILE,$(VENV)) 'import torch._dynamo, matplotlib.pyplot'
	touch $@

# The environment $(1) gets the pins of requirements.lock, or of those that the packages $(2) ask for. Python compiles a module when it
# is first imported: most never are.
PINS = $(VENV)/bin/python scripts/pins.py --gpu $(GPU) $(2) > $(1)/pins.txt && \
	$(1)/bin/pip install --disable-pip-version-check --quiet --no-deps --no-compile -r $(1)/pins.txt && \
	$(if $(filter 1,$(GPU)),rm -f $(1)/.without-cuda,touch $(1)/.without-cuda && $(1)/bin/python scripts/without_cuda.py)

# An environment without CUDA gets it as soon as there is a GPU.
ifneq ($(filter 1,$(GPU)),)
ifneq ($(wildcard $(VENV)/.without-cuda),)
$(VENV)/.installed: with-cuda
endif
endif
with-cuda:

wheels: build ## wheels of the trainer with all programs, and of the viewer: target/wheels
	rm -rf target/wheels
	scripts/wheels.sh $(VENV)/bin/python target/wheels

install: wheels ## an environment of its own in PREFIX, from the wheels: PREFIX/bin/caraware
	@if [ -z "$(PREFIX)" ]; then echo "make install PREFIX=DIRECTORY makes an environment there" >&2; exit 2; fi
	$(PYTHON) -m venv $(PREFIX)
	$(call PINS,$(PREFIX),'trainer[$(EXTRAS)]' viewer)
	$(PREFIX)/bin/pip install --disable-pip-version-check --quiet --no-deps --force-reinstall target/wheels/*.whl
	$(COMPILE_IMPORTED)

# Compiles what the environment $(1) imports. Later users, and a container's, may not write beside it, and PYTHONDONTWRITEBYTECODE forbids
# it: each start of a trainer would compile the modules again, which takes half of the start.
COMPILE = env -u PYTHONDONTWRITEBYTECODE -u PYTHONPYCACHEPREFIX $(1)/bin/python -c

# All modules that a run imports.
COMPILE_IMPORTED = $(call COMPILE,$(PREFIX)) 'import torch._dynamo, \
	caraware.train, caraware.play, caraware.run.loop, caraware.ipc.channel, caraware.fusion.train, caraware.report.plots, caraware_viewer.__main__'

image: ## a container image of Containerfile, by podman, buildah or docker
	scripts/image.sh caraware GPU=$(GPU)

# A test thread more than cores: most tests start whole runs, which wait for each other much of the time. `--tests` leaves out
# documentation tests, of which no crate has any.
test-rust: programs-and-tests
	RUST_TEST_THREADS=$${RUST_TEST_THREADS:-$$(($$(nproc) + 1))} $(CARGO) test $(CARGO_FLAGS) --no-fail-fast --tests -- --skip $(ENDURANCE)

# It waits for minutes, and would wait alone at the end of the others.
ENDURANCE = disturbed_runs_end_as_if_nothing_had_happened

test-trainer:
	$(VENV)/bin/python -m pytest -q trainer/tests

# One pytest each: test modules of different packages may share names.
test-packages: programs-and-tests
	$(CARGO) test $(CARGO_FLAGS) --test command_line $(ENDURANCE)
	$(VENV)/bin/python -m pytest -q bench/tests
	cd viewer && ../$(VENV)/bin/python -m pytest -q tests
	$(VENV)/bin/python -m pytest -q maps/town/tests
	$(VENV)/bin/python -m pytest -q maps/valley/tests
	$(VENV)/bin/python -m pytest -q sim-core/tests

# Left out: detector.png needs a trained detector, driving-curves.png runs of eight minutes on sixteen cores, error.png a run of `town`.
pictures: export PATH := $(CURDIR)/$(VENV)/bin:$(PATH)
pictures: build programs-and-tests browser ## the pictures of README and docs anew, in a real browser where they show a page
	rm -rf target/pictures
	mkdir -p target/pictures/sensors
	$(VENV)/bin/python docs/images/animate_town.py record target/pictures/town
	$(VENV)/bin/python docs/images/animate_town.py draw target/pictures/town/runs/town-gif
	CARAWARE_SCREENSHOT=docs/images/viewer.png $(PICTURE) viewer/tests/test_browser.py -k "mode and train"
	CARAWARE_SCREENSHOT=docs/images/messages.png CARAWARE_SCREENSHOT_MODE=messages $(PICTURE) viewer/tests/test_browser.py -k messages
	CARAWARE_PANEL_SCREENSHOT=docs/images/panel.png $(PICTURE) viewer/tests/test_panel.py
	$(VENV)/bin/python docs/images/draw_planes.py
	$(VENV)/bin/python docs/images/draw_articulated.py
	target/release/examples/response > target/pictures/response.csv
	$(VENV)/bin/python docs/images/draw_vehicle_model.py target/pictures/response.csv
	target/release/examples/sensor_plots target/pictures/sensors
	$(VENV)/bin/python docs/images/sensor_plots.py target/pictures/sensors

PICTURE = $(VENV)/bin/python -m pytest --quiet

newcomer: build ## every command block of README and docs, also those that the tests only parse: about a quarter of an hour
	$(VENV)/bin/python scripts/newcomer.py --all

MIRI = cd sensor-daemon/tests/miri && MAKEFLAGS= RUSTFLAGS=-Ctarget-feature=+avx2 CARGO_TARGET_DIR=$(CURDIR)/target/miri cargo +nightly miri test

# The tests look at fewer deaths, preemptions and frames.
model: prerequisites $(VENV)/.installed ## the models and the parsers for longer than in the tests, the unsafe parts under Miri: about an hour
	CARAWARE_MODEL_DEATHS=3,3 $(CARGO) test $(CARGO_FLAGS) --test protocol_model
	CARAWARE_LOOM_PREEMPTIONS=4 $(CARGO) test $(CARGO_FLAGS) --test boards_under_loom
	CARAWARE_FUZZ_FRAMES=100000000 $(CARGO) test $(CARGO_FLAGS) --test hostile_frames
	CARAWARE_FUZZ_FRAMES=100000000 $(CARGO) test $(CARGO_FLAGS) --test messages
	CARAWARE_FUZZ_FRAMES=1000000 $(CARGO) test $(CARGO_FLAGS) --test fanout a_flood
	CARAWARE_DAMAGED_COPIES=38 $(CARGO) test $(CARGO_FLAGS) --test system whole_program_survives
	cd viewer && CARAWARE_FUZZ_FRAMES=1000000 ../$(VENV)/bin/python -m pytest -q tests/test_hostile_frames.py
	$(MAKE) --no-print-directory miri
	export MIRIFLAGS="-Zmiri-disable-data-race-detector -Zmiri-many-seeds=0..64"; $(MIRI) --features racing-board -- a_board_that

miri: prerequisites ## the unsafe parts under Miri, in a few minutes (needs: rustup toolchain install nightly --component miri,rust-src)
	$(MIRI) -- --skip noise::

lint: lint-rust lint-python ## formatting and lints, as errors

# `cargo clippy` would check the third-party crates that the tests compile: scripts/clippy.sh.
lint-rust: prerequisites $(VENV)/.sumo
	cargo fmt --all --check
	RUSTC_WORKSPACE_WRAPPER=$(CURDIR)/scripts/clippy.sh $(CARGO) build $(CARGO_FLAGS) --all-targets

lint-python: $(VENV)/.installed
	$(VENV)/bin/ruff check trainer viewer bench
	$(VENV)/bin/ruff check --config trainer/pyproject.toml sim-core sensor-daemon v2x docs maps scripts
	$(VENV)/bin/ruff format --check trainer viewer bench
	$(VENV)/bin/ruff format --config trainer/pyproject.toml --check sim-core sensor-daemon v2x docs maps scripts
	cd viewer && ../$(VENV)/bin/mypy
	cd trainer && ../$(VENV)/bin/mypy

format: $(VENV)/.installed
	cargo fmt --all
	$(VENV)/bin/ruff check --fix trainer viewer bench
	$(VENV)/bin/ruff check --config trainer/pyproject.toml --fix sim-core sensor-daemon v2x docs maps scripts
	$(VENV)/bin/ruff format trainer viewer bench
	$(VENV)/bin/ruff format --config trainer/pyproject.toml sim-core sensor-daemon v2x docs maps scripts

deny: ## licences, sources and advisories of all dependencies (needs: cargo install cargo-deny --locked)
	cargo deny check

bench: build ## the benchmarks of docs/benchmarks.md
	cargo bench --locked

peers: build ## what `caraware bench` compares with, in an environment of its own that sees the project's packages
	$(VENV)/bin/python -m venv .venv-peers
	($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'; \
		printf '%s\n' "$(CURDIR)/trainer/python" "$(CURDIR)/bench/python") \
		> $$(.venv-peers/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/project.pth
	.venv-peers/bin/pip install --disable-pip-version-check --quiet --progress-bar on -r bench/requirements-peers.txt

# These two pin other versions of shared packages: each has an environment of its own that sees the benchmarks' package alone.
OWN_ENVIRONMENT = echo "$(CURDIR)/bench/python" > $$($(1)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/project.pth

peers-metadrive: ## MetaDrive for `caraware bench peers`: 60 MB to download for its models beside its packages, 1 GB on disk
	$(PYTHON) -m venv .venv-metadrive
	.venv-metadrive/bin/pip install --disable-pip-version-check --quiet --progress-bar on -r bench/requirements-metadrive.txt
	$(call OWN_ENVIRONMENT,.venv-metadrive)
	.venv-metadrive/bin/python -m caraware_bench.metadrive_assets

peers-smarts: ## SMARTS for `caraware bench peers`, which needs Python 3.10 (PYTHON310=PATH): 1.1 GB on disk
	$(PYTHON310) -m venv .venv-smarts
	.venv-smarts/bin/pip install --disable-pip-version-check --quiet --progress-bar on -r bench/requirements-smarts.txt
	$(call OWN_ENVIRONMENT,.venv-smarts)

site: .venv-site/.installed ## a website of all pages, with every link checked: target/site/html
	.venv-site/bin/python docs/site/build.py

.venv-site/.installed: docs/requirements-site.txt
	$(PYTHON) -m venv .venv-site
	.venv-site/bin/pip install --disable-pip-version-check --quiet --progress-bar on -r docs/requirements-site.txt
	touch $@

faces: build ## RLlib for `caraware.examples.rllib_ppo`, in an environment of its own that sees the project's packages: 380 MB on disk
	$(VENV)/bin/python -m venv .venv-faces
	echo '*' > .venv-faces/.gitignore
	($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'; echo "$(CURDIR)/trainer/python") \
		> $$(.venv-faces/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/project.pth
	.venv-faces/bin/pip install --disable-pip-version-check --quiet --progress-bar on -r trainer/requirements-faces.txt

# With NO_OCEAN, PufferLib's setup.py neither compiles its games nor downloads libraries for them. But then it reads a list that only the
# games define, so Python gets an empty one. The kernel fits the project's torch alone: pip keeps no wheel of it, and `--clear` makes it anew.
puffer: build ## PufferLib for `caraware.examples.puffer_ppo`, in an environment of its own that sees the project's packages: 107 MB on disk
	$(VENV)/bin/python -m venv --clear --without-pip .venv-puffer
	echo '*' > .venv-puffer/.gitignore
	($(VENV)/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))'; echo "$(CURDIR)/trainer/python"; \
		echo 'import builtins; builtins.c_extension_paths = []') \
		> $$(.venv-puffer/bin/python -c 'import sysconfig; print(sysconfig.get_path("purelib"))')/project.pth
	NO_OCEAN=1 $(VENV)/bin/pip --python .venv-puffer/bin/python install --disable-pip-version-check --quiet --progress-bar on \
		--no-cache-dir --no-deps --no-build-isolation --ignore-installed -r trainer/requirements-puffer.txt

clean:
	cargo clean
	rm -rf $(VENV) .venv-peers .venv-metadrive .venv-smarts .venv-faces .venv-puffer .venv-site
