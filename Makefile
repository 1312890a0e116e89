# Everything that a fresh machine needs is installed by the first target that needs it, into .venv: Python 3.11 to 3.13.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
RUN ?= runs/demo-$(shell date -u +%Y%m%d-%H%M%S)

.PHONY: demo test explore check lint proto docs clean

# The main job: three UAV processes, the TMC and the learner on downtown Toronto; then the policy against the baselines.
demo: $(VENV)/.run
	$(BIN)/overfly run quick --out $(RUN)
	$(BIN)/overfly evaluate $(RUN) planner:greedy planner:random-road planner:random --seeds 5

test: $(VENV)/.dev $(VENV)/.readers
	$(BIN)/python -m pytest -n 2 --dist worksteal

# The properties with new random examples. A failure names the example: make it a test of its own.
explore: $(VENV)/.dev
	$(BIN)/python -m pytest -n 2 --dist worksteal -m hypothesis --hypothesis-profile explore

lint: $(VENV)/.dev
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# The site, in build/docs: the pages that follow from the code are written first; a warning or a broken link is an error.
docs: $(VENV)/.docs
	$(BIN)/python docs/generate.py
	$(BIN)/python -m sphinx -q -W --keep-going -d build/doctrees docs build/docs

check: lint docs test

# The protobuf classes, after a change of a .proto file. An install generates them as well.
proto: $(VENV)/.dev
	$(BIN)/python hatch_build.py

$(VENV)/bin/pip:
	$(PYTHON) -m venv $(VENV)

# The constraints pin what we develop with; pyproject.toml keeps the ranges that users need. torch goes first, so that no
# later resolution can choose another build of it.
$(VENV)/.run: pyproject.toml constraints.txt hatch_build.py tmc/record/overfly.proto | $(VENV)/bin/pip
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt torch
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[all]"
	@touch $@

$(VENV)/.dev: $(VENV)/.run
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[dev]"
	@touch $@

$(VENV)/.docs: $(VENV)/.run
	$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[docs]"
	@touch $@

# What others read our logs with, for tests/readers. What cannot be had here is left out: its tests skip, and say why.
$(VENV)/.readers: pyproject.toml constraints.txt tests/readers/package-lock.json | $(VENV)/.dev
	-$(BIN)/pip install -q --disable-pip-version-check -c constraints.txt -e ".[readers]"
	-npm ci --prefix tests/readers --ignore-scripts --no-audit --no-fund
	@touch $@

clean:
	rm -rf $(VENV) build dist tests/readers/node_modules
