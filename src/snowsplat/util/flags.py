"""`flags_of`: the arguments and flags of a class of settings, as they are declared in its fields.

The command line parses them (`snowsplat.cli.parser`); `command_line` writes them.
"""

import re
import shlex
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import MISSING, dataclass, fields, replace
from functools import cache
from types import NoneType
from typing import Any, Literal, Optional, TypeVar, get_origin

from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import as_message
from snowsplat.util.settings import Setting, Settings, declarations, kinds_of

_Settings = TypeVar("_Settings", bound=Settings)
_SETTING = re.compile(r"`([a-z][a-z0-9_]*)`")
_BY_RECIPE = "set by the recipe"


@dataclass(frozen=True)
class Flag:
    """A setting that is an argument or a flag.

    Attributes:
        name: that of the setting, with the prefix of its class: "max_gaussians".
        path: the fields that lead to it.
        hint: the type of its value.
        declared: its declaration.
        default: what it is if it is not given, in words; "": nothing.
    """

    name: str
    path: tuple[str, ...]
    hint: Any
    declared: Setting
    default: str

    @property
    def key(self) -> str:
        """Its name in the command line, with "_" in the place of "-"."""
        return self.declared.name or self.name

    @property
    def spellings(self) -> tuple[str, ...]:
        """All spellings of the flag, with "-" in the place of "_"; none if it is an argument."""
        if self.declared.argument:
            return ()
        return ("--" + self.key.replace("_", "-"), *self.declared.aliases)

    @property
    def type(self) -> Any:
        """The type of its value in the command line."""
        if self.declared.metavar == "":
            return bool
        kinds = [kind for kind in kinds_of(self.hint) if kind is not NoneType]
        kind = str if self.declared.parse else Literal["on", "off"] if kinds == [bool] else None
        return self.hint if kind is None else Optional[kind]  # noqa: UP045 (at run time)

    @property
    def is_list(self) -> bool:
        """Whether it has any number of values."""
        return get_origin(self.hint) is tuple and Ellipsis in self.hint.__args__

    def value(self, given: Any) -> Any:
        """The setting of a value in the command line.

        Raises: SettingError: it is not valid.
        """
        if self.declared.metavar == "":
            return self.declared.means
        try:
            if self.declared.parse:
                return self.declared.parse(given)
        except ValueError as error:
            raise SettingError(self.key, as_message(error)) from None
        return given == "on" if self.type == Optional[Literal["on", "off"]] else given  # noqa: UP045


def flags_of(kind: type) -> tuple[Flag, ...]:
    """The arguments and flags of a class of settings, in the order of its fields.

    Those of a base class come after those of the class itself.
    """
    return _known_flags(kind)


@cache
def _known_flags(kind: type) -> tuple[Flag, ...]:
    own = {name for base in kind.__mro__[1:] for name in getattr(base, "__annotations__", ())}
    ordered = sorted(declarations(kind), key=lambda each: each[0] in own)
    values = {each.name: each.default for each in fields(kind)}
    return tuple(
        flag
        for name, hint, declared in ordered
        for flag in _flags(name, hint, declared, values[name])
    )


def _flags(name: str, hint: Any, declared: Setting, value: Any) -> Iterator[Flag]:
    if declared.metavar is not None:
        default = declared.default
        if default is None:
            items = value if isinstance(value, tuple) else [value]
            default = "" if value in (None, False, "", MISSING) else " ".join(map(_text, items))
        yield Flag(name, (name,), hint, declared, "" if declared.metavar == "" else default)
    seen = set[str]()
    for kind in declared.kinds:
        for flag in flags_of(kind):
            key = getattr(kind, "prefix", "") + flag.name
            if key in seen or (declared.only is not None and key not in declared.only):
                continue
            seen.add(key)
            about, help = flag.declared, flag.declared.help
            if isinstance(declared.only, Mapping):
                help = declared.only[key]
            if declared.action:
                help = f"{declared.action}: {help[:1].lower()}{help[1:]}"
            about = replace(about, help=help)
            if get_origin(hint) is None:
                yield replace(flag, path=(name, *flag.path), declared=about)
            else:
                default = _BY_RECIPE if about.default is None else about.default
                default = "" if about.metavar == "" else default
                yield Flag(key, (name, key), flag.hint, about, default)


def settings_from(kind: type[_Settings], given: Mapping[str, Any]) -> _Settings:
    """An object of a class of settings.

    ``given``: values of the command line, by the keys of the flags.

    Raises: UserError: a value is not valid, or one is missing.
    """
    values: dict[str, Any] = {}
    for flag in flags_of(kind):
        if flag.key in given:
            inner = values
            for name in flag.path[:-1]:
                inner = inner.setdefault(name, {})
            inner[flag.path[-1]] = flag.value(given[flag.key])
        elif flag.declared.needed is not None:
            raise UserError(flag.declared.needed)
    return _nested(kind, values)


def _nested(kind: type[_Settings], values: dict[str, Any]) -> _Settings:
    fields_of: type = kind
    hints = {name: hint for name, hint, _ in declarations(fields_of)}
    made = {
        name: _nested(hints[name], value)
        if isinstance(value, dict) and get_origin(hints[name]) is None
        else value
        for name, value in values.items()
    }
    return kind(**made)


def words(kind: type, given: Mapping[str, Any]) -> list[str]:
    """The words of a command line for values of it, by the keys of the flags; None: not given."""
    arguments, options = list[str](), list[str]()
    for flag in flags_of(kind):
        value = given.get(flag.key)
        if value is None or (flag.type is bool and not value):
            continue
        texts = [_text(each) for each in (value if isinstance(value, tuple | list) else [value])]
        if flag.declared.argument:
            arguments += texts
        elif flag.type is bool:
            options.append(flag.spellings[0])
        elif flag.declared.repeated:
            options += [word for text in texts for word in (flag.spellings[0], text)]
        else:
            options += [flag.spellings[0], *texts]
    return arguments + options


def command_line(name: str, *parts: Iterable[object]) -> str:
    """The text of a command line: the subcommand, and its words."""
    return shlex.join(["snowsplat", name, *(str(word) for part in parts for word in part)])


def with_flags(message: str, kind: type | None = None) -> str:
    """A message of the library for the command line: "use `overwrite`" -> "use --overwrite".

    ``kind``: the settings of the subcommand, whose flags may have other names.
    """
    names = {flag.name: flag.key for flag in flags_of(kind)} if kind is not None else {}

    def flag(match: re.Match[str]) -> str:
        return "--" + names.get(match[1], match[1]).replace("_", "-")

    return _SETTING.sub(flag, message)


def _text(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return re.sub(r"\.0$", "", str(value)) if isinstance(value, float) else str(value)
