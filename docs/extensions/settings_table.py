"""The directive `settings`: tables of the settings of a training and of the options of functions,
from their declarations.

```{settings}
```
"""

from collections.abc import Iterator
from typing import Any

from docutils import nodes
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from snowsplat.pipeline.options.benchmark import BenchmarkOptions, PlanOptions
from snowsplat.pipeline.options.make import MakeOptions
from snowsplat.pipeline.options.scene import Edits, MeshOptions, PublishOptions
from snowsplat.pipeline.options.train import TrainOptions
from snowsplat.pipeline.options.video import VideoOptions
from snowsplat.sfm.options import DatasetOptions
from snowsplat.training.settings import (
    RECIPES,
    AdaptiveDensity,
    DecayRates,
    LearningRates,
    McmcDensity,
    TrainConfig,
    recipe,
)
from snowsplat.training.settings.names import PARTS, setting_names
from snowsplat.util.flags import flags_of
from snowsplat.util.settings import allowed, declarations

_TITLES = {
    TrainConfig: "The training",
    AdaptiveDensity: "Density control of the paper (`AdaptiveDensity`)",
    McmcDensity: "MCMC density control (`McmcDensity`)",
    LearningRates: "Learning rates",
    DecayRates: "Decay",
}
# What is set by flags, and is not in the tables above.
_OPTIONS = {
    MakeOptions: "`make`: `MakeOptions`",
    DatasetOptions: "`sfm`: `DatasetOptions`",
    TrainOptions: "`train`, `resume`: `TrainOptions`",
    VideoOptions: "`render_video`: `VideoOptions`",
    Edits: "`convert`: `Edits`",
    MeshOptions: "`write_mesh`: `MeshOptions`",
    PublishOptions: "`publish`: `PublishOptions`",
    BenchmarkOptions: "`benchmark`: `BenchmarkOptions`",
    PlanOptions: "`plan_blocks`: `PlanOptions`",
}


def _defaults(name: str) -> Iterator[tuple[str, str]]:
    """The name of each recipe that has a setting, and its value there."""
    for each in RECIPES:
        config = recipe(each)
        known = setting_names(config)
        if name in known:
            part, attribute = known[name]
            holder = config if part is None else getattr(config, part)
            yield each, repr(getattr(holder, attribute))


def _values(name: str) -> str:
    """The default, and the recipes that have another value."""
    by_recipe = dict(_defaults(name))
    values = list(dict.fromkeys(by_recipe.values()))
    if len(values) == 1:
        return f"`{values[0]}`"
    names = ((value, [n for n, v in by_recipe.items() if v == value]) for value in values)
    return "; ".join(f"`{value}` ({', '.join(recipes)})" for value, recipes in names)


def markdown() -> str:
    """One table for each class of settings."""
    lines: list[str] = []
    for kind, title in _TITLES.items():
        lines += [f"## {title}", "", "| setting | valid | recipes | |", "|---|---|---|---|"]
        for name, hint, declared in declarations(kind):
            if kind is TrainConfig and name in PARTS:
                continue
            full = getattr(kind, "prefix", "") + name
            names = f"`{full}`"
            if declared.metavar is not None:
                flags = ("--" + full.replace("_", "-"), *declared.aliases)
                names += "".join(f" `{flag}`" for flag in flags)
            valid = str(allowed(hint, declared)).replace("|", "\\|")
            cells = (names, valid, _values(full), declared.help.replace("|", "\\|"))
            lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    for kind, title in _OPTIONS.items():
        lines += [f"## {title}", "", "| option | valid | default | |", "|---|---|---|---|"]
        for flag in flags_of(kind):
            if flag.path[0] != "settings":  # those of the training
                names = " ".join(f"`{name}`" for name in (".".join(flag.path), *flag.spellings))
                valid = str(allowed(flag.hint, flag.declared)).replace("|", "\\|")
                cells = (names, valid, flag.default, flag.declared.help.replace("|", "\\|"))
                lines.append(f"| {' | '.join(cells)} |")
        lines.append("")
    return "\n".join(lines)


class SettingsTables(SphinxDirective):
    """One section with a table for each class of settings."""

    def run(self) -> list[nodes.Node]:
        return self.parse_text_to_nodes(markdown(), allow_section_headings=True)


def setup(app: Sphinx) -> dict[str, Any]:
    app.add_directive("settings", SettingsTables)
    return {"parallel_read_safe": True}
