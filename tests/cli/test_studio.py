"""`snowsplat studio`: prints the address of the page, ends on Ctrl-C, and needs no torch."""

import json
import os
import re
import signal
import subprocess
import sys
import urllib.request
from pathlib import Path

import pytest

from ..fork_server import ENVIRONMENT


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_serves_until_a_signal(start, tmp_path, number):
    process = start("studio", tmp_path / "scenes", "--no-browser")
    assert process.stdout.readline() == f"scenes are kept in {tmp_path / 'scenes'}\n"
    url = re.search(r"http://127\.0\.0\.1:\S+", process.stdout.readline())[0]
    with urllib.request.urlopen(url, timeout=10) as page:
        assert b"<title>snowsplat studio</title>" in page.read()
    with urllib.request.urlopen(f"{url}scenes", timeout=10) as scenes:
        assert json.loads(scenes.read()) == []
    process.send_signal(number)
    assert process.wait(10) == 0
    assert process.stderr.read() == ""


def test_a_folder_that_is_a_file(refused, tmp_path):
    (tmp_path / "file").touch()
    assert "drop it on the page" in refused("studio", tmp_path / "file", "--no-browser")


def test_the_server_has_no_torch():
    modules = "snowsplat.cli.studio, snowsplat.studio.app, snowsplat.viewer.http.server"
    code = f"import sys, {modules}; print('torch' in sys.modules, 'cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True)
    assert done.stdout == b"False False\n"


def address_in(process: subprocess.Popen[str]) -> str:
    lines = process.stdout.readline() + process.stdout.readline()
    return re.search(r"http://127\.0\.0\.1:\S+", lines)[0]


def test_a_second_studio_opens_the_first(start, refused, tmp_path):
    """Also by another path; with other settings, it says why not."""
    scenes, other = tmp_path / "scenes", tmp_path / "other"
    first = start("studio", scenes, "--no-browser")
    url = address_in(first)
    other.symlink_to(scenes)
    second = start("studio", other, "--no-browser")
    assert address_in(second) == url
    assert second.wait(10) == 0
    assert "end that one with Ctrl-C" in refused("studio", scenes, "--port", "1024")
    if hasattr(os, "getuid"):  # it has the token
        address = scenes / ".studio.json"
        opener = Path(json.loads(address.read_text())["opener"])
        for file in (address, opener, opener.parent):
            assert file.stat().st_mode & 0o77 == 0
        assert url in opener.read_text()
    first.send_signal(signal.SIGINT)
    assert first.wait(10) == 0
    assert list(scenes.iterdir()) == []
    assert not opener.parent.exists()


def test_each_start_has_a_new_token(start, tmp_path):
    first = start("studio", tmp_path, "--no-browser")
    url = address_in(first)
    first.kill()
    first.wait()
    again = start("studio", tmp_path, "--no-browser")
    assert address_in(again).split("/")[3] != url.split("/")[3]
    again.send_signal(signal.SIGINT)
    assert again.wait(10) == 0
