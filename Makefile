# Everything from a fresh clone with Python 3.11, make and nothing else prepared.
PYTHON ?= python3
VENV ?= .venv
BIN := $(VENV)/bin
# The constraints hold for build dependencies too, hence also as a variable.
INSTALL := PIP_CONSTRAINT=constraints.txt PIP_DISABLE_PIP_VERSION_CHECK=1 $(BIN)/python -m pip install --quiet -c constraints.txt

.PHONY: help demo serve kernels test check-long lint bench tables accuracy docs clean install install-test install-docs
.DEFAULT_GOAL := help

help:
	@echo "make demo        four runs of HE0435-1223 through the whole system, with a table of biases"
	@echo "make serve       run the service until Ctrl-C"
	@echo "make test        ruff, mypy and the tests: about thirteen minutes on two cores"
	@echo "make check-long  the tests that take hours: full-size drills, 100,000 steps of the queue, 10,000 lenses"
	@echo "make lint        ruff and mypy"
	@echo "make bench       benchmarks: the answer asserted, then the time as a ratio to a peer"
	@echo "make tables      the tables in docs/tables: error, time and memory of the simulation and of the evidence"
	@echo "make accuracy    speed against error of every knob, for all eight systems: half an hour"
	@echo "make docs        the documentation as a site in build/docs; a warning is an error"
	@echo "make clean       remove the virtual environment and caches (not var/, where data lies)"

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "hostlens needs Python 3.11 or newer: make PYTHON=python3.11 ..."; exit 1; }
	@$(PYTHON) -c 'import ensurepip, venv' 2>/dev/null || \
	  { echo "$(PYTHON) cannot make virtual environments: install python3-venv (as root: apt-get install python3-venv)"; exit 1; }
	$(PYTHON) -m venv $(VENV)

$(VENV)/installed: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing hostlens into $(VENV) (a minute or two)"
	$(INSTALL) -e .
	@touch $@

$(VENV)/installed-test: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing hostlens and what its tests need into $(VENV) (a minute or two)"
	$(INSTALL) -e '.[test]'
	@touch $@ $(VENV)/installed

$(VENV)/installed-docs: pyproject.toml constraints.txt | $(BIN)/python
	@echo "installing hostlens and what its documentation needs into $(VENV) (a minute or two)"
	$(INSTALL) -e '.[docs]'
	@touch $@ $(VENV)/installed

install: $(VENV)/installed

install-test: $(VENV)/installed-test

install-docs: $(VENV)/installed-docs

demo: install
	$(BIN)/hostlens demo

# exec: Ctrl-C and signals go to the service, not to a shell in between.
serve: install
	@exec $(BIN)/hostlens serve

lint: install-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# A small run, so that kernels are compiled once and not by each process of the tests for itself.
kernels: install-test
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -c 'from engine import Host, Realization, run; from tests.engine.conftest import QUICK; \
	  run(Realization("HE0435", 1.0, Host(n=2.0, r_eff=0.39, magnitude=21.0), analysis=QUICK))'

# More processes than cores: tests that start services wait for them most of the time. Who runs what is said in
# tests/conftest.py.
test: install-test
	$(MAKE) -j 2 lint kernels
	$(BIN)/python -m pytest -n $$(( $$(nproc) + $$(nproc) / 2 ))

# One at a time: some of them measure.
check-long: install-test
	$(BIN)/python -m pytest -m long

# One thread: a worker has one core, and ratios are only fair so.
bench: install-test
	$(BIN)/python -m benchmarks.peers || echo "peers could not be installed: they are left out"
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.deflection
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.rendering
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.evidence
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.strength

tables: install-test
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.simulation --write docs/tables/simulation.md
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.evidence_growth
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.scenes --write docs/tables/scenes.md
	$(BIN)/hostlens study h0licow-vi --from shipped --output build/study && cp build/study/conclusions.md docs/tables/study.md

accuracy: install-test
	$(BIN)/python -m benchmarks.peers || echo "peers could not be installed: they are left out"
	OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m benchmarks.accuracy_report

docs: install-docs
	OMP_NUM_THREADS=1 OPENBLAS_NUM_THREADS=1 NUMBA_NUM_THREADS=1 $(BIN)/python -m sphinx -q -W --keep-going -b html docs build/docs
	@echo "build/docs/index.html"

clean:
	rm -rf $(VENV) .pytest_cache .mypy_cache .ruff_cache .hypothesis build dist docs/_outside
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
