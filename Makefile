# The commands: `make demo`, `make test`, `make docs`. They build .venv from the lock when it is missing.
PYTHON ?= python3
BIN := .venv/bin
READY := .venv/.ready
# Processes that run the tests. A file's tests stay together, so that few kernels are compiled twice.
WORKERS ?= 2

.PHONY: demo test docs lint format bench evidence portability lock clean

demo: $(READY)  ## train a small policy on Amplitude-v0 and compare it with the reference policies
	rm -rf runs/demo
	$(BIN)/python train.py --steps 1500000 --output runs/demo

test: $(READY)  ## all tests but the slow evidence, in WORKERS processes
	$(BIN)/python -m pytest -m "not slow" -n $(WORKERS) --dist loadfile --no-loadscope-reorder

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

lint: $(READY)  ## style, format and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

format: $(READY)
	$(BIN)/ruff check --fix .
	$(BIN)/ruff format .

$(READY): requirements.lock pyproject.toml
	$(PYTHON) -m venv .venv
	$(BIN)/python -m pip install --quiet --requirement requirements.lock
	$(BIN)/python -m pip install --quiet --no-deps --no-build-isolation --editable .
	touch $(READY)

lock: $(READY)  ## write the versions that are installed now into the lock, keeping its head
	{ grep '^#' requirements.lock; $(BIN)/pip freeze --exclude-editable | sed 's/+cpu$$//'; } > requirements.lock.tmp
	mv requirements.lock.tmp requirements.lock

clean:
	rm -rf .venv build dist
