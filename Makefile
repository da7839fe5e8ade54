# The commands: `make demo`, `make test`, `make docs`. They build .venv from the lock when it is missing.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Processes that run the tests. A file's tests stay together, so that few kernels are compiled twice.
WORKERS ?= 2

.PHONY: demo test test-research docs lint format bench evidence portability compat lock clean

demo: $(READY)  ## train a policy on Amplitude-v0 and compare it with the reference policies
	rm -rf runs/demo
	$(BIN)/python train.py --steps 2000000 --eval-every 500000 --output runs/demo

PYTEST = $(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile --no-loadscope-reorder

test: $(READY)  ## the tests of the packages but the slow evidence, in WORKERS processes
	$(PYTEST) --ignore=tests/research

test-research: $(READY)  ## the tests of studies, the oracles' search, certificates and benchmarks
	$(PYTEST) tests/research

docs: $(READY)  ## the manual, into build/manual; a warning is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --config-file docs/manual/mkdocs.yml
	@echo "The manual is in build/manual: open index.html, or see it with its search at localhost:8000 after"
	@echo "  $(BIN)/python -m http.server --directory build/manual"

evidence: $(READY)  ## the slow evidence: coverage tables, trainings, times
	$(BIN)/python -m pytest -m slow -s

portability: $(READY)  ## the tests that compute, under several instruction sets; about half an hour
	$(BIN)/python -m benchmarks.portability --workers $(WORKERS)

bench: $(READY)  ## timed comparisons, with peers in .venv-peers; about 15 minutes
	$(BIN)/python -m benchmarks --json runs/benchmarks/results.json

# The newest Gymnasium lies beside the one that RLlib asks for.
compat: $(READY)  ## what other RL libraries make of the environments, in .venv-compat; a quarter of an hour
	$(BIN)/python -m venv .venv-compat
	.venv-compat/bin/python -m pip install --quiet --requirement benchmarks/compat.lock
	.venv-compat/bin/python -m pip install --quiet --no-deps --editable .
	.venv-compat/bin/python -m pip install --quiet --no-deps --upgrade --target .venv-compat/newest gymnasium==1.4.0
	.venv-compat/bin/python -m benchmarks.compat
	.venv-compat/bin/python -m pytest tests/test_examples.py tests/agents/test_multi_seed_training.py
	.venv-compat/bin/python -m benchmarks.ray_node_kill
	PYTHONPATH=.venv-compat/newest .venv-compat/bin/python -m benchmarks.compat

lint: $(READY)  ## style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

# The Python versions are those of the classifiers in pyproject.toml.
VERSIONS := $(shell sed -n 's/.*"Programming Language :: Python :: \(3\.[0-9]*\)".*/\1/p' pyproject.toml)
WORKS := duffing-env works with Python $(firstword $(VERSIONS)) to $(lastword $(VERSIONS))
VERSION = $(shell $(PYTHON) -c 'import sys; print("%d.%d" % sys.version_info[:2])' 2>/dev/null)
$(info $(WORKS).)

LOCKED := .venv/.locked
# Where PYTHON is named, and .venv has another version, .venv is built anew.
ifneq ($(origin PYTHON),file)
ifneq ($(VERSION),$(shell cat $(LOCKED) 2>/dev/null))
.PHONY: $(LOCKED)
endif
endif

# From nothing, so that what has left the lock leaves .venv too.
$(LOCKED): requirements.lock
	$(if $(filter $(VERSION),$(VERSIONS)),,$(error $(WORKS); $(PYTHON) is $(or \
		$(addprefix Python ,$(VERSION)),not to be found). Name another: make PYTHON=python$(lastword $(VERSIONS))))
	$(PYTHON) -m venv --clear .venv
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	echo $(VERSION) > $(LOCKED)

$(READY): $(LOCKED) pyproject.toml
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $(READY)

lock: $(LOCKED)  ## write the versions that are installed now into the lock, keeping its head
	grep '^#' requirements.lock > requirements.lock.tmp
	$(BIN)/pip freeze --all --exclude pip --exclude-editable >> requirements.lock.tmp
	sed -E '/^(cuda|nvidia|triton)/d; s/\+cpu$$//' requirements.lock.tmp > requirements.lock
	rm requirements.lock.tmp

.PHONY: lock-check
lock-check: $(READY)  ## every line of the lock has a binary file for every Python version
	$(BIN)/python .ci/check_lock.py $(VERSIONS)

.PHONY: fuzz soak kills release licences
INPUTS ?= 50000
fuzz: $(READY)  ## bad inputs by the thousand; fails where one is not refused clearly
	$(BIN)/python -m benchmarks.fuzz --inputs $(INPUTS)

soak: $(READY)  ## long runs on every track
	$(BIN)/python -m benchmarks.soak_test --steps 10000000

kills: $(READY)  ## commands killed at random moments, and started again; a quarter of an hour
	$(BIN)/python -m benchmarks.kills

release: $(READY)  ## wheel and sdist into dist, built twice and compared; the wheel tried in a clean environment
	$(BIN)/python .ci/release.py
	$(BIN)/python -m pytest -m slow -s tests/test_wheel.py

licences: $(READY)  ## of every installed package
	$(BIN)/python .ci/licences.py

clean:
	rm -rf .venv build dist
