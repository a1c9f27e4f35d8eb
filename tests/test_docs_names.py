"""No page names a file, a folder, a flag, a subcommand or a Python name that does not exist.

The pages are the documentation in both languages, the README files and the part of the changelog
that is not released. The text in backquotes is read, and the blocks `sh`.
"""

import contextlib
import functools
import importlib
import io
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import snowsplat
from snowsplat import extras
from snowsplat.cli import main as cli
from snowsplat.formats.registry import FORMATS

from .walk_throughs import FOLDER, walk_throughs

extras.register()

ROOT = Path(__file__).resolve().parents[1]
PAGES = [
    *ROOT.glob("*.md"),
    *(ROOT / folder / "README.md" for folder in ("benchmarks", "experiments", "notebooks")),
    *(page for page in (ROOT / "docs").rglob("*.md") if "static" not in page.parts),
]
CODE = (".py", ".h", ".cpp", ".cu", ".js", ".css", ".cmake", ".toml", ".yml", ".sh", ".j2")


def listed(words: str) -> set[str]:
    return set(re.findall(r"\S+", words))


#: Names of other programs.
FOREIGN_FILES = {"convert.py", "metrics.py", "full_eval.py", "render.py", "train.py"} | {
    "dataparser.py",
    "simple_trainer.py",
    "gaussian_model.py",
    "config.yml",
}
FOREIGN_FLAGS = listed("""
    --app_opt --ckpt --data_factor --dest --diff-filter --downscale-factor --find-links --format
    --gpus --max-num-iterations --max_steps --network --no-index --no-normalize-world-space
    --output-dir --pipeline --ply-color-mode --pose_opt --resize --rm --save_ply --strategy
    --torch-backend --user
    """)
#: Names of the listings of the paper, and of other programs.
FOREIGN_NAMES = listed("""
    BlendInOrder CreateTiles CullGaussian DuplicateWithKeys GetTileRange IdentifyTileRanges
    InitAttributes
    IsRefinementIteration IsTooLarge SampleTrainingView ScreenspaceGaussians SortByKeys
    DefaultStrategy SPZ_ADOBE_coordinate_system f_rest_i normalize_world_space step_pre_backward
    DSNOWSPLAT_LINEINFO
    """)
#: Names that a reader chooses, or that stand for others.
CHOSEN = {"MyPart", "my_loss", "point_cloud_29999_views"} | {"hubble_deep_field", "ours_2000"}

PATH = re.compile(r"[\w.{}-]+(?:/[\w.{}-]+)*/?")
WORD = re.compile(r"(?<![\w.])([A-Za-z_]\w*)(?![\w])")


def text_of(page: Path) -> str:
    text = page.read_text(encoding="utf-8")
    if page.name == "CHANGELOG.md":  # former versions had other names
        text = "\n## ".join(text.split("\n## ")[:2]).partition("### Removed")[0]
        assert text.count("\n## ") == 1
    return text


def spans(text: str) -> list[str]:
    """The code within the text of a page."""
    text = re.sub(r"^ *(```|~~~).*?^ *\1", "", text, flags=re.M | re.S)
    return [" ".join(code.split()) for code in re.findall(r"(?<!`)`([^`]+)`(?!`)", text)]


def shell(text: str) -> list[str]:
    """The commands of the blocks `sh` of a page."""
    blocks = re.findall(r"^ *```sh\n(.*?)^ *```", text, re.M | re.S)
    return [line for block in blocks for line in block.replace("\\\n", " ").splitlines()]


@functools.cache
def files() -> tuple[str, ...]:
    """All files of the repository, and those that a reader of a walk-through creates."""
    found = [name for walk in walk_throughs() for name, _, _ in walk.edits]
    for folder, below, names in os.walk(ROOT):
        below[:] = [name for name in below if name not in ("build", "dist", "out", "node_modules")]
        below[:] = [name for name in below if not name.startswith((".", "_")) or name == ".github"]
        inside = Path(folder).relative_to(ROOT)
        found += [(inside / name).as_posix() for name in names]
    return tuple(found)


@functools.cache
def known_paths() -> frozenset[str]:
    """Each file and folder of the repository, by each end of its path."""
    ends = set()
    for name in files():
        parts = name.split("/")
        for last in range(1, len(parts) + 1):
            for first in range(last):
                ends.add("/".join(parts[first:last]) + ("/" if last < len(parts) else ""))
    return frozenset(ends)


@functools.cache
def words() -> frozenset[str]:
    """All words of the source files: names, and keys of the files that they read and write."""
    found = FOREIGN_NAMES | CHOSEN
    for name in files():
        file = ROOT / name
        if (
            name.endswith((*CODE, "Makefile", ".ipynb"))
            and file.exists()
            and file != Path(__file__)
        ):
            found |= set(re.findall(r"\w+", file.read_text(encoding="utf-8")))
    for page in FOLDER.glob("*.md"):
        found |= set(re.findall(r"^ *(?:def|class) (\w+)", page.read_text("utf-8"), re.M))
    return frozenset(found)


@functools.cache
def flags(subcommand: str) -> frozenset[str]:
    with contextlib.redirect_stdout(io.StringIO()) as out, contextlib.suppress(SystemExit):
        cli.parse([subcommand, "--help"])
    return frozenset(re.findall(r"--[a-z][\w-]*", out.getvalue()))


