# `make` alone prints what there is. The environment .venv is made from requirements.lock by the
# targets that need it, and again when the lock or pyproject.toml has changed.
.DEFAULT_GOAL := help
SHELL := /bin/bash
.SHELLFLAGS := -euo pipefail -c

PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
OUT ?= optnav-demo
ARGS ?=
NEWEST ?= python3.13
N ?= 500
SEED ?= 1
KINDS ?=
CASE ?=
# A test file at a time, in the order of the folders, so that what the tests of a file share is made
# once and the longest files do not come last. tests/conftest.py says how many processes "auto" means.
PARALLEL := -n auto --dist loadfile --no-loadscope-reorder
# Tests start hundreds of processes, and each would compile the modules where no byte code is kept.
BYTE_CODE := -m compileall -q catalog optnav_cli
# The processes that run tests share that of the tests; tests/conftest.py says how.
KEEP_BYTE_CODE := PYTHONDONTWRITEBYTECODE=
# With threads of its own in each of these, products of small matrices take four times as long.
ONE_THREAD := OPENBLAS_NUM_THREADS=1

.PHONY: help setup demo test check lint types tests fuzz cases bench bench-global golden docs newest lock clean

help: ## print this list
	@echo "optnav: control-point catalogs from terrain, camera positions from pictures"
	@echo
	@grep -hE '^[a-z%-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/:[^#]*## /\t/' \
	  | while IFS=$$'\t' read -r name text; do printf '  make %-12s %s\n' "$$name" "$$text"; done
	@echo
	@echo "  PYTHON=python3.12 chooses the interpreter (3.11 or newer) that .venv is made with."

setup: $(READY) ## make the environment .venv from requirements.lock

$(READY): requirements.lock pyproject.toml
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "make: $(PYTHON) is older than Python 3.11; name a newer one: make PYTHON=python3.12" >&2; exit 1; }
	rm -rf .venv
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile --require-hashes -r requirements.lock
# pip would compile the 6300 modules on one core; one that does not compile is left to its import
	-$(BIN)/python -m compileall -q -j 0 .venv/lib
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation -e .
	@touch $@

demo: $(READY) ## the main job on the bundled Tycho terrain, with a report (OUT=optnav-demo)
	$(BIN)/optnav demo -o $(OUT)

test: $(READY) ## style, types and tests with warnings as errors: what CI runs
	@$(MAKE) --no-print-directory --jobs=3 lint types tests

check: test ## the same as test

lint: $(READY) ## style alone
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .

types: $(READY) ## types alone
	$(BIN)/mypy

tests: $(READY) ## tests alone (ARGS="-k nearest -x" is handed to pytest; -n 0: one process)
	@$(BIN)/python $(BYTE_CODE)
	@$(ONE_THREAD) $(BIN)/python -m tests.kernels
	$(KEEP_BYTE_CODE) $(ONE_THREAD) $(BIN)/python -m pytest $(PARALLEL) $(ARGS)

fuzz: $(READY) ## hostile inputs (N=500 SEED=1; one of them again: CASE=kind:seed; KINDS=map,import)
	$(BIN)/python -m tests.fuzz -n $(N) --seed $(SEED) --kinds "$(KINDS)" --case "$(CASE)" $(ARGS)

cases: $(READY) ## read a folder of other programs' files, each right or refused (DIR=/some/folder)
	@[ -n "$(DIR)" ] || { echo "make: name the folder with files/ and archives/: make cases DIR=/some/folder" >&2; exit 2; }
	$(BIN)/python -m tests.cases "$(DIR)" $(ARGS)

study-%: $(READY) ## one long experiment behind the figures, such as study-selection
	$(BIN)/python -m tests.studies $* $(ARGS)

bench: $(READY) ## speed, as ratios to well-known tools on this machine (STORE=yes keeps the table)
	OPTNAV_BENCH=full OPTNAV_BENCH_STORE=$(STORE) $(ONE_THREAD) $(BIN)/python -m pytest tests/bench -m bench -q -s $(ARGS)

bench-global: $(if $(DIR),$(READY)) ## a catalog of the whole Moon at full size (DIR=/some/folder, 19 GB; an hour)
	@[ -n "$(DIR)" ] || \
	  { echo "make: name a folder to work in, on a disk with 19 GB free: make bench-global DIR=/some/folder" >&2; exit 2; }
	$(BIN)/python -m tests.bench.global_moon "$(DIR)" $(ARGS)

golden: $(READY) ## golden values, and the READMEs' pictures and captions anew; look at the difference
	$(BIN)/python -m tests.golden $(ARGS)

docs: $(READY) ## write the tables of the READMEs anew, from the code and stored figures
	$(BIN)/python -m tests.golden.documents

newest: $(READY) ## the wheel on the newest Python that numba supports (NEWEST=python3.13)
	@command -v $(NEWEST) >/dev/null || \
	  { echo "make: there is no $(NEWEST); name a Python newer than $(PYTHON): make newest NEWEST=python3.13" >&2; exit 2; }
	rm -rf build/newest-env
	$(NEWEST) -m venv build/newest-env
	build/newest-env/bin/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pytest -q tests/end_to_end/test_wheel.py $(ARGS)

lock: ## make requirements.lock anew from pyproject.toml
	rm -rf build/lock-env
	$(PYTHON) -m venv build/lock-env
	build/lock-env/bin/python -m pip install --quiet --disable-pip-version-check 'pip-tools>=7.4'
	build/lock-env/bin/pip-compile --quiet --upgrade --generate-hashes --strip-extras --allow-unsafe \
	  --extra test --extra spice --extra tle --extra dist --no-header --no-annotate --no-emit-index-url --no-emit-trusted-host \
	  --no-emit-find-links --output-file requirements.lock pyproject.toml

clean: ## remove the environment, caches and the demo's output
	rm -rf .venv build dist optnav-demo .pytest_cache .mypy_cache .ruff_cache .hypothesis
	find catalog optnav_cli tests -name __pycache__ -type d -prune -exec rm -rf {} +
