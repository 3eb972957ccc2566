# Install, show, test and package handtouch. Needs make and Python 3.11 or later with venv; `make help` lists the targets.

PYTHON ?= $(shell for p in python3 python3.14 python3.13 python3.12 python3.11; do \
	$$p -c 'import sys; sys.exit(sys.version_info < (3, 11))' 2>/dev/null && echo $$p && break; done)
VENV ?= .venv
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check --quiet
ONLY ?= *
UPGRADE ?= --upgrade
ARGS ?=
# tests start hundreds of processes; without bytecode each of them would compile the source
unexport PYTHONDONTWRITEBYTECODE

.PHONY: help
help: ## list the targets (default)
	@sed -n 's/^\([a-z-]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | while IFS='	' read -r name text; do \
		printf '  make %-10s %s\n' "$$name" "$$text"; done

# --- installation: a stamp file records what a virtual environment holds, so that a second run is skipped

$(BIN)/python:
	@test -n "$(PYTHON)" || { echo "no Python 3.11 or later found; give make PYTHON=/path/to/python3"; exit 1; }
	@$(PYTHON) -m venv $(VENV) || { echo "python3 -m venv failed; on Debian: apt-get install python3-venv"; exit 1; }

# exactly the locked files of packages, by their hashes; then handtouch itself, built by the locked build tools
# by uv where it is found, which takes a third of the time, else and where it fails by pip
UV := $(shell command -v uv 2>/dev/null)
PIP_LOCKED := $(PIP) install --no-compile --require-hashes --no-deps
LOCKED = install() { $(if $(UV),$(UV) pip install --quiet --python $(BIN)/python --require-hashes --no-deps "$$@" \
	2>/dev/null ||) $(PIP_LOCKED) "$$@"; }; install
HANDTOUCH := $(if $(UV),$(UV) pip install --quiet --python $(BIN)/python --no-deps --no-build-isolation -e . 2>/dev/null ||) \
	$(PIP) install --no-compile --no-deps --no-build-isolation -e .
# with progress, before pip builds the package in silence; without a compiler it says what is missing
COMPILE := $(BIN)/python src/handtouch/core/build.py || test "$(CI)" != true

# $(call INSTALL,LOCK): the build tools, which compile while the packages of the lock are installed, then handtouch
INSTALL = $(LOCKED) -r locks/build.lock && { { $(COMPILE); } & compiling=$$!; $(LOCKED) -r locks/$(1).lock; installed=$$?; \
	wait $$compiling && test $$installed = 0; } && { $(HANDTOUCH); }

$(VENV)/.run: pyproject.toml locks/run.lock locks/build.lock | $(BIN)/python
	@echo "installing packages into $(VENV) ..."
	@$(call INSTALL,run)
	@touch $@

$(VENV)/.dev: pyproject.toml locks/dev.lock locks/build.lock | $(BIN)/python
	@echo "installing packages and tools into $(VENV) ..."
	@$(call INSTALL,dev)
	@touch $(VENV)/.run $(VENV)/.view $@

