"""`Message`: a text for people in English or Chinese, rendered where it is shown.

    note = message("{photos} of {all} photos could not be placed", photos=3, all=36)
    str(note)                 # in the language of the program: see `use`
    note.text("zh")           # in another one

The key of a message is its English text, in which {name} stands for a value, with the format
specifications of `str.format`. The Chinese texts are in `locale/zh/*.po`, the format of gettext,
and the build compiles them to `_lib/zh.mo`. A text without a translation is shown in English.
`tests/test_messages.py` finds every key of the program in every language.

This module imports nothing slow.
"""

from __future__ import annotations

import gettext
import os
import string
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from functools import cache
from pathlib import Path
from typing import Any, Literal

Language = Literal["en", "zh"]
LANGUAGES: tuple[Language, ...] = ("en", "zh")

_COMPILED = Path(__file__).parent.parent / "_lib"
_current: Language = "en"


@dataclass(frozen=True)
class Message:
    """A text with values.

    Attributes:
        key: the English text.
        values: of its fields: texts, numbers, paths, and other messages or errors, which are
            rendered in the same language. The items of a list are joined by ", ". They are kept
            as values of JSON and messages.
        many: the English text if ``values["n"]`` is not 1; None: there is one text.
    """

    key: str
    values: Mapping[str, Any] = field(default_factory=dict)
    many: str | None = None

    def __post_init__(self) -> None:
        plain = {name: _plain(value) for name, value in self.values.items()}
        object.__setattr__(self, "values", plain)

    def __str__(self) -> str:
        return self.text(_current)

    def __hash__(self) -> int:
        return hash(self.key)

    def __bool__(self) -> bool:
        return bool(self.key)

    def text(self, language: Language) -> str:
        """The text in a language."""
        if self.many is None:
            template = _catalogue(language).gettext(self.key) if self.key else ""
        else:
            template = _catalogue(language).ngettext(self.key, self.many, self.values["n"])
        # Without values, a text of another library may have braces.
        return _Rendering(language).vformat(template, (), self.values) if self.values else template

    def as_json(self) -> dict[str, Any]:
        """JSON values, which `from_json` reads; the same as those of `dataclasses.asdict`."""
        return asdict(self)

    @classmethod
    def from_json(cls, json: Any) -> Message:
        """The message of `as_json`. Raises: ValueError: it is none."""
        match json:
            case {"key": str(key), "values": dict(values), "many": (None | str()) as many}:
                if len(json) == 3 and (many is None or isinstance(values.get("n"), int)):
                    return cls(key, {name: _read(value) for name, value in values.items()}, many)
        raise ValueError("not a message")

    def in_all_languages(self) -> dict[Language, str]:
        """The text in each language, for a page that chooses one."""
        return {language: self.text(language) for language in LANGUAGES}


def message(key: str, /, **values: Any) -> Message:
    """A message; see `Message`."""
    return Message(key, values)


def plural(one: str, many: str, /, *, n: int, **values: Any) -> Message:
    """A message whose English depends on a number: ``plural("{n} photo", "{n} photos", n=3)``."""
    return Message(one, {"n": n, **values}, many)


def as_message(text: object) -> Message:
    """A text of any origin: a message or its JSON, an error, or a text without values."""
    if isinstance(text, Message):
        return text
    if isinstance(text, dict):
        return Message.from_json(text)
    inner = getattr(text, "message", None) if isinstance(text, Exception) else None
    return inner if isinstance(inner, Message) else Message(str(text))


def use(language: Language) -> None:
    """Set the language of `str` of messages in this process. At first, it is English."""
    global _current
    _current = language


def language() -> Language:
    """The language of `str` of messages in this process."""
    return _current


def language_of_environment(environment: Mapping[str, str] = os.environ) -> Language:
    """The language that the variables LANGUAGE, LC_ALL, LC_MESSAGES and LANG choose (gettext)."""
    for name in ("LANGUAGE", "LC_ALL", "LC_MESSAGES", "LANG"):
        if chosen := environment.get(name):
            return "zh" if chosen.lower().startswith("zh") else "en"
    return "en"


class _Rendering(string.Formatter):
    """`str.format` that renders messages among the values in a language."""

    def __init__(self, language: Language) -> None:
        self._language = language

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Mapping[str, Any]) -> Any:
        # Only names: neither attributes nor items of the values.
        return self._rendered(kwargs[field_name]), field_name

    def _rendered(self, value: Any) -> Any:
        if isinstance(value, Message):
            return value.text(self._language)
        if isinstance(value, list):
            return ", ".join(str(self._rendered(item)) for item in value)
        return value


@cache
def _catalogue(language: Language) -> gettext.NullTranslations:
    file = _COMPILED / f"{language}.mo"
    if language == "en" or not file.is_file():
        return gettext.NullTranslations()
    with file.open("rb") as compiled:
        return gettext.GNUTranslations(compiled)


def _plain(value: Any) -> Any:
    """A value of JSON, or a message. Numbers of other libraries become those of Python."""
    if isinstance(value, Message | Exception):
        return as_message(value)
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if not isinstance(value, str | int | float | bool) and hasattr(value, "item"):
        value = value.item()
    return value if isinstance(value, str | int | float | bool) else str(value)


def _read(value: Any) -> Any:
    if isinstance(value, dict):
        return Message.from_json(value)
    return [_read(item) for item in value] if isinstance(value, list) else value
