# make install | demo | test | test-all | test-long | coverage | lint | docs | bench | package
PYTHON ?= python3
BIN := .venv/bin
EXTRAS := bayes,docs,fetch,flows,fmu,logs,monitor,onnx,parquet,postgres,render,rocket,scale,dev
# One torch thread per test process: more threads than cores cost several times the time.
PYTEST := OMP_NUM_THREADS=1 $(BIN)/pytest -n 2

.PHONY: install demo test test-all test-long coverage lint docs bench package clean

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[$(EXTRAS)]"
	touch $@

# The main job: on the real robot if RETWIN_DATA is set, else on an emulated one.
demo: install
	$(BIN)/retwin demo

# The fast tier: every room, in minutes.
test: install
	$(PYTEST) -m "not slow and not long"

# What `make test` leaves out: whole studies, fits, documentation, browser and long chains.
test-all: install
	$(PYTEST) -m "slow and not long"

# Before a release: thousands of mutated files, hundreds of kills, the arithmetic of other
# processors, and one and two threads. Threads that wait passively leave the cores to others:
# actively, on two busy cores, they take six times the processor time.
test-long: install
	$(PYTEST) -m long
	ATEN_CPU_CAPABILITY=default OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m "numerical and not long"
	ATEN_CPU_CAPABILITY=avx2 OMP_NUM_THREADS=1 $(BIN)/pytest -n 2 -m "numerical and not long"
	OMP_NUM_THREADS=2 OMP_WAIT_POLICY=passive $(BIN)/pytest -n 1 -m "numerical and not long"

coverage: install
	$(PYTEST) -m "not slow and not long" --cov=retwin --cov-report=term:skip-covered --cov-report=html

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation site, in site/; warnings are errors.
docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: install
	for name in generation training fitting command_space bands inversion updating residual \
		importing twins fmu state_twin scale bundle parameter_coverage; do $(BIN)/python benchmarks/$$name.py || exit 1; done
	if [ -n "$$RETWIN_DATA" ]; then OMP_NUM_THREADS=1 $(BIN)/python benchmarks/systems.py; fi

# Wheel and source distribution in dist/. The wheel, with its mandatory dependencies alone, runs the
# demo in an empty environment; the source distribution, with all extras, passes the fast tests.
package: install
	rm -rf dist .package
	$(BIN)/python -m build --outdir dist
	$(PYTHON) -m venv .package
	.package/bin/pip install --quiet --disable-pip-version-check -c constraints.txt dist/*.whl
	cd .package && bin/retwin doctor && env -u RETWIN_DATA bin/retwin demo --out demo
	.package/bin/pip install --quiet --disable-pip-version-check -c constraints.txt \
		--force-reinstall --no-deps dist/*.tar.gz
	.package/bin/pip install --quiet --disable-pip-version-check -c constraints.txt \
		"retwin[$(EXTRAS)]"
	OMP_NUM_THREADS=1 .package/bin/python -m pytest -n 2 -m "not slow and not long" -p no:cacheprovider

clean:
	rm -rf .venv .package demo dist site
