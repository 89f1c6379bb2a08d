# make demo | test | test-cpus | lint | docs | bench | viewer | sample-page. Everything happens in .venv; nothing outside this folder is touched.

PYTHON ?= python3
BIN := .venv/bin
NATIVE := $(shell find CMakeLists.txt native -type f 2>/dev/null)

.PHONY: demo test test-cpus lint docs bench viewer sample-page clean

demo: .venv/installed
	rm -rf demo
	$(BIN)/neeco demo --output demo

test: .venv/installed
	$(BIN)/pytest -n 2 --dist worksteal

# as other processors and Pythons run the suite; an hour
test-cpus: .venv/installed
	tools/test-cpus

docs: .venv/installed
	$(BIN)/zensical build --clean --strict
	@echo "site/index.html"

lint: .venv/installed
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

bench: .venv/installed
	$(BIN)/python benchmarks/raster.py

# The page's rasteriser, which the package carries: needed again where the kernels or native/web change. The toolchain
# (0.4 GB) is no part of the environment.
viewer: build/zig/bin/python
	build/zig/bin/python -m ziglang c++ -target wasm32-wasi -mexec-model=reactor -std=c++17 -O3 -msimd128 -fno-exceptions \
	  -fno-rtti -fno-math-errno -ffinite-math-only -fno-signed-zeros -fno-trapping-math -ffp-contract=off -DNDEBUG -Inative \
	  native/web/viewer.cpp native/web/system.cpp native/rasterize.cpp native/binning.cpp native/memory.cpp \
	  -Wl,--strip-all -Wl,--gc-sections -o src/neeco/viewer/viewer.wasm
	chmod 644 src/neeco/viewer/viewer.wasm

# The documentation's page of the sample, trained and written by this version; an hour. After a change of the page's code
# alone, tools/sample_page.py is enough.
sample-page: .venv/installed
	rm -rf build/liver-mini
	$(BIN)/neeco train samples/liver-mini --output build/liver-mini
	$(BIN)/neeco evaluate build/liver-mini
	$(BIN)/neeco view build/liver-mini --export docs/liver-mini.html --sh 1

build/zig/bin/python:
	$(PYTHON) -m venv build/zig
	build/zig/bin/python -m pip install --quiet --require-hashes --only-binary :all: -r requirements/wasm.txt

.venv/installed: pyproject.toml tools/install $(wildcard requirements/*.txt) $(NATIVE)
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "neeco needs Python 3.11 or newer; try: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv .venv
	tools/install $(BIN)/python --editable
	touch $@

clean:
	rm -rf .venv build demo
