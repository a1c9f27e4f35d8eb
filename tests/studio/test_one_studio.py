"""One studio per library."""

import os
import socket
import threading

import pytest

from snowsplat.studio.one_studio import Address, Running, _address_in, only_studio, write_address
from snowsplat.util.run_lock import InUse


def test_one_that_does_not_answer_is_named(tmp_path):
    def second():
        with only_studio(tmp_path, wait=0.0):
            pass

    with only_studio(tmp_path):
        with pytest.raises(InUse, match=f"in use by process {os.getpid()}"):
            second()
        # Nobody listens at port 1.
        write_address(tmp_path, Address("http://127.0.0.1:1/x/", "127.0.0.1", 1, "x", [], ""))
        with pytest.raises(InUse, match="in use by process"):
            second()
    assert list(tmp_path.iterdir()) == []


def test_an_address_that_others_may_have_written(tmp_path):
    address = Address("http://127.0.0.1:1/x/", "127.0.0.1", 1, "x", [], "")
    write_address(tmp_path, address)
    assert _address_in(tmp_path) == address
    (tmp_path / ".studio.json").rename(tmp_path / "elsewhere")
    (tmp_path / ".studio.json").symlink_to(tmp_path / "elsewhere")
    assert _address_in(tmp_path) is None
    (tmp_path / ".studio.json").unlink()
    (tmp_path / ".studio.json").write_text("{}")
    assert _address_in(tmp_path) is None


def test_requests_to_this_computer_go_past_proxies(studio, monkeypatch):
    """Nobody listens at port 1."""
    monkeypatch.setenv("http_proxy", "http://127.0.0.1:1")
    url, token = studio.server.url, studio.server.token
    address = Address(url, "127.0.0.1", studio.server.port, token, [], "")
    assert address.answers(studio.library.folder)
    assert not address.answers(studio.library.folder.parent)
    with only_studio(studio.library.folder):
        write_address(studio.library.folder, address)
        with pytest.raises(Running) as running, only_studio(studio.library.folder):
            pass
    assert running.value.address == address


def test_another_program_at_the_port_of_one_that_was_killed(tmp_path):
    """It does not get the token; and what is no answer is not that of a studio."""
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        address = Address(f"http://127.0.0.1:{port}/x/", "127.0.0.1", port, "x", [], "")
        write_address(tmp_path, address)
        with only_studio(tmp_path):
            pass
        other.setblocking(False)
        with pytest.raises(BlockingIOError):
            other.accept()
        other.setblocking(True)

        def answer():
            with other.accept()[0] as asked:
                asked.recv(1000)
                asked.sendall(b"SSH-2.0-OpenSSH\r\n")

        answering = threading.Thread(target=answer)
        answering.start()
        assert not address.answers(tmp_path)
        answering.join()
