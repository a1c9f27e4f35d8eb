"""Fixtures that run one test body over the implementations of the ops."""

from __future__ import annotations

import pytest

from .scenes import NATIVE_FLOAT32, NATIVE_FLOAT64, TWIN, Variant


@pytest.fixture(params=[TWIN, NATIVE_FLOAT32, NATIVE_FLOAT64], ids=str)
def variant(request: pytest.FixtureRequest) -> Variant:
    """Every implementation: for answers that are known in closed form."""
    return request.param


@pytest.fixture(params=[NATIVE_FLOAT32, NATIVE_FLOAT64], ids=str)
def native(request: pytest.FixtureRequest) -> Variant:
    """The native ops: for comparison with the float64 twin."""
    return request.param


@pytest.fixture(params=[TWIN, NATIVE_FLOAT64], ids=str)
def double(request: pytest.FixtureRequest) -> Variant:
    """The float64 implementations: for finite differences."""
    return request.param
