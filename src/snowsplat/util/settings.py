"""How a setting is declared. Type, default, valid values, help and flag stand in its field.

    @dataclass(frozen=True)
    class Sharpening(Settings):
        strength: float = flag(0.5, "Weight of the sharpness.", least=0.0)

`Settings` checks the values when the object is created. The arguments and flags of the command line
(`snowsplat.util.flags`), their help texts, the values in files (`--config`) and the table in the
documentation are made from the same fields. This module imports nothing slow: neither torch nor
numpy.
"""

import math
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field, fields, replace
from difflib import get_close_matches
from functools import cache
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Literal, TypeVar, Union, get_args, get_origin, get_type_hints

from snowsplat.util.errors import Problem, SettingError
from snowsplat.util.messages import Message, as_message, message
from snowsplat.util.safe_json import printable

#: A moment of the training: a step (int), or a fraction of all steps (float).
When = int | float

#: Larger whole numbers do not fit into the 64 bits of tensors and kernels.
_LARGEST = 2**63 - 1
# Of `flag`: the placeholder says the type, which is known with the class.
_OF_TYPE = "TYPE"
_PLACEHOLDERS: dict[Any, str] = {bool: "{on,off}", int: "N", float: "F", str: "TEXT"}
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Setting:
    """What a field declares besides its type and its default."""

    # One or two sentences. Names of other settings are in backquotes.
    help: str = ""
    # least, most, above, below: limits of a number; ``above`` and ``below`` are not included. If a
    # value is a list, they are limits of its items.
    least: float | None = None
    most: float | None = None
    above: float | None = None
    below: float | None = None
    # The limit of a float, if the type is "a whole number or a fraction".
    largest_fraction: float = 1.0
    # What is valid, if the limits cannot say it, for a message: "use <allowed>".
    allowed: str | None = None
    # Called with a value of the declared type; returns what is wrong with it, or None.
    check: Callable[[Any], Message | str | None] | None = None
    # The placeholder of the value of the flag; "": a flag without a value; None: there is no flag.
    metavar: str | None = None
    aliases: tuple[str, ...] = ()  # other spellings of the flag
    default: str | None = None  # the default in the help text; None: the value, or that of a recipe
    name: str | None = None  # that of the flag, if it is not that of the field
    means: Any = True  # what a flag without a value stands for
    # Makes the value of the text of the flag; raises ValueError with what is wrong.
    parse: Callable[[str], Any] | None = None
    argument: bool = False  # it has no flag: it is known by its place in the command line
    repeated: bool = False  # the flag is given once for each item of the tuple
    needed: str | Message | None = (
        None  # the error if an argument or flag without a default is not given
    )
    # The classes whose settings are flags, too; those of `by_name` are the values of a mapping.
    kinds: tuple[type, ...] = ()
    only: Collection[str] | None = None  # of these settings; None: all; a mapping: to their helps
    action: str = ""  # what these flags are for, in front of their help texts: "plan"


_UNDECLARED = Setting()


def setting(value: _Value, help: str, flag: str | None = None, **declared: Any) -> _Value:
    """A field with the default ``value``.

    Args:
        help: see `Setting`.
        flag: the attribute ``default`` of `Setting`.
        declared: the other attributes of `Setting`.
    """
    metadata = {"setting": Setting(help, default=flag, **declared)}
    return field(default=value, metadata=metadata)


def flag(value: _Value, help: str, default: str | None = None, **declared: Any) -> _Value:
    """A field that is a flag, too; its placeholder is that of its type: N, F, TEXT, {on,off} …"""
    return setting(value, help, default, metavar=_OF_TYPE, **declared)


def part(kind: Callable[[], _Value], help: str, **declared: Any) -> _Value:
    """A field for settings that have a class of their own; the default is ``kind()``."""
    metadata = {"setting": Setting(help, **declared)}
    return field(default_factory=kind, metadata=metadata)


def switch(help: str, *aliases: str, **declared: Any) -> bool:
    """A flag without a value: False, unless it is given."""
    return setting(False, help, metavar="", aliases=aliases, **declared)


def argument(value: _Value, metavar: str, help: str, **declared: Any) -> _Value:
    """An argument of a command line, with the default ``value``."""
    return setting(value, help, metavar=metavar, argument=True, **declared)


def needed(error: str | Message, metavar: str, help: str, *aliases: str, **declared: Any) -> Any:
    """An argument or flag without a default; ``error`` says that it is missing."""
    about = Setting(help, metavar=metavar, aliases=aliases, needed=error, **declared)
    return field(metadata={"setting": about})


