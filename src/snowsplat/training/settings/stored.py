"""A `TrainConfig` as JSON values, for checkpoints and `config.json`."""

import logging
from dataclasses import asdict, fields
from typing import Any

from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import DENSITY_CONTROLS
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.safe_json import from_json, quoted
from snowsplat.util.settings import Settings

logger = logging.getLogger(__name__)

_DENSITY_NAME = "density_control"


def config_to_json(config: TrainConfig) -> dict[str, Any]:
    """The configuration as JSON values, for `config_from_json`."""
    return asdict(config) | {_DENSITY_NAME: type(config.density).__name__}


def config_from_json(values: dict[str, Any], strict: bool = False) -> TrainConfig:
    """The configuration that `config_to_json` returned.

    Settings that an older version did not have get their default. Settings that this version does
    not have are ignored, with a warning, or refused if ``strict``.

    Raises: UserError: the density control is not registered; or the values are damaged.
    """
    if not isinstance(values, dict) or _DENSITY_NAME not in values:
        raise UserError("the configuration: damaged; start the training again")
    values = dict(values)
    name = values.pop(_DENSITY_NAME)
    if not isinstance(name, str) or name not in DENSITY_CONTROLS:
        raise UserError(
            "the configuration: the density control {name} is not registered; name "
            "the file that registers it with --import, or call register_density with its class",
            name=quoted(name),
        )
    kinds: dict[str, type] = {
        "density": DENSITY_CONTROLS[name],
        "learning_rates": LearningRates,
        "decay": DecayRates,
    }
    for part, kind in kinds.items():
        if part in values:
            values[part] = _known(kind, values[part], strict)
    config: TrainConfig = _known(TrainConfig, values | {"density": values.get("density")}, strict)
    return config


def _known(kind: type, values: Any, strict: bool) -> Any:
    """An object of the class ``kind``, from the values that it knows."""
    if not isinstance(values, dict):
        raise UserError(
            "the configuration: {values} is not valid; start again", values=quoted(values)
        )
    names = {each.name for each in fields(kind) if each.init}
    for unknown in sorted(values.keys() - names):
        if strict:
            raise UserError(
                "{unknown} is unknown to this version; remove it", unknown=quoted(unknown)
            )
        logger.warning("the configuration: %s is unknown to this version; ignored", quoted(unknown))
    known = {name: value for name, value in values.items() if name in names}
    try:
        if issubclass(kind, Settings):  # it checks the types of its values
            return kind(**known)
        return from_json(kind, known)
    except SettingError as error:
        raise UserError("the configuration: {error}", error=error) from None
    except (TypeError, ValueError) as error:
        raise UserError(
            "the configuration: {error}; start the training again", error=error
        ) from None
