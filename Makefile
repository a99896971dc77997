# What a newcomer types: `make demo`, then `make test`. PYTHON=python3.12 chooses another interpreter (3.11 or newer).

PYTHON ?= python3
BIN := .venv/bin
EXAMPLE := examples/wind-vane

# A half-made environment or stamp would look finished to the next run.
.DELETE_ON_ERROR:
.DEFAULT_GOAL := help
.PHONY: help demo test docs clean

help:
	@echo "make demo    filter a year of real wind directions; draws $(EXAMPLE)/out/wind-vane.html"
	@echo "make test    linter, type checker and all tests"
	@echo "make docs    the documentation, with every example executed: docs/_build/html/index.html"
	@echo "make clean   remove the environment and everything that was generated"

# The stamps say which extras the environment holds; they are older than pyproject.toml when it must be brought up to date.
.venv/pyvenv.cfg:
	$(PYTHON) -c 'import sys; sys.version_info >= (3, 11) or sys.exit("zakai needs Python 3.11 or newer: make PYTHON=python3.12 ...")'
	$(PYTHON) -m venv .venv

# A module is compiled when it is first imported: to compile all of them takes longer than the rest of the installation.
.venv/.plots: pyproject.toml | .venv/pyvenv.cfg
	$(BIN)/python -m pip install --quiet --no-compile --editable '.[plots]'
	@touch $@

.venv/.dev: pyproject.toml | .venv/pyvenv.cfg
	$(BIN)/python -m pip install --quiet --editable '.[dev]'
	@touch $@

demo: .venv/.plots
	mkdir -p $(EXAMPLE)/out
	$(BIN)/zakai filter $(EXAMPLE)/wind-vane.toml $(EXAMPLE)/observations.csv \
	    -o $(EXAMPLE)/out/wind-vane.nc --report $(EXAMPLE)/out/wind-vane.html
	$(BIN)/python $(EXAMPLE)/picture.py
	@echo "Open $(EXAMPLE)/out/wind-vane.html in a browser; $(EXAMPLE)/out/wind-vane.png shows ten days of it."

# mypy, which takes one core, fills its cache beside the tests; after them it prints what it found.
test: .venv/.dev
	@began=$$(date +%s); \
	$(BIN)/ruff check . && { $(BIN)/mypy src >/dev/null 2>&1 & \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m pytest -q -n auto --dist worksteal; tests=$$?; wait; (exit $$tests); } && \
	$(BIN)/mypy src && \
	echo "make test took $$(( $$(date +%s) - began )) s"

docs: .venv/.dev
	@began=$$(date +%s); rm -rf docs/_build docs/_generated docs/reference/generated; \
	OPENBLAS_NUM_THREADS=1 $(BIN)/python -m sphinx -q -W --keep-going -j 2 -b html docs docs/_build/html && \
	echo "docs/_build/html/index.html; make docs took $$(( $$(date +%s) - began )) s"

clean:
	rm -rf .venv build dist $(EXAMPLE)/out docs/_build docs/_generated docs/reference/generated .pytest_cache .mypy_cache .ruff_cache .jax_cache .hypothesis
	find src tests -name __pycache__ -type d -prune -exec rm -rf {} +
