# make demo     renders photos of a small synthetic scene and reconstructs it: `snowsplat demo`
# make quick    checks of format, lint, types and layers, and the fast tests: under a minute once built
# make nightly  long tests, which `make test` leaves out
# make test     the same checks and all tests: on every instruction set, with the GPU kernels on the CPU
# make dev      creates the development environment for the other targets
# make docs     builds the documentation site in build/docs; warnings are errors
# make format   formats the sources
# make native   builds the native libraries
# make messages brings the catalogues of translations up to date
# make wheel    builds wheels for Linux on x86-64 and aarch64, for every version of Python, into dist/
#
# Each target works on a fresh clone and needs Python >= 3.10 and a C++ compiler. Everything is installed
# into .venv, created by BOOTSTRAP (python3); PYTHON=path/to/python uses an existing environment instead.

SHELL := /bin/sh
BOOTSTRAP ?= python3
NO_COMPILER := snowsplat: no C++ compiler found; install one (Debian/Ubuntu: apt install g++)
NO_PYTHON := snowsplat: $(BOOTSTRAP) is missing or older than 3.10; choose another: make BOOTSTRAP=python3.12
NO_VENV := snowsplat: $(BOOTSTRAP) cannot create environments; install venv (Debian/Ubuntu: apt install python3-venv)

ifdef PYTHON
TOOLS :=
ENVIRONMENT :=
else
PYTHON := .venv/bin/python
TOOLS := .venv/.tools
ENVIRONMENT := .venv/.installed
endif
# Tools (cmake, ninja, ruff, …) come from the environment, the package from this checkout.
export PATH := $(abspath $(dir $(PYTHON))):$(PATH)
export PYTHONPATH := $(CURDIR)/src
# Tests start Python often. Without cached bytecode, each start would compile all modules.
unexport PYTHONDONTWRITEBYTECODE

BUILD := build/native
# Only one build at a time in a checkout.
LOCK := $(shell command -v flock >/dev/null 2>&1 && echo flock build/native.lock)
# The formatter and linter of JavaScript (biome.json).
BIOME = $(and $(shell command -v node),$(wildcard tests/node/node_modules/.bin/biome))
NO_BIOME := lint: JavaScript is not checked; that needs Node, and npm ci --prefix tests/node --ignore-scripts
CXX_FILES = $(shell find src/snowsplat/native tests -name '*.h' -o -name '*.cpp' -o -name '*.cu' | sort)

.PHONY: demo quick test nightly dev docs gallery messages format native wheel compiler lint types layers clean
.PHONY: pytest-quick pytest pytest-best pytest-repeated pytest-isas sanitized neon webgpu

demo: native $(ENVIRONMENT)
	$(PYTHON) -m snowsplat demo -o out/demo

quick: lint
	@$(MAKE) --no-print-directory -j2 types layers pytest-quick

test: lint
	@$(MAKE) --no-print-directory -j2 types layers pytest

# What compiles is a small part of the environment, so the rest is installed at the same time.
dev:
	@$(MAKE) --no-print-directory -j2 native $(ENVIRONMENT)

# uv downloads and unpacks several packages at once, in a third of the time of pip. It does not know what is set
# for pip, such as a mirror: where uv cannot install, pip does.
UV := UV_HTTP_TIMEOUT=20 UV_HTTP_RETRIES=0 .venv/bin/python -m uv pip install --quiet --python .venv/bin/python
install = $(UV) $(1) 2>/dev/null || .venv/bin/python -m pip install --no-compile $(1)

# The part of the environment that compiles: the pinned tools among the packages for development.
COMPILING := babel|cmake|ninja|nvidia-cuda-nvrtc-cu12|scikit-build-core
.venv/.tools: pyproject.toml | compiler
	@$(BOOTSTRAP) -c 'import sys; sys.exit(sys.version_info < (3, 10))' 2>/dev/null || \
	    { echo "$(NO_PYTHON)" >&2; exit 1; }
	@$(BOOTSTRAP) -c 'import ensurepip, venv' 2>/dev/null || { echo "$(NO_VENV)" >&2; exit 1; }
	$(BOOTSTRAP) -m venv .venv
	.venv/bin/python -m pip install --quiet --upgrade pip
	-@.venv/bin/python -m pip install --quiet --only-binary=:all: uv
	sed -nE '/^dev = /,/^]/ s/^ *"(($(COMPILING))==.*)",$$/\1/p' pyproject.toml >.venv/tools.txt
	$(call install,--requirement .venv/tools.txt)
	@touch $@

# Without an NVIDIA driver, the CPU build of PyTorch: it needs none of the CUDA libraries (2.4 GB of 3.2 GB). The
# default build is taken if the index of the CPU build cannot be reached; with TORCH_BACKEND= at once.
TORCH_BACKEND ?= cpu
NO_INDEX := snowsplat: the CPU build of PyTorch cannot be had here; the default build is installed
HAS_DRIVER := import ctypes, sys; sys.platform == "linux" and ctypes.CDLL("libcuda.so.1")

