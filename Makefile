# Needs Python 3.11 or newer and make, nothing else: every target sets up .venv first where needed.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
READY := $(VENV)/.ready
TOOLS := $(VENV)/.tools-ready
PEERS := .venv-peers
SHIPPED := components/operating/shipped

# One thread per process, also for the tests' own process: spinning OpenMP threads of several
# processes slow each other down a hundredfold.
export OMP_NUM_THREADS ?= 1
export OMP_WAIT_POLICY ?= PASSIVE

# Installed modules are compiled when first imported (see below), which has to be kept.
unexport PYTHONDONTWRITEBYTECODE

# Two processes share the tests (tests/conftest.py says which stay together); the longest start first.
# A process that dies fails the run: started again, it would meet the same test for ever.
TEST_WORKERS ?= 2
PYTEST := $(BIN)/python -m pytest --numprocesses $(TEST_WORKERS) --dist loadscope \
  --no-loadscope-reorder --max-worker-restart 0

.DEFAULT_GOAL := help
.PHONY: help setup benchmark console data shipped-policies test test-fast test-all lint format docs
.PHONY: soak bench peers ui clean

help: ## Show this list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / {printf "  make %-17s %s\n", $$1, $$2}' $(MAKEFILE_LIST)

# Modules are compiled when first imported: to compile every file of every package takes as long
# as unpacking them.
define install
@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
  { echo "Python 3.11 or newer is needed; set PYTHON=/path/to/python3.11."; exit 1; }
$(PYTHON) -m venv $(VENV)
$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-compile \
  --constraint constraints.txt --editable '$(PROJECT)'
@touch $@
endef

# A variable and no argument of `call`, which would be cut at the comma.
$(READY): PROJECT := .
$(READY): pyproject.toml constraints.txt
	$(install)

$(TOOLS): PROJECT := .[dev,export]
$(TOOLS): pyproject.toml constraints.txt
	$(install)
	@touch $(READY)

setup: $(TOOLS) ## Make .venv with all that is needed, also for tests and exports

benchmark: $(READY) ## Run the quick benchmark: four datasets, a table in minutes
	$(BIN)/python -m flows.full_benchmark profile=quick

console: $(READY) ## Turn the proximity while a machine runs, in a browser
	$(BIN)/python -m flows.console

data: $(READY) ## Generate all datasets and export them for Minari
	$(BIN)/python -m flows.generate_data

test: $(TOOLS) ## Run the test suite, as CI does: minutes on two cores
	$(PYTEST) -m 'not exhaustive'

test-fast: $(TOOLS) ## Run the tests that take seconds each, at least one per room
	$(PYTEST) -m 'not slow and not exhaustive'

test-all: $(TOOLS) ## Run the suite and the further cases that CI leaves out
	$(PYTEST)

lint: $(TOOLS) ## Check style, types and the walls between the rooms
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

format: $(TOOLS) ## Put the code into the common format
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# In a store of their own, where the names of the runs mean one thing, and without Ray: the same bytes.
RETRAIN := runner.executor=serial store=mlruns-shipped

shipped-policies: $(READY) ## Train the policies again that the console ships with: minutes
	$(BIN)/python -m flows.full_benchmark profile=quick datasets=[world] algorithms=[bc,lion] \
	  seeds=[0] algorithm.lion.updates=570 algorithm.lion.hidden=[64,64] \
	  algorithm.lion.trajectories=200 model.deterministic_ensemble.epochs=300 \
	  model.behaviour_policy.epochs=200 evaluation.horizon=25 sweep=shipped-world $(RETRAIN)
	$(BIN)/python -m flows.full_benchmark profile=quick datasets=[mediocre-0.2] algorithms=[lion] \
	  seeds=[0] algorithm.lion.updates=300 algorithm.lion.hidden=[64,64] \
	  algorithm.lion.learning_rate=0.001 training.snapshots=4 evaluation.proximity_step=0.1 \
	  evaluation.trajectories=5 sweep=shipped-turbine $(RETRAIN)
	$(BIN)/python -m flows.pack_policy run=lion/world/seed0 to=$(SHIPPED)/world \
	  store=mlruns-shipped overwrite=true
	$(BIN)/python -m flows.pack_policy run=lion/mediocre-0.2/seed0 to=$(SHIPPED)/turbine \
	  store=mlruns-shipped overwrite=true

docs: $(TOOLS) ## Build the pages of docs/ as a site, into site/
	NO_MKDOCS_2_WARNING=1 $(BIN)/python -m mkdocs build --strict

soak: $(TOOLS) ## Kill a small benchmark 50 times at random and compare it with an undisturbed one; SEED=1
	$(BIN)/python -m tests.soak --kills 50 $(if $(SEED),--seed $(SEED))

bench: $(TOOLS) ## Measure every hot path beside its peers, into benchmarks/results/
	$(BIN)/python -m benchmarks.run

$(PEERS)/.ready: benchmarks/peer-constraints.txt
	$(PYTHON) -m venv $(PEERS)
	$(PEERS)/bin/python -m pip install --quiet --disable-pip-version-check \
	  --constraint benchmarks/peer-constraints.txt torch d3rlpy jax optax
	@touch $@

peers: $(PEERS)/.ready ## Install d3rlpy and JAX beside this project, for the speed comparison

ui: $(READY) ## Open the MLflow UI on this project's runs, at http://127.0.0.1:5000
	$(BIN)/python -m flows.ui

clean: ## Remove the environment and caches (never mlruns/)
	rm -rf $(VENV) $(PEERS) build site *.egg-info .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
