"""The report of a training run: complete, self-contained, correct, and without private paths."""

import json
import re
import xml.etree.ElementTree as ET
from typing import Any

import pytest

from snowsplat.data import load_dataset
from snowsplat.synthetic.toy_dataset import write_toy_dataset
from snowsplat.training.core.history import History
from snowsplat.training.core.trainer import Trainer
from snowsplat.training.parts.part import PartReport, Section
from snowsplat.training.report import Trained, write_training_report
from snowsplat.training.settings.config import TrainConfig
from snowsplat.util.messages import message

from ...browser import chinese_labels, english_text

pytestmark = pytest.mark.slow  # trains

NAME = "mon <château>"
EXPOSURES = PartReport(
    sections=(
        Section(message("Exposures of the photos"), (), (0.5, -1.0, 0.5), message("exposure, EV")),
    )
)


@pytest.fixture(scope="module")
def trained(tmp_path_factory) -> dict[str, Any]:
    """Arguments of `Trained`, with a name that needs escaping."""
    folder = tmp_path_factory.mktemp("report") / "dataset"
    write_toy_dataset(folder, n_views=17, width=48, height=36, n_points=300)
    dataset = load_dataset(folder, hold_out=2)
    trainer = Trainer(dataset, TrainConfig(iterations=40, test_iterations=(20, 40)))
    history = History()

    def record(progress: Any) -> None:
        history.step_ends(progress.step, progress.loss, progress.gaussians)
        if progress.metrics is not None:
            history.measure(progress.step, progress.metrics.psnr, progress.metrics.ssim)
        history.step_begins()

    trainer.run(record)
    return {
        "name": NAME,
        "folder": "out of/here",
        "dataset": dataset,
        "gaussians": trainer.gaussians,
        "step": 40,
        "background": (0.0, 0.0, 0.0),
        "history": history,
        "evaluation": trainer.evaluate(),
        "settings": {"recipe": "a & b", "training": {"iterations": 40}},
        "peak_bytes": 123_000_000,
    }


def test_the_page_is_well_formed_and_self_contained(trained, tmp_path):
    page = tmp_path / "report.html"
    write_training_report(page, Trained(**trained))
    text = page.read_text(encoding="utf-8")
    root = ET.fromstring(text)
    icon, *sources = re.findall(r'(?:src|href)="([^"]*)"', text)
    assert icon == "data:,"
    assert len(sources) == 3 * 5
    assert all(source.startswith("data:image/jpeg;base64,") for source in sources)
    assert "url(" not in text
    assert page.stat().st_size < 200_000
    charts = root.findall(".//{http://www.w3.org/2000/svg}svg")
    titles = [chart.find("{http://www.w3.org/2000/svg}title").text for chart in charts]
    assert titles == ["loss", "PSNR, dB", "Gaussians", "time of a step, ms"]


def test_the_page_contains_the_results(trained, tmp_path):
    write_training_report(tmp_path / "report.html", Trained(**trained))
    content = english_text(tmp_path / "report.html")
    evaluation = trained["evaluation"]
    for expected in (
        NAME,
        f"{evaluation.psnr:.2f} dB",
        f"{evaluation.ssim:.3f}",
        f"{len(trained['gaussians']):,}",
        "9 photos of 48x36 that were not used for training",
        "8 to train on, 9 held out",
        "48 × 36",
        "a & b",
        "0.1 GB peak",
        "trained on",
        "snowsplat view 'out of/here'",
    ):
        assert expected in content
    # The worst views are sorted with the worst first, the best views with the best first. The table
    # has every view.
    order = sorted(evaluation.views, key=lambda view: view.psnr)
    shown = [f"{view.name}: PSNR" for view in (*order[:3], order[-1], order[-2])]
    places = [content.index(name) for name in shown]
    assert places == sorted(places)
    assert all(content.count(view.name) >= 1 for view in evaluation.views)


def test_the_exposures_of_the_photos(trained, tmp_path):
    page = tmp_path / "report.html"
    write_training_report(page, Trained(**trained, parts=[EXPOSURES]))
    titles = [e.text for e in ET.parse(page).iter("{http://www.w3.org/2000/svg}title")]
    assert "exposure, EV" in titles[-2:]
    assert "Exposures of the photos" in english_text(page)


def test_without_held_out_photos_training_photos_are_evaluated(trained, tmp_path):
    dataset = trained["dataset"]
    without_test = type(dataset)(dataset.train, [], dataset.points, dataset.extent)
    changed = trained | {"dataset": without_test, "evaluation": None, "history": History()}
    write_training_report(tmp_path / "report.html", Trained(**changed))
    content = english_text(tmp_path / "report.html")
    assert "No photos were held out" in content
    assert "8 photos of 48x36 used for training" in content
    assert "8 to train on, 0 held out" in content


def test_photos_that_are_left_out_are_not_evaluated(trained, tmp_path):
    dataset = trained["dataset"]
    names = tuple(view.name for view in dataset.train[:2])
    without_test = type(dataset)(dataset.train, [], dataset.points, dataset.extent)
    changed = trained | {"dataset": without_test, "evaluation": None, "left_out": names}
    write_training_report(tmp_path / "report.html", Trained(**changed))
    content = english_text(tmp_path / "report.html")
    assert "6 photos of 48x36 used for training" in content
    assert names[0] not in content


def test_train_writes_the_report_and_a_resumed_run_continues_its_curves(tmp_path):
    """The command line is used. The page contains names, but no absolute paths."""
    from snowsplat.cli.main import main

    write_toy_dataset(tmp_path / "photos", n_views=9, width=48, height=36, n_points=300)
    out = tmp_path / "out"
    train = ["train", str(tmp_path / "photos"), "-o", str(out), "--eval", "-q"]
    assert main([*train, "--iterations", "20", "--checkpoint-every", "10"]) == 0
    first = english_text(out / "report.html")
    for name in ("history.json", "report.html"):  # a kill leaves such files
        (out / f".{name}.ab12cd_9.tmp").write_text("half")
    again = ["train", "-o", str(out), "--resume", "-q", "--iterations", "30"]
    assert main([*again, "--test-iterations", "25"]) == 0
    assert not list(out.rglob("*.tmp"))
    history = json.loads((out / "history.json").read_text())
    assert sum(stretch["steps"] for stretch in history["stretches"]) == 30
    assert [measured["step"] for measured in history["measured"]] == [20, 25, 30]
    page = (out / "report.html").read_text()
    assert english_text(out / "report.html") != first
    assert str(tmp_path) not in page
    assert "photos" in page
    assert main([*train, "--iterations", "10", "--overwrite"]) == 0
    history = json.loads((out / "history.json").read_text())
    assert sum(stretch["steps"] for stretch in history["stretches"]) == 10


@pytest.mark.browser
def test_headings_and_labels_are_chinese_in_a_browser_in_chinese(trained, tmp_path):
    path = tmp_path / "report.html"
    write_training_report(path, Trained(**trained, parts=[EXPOSURES]))
    chinese_labels(path)
