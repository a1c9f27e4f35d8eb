"""`Finding`, what a check of cameras has found, and `lens_findings`: whether the intrinsics of a
pinhole camera are those of a real one."""

import math
from dataclasses import dataclass

from snowsplat.util.messages import Message, message

# Degrees, of the longer side of a photo. A pinhole image of more than 150° has less than a
# seventh of its pixels within the central 60°: no lens is corrected to that. Below 5° (more than
# 400 mm on a full-frame camera) are telescopes and satellites.
_WIDEST, _NARROWEST = 150.0, 5.0
# A telescope on a camera has about 0.5°; below is a unit that is not the pixel.
_NARROWEST_TELESCOPE = 0.1
# fx / fy. Sensors have square pixels within 0.1%; calibration is good to 1 or 2%. Some videos are
# anamorphic or were scaled in one direction.
_SQUARE = 0.97, 1.03
# Distance of the principal point from the centre, relative to the size of the photo. Cropping
# moves it.
_OFF_CENTRE = 0.2


@dataclass(frozen=True)
class Finding:
    """What a check has found, for the user.

    Attributes:
        about: the quantity, in one or two words: "field of view", "axes".
        text: one sentence with numbers, without a full stop.
        advice: what to do; None: not known.
        impossible: no real camera is like this, or the evidence is overwhelming. False: in doubt;
            the data may be unusual but right.
        photos: the views whose poses are wrong, if those of the others are right.
    """

    about: str
    text: Message
    advice: Message | None = None
    impossible: bool = False
    photos: tuple[str, ...] = ()

    @property
    def sentence(self) -> Message:
        """The text and the advice."""
        if self.advice is None:
            return self.text
        return message("{text}; {advice}", text=self.text, advice=self.advice)


def field_of_view(size: float, focal: float) -> float:
    """The angle in degrees that ``size`` pixels span at a focal length in pixels."""
    return 2.0 * math.degrees(math.atan(0.5 * size / focal))


def lens_findings(
    width: int, height: int, fx: float, fy: float, cx: float, cy: float
) -> list[Finding]:
    """What is impossible or doubtful about the intrinsics of a pinhole camera.

    Args:
        width, height: of the photo in pixels.
        fx, fy: positive focal lengths in pixels.
        cx, cy: the principal point in pixels from the upper left corner.
    """
    found = []
    angle = max(field_of_view(width, fx), field_of_view(height, fy))
    size = message("photos of {width}x{height}", width=width, height=height)
    if not _NARROWEST <= angle <= _WIDEST:
        text = message(
            "a focal length of {fx:.5g} pixels for {size} is a field of view of {angle:.3g}°",
            fx=fx,
            size=size,
            angle=angle,
        )
        if angle > _WIDEST:
            text = message("{text}; a pinhole camera has less than 150°", text=text)
        advice = message("the focal length must be in pixels of these photos")
        impossible = angle > _WIDEST or angle < _NARROWEST_TELESCOPE
        found.append(Finding("field of view", text, advice, impossible))
    if not _SQUARE[0] <= fx / fy <= _SQUARE[1]:
        text = message(
            "fx is {ratio:.3f} of fy, but pixels are square ({fx:.5g} and {fy:.5g})",
            ratio=fx / fy,
            fx=fx,
            fy=fy,
        )
        found.append(Finding("pixel aspect", text))
    where = message("the principal point ({cx:.5g}, {cy:.5g})", cx=cx, cy=cy)
    off = max(abs(cx / width - 0.5), abs(cy / height - 0.5))
    if off > 0.5:
        text = message("{where} is outside of {size}", where=where, size=size)
        advice = message("it must be in pixels of these photos")
        found.append(Finding("principal point", text, advice, impossible=True))
    elif off > _OFF_CENTRE:
        text = message(
            "{where} is {off:.0%} of the size away from the centre of {size}",
            where=where,
            off=off,
            size=size,
        )
        found.append(Finding("principal point", text))
    return found
