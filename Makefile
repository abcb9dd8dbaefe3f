# Two commands do all set-up: `make run` and `make test`. The environment is made once, in .venv,
# from requirements.lock alone; PYTHON=python3.12 picks another interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
FLOORS := backplane levels boards tools configs
CONFIG ?= nasrem
# Where it is set, each start would compile all our modules anew, and pytest all tests.
unexport PYTHONDONTWRITEBYTECODE
# Set, tests try all values of which they take samples otherwise.
ifdef EXHAUSTIVE
export EXHAUSTIVE
endif
.DEFAULT_GOAL := help
.PHONY: help run test thorough quick mutants golden reference lint docs dist lock clean

help: ## show this
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/' | expand -t 16

run: $(STAMP) ## run the rack CONFIG (default: nasrem); ARGS="--lockstep" and the like are passed on
	$(BIN)/rack run $(CONFIG) $(ARGS)

test: $(STAMP) ## run the tests, about five minutes; ARGS="-k segment" and the like are passed on
	$(BIN)/python -m pytest -m "not thorough" $(ARGS)

thorough: $(STAMP) ## run the tests that `make test` leaves out: whole tasks, all examples, the lab; ARGS as above; EXHAUSTIVE=1 leaves no samples
	$(BIN)/python -m pytest -m thorough $(ARGS)

quick: $(STAMP) ## run the quick tests, under a minute: those not marked slow, alone or thorough, of every room; ARGS as above
	$(BIN)/python -m pytest -m "not slow and not alone and not thorough" $(ARGS)

mutants: $(STAMP) ## check that a campaign notices when a detector is switched off
	$(BIN)/python -m tests.mutants

golden: $(STAMP) ## write digests and snapshots anew, after a change of what racks do
	$(BIN)/python -m tests.golden
	WRITE_SNAPSHOTS=1 $(BIN)/python -m pytest -q -n0 $$(git ls-files 'tests/*test_*.toml' | sed 's/toml$$/py/')

reference: $(STAMP) ## write configs/REFERENCE.md anew, after a change of what a config may hold
	$(BIN)/python -m tests.reference

lint: $(STAMP) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

docs: $(STAMP) ## build the pages as a site in dist/site, without a network; a broken link is an error
	NO_MKDOCS_2_WARNING=1 $(BIN)/mkdocs build --strict --quiet
	@echo "dist/site/index.html"

dist: $(STAMP) ## build wheel and sdist of the version in pyproject.toml into dist/
	rm -rf dist
	$(BIN)/python -m build --no-isolation --outdir dist .

lock: $(STAMP) ## pin the newest versions that pyproject.toml permits
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --upgrade --universal --generate-hashes --no-emit-index-url --no-header \
		--extra can --extra charts --extra dev --extra docs --extra export --extra foxglove --extra lab --extra lan \
		--extra live --extra notebook --extra perfetto --extra ros2 pyproject.toml --output-file requirements.lock

clean: ## remove the environment and what tools have left; runs/ stays
	rm -rf $(VENV) dist .mypy_cache .pytest_cache .ruff_cache
	find . -name __pycache__ -not -path './$(VENV)/*' -prune -exec rm -rf {} +

$(STAMP): requirements.lock pyproject.toml
	@[ "$$(uname -s)" = Linux ] || { echo "rack runs on Linux alone: it needs /dev/shm, pidfds, SCHED_FIFO"; exit 1; }
	@[ -d /dev/shm ] && [ -w /dev/shm ] || { echo "rack needs /dev/shm, writable: mount a tmpfs there"; exit 1; }
	@$(PYTHON) -c 'import sys; sys.exit(not (3, 11) <= sys.version_info < (3, 15))' 2>/dev/null \
		|| { echo "rack needs Python 3.11 to 3.14, and $(PYTHON) is not that: try make PYTHON=python3.11"; exit 1; }
	@$(PYTHON) -c 'import venv, ensurepip' 2>/dev/null \
		|| { echo "$(PYTHON) has no venv: install it (Debian: apt-get install python3-venv)"; exit 1; }
	$(PYTHON) -m venv --clear $(VENV)
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --require-hashes -r requirements.lock
	$(BIN)/python -m pip install --quiet --disable-pip-version-check --no-deps --no-build-isolation --no-index --editable .
	@# The editable install puts this folder on Python's path: links give type checkers and editors the package `rack`, too.
	@mkdir -p $(VENV)/src/rack && for floor in $(FLOORS); do ln -sfn ../../../$$floor $(VENV)/src/rack/$$floor; done
	@for file in __init__.py __main__.py py.typed; do ln -sfn ../../../tools/front/rack/$$file $(VENV)/src/rack/$$file; done
	@ln -sfn ../../tools/front/nasrem_rack.py $(VENV)/src/nasrem_rack.py
	@touch $(STAMP)
