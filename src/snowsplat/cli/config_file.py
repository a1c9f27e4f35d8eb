"""The flag `--config FILE`: values of flags in a file, or the `config.json` of a training."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from pathlib import Path
from types import NoneType
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from snowsplat.cli.command import Command
from snowsplat.util.errors import Problem, UserError
from snowsplat.util.flags import Flag, flags_of
from snowsplat.util.messages import message
from snowsplat.util.safe_json import encoding_of, from_json, printable, read_json
from snowsplat.util.settings import kinds_of, setting, suggestion

if TYPE_CHECKING:
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.training.settings.config import TrainConfig

#: The flag that names the file.
KEY = "config"


def config(more: str = "") -> Path | None:
    """The file, as a field. ``more``: what else it can be."""
    return setting(
        None,
        f"A JSON or TOML file with values of these flags{more}. Flags have priority.",
        metavar="FILE",
    )


def with_file(command: type[Command], given: Mapping[str, Any]) -> dict[str, Any]:
    """Given values of flags, and those of the file of `KEY` that are not given.

    A `config.json` is left to `training_in`.

    Raises: UserError: the file is not readable, or contains what is no flag of the subcommand.
    """
    file = given[KEY]
    content = _content(file)
    if "training" in content:
        if command.__name__ != "Train":
            raise UserError(
                "{file}: is the configuration of a training; use it with train", file=file
            )
        return dict(given)
    flags = {spelling: flag for flag in flags_of(command) for spelling in flag.spellings}
    values = {name: value for name, value in given.items() if name != KEY}
    for key, value in content.items():
        spelling = f"--{key}".replace("_", "-")
        flag = flags.get(spelling)
        if flag is None or flag.key in (KEY, "import"):  # a file of settings runs no code
            names = [name[2:] for name in flags if name.startswith("--")]
            advice = suggestion(spelling[2:], names) or message("remove it")
            raise UserError(
                "{file}: {name}: unknown; {advice}", file=file, name=printable(key), advice=advice
            )
        if flag.key in values or value is None:
            continue
        try:
            if (read := _value(flag, value)) is not None:
                values[flag.key] = read
        except ValueError as error:
            raise UserError(
                "{file}: {name}: {error}", file=file, name=printable(key), error=error
            ) from None
    return values


def training_in(file: Path) -> tuple[TrainConfig, DatasetSettings]:
    """The configuration and the dataset of an earlier training, from its `config.json`.

    Raises:
        UserError: the file is not readable, or contains settings that this version does not have.
    """
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.training.settings.stored import config_from_json

    content = _content(file)
    if unknown := sorted(content.keys() - {"snowsplat", "dataset", "training"}):
        raise UserError(
            "{file}: {unknown}: unknown; remove it", file=file, unknown=printable(unknown[0])
        )
    try:
        dataset = from_json(DatasetSettings, content.get("dataset", {"path": ""}))
        return config_from_json(content["training"], strict=True), dataset
    except (ValueError, UserError) as error:
        raise UserError("{file}: {error}", file=file, error=error) from None


def _content(file: Path) -> dict[str, Any]:
    try:
        content = _toml(file) if file.suffix.lower() == ".toml" else read_json(file)
    except ValueError as error:
        raise UserError(
            "{file}: neither JSON nor a .toml file ({error})", file=file, error=error
        ) from None
    if not isinstance(content, dict):
        raise UserError('{file}: has no names of flags; write {{"iterations": 3000}}', file=file)
    return content


def _toml(file: Path) -> Any:
    if sys.version_info < (3, 11):
        raise UserError("{file}: TOML needs Python 3.11; write the same as JSON", file=file)
    import tomllib  # type: ignore[import-not-found,unused-ignore]

    return tomllib.loads((data := file.read_bytes()).decode(encoding_of(data)))


def _value(flag: Flag, value: Any) -> Any:
    """What the command line gives for a value of JSON; None: nothing.

    Raises: ValueError: the flag cannot have the value.
    """
    if flag.type is bool:
        if not isinstance(value, bool):
            raise Problem("use true or false")
        return value or None
    values = value if isinstance(value, list) else [value]
    if any(isinstance(each, dict | list) for each in values):
        raise Problem("a table is no value of a flag")
    kinds = [kind for kind in kinds_of(flag.type) if kind is not NoneType]
    if get_origin(kinds[0]) is tuple:
        return tuple(_item(each, [get_args(kinds[0])[0]]) for each in values)
    return _item(value, kinds)


def _item(value: Any, kinds: list[Any]) -> Any:
    if isinstance(value, bool) and any(
        "on" in get_args(k) for k in kinds if get_origin(k) is Literal
    ):
        return "on" if value else "off"
    if Path in kinds:
        return Path(str(value))
    return str(value) if str in kinds else value
