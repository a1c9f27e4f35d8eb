"""The flags of `snowsplat train` that are settings of its configuration.

They are made from the declarations of the settings, under the same names; see
`snowsplat.util.settings`.
"""

from __future__ import annotations

from dataclasses import field, make_dataclass
from typing import TYPE_CHECKING, Annotated, Any, Literal, TypeAlias

from snowsplat.cli.flags import flag, switch, with_flags
from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import DENSITY_CONTROLS
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.training.settings.recipes import RECIPES
from snowsplat.util.settings import Setting, flags_of

RECIPE = "set by the recipe"
#: The values of the flag --recipe.
RecipeName: TypeAlias = Literal[tuple(RECIPES)]  # type: ignore[valid-type]
RECIPE_FLAG = flag(f"{{{','.join(RECIPES)}}}", default="default")

#: Name, type and declaration of every setting with a flag, in the order of the help text.
SETTINGS = tuple(flags_of(TrainConfig, *DENSITY_CONTROLS.values(), LearningRates, DecayRates))


def _flag(name: str, hint: Any, declared: Setting) -> tuple[str, Any, Any]:
    """The field of a flag. None: the recipe determines the setting."""
    metadata = {"help": with_flags(declared.help)}
    if declared.metavar == "":
        option = switch(*declared.aliases)
        return name, Annotated[bool, option], field(default=False, metadata=metadata)
    default = RECIPE if declared.default is None else declared.default
    option = flag(declared.metavar or "", *declared.aliases, default=default)
    kind = Literal["on", "off"] if hint is bool else hint
    return name, Annotated[kind | None, option], field(default=None, metadata=metadata)


class _Given:
    def config_settings(self) -> dict[str, Any]:
        """The settings that were given: name -> value."""
        given: dict[str, Any] = {}
        for name, hint, declared in SETTINGS:
            value = getattr(self, name)
            if value is None or (declared.metavar == "" and not value):
                continue
            given[name] = value in ("on", True) if hint is bool else value
        if "test_iterations" in given:  # -1: none
            given["test_iterations"] = tuple(n for n in given["test_iterations"] if n > 0 or n < -1)
        return given


if TYPE_CHECKING:
    ConfigFlags = _Given
else:
    ConfigFlags = make_dataclass(
        "ConfigFlags", [_flag(*each) for each in SETTINGS], bases=(_Given,)
    )
