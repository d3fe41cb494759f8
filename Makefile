# Works on a fresh machine with make and Python 3.11 or newer:
#   make demo    make an asset from the clip that comes with the package
#   make test    the checks of a newcomer: lint, import contracts, unit tests, one whole asset
#   make check   types, and every test: assets, packages of others and physics at full resolution as well
# Another interpreter: make demo PYTHON=python3.12; tests in another number of processes: make test WORKERS=4

PYTHON ?= python3
VENV ?= .venv
OUT ?= demo.fluid
WORKERS ?= 2
BIN := $(VENV)/bin
PIP := $(BIN)/python -m pip install --disable-pip-version-check -c constraints.txt

.PHONY: help demo test check lint style compiled format clean

help:
	@echo "make demo    make an asset from the clip that comes with the package, in $(OUT)"
	@echo "make test    lint, import contracts, unit tests, one whole asset"
	@echo "make check   lint, import contracts, types and all tests"
	@echo "make lint    lint, types and import contracts only"
	@echo "make format  let ruff put the source in order"
	@echo "make clean   remove the environment, caches and the demo asset"

# Exit code 4 of fluidlift means: done, with warnings.
demo: $(VENV)/.core
	@$(BIN)/fluidlift demo --out $(OUT) || [ $$? -eq 4 ]
	@echo "watch $(OUT)/preview.mp4, then open $(OUT)/report.html"

PYTEST := $(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

# Without types: the checker takes two minutes of processor time.
test: style compiled
	$(PYTEST) -m "unit or whole"

check: lint compiled
	$(PYTEST)

# Once, instead of in every process of the tests that calls them first.
compiled: $(VENV)/.dev
	@$(BIN)/fluidlift doctor --compile >/dev/null

lint: style
	$(BIN)/pyright

style: $(VENV)/.dev
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/lint-imports

format: $(VENV)/.dev
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# Stamps: an installation is repeated only when what it depends on has changed.
$(VENV)/.made:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' \
	  || { echo "Python 3.11 or newer is needed, for example: make $(MAKECMDGOALS) PYTHON=python3.12"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	@touch $@

$(VENV)/.core: $(VENV)/.made pyproject.toml constraints.txt
	$(PIP) --quiet -e .
	@touch $@

$(VENV)/.dev: $(VENV)/.made pyproject.toml constraints.txt
	$(PIP) --quiet -e '.[dev]'
	@touch $(VENV)/.core $@

clean:
	rm -rf $(VENV) demo.fluid build dist src/*.egg-info .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find src tests benchmarks -name __pycache__ -type d -prune -exec rm -rf {} +
