"""The page that trains: its file, its words, and a step beside that of the CPU."""

import base64
import io
import json
import re
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from PIL import Image
from tests.browser import Browser
from tests.ops.scenes import PARAMETERS

from snowsplat import ops
from snowsplat.data import load_dataset
from snowsplat.formats import read_gaussians
from snowsplat.pipeline.publish_trainable import publish_trainable
from snowsplat.util.errors import UserError

COLUMNS = {"means": 3, "log_scales": 3, "quats": 4, "opacity_logits": 1, "sh_dc": 3, "sh_rest": 45}
SHAPES = {"opacity_logits": (-1,), "sh_dc": (-1, 1, 3), "sh_rest": (-1, 15, 3)}


@pytest.fixture(scope="module")
def made(dataset, tmp_path_factory):
    page = tmp_path_factory.mktemp("tab") / "balls.html"
    return publish_trainable(dataset, page, "Four <balls>", steps=20)


def test_the_file_has_all_that_it_needs(made, dataset):
    text = made.page.read_text("utf-8")
    assert made.bytes == made.page.stat().st_size
    assert (made.photos, made.gaussians) == (9, 300)
    assert "<title>Four &lt;balls&gt;</title>" in text
    # The name space of SVG is not an address that a browser loads.
    assert not re.findall(r"(?:https?:)?//[\w.]+/", text.replace("http://www.w3.org/2000/svg", ""))
    data = json.loads(re.search(r'id="data">(.*?)</script>', text, re.DOTALL)[1])
    steps = [step for operation in data["plan"].values() for step in operation["steps"]]
    used = {step["file"] for step in steps} & data["shaders"].keys()
    assert data["shaders"].keys() == used | {"show"}
    assert sum(view["heldOut"] for view in data["views"]) == len(load_dataset(dataset).test)


def test_large_photos_become_smaller(tmp_path):
    from snowsplat.synthetic.toy_dataset import write_toy_dataset

    folder = write_toy_dataset(tmp_path / "large", "colmap-bin", 3, 768, 24, n_points=50)
    page = publish_trainable(folder, tmp_path / "large.html").page
    views = json.loads(re.search(r'id="data">(.*?)</script>', page.read_text("utf-8"))[1])["views"]
    assert {(view["width"], view["height"]) for view in views} == {(512, 16)}


def test_errors(dataset, tmp_path):
    with pytest.raises(UserError, match=r"use a name with \.html"):
        publish_trainable(dataset, tmp_path / "folder")
    (tmp_path / "page.html").write_text("mine")
    with pytest.raises(UserError, match="exists"):
        publish_trainable(dataset, tmp_path / "page.html")


@pytest.mark.browser
@pytest.mark.parametrize(
    ("language", "words"), [("en-US", "This browser has no WebGPU"), ("zh-CN", "没有 WebGPU")]
)
def test_without_webgpu(made, language, words):
    with Browser() as browser:
        page = browser.open(made.page.as_uri(), language=language)
        page.wait_for(f"document.getElementById('notice').textContent.includes('{words}')")
        assert page.evaluate("document.getElementById('pause').disabled")
        assert page.errors == []
        assert set(page.requests) == {made.page.as_uri()}


