"""Video -> frames: the sharpest frame of each time window, without repeated views.

Decoding takes most of the time, so all frames are decoded in a single pass. The sharpest frame of
the current window is kept in memory and written when the window ends. The length of the video is
computed before from the times of the packets, because the length in the header is missing in
streams that browsers record, and wrong in truncated files.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from snowsplat.sfm.ingest.clip import (
    Clip,
    decoded_frames,
    nothing_decodes,
    open_video,
    upright_size,
)
from snowsplat.sfm.ingest.photo_files import resized, save, scaled_size
from snowsplat.sfm.ingest.sharpness import (
    FRAME_SIDE,
    PICTURE_SIDE,
    grey_copy,
    has_moved,
    sharpness,
    why_useless,
)
from snowsplat.sfm.progress import Report
from snowsplat.sfm.tone import rgb_picture
from snowsplat.util.files import shown

if TYPE_CHECKING:
    from av import VideoFrame

logger = logging.getLogger(__name__)

SAME_VIEW = "shows the same view as the previous frame"


@dataclass(frozen=True)
class Frame:
    """A frame that was written."""

    name: str
    seconds: float  # from the beginning of the video
    width: int
    height: int


@dataclass
class Frames:
    """The result of extracting frames from a video."""

    kept: list[Frame] = field(default_factory=list)
    skipped: list[tuple[float, str]] = field(default_factory=list)  # time (s) and reason
    read: int = 0  # number of decoded frames


def extract_frames(
    clip: Clip, folder: Path, windows: int, size: int | None, report: Report
) -> Frames:
    """Write ``frame_00001.jpg`` … to an existing folder: at most one frame per time window.

    Args:
        windows: number of equal time windows.
        size: resize larger frames to this longest side in pixels; None keeps the size.

    Raises:
        UserError: no frame can be decoded.
        OSError: the disk is full.
    """
    import av

    frames = Frames()
    name = clip.path.name
    best = _SharpestFrame()
    last: np.ndarray | None = None  # small copy of the last frame that was written
    window = 0

    def close_window() -> None:
        nonlocal last
        if best.frame is None or best.grey is None:
            return
        small = grey_copy(Image.fromarray(best.grey), PICTURE_SIDE)
        reason = why_useless(small)
        if reason is None and last is not None and last.shape == small.shape:
            reason = None if has_moved(last, small) else SAME_VIEW
        if reason is None:
            frames.kept.append(_write(best, clip, folder, len(frames.kept) + 1, size))
            last = small
        else:
            frames.skipped.append((best.seconds, reason))
        best.reset()

    try:
        with open_video(clip.path) as container:
            rate = float(container.streams.video[0].average_rate or 30)
            for frame in decoded_frames(container):
                timed = frame.time is not None
                seconds = frame.time - clip.start if timed else frames.read / rate
                # A small time is added, so that rounding does not put two frames into one window.
                place = (max(seconds, 0.0) + 1e-6) / clip.seconds
                index = min(int(place * windows), windows - 1)
                if index > window:
                    close_window()
                    window = index
                best.offer(frame, seconds)
                frames.read += 1
                if frames.read % 10 == 0:
                    report(min(frames.read, clip.packets), clip.packets, f"frames of {name}")
    except (av.FFmpegError, ValueError) as error:
        raise nothing_decodes(clip.path, error) from None
    close_window()
    if not frames.read:
        raise nothing_decodes(clip.path, None)
    report(clip.packets, clip.packets, f"frames of {name}")
    _log_summary(clip, frames)
    return frames


class _SharpestFrame:
    """The sharpest frame since the last reset."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.frame: VideoFrame | None = None
        self.grey: np.ndarray | None = None  # (H, W) uint8, not rotated
        self.seconds = 0.0
        self._sharpness = -1.0

    def offer(self, frame: VideoFrame, seconds: float) -> None:
        grey = _grey(frame)
        value = sharpness(grey)
        if value > self._sharpness:
            self.frame, self.grey, self.seconds = frame, grey, seconds
            self._sharpness = value


def _grey(frame: VideoFrame) -> np.ndarray:
    width, height = scaled_size(frame.width, frame.height, FRAME_SIDE)
    small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    return small.to_ndarray()


def _write(best: _SharpestFrame, clip: Clip, folder: Path, number: int, size: int | None) -> Frame:
    frame = best.frame
    assert frame is not None
    image = Image.fromarray(rgb_picture(frame))
    turns = round(frame.rotation / 90) % 4
    if turns:  # counter-clockwise, as in Pillow
        image = image.transpose(Image.Transpose(1 + turns))
    image = resized(image, scaled_size(*upright_size(frame, clip.aspect), size))
    name = f"frame_{number:05d}.jpg"
    save(image, folder / name)
    return Frame(name, best.seconds, image.width, image.height)


def _log_summary(clip: Clip, frames: Frames) -> None:
    if frames.read < 0.97 * clip.declared_frames:
        logger.warning(
            "%s: the video is damaged or truncated; %d of its %d frames could be decoded",
            shown(clip.path),
            frames.read,
            clip.declared_frames,
        )
    same = sum(reason == SAME_VIEW for _, reason in frames.skipped)
    useless = len(frames.skipped) - same
    window = clip.seconds / max(1, len(frames.kept) + len(frames.skipped))
    line = f"{clip.path.name}: decoded {frames.read} frames ({clip.seconds:.1f} s of video), "
    line += f"selected {len(frames.kept)}: the sharpest of each {window:.2f} s"
    line += f"; {same} skipped because the camera did not move" if same else ""
    line += f"; {useless} skipped because they are black, white or blurred" if useless else ""
    logger.info("%s", line)
