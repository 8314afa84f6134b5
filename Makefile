# `make train` sets everything up and trains an agent; `make test` sets everything up and passes the tests.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
CHECKED := src tests benchmarks

.PHONY: train test slow lint format types docs coverage bench clean

# One stamp a set of requirements, so that a second call installs nothing.
$(VENV)/.installed: pyproject.toml constraints.txt
	test -x $(BIN)/python || $(PYTHON) -m venv $(VENV)
	$(BIN)/python -m pip install --quiet --upgrade pip
	$(BIN)/python -m pip install --quiet -c constraints.txt -e .
	touch $@

$(VENV)/.installed-dev: $(VENV)/.installed
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev,docs,render,mujoco,box2d,minari,tensorboard,onnx,export,atari,web]'
	touch $@

train: $(VENV)/.installed
	$(BIN)/rtg train ppo CartPole-v1

test: $(VENV)/.installed-dev
	$(BIN)/python -m pytest -m "not slow" -n 2 -q

slow: $(VENV)/.installed-dev
	$(BIN)/python tests/coverage_report.py --slow

lint: $(VENV)/.installed-dev
	$(BIN)/ruff check $(CHECKED)
	$(BIN)/ruff format --check $(CHECKED)

format: $(VENV)/.installed-dev
	$(BIN)/ruff check --fix $(CHECKED)
	$(BIN)/ruff format $(CHECKED)

types: $(VENV)/.installed-dev
	$(BIN)/pyright

docs: $(VENV)/.installed-dev
	$(BIN)/mkdocs build --strict --quiet

coverage: $(VENV)/.installed-dev
	$(BIN)/python tests/coverage_report.py

bench: $(VENV)/.installed
	$(BIN)/python benchmarks/bench.py

clean:
	rm -rf $(VENV) .venv-* build dist site .pytest_cache .ruff_cache
