# Everything works in a clean clone on Debian or Ubuntu with Python 3.11 and make:
#   make land    fly the default scenario and write its report to out/land
#   make test    run the tests
#   make lint    ruff and mypy
#   make bench   simulated seconds per CPU second
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
SETUP := $(VENV)/.setup-done
WORKERS ?= 2

.PHONY: land test lint bench setup system-packages clean

land: setup
	$(BIN)/plumbline land --out out/land

test: setup
	$(BIN)/python -m pytest -n $(WORKERS) --dist worksteal

lint: setup
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: setup
	$(BIN)/python -m benchmarks

setup: $(SETUP)

$(SETUP): pyproject.toml constraints.txt docs/setup.sh
	PYTHON=$(PYTHON) VENV=$(VENV) sh docs/setup.sh
	touch $@

clean:
	rm -rf $(VENV) out