# The editable installation builds nothing: `make native` installs the libraries into src/. Python
# compiles the modules that it imports; most of those of torch are never imported.
CHECKOUT := --no-build-isolation --editable '.[dev,docs]' \
    --config-settings=wheel.cmake=false --config-settings=editable.mode=inplace
.venv/.installed: .venv/.tools
	@$(if $(TORCH_BACKEND),$(BOOTSTRAP) -c '$(HAS_DRIVER)' 2>/dev/null || \
	    $(UV) --torch-backend=$(TORCH_BACKEND) torch 2>/dev/null || echo "$(NO_INDEX)" >&2)
	$(call install,$(CHECKOUT))
	@touch $@

compiler:
	@command -v "$${CXX:-c++}" >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || \
	    command -v clang++ >/dev/null 2>&1 || { echo "$(NO_COMPILER)" >&2; exit 1; }

# One library per instruction set and the kernels for each GPU architecture, into src/snowsplat/_lib; the page
# of the viewer, into src/snowsplat/_viewer. Only changed files are compiled.
native: $(TOOLS) | compiler
	@mkdir -p $(BUILD)
	@$(LOCK) env -u MAKEFLAGS sh -ec ' \
	    cmake -G Ninja -S . -B $(BUILD) --log-level=NOTICE \
	        -DPython3_EXECUTABLE="$(abspath $(shell command -v $(PYTHON)))" >/dev/null; \
	    cmake --build $(BUILD) -- --quiet; \
	    cmake --install $(BUILD) --prefix src >/dev/null'

# The scenes that the page "Gallery" links to: about ten minutes.
gallery: native $(ENVIRONMENT)
	$(PYTHON) docs/gallery.py

# Always all pages: otherwise, the warnings about unchanged pages would be missing.
docs: $(ENVIRONMENT)
	$(PYTHON) -m sphinx --builder html --doctree-dir build/doctrees --fresh-env --fail-on-warning --keep-going \
	    --quiet docs build/docs

wheel: $(ENVIRONMENT)
	@$(PYTHON) tools/make_wheels.py

messages: $(ENVIRONMENT)
	$(PYTHON) tools/update_messages.py

format: $(ENVIRONMENT)
	ruff format .
	ruff check --fix .
	$(if $(CXX_FILES),clang-format -i $(CXX_FILES))
	$(if $(BIOME),$(BIOME) check --write .)

lint: $(ENVIRONMENT)
	ruff format --check .
	ruff check .
	$(if $(CXX_FILES),clang-format --dry-run --Werror $(CXX_FILES))
	@$(if $(BIOME),$(BIOME) check --error-on-warnings .,echo "$(NO_BIOME)")

types: $(ENVIRONMENT)
	mypy

layers: $(ENVIRONMENT)
	lint-imports --no-logo

# Number of processes for tests.
JOBS ?= $(shell $(PYTHON) -c 'import os; print(os.cpu_count())')
PYTEST = $(PROCESS) $(PYTHON) -m pytest $(PROCESSES)
# A single process does not need xdist.
PROCESS = $(if $(filter 1,$(JOBS)),OMP_NUM_THREADS=1)
PROCESSES = $(if $(filter 1,$(JOBS)),,-n $(JOBS) --dist worksteal)
# Slow tests have a mark, and `quick` excludes these marks (listed in pyproject.toml).
QUICK := not (sfm or browser or build or emulated or gpu or webgpu or kill or slow or nightly)
ISA := isa and not (emulated or gpu or nightly)
# The tests of kernels that other instruction sets do not repeat: threads and the loops over long images
# are the same for each of them; and on each, results and gradients are compared with those of the reference,
# so finite differences would only test the reference again.
SAME := test_determinism or number_of_threads or in_parallel or long_images or \
    (finite_differences and (test_photometric or test_project or test_rasterize))
# Repeated tests have few of their cases: each value of each parameter. `make nightly` repeats all of them.
CASES = few
# Under sanitizers, one precision is enough: both have the same source. One test is about the sanitizers.
SANITIZED := emulated-float32 or sanitizers_find
REPEATED := build/pytest-repeated.log

pytest-quick: native $(ENVIRONMENT)
	$(PYTEST) -m '$(QUICK)'

# All tests on the best instruction set. Some of them wait for browsers and servers. Therefore, at the same
# time, with half as many processes and a lower priority: on each other instruction set and in an emulator
# of Arm, the tests that depend on it; and the GPU kernels on the CPU under sanitizers. Tests that run under
# sanitizers are not repeated without them.
pytest: native $(ENVIRONMENT)
	@$(MAKE) --no-print-directory -j2 pytest-best pytest-repeated

pytest-best:
	$(PYTEST) -m 'not (nightly or webgpu)' $(if $(SANITIZERS),-k 'not ($(SANITIZED))')

