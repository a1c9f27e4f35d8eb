"""What the course says about recipes is what the recipes are: the statements, and the table."""

import ast
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from snowsplat import TrainConfig, recipe
from snowsplat.scene.camera import NEAR
from snowsplat.training.density import adaptive
from snowsplat.training.parts import surfaces
from snowsplat.training.settings.names import setting_names
from snowsplat.training.settings.recipes import RECIPES

DOCS = Path(__file__).resolve().parents[2] / "docs"
LEARN = DOCS / "learn"
WALK = "from-paper-to-default.md"
#: These settings choose when to evaluate, and skip rows that no photo shows: not the method.
NOT_THE_METHOD = {"test_iterations", "visible_only", "density", "learning_rates", "decay"}


def setting(config: TrainConfig, name: str) -> Any:
    part, field = setting_names(config)[name]
    return getattr(getattr(config, part) if part else config, field)


def paragraphs(page: str) -> list[str]:
    """The text of a page without code, each paragraph, item and row in one line."""
    text = re.sub(r"```.*?```", "", (LEARN / page).read_text(encoding="utf-8"), flags=re.DOTALL)
    blocks = re.split(r"\n\s*\n|\n(?=[|-] ?)", text.replace("\n>", "\n"))
    return [" ".join(block.split()) for block in blocks]


Check = Callable[[TrainConfig, TrainConfig], bool]  # of `paper` and `default`
STATEMENTS: list[tuple[str, str, Check]] = [
    (
        "density-control.md",
        "In the recipe `paper`, it means a scale of more than 0.1 scene extents "
        "(`prune_world_size`), after the first opacity reset",
        lambda paper, _: (
            setting(paper, "prune_world_size") == 0.1 and paper.density.opacity_reset_interval > 0
        ),
    ),
    (
        "density-control.md",
        "`prune_screen_size` limits the radius in a photo; no recipe uses it.",
        lambda *_: (
            not any(getattr(make().density, "prune_screen_size", 0) for make in RECIPES.values())
        ),
    ),
    (
        "density-control.md",
        "A Gaussian with $o < 0.005$ changes no pixel",
        lambda paper, _: setting(paper, "prune_opacity") == 0.005,
    ),
    (
        "density-control.md",
        "Every 3000 steps, the opacity of each Gaussian is reduced",
        lambda paper, _: setting(paper, "opacity_reset_interval") == 3000,
    ),
    (
        "density-control.md",
        "A small Gaussian ($\\max_i s_i \\le 0.01$ scene extents)",
        lambda *both: all(setting(config, "percent_dense") == 0.01 for config in both),
    ),
    (
        "density-control.md",
        "The recipe `default` uses this, with one difference",
        lambda paper, default: (
            setting(default, "abs_grad") is True and setting(paper, "abs_grad") is False
        ),
    ),
    (
        "density-control.md",
        "In snowsplat, it is the recipe `mcmc`.",
        lambda *_: type(recipe("mcmc").density).__name__ == "McmcDensity",
    ),
    (
        "notes.md",
        "In the recipe `paper`: too large in the world, after the first reset.",
        lambda paper, _: setting(paper, "prune_world_size") > 0,
    ),
    (
        "optimisation.md",
        "The recipe `default` of snowsplat is made for short training runs, and has several times "
        "larger rates",
        lambda paper, default: (
            default.iterations < 0.1 * paper.iterations
            and all(
                setting(default, name) >= 3 * setting(paper, name)
                for name in ("lr_means", "lr_log_scales", "lr_quats", "lr_sh_dc", "lr_sh_rest")
            )
        ),
    ),
    (
        "optimisation.md",
        "(The recipe `default` also starts from points that a plane sweep finds.)",
        lambda _, default: default.init == "points+sweep",
    ),
    (
        "optimisation.md",
        "the recipe `default` (2000 steps) lets the other rates decrease, too",
        lambda _, default: default.iterations == 2000 and setting(default, "lr_anneal") < 1,
    ),
    (
        "optimisation.md",
        "The recipe `default` begins with a quarter of the resolution.",
        lambda _, default: float(default.coarse_to_fine[0]) > 0,
    ),
    (
        "optimisation.md",
        "$\\min(3, \\lfloor\\text{step}/1000\\rfloor)$",
        lambda paper, _: (paper.sh_interval, paper.sh_degree) == (1000, 3),
    ),
    (
        "ply.md",
        "An antialiased scene, such as those of the recipe `default`",
        lambda _, default: default.antialias,
    ),
    (
        "since-2023.md",
        "| other zooms than the photos | Mip-Splatting",
        lambda _, default: default.antialias,
    ),
    (
        "projection.md",
        "The default recipe of snowsplat does this (`--antialias`).",
        lambda _, default: default.antialias,
    ),
]
STATEMENTS += [
    (
        "density-control.md",
        "snowsplat does no reset in the last 500 steps of the densification.",
        lambda *_: adaptive.RESET_RECOVERY == 500,
    ),
    (
        "equations.md",
        "The paper resets opacities in the text only, every 3000 steps; here `_resets_at`",
        lambda paper, _: setting(paper, "opacity_reset_interval") == 3000,
    ),
    (
        "equations.md",
        "compares the largest scale with 1% of the scene extent",
        lambda *both: all(setting(config, "percent_dense") == 0.01 for config in both),
    ),
    (
        "surfaces.md",
        "with `--surfaces on`: every 10 steps, the smallest scale is multiplied by 0.97",
        lambda *_: (surfaces._INTERVAL, surfaces._SHRINK) == (10, 0.97),
    ),
    (
        "camera.md",
        "for a scene at a distance of 3 to 5 units from the cameras, it is 0.2",
        lambda *_: NEAR == 0.2,
    ),
    (
        "from-paper-to-default.md",
        "which has 2000 steps instead of 30,000",
        lambda paper, default: (paper.iterations, default.iterations) == (30_000, 2000),
    ),
]
#: Beginnings of sentences with a number that are about shapes, files, or what was measured.
NOT_SETTINGS = (
    "In snowsplat, the matrix",
    "| OpenCV |",
    "On the CPU, snowsplat sorts",
    "**Images.** 64 round Gaussians",
    "**The order of `f_rest`.**",
    "`splats` is a",
    "What happened from 2024",
    "The degree is the highest",
    "Some texts count",
    "This page follows the computation",
    "Noise alone changes nothing here",
    "Without the [dense initialisation",
    "**If you have an afternoon**",
    "| [From the paper to the default",
    '**"Degree 3" and "order 4"',
)
#: Paragraphs that measure recipes, or say where they are, and state no setting.
NO_SETTING = (
    "initialisation.md",
    "`training/settings/recipes.py` contains all values",
    "The kernels with the recipe `classic` reach",
)


