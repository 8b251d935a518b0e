# Every target makes its own environment in .venv when it is missing or when the dependencies
# changed, so `make quickstart` and `make test` are the only commands a fresh machine needs.
#
#   PYTHON=python3.12 make test                  another interpreter (3.11 is the tested one)
#   PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu make test
#                                                the smaller CPU build of torch

PYTHON ?= python3
VENV := .venv
BIN := $(VENV)/bin
INSTALLED := $(VENV)/.installed
PIP_INSTALL := -m pip install --quiet --disable-pip-version-check -c constraints.txt

# One thread per process: tests and seeds run as parallel processes, which would otherwise fight.
export OMP_NUM_THREADS ?= 1
export MPLBACKEND ?= Agg

.PHONY: help quickstart films gpu test test-core test-mjlab check build lock clean
.DEFAULT_GOAL := help

help:
	@echo "make quickstart   train PPO with and without symmetry on CartPole; watch ANYmal push a cube"
	@echo "make films        the films of benchmarks/plots, from the policies of benchmarks/results"
	@echo "make test         run all tests and doctests"
	@echo "make gpu          the second physics engine, mujoco_warp, into .venv; make test then tests it too"
	@echo "make test-core    the core's tests with nothing installed but TorchRL, on any Python that it supports"
	@echo "make test-mjlab   the tests of MuJoCo models with mjlab and its MuJoCo 3.11"
	@echo "make check        lint, formatting, types"
	@echo "make build        wheel and sdist in dist/; the wheel is smoke-tested in clean environments"
	@echo "make lock         the hashes from which the CI installs, after a change of constraints*.txt"
	@echo "make clean        remove .venv, .venv-*, caches and build products"

$(INSTALLED): pyproject.toml constraints.txt
	@test -x $(BIN)/pip || $(PYTHON) -m venv $(VENV)
	@echo "Installing into $(VENV) (a few minutes the first time)"
	$(BIN)/python $(PIP_INSTALL) --editable '.[dev]'
	$(BIN)/python $(PIP_INSTALL) --no-deps rsl-rl-lib  # torchvision, which it names, is not needed
	@touch $@

# 150 MB more, for those who want it: without it, its tests are skipped.
$(VENV)/.installed-gpu: $(INSTALLED)
	$(BIN)/python $(PIP_INSTALL) --editable '.[gpu]'
	@touch $@

$(VENV)-core/.installed: pyproject.toml constraints.txt
	@test -x $(@D)/bin/pip || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) --editable . pytest hypothesis
	@touch $@

$(VENV)-mjlab/.installed: pyproject.toml constraints.txt constraints-mjlab.txt
	@test -x $(@D)/bin/pip || $(PYTHON) -m venv $(@D)
	$(@D)/bin/python $(PIP_INSTALL) --editable '.[dev]'
	$(@D)/bin/python -m pip install --quiet --disable-pip-version-check --no-deps -r constraints-mjlab.txt
	@touch $@

# A robot's policy is replayed first: key frames, or where there is no OpenGL its paths from above. A film
# (--out push.gif) takes a minute more. What was seen, and what to do next, comes last.
PUSH := anymal_push --checkpoint benchmarks/results/paper-push/policies/anymal_push/aug
quickstart: $(INSTALLED)
	@echo "ANYmal pushes a cube to targets all around it, with a policy that is in this repository"
	@$(BIN)/python examples/watch.py $(PUSH) --out runs/quickstart/push.png || \
	$(BIN)/python examples/watch.py $(PUSH) --overlay --out runs/quickstart/push_paths.png
	@echo "CartPole: PPO against PPO with symmetric copies"
	@$(BIN)/python examples/quickstart.py

# All goals side by side from the images of one start, a minute each.
define film
$(BIN)/python examples/watch.py anymal_$(1) --checkpoint benchmarks/results/paper-$(1)/policies/anymal_$(1)/$(2) \
  --out benchmarks/plots/paper-$(1)/anymal_$(1)_$(2).mp4

endef
films: $(INSTALLED)
	$(foreach task,push climb,$(foreach method,ppo aug,$(call film,$(task),$(method))))

gpu: $(VENV)/.installed-gpu

test: $(INSTALLED)
	$(BIN)/python -m pytest --numprocesses auto --dist worksteal $(PYTEST_ARGS)

# The tests that need neither an extra nor our tasks.
CORE := augment augment_random builders events exactly_symmetric exactness groups host_waits images imports \
  malformed_builders mirror_loss mirror_loss_effect mirror_loss_of normalization outputs probing \
  probing_sources replay_buffers replay_combinations representations samplers scans symmetric_ppo \
  symmetric_ppo_contracts symmetric_ppo_networks symmetry symmetry_replay_buffer testing vecnorm
test-core: $(VENV)-core/.installed
	$(VENV)-core/bin/python -m pytest $(CORE:%=tests/test_%.py) $(PYTEST_ARGS)

# Our tasks need MuJoCo 3.17, and the tests of verify need our tasks.
test-mjlab: $(VENV)-mjlab/.installed
	$(VENV)-mjlab/bin/python -m pytest --numprocesses auto --dist worksteal \
	  $(filter-out tests/test_mujoco_verify.py,$(wildcard tests/test_mujoco_*.py tests/test_bridges_mjlab.py)) \
	  $(PYTEST_ARGS)

check: $(INSTALLED)
	$(BIN)/ruff check .
	$(BIN)/ruff format --check .
	$(BIN)/pyright

# Each extra alone: small environments beside one with the core, whose torch they share.
build: $(INSTALLED)
	rm -rf build dist
	PIP_CONSTRAINT=constraints.txt $(BIN)/python -m build --quiet
	@set -e; clean=$$(mktemp -d); trap 'rm -rf "$$clean"' EXIT; wheel=$$(echo dist/*.whl); \
	cp tests/smoke_wheel.py "$$clean"; \
	for extra in core mujoco tasks train; do \
	  echo "Installing the wheel into a clean environment: $$extra"; \
	  python="$$clean/$$extra/bin/python"; \
	  $(PYTHON) -m venv "$$clean/$$extra"; \
	  site=$$("$$python" -c 'import site; print(site.getsitepackages()[0])'); \
	  if [ $$extra = core ]; then core="$$site"; "$$python" $(PIP_INSTALL) "$$wheel"; \
	  else echo "$$core" > "$$site/core.pth"; "$$python" $(PIP_INSTALL) "$$wheel[$$extra]"; fi; \
	  (cd "$$clean"; "$$python" -I smoke_wheel.py $$extra); \
	done

lock: $(INSTALLED)
	$(BIN)/python .ci/lock.py

clean:
	rm -rf $(VENV) $(VENV)-core $(VENV)-mjlab build dist *.egg-info .pytest_cache .ruff_cache .hypothesis
	find . -name __pycache__ -type d -prune -exec rm -rf {} +