# sources that Cython compiles; a run without a compiler is slower, and says so
CORE := $(wildcard src/handtouch/*/stages/*.py src/handtouch/*/stages/*.pxd) src/handtouch/core/compiled.py
$(VENV)/.core: $(CORE) | $(VENV)/.dev
	@$(BIN)/python src/handtouch/core/build.py && touch $@ || test "$(CI)" != true

$(VENV)/.view: locks/view.lock | $(VENV)/.run
	@echo "installing packages for joints and meshes in the view ..."
	@$(LOCKED) -r locks/view.lock
	@touch $@

.PHONY: install dev
install: $(VENV)/.run ## install the packages for a robot into .venv
dev: $(VENV)/.dev $(VENV)/.core ## install the packages for development into .venv

# --- use

.PHONY: demo
demo: $(VENV)/.run $(if $(VIEW),$(VENV)/.view) ## run a simulated hand, the daemon and a live view (VIEW=1: in the browser)
	@$(BIN)/handtouch demo $(if $(VIEW),--view) $(ARGS)

.PHONY: examples
examples: $(VENV)/.dev ## run examples/, each a control loop with a simulated gripper; one minute
	@$(BIN)/python examples/run_all.py

.PHONY: bolt
bolt: $(VENV)/.dev $(VENV)/.core ## find a bolt by touch and start it in a hole, with a simulated hand; a minute
	@$(BIN)/python examples/start_bolt.py $(ARGS)

# --- test

.PHONY: test check lint types unit fastest coverage socketcan docs tables wiring
test: ## run everything that CI runs
	@mkdir -p build; log=build/computed.txt; : >$$log; \
	$(MAKE) --no-print-directory --jobs=2 TO=">$$log 2>&1" timed computed; status=$$?; cat $$log; exit $$status

check: ## run lint, types and the fastest tests, as far as `make test` measured them
	@$(MAKE) --no-print-directory --jobs=2 --output-sync=target lint types fastest

# processes of tests wait for one another half of the time; what waits for nothing fills it, and gives way
TIMED := $(addprefix tests/,bridge cli client daemon device end_to_end host node procedures view test_examples.py)
.PHONY: timed computed
timed: $(VENV)/.dev $(VENV)/.core
	@$(MAKE) --no-print-directory socketcan
	@$(MAKE) --no-print-directory unit ARGS="$(TIMED) $(ARGS)"

computed: $(VENV)/.dev $(VENV)/.core
	@{ nice -n 5 $(MAKE) --no-print-directory lint types docs && \
	nice -n 10 $(MAKE) --no-print-directory unit ARGS="$(addprefix --ignore=,$(TIMED)) $(ARGS)"; } $(TO)

# for the way between two edits; durations are those of the last `make test`
fastest: $(VENV)/.dev $(VENV)/.core
	@$(MAKE) --no-print-directory unit ARGS="-n 2 --within 80 $(ARGS)"

lint: $(VENV)/.dev ## check style
	$(BIN)/ruff check
	$(BIN)/ruff format --check
	$(BIN)/python -m docs.wire_files --check

types: $(VENV)/.dev ## check static types
	$(BIN)/mypy --strict

docs: $(VENV)/.dev ## build the documentation in docs/_build; warnings are errors
	$(BIN)/sphinx-build -W --keep-going -q -b html docs docs/_build

tables: $(VENV)/.dev ## write from the code what is generated of messages (docs/wire_files.py lists it), of configuration and of firmware
	$(BIN)/python -m docs.wire_files
	$(BIN)/python docs/firmware_tables.py
	@mkdir -p build
	$(BIN)/python docs/configuration_page.py >build/configuration.md && mv build/configuration.md docs/configuration.md
	$(BIN)/handtouch check --schema >build/schema.json && mv build/schema.json config/handtouch.schema.json
	$(BIN)/handtouch node --schema >build/schema.json && mv build/schema.json config/touch_node.schema.json

wiring: $(BIN)/python ## draw docs/wiring.svg, the wiring of a sensor node
	$(BIN)/python docs/wiring.py >docs/wiring.svg

# two workers for two processors: a third, unless it gives way, starves simulated nodes now and then
unit: $(VENV)/.dev $(VENV)/.core ## run all tests that need no SocketCAN
	$(BIN)/python -m pytest -m "not socketcan" -n 2 --dist loadfile --no-loadscope-reorder $(ARGS)

coverage: $(VENV)/.dev ## run them with a report of lines not covered; slower
	@rm -rf build/tests/handtouch # tables of earlier sessions would leave the code that computes them idle
	@$(MAKE) --no-print-directory unit ARGS="--cov --cov-report=term:skip-covered $(ARGS)"

socketcan: $(VENV)/.dev $(VENV)/.core ## run the tests on SocketCAN; skipped without it, which fails CI
	@marked=$$(grep -rl --include='*.py' 'mark\.socketcan' tests); \
	VCAN_RUN_TIMEOUT=900 tests/socketcan/vcan-run $(BIN)/python -m pytest -m socketcan $$marked $(ARGS); status=$$?; \
	if [ $$status -eq 77 ] && [ "$(CI)" != true ]; then echo "SocketCAN tests SKIPPED, see the reason above"; exit 0; \
	elif [ $$status -eq 77 ]; then echo "SocketCAN tests were skipped, and CI needs them"; exit 1; fi; exit $$status

# --- measure: every benchmarks/{bench,soak,stress}_NAME.py; ONLY=NAME chooses one

.PHONY: bench soak stress
bench: ## run the benchmarks: errors, latency, load; an hour
soak: ## run the endurance tests
stress: ## run sweeps that are too slow for the tests
bench soak stress: $(VENV)/.dev $(VENV)/.core
	@PYTHONPATH=. $(BIN)/python -m benchmarks.run_programs $@ '$(ONLY)' $(ARGS)

# --- maintain

.PHONY: format lock audit dist clean
format: $(VENV)/.dev ## format the source
	$(BIN)/ruff check --fix-only
	$(BIN)/ruff format

lock: $(BIN)/python ## update the pinned versions and hashes of all packages in locks/; UPGRADE= keeps versions
	@$(PIP) install uv
	@cd locks && lock() { name=$$1; shift; $(abspath $(BIN))/uv pip compile --quiet --universal --python-version 3.11 \
		--generate-hashes --no-header --no-annotate --no-emit-index-url --no-emit-find-links --output-file $$name.lock "$$@"; }; \
	lock dev $(UPGRADE) --extra dev --group ../pyproject.toml:build ../pyproject.toml && \
	lock run -c dev.lock ../pyproject.toml && lock view -c dev.lock --extra view ../pyproject.toml && \
	lock build -c dev.lock --group ../pyproject.toml:build && \
	lock dist $(UPGRADE) -c dev.lock --group ../pyproject.toml:dist

audit: ## compare all locked versions with published vulnerabilities; needs access to osv.dev
	@test -x build/audit/bin/pip-audit || { $(PYTHON) -m venv build/audit && \
		build/audit/bin/python -m pip --disable-pip-version-check --quiet install pip-audit; }
	@for lock in run view dev build dist; do echo "locks/$$lock.lock:"; \
		build/audit/bin/pip-audit --vulnerability-service osv --disable-pip --require-hashes -r locks/$$lock.lock \
		|| failed=1; done; exit $${failed:-0}

# for any Linux with glibc 2.17 or later on these machines; ziglang has a C compiler for both
dist: $(VENV)/.dev ## build the source archive, wheels for x86_64 and aarch64, and a bill of materials (SBOM)
	$(BIN)/python -m benchmarks.stale
	@$(LOCKED) -r locks/dist.lock
	rm -rf dist build
	$(BIN)/python -m build --no-isolation --sdist
	for machine in x86_64 aarch64; do \
		HANDTOUCH_WHEEL_MACHINE=$$machine $(BIN)/python -m build --no-isolation --wheel || exit 1; done
	$(BIN)/python locks/sbom.py run >dist/handtouch.cdx.json

.PHONY: deb
deb: ## build the Debian package of the services in build/, for this machine's Python; needs debhelper
	rm -rf build/deb && mkdir -p build/deb
	git archive --prefix=handtouch/ HEAD | tar -x -C build/deb
	cd build/deb/handtouch && PATH=/usr/sbin:/usr/bin:/sbin:/bin dpkg-buildpackage -us -uc -b

.PHONY: release
release: ## check and build all parts of a release in dist/, and print the commands that upload them
	@test -z "$$(git status --porcelain)" || { echo "commit your changes first: a release is made of a commit"; exit 1; }
	@$(MAKE) --no-print-directory check docs dist
	@npm pack --silent --pack-destination dist ./clients/js
	@if command -v dpkg-buildpackage >/dev/null; then $(MAKE) --no-print-directory deb && cp build/deb/*.deb dist/; \
	else echo "no Debian package: apt-get install debhelper dpkg-dev"; fi
	@version=$$(sed -n 's/^version = "\(.*\)"/\1/p' pyproject.toml); ls -l dist; printf '%s\n' "To publish $$version:" \
		"  git tag -s v$$version && git push origin v$$version" \
		"  python -m twine upload dist/*.whl dist/*.tar.gz" \
		"  npm publish dist/handtouch-$$version.tgz" \
		"  docker build -f docker/Dockerfile -t handtouch:$$version . && docker push REGISTRY/handtouch:$$version"

clean: ## remove build results and .venv
	rm -rf $(VENV) dist build .coverage .mypy_cache .ruff_cache .pytest_cache .hypothesis
