# setup   an environment in .venv: ROS 2 and the solvers from wheels, messages and kernels compiled (Python 3.11 to 3.13, C++)
# demo    real input from map to report, in demo_report/
# test    all tests          check   format, lint, types          bench   figures beside their targets
# clean   removes the environment and everything built
PYTHON ?= python3
VENV   ?= .venv
PY      = $(VENV)/bin/python

# ROS traffic stays on this machine.
export ROS_AUTOMATIC_DISCOVERY_RANGE = LOCALHOST
# Two copies of one ROS library in a process do not mix: nothing of a sourced distribution or of another environment of
# ROS wheels may leak into ours.
unexport PYTHONHOME PYTHONPATH LD_LIBRARY_PATH AMENT_PREFIX_PATH CMAKE_PREFIX_PATH COLCON_PREFIX_PATH
unexport RMW_IMPLEMENTATION _ROS_WHEELS_BOOTSTRAP_COMPLETE

# The stamp's name holds the contents of what the environment is made from, and its place, since a venv does not move.
INPUTS := setup.py pyproject.toml package.xml $(shell find msg_defs src -type f -not -path '*/__pycache__/*' | LC_ALL=C sort)
STAMP  := $(VENV)/.done-$(shell { echo '$(abspath $(VENV))'; cksum $(INPUTS); } | cksum | cut -d' ' -f1)

.PHONY: setup demo test check bench clean
setup: $(STAMP)

$(STAMP):
	@fail() { echo "setup: $$1." >&2; exit 1; }; \
	command -v '$(PYTHON)' >/dev/null \
	  || fail 'there is no $(PYTHON); apt install python3 python3-venv python3-dev, or name another with make PYTHON=/path/to/python'; \
	version=$$('$(PYTHON)' -c 'import sys; print("%d.%d" % sys.version_info[:2])'); \
	case $$version in \
	  3.11|3.12|3.13) ;; \
	  *) fail "xalign needs Python 3.11, 3.12 or 3.13 and $(PYTHON) is $$version; apt install python3.11 python3.11-venv python3.11-dev (or a later one), then make PYTHON=python3.11" ;; \
	esac; \
	'$(PYTHON)' -c 'import ensurepip, venv' 2>/dev/null \
	  || fail "$(PYTHON) cannot make a virtual environment; apt install python$$version-venv"; \
	'$(PYTHON)' -c 'import os, sysconfig; open(os.path.join(sysconfig.get_path("include"), "Python.h"))' 2>/dev/null \
	  || fail "$(PYTHON) has no Python.h to compile with; apt install python$$version-dev"; \
	set -- $${CXX:-c++}; command -v "$$1" >/dev/null || command -v g++ >/dev/null \
	  || fail 'there is no C++ compiler to compile with; apt install g++'; \
	if [ -x $(PY) ] && ! $(PY) -c "import sys; sys.exit('%d.%d' % sys.version_info[:2] != '$$version')"; then \
	  fail "$(VENV) was made with another Python than $(PYTHON) ($$version); make clean first"; \
	fi
	@echo 'setup: virtual environment $(VENV)'
	@'$(PYTHON)' -m venv $(VENV)
	@$(PY) -m pip install -q --disable-pip-version-check uv==0.13.8
	@echo 'setup: ROS 2 and solver wheels (about 1.1 GB installed), compiling messages and kernels; a minute on a good line'
	@# compile: half of a command's start, where Python may not write bytecode. reinstall: uv would take the messages of an
	@# earlier build from its cache. pip: knows mirrors that uv does not.
	@$(VENV)/bin/uv pip install -q --python $(PY) --compile-bytecode --reinstall-package xalign-msgs ./msg_defs/tf2_msgs ./msg_defs -e '.[wheels,algo,batch,test]' \
	  || { echo 'setup: once more with pip' >&2; $(PY) -m pip install -q -U pip \
	       && $(PY) -m pip install -q ./msg_defs/tf2_msgs ./msg_defs -e '.[wheels,algo,batch,test]'; }
	@rm -f $(VENV)/.done-*
	@touch $@
	@echo 'setup: done'

demo: $(STAMP)
	$(VENV)/bin/xalign demo -o demo_report

test: $(STAMP)
	$(PY) -m pytest -q -n 2 --dist loadfile test

check: $(STAMP)
	$(VENV)/bin/ruff format --check .
	$(VENV)/bin/ruff check .
	$(VENV)/bin/mypy

bench: $(STAMP)
	$(PY) -m pip install -q pytheia==1.2.1 faiss-cpu
	@missed=0; for name in main_job batch live logs faults anchors posegraph graph bundle align surfaces; do $(PY) bench/$$name.py || missed=1; done; exit $$missed

clean:
	rm -rf $(VENV) build install log *.egg-info xalign_ros/core/*.so demo_report .mypy_cache .pytest_cache .ruff_cache .hypothesis
