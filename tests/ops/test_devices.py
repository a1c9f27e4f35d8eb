"""Selection of the device, and the messages if a GPU cannot be used."""

import importlib
import json
import sys
import warnings
from types import SimpleNamespace

import pytest
import torch

from snowsplat import ops
from snowsplat.ops.cuda import availability
from snowsplat.util.errors import UserError
from snowsplat.util.messages import Message

TOO_OLD = "A card (compute capability 6.1) is too old; use one of 7.0 (2017) or newer"


@pytest.fixture(autouse=True)
def machine(monkeypatch) -> SimpleNamespace:
    """A machine with a usable GPU; tests then change it."""
    monkeypatch.delenv("SNOWSPLAT_DEVICE", raising=False)
    fake = SimpleNamespace(
        usable=True, capabilities=[(8, 6), (9, 0)], architectures=["sm_70", "sm_80", "sm_90"]
    )
    fake.driver = SimpleNamespace(error=0, cuda=(12, 4))
    cuda = torch.cuda
    monkeypatch.setattr(torch.version, "cuda", "12.6")
    monkeypatch.setattr(cuda, "is_available", lambda: fake.usable)
    monkeypatch.setattr(cuda, "device_count", lambda: len(fake.capabilities))
    monkeypatch.setattr(cuda, "get_device_name", lambda index: "A card")
    monkeypatch.setattr(cuda, "get_device_capability", lambda index: fake.capabilities[index])
    monkeypatch.setattr(cuda, "get_arch_list", lambda: fake.architectures)
    monkeypatch.setattr(cuda, "is_initialized", lambda: False)
    monkeypatch.setattr(availability, "why_unusable", availability.why_unusable.__wrapped__)
    monkeypatch.setattr(availability, "_driver", lambda: fake.driver)
    monkeypatch.setitem(sys.modules, "cuda.bindings.driver", SimpleNamespace())
    return fake


def chosen(text: str | None = None) -> tuple[str, list[str]]:
    notes: list[Message] = []
    return str(ops.resolve_device(text, notes.append)), list(map(str, notes))


def refused(text: str) -> str:
    with pytest.raises(UserError) as error:
        ops.resolve_device(text)
    return str(error.value)


def test_a_gpu_is_the_default(monkeypatch):
    assert chosen() == ("cuda:0", [])
    assert ops.default_device() == torch.device("cuda", 0)
    assert chosen("cpu") == chosen("cpu:0") == ("cpu", [])
    assert chosen("cuda") == ("cuda:0", [])
    assert chosen("cuda:1") == ("cuda:1", [])
    monkeypatch.setattr(torch.cuda, "is_initialized", lambda: True)
    monkeypatch.setattr(torch.cuda, "current_device", lambda: 1)
    assert chosen() == chosen("cuda") == ("cuda:1", [])


def test_the_environment_sets_the_default(monkeypatch):
    monkeypatch.setenv("SNOWSPLAT_DEVICE", "cpu")
    assert chosen() == ("cpu", [])
    assert chosen("cuda:1") == ("cuda:1", [])
    monkeypatch.setenv("SNOWSPLAT_DEVICE", "cuda:2")
    with pytest.raises(UserError) as error:
        chosen()
    assert str(error.value) == (
        "SNOWSPLAT_DEVICE=cuda:2: there is no cuda:2; this machine has cuda:0 to cuda:1; "
        "set it to cpu to use the CPU"
    )
    monkeypatch.setenv("SNOWSPLAT_DEVICE", "")
    assert chosen() == ("cuda:0", [])


@pytest.mark.parametrize("text", ["gpu", "mps", "cuda:x", "cuda:-1", "", "0"])
def test_unsupported_devices(text):
    assert refused(text) == f"--device {text}: unsupported device; use cpu, cuda, cuda:1 or webgpu"


def test_no_message_without_a_gpu(machine):
    machine.usable = False
    for driver in (None, SimpleNamespace(error=availability._NO_DEVICE, cuda=(12, 4))):
        machine.driver = driver
        assert chosen() == ("cpu", [])
    assert refused("cuda") == (
        "--device cuda: the driver finds no NVIDIA GPU; leave --device out to use the CPU"
    )
    machine.driver = None
    assert refused("cuda:0") == (
        "--device cuda:0: there is no NVIDIA driver; install one if there is an NVIDIA GPU; "
        "leave --device out to use the CPU"
    )


def unused(reason: str) -> None:
    """The CPU is used, with the reason in a line; requesting the GPU is an error."""
    line = f"the GPU cannot be used: {reason}; computing on the CPU"
    assert chosen() == ("cpu", [line])
    assert "\n" not in line
    assert ops.default_device() == torch.device("cpu")
    assert refused("cuda") == f"--device cuda: {reason}; leave --device out to use the CPU"


def test_torch_without_cuda(machine, monkeypatch):
    monkeypatch.setattr(torch.version, "cuda", None)
    unused("this PyTorch is built without CUDA; install one with it (see pytorch.org)")
    machine.driver = None
    assert chosen() == ("cpu", [])


