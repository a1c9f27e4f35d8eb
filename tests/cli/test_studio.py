"""`snowsplat studio`: prints the address of the page, ends on Ctrl-C, and needs no torch."""

import json
import re
import signal
import subprocess
import sys
import urllib.request

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
    assert "file" in refused("studio", tmp_path / "file", "--no-browser")


def test_the_server_has_no_torch():
    modules = "snowsplat.cli.studio, snowsplat.studio.app, snowsplat.viewer.http.server"
    code = f"import sys, {modules}; print('torch' in sys.modules, 'cv2' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True)
    assert done.stdout == b"False False\n"
