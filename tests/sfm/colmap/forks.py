"""Starts the child processes of COLMAP as forks of a process that has loaded their modules."""

import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace

import pytest

from snowsplat.sfm.colmap.process import child

from ... import fork_server


def _popen(command, *, env, stdin, stdout, stderr, text, encoding):
    assert (stdout, text, encoding) == (subprocess.PIPE, True, "utf-8")
    return fork_server.popen(*command[1:], env=env, stdin=stdin, stderr=stderr.fileno())


@contextmanager
def children_in_forks() -> Iterator[None]:
    """In this context, child processes are forks: a fork takes a fifth of the time of a new one.

    Tests of the child process itself and of the command line start new processes.
    """
    with pytest.MonkeyPatch.context() as patch:
        started = SimpleNamespace(Popen=_popen, PIPE=subprocess.PIPE)
        patch.setattr(child, "subprocess", started)
        yield
