"""The interactive figures of the course in a real browser: by keys, mouse and touch.

They are a part of the documentation, not of the package: only whether they work is tested with each
change, in both languages; what they show, at night.
"""

import base64
import io
import json
import math
import re
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.extras.image.fit import Fitter
from snowsplat.extras.image.options import FitOptions
from snowsplat.ops import reference
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render

from ..browser import Browser, Page, chromium

DOCS = Path(__file__).resolve().parents[2] / "docs"
SPACE = ["space-ellipsoid", "space-degrees", "space-order", "space-training"]
FIGURES = ["covariance", "projection", "harmonics", "blending", "tiles", "density", "fit", *SPACE]
DRAWN = (
    "[...document.querySelectorAll('.interactive')].every(e => e.querySelector('.status')"
    "?.textContent)"
)

pytestmark = [
    pytest.mark.browser,
    pytest.mark.skipif(chromium() is None, reason="needs Chromium"),
]


def html(language: str) -> str:
    blocks = "".join(
        f'<div class="interactive" data-figure="{name}">words</div>' for name in FIGURES
    )
    return (
        f'<!doctype html><html lang="{language}"><meta charset="utf-8">'
        f'<link rel="stylesheet" href="{DOCS}/static/site.css"><body>{blocks}'
        f'<script src="{DOCS}/static/interactive/interactive.js" defer></script>'
    )


@pytest.fixture(scope="module")
def browser():
    with Browser(390, 900) as running:
        yield running


@pytest.fixture(scope="module")
def page(browser, tmp_path_factory):
    """All figures, opened as a file."""
    file = tmp_path_factory.mktemp("figures") / "figures.html"
    file.write_text(html("en"), encoding="utf-8")
    page = browser.open(file.as_uri())
    page.wait_for(DRAWN)
    yield page
    assert not page.errors


def part(figure: str, selector: str) -> str:
    return f"document.querySelector('[data-figure={figure}] {selector}')"


def data(page: Page, figure: str, name: str) -> str:
    return str(page.evaluate(f"document.querySelector('[data-figure={figure}]').dataset.{name}"))


def put(page: Page, figure: str, name: str, value: object) -> None:
    """Give an input a value, as a reader does."""
    page.evaluate(
        f"(input => {{ input.value = '{value}';"
        "for (const kind of ['input', 'change']) input.dispatchEvent(new Event(kind)); })"
        f"({part(figure, f'[name={name}]')})"
    )


def press(page: Page, figure: str, name: str) -> None:
    page.evaluate(f"{part(figure, f'[name={name}]')}.click()")


def keys(page: Page, figure: str, selector: str, key: str, times: int = 1) -> None:
    page.evaluate(f"{part(figure, selector)}.focus()")
    for _ in range(times):
        page.key(key)


def place(page: Page, figure: str, selector: str) -> tuple[float, float]:
    """The middle of an element, in the window."""
    script = """(e => { e.scrollIntoView({ block: "center" }); const box =
        e.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; })"""
    x, y = page.evaluate(f"{script}({part(figure, selector)})")
    return x, y


def touch(page: Page, *places: tuple[float, float]) -> None:
    """Drag a finger along some places."""
    kinds = ["touchStart", *["touchMove"] * (len(places) - 1), "touchEnd"]
    for kind, points in zip(kinds, [*([place] for place in places), []], strict=True):
        found = [{"x": x, "y": y} for x, y in points]
        page.call("Input.dispatchTouchEvent", type=kind, touchPoints=found)


def test_they_fit_on_a_phone_and_speak_the_language_of_the_page(page, browser, tmp_path):
    assert page.evaluate("document.documentElement.scrollWidth <= 390")
    file = tmp_path / "zh.html"
    file.write_text(html("zh-CN"), encoding="utf-8")
    chinese = browser.open(file.as_uri())
    chinese.wait_for(DRAWN)
    words = "[...document.querySelectorAll('.status, label, button')].map(e => e.textContent)"
    assert not [
        w for w in chinese.evaluate(words) if re.search("[a-z]{4,}", w.replace("splat", ""))
    ]
    assert chinese.evaluate("document.documentElement.scrollWidth <= 390")
    assert not chinese.errors
    chinese.close()


def test_every_page_has_its_figures():
    for folder in (DOCS / "learn", DOCS / "zh" / "learn"):
        text = "".join(path.read_text(encoding="utf-8") for path in folder.glob("*.md"))
        assert sorted(re.findall('data-figure="(.*?)"', text)) == sorted(FIGURES)


