"""The nightly scripts fit the code: they start; the files and texts that they name exist."""

import sys
from pathlib import Path

import pytest

from . import fork_server

NIGHTLY = Path(__file__).resolve().parent / "nightly"
NATIVE = Path(__file__).resolve().parents[1] / "src" / "snowsplat" / "native"


@pytest.mark.parametrize("script", sorted(path.name for path in NIGHTLY.glob("*.py")))
def test_every_script_starts(script):
    if script.startswith("mutate"):
        pytest.importorskip("libcst", reason="comes with the extra nightly")
    done = fork_server.run(NIGHTLY / script, "--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert "usage:" in done.stdout


@pytest.fixture
def nightly(monkeypatch):
    pytest.importorskip("mutmut", reason="comes with the extra nightly")
    monkeypatch.syspath_prepend(str(NIGHTLY))
    yield
    for name in [name for name in sys.modules if name.split(".")[0] in ("mutate", "mutation")]:
        del sys.modules[name]


def test_every_part_of_the_mutation_tests_has_files_and_tests(nightly, monkeypatch):
    import mutate

    for name in mutate.PARTS:
        assert mutate.files_of(name)
    monkeypatch.setitem(
        mutate.PARTS, "lost", mutate.Part(("ops/*.py", "core/*.py"), ("tests/a.py",))
    )
    with pytest.raises(SystemExit, match=r"core/\*\.py, tests/a\.py does not exist; change PARTS"):
        mutate.files_of("lost")


@pytest.fixture
def tables(monkeypatch):
    pytest.importorskip("tomllib", reason="needs Python 3.11")
    monkeypatch.syspath_prepend(str(NIGHTLY))
    from mutation import tables

    return tables


def test_every_fault_of_a_kernel_fits_its_source(tables):
    assert len(tables.FAULTS) > 60
    for fault in tables.FAULTS:
        assert (NATIVE / fault.file).read_text("utf-8").count(fault.was) == 1, fault.breaks
        assert (NIGHTLY.parent / "ops" / f"test_{fault.tests}.py").exists(), fault.tests


def test_every_fault_without_an_effect_names_a_file(tables):
    assert len(tables.EQUIVALENTS) > 10
    for name, _, _ in tables.EQUIVALENTS:
        assert (NATIVE.parent / name).exists(), name