def group(
    kind: Callable[[], _Value], only: Collection[str] | None = None, action: str = ""
) -> _Value:
    """A field for the settings of a class, or ``only`` some of them, which are flags, too.

    ``action``: see `Setting`.
    """
    declared = Setting(kinds=(kind,), only=only, action=action)  # type: ignore[arg-type]
    return field(default_factory=kind, metadata={"setting": declared})


def by_name(*kinds: type, only: Collection[str] | None = None) -> Any:
    """A field for changed settings of some classes, name -> value; their flags change it.

    ``only``: some of them; or a mapping from these to their help texts here.
    """
    declared = Setting(kinds=kinds, only=only)
    return field(default_factory=dict, metadata={"setting": declared})


def same(kind: type, name: str, value: _Value, **changes: Any) -> _Value:
    """The field ``name`` of another class, with the default ``value``."""
    (known,) = (each for each in fields(kind) if each.name == name)
    declared = {**vars(known.metadata["setting"]), **changes}
    return field(default=value, metadata={"setting": Setting(**declared)})


class Settings:
    """The base of a frozen dataclass whose fields are settings.

    Numbers of NumPy become numbers of Python, and lists become tuples.

    Attributes:
        prefix: of the names by which `changed` and the flags know the fields: "lr_".

    Raises: SettingError: a value is invalid. The message is one line that names the setting, the
    value and what is allowed.
    """

    prefix: ClassVar[str] = ""

    def __post_init__(self) -> None:
        kind: type = type(self)
        for name, hint, declared in declarations(kind):
            value = checked(self.prefix + name, getattr(self, name), hint, declared)
            object.__setattr__(self, name, value)


@cache
def declarations(kind: type) -> tuple[tuple[str, Any, Setting], ...]:
    """Name, type and declaration of the fields of a class. A plain field declares only its type."""
    hints = get_type_hints(kind)
    found = []
    for each in fields(kind):
        hint, declared = hints[each.name], each.metadata.get("setting", _UNDECLARED)
        if declared.metavar == _OF_TYPE:
            declared = replace(declared, metavar=_placeholder(hint))
        found.append((each.name, hint, declared))
    return tuple(found)


def _placeholder(hint: Any) -> str:
    """That of a value: "{auto,on,off}" of the words of a `Literal`, "[N ...]" of a tuple."""
    kinds = get_args(hint)
    if get_origin(hint) is Literal:
        return f"{{{','.join(kinds)}}}"
    if get_origin(hint) is tuple:
        return f"[{_placeholder(kinds[0])} ...]"
    if not kinds:
        return _PLACEHOLDERS[hint]
    return "|".join(_placeholder(kind) for kind in kinds if kind is not NoneType)


def checked(name: str, value: Any, hint: Any, declared: Setting = _UNDECLARED) -> Any:
    """``value`` as a value of the type ``hint``, within the limits of the declaration.

    Raises: SettingError: it is not valid.
    """
    try:
        value = _typed(value, hint, declared)
        problem = declared.check(value) if declared.check and value is not None else None
    except ValueError as error:
        problem = as_message(error)
    if problem is None:
        return value
    wrong = message("{value} {problem}", value=shown(value), problem=as_message(problem))
    if "; " in str(problem):
        raise SettingError(name, wrong)
    raise SettingError(name, "{wrong}; use {allowed}", wrong=wrong, allowed=allowed(hint, declared))


def shown(value: Any) -> str:
    """A value in a message of one line."""
    return printable(" ".join(repr(value).split()))[:80]


def suggestion(name: str, known: Sequence[str]) -> Message | None:
    """``"did you mean NAME?"``, or None if no known name is similar."""
    similar = get_close_matches(name, known, 1)
    return message("did you mean {name}?", name=similar[0]) if similar else None


def allowed(hint: Any, declared: Setting = _UNDECLARED) -> Message:
    """The valid values, in words: "a number from 0 to 1"."""
    if declared.allowed:
        return as_message(declared.allowed)
    kinds = [kind for kind in kinds_of(hint) if kind is not NoneType]
    if int in kinds and float in kinds:
        least = message("0 or more") if declared.above is None else message("above 0")
        if math.isinf(most := declared.largest_fraction):
            return message("a whole number, {least}, or a fraction such as 0.5", least=least)
        return message(
            "a whole number, {least}, or a fraction such as 0.5, at most {most:.1f}",
            least=least,
            most=most,
        )
    return _alternatives([_words(kind, declared) for kind in kinds])


