"""The output on terminals and pipes that cannot show all characters."""

import io
import sys

import pytest

from snowsplat.cli.main import accept_all_characters, main, similar
from snowsplat.cli.subcommands import SUBCOMMANDS


@pytest.fixture
def terminal(monkeypatch):
    """``terminal(encoding)`` replaces stdout and stderr, and returns what is written to both."""

    def terminal(encoding: str) -> io.BytesIO:
        written = io.BytesIO()
        for name in ("stdout", "stderr"):
            stream = io.TextIOWrapper(written, encoding, "strict", write_through=True)
            monkeypatch.setattr(sys, name, stream)
        return written

    return terminal


@pytest.mark.parametrize("encoding", ["ascii", "cp437"])
def test_every_help_text(terminal, encoding):
    written = terminal(encoding)
    assert main(["--help"]) == 0
    for name in SUBCOMMANDS:
        with pytest.raises(SystemExit) as ended:
            main([name, "--help"])
        assert ended.value.code == 0
    text = written.getvalue().decode(encoding)
    assert "[MORE ...] FILE" in text
    assert "\\u" not in text


def test_an_error_names_a_file_unmistakably(terminal):
    written = terminal("ascii")
    assert main(["info", "Größe.ply"]) == 2
    assert written.getvalue().startswith(rb"snowsplat: Gr\xf6\xdfe.ply: no such file")


def test_similar_characters(terminal):
    written = terminal("latin-1")
    accept_all_characters()
    print("│ 2 × 3 – 4 … ≤ 5 → m² −½ 本 │")
    assert written.getvalue() == b"| 2 \xd7 3 - 4 ... <= 5 -> m\xb2 -\xbd \\u672c |\n"
    assert "".join(map(similar, "2 × 3 · ½ m² ±1 ╭─╮")) == "2 x 3 * 1/2 m2 +/-1 +-+"
