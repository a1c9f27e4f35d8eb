"""Fixtures that run one test body over the implementations of the ops."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch

from .scenes import NATIVE_FLOAT32, NATIVE_FLOAT64, TWIN, Variant


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """Scenes are tiny: torch's threads would only wait for each other."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


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