def test_every_slider_shows_its_value_and_each_figure_says_what_to_try(page):
    shown = """[...document.querySelectorAll("label input[type=range]")].every(input =>
        Math.abs(Number(input.nextSibling.textContent.replace("−", "-")) - input.value) < 1e-9)"""
    assert page.evaluate(shown)
    put(page, "space-degrees", "degree", 1)
    keys(page, "covariance", "[data-handle=s1]", "ArrowUp")  # changes a slider, too
    assert page.evaluate(shown)
    words = page.evaluate("[...document.querySelectorAll('.try')].map(e => e.textContent)")
    assert len(words) == len(FIGURES) == len(set(words))


def picture(page: Page, figure: str) -> np.ndarray:
    """(H, W, 3) in 0..1: what the canvas of a 3D figure shows."""
    url = page.evaluate(part(figure, "canvas") + ".toDataURL()")
    image = Image.open(io.BytesIO(base64.b64decode(url.partition(",")[2]))).convert("RGB")
    return np.asarray(image) / 255.0


def test_the_object_turns_by_keys_mouse_and_touch_in_all_figures(page):
    turns = [data(page, "space-order", "turn")]
    keys(page, "space-ellipsoid", "canvas", "ArrowLeft")
    turns.append(data(page, "space-order", "turn"))
    x, y = place(page, "space-degrees", "canvas")
    page.drag(x, y, x + 30, y + 10)
    turns.append(data(page, "space-order", "turn"))
    x, y = place(page, "space-training", "canvas")
    touch(page, (x, y), (x + 20, y), (x + 40, y + 10))
    turns.append(data(page, "space-order", "turn"))
    assert len(set(turns)) == 4
    assert {data(page, figure, "turn") for figure in SPACE} == {turns[-1]}
    assert page.evaluate("JSON.parse(sessionStorage.space).length") == 2


@pytest.mark.nightly
def test_the_object_is_drawn_as_snowsplat_draws_it(page):
    """With each degree of SH; the ellipsoid's matrix; the layers; the rounds of the training."""
    text = (DOCS / "static" / "interactive" / "space-data.js").read_text(encoding="utf-8")
    stages = json.loads(text[text.index("[[") : text.index("]]") + 2])
    blob = base64.b64decode(text[text.index('data: "') + 7 : text.rindex('"')])
    count = stages[-1][1]
    at = sum(18 * n for _, n in stages[:-1])

    def take(columns: int, low: float, high: float, kind: str = "u1") -> torch.Tensor:
        nonlocal at
        values = np.frombuffer(blob, kind, count * columns, at).astype(np.float32)
        at += count * columns * np.dtype(kind).itemsize
        top = 65535 if kind == "<u2" else 255
        return torch.tensor(low + (high - low) * values / top).reshape(count, columns)

    means, log_scales, quats = take(3, -2, 2, "<u2"), take(3, -7, 1), take(4, -1, 1)
    logits, dc, _ = take(1, 0, 1).clamp(0, 0.9999).logit()[:, 0], take(3, -2.5, 2.5), take(1, 0, 1)
    rest = take(45, -1, 1).reshape(count, 3, 15).mT.contiguous()
    assert at == len(blob)
    object_ = Gaussians(means, log_scales, quats, logits, dc[:, None], rest)
    for degree in range(4):
        put(page, "space-degrees", "degree", degree)
        a, b = (float(v) for v in data(page, "space-degrees", "turn").split(","))
        y, x = (
            np.array([[math.cos(a), 0, math.sin(a)], [0, 1, 0], [-math.sin(a), 0, math.cos(a)]]),
            b,
        )
        tilt = [[1, 0, 0], [0, math.cos(x), -math.sin(x)], [0, math.sin(x), math.cos(x)]]
        pose = np.concatenate([np.array(tilt) @ y, [[0], [0], [4]]], axis=1)
        camera = Camera(660, 660, 1.45 * 660, 1.45 * 660, 330, 330, torch.tensor(pose))
        expected = render(object_, camera, torch.ones(3), degree).image.clamp(0, 1)
        found = picture(page, "space-degrees")
        assert np.abs(found - expected.numpy()).mean() < 0.004
    put(page, "space-order", "removed", count)
    assert picture(page, "space-order").min() == 1
    for name, value in {"s1": 0.5, "s2": 0.2, "s3": 0.1, "x": 0, "y": 0, "z": 1}.items():
        put(page, "space-ellipsoid", name, value)
    sigma = [float(v) for v in data(page, "space-ellipsoid", "sigma").split(",")]
    assert sigma == pytest.approx([0.04, 0, 0, 0.25, 0, 0.01], abs=1e-6)  # 90° around z
    for stage, (step, number) in enumerate(stages):
        put(page, "space-training", "stage", stage)
        words = page.evaluate(part("space-training", ".status") + ".textContent")
        assert f"Step {step}, {number} Gaussians" in words
        assert ("clones" in words) == (stage in (2, 4, 6))


