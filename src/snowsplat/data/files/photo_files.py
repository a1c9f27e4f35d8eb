"""The photos in the folder of a dataset, and the line about names that differ from their files."""

import logging
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path

from snowsplat.data.files.listing import files_below, folder_kind, original_of
from snowsplat.data.files.masks import is_marked
from snowsplat.data.files.matching import match_names
from snowsplat.data.photos.decode import is_photo
from snowsplat.util.errors import UserError
from snowsplat.util.names import first_names
from snowsplat.util.safe_json import quoted

logger = logging.getLogger(__name__)


def photos_below(root: Path) -> list[str]:
    """Image files that may be photos; relative to ``root``, with "/", in natural order.

    Hidden files, masks, depth maps, thumbnails and smaller copies (``images_4`` beside ``images``)
    are left out.

    Raises: OSError: a folder cannot be read.
    """

    def enter(_: Path, names: list[str]) -> list[str]:
        return [n for n in names if folder_kind(n) == "photos" and original_of(n, names) is None]

    return [file for file in files_below(root, enter) if is_photo(file) and not is_marked(file)]


def warn_of_missing(
    where: object, missing: Sequence[str], count: int, what: str = "images"
) -> None:
    """Log how many of the ``count`` photos of a dataset are missing, if any are."""
    if missing:
        line = "%s: %d of %d %s are missing (the first is %s); skipped"
        logger.warning(line, where, len(missing), count, what, quoted(missing[0]))


def warn_of_unusable(where: object, errors: Mapping[str, UserError], usable: int) -> None:
    """Log the photos of a dataset that cannot be used, and why the first one cannot.

    Raises: UserError: they are no minority, so one cause may make all of them wrong.
    """
    if errors:
        first = next(iter(errors.values()))
        if len(errors) >= usable:
            raise first
        logger.warning(
            "%s: %d of %d photos are left out: %s (%s)",
            where,
            len(errors),
            len(errors) + usable,
            first_names([*errors], 3),
            first,
        )


def find_photos(
    where: object, root: Path, names: Sequence[str], taken: Collection[str]
) -> dict[str, str]:
    """The files of photos that are not where a dataset says; logs a line about those found.

    Args:
        where: the dataset, for the line.
        root: the folder of the photos.
        names: as the dataset states them.
        taken: files of other photos of the dataset, relative to ``root``.

    Returns: name -> file, relative to ``root``; see `match_names`.
    """
    try:
        files = [file for file in photos_below(root) if file not in taken]
    except OSError:
        return {}
    # If some photos are where the dataset says, the others were removed. They may have been put
    # aside, into a folder "rejected".
    matches = match_names(names, files, other_folders=not taken)
    if matches.files:
        name, file = next(iter(matches.files.items()))
        logger.warning(
            "%s: %d images are found by other names than it states: %s is %s",
            where,
            len(matches.files),
            quoted(name),
            root / file,
        )
    if matches.doubtful:
        logger.warning(
            "%s: %d images are not used, because %s has several files for a name or one for "
            "several (the first name is %s)",
            where,
            len(matches.doubtful),
            root,
            quoted(matches.doubtful[0]),
        )
    return matches.files
