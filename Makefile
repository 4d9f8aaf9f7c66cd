# canductor: every target sets up what it needs in .venv. Needs python3 >= 3.11 with venv and headers, gcc, make.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
C_SOURCES := $(shell git ls-files '*.c' '*.h' 2>/dev/null || find firmware nodes coordinator -name '*.[ch]')
NATIVE_INPUTS := $(C_SOURCES) $(wildcard firmware/Makefile firmware/tools/*.py) setup.py pyproject.toml \
	$(shell find nodes coordinator -name 'build_*.py')

C_WARNINGS := -std=gnu11 -Wall -Wextra -Wconversion -Wno-psabi -Werror -I. -Ifirmware

.PHONY: demo test check pytest ctest fuzz vcan bench clean setup format pytest-live pytest-sim-a-m pytest-sim-n-z \
	pytest-coordinator pytest-motion pytest-others
.DEFAULT_GOAL := test

# The C code is compiled while pip fetches packages.
setup:
	@$(MAKE) -j2 --no-print-directory $(VENV)/.installed

$(VENV)/.python: pyproject.toml .ci/prerequisites
	@sh .ci/prerequisites $(PYTHON)
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install -q --disable-pip-version-check 'setuptools>=77' 'cffi>=2.0'
	@touch $@

$(VENV)/.dependencies: $(VENV)/.python .ci/requirements
	$(BIN)/python .ci/requirements dev >$(VENV)/requirements.txt
	$(BIN)/pip install -q --disable-pip-version-check -r $(VENV)/requirements.txt
	@touch $@

$(VENV)/.compiled: $(VENV)/.python $(NATIVE_INPUTS)
	$(BIN)/python setup.py -q build_ext --inplace
	@touch $@

$(VENV)/.installed: $(VENV)/.dependencies $(VENV)/.compiled
	$(BIN)/pip install -q --disable-pip-version-check --no-build-isolation --no-deps -e .
	# As an installation that is not editable does; some environments forbid Python to do it later.
	@$(BIN)/python -m compileall -q coordinator nodes canbus_tools
	@touch $@

demo: setup
	$(BIN)/canductor demo

check: $(VENV)/.dependencies
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/clang-format --dry-run --Werror $(C_SOURCES)
	# A board needs its build's constants: firmware/Makefile compiles those, with the same warnings as errors.
	@for c in $(filter-out firmware/boards/%,$(filter %.c,$(filter firmware/% nodes/% coordinator/%,$(C_SOURCES)))); do \
	  gcc $(C_WARNINGS) -fsyntax-only $$c || exit 1; done
	@$(MAKE) --no-print-directory clang-c
	@! command -v node >/dev/null || for f in coordinator/web/page/*.js; do \
	  node --check --input-type=module <$$f || exit 1; done
	$(BIN)/pytest --noconftest tests/test_import_floors.py

ctest: $(VENV)/.installed
	$(MAKE) -C tests PYTHON=$(abspath $(BIN)/python)
	$(MAKE) -C tests/fuzz short

# The Python tests in parts of about equal size, which run in parallel: a process collects its own part only.
LIVE := tests/smoke tests/coordinator/web
MOTION := tests/coordinator/motion tests/coordinator/kinematics tests/coordinator/verification
pytest-live: WHAT = $(LIVE)
pytest-sim-a-m: WHAT = $(sort $(wildcard tests/sim/test_[a-m]*.py))
pytest-sim-n-z: WHAT = $(sort $(wildcard tests/sim/test_[n-z]*.py))
pytest-coordinator: WHAT = tests/coordinator $(addprefix --ignore=,$(LIVE) $(MOTION))
pytest-motion: WHAT = $(MOTION)
# The import floors are part of check.
pytest-others: WHAT = tests $(addprefix --ignore=,$(LIVE) tests/sim tests/coordinator tests/test_import_floors.py)
# Those that wait for processes come first, beside each other; what only calculates fills the processors to the end.
PARTS := pytest-live pytest-others pytest-coordinator pytest-sim-n-z pytest-sim-a-m pytest-motion
$(PARTS): $(VENV)/.installed
	$(BIN)/pytest $(WHAT)

pytest:
	@$(MAKE) -k -j3 --output-sync=target $(PARTS)

# All of it in parallel. Nothing but a dozen smoke tests takes real time (docs/testing.md).
test:
	@$(MAKE) -k -j3 --output-sync=target $(PARTS) check ctest

# Ten minutes of hostile G-code through the motion engine, under the sanitizers; ctest has a short run of it.
FUZZ_SECONDS ?= 600
fuzz: setup
	$(MAKE) -C tests/fuzz run SECONDS=$(FUZZ_SECONDS)

include tests/thorough.mk

# SocketCAN in Linux kernels booted as processes: two, since one has one CPU. Builds nothing inside.
vcan: setup
	@missing=$$(sh tests/vcan/missing-packages); [ -z "$$missing" ] || { \
	  echo "canductor: make vcan needs: apt-get install --no-install-recommends $$missing" >&2; exit 1; }
	tests/vcan/run $(BIN)/python -m pytest

bench: setup
	@for b in bench/*.py; do echo "== $$b"; $(BIN)/python $$b || exit 1; done

include tests/eyes.mk
include tests/frontends.mk

format: setup
	$(BIN)/ruff check --fix . ; $(BIN)/ruff format .
	$(BIN)/clang-format -i $(C_SOURCES)

clean:
	rm -rf $(VENV) build *.egg-info nodes/virtual/bin .mypy_cache .ruff_cache .pytest_cache .hypothesis
	find nodes coordinator \( -name '_*.c' -o -name '*.so' -o -name '*.o' \) -delete
	$(MAKE) -C firmware clean