def _alternatives(words: Sequence[Message]) -> Message:
    *first, last = words
    return message("{first} or {last}", first=first, last=last) if first else last


def _words(kind: Any, declared: Setting) -> Message:
    if get_origin(kind) is Literal:
        return _alternatives([Message(str(value)) for value in get_args(kind)])
    if get_origin(kind) in (tuple, list):
        first, *others = get_args(kind)
        item = allowed(first, declared)
        if others and Ellipsis not in others:
            return message("{count} values, each {item}", count=1 + len(others), item=item)
        return message("a list; each item is {item}", item=item)
    if kind is int or kind is float:
        noun = message("a whole number") if kind is int else message("a number")
        return message("{noun}{limits}", noun=noun, limits=_limits(declared))
    names = {
        bool: message("True or False"),
        str: message("a text"),
        Path: message("a path"),
    }
    return names.get(kind) or message("a {kind}", kind=getattr(kind, "__name__", kind))


def _limits(declared: Setting) -> Message:
    least, most = declared.least, declared.most
    if least is not None and most is not None:
        return message(" from {least:g} to {most:g}", least=least, most=most)
    limits = []
    if least is not None:
        limits.append(message("of at least {limit:g}", limit=least))
    if declared.above is not None:
        limits.append(message("above {limit:g}", limit=declared.above))
    if most is not None:
        limits.append(message("at most {limit:g}", limit=most))
    if declared.below is not None:
        limits.append(message("below {limit:g}", limit=declared.below))
    if not limits:
        return Message("")
    both = message("{one} and {other}", one=limits[0], other=limits[-1])
    return message(" {limits}", limits=both if len(limits) > 1 else limits[0])


def kinds_of(hint: Any) -> tuple[Any, ...]:
    """The types that are joined by "|"."""
    return get_args(hint) if get_origin(hint) in (Union, UnionType) else (hint,)


def _item_kinds(hint: Any, count: int) -> list[Any]:
    """The types of ``count`` items of a list or tuple."""
    kinds = get_args(hint)
    if get_origin(hint) is list or kinds[-1] is Ellipsis:
        return [kinds[0]] * count
    return list(kinds)


def _typed(value: Any, hint: Any, declared: Setting) -> Any:
    """``value`` with the types of Python; raises Problem with what is wrong."""
    problem = Problem("has the wrong type")
    for kind in kinds_of(hint):
        try:
            return _of_kind(value, kind, hint, declared)
        except TypeError:
            continue
        except Problem as error:
            problem = error
    raise problem


def _of_kind(value: Any, kind: Any, hint: Any, declared: Setting) -> Any:
    """Raises TypeError if the type is another one, Problem if only the value is wrong."""
    origin = get_origin(kind)
    if origin is Literal:
        if isinstance(value, str) and value in get_args(kind):
            return value
        raise Problem("is unknown")
    if origin in (tuple, list):
        if not isinstance(value, list | tuple):
            raise TypeError
        kinds = _item_kinds(kind, len(value))
        if len(kinds) != len(value):
            raise Problem(
                "has {found} items instead of {count}", found=len(value), count=len(kinds)
            )
        return origin(_typed(item, each, declared) for item, each in zip(value, kinds, strict=True))
    if kind is int or kind is float:
        return _number(value, kind, hint, declared)
    if kind is Path and isinstance(value, str):
        return Path(value)
    kind = origin or kind
    if kind is not Any and not getattr(kind, "_is_protocol", False) and not isinstance(value, kind):
        raise TypeError
    return value


def _number(value: Any, kind: type, hint: Any, declared: Setting) -> int | float:
    if isinstance(value, bool) or not isinstance(value, Integral if kind is int else Real):
        raise TypeError
    if isinstance(value, Integral):
        number: int | float = int(value)
        if abs(number) > _LARGEST:
            raise Problem("is too large")
    else:
        number = float(value)
        if not math.isfinite(number):
            raise Problem("is not finite")
        if int in kinds_of(hint) and number > declared.largest_fraction:
            raise Problem("is too large for a fraction")
    least, most, above, below = declared.least, declared.most, declared.above, declared.below
    if (least is not None and number < least) or (above is not None and number <= above):
        raise Problem("is too small")
    if (most is not None and number > most) or (below is not None and number >= below):
        raise Problem("is too large")
    return number