def test_too_old_a_driver(machine):
    machine.usable, machine.driver.cuda = False, (11, 4)
    unused(
        "the NVIDIA driver is too old: it supports CUDA 11.4 and this PyTorch needs 12.6; update "
        "the driver, or install a PyTorch for an older CUDA (see pytorch.org)"
    )


def test_a_driver_that_fails(machine):
    machine.usable, machine.driver.error = False, 999
    unused("the NVIDIA driver fails (error 999); restart the machine or reinstall it")


def test_the_message_of_torch_is_reported(machine, monkeypatch):
    def unavailable() -> bool:
        warnings.warn("CUDA: it is\nbroken (Triggered internally at x.cpp:1.)", stacklevel=1)
        return False

    monkeypatch.setattr(torch.cuda, "is_available", unavailable)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        unused("PyTorch cannot use it: CUDA: it is broken")
    machine.usable = False
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    unused("PyTorch cannot use it: torch.cuda.is_available() is false")


@pytest.mark.parametrize("capability", [(5, 2), (6, 1), (6, 2)])
def test_too_old_a_gpu(capability, machine):
    machine.capabilities[0] = capability
    unused(TOO_OLD.replace("6.1", f"{capability[0]}.{capability[1]}"))
    assert chosen("cuda:1") == ("cuda:1", [])


@pytest.mark.parametrize(
    ("capability", "architectures", "runs"),
    [
        ((12, 0), ["sm_80", "sm_90"], False),
        ((7, 0), ["sm_70", "sm_90"], True),
        ((7, 0), ["sm_75", "sm_90"], False),
        ((12, 0), ["sm_80", "sm_90", "compute_90"], True),
        ((8, 9), ["sm_80"], True),
        ((8, 0), ["sm_86", "compute_90"], False),
        ((9, 0), ["sm_90a"], True),
        ((10, 3), ["sm_75", "sm_100", "sm_120"], True),
        ((12, 1), ["sm_120"], True),
        ((8, 6), [], True),
    ],
)
def test_a_gpu_that_this_torch_does_not_support(capability, architectures, runs, machine):
    machine.capabilities, machine.architectures = [capability], architectures
    if runs:
        assert chosen() == ("cuda:0", [])
    else:
        shown = f"A card (compute capability {capability[0]}.{capability[1]})"
        unused(
            f"this PyTorch, for CUDA 12.6, has no kernels for {shown}; "
            "install another PyTorch (see pytorch.org)"
        )


def test_a_missing_device(machine):
    machine.capabilities = [(8, 6)]
    assert "there is no cuda:1; this machine has only cuda:0;" in refused("cuda:1")


def test_without_the_bindings(monkeypatch):
    plain = importlib.import_module

    def missing(name: str, package: str | None = None):
        if name.startswith("cuda."):
            raise ModuleNotFoundError(name)
        return plain(name, package)

    monkeypatch.setattr(importlib, "import_module", missing)
    unused("the package cuda-bindings is missing: pip install cuda-bindings")


def test_the_driver_is_queried_directly(monkeypatch):
    monkeypatch.undo()
    query = availability._driver.__wrapped__

    class Library:
        def __init__(self, error: int) -> None:
            self.cuInit = lambda flags: error

        def cuDriverGetVersion(self, version) -> int:
            version._obj.value = 12080
            return 0

    for error, there in ((0, True), (100, True), (999, True), (34, False)):
        monkeypatch.setattr(availability.ctypes, "CDLL", lambda name, e=error: Library(e))
        driver = query()
        assert (driver is not None) == there
        if driver is not None:
            assert (driver.error, driver.cuda) == (error, (12, 8))
        monkeypatch.setattr(availability, "_driver", lambda found=driver: found)
        assert availability.has_gpu() == (error in (0, 999))

    def absent(name: str) -> None:
        raise OSError(f"{name}: cannot open shared object file")

    monkeypatch.setattr(availability.ctypes, "CDLL", absent)
    assert query() is None


def test_the_inventory_of_a_machine(machine, monkeypatch):
    memory = SimpleNamespace(total_memory=16 << 30)
    monkeypatch.setattr(torch.cuda, "get_device_properties", lambda index: memory, raising=False)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda index: (15 << 30, 16 << 30))
    machine.capabilities = [(7, 0), (6, 1)]
    found = availability.inventory()
    assert json.loads(json.dumps(found)) == found
    first, second = found["devices"]
    assert first == {
        "name": "A card",
        "compute_capability": "7.0",
        "memory_bytes": 16 << 30,
        "free_bytes": 15 << 30,
        "why_unused": None,
    }
    assert second["why_unused"] == TOO_OLD
    assert (found["has_gpu"], found["why_unused"], found["driver_cuda"]) == (True, None, "12.4")
    machine.usable, machine.driver = False, None
    found = availability.inventory()
    assert (found["devices"], found["has_gpu"], found["driver_cuda"]) == ([], False, None)
    assert "no NVIDIA driver" in found["why_unused"]


def test_the_name_of_a_device():
    assert ops.device_name(torch.device("cuda", 1)) == "A card (cuda:1)"
    assert f"{ops.get_num_threads()} threads" in ops.device_name(torch.device("cpu"))
