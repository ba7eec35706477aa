# The commands of the project; `make help` lists them. What is installed is declared in ros2_ws/src/*/setup.cfg.

VENV ?= $(CURDIR)/.venv
BIN := $(VENV)/bin
TESTS ?= tests
# -n 2: two modules at a time, so that what a module's tests share is made once; each test of ROS nodes has a domain id
# of its own
PYTEST_FLAGS ?= -n 2 --dist loadscope --no-loadscope-reorder
# one thread of linear algebra per process: the tests and the lab run processes side by side
export OMP_NUM_THREADS ?= 1
export OPENBLAS_NUM_THREADS ?= 1
export VENV

.DEFAULT_GOAL := help
.PHONY: help setup demo test quick check bench build lock rosdep clean distclean

help: ## list these commands
	@awk -F ':.*## ' '/^[a-z]+:.*## / { printf "make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)

setup: ## make or update .venv (each command below does so first; free when nothing changed)
	@command -v $(or $(PYTHON),python3) >/dev/null || { echo "set-up: $(or $(PYTHON),python3) not found: install Python 3.11 or 3.12 (apt install python3 python3-venv)" >&2; exit 2; }
	@PYTHON='$(PYTHON)' $(or $(PYTHON),python3) tools/environment.py

demo: setup ## a closure recorded, compared, diagnosed; ends with the path of a report
	@$(BIN)/hannes demo $(ARGS)

test: setup ## all tests
	@$(BIN)/python -m pytest $(PYTEST_FLAGS) $(TESTS)

quick: setup ## the tests without those that take more than about twelve seconds each
	@$(BIN)/python -m pytest $(PYTEST_FLAGS) -m "not slow" $(TESTS)

check: setup ## ruff (rules and layout) and mypy
	@status=0; $(BIN)/ruff check . || status=1; $(BIN)/ruff format --check --quiet . || status=1; $(BIN)/mypy --config-file pyproject.toml || status=1; \
	$(BIN)/mypy --config-file pyproject.toml bench tools || status=1; exit $$status

bench: setup ## speed and identification benchmarks, as ratios in one run
	@for file in bench/*.py; do echo "== $$file"; $(BIN)/python $$file || exit 1; done

build: setup ## colcon build of ros2_ws; then: source ros2_ws/install/setup.bash
	@tools/colcon_build $(COLCON_FLAGS)

lock: setup ## pin in requirements/constraints.txt the versions that .venv holds
	@$(BIN)/python tools/environment.py --lock

rosdep: ## print the rosdep line for apt ROS 2 Jazzy
	@python3 tools/environment.py --rosdep

clean: ## remove what was built, keep .venv
	@rm -rf ros2_ws/build ros2_ws/install ros2_ws/log .pytest_cache .mypy_cache .ruff_cache
	@find ros2_ws/src tests -name __pycache__ -prune -exec rm -rf {} +

distclean: clean ## remove .venv too
	@rm -rf $(VENV) && find ros2_ws/src -name '*.egg-info' -prune -exec rm -rf {} +
