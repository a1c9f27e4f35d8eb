"""Video -> frames: sharp frames, between which the picture moves by about the same amount.

Decoding takes most of the time, so all frames are decoded in a single pass. It divides the video
into short windows. A window ends when the picture has moved by a small step, or after a time. The
sharpest frame of the current window is kept in memory, and is written as a candidate when the
window ends. The whole motion is known only at the end, so more candidates than necessary are
written. The frames to keep are chosen from them at the end, and the other files are deleted.

The length of the video is computed before from the times of the packets, because the length in the
header is missing in streams that browsers record, and wrong in truncated files.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
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
from snowsplat.sfm.ingest.key_frames import Candidate, choose
from snowsplat.sfm.ingest.motion import PictureMotion, has_moved
from snowsplat.sfm.ingest.photo_files import resized, save, scaled_size
from snowsplat.sfm.ingest.sharpness import (
    FRAME_SIDE,
    PICTURE_SIDE,
    grey_copy,
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

# The smallest step between candidates, as a fraction of the picture: nearly the same view.
_FINEST_STEP = 0.01
_FEW = 30  # for fewer frames than this, there are as many candidates as for this number


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


def extract_frames(clip: Clip, folder: Path, most: int, size: int | None, report: Report) -> Frames:
    """Write ``frame_00001.jpg`` … to an existing folder, in the order of time.

    During the pass, the folder contains more files than at the end: up to four times ``most``, or
    120 if that is more. They are deleted at the end, also after an error.

    Args:
        most: maximum number of frames, at least 1.
        size: resize larger frames to this longest side in pixels; None keeps the size.

    Raises:
        UserError: no frame can be decoded.
        OSError: the disk is full.
    """
    import av

    frames = Frames()
    name = clip.path.name
    candidates = _Candidates(clip, folder, most, size)
    motion = PictureMotion()
    try:
        with open_video(clip.path) as container:
            rate = float(container.streams.video[0].average_rate or 30)
            for frame in decoded_frames(container):
                timed = frame.time is not None
                seconds = frame.time - clip.start if timed else frames.read / rate
                grey = _grey(frame)
                candidates.offer(frame, grey, max(seconds, 0.0), motion.add(grey))
                frames.read += 1
                if frames.read % 10 == 0:
                    report(min(frames.read, clip.packets), clip.packets, f"frames of {name}")
        frames.kept = candidates.finish()
    except (av.FFmpegError, ValueError) as error:
        raise nothing_decodes(clip.path, error) from None
    finally:
        candidates.delete()
    if not frames.read:
        raise nothing_decodes(clip.path, None)
    frames.skipped = candidates.skipped
    report(clip.packets, clip.packets, f"frames of {name}")
    _log_summary(clip, frames)
    return frames


class _Candidates:
    """Divides a video into windows, and writes the sharpest frame of each as a candidate."""

    def __init__(self, clip: Clip, folder: Path, most: int, size: int | None) -> None:
        self.skipped: list[tuple[float, str]] = []  # time (s) and reason
        self._clip, self._folder, self._most, self._size = clip, folder, most, size
        self._many = max(most, _FEW)
        self._longest = clip.seconds / most - 1e-3  # seconds; times are rounded to 1 ms
        self._candidates: list[Candidate] = []
        self._frames: dict[int, Frame] = {}  # by the number of the candidate
        self._written = 0
        self._best = _SharpestFrame()
        self._opened = (0.0, 0.0)  # time (s) and motion at which the window began
        self._last: np.ndarray | None = None  # small copy of the last candidate

    def offer(self, frame: VideoFrame, grey: np.ndarray, seconds: float, moved: float) -> None:
        """Take the next frame. ``moved``: the result of `PictureMotion`."""
        if self._best.frame is None:
            self._opened = seconds, moved
        # The final step is at least the present motion divided by the number of frames. So this
        # step is at most half of the final one, at any time.
        step = max(_FINEST_STEP, moved / (2 * self._many))
        if seconds - self._opened[0] >= self._longest or moved - self._opened[1] >= step:
            self._close_window()
            self._opened = seconds, moved
        self._best.offer(frame, grey, seconds, moved)

    def finish(self) -> list[Frame]:
        """Delete the candidates that are not chosen, and rename the others."""
        self._close_window()
        self._thin(self._most)
        kept = []
        for number, candidate in enumerate(self._candidates, 1):
            frame = self._frames.pop(candidate.number)
            kept.append(replace(frame, name=f"frame_{number:05d}.jpg"))
            (self._folder / frame.name).rename(self._folder / kept[-1].name)
        return kept

    def delete(self) -> None:
        """Delete the candidates that `finish` has not renamed."""
        for frame in self._frames.values():
            (self._folder / frame.name).unlink(missing_ok=True)
        self._frames.clear()

    def _close_window(self) -> None:
        best = self._best
        if best.frame is None or best.grey is None:
            return
        small = grey_copy(Image.fromarray(best.grey), PICTURE_SIDE)
        reason = why_useless(small)
        last = self._last
        if reason is None and last is not None and last.shape == small.shape:
            reason = None if has_moved(last, small) else SAME_VIEW
        if reason is None:
            self._written += 1
            path = self._folder / f"candidate_{self._written:06d}.jpg"
            self._frames[self._written] = _write(best, self._clip, path, self._size)
            self._candidates.append(Candidate(best.moved, best.sharpness, self._written))
            self._last = small
            if len(self._candidates) > 4 * self._many:
                self._thin(2 * self._many)
        else:
            self.skipped.append((best.seconds, reason))
        best.reset()

    def _thin(self, most: int) -> None:
        self._candidates = choose(self._candidates, most)
        kept = {candidate.number for candidate in self._candidates}
        for number in self._frames.keys() - kept:
            (self._folder / self._frames.pop(number).name).unlink()


class _SharpestFrame:
    """The sharpest frame since the last reset."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        self.frame: VideoFrame | None = None
        self.grey: np.ndarray | None = None  # (H, W) uint8, not rotated
        self.seconds = 0.0
        self.moved = 0.0
        self.sharpness = -1.0

    def offer(self, frame: VideoFrame, grey: np.ndarray, seconds: float, moved: float) -> None:
        value = sharpness(grey)
        if value > self.sharpness:
            self.frame, self.grey, self.seconds = frame, grey, seconds
            self.moved, self.sharpness = moved, value


def _grey(frame: VideoFrame) -> np.ndarray:
    width, height = scaled_size(frame.width, frame.height, FRAME_SIDE)
    small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    return small.to_ndarray()


def _write(best: _SharpestFrame, clip: Clip, path: Path, size: int | None) -> Frame:
    frame = best.frame
    assert frame is not None
    image = Image.fromarray(rgb_picture(frame))
    turns = round(frame.rotation / 90) % 4
    if turns:  # counter-clockwise, as in Pillow
        image = image.transpose(Image.Transpose(1 + turns))
    image = resized(image, scaled_size(*upright_size(frame, clip.aspect), size))
    save(image, path)
    return Frame(path.name, best.seconds, image.width, image.height)


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
    line = f"{clip.path.name}: decoded {frames.read} frames ({clip.seconds:.1f} s of video), "
    line += f"selected {len(frames.kept)} sharp frames, by how far the picture moved"
    line += f"; {same} skipped because the camera did not move" if same else ""
    line += f"; {useless} skipped because they are black, white or blurred" if useless else ""
    logger.info("%s", line)