@pytest.mark.nightly
def test_covariance(page):
    """The matrix is that of the sliders; the entries can be no covariance."""
    put(page, "covariance", "s1", 2)
    put(page, "covariance", "s2", 1)
    put(page, "covariance", "angle", 90)
    numbers = page.evaluate(part("covariance", "pre") + ".textContent")
    assert re.search(r"Σ = +1\.00 +0\.00\n +0\.00 +4\.00", numbers)
    # The end of the first axis points up: the key moves it farther away.
    keys(page, "covariance", "[data-handle=s1]", "ArrowUp", 2)
    assert float(page.evaluate(part("covariance", "[name=s1]") + ".value")) == pytest.approx(
        2 + 2 * 8.4 / 60, abs=0.01
    )
    x, y = place(page, "covariance", "[data-handle=s2]")
    page.drag(x, y, x - 20, y)
    assert float(page.evaluate(part("covariance", "[name=s2]") + ".value")) > 1.3
    put(page, "covariance", "stored", "entries")
    put(page, "covariance", "b", 5)
    assert data(page, "covariance", "valid") == "false"
    put(page, "covariance", "b", 0)
    assert data(page, "covariance", "valid") == "true"


@pytest.mark.nightly
def test_projection(page):
    """A small Gaussian is projected as the theory says; a near and large one is not. By touch."""
    exact = 1 - math.exp(-2)  # inside of k = 2, in two dimensions
    put(page, "projection", "size", 0.05)
    assert float(data(page, "projection", "share")) == pytest.approx(exact, abs=0.04)
    x, y = place(page, "projection", "[data-handle=centre]")
    scale = page.evaluate(part("projection", "svg") + ".getBoundingClientRect().width") / 330
    touch(page, (x, y), (x, y + 50 * scale), (x, y + 110 * scale))
    put(page, "projection", "size", 0.8)
    assert float(data(page, "projection", "share")) < exact - 0.1
    status = page.evaluate(part("projection", ".status") + ".textContent")
    assert "Behind the camera" in status


@pytest.mark.nightly
def test_harmonics(page):
    """The coefficients are those of the reference, and each degree lowers the error."""
    put(page, "harmonics", "target", "soft")
    rest = []
    for degree in range(4):
        put(page, "harmonics", "degree", degree)
        rest.append(float(data(page, "harmonics", "rest")))
    assert rest[0] == pytest.approx(100, abs=0.1)
    assert all(after < 0.5 * before for before, after in pairwise(rest))
    values = page.evaluate(
        "[...document.querySelectorAll('[data-figure=harmonics] input[type=range]')]"
        ".map(e => Number(e.value))"
    )
    directions = torch.nn.functional.normalize(
        torch.randn(200_000, 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64),
        dim=1,
    )
    light = torch.tensor([0.36, -0.8, 0.48], dtype=torch.float64)
    colour = 0.25 + 0.7 * torch.exp((directions @ light - 1) / 0.25) - 0.5
    basis = reference.sh_basis(directions, 3)
    expected = 4 * math.pi * (basis * colour[:, None]).mean(0)
    np.testing.assert_allclose(values, expected, atol=0.02)
    # The sphere turns by a key and by touch.
    shown = part("harmonics", "canvas") + ".toDataURL()"
    pictures = [page.evaluate(shown)]
    keys(page, "harmonics", "canvas", "ArrowLeft")
    pictures.append(page.evaluate(shown))
    x, y = place(page, "harmonics", "canvas")
    touch(page, (x, y), (x + 20, y), (x + 40, y + 10))
    pictures.append(page.evaluate(shown))
    assert len(set(pictures)) == 3


