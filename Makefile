PYTHON ?= python3
VENV ?= .venv
BIN = $(VENV)/bin

.PHONY: help demo test lint regression docs gallery dist clean
.DEFAULT_GOAL := help

help:  ## list the targets
	@sed -n 's/^\([a-z]*\):.*## /  make \1\t/p' $(MAKEFILE_LIST)
	@echo "  PYTHON=$(PYTHON) (3.11 or newer) and VENV=$(VENV) can be set on the command line"

demo: $(VENV)/.installed-demo  ## denoise a small surface: picture and mesh in demo_out/
	$(BIN)/beltrami demo demo_out --from sample_data/torus --overwrite

test: $(VENV)/.installed-dev  ## run the tests, in as many processes as there are cores
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal

lint: $(VENV)/.installed-dev  ## check format, style, types and the import contracts
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/lint-imports

# What docs/ci.md recommends, on this project itself: synthetic volumes, a matrix of jobs, stored results, tolerances.
# Tolerances: 0.002 of 255 grey levels (another CPU's order of sums gives 0.00006), and 29 dB to the truth.
SYNTHETIC = configs/data/regression
RESULTS = configs/output/regression
regression: $(VENV)/.installed-dev  ## denoise synthetic volumes and compare with stored results
	$(BIN)/beltrami phantom torus $(SYNTHETIC)/torus --size 24 --noise 20 --seed 1 --overwrite --quiet
	$(BIN)/beltrami phantom sulcus $(SYNTHETIC)/sulcus --size 24 --noise 20 --seed 1 --overwrite --quiet
	$(BIN)/beltrami batch configs/regression.toml --jobs 2
	$(BIN)/beltrami compare tests/golden/regression $(RESULTS) --max-abs 0.002 --max-missing 0
	$(BIN)/beltrami compare $(SYNTHETIC)/torus/clean.nii.gz $(RESULTS)/torus_symmetric_beta0.5.nii.gz \
		--levelset $(SYNTHETIC)/torus/levelset.nii.gz --data-range 255 --min-psnr 29

docs: $(VENV)/.installed-docs  ## build the documentation into docs/_build/html; a warning is an error
	$(BIN)/python -m sphinx -W --keep-going -q -b html docs docs/_build/html

gallery: $(VENV)/.installed-demo  ## make the pictures of docs/gallery.md anew
	$(BIN)/python .ci/gallery.py

dist: $(VENV)/.installed-dev  ## build sdist and wheel, and check them in a fresh environment
	rm -rf dist
	$(BIN)/python -m build --outdir dist .
	$(BIN)/python -m twine check --strict dist/*
	$(BIN)/python .ci/check_dist.py dist

clean:  ## remove the virtual environment, caches and what the demo wrote
	rm -rf $(VENV) build dist demo_out docs/_build .pytest_cache .mypy_cache .ruff_cache .hypothesis .import_linter_cache *.egg-info
	find . -name __pycache__ -type d -prune -exec rm -rf {} +

$(BIN)/python:
	@$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11))' || \
		{ echo "make: $(PYTHON) is older than Python 3.11; name a newer one: make PYTHON=python3.12" >&2; exit 1; }
	@echo "setting up $(VENV): the first time takes a minute or two"
	@$(PYTHON) -m venv $(VENV)

$(VENV)/.installed-demo: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[report]'
	@touch $@

$(VENV)/.installed-docs: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[docs]'
	@touch $@

$(VENV)/.installed-dev: pyproject.toml | $(BIN)/python
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --editable '.[report,docs,dev]'
	@touch $@
