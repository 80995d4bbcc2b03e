# palpate: `make demo` and `make test` each need nothing but Python 3.11+ on a fresh clone.
# The environment in .venv is made anew when pyproject.toml or constraints.txt change.

PYTHON ?= python3
VENV   := .venv
BIN    := $(VENV)/bin
KEY    := $(shell cat pyproject.toml constraints.txt | sha256sum | cut -c1-16)
READY  := $(VENV)/.ready-$(KEY)
DEV    := $(VENV)/.dev-$(KEY)
OUT    ?= runs/demo
# Spinning threads make two busy cores several times slower than one.
export OMP_WAIT_POLICY := passive

.PHONY: help demo test test-fast test-slow lint format wheel lock clean

help:            ## this list
	@grep -E '^[a-z-]+: .*##' $(MAKEFILE_LIST) | sed -E 's/:[^#]*##/\t/' | expand -t 14

demo: $(READY)   ## the whole pipeline on the embedded world; DATA=path runs it on a Touch and Go tree
	$(BIN)/palpate demo --out $(OUT) $(if $(DATA),--data $(DATA))

test: test-fast test-slow  ## all tests, fast ones first

test-fast: $(DEV)  ## tests of under about five seconds each
	OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1 $(BIN)/python -m pytest -q -m "not slow and not browser"

test-slow: $(DEV)  ## the slow ones, and the page in a browser
	OMP_NUM_THREADS=1 HF_HUB_OFFLINE=1 $(BIN)/python -m pytest -q -m "slow or browser"

lint: $(DEV)     ## style, types, and the one-way house
	$(BIN)/ruff format --check .
	$(BIN)/ruff check .
	$(BIN)/lint-imports
	$(BIN)/basedpyright

format: $(DEV)   ## rewrite the sources in the house style
	$(BIN)/ruff format .
	$(BIN)/ruff check --fix .

wheel: $(DEV)    ## build the wheel and try it alone in empty environments
	PYTHON=$(PYTHON) .ci/wheel $(BIN)/python

lock:            ## write constraints.txt from a fresh environment
	PYTHON=$(PYTHON) .ci/lock

clean:           ## remove the environment and everything generated
	rm -rf $(VENV) build dist runs artifacts .pytest_cache .ruff_cache .hypothesis .import_linter_cache

# torch goes in first and alone: with a version in place, nothing that depends on it brings another build.
$(READY):
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || { echo "palpate needs Python 3.11 or newer; got $$($(PYTHON) --version). Try: make PYTHON=python3.12"; exit 2; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check $$(grep '^torch==' constraints.txt)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[video,torch]"
	touch $@

$(DEV): $(READY)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[all,dev]"
	touch $@
