"""What the page of a scene shows in each of its states, without a job."""

import pytest

from snowsplat.evaluation.verdict import Reason, Verdict
from snowsplat.studio import job
from snowsplat.util.files import write_json
from snowsplat.util.messages import message

from ..browser import Browser

pytestmark = pytest.mark.browser

_STAGES = [
    {"stage": "photos", "lines": ["30 photos"], "seconds": 3.0, "again": False},
    {"stage": "poses", "lines": ["30 of 30 photos placed"], "seconds": 9.0, "again": True},
]
KILLED = {"en": "the process was killed", "zh": "进程被终止"}
_STEPS = {"step": 50, "iterations": 100, "gaussians": 1234, "left": 20.0, "psnr": 21.5}


def texts(page, selector: str) -> list[str]:
    return page.evaluate(f"[...document.querySelectorAll('{selector}')].map(e => e.textContent)")


def test_a_running_a_failed_and_a_finished_scene(studio, finished, monkeypatch):
    scene, address = finished, f"{studio.server.url}#Box"
    done = scene.state()
    running = {"stages": _STAGES, "notes": [{"en": "out of memory", "zh": "内存不足"}]}
    running |= {"curve": [[10, 0.5], [20, 0.3]], "steps": _STEPS, "now": {"stage": "scene"}}
    with Browser(1000, 800, frames=2.0) as browser:
        scene.write_state(running)
        monkeypatch.setattr(job, "is_running", lambda *_: True)
        page = browser.open(address)
        page.wait_for("document.querySelector('.status')?.dataset.status === 'running'")
        stages = texts(page, ".stages li[data-state=done]")
        assert ["30 photos (3 s)" in stages[0], "30 of 30" in stages[1]] == [True, True]
        assert "50 of 100" in texts(page, ".present")[0]
        assert page.evaluate("document.title") == "about 20 s left – Box"
        assert "21.50 dB" in texts(page, ".figures dd")
        assert texts(page, ".notes li") == ["out of memory"]
        assert page.evaluate("document.querySelector('polyline').points.length") == 2
        page.evaluate("document.querySelector('#language').click()")
        page.wait_for("document.querySelector('.status')?.textContent === '正在制作'")
        assert texts(page, ".notes li") == ["内存不足"]
        page.evaluate("document.querySelector('#language').click()")

        monkeypatch.setattr(job, "is_running", lambda *_: False)
        scene.write_state(running | {"outcome": "failed", "error": KILLED})
        page.wait_for("document.querySelector('.status')?.dataset.status === 'failed'")
        assert texts(page, "p.bad") == [KILLED["en"]]
        assert "Continue" in texts(page, "button")

        reason = Reason("poor", message("the memory was not enough"))
        record = {"stages": {"scene": {"result": {"verdict": Verdict.of([reason]).as_json()}}}}
        write_json(scene.made / "make.json", record)
        scene.write_state(done)
        page.wait_for("document.querySelector('.status')?.dataset.status === 'done'")
        assert texts(page, ".card ul li") == ["the memory was not enough"]
        assert texts(page, ".status .badge") == ["poor"]  # and the status is not green
        assert texts(page, ".card > h2")[0] == "Verdict"
        exports = studio.ask("scenes/Box")[1]["exports"]
        assert len(texts(page, ".export button")) == len(exports)
        assert not page.errors
