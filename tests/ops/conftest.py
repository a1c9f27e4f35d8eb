"""Fixtures that run one test body over the implementations of the ops."""

import os
from collections.abc import Iterator

import pytest
import torch

from snowsplat.ops.native import LAUNCHERS
from snowsplat.util.native_layout import Fields

from .engines import launcher
from .scenes import (
    CUDA_FLOAT32,
    CUDA_FLOAT64,
    EMULATED_FLOAT32,
    EMULATED_FLOAT64,
    NATIVE_FLOAT32,
    NATIVE_FLOAT64,
    REFERENCE,
    WEBGPU_FLOAT32,
    Variant,
)


@pytest.fixture(scope="session", autouse=True)
def _one_torch_thread() -> Iterator[None]:
    """The scenes are tiny, so several torch threads would only be slower."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture(autouse=True)
def _isa_is_marked(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Fails if a test runs CPU kernels without the mark `isa`."""
    exempt = {"isa", "emulated", "gpu", "webgpu"}.intersection(
        mark.name for mark in request.node.iter_markers()
    )
    if exempt or "recorder" in request.fixturenames:  # the recorder is not a kernel
        return

    def unmarked(name: str, fields: Fields) -> int:
        pytest.fail(f"runs the kernel {name} of the CPU; mark the test `isa`")

    monkeypatch.setitem(LAUNCHERS, "cpu", unmarked)


def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """With SNOWSPLAT_CASES=few, of the cases of a test only so many that each value of each
    parameter occurs: for runs that repeat the tests (see the Makefile). Always for webgpu, whose
    adapter may be a driver that computes on the CPU.
    """
    few = os.environ.get("SNOWSPLAT_CASES") == "few"
    cases: dict[object, list[pytest.Function]] = {}
    for item in items:
        is_counted = few or item.get_closest_marker("webgpu") is not None
        if is_counted and isinstance(item, pytest.Function) and hasattr(item, "callspec"):
            engines = tuple(v for v in item.callspec.params.values() if isinstance(v, Variant))
            cases.setdefault((item.path, item.originalname, engines), []).append(item)
    superfluous: set[pytest.Item] = set()
    for among in cases.values():
        values = {item: {(k, repr(v)) for k, v in item.callspec.params.items()} for item in among}
        missing = set().union(*values.values())
        while missing:
            best = max(values, key=lambda item: len(values[item] & missing))
            missing -= values.pop(best)
        superfluous |= values.keys()
    config.hook.pytest_deselected(items=list(superfluous))
    items[:] = [item for item in items if item not in superfluous]


def variants(*among: Variant) -> list:
    """Parameters of a fixture, with the marks of their engines.

    Only the CPU's kernels depend on the instruction set, so only they are marked `isa`. The
    reference and the kernels of a GPU would only repeat the same check. Tests that need a GPU exist
    only where there is one.
    """
    marks = {
        "native": pytest.mark.isa,
        "cuda": pytest.mark.gpu,
        "emulated": pytest.mark.emulated,
        "webgpu": pytest.mark.webgpu,
    }
    return [
        pytest.param(v, id=str(v), marks=[marks[v.engine]] if v.engine in marks else [])
        for v in among
        if v.engine != "cuda" or torch.cuda.is_available()
    ]


#: Finite differences of the reference take a second or two.
SLOW_REFERENCE = pytest.param(REFERENCE, id=str(REFERENCE), marks=pytest.mark.slow)
FLOAT64 = (NATIVE_FLOAT64, EMULATED_FLOAT64, CUDA_FLOAT64)
KERNELS = (NATIVE_FLOAT32, EMULATED_FLOAT32, CUDA_FLOAT32, WEBGPU_FLOAT32, *FLOAT64)


def _running(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Variant:
    """The requested variant. The launcher of its engine replaces that of the CPU."""
    variant: Variant = request.param
    if variant.engine in ("emulated", "cuda", "webgpu"):
        monkeypatch.setitem(LAUNCHERS, "cpu", launcher(variant.engine))
    return variant


@pytest.fixture(params=variants(REFERENCE, *KERNELS))
def variant(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Variant:
    """Every implementation: for results that are known in closed form."""
    return _running(request, monkeypatch)


@pytest.fixture(params=variants(*KERNELS))
def native(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Variant:
    """The kernels: for comparison with the float64 reference."""
    return _running(request, monkeypatch)


@pytest.fixture(params=[SLOW_REFERENCE, *variants(*FLOAT64)])
def double(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Variant:
    """The float64 implementations: for finite differences."""
    return _running(request, monkeypatch)


@pytest.fixture
def sums_in_order() -> Iterator[None]:
    """Gradients are summed in a fixed order, on a GPU too."""
    before = torch.get_deterministic_debug_mode()
    # The same as torch.use_deterministic_algorithms(True), which imports torch's compiler first.
    torch.set_deterministic_debug_mode("error")
    yield
    torch.set_deterministic_debug_mode(before)