@functools.cache
def all_flags() -> frozenset[str]:
    """The flags of all subcommands, and of the scripts of the repository and the tools in it."""
    found = {flag for name in cli.SUBCOMMANDS for flag in flags(name)} | FOREIGN_FLAGS
    for name in files():
        file = ROOT / name
        if name.endswith((".py", "Makefile")) and file.exists() and file != Path(__file__):
            found |= set(re.findall(r"""["' ](--[a-z][\w-]*)""", file.read_text("utf-8")))
    return frozenset(found)


@functools.cache
def new_flags() -> frozenset[str]:
    """The flags of the settings that a walk-through adds."""
    pages = [page.read_text(encoding="utf-8") for page in FOLDER.glob("*.md")]
    return frozenset(
        f"--{name}"
        for page in pages
        for name in re.findall(r"^\+ +(\w+): \w+ = (?:flag|setting)", page, re.M)
    )


def wrong_path(code: str) -> Iterator[str]:
    if not PATH.fullmatch(code) or any(part.isupper() for part in re.split(r"[/._-]", code)):
        return
    inside = code.startswith(SOURCES)
    if code.endswith(CODE) and not code.startswith((".", "/")):
        if code not in known_paths() and code.rpartition("/")[2] not in FOREIGN_FILES:
            yield f"no file {code}"
    elif code.endswith("/") and inside and code not in known_paths():
        yield f"no folder {code}"


#: Folders whose names are not those of the files of users.
SOURCES = tuple(
    f"{folder}/"
    for folder in listed("""
    src benchmarks cli docs evaluation experiments extras formats native notebooks ops pipeline sfm
    studio surface synthetic tests training trajectory util viewer
    """)
)


def wrong_flag(code: str) -> Iterator[str]:
    name = re.match(r"(?:(?:python -m )?snowsplat )?([a-z]+)(?![\w.])", code)
    known = all_flags()
    if name and name[1] in cli.SUBCOMMANDS:
        known = flags(name[1]) | new_flags()
    for flag in re.findall(r"(?<![\w-])(--[a-z][\w-]*)", code):
        if flag not in known and flag.replace("_", "-") not in known:
            yield f"no flag {flag}: {code}"


def wrong_subcommand(code: str) -> Iterator[str]:
    for name in re.findall(r"(?:^|[;&|] ?)snowsplat ([a-z]\w*)", code):
        if name not in (*cli.SUBCOMMANDS, "version", "help"):
            yield f"no subcommand {name}: {code}"


def wrong_name(code: str) -> Iterator[str]:
    """Names in Python: dotted ones of the package, and words that look like names."""
    if (" " in code and "(" not in code) or "/" in code or re.search(r"\.\w{2,4}$", code):
        return
    for dotted in re.findall(r"(?<![\w./\"-])([A-Za-z_]\w*(?:\.[A-Za-z_]\w*)+)", code):
        first, *rest = dotted.split(".")
        if first == "snowsplat" or (
            first in PACKAGES and dotted.rpartition(".")[2] not in SUFFIXES
        ):
            parts = rest if first == "snowsplat" else [first, *rest]
            if not resolves(parts):
                yield f"no name {dotted}"
    for word in WORD.findall(re.sub(r"--[\w-]+|\"[^\"]*\"|'[^']*'", "", code)):
        looks = "_" in word.strip("_") or re.search(r"[a-z][A-Z]", word) or f"{word}(" in code
        if looks and word not in words():
            yield f"no name {word}: {code}"


PACKAGES = {p.name for p in (ROOT / "src" / "snowsplat").iterdir() if (p / "__init__.py").exists()}
SUFFIXES = {"py", "h", "js", "css", "html", "md", "json", "ply"}


def resolves(parts: list[str]) -> bool:
    target: object = snowsplat
    name = "snowsplat"
    for part in parts:
        name = f"{name}.{part}"
        if not hasattr(target, part):
            try:
                target = importlib.import_module(name)
            except ImportError:
                return part in getattr(target, "__dataclass_fields__", {})
        else:
            target = getattr(target, part)
    return True


def wrong_places(text: str) -> Iterator[str]:
    """`FILE` (`NAME`, …): the file contains these names."""
    for name, names in re.findall(r"`([\w/]+\.(?:py|h))` \((`[\w`, ]+`)\)", text):
        found = [file for file in files() if f"/{file}".endswith(f"/{name}")]
        source = "".join((ROOT / file).read_text(encoding="utf-8") for file in found)
        for word in re.findall(r"`(\w+)`", names):
            if found and word not in source:
                yield f"no {word} in {name}"


CHECKS: list[Callable[[str], Iterator[str]]] = [
    wrong_path,
    wrong_flag,
    wrong_subcommand,
    wrong_name,
]


def problems(text: str) -> list[str]:
    found = [problem for code in spans(text) for check in CHECKS for problem in check(code)]
    for line in shell(text):
        found += [*wrong_flag(line), *wrong_subcommand(line)]
    return [*found, *wrong_places(text)]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_a_page_names_only_what_exists(page):
    assert problems(text_of(page)) == []


def test_the_number_of_scene_formats_is_told():
    readable = {fmt.name.removesuffix(" in JSON") for fmt in FORMATS if fmt.read is not None}
    numbers = {10: "ten", 11: "eleven", 12: "twelve", 13: "thirteen"}
    page = " ".join((ROOT / "docs" / "index.md").read_text(encoding="utf-8").split())
    assert f"[{numbers[len(readable)]} file formats]" in page
