# make run       install into .venv and pour blood into the aorta and its iliac arteries
# make test      install, lint, type-check, run the tests
# make validation  run the slow proofs too (pytest -m validation)
# make validate  compare the physics with theory (minutes)

PYTHON ?= python3
SCENE ?= aortoiliac
OPTIONS ?=

BIN := .venv/bin
PIP := $(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt
INSTALLED := .venv/.installed
DEVELOPS := .venv/.installed-dev

.PHONY: run test validation validate lint clean
.DEFAULT_GOAL := run

run: $(INSTALLED)
	@mkdir -p recordings
	$(BIN)/vesselflow run $(SCENE) --rrd recordings/$(notdir $(basename $(SCENE))).rrd $(OPTIONS)

test: lint
	$(BIN)/pytest --numprocesses 2 --dist loadfile --durations=25

validation: $(DEVELOPS)
	$(BIN)/pytest -m validation --durations=25

lint: $(DEVELOPS)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

validate: $(INSTALLED)
	$(BIN)/vesselflow validate $(OPTIONS)

$(BIN)/python:
	$(PYTHON) -m venv .venv

# Installed again only when what is asked for has changed.
$(INSTALLED): pyproject.toml constraints.txt | $(BIN)/python
	$(PIP) --editable .
	@touch $@

$(DEVELOPS): pyproject.toml constraints.txt | $(BIN)/python
	# What is imported is compiled then; to compile all of torch takes a minute.
	$(PIP) --no-compile --editable '.[dev]'
	@touch $@ $(INSTALLED)

clean:
	rm -rf .venv .mypy_cache .pytest_cache .ruff_cache build dist recordings
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
