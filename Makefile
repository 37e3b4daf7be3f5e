# The first verb that needs it creates .venv and installs everything at the versions in constraints.txt.
#
# Interpreter for .venv, 3.11 or newer:
PYTHON ?= python3
# PyTorch goes in first, because on Linux PyPI's wheel brings several GB of CUDA libraries along. Simulation runs on
# the CPU and the tests are run with the CPU wheel; to get that one too, name its index:
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make install
# or name another build: make install TORCH='torch==2.13.0+cu130' (with its index, as above).
TORCH ?= torch==2.13.0
# Overrides for `make train`, for example: make train ARGS='task=push_box seed=1'; options of pytest for `make test`
ARGS ?=

VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed

.DEFAULT_GOAL := help
.PHONY: help install format lint test docs train clean

help: ## list the verbs
	@sed -n 's/^\([a-z]*\):.*## /\1\t/p' $(MAKEFILE_LIST) | expand -t 10

install: $(STAMP) ## create .venv and install the package with its tools

# newer than its prerequisites only when an installation went through to the end
$(STAMP): pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install -c constraints.txt '$(TORCH)'
	$(BIN)/python -m pip install -c constraints.txt -e '.[dev,docs,retarget,viewer,gpu,ray,cluster,deploy,robot]'
	touch $@

format: $(STAMP) ## format the code and fix what ruff can fix
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

lint: $(STAMP) ## check style, formatting and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

test: $(STAMP) ## run the tests; HDMI_MOTIONS=FOLDER adds those on the public motions, ARGS='-m slow' runs the slow ones
	$(BIN)/python -m pytest -n 2 --dist loadgroup $(ARGS)

docs: $(STAMP) ## build the documentation into build/docs
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

train: $(STAMP) ## train with the default configuration; ARGS='key=value ...' overrides it
	$(BIN)/python train.py $(ARGS)

clean: ## remove .venv, caches and build outputs; keeps outputs/ and runs/
	rm -rf $(VENV) build dist *.egg-info .pytest_cache .ruff_cache .mypy_cache .hypothesis MUJOCO_LOG.TXT
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
