# Two commands on a fresh machine with Python 3.11 or newer: `make demo` and `make test`. Each sets up what it needs.
PYTHON ?= python3
BIN := .venv/bin
DEMO ?= --defense none --defense affine --defense ldp:epsilon=16 --defense ldp --attack dia --attack nearest
DATA ?= ../shared/data

.PHONY: demo test lint bench assets

demo: .venv/ready
	$(BIN)/bench run $(DEMO)

test: .venv/ready-to-test
	$(BIN)/pytest -q

lint: .venv/ready-to-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/ready-to-test # speed, as ratios within one run
	$(BIN)/pytest -q --benchmark-only --benchmark-columns=min,median,rounds --benchmark-sort=name

assets: .venv/ready # hours: rebuilds the dictionaries and networks that are shipped
	$(BIN)/python tools/make_assets.py --data $(DATA) --work work/assets
	$(BIN)/python tools/train_context.py --data $(DATA) --work work/assets

.venv/ready: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e .
	touch $@

.venv/ready-to-test: .venv/ready
	$(BIN)/pip install -q -e '.[test]'
	touch $@
