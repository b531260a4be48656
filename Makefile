# make install | demo | test | lint | docs | bench
PYTHON ?= python3
BIN := .venv/bin

.PHONY: install demo test lint docs bench clean

install: .venv/installed

.venv/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv .venv
	$(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt -e ".[bayes,docs,flows,fmu,onnx,render,rocket,scale,dev]"
	touch $@

# The main job: on the real robot if RETWIN_DATA is set, else on an emulated one.
demo: install
	$(BIN)/retwin demo

# A worker per core, one torch thread each: more threads than cores cost several times the time.
test: install
	OMP_NUM_THREADS=1 $(BIN)/pytest -n 2

lint: install
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

# The documentation site, in site/; warnings are errors.
docs: install
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict

bench: install
	$(BIN)/retwin bench
	$(BIN)/python benchmarks/generation.py
	$(BIN)/python benchmarks/training.py
	$(BIN)/python benchmarks/fitting.py
	$(BIN)/python benchmarks/command_space.py
	$(BIN)/python benchmarks/bands.py
	$(BIN)/python benchmarks/inversion.py
	$(BIN)/python benchmarks/updating.py
	$(BIN)/python benchmarks/residual.py
	$(BIN)/python benchmarks/importing.py
	$(BIN)/python benchmarks/twins.py
	$(BIN)/python benchmarks/fmu.py
	$(BIN)/python benchmarks/scale.py
	$(BIN)/python benchmarks/bundle.py

clean:
	rm -rf .venv demo
