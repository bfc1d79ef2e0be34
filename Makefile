# Everything runs in .venv, which is made here: Python 3.11 or newer and make are all it takes.
# `make PYTHON=python3.12 test` takes another interpreter.

PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help demo test everything check coverage bench faults simulate mutants clean

help:
	@echo "make demo      the whole job on a simulated cell; results in out/demo"
	@echo "make test      the tests, in minutes"
	@echo "make everything  these and the slow ones: long runs of daemons, demos, kills, fuzzing"
	@echo "make check     format, lint, types, import contracts, the tests"
	@echo "make coverage  all tests, and which lines of core and drivers they reach"
	@echo "make bench     speed beside peers, in one run; figures in out/speed.json, out/fleet.json"
	@echo "make faults    every fault on the real wire, and random ones; fills docs/reliability.md"
	@echo "make mutants   small mistakes put into the product one at a time, and which go unnoticed"
	@echo "make simulate  whole runs with faults in simulated time, on all cores; SEEDS=100000, FIRST=0"
	@echo "make clean     remove .venv and everything that was made"

demo: .venv/.main
	$(BIN)/gapbridge demo

# Two processes for what goes over wires, which mostly waits; two that compute in the meantime.
SIDE_BY_SIDE := -n 4

test: warm
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not slow"

everything: warm
	$(BIN)/python -m pytest $(SIDE_BY_SIDE)

check: warm
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not slow"

# Compiled kernels run unseen: the tests that check them run once more, as plain Python.
KERNEL_TESTS := $(addprefix tests/core/test_,kinematics.py statics.py equilibrium.py \
	compensation.py limits.py effects_position.py effects_moving.py)

coverage: warm
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest --cov --cov-report= $(KERNEL_TESTS)
	$(BIN)/python -m pytest --cov --cov-append --cov-report=term-missing:skip-covered

bench: warm
	$(BIN)/python -m benchmarks.speed --out out/speed.json
	$(BIN)/python -m benchmarks.fleet growth --no-dask --json out/fleet.json

# REPEAT: times that each fault is made. SEQUENCES: random ones. MINUTES: no fault is begun after.
REPEAT ?= 5
SEQUENCES ?= 1000
MINUTES ?= 120

faults: warm
	$(BIN)/python -m benchmarks.faults --repeat $(REPEAT) --sequences $(SEQUENCES) \
		--minutes $(MINUTES) --page

mutants: warm
	$(BIN)/python -m benchmarks.mutants --out out/mutants.jsonl

# SEEDS: how many runs; the same command again goes on where it was left (out/simulation.jsonl).
# One of them again: .venv/bin/python -m benchmarks.simulation --seed N
SEEDS ?= 2000
FIRST ?= 0

simulate: warm
	$(BIN)/python -m benchmarks.simulation --first $(FIRST) --seeds $(SEEDS)

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "$(PYTHON) is older than 3.11; try make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv

# one stamp per set of dependencies: a later make finds nothing to do
# What compiles the inner loops goes first: they are compiled while the rest is fetched and unpacked.
.venv/.main: pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --no-compile numba pydantic pyyaml
	$(BIN)/python -m gapbridge.bridge.loop.warm_up & compiling=$$!; \
		$(PIP) install --quiet --no-compile --editable . && wait $$compiling
	@touch $@

.venv/.test: pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --editable '.[test]'
	@touch $@ .venv/.main

# After an installation, and after every change of a compiled function:
# nothing is compiled in the middle of a test.
.PHONY: warm
warm: .venv/.test
	@$(BIN)/python -m gapbridge.bridge.loop.warm_up

clean:
	rm -rf .venv out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
