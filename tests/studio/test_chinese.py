"""What a job tells in English is in Chinese in the page in Chinese."""

import re
import shutil
import subprocess

import pytest

from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.pipeline.stage_lines import described
from snowsplat.util.html import CHINESE


@pytest.mark.skipif(shutil.which("node") is None, reason="needs Node.js")
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
        *described("scene", {"iteration": 900, "psnr": 28.3}),
        *described("pictures", {}),
        *described("all", {"steps": 90, "photos": 50}),
        Verdict.of([reason]).lines("The scene")[0],
        *("registered photos", "photos with features", "matched pairs", "verified pairs"),
    ]
    script = f"{CHINESE.read_text('utf-8')}; console.log({lines!r}.map(snowsplatChinese).join('|'))"
    shown = subprocess.run(["node", "-e", script], capture_output=True, text=True, check=True)
    chinese = shown.stdout.strip().split("|")
    assert len(chinese) == len(lines)
    for text, english in zip(chinese, lines, strict=True):
        assert not re.findall("[A-Za-z]{3,}", text.replace("PSNR", "")), english
    assert chinese[0] == "3 张照片中有 3 张求出了位姿，22,445 个点，重投影误差 0.62 像素"
