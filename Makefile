# make demo    trains, evaluates and renders a small scene, and says where it is
# make test    everything that must hold: format, lint, types, layers, all tests on every instruction set
# make dev     the environment for working on snowsplat; make check / make format / make native use it
#
# Each works by itself on a fresh clone. PYTHON=/path/to/python uses that environment instead of .venv.

SHELL := /bin/sh
VENV := .venv
BOOTSTRAP ?= python3
ifdef PYTHON
ENVIRONMENT :=
else
PYTHON := $(VENV)/bin/python
ENVIRONMENT := $(VENV)/.installed
endif
# Tools (cmake, ninja, ruff ...) are those of the environment.
BIN := $(abspath $(dir $(PYTHON)))
export PATH := $(BIN):$(PATH)

BUILD := build/native
# Builds of one tree wait for each other.
LOCK := $(shell command -v flock >/dev/null 2>&1 && echo flock build/native.lock)

.PHONY: native
native: $(ENVIRONMENT) | compiler
	@mkdir -p $(BUILD)
	@$(LOCK) sh -ec 'test -f $(BUILD)/build.ninja || cmake -G Ninja -S . -B $(BUILD) --log-level=WARNING; \
	    cmake --build $(BUILD) -- --quiet; \
	    cmake --install $(BUILD) --prefix src >/dev/null'

.PHONY: compiler
compiler:
	@command -v "$${CXX:-c++}" >/dev/null 2>&1 || command -v g++ >/dev/null 2>&1 || command -v clang++ >/dev/null 2>&1 || \
	    { echo "snowsplat: no C++ compiler found; install one (Debian/Ubuntu: apt install g++)" >&2; exit 1; }
