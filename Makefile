# make demo | test | lint | bench. Everything happens in .venv; nothing outside this folder is touched.

PYTHON ?= python3
BIN := .venv/bin
NATIVE := $(shell find CMakeLists.txt native -type f 2>/dev/null)

.PHONY: demo test lint bench clean

demo: .venv/installed
	rm -rf demo
	$(BIN)/neeco demo --output demo

test: .venv/installed
	$(BIN)/pytest -n 2

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed
	$(BIN)/python benchmarks/raster.py

# torch first: whatever needs it then finds the pinned one
.venv/installed: pyproject.toml constraints.txt $(NATIVE)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "neeco needs Python 3.11 or newer; try: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet -c constraints.txt torch
	$(BIN)/python -m pip install --quiet -c constraints.txt -e '.[dev]'
	touch $@

clean:
	rm -rf .venv build demo
