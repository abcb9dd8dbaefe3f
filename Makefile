# Two commands do all set-up: `make run` and `make test`. The environment is made once, in .venv,
# from requirements.lock alone; PYTHON=python3.12 picks another interpreter.
PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
STAMP := $(VENV)/installed
FLOORS := backplane levels boards tools configs
CONFIG ?= nasrem
# What needs neither a whole task, a process in real time, nor a writer that hammers; shared memory and one small rack in
# lockstep are real.
QUICK := tests/test_architecture.py $(wildcard tests/backplane/test_*.py) $(filter-out %/test_driver.py \
	%/test_protocols.py %/test_overtaken_reader.py,$(wildcard tests/backplane/*/test_*.py)) \
	tests/levels/motion tests/levels/planning tests/levels/timing tests/levels/robot/test_cell.py \
	tests/levels/robot/test_dynamics.py tests/levels/test_algebra.py tests/levels/test_level.py \
	tests/levels/elemental_move/test_elemental_move_executor.py tests/levels/task/test_task_program.py \
	tests/levels/arm/test_faulty.py tests/levels/arm/test_own_arm.py \
	$(wildcard tests/boards/test_config_*.py) $(wildcard tests/boards/test_fault_*.py) \
	$(addprefix tests/boards/run/test_lockstep.py::test_,ten_runs_in_lockstep_have_one_digest the_digest_distinguishes_runs) \
	tests/tools/test_cli.py tests/tools/commands/test_schema.py tests/tools/faults/test_judge.py \
	tests/tools/faults/campaigns tests/tools/timing/test_judged_config.py tests/tools/timing/test_repair.py \
	tests/tools/timing/charts/test_measured.py tests/tools/timing/charts/test_patterns.py tests/tools/timing/charts/test_window.py

.DEFAULT_GOAL := help
.PHONY: help run test quick mutants golden lint lock clean

help: ## show this
	@grep -hE '^[a-z]+:.*## ' $(MAKEFILE_LIST) | sed -E 's/^([a-z]+):.*## (.*)/  make \1\t\2/' | expand -t 16

run: $(STAMP) ## run the rack CONFIG (default: nasrem); ARGS="--lockstep" and the like are passed on
	$(BIN)/rack run $(CONFIG) $(ARGS)

test: $(STAMP) ## run the tests; ARGS="-k segment" and the like are passed on
	$(BIN)/python -m pytest $(ARGS)

quick: $(STAMP) ## run the quick tests, under a minute: no whole task, no rack in real time; ARGS as above
	$(BIN)/python -m pytest -m "not alone" $(QUICK) $(ARGS)

mutants: $(STAMP) ## check that a campaign notices when a detector is switched off
	$(BIN)/python -m tests.mutants

golden: $(STAMP) ## write the digests of the shipped racks anew, after a change of what they do
	$(BIN)/python -m tests.golden

lint: $(STAMP) ## check style and types
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/mypy

lock: $(STAMP) ## pin the newest versions that pyproject.toml permits
	$(BIN)/python -m pip install --quiet uv
	$(BIN)/uv pip compile --quiet --upgrade --universal --generate-hashes --no-emit-index-url --no-header \
		--extra bench --extra dev --extra lan pyproject.toml --output-file requirements.lock

clean: ## remove the environment and what tools have left; runs/ stays
	rm -rf $(VENV) build *.egg-info .mypy_cache .pytest_cache .ruff_cache
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
	@# A type checker and an editor read no import hook: for them, `rack` as links.
	@mkdir -p $(VENV)/src/rack && for floor in $(FLOORS); do ln -sfn ../../../$$floor $(VENV)/src/rack/$$floor; done
	@touch $(STAMP)
