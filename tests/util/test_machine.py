"""The description of the machine."""

import contextlib
import getpass
import os
import platform

from snowsplat.util.machine import memory_bytes, processor_name, system_name


def test_machine():
    assert len(processor_name()) > 3
    assert processor_name() == processor_name().strip()
    assert memory_bytes() == 0 or memory_bytes() > 1 << 28
    assert system_name().startswith(platform.system())
    assert platform.python_version().startswith(system_name().split()[-1])


def test_no_user_or_host_name():
    text = f"{processor_name()} {system_name()}"
    names = [platform.node(), os.environ.get("HOSTNAME", "")]
    with contextlib.suppress(OSError, KeyError):
        names.append(getpass.getuser())
    assert not [name for name in names if len(name) > 3 and name in text]
