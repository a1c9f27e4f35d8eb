"""Finds COLMAP models in the folder of a dataset, and the folder of their images."""

from collections import deque
from collections.abc import Iterator, Sequence
from pathlib import Path

from snowsplat.data.colmap.model import count_images, model_is_text
from snowsplat.project.project import is_output
from snowsplat.util.errors import UserError
from snowsplat.util.safe_json import quoted

# Where a model may be: dense/0/sparse/0.
_DEEPEST = 4
# Folders that are looked into.
_MOST_FOLDERS = 2000


def find_models(parent: Path) -> list[Path]:
    """The folders that hold a COLMAP model: ``parent`` and its direct subfolders.

    They are sorted by their number of images, the largest first.
    """
    if not parent.is_dir():
        return []
    folders = [*sorted(p for p in parent.iterdir() if p.is_dir()), parent]
    return _largest_first([folder for folder in folders if model_is_text(folder) is not None])


def find_models_below(root: Path, images: str) -> list[Path]:
    """The models of one dataset anywhere in a folder, the largest first: ``dense/0/sparse`` …

    Outputs of snowsplat in ``root`` are skipped.

    ``images``: name of the folders of images, which tell datasets apart.

    Raises: UserError: there are several datasets.
    """
    models = [path for path in folders_below(root, _DEEPEST) if model_is_text(path) is not None]
    # The model in sparse/0 beside dense/0 may be one of photos that are not there.
    complete = [m for m in models if (workspace_of(m, root, images) / images).is_dir()]
    models = complete or models
    workspaces = list(dict.fromkeys(workspace_of(model, root, images) for model in models))
    # dense/0, dense/1 …: the parts of one reconstruction.
    parts = {path.parent for path in workspaces if path.name.isdecimal()}
    if len(workspaces) > 1 and not (
        len(parts) == 1 and all(p.name.isdecimal() for p in workspaces)
    ):
        names = ", ".join(quoted(p.relative_to(root).as_posix()) for p in workspaces[:3])
        raise UserError(
            "{root}: has several datasets ({names}, …); use one of these folders",
            root=root,
            names=names,
        )
    return _largest_first(models)


def folders_below(root: Path, deepest: int) -> Iterator[Path]:
    """A folder and those in it, the nearest first, without hidden ones and outputs of snowsplat."""
    queue, seen = deque([(root, 0)]), 0
    while queue and (seen := seen + 1) <= _MOST_FOLDERS:
        folder, depth = queue.popleft()
        yield folder
        if depth < deepest:
            try:
                inner = sorted(p for p in folder.iterdir() if p.is_dir())
            except OSError:
                continue
            queue += [(p, depth + 1) for p in inner if not (p.name[0] == "." or is_output(p))]


def workspace_of(model: Path, root: Path, images: str) -> Path:
    """The nearest folder above a model that has a folder of images; ``root`` if none has."""
    folder = model
    while folder != root and folder != folder.parent:
        if (folder / images).is_dir():
            return folder
        folder = folder.parent
    return root


def _largest_first(models: Sequence[Path]) -> list[Path]:
    return sorted(models, key=lambda folder: -count_images(folder))  # stable for equal counts
