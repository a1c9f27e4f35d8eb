"""The messages of the program: each has a Chinese text with the same values."""

import ast
import logging
import os
import pickle
import re
import string
import subprocess
import sys
from pathlib import Path

import pytest

from snowsplat.util import messages
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import Message, message, plural

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / "src" / "snowsplat"
FOLDER = SOURCE / "locale" / "zh"


@pytest.fixture(scope="module")
def tool():
    pytest.importorskip("babel", reason="needs Babel (make dev installs it)")
    sys.path.insert(0, str(ROOT / "tools"))
    try:
        import update_messages
    finally:
        sys.path.remove(str(ROOT / "tools"))
    return update_messages


@pytest.fixture(scope="module")
def keys(tool) -> set:
    return {key for _, key in tool.messages_of()}


def fields(text: str) -> list[str]:
    """The fields {name:…} of a text, and those of logging: "%d"."""
    named = [name for _, name, _, _ in string.Formatter().parse(text) if name is not None]
    return sorted(named) or re.findall(r"%[^%\w]*[.\d]*[a-z]", text.replace("%%", ""))


def test_every_message_has_a_chinese_text_with_the_same_values(tool, keys):
    catalogue = tool.translations(FOLDER)
    assert len(keys) > 400  # they are found
    wrong = []
    for key in keys:
        first = key if isinstance(key, str) else key[-1]
        entry = catalogue.get(key if isinstance(key, str) else key[0])
        texts = (
            []
            if entry is None
            else [entry.string]
            if isinstance(entry.string, str)
            else entry.string
        )
        if not texts or any(fields(text) != fields(first) for text in texts):
            wrong.append(key)
    assert wrong == [], "run make messages, and translate these"


def test_no_chinese_text_is_left_of_a_message_that_does_not_exist(tool, keys):
    known = {key if isinstance(key, str) else key[0] for key in keys}
    found = {
        each.id if isinstance(each.id, str) else each.id[0]
        for each in tool.translations(FOLDER)
        if each.id
    }
    assert sorted(found - known) == [], "run make messages"


def test_the_text_of_a_message_is_a_template(tool):
    """Neither an f-string, whose values are lost, nor an error that is rendered too early."""
    keywords, wrong = tool.keywords(SOURCE), []
    for file in SOURCE.rglob("*.py"):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            if not isinstance(node, ast.Call):
                continue
            name = getattr(node.func, "id", getattr(node.func, "attr", ""))
            if name in ("warning", "info") or name not in {*keywords, "Reason", "note"}:
                continue
            if getattr(getattr(node.func, "value", None), "id", "") == "cut":  # not for people
                continue
            for each in node.args:
                rendered = isinstance(each, ast.Call) and getattr(each.func, "id", "") == "str"
                if isinstance(each, ast.JoinedStr) or rendered:
                    wrong.append(f"{file.relative_to(SOURCE)}:{node.lineno}")
    assert wrong == []


def test_the_texts_of_all_errors_are_messages(tool):
    """Also of errors that are derived from others: Damaged, of Unsupported, of UserError."""
    keywords = tool.keywords(SOURCE)
    assert keywords["Damaged"] == keywords["UserError"]
    assert keywords["_InUse"] == keywords["SettingError"]


def test_values_are_rendered_in_the_language_of_the_message(chinese):
    inner = UserError("{path}: is a file; use a folder", path=Path("a"))
    outer = message("{error} ({share:.1f}%), {names}", error=inner, share=12.345, names=["x", "y"])
    assert str(outer) == "a: is a file; use a folder (12.3%), x, y"
    assert outer.text("zh") == "a：文件，请用文件夹；12.3；x, y"


@pytest.fixture
def chinese(monkeypatch):
    """A small Chinese catalogue."""
    texts = {
        "{path}: is a file; use a folder": "{path}：文件，请用文件夹",
        "{error} ({share:.1f}%), {names}": "{error}；{share:.1f}；{names}",
        "%s is old": "%s 太旧",
        "{n} photo": "{n} 张照片",
    }

    class Catalogue(messages.gettext.NullTranslations):
        def gettext(self, text):
            return texts.get(text, text)

        def ngettext(self, one, many, n):
            return texts.get(one, one)

    english = messages.gettext.NullTranslations()
    monkeypatch.setattr(
        messages, "_catalogue", lambda lang: Catalogue() if lang == "zh" else english
    )


def test_plural(chinese):
    one, many = plural("{n} photo", "{n} photos", n=1), plural("{n} photo", "{n} photos", n=2)
    assert (str(one), str(many), many.text("zh")) == ("1 photo", "2 photos", "2 张照片")


def test_a_text_without_values_may_have_braces():
    assert str(UserError('write {"iterations": 3000}')) == 'write {"iterations": 3000}'


def test_a_value_is_never_a_template():
    assert str(message("{name}: missing", name="{key.__class__}")) == "{key.__class__}: missing"
    with pytest.raises(KeyError):
        str(message("{name.__class__}", name="a"))


def test_json_keeps_key_and_values(chinese):
    told = message(
        "{error} ({share:.1f}%), {names}", error=OSError("full"), share=1.0, names=[Path("b")]
    )
    read = Message.from_json(told.as_json())
    assert read.in_all_languages() == {"en": "full (1.0%), b", "zh": "full；1.0；b"}
    again = plural("{n} photo", "{n} photos", n=2)
    assert Message.from_json(again.as_json()).text("zh") == "2 张照片"


@pytest.mark.parametrize(
    "json",
    [None, "text", {"key": "a"}, {"key": 1, "values": {}}, {"key": "a", "values": {}, "many": "b"}],
)
def test_other_json_is_no_message(json):
    with pytest.raises(ValueError, match="not a message"):
        Message.from_json(json)


def test_errors_survive_pickle():
    error = pickle.loads(pickle.dumps(SettingError("port", "{port} is in use", port=80)))
    assert (error.setting, str(error)) == ("port", "port: 80 is in use")
    assert str(pickle.loads(pickle.dumps(UserError("{a}: no", a=1)))) == "1: no"


@pytest.mark.parametrize(
    ("environment", "expected"),
    [
        ({}, "en"),
        ({"LANG": "zh_CN.UTF-8"}, "zh"),
        ({"LANG": "zh_CN.UTF-8", "LC_ALL": "C"}, "en"),
        ({"LANG": "C.UTF-8", "LANGUAGE": "zh_TW:en"}, "zh"),
        ({"LANG": "de_DE.UTF-8"}, "en"),
    ],
)
def test_language_of_the_environment(environment, expected):
    assert messages.language_of_environment(environment) == expected


def test_the_command_line_speaks_chinese(tmp_path):
    command = [sys.executable, "-m", "snowsplat", "info", str(tmp_path / "none")]
    done = subprocess.run(
        command, env={**_environment(), "LANG": "zh_CN.UTF-8"}, capture_output=True, text=True
    )
    assert done.returncode == 2
    assert re.search(r"[一-鿿]", done.stderr), done.stderr
    assert "none" in done.stderr


def _environment() -> dict[str, str]:
    return {
        name: value for name, value in os.environ.items() if not name.startswith(("LC_", "LANG"))
    }


def test_lines_of_the_log_are_translated(chinese, monkeypatch, capsys):
    from snowsplat.cli.main import _LogHandler

    monkeypatch.setattr(messages, "_current", "zh")
    _LogHandler().emit(
        logging.LogRecord("snowsplat", logging.WARNING, "", 0, "%s is old", ("a",), None)
    )
    assert capsys.readouterr().err == "snowsplat: a 太旧\n"
