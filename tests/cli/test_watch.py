"""`snowsplat watch`, and `--view` of `train` and `make`: errors, printed addresses, Ctrl-C."""

import signal
import socket
import urllib.error
import urllib.request
from pathlib import Path

import pytest

from ..ports import unused_port


@pytest.fixture(scope="module")
def trained(dataset, tmp_path_factory) -> Path:
    """Checkpoints of step 20 and 40, scenes of 20 and 50."""
    from snowsplat.cli.main import main

    out = tmp_path_factory.mktemp("watch") / "out"
    flags = ["--iterations", "50", "--checkpoint-every", "20", "--save-iterations", "20", "-q"]
    assert main(["train", str(dataset), "-o", str(out), *flags]) == 0
    return out


def url_of(process) -> str:
    """The address of the page, from the output of a process."""
    while line := process.stdout.readline():
        if line.startswith("watch it in a browser: "):
            return line.split()[-1]
    raise AssertionError(process.communicate())


def page_at(url: str) -> bytes:
    with urllib.request.urlopen(url, timeout=10) as page:
        return page.read()


def test_watch_until_ctrl_c(start, trained):
    process = start("watch", trained)
    url = url_of(process)
    assert url.startswith("http://127.0.0.1:")
    assert process.stdout.readline() == "Ctrl-C ends it\n"
    assert b"<title>out - snowsplat</title>" in page_at(url)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")


def test_errors(refused, trained, tmp_path):
    assert "no such folder" in refused("watch", tmp_path / "absent")
    assert "one output folder" in refused("watch")
    (tmp_path / "empty").mkdir()
    assert "not the output folder" in refused("watch", tmp_path / "empty")
    assert "no scene of iteration 7" in refused("watch", trained, "--iteration", 7)
    assert "no such folder" in refused("watch", trained, "-s", tmp_path / "absent")
    assert "--host: cannot listen at 192.0.2.1" in refused("watch", trained, "--host", "192.0.2.1")


def test_a_port_in_use(refused, trained, dataset, tmp_path):
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        assert f"--port: {port} is in use" in refused("watch", trained, "--port", port)
        out = tmp_path / "out"
        line = refused("train", dataset, "-o", out, "--view", "--port", port)
        assert f"--port: {port} is in use" in line
        line = refused("make", dataset / "images", "-o", out, "--view", "--port", port)
        assert f"--port: {port} is in use" in line
        assert not out.exists()


def test_host_and_port_need_view(refused, dataset, tmp_path):
    for flags in (["--port", 9000], ["--host", "0.0.0.0"], ["--allow-host", "a.example"]):
        if flags[0] != "--port":  # of scripts for the reference implementation, see there
            assert "add --view" in refused("train", dataset, "-o", tmp_path / "out", *flags)
        assert "add --view" in refused("make", dataset / "images", "-o", tmp_path / "out", *flags)


def test_the_page_of_a_training_run_stays_until_ctrl_c(start, run, dataset, tmp_path):
    viewed, plain = tmp_path / "viewed", tmp_path / "plain"
    port = unused_port()
    process = start("train", dataset, "-o", viewed, "--iterations", 30, "--view", "--port", port)
    url = url_of(process)
    while not (line := process.stdout.readline()).startswith("the scene is shown at"):
        assert line
    assert b"<html" in page_at(url)
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=60)
    assert (process.returncode, err) == (0, "")
    assert run("train", dataset, "-o", plain, "--iterations", 30).code == 0
    name = "point_cloud/iteration_30/point_cloud.ply"
    assert (viewed / name).read_bytes() == (plain / name).read_bytes()
