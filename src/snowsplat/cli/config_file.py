"""The flag `--config FILE`: flags in a file, or the `config.json` of an earlier training."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

import tyro

from snowsplat.cli.flag_errors import spellings
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import from_json, printable, read_json
from snowsplat.util.settings import kinds_of, suggestion

if TYPE_CHECKING:
    from snowsplat.project.training_folder import DatasetSettings
    from snowsplat.training.settings.config import TrainConfig

_FLAG = "--config"


def expanded(kind: Any, arguments: Sequence[str]) -> list[str]:
    """The arguments with the flags of a file in the place of ``--config FILE``.

    Flags among the arguments have priority. A `config.json` is left to `training_in`.

    ``kind``: the dataclass of the subcommand.

    Raises: UserError: the file is not readable, or contains what is no flag of the subcommand.
    """
    rest, added = list(arguments), list[str]()
    known = spellings(kind)
    given = {known[name][0] for name in map(_spelling, arguments) if name in known}
    if "config" not in given:
        return rest
    at = [_spelling(argument) for argument in rest].index(_FLAG)
    separate = "=" not in rest[at]
    if separate and at + 1 == len(rest):
        return rest  # the parser says that the value is missing
    file = Path(rest[at + 1] if separate else rest[at].partition("=")[2])
    content = _content(file)
    if "training" in content:
        if kind.__name__ != "Train":
            raise UserError(
                "{file}: is the configuration of a training; use it with train", file=file
            )
        return rest
    for key, value in content.items():
        spelling = _spelling(f"--{key}")
        if spelling not in known or spelling in (_FLAG, "--help"):
            names = [name[2:] for name in known if name.startswith("--")]
            advice = suggestion(spelling[2:], names) or "; remove it"
            raise UserError(
                "{file}: {name}: unknown{advice}", file=file, name=printable(key), advice=advice
            )
        name, hint, _ = known[spelling]
        if name not in given and value is not None:
            try:
                extras = get_args(get_type_hints(kind, include_extras=True)[name])
                repeated = tyro.conf.UseAppendAction in extras
                added += _arguments(spelling, value, hint, repeated)
            except ValueError as error:
                raise UserError(
                    "{file}: {name}: {error}", file=file, name=printable(key), error=error
                ) from None
    return [*rest[:at], *rest[at + 1 + separate :], *added]


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

    return tomllib.loads(file.read_text(encoding="utf-8"))


def _spelling(argument: str) -> str:
    return argument.partition("=")[0].replace("_", "-") if argument.startswith("-") else argument


def _arguments(spelling: str, value: Any, hint: Any, repeated: bool) -> Iterator[str]:
    """The arguments that set a flag to a value of JSON.

    ``repeated``: whether the flag is given once for each item of a list.

    Raises: ValueError: the flag cannot have the value.
    """
    kinds = kinds_of(hint)
    if bool in kinds:
        if not isinstance(value, bool):
            raise ValueError("use true or false")
        return iter([spelling] * value)
    if isinstance(value, bool) and any(
        get_origin(each) is Literal and "on" in get_args(each) for each in kinds
    ):
        value = "on" if value else "off"
    values = value if isinstance(value, list) else [value]
    if any(isinstance(each, dict | list) for each in values):
        raise ValueError("a table is no value of a flag")
    if isinstance(value, list) and not repeated:
        return iter([spelling, *map(str, values)])
    return (f"{spelling}={each}" for each in values)
