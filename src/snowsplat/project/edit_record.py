"""What was changed in a page, and the record of an edited scene: NAME_edited.json beside its file.

It imports no torch.
"""

import base64
import binascii
import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path

from snowsplat.util.errors import Problem
from snowsplat.util.files import atomic_path, remove_temporaries, write_json
from snowsplat.util.safe_json import from_json, read_json

_ENDING = "_edited"
#: The limits of the viewer that shows them.
MOST_NOTES, _LONGEST_TITLE, _LONGEST_TEXT = 25, 60, 280


@dataclass(frozen=True)
class Note:
    """What a person has written at a place of the scene.

    Attributes:
        title, text: 1 to 60, and at most 280 characters.
        view: the view that shows it, whose target is the place; see `EditRecord.start`.

    Raises: ValueError: the title is empty, a text is too long, or the view is none.
    """

    title: str
    text: str
    view: list[float]

    def __post_init__(self) -> None:
        if not 0 < len(self.title) <= _LONGEST_TITLE or len(self.text) > _LONGEST_TEXT:
            raise Problem(
                "an annotation has a title of 1 to {longest_title} characters, and a text of at "
                "most {longest_text}",
                longest_title=_LONGEST_TITLE,
                longest_text=_LONGEST_TEXT,
            )
        if not is_view(self.view):
            raise Problem("the view of an annotation is none")


@dataclass(frozen=True)
class EditRecord:
    """How an edited scene was made from another one.

    Attributes:
        scene: the name of the file that was edited, in the same folder.
        removed: the number of Gaussians that were removed.
        scale: the size relative to that of the other scene, about the origin of the world.
        title: the name of the scene for people; "": that of the other scene.
        start: the initial view in the world of the edited scene: position, target, field of view in
            degrees, aspect (`InitialView`); None: not chosen.
        notes: annotations, whose views are in the world of the edited scene.
        turn: a person has turned the scene upright, −y is up: the rotation from the world of the
            other scene, about its origin, as a quaternion wxyz. None: not turned by a person.

    Raises: ValueError: the scale is not positive, the view or the rotation is none, or there are
    too many annotations.
    """

    scene: str
    removed: int
    scale: float = 1.0
    title: str = ""
    start: list[float] | None = None
    notes: tuple[Note, ...] = ()
    turn: list[float] | None = None

    def __post_init__(self) -> None:
        if self.turn is not None and not is_rotation(self.turn):
            raise Problem("the rotation is none")
        if not 0 < self.scale < math.inf:
            raise Problem("the scale {scale} is not positive", scale=self.scale)
        if self.start is not None and not is_view(self.start):
            raise Problem("the initial view is none")
        if len(self.notes) > MOST_NOTES:
            raise Problem("a scene has at most {most_notes} annotations", most_notes=MOST_NOTES)