@pytest.mark.nightly
def test_blending(page):
    """The colour of the pixel is that of the formula, in the order of depth and of the list."""
    colours = np.array([[214, 69, 65], [60, 140, 220], [242, 183, 5], [72, 160, 90]])
    alphas = np.array([0.6, 0.5, 0.8, 0.9])

    def pixel(order: list[int]) -> np.ndarray:
        before = np.cumprod(np.append(1, 1 - alphas[order]))
        return (before[:-1] * alphas[order]) @ colours[order] + before[-1] * 255

    def shown() -> list[int]:
        return [int(v) for v in data(page, "blending", "colour").split(",")]

    np.testing.assert_allclose(shown(), pixel([0, 1, 2, 3]), atol=1)
    press(page, "blending", "reverse")
    np.testing.assert_allclose(shown(), pixel([3, 2, 1, 0]), atol=1)
    press(page, "blending", "sorted")
    np.testing.assert_allclose(shown(), pixel([0, 1, 2, 3]), atol=1)
    press(page, "blending", "sorted")
    press(page, "blending", "reset")
    keys(page, "blending", "[data-handle=layer0]", "ArrowRight", 15)  # behind the next layer
    np.testing.assert_allclose(shown(), pixel([1, 0, 2, 3]), atol=1)


@pytest.mark.nightly
def test_tiles(page):
    """Each tile has the splats that reach one of its pixels, and few others; the list is sorted."""
    text = (DOCS / "static" / "interactive" / "tiles-data.js").read_text(encoding="utf-8")
    rows = np.array(json.loads(text[text.index("[\n") :].rstrip(";\n").replace(",\n]", "]")))
    y, x = np.mgrid[0:64, 0:96] + 0.5
    dx, dy = x - rows[:, 0, None, None], y - rows[:, 1, None, None]
    a, b, c, opacity = (rows[:, k, None, None] for k in (2, 3, 4, 5))
    alpha = opacity * np.exp(-0.5 * (a * dx * dx + c * dy * dy) - b * dx * dy)
    touched = (alpha >= 1 / 255).reshape(len(rows), 4, 16, 6, 16).any(axis=(2, 4))
    exact = int(data(page, "tiles", "instances"))
    # The test of the kernels regards the rectangle of the pixel centres, not the centres alone.
    assert touched.sum() <= exact <= touched.sum() + 3
    depths = page.evaluate(
        part("tiles", "pre") + ".textContent.split('\\n').slice(1)"
        ".map(line => line.slice(2).split(/[ |]+/).filter(w => w).map(Number).slice(0, 2))"
    )
    assert len(depths) == exact
    assert depths == sorted(depths)
    put(page, "tiles", "rule", "box")
    box = int(data(page, "tiles", "instances"))
    put(page, "tiles", "rule", "square")
    assert exact < box < int(data(page, "tiles", "instances"))
    put(page, "tiles", "rule", "exact")
    # From tile 8 to the next one by a key, to tile 21 by a click.
    keys(page, "tiles", "[data-handle=tile]", "ArrowRight")
    assert "Tile 9:" in page.evaluate(part("tiles", ".status") + ".textContent")
    left, top = place(page, "tiles", "svg")
    unit = page.evaluate(part("tiles", "svg") + ".getBoundingClientRect().width") / 330
    page.click(left + 0.5 * 52 * unit, top + 1.5 * 52 * unit)
    assert "Tile 21:" in page.evaluate(part("tiles", ".status") + ".textContent")
    first, last = (int(v) for v in data(page, "tiles", "range").split(","))
    assert last - first + 1 == touched[:, 3, 3].sum()
    # The middle pixel of the tile, composited from front to back.
    T, colour = 1.0, np.zeros(3)
    for row in np.argsort(rows[:, 6], kind="stable"):
        value = min(0.99, float(alpha[row, 56, 56]))
        if value >= 1 / 255:
            colour, T = colour + T * value * rows[row, 7:], T * (1 - value)
    seen = page.evaluate(
        f"[...{part('tiles', '.tile')}.getContext('2d').getImageData(8, 8, 1, 1).data]"
    )
    np.testing.assert_allclose(seen[:3], 255 * colour, atol=2)


