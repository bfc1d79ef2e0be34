# Everything runs in .venv, which is created here; it needs only Python 3.11 or newer and make.
# `make PYTHON=python3.12 test` uses another interpreter.

PYTHON ?= python3
BIN := .venv/bin
# Tests start some thousand processes: none of them compiles every module again.
unexport PYTHONDONTWRITEBYTECODE
PIP := $(BIN)/python -m pip --disable-pip-version-check

.PHONY: help demo test everything check coverage bench faults simulate mutants clean

help:
	@echo "make demo      calibrate, compensate and diagnose a simulated cell; results in out/demo"
	@echo "make test      the tests without the slow ones"
	@echo "make everything  all tests: also long runs of daemons, demos, kills, fuzzing, every fault"
	@echo "make check     format, lint, types, import contracts, the tests"
	@echo "make coverage  all tests, with the line coverage of core and drivers"
	@echo "make bench     speed compared with other libraries; figures in out/speed.json, out/fleet.json"
	@echo "make faults    every fault over the real protocols, and random ones; fills docs/reliability.md"
	@echo "make mutants   put small faults into the product one at a time, and list those not detected"
	@echo "make simulate  whole runs with faults in simulated time, on all cores; SEEDS=100000, FIRST=0"
	@echo "make clean     remove .venv and all generated files"

demo: .venv/.main
	$(BIN)/gapbridge demo

# Two processes for tests of protocols, which mostly wait; two for all others.
SIDE_BY_SIDE := -n 4

test: warm
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not slow"

# The table of faults is judged by milliseconds on a wire: it has the machine to itself.
FAULT_TABLE := tests/faults/test_matrix.py

everything: warm
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) --ignore $(FAULT_TABLE)
	$(BIN)/python -m pytest $(FAULT_TABLE)

check: warm
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports
	$(BIN)/python -m pytest $(SIDE_BY_SIDE) -m "not slow"

# Coverage cannot see compiled kernels: their tests also run as plain Python.
KERNEL_TESTS := $(addprefix tests/core/test_,kinematics.py statics.py equilibrium.py \
	compensation.py limits.py effects_position.py effects_moving.py)

coverage: warm
	$(PIP) install --quiet --editable '.[coverage]'
	NUMBA_DISABLE_JIT=1 $(BIN)/python -m pytest --cov --cov-report= $(KERNEL_TESTS)
	$(BIN)/python -m pytest --cov --cov-append --cov-report=term-missing:skip-covered \
		--ignore $(FAULT_TABLE)

bench: warm
	$(BIN)/python -m benchmarks.speed --out out/speed.json
	$(BIN)/python -m benchmarks.fleet growth --no-dask --json out/fleet.json

# REPEAT: runs of each fault. SEQUENCES: random sequences. MINUTES: no fault is started later.
REPEAT ?= 5
SEQUENCES ?= 1000
MINUTES ?= 120

faults: warm
	$(BIN)/python -m benchmarks.faults --repeat $(REPEAT) --sequences $(SEQUENCES) \
		--minutes $(MINUTES) --page

mutants: warm
	$(BIN)/python -m benchmarks.mutants --out out/mutants.jsonl

# SEEDS: number of runs; the same command resumes an interrupted one (out/simulation.jsonl).
# A single run: .venv/bin/python -m benchmarks.simulation --seed N
SEEDS ?= 2000
FIRST ?= 0

simulate: warm
	$(BIN)/python -m benchmarks.simulation --first $(FIRST) --seeds $(SEEDS)

.venv/bin/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
		|| { echo "$(PYTHON) is older than 3.11; try make PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv .venv

# One stamp per set of dependencies. The libraries that compile the inner loops are installed first:
# the loops are compiled while the other libraries are downloaded.
.venv/.main: pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --no-compile numba pydantic pyyaml
	$(BIN)/python -m gapbridge.bridge.loop.warm_up & compiling=$$!; \
		$(PIP) install --quiet --no-compile --editable . && wait $$compiling
	@touch $@

.venv/.test: pyproject.toml | .venv/bin/python
	$(PIP) install --quiet --editable '.[test]'
	@touch $@ .venv/.main

# After an installation and after every change of a compiled function: no test has to compile.
.PHONY: warm
warm: .venv/.test
	@$(BIN)/python -m gapbridge.bridge.loop.warm_up

clean:
	rm -rf .venv out build dist *.egg-info .pytest_cache .mypy_cache .ruff_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