@dataclass(frozen=True)
class PageEdit:
    """What was changed in a page.

    Attributes:
        count: the number of Gaussians of the page.
        removed: base64 of one bit per Gaussian, in the order of the page, the lowest bit of a byte
            first; 1: it is removed.
        scale: the size of the scene relative to its present one.
        title: the name of the scene for people; "": as it is.
        start: the initial view in the frame of the page: position, target, field of view in degrees
            and aspect, see `InitialView`; None: as it is.
        hidden: what the sliders of the page hide is removed, too: the place from which they
            measure, in the frame of the page; the largest distance from it and the largest size
            (standard deviation of the longest axis) that they show. None: they do not count.
        notes: all annotations, whose views are in the frame of the page; None: as they are.
        turn: the rotation by which a person turns the scene in the viewer, whose y axis points up,
            as a quaternion wxyz. Views and places are those before it. None: not turned.

    Raises: ValueError: the number of bits, the scale, a view or a limit is not possible.
    """

    count: int
    removed: str
    scale: float = 1.0
    title: str = ""
    start: list[float] | None = None
    hidden: tuple[float, float, float, float, float] | None = None
    notes: tuple[Note, ...] | None = None
    turn: list[float] | None = None

    def __post_init__(self) -> None:
        # This checks these values.
        EditRecord("", 0, self.scale, self.title, self.start, self.notes or (), self.turn)
        if self.hidden is not None and not min(self.hidden[3:]) > 0:
            raise Problem("the sliders hide everything")
        if not 1e-9 < self.scale < 1e9:
            raise Problem("a scene cannot become {scale:g} times as large", scale=self.scale)
        if self.count < 1 or len(self.bits()) != -(-self.count // 8):
            raise Problem(
                "{bits} bits are not those of {count} Gaussians",
                bits=8 * len(self.bits()),
                count=self.count,
            )

    def bits(self) -> bytes:
        """Raises ValueError: they are not in base64."""
        try:
            return base64.b64decode(self.removed, validate=True)
        except binascii.Error:
            raise Problem("the removed Gaussians are not in base64") from None


def is_view(numbers: list[float]) -> bool:
    """Whether these are position, target, field of view in degrees and aspect of a view."""
    if len(numbers) != 8:
        return False
    *points, fov, aspect = numbers
    return points[:3] != points[3:] and 0 < fov < 180 and aspect > 0


def is_rotation(numbers: list[float]) -> bool:
    """Whether these are a unit quaternion."""
    return len(numbers) == 4 and math.isclose(math.hypot(*numbers), 1.0, rel_tol=1e-6)


def edited_file(scene: Path) -> Path:
    """The file of the edited scene; ``scene`` itself if it is one."""
    return scene if read_record(scene) else scene.with_name(f"{scene.stem}{_ENDING}.ply")


def record_file(edited: Path) -> Path:
    """The file of the record."""
    return edited.with_suffix(".json")


@dataclass(frozen=True)
class _Announced:
    """The record of an edited scene that is about to be written, and how its file is known."""

    record: EditRecord
    bytes: int
    time: int  # of its last change, nanoseconds


def read_record(file: Path) -> EditRecord | None:
    """The record of a scene file; None if it was not edited here."""
    if not file.stem.endswith(_ENDING):
        return None
    # The process that has written the file was killed before it wrote the record.
    with suppress(OSError, ValueError):
        announced = from_json(_Announced, read_json(_announced_file(file)))
        about = file.stat()
        if (about.st_size, about.st_mtime_ns) == (announced.bytes, announced.time):
            return announced.record
    try:
        return from_json(EditRecord, read_json(record_file(file)))
    except (OSError, ValueError):
        return None


@contextmanager
def written_with_record(edited: Path, record: EditRecord) -> Iterator[Path]:
    """Context with a temporary file, as `atomic_path`, which becomes an edited scene with a record.

    An edited scene that is replaced has its own record until then, also if the process is killed.

    Raises: OSError: the folder is not writable, or the disk is full.
    """
    with atomic_path(edited) as temporary:
        yield temporary
        with open(temporary, "rb+") as file:
            os.fsync(file.fileno())  # network file systems then know its time
        about = temporary.stat()
        announced = _Announced(record, about.st_size, about.st_mtime_ns)
        write_json(_announced_file(edited), asdict(announced))
    write_json(record_file(edited), asdict(record))
    _announced_file(edited).unlink()


def remove_edited(edited: Path) -> None:
    """Remove an edited scene, and then its record. Raises OSError: the folder is not writable."""
    for file in _files_of(edited):
        file.unlink(missing_ok=True)


def remove_unfinished(scene: Path) -> None:
    """Remove the temporary files of an edit of this scene whose process was killed."""
    names = [file.name for file in _files_of(edited_file(scene))]
    remove_temporaries(scene.parent, [*names, f".{names[0]}.tmp"])


def _files_of(edited: Path) -> tuple[Path, Path, Path]:
    return edited, record_file(edited), _announced_file(edited)


def _announced_file(edited: Path) -> Path:
    return edited.with_suffix(".next.json")


def shown_file(scene: Path) -> Path:
    """The edited scene, unless there is none, or ``scene`` has been made again since then."""
    edited = edited_file(scene)
    if read_record(edited) and edited.is_file():
        newer = edited.stat().st_mtime_ns >= scene.stat().st_mtime_ns
        return edited if newer else scene
    return scene
