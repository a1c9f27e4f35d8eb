"""`LeftOut`: a photo that is not used, and why."""

from dataclasses import dataclass
from typing import Literal

from snowsplat.util.messages import Message

#: What left a photo out: the choice of the photos (it cannot be read, is a copy, is blurred …), the
#: camera poses, or the training (the scene does not explain it).
Stage = Literal["photos", "poses", "training"]


@dataclass(frozen=True)
class LeftOut:
    """A photo, video or frame that is not used.

    Attributes:
        photo: the file, or the file and the time of a frame; a folder if nothing in it is used.
        stage: which stage has left it out.
        reason: why, as a text that continues the name of the photo.
    """

    photo: str
    stage: Stage
    reason: Message