# What the page does between two steps of its own, so that nothing else uses the device.
BETWEEN_STEPS = """new Promise((resolve, reject) => {
    const { trainer } = snowsplat;
    const text = array => {
        const bytes = new Uint8Array(array.buffer, array.byteOffset, array.byteLength);
        return btoa(Array.from(bytes, each => String.fromCharCode(each)).join(""));
    };
    const texts = arrays =>
        Object.fromEntries(Object.entries(arrays).map(([name, array]) => [name, text(array)]));
    const state = async () => {
        const { count, values, m, v } = await trainer.state();
        return { count, values: texts(values), m: texts(m), v: texts(v) };
    };
    snowsplat.asked = async () => {
        snowsplat.asked = undefined;
        const act = async () => { %s };
        await act().then(found => resolve(JSON.stringify(found)), reject);
    };
})"""
# Two steps before: the first Gaussians are round, and turning them changes nothing.
ONE_STEP = """
    await trainer.train(2);
    const before = await state();
    trainer.queue = [trainer.training[1]];
    await trainer.train(1);
    const after = await state();
    return { before, after, step: trainer.step, loss: trainer.loss };
"""
REST = """
    await trainer.refine();
    const refined = trainer.count;
    const psnr = await trainer.psnr();
    const { count, values } = await trainer.state();
    const file = snowsplat.file();
    await snowsplat.asked();
    return { refined, psnr, count, means: text(values.means), ply: text(await file) };
"""


def arrays(texts):
    return {
        name: torch.from_numpy(np.frombuffer(base64.b64decode(text), np.float32).copy()).view(
            SHAPES.get(name, (-1, COLUMNS[name]))
        )
        for name, text in texts.items()
    }


@pytest.mark.browser
@pytest.mark.nightly
def test_a_step_is_that_of_the_cpu(made, dataset):
    with Browser(420, 300, webgpu=True) as browser:
        page = browser.open(made.page.as_uri())
        page.wait_for("window.snowsplat", 120)
        page.evaluate("snowsplat.paused = true; snowsplat.show = async () => {}; 1")
        found = json.loads(page.evaluate(BETWEEN_STEPS % ONE_STEP, 300))
        rest = json.loads(page.evaluate(BETWEEN_STEPS % REST, 300))
        assert list(page.console) == []
        assert set(page.requests) == {made.page.as_uri()}

    before, after = (
        SimpleNamespace(**{part: arrays(found[each][part]) for part in ("values", "m", "v")})
        for each in ("before", "after")
    )
    read = load_dataset(dataset)
    camera = read.train[1].camera
    data = json.loads(re.search(r'id="data">(.*?)</script>', made.page.read_text("utf-8"))[1])
    recipe = data["recipe"]
    degree = (found["step"] - 1) // recipe["degreeEvery"]
    names = ("cam_from_world", "width", "height", "fx", "fy", "cx", "cy")
    view = ops.View(*(getattr(camera, name) for name in names), degree, camera.near)
    gaussians = SimpleNamespace(**before.values)
    splats = ops.project(gaussians, view)
    splats.packed.requires_grad_().retain_grad()
    image, _, _ = ops.rasterize(splats, view.width, view.height)
    photo = np.asarray(Image.open(io.BytesIO(base64.b64decode(data["views"][1]["jpeg"]))))
    loss = ops.photometric_loss(image, torch.from_numpy(photo.copy()))
    loss.backward()
    share = found["step"] / 20
    first, last = recipe["means"]
    rates = {"means": read.extent * first ** (1 - share) * last**share} | recipe["rates"]
    ops.adam_step(
        gaussians,
        ops.Moments(before.m, before.v),
        ops.SplatGradient.of(splats),
        view,
        ops.AdamRates(rates, found["step"]),
        visible_only=recipe["visibleOnly"],
    )
    assert found["loss"] == pytest.approx(loss.item(), rel=2e-3)  # decoders of JPEG differ
    for name in PARAMETERS:
        for expected, actual in ((before.values, after.values), (before.m, after.m)):
            error = (actual[name] - expected[name]).norm() / expected[name].norm().clamp_min(1e-9)
            assert error < 0.02, (name, float(error))

    assert rest["refined"] == rest["count"] >= 300
    assert 5 < rest["psnr"] < 40
    path = made.page.with_suffix(".ply")
    path.write_bytes(base64.b64decode(rest["ply"]))
    assert path.read_bytes().count(b"property float") == 62
    scene = read_gaussians(path)
    means = np.frombuffer(base64.b64decode(rest["means"]), np.float32).reshape(-1, 3)
    assert np.array_equal(np.asarray(scene.means), means)
