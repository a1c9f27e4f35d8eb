"""`changed`: settings by name, those of `TrainConfig` and of its parts alike."""

from dataclasses import fields, replace
from typing import Any

from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import owner
from snowsplat.util.errors import SettingError
from snowsplat.util.messages import Message, message
from snowsplat.util.settings import suggestion

#: The fields of `TrainConfig` whose value has settings itself.
PARTS = ("density", "learning_rates", "decay")
#: Settings, and the rule for the dataset that a given value disables.
_RULES = {
    "max_gaussians": "gaussians_per_pixel",
    "lr_sh_rest": "lr_sh_rest_passes",
    "coarse_to_fine": "few_passes",
}


def setting_names(config: TrainConfig) -> dict[str, tuple[str | None, str]]:
    """The name of every setting -> the part that it belongs to (None: no part), and its field."""
    names: dict[str, tuple[str | None, str]] = {}
    for name in PARTS:
        settings = getattr(config, name)
        prefix = getattr(settings, "prefix", "")
        names |= {prefix + each.name: (name, each.name) for each in fields(settings)}
    return names | {each.name: (None, each.name) for each in fields(config)}


def changed(config: TrainConfig, **settings: Any) -> TrainConfig:
    """``config`` with other values for some settings, by name.

    Args:
        settings: fields of `TrainConfig`; fields of its density control (``grad_threshold=4e-4``);
            fields of `LearningRates` with the prefix ``lr_`` (``lr_means=1e-4``), and of
            `DecayRates` with the prefix ``decay_``. None leaves a setting unchanged.
            ``max_gaussians`` also disables ``gaussians_per_pixel``, ``lr_sh_rest`` disables
            ``lr_sh_rest_passes``, and ``coarse_to_fine`` disables ``few_passes``.

    Raises:
        SettingError: the configuration has no such setting, or a value is invalid.
    """
    given = {name: value for name, value in settings.items() if value is not None}
    whole = {name: given.pop(name) for name in PARTS if name in given}
    if whole:  # the other names may be those of the new density control
        config = replace(config, **whole)
    for name, rule in _RULES.items():
        if name in given:
            given.setdefault(rule, 0.0)
    known = setting_names(config)
    direct: dict[str, Any] = {}
    of_parts: dict[str, dict[str, Any]] = {}
    for name, value in given.items():
        if name not in known:
            raise SettingError(name, _unknown(name, config, list(known)))
        part, attribute = known[name]
        (direct if part is None else of_parts.setdefault(part, {}))[attribute] = value
    parts = {name: replace(getattr(config, name), **values) for name, values in of_parts.items()}
    return replace(config, **direct, **parts)


def _unknown(name: str, config: TrainConfig, known: list[str]) -> Message:
    control = type(config.density).__name__
    if other := owner(name):
        return message(
            "a setting of {other}, but this training uses {control}; remove it or use another "
            "recipe",
            other=other,
            control=control,
        )
    advice = suggestion(name, known) or message("remove it")
    return message("unknown setting; {advice}", advice=advice)
