# make demo   install into .venv and run the main job: a scene becomes a film, a plot and a recording in out/
# make test   install what tests need and run them
# make bench NAME=film   run tests/bench/film.py
# make lint   ruff, mypy, import order

VENV ?= .venv
BIN := $(VENV)/bin
SCENE ?= models/scenes/waving_arm.toml
PROCESSES ?= 2
# setuptools warns of every editable install that a folder of the package's name would hide it
PIP = PYTHONWARNINGS="ignore:Editable installation" $(BIN)/python -m pip install --quiet

.PHONY: demo test lint bench system
.DEFAULT_GOAL := demo

system:
	@sh .ci/system-libraries

$(BIN)/python:
	@sh .ci/make-venv $(VENV)

$(VENV)/.installed: pyproject.toml .ci/constraints.txt | $(BIN)/python
	$(PIP) --upgrade "pip>=25.1"
	$(PIP) --constraint .ci/constraints.txt --editable .
	@touch $@

$(VENV)/.tools: $(VENV)/.installed
	$(PIP) --constraint .ci/constraints.txt --editable ".[torch,parquet]" --group test
	@mkdir -p .types && ln -sfn .. .types/pantograph
	@touch $@

demo: system $(VENV)/.installed
	$(BIN)/pantograph run $(SCENE) --error --film demo.mp4 --plot demo.png --out out

lint: $(VENV)/.tools
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

test: system lint
	$(BIN)/python -m pytest -q -n $(PROCESSES) --dist loadfile

bench: system $(VENV)/.tools
	$(BIN)/python tests/bench/$(NAME).py
