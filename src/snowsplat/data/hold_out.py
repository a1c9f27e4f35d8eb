"""The images of a dataset that are held out for testing."""

from collections.abc import Mapping, Sequence
from pathlib import Path

from snowsplat.data.dataset import PosedImage
from snowsplat.util.errors import SettingError, UserError
from snowsplat.util.messages import message
from snowsplat.util.natural_order import natural_key
from snowsplat.util.safe_json import encoding_of, is_file, quoted


def held_out_names(
    posed: list[PosedImage],
    hold_out: int | None,
    first: int,
    test_list: Path | str | Sequence[str] | None,
) -> set[str]:
    """The names of the images to hold out; see `load_dataset`."""
    names = sorted((image.name for image in posed), key=natural_key)
    together = _frames(posed)
    if test_list is not None:
        return {
            name for one in _names_in_list(names, test_list, together) for name in together[one]
        }
    if hold_out is None:
        return set()
    if hold_out < 1:
        raise SettingError("hold_out", "{hold_out} is not valid; use 2 or more", hold_out=hold_out)
    if first < 0:
        raise SettingError("first_held_out", "{first} is not valid; use 0 or more", first=first)
    if any(image.split == "test" for image in posed):
        return {image.name for image in posed if image.split == "test"}
    frames = list(dict.fromkeys(together[name] for name in names))
    if len(frames) < 2:  # else no image is left for training
        return set()
    chosen = frames[first::hold_out] or [frames[len(frames) // 2]]
    return {name for frame in chosen for name in frame}


def _frames(posed: list[PosedImage]) -> dict[str, tuple[str, ...]]:
    """For each image name, those of its frame of a rig, sorted: the views of one panorama, … They
    are held out together, as they show the same from the same place."""
    frames: dict[str | tuple[str], list[str]] = {}
    for image in posed:
        frames.setdefault(image.frame or (image.name,), []).append(image.name)
    return {name: tuple(sorted(names)) for names in frames.values() for name in names}


def _names_in_list(
    names: list[str], test_list: Path | str | Sequence[str], together: Mapping[str, tuple[str, ...]]
) -> set[str]:
    """The image names in a test list; folder and suffix may be omitted if the rest is unique.
    ``together`` is that of `_frames`: what is left may also be the name of one frame."""
    if isinstance(test_list, str | Path):
        try:
            if Path(test_list).exists() and not is_file(Path(test_list)):
                raise ValueError("not a file")
            data = Path(test_list).read_bytes()
            lines = data.decode(encoding_of(data)).splitlines()
        except (OSError, ValueError) as error:
            raise UserError(
                "{test_list}: the list of test images cannot be read ({error})",
                test_list=test_list,
                error=error,
            ) from None
    else:
        lines = list(test_list)
    known: dict[str, set[str]] = {}
    for name in names:
        file = name.rpartition("/")[2]
        for short in {name, name.rpartition(".")[0], file, file.rpartition(".")[0]}:
            known.setdefault(short, set()).add(name)
    listed = set()
    for line in filter(None, (line.strip() for line in lines)):
        matches = {line} if line in names else known.get(line, set())
        if len({together[name] for name in matches}) != 1:
            problem = message("is the name of several images")
            if not matches:
                problem = message("is not an image of the dataset")
            raise UserError(
                "the list of test images: {line} {problem}", line=quoted(line), problem=problem
            )
        listed |= matches
    return listed
