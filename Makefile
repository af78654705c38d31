# `make fly` and `make test` do everything: each makes .venv on first use, or adds to it what it needs, and again when what
# is built has changed.

PYTHON ?= $(shell for python in python3.12 python3.13 python3 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null && echo $$python && break; done)
BUILT_FROM := pyproject.toml CMakeLists.txt $(shell find native -type f)
SPLATPILOT := .venv/bin/splatpilot

.PHONY: fly test lint sanitize clean

fly: .venv/flying
	$(SPLATPILOT) fly --out out/fly

test: lint
	.venv/bin/python -m pytest

lint: .venv/installed
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/pyright

# The splat tests on a build with AddressSanitizer and UndefinedBehaviorSanitizer.
sanitize: .venv/installed
	.venv/bin/uv pip install --quiet --python .venv/bin/python cmake ninja nanobind
	native/sanitize.sh

clean:
	rm -rf .venv build

# What flies, and then what trains, reconstructs and checks too.
.venv/flying: $(BUILT_FROM)
	@test -n "$(PYTHON)" || { echo "No Python 3.12 or newer found; install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet uv
	.venv/bin/uv pip install --python .venv/bin/python --editable .
	touch $@

.venv/installed: .venv/flying
	.venv/bin/uv pip install --python .venv/bin/python --requirements pyproject.toml --extra dev
	touch $@