@pytest.mark.nightly
def test_density_control(page):
    count = int(data(page, "density", "count"))
    for stage in ("fitted", "judged", "changed", "fitted", "judged"):
        press(page, "density", "next")
        assert data(page, "density", "stage") == stage
    assert int(data(page, "density", "count")) > count
    chosen = []
    for threshold in (0.05, 1):
        put(page, "density", "threshold", threshold)
        words = page.evaluate(part("density", ".status") + ".textContent")
        chosen.append(sum(map(int, re.findall(r"(\d+) (?:large|small)", words))))
    assert chosen[0] > 3
    assert chosen[1] < chosen[0]
    press(page, "density", "reset")
    assert int(data(page, "density", "count")) == count


@pytest.mark.nightly
def test_gradients_of_the_live_fit(page):
    """Against central differences, for all nine parameters of overlapping Gaussians."""
    worst = page.evaluate(
        """(() => {
        let seed = 7;
        const random = () => (seed = seed * 16807 % 2147483647) / 2147483647;
        const target = Float64Array.from({ length: 40 * 30 * 3 }, random);
        const fit = fitting2d(gaussians2d(target, 40, 30), 3);
        fit.start(12);
        fit.rows.forEach((v, i) => { if (i % 9 > 1) fit.rows[i] = v + 0.6 * (random() - 0.5); });
        const loss = () => { fit.render(); return 0.5 * fit.mse * target.length; };
        loss();
        return Math.max(...fit.gradient().map((g, i) => {
            const value = fit.rows[i], step = 1e-5;
            const [high, low] = [step, -step].map(d => { fit.rows[i] = value + d; return loss(); });
            fit.rows[i] = value;
            const expected = (high - low) / (2 * step);
            return Math.abs(g - expected) / (1 + Math.abs(expected));
        }));
        })()"""
    )
    assert worst < 1e-6


@pytest.mark.nightly
def test_live_fit_of_a_dropped_picture(page, tmp_path):
    y, x = np.mgrid[0:48, 0:64]
    pixels = np.stack([4 * x, 5 * y, np.where((x // 16 + y // 16) % 2, 200, 40)], axis=-1)
    Image.fromarray(pixels.astype(np.uint8)).save(tmp_path / "squares.png")
    left, top = place(page, "fit", "canvas")
    page.drop(tmp_path / "squares.png", left, top)
    page.wait_for(part("fit", "canvas") + ".width === 64")
    page.wait_for(part("fit", ".status") + ".textContent.includes('Step 0 ')")
    put(page, "fit", "most", 1000)  # enough that it is not finished at the pause
    put(page, "fit", "view", "ellipses")
    press(page, "fit", "run")
    step = "Number(document.querySelector('[data-figure=fit]').dataset.step)"
    page.wait_for(f"{step} > 300")
    press(page, "fit", "run")  # pause
    counts = f"{part('fit', '.status')}.textContent.match(/Cloned (\\d+), split (\\d+)/).slice(1)"
    assert sum(int(count) for count in page.evaluate(counts)) > 60
    assert float(data(page, "fit", "psnr")) > 25
    # A file that is no picture is refused, and the fit goes on.
    (tmp_path / "no.png").write_text("no picture")
    left, top = place(page, "fit", "canvas")  # the text above may have become longer
    page.drop(tmp_path / "no.png", left, top)
    page.wait_for(part("fit", ".status") + ".textContent.includes('not a picture')")
    before = page.evaluate(step)
    press(page, "fit", "run")
    page.wait_for(f"{step} !== {before}")
    press(page, "fit", "restart")
    page.wait_for(f"{step} === 0")


@pytest.mark.nightly
def test_live_fit_reaches_the_quality_of_the_subcommand(page):
    """Within 1 dB with 1000 Gaussians; `snowsplat image` has 3000 steps."""
    text = (DOCS / "static" / "interactive" / "picture-data.js").read_text(encoding="utf-8")
    encoded = "".join(re.findall('^  "(.*)"', text, re.MULTILINE))
    picture = Image.open(io.BytesIO(base64.b64decode(encoded))).convert("RGB")
    target = torch.from_numpy(np.asarray(picture).copy()).float() / 255
    fitter = Fitter(target, FitOptions(gaussians=1000))
    while not fitter.finished:
        fitter.step()
    page.evaluate("location.reload()")
    page.wait_for(f"document.readyState === 'complete' && {DRAWN}")
    press(page, "fit", "run")
    page.wait_for("document.querySelector('[data-figure=fit]').dataset.step === '1500'", 600)
    assert float(data(page, "fit", "psnr")) > -10 * math.log10(fitter.mse) - 1
