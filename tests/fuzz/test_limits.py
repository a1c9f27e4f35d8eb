"""`guarded` detects readers that exceed a limit."""

import subprocess
import sys
import time

import pytest
import torch

from snowsplat.util.errors import UserError

from .limits import MEMORY, Broken, guarded


def refuse(line: str) -> None:
    raise UserError(line)


def compute_forever() -> None:
    while True:
        pass


def evaluate(text: str) -> None:
    subprocess.run([sys.executable, "-c", text], check=True)


BROKEN = {
    "takes more than 0.05": lambda home: compute_forever(),
    "takes more": lambda home: time.sleep(60),
    "for a file of": lambda home: bool(torch.ones(2 * MEMORY, dtype=torch.uint8).sum()),
    "opened": lambda home: (home.parent / "secret").read_bytes(),
    "subprocess.Popen": lambda home: evaluate("pass"),
    "long message: 'two": lambda home: refuse("two\nlines"),
    "long message: 'aaa": lambda home: refuse("a" * 5000),
}


@pytest.mark.parametrize("what", BROKEN)
def test_a_reader_that_exceeds_a_limit_is_detected(tmp_path, monkeypatch, what):
    if what.startswith("takes more"):
        monkeypatch.setattr("tests.fuzz.limits.SECONDS", 0.05)
    home = tmp_path / "home"
    home.mkdir()
    (tmp_path / "secret").write_text("x")
    with pytest.raises(Broken, match=what):
        guarded(lambda: BROKEN[what](home), home, 100)


def test_a_reader_within_the_limits_passes(tmp_path):
    (tmp_path / "a").write_text("x")
    assert guarded(lambda: (tmp_path / "a").read_text(), tmp_path, 100) == "x"
    assert isinstance(guarded(lambda: refuse("no"), tmp_path, 100), UserError)
    large = guarded(lambda: torch.ones(2 * MEMORY, dtype=torch.uint8), tmp_path, 100)
    assert large.nbytes == 2 * MEMORY  # the size of the result is allowed
    with pytest.raises(ZeroDivisionError):
        guarded(lambda: 1 // 0, tmp_path, 100)
