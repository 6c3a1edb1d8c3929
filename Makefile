# Everything runs in .venv, which `make install` makes. PYTHON=/path/to/python chooses the interpreter it is made with.
PYTHON ?=
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/.installed
NEW_ENOUGH := -c 'import sys; sys.exit(sys.version_info < (3, 11))'

# What `make quick` tests: files in which nothing fits a model, trains a network or starts a service.
QUICK := tests/test_layers.py \
	tests/test_guides.py \
	tests/firmware_iface/test_dlpc900.py \
	tests/firmware_iface/test_panel_board.py \
	tests/firmware_iface/test_virtual_description.py \
	tests/runtime/test_bundle.py \
	tests/runtime/test_files.py \
	tests/runtime/test_lightpath.py \
	tests/runtime/test_propagation.py \
	tests/runtime/test_solver.py \
	tests/runtime/test_targets.py \
	tests/trainer/test_captures.py \
	tests/trainer/test_check.py \
	tests/trainer/test_conventions.py \
	tests/trainer/test_fleet_drift.py \
	tests/trainer/test_kept_pictures.py \
	tests/trainer/test_model_file.py \
	tests/trainer/test_model_text.py \
	tests/trainer/test_verdict.py

.PHONY: help install quick test demo benchmark clean

help:
	@echo "make install     make .venv and install hololoop in it, with exactly the versions of constraints.txt"
	@echo "make quick       check the style and the types, run the tests that take about a minute"
	@echo "make test        check the style and the types, run all tests"
	@echo "make demo        the whole loop on a virtual bench"
	@echo "make benchmark   measure how fast the trainer is on this machine (hololoop-runtime benchmark: the solver)"
	@echo "make clean       remove caches and build products (.venv stays; rm -r .venv removes it)"

install: $(STAMP)

$(STAMP): pyproject.toml constraints.txt
	@set -e; \
	if [ ! -x $(BIN)/python ]; then \
	    found=; \
	    for python in $(if $(PYTHON),"$(PYTHON)",python3 python3.14 python3.13 python3.12 python3.11); do \
	        if "$$python" $(NEW_ENOUGH) 2>/dev/null; then found=$$python; break; fi; \
	    done; \
	    if [ -z "$$found" ]; then \
	        echo "hololoop needs Python 3.11 or newer; $(or $(PYTHON),python3) is" \
	             "$$("$(or $(PYTHON),python3)" --version 2>&1 | tail -n 1)." \
	             "Install a newer one and say: make install PYTHON=/path/to/python3.11" >&2; \
	        exit 1; \
	    fi; \
	    "$$found" -m venv $(VENV); \
	elif ! $(BIN)/python $(NEW_ENOUGH) 2>/dev/null; then \
	    echo "$(VENV) does not hold a working Python 3.11 or newer: rm -r $(VENV), then make install" >&2; \
	    exit 1; \
	fi
	$(BIN)/python -m pip install -c constraints.txt torch==2.13.0
	$(BIN)/python -m pip install -c constraints.txt -e '.[trainer,studio,completion,cluster,camera,dev]'
	@touch $@

quick: install
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest --deselect tests/test_guides.py::test_what_a_guide_shows_works $(QUICK)

test: install
	$(BIN)/ruff check .
	$(BIN)/mypy
	$(BIN)/python -m pytest

demo: install
	$(BIN)/hololoop-trainer demo

benchmark: install
	$(BIN)/python -m pytest tests/benchmarks -n 0

clean:
	rm -rf build dist *.egg-info .pytest_cache .hypothesis .mypy_cache .ruff_cache
	find trainer runtime firmware_iface tests -name __pycache__ -type d -prune -exec rm -rf {} +
