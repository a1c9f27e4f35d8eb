# make demo     takes photos of a small scene and makes it anew from them, with `snowsplat make`
# make test     all that must hold: format, lint, types, layers, tests on every instruction set, and
#               the kernels of a GPU, on the CPU
# make dev      the environment to work in; then, quickly: make test, make format, make native
#
# Each works by itself on a fresh clone and needs Python >= 3.10 and a C++ compiler. Everything goes
# into .venv, made by BOOTSTRAP (python3); PYTHON=path/to/python uses a ready environment instead.

SHELL := /bin/sh
BOOTSTRAP ?= python3
NO_COMPILER := snowsplat: no C++ compiler found; install one (Debian/Ubuntu: apt install g++)
NO_PYTHON := snowsplat: $(BOOTSTRAP) is missing or older than 3.10; name one: make BOOTSTRAP=python3.12
NO_VENV := snowsplat: $(BOOTSTRAP) cannot make environments; install that (Debian/Ubuntu: apt install python3-venv)

ifdef PYTHON
ENVIRONMENT :=
else
PYTHON := .venv/bin/python
ENVIRONMENT := .venv/.installed
endif
# cmake, ninja, ruff and the rest are those of the environment; the package is that of this checkout.
export PATH := $(abspath $(dir $(PYTHON))):$(PATH)
export PYTHONPATH := $(CURDIR)/src

BUILD := build/native
# Two builds in one checkout wait for each other.
LOCK := $(shell command -v flock >/dev/null 2>&1 && echo flock build/native.lock)
# One precision is enough: the two have the same source.
SANITIZED := emulated-float32
CXX_FILES = $(shell find src/snowsplat/native tests -name '*.h' -o -name '*.cpp' -o -name '*.cu' | sort)

.PHONY: demo test dev format native compiler lint types layers pytest pytest-others pytest-ops sanitized clean

demo: native
	$(PYTHON) examples/demo.py out/demo

test: lint types layers pytest

dev: native

# The environment. Editable without a build of its own: `make native` puts the libraries into src/.
.venv/.installed: pyproject.toml | compiler
	@$(BOOTSTRAP) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || \
	    { echo "$(NO_PYTHON)" >&2; exit 1; }
	@$(BOOTSTRAP) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(NO_VENV)" >&2; exit 1; }
	$(BOOTSTRAP) -m venv .venv
	.venv/bin/python -m pip install --quiet --upgrade pip
	.venv/bin/python -m pip install --editable '.[dev]' \
	    --config-settings=wheel.cmake=false --config-settings=editable.mode=inplace
	@touch $@

compiler:
	@command -v "$${CXX:-c++}" >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || \
	    command -v clang++ >/dev/null 2>&1 || { echo "$(NO_COMPILER)" >&2; exit 1; }

# One library for each instruction set, and the kernels for each kind of GPU, into src/snowsplat/_lib,
# and the viewer's page, into _viewer; only what changed is compiled.
native: $(ENVIRONMENT) | compiler
	@mkdir -p $(BUILD)
	@$(LOCK) env -u MAKEFLAGS sh -ec ' \
	    cmake -G Ninja -S . -B $(BUILD) --log-level=NOTICE \
	        -DPython3_EXECUTABLE="$(abspath $(shell command -v $(PYTHON)))" >/dev/null; \
	    cmake --build $(BUILD) -- --quiet; \
	    cmake --install $(BUILD) --prefix src >/dev/null'

format: $(ENVIRONMENT)
	ruff format .
	ruff check --fix .
	$(if $(CXX_FILES),clang-format -i $(CXX_FILES))

lint: $(ENVIRONMENT)
	ruff format --check .
	ruff check .
	$(if $(CXX_FILES),clang-format --dry-run --Werror $(CXX_FILES))

types: $(ENVIRONMENT)
	mypy

layers: $(ENVIRONMENT)
	lint-imports --no-logo

# All tests on the best instruction set, then those of the ops on each of the others, less those of
# a GPU's kernels, which have none. Two at a time, since most tests keep one core busy.
pytest: native
	@$(MAKE) --no-print-directory -j2 pytest-others pytest-ops sanitized

pytest-others: native
	$(PYTHON) -m pytest --ignore tests/ops

pytest-ops: native
	$(PYTHON) -m pytest tests/ops
	@isas=$$($(PYTHON) -c 'from snowsplat.ops import native; print(*native.available_isas()[:-1])') && \
	    for isa in $$isas; do \
	        echo "SNOWSPLAT_ISA=$$isa $(PYTHON) -m pytest tests/ops"; \
	        SNOWSPLAT_ISA=$$isa $(PYTHON) -m pytest tests/ops -m 'not emulated and not gpu' || exit 1; \
	    done

# The kernels of a GPU, on the CPU, under AddressSanitizer and UndefinedBehaviorSanitizer, and with the
# threads of a block in the other order: what misses a barrier can be right in one of the two alone.
# GCC's sanitizers, since they can be loaded into a Python that was built without them.
sanitized: native
	@if [ -f "$$(g++ -print-file-name=libasan.so)" ]; then \
	    echo "sanitized: $(PYTHON) -m pytest tests/ops -m emulated -k $(SANITIZED)"; \
	    LD_PRELOAD="$$(g++ -print-file-name=libasan.so) $$(g++ -print-file-name=libubsan.so)" \
	    ASAN_OPTIONS=detect_leaks=0 CXX=g++ SNOWSPLAT_EMULATION=sanitized SNOWSPLAT_ORDER=backward \
	        $(PYTHON) -m pytest tests/ops -m emulated -k $(SANITIZED); \
	else \
	    echo "sanitized: skipped; it needs g++ with its sanitizers"; \
	fi

clean:
	rm -rf build dist src/snowsplat/_lib src/snowsplat/_viewer .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
