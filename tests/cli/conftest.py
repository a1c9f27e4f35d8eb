"""The command line, called in this process or as a separate one."""

import functools
import subprocess
from collections.abc import Callable
from dataclasses import dataclass

import pytest

from snowsplat import extras
from snowsplat.cli.main import main

from ..fork_server import Process, popen

extras.register()


@dataclass
class Result:
    code: int
    out: str
    err: str


@pytest.fixture
def run(capsys) -> Callable[..., Result]:
    """Call the command with some arguments."""

    def run(*arguments: object) -> Result:
        capsys.readouterr()
        try:
            code = main([str(argument) for argument in arguments])
        except SystemExit as ended:  # tyro: help, or invalid flags
            code = int(ended.code or 0)
        captured = capsys.readouterr()
        return Result(code, captured.out, captured.err)

    return run


@pytest.fixture
def refused(run) -> Callable[..., str]:
    """Call the command with invalid input; returns its one-line error."""

    def refused(*arguments: object) -> str:
        result = run(*arguments)
        assert result.code == 2
        lines = result.err.splitlines()
        assert len(lines) == 1, result.err
        assert lines[0].startswith("snowsplat: ")
        return lines[0]

    return refused


@pytest.fixture
def start() -> Callable[..., Process | subprocess.Popen]:
    """Start the command as a separate process."""
    return functools.partial(popen, "-m", "snowsplat")
