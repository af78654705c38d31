# `make fly` and `make test` do everything: each makes .venv on first use, or adds to it what it needs, and again when what
# is built has changed.

PYTHON ?= $(shell for python in python3.12 python3.13 python3 python; do \
	$$python -c 'import sys; sys.exit(sys.version_info < (3, 12))' 2>/dev/null && echo $$python && break; done)
BUILT_FROM := pyproject.toml CMakeLists.txt $(shell find native -type f)
SPLATPILOT := .venv/bin/splatpilot
NATIVE := $(shell find native -name '*.hpp' -o -name '*.cpp')

.PHONY: fly test pytest lint docs stub messages sanitize nightly clean

fly: .venv/flying
	$(SPLATPILOT) fly --out out/fly --overwrite

# Pyright has one thread, which the tests need not wait for.
test: .venv/installed
	+@$(MAKE) --no-print-directory --jobs=2 lint pytest

pytest: .venv/installed
	OMP_NUM_THREADS=1 .venv/bin/python -m pytest -n auto --dist loadfile --no-loadscope-reorder

lint: .venv/installed
	.venv/bin/ruff check .
	.venv/bin/ruff format --check .
	.venv/bin/python lint/words.py
	.venv/bin/codespell
	.venv/bin/clang-format --dry-run --Werror $(NATIVE)
	.venv/bin/pyright

# The documentation, in build/site; needs no network.
docs: .venv/installed
	.venv/bin/sphinx-build --fail-on-warning --keep-going --quiet docs build/site
	@echo "open build/site/index.html"

# Writes the types of the native module, after a change of its bindings.
stub: .venv/installed
	.venv/bin/python -m nanobind.stubgen --quiet --module splatpilot._native --output-file splatpilot/_native.pyi

# Writes the Python of the messages, after a change in lcmtypes/.
messages: .venv/installed
	rm -rf build/messages systems/messaging/generated
	.venv/bin/lcm-gen --python --ppath build/messages lcmtypes/*.lcm
	mv build/messages/splatpilot systems/messaging/generated

# The tests of the native kernels on a build with AddressSanitizer and UndefinedBehaviorSanitizer.
sanitize: .venv/installed
	native/sanitize.sh

nightly: sanitize
	.venv/bin/python benchmarks/rasterize.py

clean:
	rm -rf .venv build

# What flies, and then what trains, reconstructs and checks too: with EXTRAS, it downloads while it compiles. Without
# isolation, later builds compile what has changed.
.venv/flying: $(BUILT_FROM)
	@test -n "$(PYTHON)" || { echo "No Python 3.12 or newer found; install one, or name it: make PYTHON=/path/to/python3.12" >&2; exit 1; }
	$(PYTHON) -m venv .venv
	.venv/bin/python -m pip install --quiet uv
	.venv/bin/uv pip install --quiet --python .venv/bin/python --group build
	.venv/bin/uv pip install --python .venv/bin/python --no-build-isolation-package splatpilot --editable '.$(EXTRAS)'
	touch $@

.venv/installed: EXTRAS := [dev]
.venv/installed: .venv/flying
	.venv/bin/uv pip install --python .venv/bin/python --requirements pyproject.toml --extra dev
	touch $@
