"""The settings of a training: the ground floor of `snowsplat.training`.

These modules import neither torch nor any other part of the training. `snowsplat.util.settings`
declares the fields.
"""

from snowsplat.training.settings.config import TrainConfig
from snowsplat.training.settings.density import (
    DENSITY_CONTROLS,
    AdaptiveDensity,
    DensityConfig,
    McmcDensity,
    register_density,
)
from snowsplat.training.settings.names import changed
from snowsplat.training.settings.rates import DecayRates, LearningRates
from snowsplat.training.settings.recipes import RECIPES, recipe, register_recipe
from snowsplat.training.settings.starts import STARTS, register_start
from snowsplat.training.settings.stored import config_from_json, config_to_json
from snowsplat.util.settings import Settings, When, setting

__all__ = [
    "DENSITY_CONTROLS",
    "RECIPES",
    "STARTS",
    "AdaptiveDensity",
    "DecayRates",
    "DensityConfig",
    "LearningRates",
    "McmcDensity",
    "Settings",
    "TrainConfig",
    "When",
    "changed",
    "config_from_json",
    "config_to_json",
    "recipe",
    "register_density",
    "register_recipe",
    "register_start",
    "setting",
]
