# palpate: `make demo` and `make test` each need nothing but Python 3.11+ on a fresh clone.
# The environment in .venv is made anew when pyproject.toml or constraints.txt change.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
KEY    := $(shell cat pyproject.toml constraints.txt | sha256sum | cut -c1-16)
READY  := $(VENV)/.ready-$(KEY)
DEV    := $(VENV)/.dev-$(KEY)
OUT    ?= runs/demo
RUN    ?= runs/study
# Processes that run tests; each uses one thread.
WORKERS ?= auto
PYTEST = OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1 $(BIN)/python -m pytest -q -n $(WORKERS) --dist worksteal
PIP    = $(BIN)/python -m pip install --quiet --disable-pip-version-check
# Spinning threads make two busy cores several times slower than one.
export OMP_WAIT_POLICY := passive
# Compiled modules are kept: each test that starts a process would compile them again.
export PYTHONDONTWRITEBYTECODE :=

.PHONY: help demo record test test-fast nightly coverage lint format docs examples wheel release-check lock clean

help:            ## list the targets
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/' | expand -t 14

demo: $(READY)   ## the whole pipeline on the embedded world; DATA=path runs it on a Touch and Go tree
	$(BIN)/palpate demo --output $(OUT) $(if $(DATA),--data $(DATA))

record:          ## RUN=runs/study: pack results, page, tables and figures of a run into dist/, for a release
	mkdir -p dist
	tar -czf dist/record-$(notdir $(RUN:/=)).tar.gz -C $(RUN) results.json page.html page.md tables.tex figures

test: $(DEV)     ## all tests but nightly ones, fast ones first
	$(PYTEST) -m "not nightly"

test-fast: $(DEV)  ## tests of under about five seconds each
	$(PYTEST) -m "not slow and not browser and not nightly"

nightly: $(DEV)  ## what takes longer: tests of minutes, what must not change, the metrics at full size, the shipped models scored again, the study of splits, small, 50 raters in browsers
	$(PYTEST) -m nightly
	$(BIN)/python benchmarks/frozen.py --compare
	$(BIN)/python benchmarks/metrics.py
	$(BIN)/python recipes/mini.py --work runs/mini --verify
	$(BIN)/python benchmarks/split_drop.py --small
	$(BIN)/python benchmarks/preference_load.py
	$(BIN)/python benchmarks/preference_study.py
	PALPATE_RATERS=50 $(BIN)/python -m pytest -q tests/test_preference_raters.py

coverage: $(DEV)  ## line and branch coverage of the fast tests
	$(PYTEST) -m "not slow and not browser and not nightly" --cov --cov-report=term --cov-report=xml

lint: $(DEV)     ## style, types, the direction of imports, and the size of the house
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/basedpyright
	$(BIN)/python .ci/budget.py

format: $(DEV)   ## rewrite the sources in the project's style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

docs: $(DEV)     ## the docs site in site/, with what commands print now; a broken link fails
	$(BIN)/python recipes/reference_pages.py
	$(BIN)/python recipes/printed.py
	$(BIN)/zensical build --clean --strict

examples: $(DEV)  ## run the notebooks in examples/ and write their pages
	$(BIN)/python recipes/notebooks.py

wheel: $(DEV)    ## build the wheel and try it alone in empty environments
	PYTHON=$(PYTHON) .ci/wheel $(BIN)/python

release-check: $(DEV)  ## build sdist and wheel twice, compare, check metadata, try the wheel alone; BASE=1 leaves out the extras
	.ci/release $(BIN)/python $(if $(BASE),base)

lock:            ## write constraints.txt from a fresh environment
	PYTHON=$(PYTHON) .ci/lock

clean:           ## remove the environment and everything generated
	rm -rf $(VENV) build dist runs artifacts site .cache .coverage coverage.xml .pytest_cache .ruff_cache .hypothesis .import_linter_cache

# torch goes in first and alone: with a version in place, nothing that depends on it brings another build.
$(READY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "palpate needs Python 3.11 or newer; got $$($(PYTHON) --version). Try: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv --clear $(VENV)
	$(PIP) $$(grep '^torch==' constraints.txt)
	$(PIP) -c constraints.txt -e ".[video,torch]"
	touch $@

$(DEV): $(READY)
	$(PIP) -c constraints.txt -e ".[all,dev]"
	touch $@