nightly: native $(ENVIRONMENT)
	@$(MAKE) --no-print-directory pytest-isas CASES=all ISA_SKIPPED='$(SAME)'
	@$(MAKE) --no-print-directory sanitized CASES=all
	@$(MAKE) --no-print-directory neon CASES=all NEON_SKIPPED='float64 or $(SAME)'
	$(PYTEST) -m nightly

# The kernels for Arm (NEON), in an emulator, which takes five times as long as the processor: with the
# precision that trainings use. float64, for references, has the same source. The loader of the library,
# which test_native.py tests, is not used for them. Random values are for `make nightly`.
NEON_SKIPPED = float64 or test_fuzz or $(SAME)
NEON_TESTS := tests/ops tests/sfm/colmap/pairs/test_matching.py tests/sfm/colmap/features/test_patches.py \
    tests/sfm/colmap/features/test_sift.py \
    --ignore tests/ops/test_native.py -k 'not ($(NEON_SKIPPED))'
NEON_FOUND = $(shell command -v aarch64-linux-gnu-g++ >/dev/null && command -v qemu-aarch64)

neon: native $(ENVIRONMENT)
	@$(if $(NEON_FOUND),echo "neon: $(PYTEST) -m '$(ISA)'" $(NEON_TESTS); \
	    SNOWSPLAT_CASES=$(CASES) SNOWSPLAT_NEON=run $(PYTEST) -m '$(ISA)' $(NEON_TESTS), \
	    echo "neon: skipped; it needs a compiler and an emulator (Debian/Ubuntu: apt install g++-aarch64-linux-gnu qemu-user)")

# The kernels in WGSL, in processes of their own (tests/conftest.py says why).
webgpu: native $(ENVIRONMENT)
	@echo "webgpu: $(PYTEST) -m 'webgpu and not nightly' tests/ops tests/training"
	@$(PYTEST) -m 'webgpu and not nightly' tests/ops tests/training

# Prints everything if a test fails, otherwise only the numbers of tests.
pytest-repeated:
	@if nice -n 5 $(MAKE) --no-print-directory pytest-isas sanitized neon webgpu LOWER='[-2:-1]' JOBS=$$(($(JOBS) / 2)) >$(REPEATED) 2>&1; \
	    then echo; grep -E '^(SNOWSPLAT_ISA|sanitized|neon|webgpu|[0-9]+ passed)' $(REPEATED); \
	    else cat $(REPEATED); exit 1; fi

# With the precision that trainings use: float64, for references, has the same source. Random values are
# for `make nightly`.
ISA_SKIPPED = float64 or test_random_extremes or $(SAME)
ISA_TESTS := tests/ops tests/sfm/colmap/pairs/test_matching.py tests/sfm/colmap/features/test_sift.py \
    tests/training/test_pose_refinement.py tests/training/test_step_runner.py -k 'not ($(ISA_SKIPPED))'
# All lower instruction sets. Each change is tested with the next lower one, and with NEON, whose kernels
# have the source of the baseline.
LOWER = [:-1]
pytest-isas:
	@isas=$$($(PYTHON) -c 'from snowsplat.ops import native; print(*native.available_isas()$(LOWER))') && \
	    for isa in $$isas; do \
	        echo "SNOWSPLAT_ISA=$$isa $(PYTEST) -m '$(ISA)'" $(ISA_TESTS); \
	        SNOWSPLAT_CASES=$(CASES) SNOWSPLAT_ISA=$$isa $(PYTEST) -m '$(ISA)' $(ISA_TESTS) || exit 1; \
	    done

# The GPU kernels on the CPU under AddressSanitizer and UndefinedBehaviorSanitizer, with the threads of a
# block in the reverse order: a missing barrier may have an effect in only one of the two orders, and the
# other precision runs in the usual order. These are the sanitizers of GCC, which can be loaded into a
# Python that was built without them. Reports need no call stack of each allocation, which costs time.
SANITIZERS = $(strip $(foreach name,libasan.so libubsan.so,$(wildcard $(shell g++ -print-file-name=$(name) 2>&1))))

sanitized: native $(ENVIRONMENT)
	@$(if $(SANITIZERS),echo "sanitized: $(PYTEST) tests/ops -m emulated -k '$(SANITIZED)'"; \
	    LD_PRELOAD="$(SANITIZERS)" ASAN_OPTIONS=detect_leaks=0:malloc_context_size=1 CXX=g++ \
	    SNOWSPLAT_CASES=$(CASES) SNOWSPLAT_EMULATION=sanitized SNOWSPLAT_ORDER=backward \
	    $(PYTEST) tests/ops -m emulated -k '$(SANITIZED)', \
	    echo "sanitized: skipped; it needs g++ with its sanitizers")

clean:
	rm -rf build dist src/snowsplat/_lib src/snowsplat/_viewer .pytest_cache .mypy_cache .ruff_cache .import_linter_cache
