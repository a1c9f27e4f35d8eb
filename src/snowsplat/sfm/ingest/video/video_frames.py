"""Writes frames of a video as files: sharp frames with about the same motion between them.

Decoding takes most of the time, so all frames are decoded only once. The video is divided into
short windows. A window ends when the motion in it reaches a small step, or after a maximum time.
The sharpest frame of the current window is kept in memory, and is written as a candidate when the
window ends. The motion of the whole video is known only at the end, so more candidates than
necessary are written. At the end, `choose` selects the frames to keep, and the files of the other
candidates are deleted.

The duration of the video is computed before, from the times of the packets (`read_clip`). The
duration in the header is missing in streams that browsers record, and wrong in truncated files.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from PIL import Image

from snowsplat.data.photos.tone_mapping import HLG, PQ, map_tones
from snowsplat.sfm.ingest.content.fixed_parts import (
    ENOUGH_PHOTOS,
    Crop,
    box_of,
    describe_bars,
    find_fixed_parts,
)
from snowsplat.sfm.ingest.content.panorama import shows_all_around
from snowsplat.sfm.ingest.content.sharpness import (
    CONTENT_SIDE,
    SHARPNESS_SIDE,
    grey_copy,
    sharpness,
    why_unusable,
)
from snowsplat.sfm.ingest.photos.photo_files import resize_photo, save
from snowsplat.sfm.ingest.video.clip import (
    Clip,
    decoded_frames,
    open_video,
    undecodable,
    video_stream,
)
from snowsplat.sfm.ingest.video.interlace import field_order, whole_frames
from snowsplat.sfm.ingest.video.key_frames import Candidate, choose
from snowsplat.sfm.ingest.video.motion import FrameMotion, has_moved
from snowsplat.sfm.progress import Report
from snowsplat.util.files import shown
from snowsplat.util.image_size import scaled_size
from snowsplat.util.messages import Message, message

if TYPE_CHECKING:
    from av import VideoFrame

# Matrix coefficients: code points of ITU-T H.273.
_BT709 = 1
_UNSPECIFIED = 2
_BT2020 = 9
# Rows of a frame from which on video players assume the matrix of BT.709, if none is declared.
_HD = 720


def rgb_image(frame: VideoFrame) -> np.ndarray:
    """(H, W, 3) uint8 sRGB of a decoded frame, in the stored orientation."""
    matrix = None  # None: the matrix that the frame declares
    if frame.colorspace == _UNSPECIFIED and frame.height >= _HD:
        matrix = _BT709
    transfer = frame.color_trc
    if transfer not in (PQ, HLG):
        return frame.reformat(format="rgb24", src_colorspace=matrix).to_ndarray()
    if frame.colorspace == _UNSPECIFIED:
        matrix = _BT2020
    rgb48 = frame.reformat(format="rgb48le", src_colorspace=matrix)
    deep = rgb48.to_ndarray().astype(np.uint16, copy=False)
    return map_tones(deep, transfer)


logger = logging.getLogger(__name__)

SAME_VIEW = message("shows the same view as the previous frame")

# The smallest motion in a window, as a fraction of the longest side: nearly the same view.
_MIN_STEP = 0.01
# If fewer frames are requested, there are as many candidates as for this number of frames.
_MIN_COUNT = 30
# With fewer key frames, what is fixed to the frame is not found reliably.
_FEW_KEY_FRAMES = 8
_MOST_CANDIDATES = 4  # times the number of frames to keep; then half of them are deleted
_REPORTED = 10  # frames between two reports of the progress
_WHOLE = 0.97  # of the declared frames; if fewer can be decoded, the video is damaged


@dataclass(frozen=True)
class Frame:
    """A frame that was written."""

    name: str
    seconds: float  # from the beginning of the video
    width: int
    height: int


@dataclass(frozen=True)
class _Written(Candidate):
    """A frame that may be kept, and its file."""

    frame: Frame


@dataclass
class Frames:
    """The result of extracting frames from a video."""

    kept: list[Frame] = field(default_factory=list)
    # The sharpest frames of windows without a candidate: time (s) and reason.
    skipped: list[tuple[float, Message]] = field(default_factory=list)
    read: int = 0  # number of decoded frames
    notes: list[Message] = field(default_factory=list)  # lines for the user
    panoramas: bool = False  # the frames show all directions


def extract_frames(
    clip: Clip,
    folder: Path,
    max_frames: int,
    size: int | None,
    report: Report,
    panoramas: bool = False,
) -> Frames:
    """Write ``frame_00001.jpg`` … to an existing folder, in the order of time.

    While the video is decoded, the folder contains more files: up to four times ``max_frames``, or
    120 if that is more. The other files are deleted at the end, also after an error.

    Args:
        max_frames: maximum number of frames, at least 1.
        size: resize larger frames to this longest side in pixels; None keeps the size.
        panoramas: the frames are 360° panoramas; False: if their pixels are those of panoramas.

    Raises:
        UserError: no frame can be decoded.
        OSError: the disk is full.
    """
    import av

    frames = Frames()
    name = clip.path.name
    try:
        copies = _copies(clip)
        order = field_order(clip)
    except (av.FFmpegError, ValueError) as error:
        raise undecodable(clip.path, error) from None
    around = sum(shows_all_around(Image.fromarray(copy)) for copy in copies)
    frames.panoramas = panoramas or around > len(copies) / 2
    # The rows at the poles of a panorama would be bars.
    parts = find_fixed_parts(np.stack(copies)) if copies and not frames.panoramas else None
    crop = parts.crop if parts else None
    fixed = None if parts is None else _crop(parts.fixed, crop)
    candidates = _Candidates(clip, folder, max_frames, size, crop, fixed)
    motion = FrameMotion(fixed)
    try:
        with open_video(clip.path) as container:
            rate = float(video_stream(container).average_rate or 30)
            decoded = decoded_frames(container)
            for frame in decoded if order is None else whole_frames(decoded, order):
                timed = frame.time is not None
                seconds = frame.time - clip.start if timed else frames.read / rate
                grey = _crop(_grey(frame), crop)
                candidates.offer(frame, grey, max(seconds, 0.0), motion.add(grey))
                frames.read += 1
                if frames.read % _REPORTED == 0:
                    report(min(frames.read, clip.packets), clip.packets, f"frames of {name}")
        frames.kept = candidates.finish()
    except (av.FFmpegError, ValueError) as error:
        raise undecodable(clip.path, error) from None
    finally:
        candidates.delete()
    if not frames.read:
        raise undecodable(clip.path, None)
    frames.skipped = candidates.skipped
    if parts is not None and crop is not None:
        frames.notes.append(describe_bars(parts, True, message("all frames")))
    if order is not None:
        frames.notes.append(
            message("the video is interlaced; rows between those of one field are computed")
        )
    report(clip.packets, clip.packets, f"frames of {name}")
    _log_summary(clip, frames)
    return frames


@dataclass
class _Candidates:
    """Divides a video into windows, and writes the sharpest frame of each as a candidate."""

    clip: Clip
    folder: Path
    max_frames: int
    size: int | None
    crop: Crop | None
    fixed: np.ndarray | None
    skipped: list[tuple[float, Message]] = field(default_factory=list)  # time (s) and reason
    _candidates: list[_Written] = field(default_factory=list)
    _written: int = 0
    _best: _Sharpest | None = None  # of the current window
    _window_start: tuple[float, float] = 0.0, 0.0  # time (s) and motion at which the window began
    _last: np.ndarray | None = None  # small copy of the last candidate

    def __post_init__(self) -> None:
        self._count = max(self.max_frames, _MIN_COUNT)
        # The longest window. Times are rounded to 1 ms.
        self._max_seconds = self.clip.seconds / self.max_frames - 1e-3

    def offer(self, frame: VideoFrame, grey: np.ndarray, seconds: float, moved: float) -> None:
        """Take the next frame.

        Args:
            grey: (H, W) uint8, its small copy, between the bars.
            seconds: its time, from the first frame.
            moved: the result of `FrameMotion.add`.
        """
        if self._best is None:
            self._window_start = seconds, moved
        # The motion only increases. At the end, `choose` uses a step of at least the whole motion
        # divided by the number of frames, so the step of a window is at most half of it.
        step = max(_MIN_STEP, moved / (2 * self._count))
        if (
            seconds - self._window_start[0] >= self._max_seconds
            or moved - self._window_start[1] >= step
        ):
            self._close_window()
            self._window_start = seconds, moved
        value = sharpness(grey)
        if self._best is None or value > self._best.sharpness:
            self._best = _Sharpest(frame, grey, seconds, moved, value)

    def finish(self) -> list[Frame]:
        """Delete the candidates that are not chosen, and rename the others."""
        self._close_window()
        self._thin(self.max_frames)
        kept = []
        for number, candidate in enumerate(self._candidates, 1):
            kept.append(replace(candidate.frame, name=f"frame_{number:05d}.jpg"))
            (self.folder / candidate.frame.name).rename(self.folder / kept[-1].name)
        return kept

    def delete(self) -> None:
        """Delete the candidates that `finish` has not renamed."""
        for candidate in self._candidates:
            (self.folder / candidate.frame.name).unlink(missing_ok=True)

    def _close_window(self) -> None:
        """Write the sharpest frame of the window as a candidate, unless it must be skipped."""
        best, self._best = self._best, None
        if best is None:
            return
        small = grey_copy(Image.fromarray(best.grey), CONTENT_SIDE)
        reason = why_unusable(small)
        last = self._last
        if reason is None and last is not None and last.shape == small.shape:
            reason = None if has_moved(last, small, self.fixed) else SAME_VIEW
        if reason is None:
            self._written += 1
            path = self.folder / f"candidate_{self._written:06d}.jpg"
            frame = _write(best, self.clip, path, self.size, self.crop)
            self._candidates.append(_Written(best.moved, best.sharpness, self._written, frame))
            self._last = small
            if len(self._candidates) > _MOST_CANDIDATES * self._count:
                self._thin(2 * self._count)
        else:
            self.skipped.append((best.seconds, reason))

    def _thin(self, max_frames: int) -> None:
        before, self._candidates = self._candidates, choose(self._candidates, max_frames)
        for candidate in before:
            if candidate not in self._candidates:
                (self.folder / candidate.frame.name).unlink()


@dataclass(frozen=True)
class _Sharpest:
    """The sharpest frame of a window."""

    frame: VideoFrame
    grey: np.ndarray  # (H, W) uint8, not rotated, between the bars
    seconds: float
    moved: float
    sharpness: float


def _grey(frame: VideoFrame) -> np.ndarray:
    width, height = scaled_size(frame.width, frame.height, SHARPNESS_SIDE)
    small = frame.reformat(width=width, height=height, format="gray", interpolation="AREA")
    return small.to_ndarray()


def _copies(clip: Clip) -> list[np.ndarray]:
    """Small copies of frames, of one size, to find what is fixed before the frames are chosen.

    What is fixed would hide the motion. The copies are not rotated. Only if there are few key
    frames, all frames are decoded.
    """
    copies = _spread_copies(clip, key_frames=True)
    if len(copies) < _FEW_KEY_FRAMES:
        copies = _spread_copies(clip, key_frames=False)
    return [copy for copy in copies if copy.shape == copies[0].shape]


def _spread_copies(clip: Clip, key_frames: bool) -> list[np.ndarray]:
    """Grey copies of frames at equal distances, `ENOUGH_PHOTOS` to twice as many, if possible."""
    copies: list[np.ndarray] = []
    step = 1
    with open_video(clip.path) as container:
        if key_frames:
            video_stream(container).codec_context.skip_frame = "NONKEY"
        for i, frame in enumerate(decoded_frames(container)):
            if i % step == 0:
                copies.append(_grey(frame))
            if len(copies) == 2 * ENOUGH_PHOTOS:
                copies, step = copies[::2], 2 * step
    return copies


def _crop(pixels: np.ndarray, crop: Crop | None) -> np.ndarray:
    """The part of an image (H, W, …) between the bars."""
    if crop is None:
        return pixels
    left, top, right, bottom = box_of(crop, pixels.shape[1], pixels.shape[0])
    return np.ascontiguousarray(pixels[top:bottom, left:right])


def _write(best: _Sharpest, clip: Clip, path: Path, size: int | None, crop: Crop | None) -> Frame:
    frame = best.frame
    image = Image.fromarray(_crop(rgb_image(frame), crop))
    width, height = round(image.width * clip.aspect), image.height
    turns = round(frame.rotation / 90) % 4
    if turns:  # counter-clockwise, as in Pillow
        image = image.transpose(Image.Transpose(1 + turns))
        width, height = (height, width) if turns % 2 else (width, height)
    image = resize_photo(image, scaled_size(width, height, size))
    save(image, path)
    return Frame(path.name, best.seconds, image.width, image.height)


def _log_summary(clip: Clip, frames: Frames) -> None:
    if frames.read < _WHOLE * clip.declared_frames:
        logger.warning(
            "%s: the video is damaged or truncated; %d of its %d frames could be decoded",
            shown(clip.path),
            frames.read,
            clip.declared_frames,
        )
    same = sum(reason == SAME_VIEW for _, reason in frames.skipped)
    useless = len(frames.skipped) - same
    line = f"{clip.path.name}: decoded {frames.read} frames ({clip.seconds:.1f} s of video), "
    line += f"selected {len(frames.kept)} sharp frames with about the same motion between them"
    line += f"; {same} skipped because the camera did not move" if same else ""
    line += f"; {useless} skipped because they are black, white or blurred" if useless else ""
    logger.info("%s", line)
