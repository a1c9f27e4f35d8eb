"""What the program tells in English is in Chinese in the page in Chinese."""

import errno
import os
import re
import zipfile
from collections.abc import Callable

import pytest

from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.pipeline.stage_lines import described
from snowsplat.project.left_out import LeftOut
from snowsplat.project.page_film import PageFilm
from snowsplat.sfm.colmap.checks.diagnosis import Evidence, failure
from snowsplat.sfm.ingest.content.sharpness import BLACK, BLURRED
from snowsplat.sfm.ingest.inputs import _too_few
from snowsplat.sfm.ingest.search.sources import find_sources
from snowsplat.sfm.ingest.video.video_frames import SAME_VIEW
from snowsplat.studio.library import Library
from snowsplat.studio.library_requests import listing
from snowsplat.studio.texts import in_languages
from snowsplat.studio.uploads import Upload, safe_path, write_part
from snowsplat.util.errors import UserError, message_of
from snowsplat.util.messages import message
from snowsplat.util.run_lock import Holder


def translated(texts: list[object]) -> list[str]:
    return [in_languages(text)["zh"] for text in texts]


def english_in(text: str) -> list[str]:
    """The words of a translation that are no names of files, formats or measures."""
    return re.findall("[A-Za-z]{3,}", re.sub(r"/\S+|PSNR|JPEG|PNG|WebP|TIFF|HEIC|zip", "", text))


def test_progress_and_verdict():
    sfm = {"registered": list("abc"), "unregistered": {}, "points": 22445}
    sfm |= {"reprojection_error": 0.62, "sub_models": [3], "attempts": ["one"]}
    images = {"sizes": [(533, 948, 3)], "images": 3, "resampled": True, "masks": 0}
    reason = Reason("usable", "the photos are few", "")
    lines = [
        described("poses", sfm)[0],
        described("images", images)[0],
        described("images", images | {"resampled": False})[0],
        *described("scene", {"iteration": 900, "psnr": 28.3, "size": "533x948"}),
        *described("pictures", {}),
        *described("all", {"steps": 90, "photos": 50}),
        *described("all", {"steps": 90, "photos": 50, "left_out": 2}),
        *described(
            "all", {"steps": 0, "why_not": message("it would use each photo less than twice")}
        ),
        Verdict.of([reason]).head(message("the scene")),
        *("registered photos", "photos with features", "matched pairs", "verified pairs"),
    ]
    chinese = translated(lines)
    for text, english in zip(chinese, lines, strict=True):
        assert not english_in(text), english
    assert chinese[0] == "3 张照片中有 3 张求出了位姿，22,445 个点，重投影误差 0.62 像素"


def error_of(run: Callable[[], object]) -> object:
    with pytest.raises((UserError, OSError, ValueError)) as caught:
        run()
    error = caught.value
    return message_of(error) if isinstance(error, OSError) else error


def test_errors(tmp_path):
    empty, raw, text = tmp_path / "1", tmp_path / "2", tmp_path / "3.txt"
    for folder in (empty, raw):
        folder.mkdir()
    (raw / "a.CR2").write_bytes(b"raw")
    text.write_text("no photo")
    damaged, nothing = tmp_path / "4.zip", tmp_path / "5.zip"
    damaged.write_bytes(b"PK\x03\x04 and no more")
    with zipfile.ZipFile(nothing, "w") as archive:
        archive.writestr("readme.txt", "no photos")
    inputs = [empty, raw, text, damaged, nothing, tmp_path / "missing"]
    library = Library(tmp_path / "library")
    scene = library.new("scene", [])
    write_part(scene, Upload("1.jpg", 4, 0), b"1234")
    plain, detailed = [0] * 9, [900] * 9
    errors = [
        *(error_of(lambda at=at: find_sources([at])) for at in inputs),
        error_of(lambda: library.new("scene", [tmp_path / "missing"])),
        error_of(lambda: library.find("/missing")),
        error_of(library.new("empty", []).inputs),
        error_of(lambda: safe_path("..")),
        error_of(lambda: write_part(scene, Upload("/1.jpg/2.jpg", 5, 0), b"12345")),
        error_of(lambda: write_part(scene, Upload("/2.jpg", 9, 0, received=5), b"1")),
        error_of(lambda: listing(tmp_path / "missing")),
        failure(Evidence(plain, [], None, 36)),
        failure(Evidence(detailed, [], None, 36)),
        failure(Evidence(detailed, [], 0.0, 36)),
        _too_few(2, []),
        _too_few(0, [LeftOut("/1.jpg", "photos", BLACK), LeftOut("/2.jpg", "photos", BLACK)]),
        _too_few(1, [LeftOut("/1.jpg", "photos", BLURRED)] * 3),
        _too_few(1, [LeftOut("/1.mp4 at 1 s", "photos", SAME_VIEW)] * 3),
        _too_few(
            1,
            [
                LeftOut(
                    "/DSC.jpg",
                    "photos",
                    message("has only {width}x{height} pixels", width=8, height=8),
                )
            ]
            * 3,
        ),
        Holder().description(),
        error_of(lambda: PageFilm([])),
        *(
            message_of(OSError(number, os.strerror(number), "/full"))
            for number in (errno.ENOSPC, errno.EACCES, errno.EROFS)
        ),
    ]
    chinese = translated(errors)
    for text, english in zip(chinese, errors, strict=True):
        assert not english_in(text), english
    assert translated(["a text of another version"]) == ["a text of another version"]