@pytest.mark.parametrize(("page", "statement", "check"), STATEMENTS)
def test_statements_about_recipes(page, statement, check):
    assert any(statement in paragraph for paragraph in paragraphs(page)), statement
    assert check(recipe("paper"), recipe("default")), statement


def test_no_statement_about_recipes_is_unchecked():
    """A paragraph that names a recipe is in `STATEMENTS`, so that it cannot become wrong."""
    for file in LEARN.glob("*.md"):
        if file.name in (WALK, *NO_SETTING):
            continue
        for paragraph in paragraphs(file.name):
            if re.search(r"\brecipes?\b|`(default|paper|classic|mcmc)`", paragraph, re.IGNORECASE):
                known = [text for page, text, _ in STATEMENTS if page == file.name]
                assert any(text in paragraph for text in (*known, *NO_SETTING)), paragraph


def test_no_number_of_the_program_is_unchecked():
    """A sentence with a number that says what snowsplat does, or what is done "here"."""
    for file in LEARN.glob("*.md"):
        known = [text for page, text, _ in STATEMENTS if page == file.name]
        for paragraph in paragraphs(file.name):
            words = re.sub(r"\$[^$]*\$|\]\([^)]*\)|<!--.*?-->|!\[[^]]*\]", "", paragraph)
            for sentence in re.split(r"(?<=[.!?:]) (?=[A-Z*`])", words):
                about = re.search(r"\b[Hh]ere\b|\b[Ss]nowsplat\b", sentence)
                if about is None or not re.search(r"\d", sentence):
                    continue
                covered = any(text in paragraph for text in known)
                assert covered or sentence.startswith(NOT_SETTINGS), f"{file.name}: {sentence}"


@pytest.mark.parametrize("page", [LEARN / WALK, DOCS / "zh" / "learn" / WALK])
def test_the_walk_names_each_difference_between_paper_and_default(page):
    """In the table: `setting` VALUE OF paper → VALUE OF default."""
    text = page.read_text(encoding="utf-8")
    found = re.findall(r"`(\w+)` ([^`|;→]+) → ([^`|;→]+?)(?=;| \|)", text)
    paper, default = recipe("paper"), recipe("default")
    for name, before, after in found:
        assert _value(before) == pytest.approx(setting(paper, name)), name
        assert _value(after) == pytest.approx(setting(default, name)), name
    different = {
        name for name in setting_names(default) if setting(paper, name) != setting(default, name)
    }
    assert {name for name, _, _ in found} == different - NOT_THE_METHOD


def _value(text: str) -> Any:
    try:
        return ast.literal_eval(text.strip())
    except (ValueError, SyntaxError):
        return text.strip()
