"""Decoding, scaling, alpha, and the cache of the loader: same pixels, within the budget."""

import dataclasses
import os
import threading
from concurrent.futures import Future

import numpy as np
import pytest
import torch
from PIL import Image

from snowsplat.data import ImageLoader, ImageSource, View
from snowsplat.data.lens.models import lens_of
from snowsplat.data.lens.views import lens_views
from snowsplat.data.photos.decode import (
    exif_exposure,
    load_image,
    load_mask,
    load_views,
    resize_area,
    resize_area_on_gpu,
)
from snowsplat.data.photos.image_loader import available_memory
from snowsplat.scene.camera import Camera
from snowsplat.util.errors import UserError

needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="needs a GPU")
POSE = torch.eye(4, dtype=torch.float64)[:3]
TIME, STOP, ISO = 0x829A, 0x829D, 0x8827


def make_view(path, pixels, mask=None, **save) -> View:
    Image.fromarray(pixels).save(path, **save)
    height, width = pixels.shape[:2]
    camera = Camera(width, height, 10.0, 10.0, width / 2, height / 2, POSE)
    return View(path.name, camera, ImageSource(path, width, height), mask)


@pytest.fixture
def views(tmp_path):
    """Ten images of noise, 20×16."""
    random = np.random.default_rng(0)
    noise = random.integers(0, 256, (10, 16, 20, 3)).astype(np.uint8)
    return [make_view(tmp_path / f"{i}.png", pixels) for i, pixels in enumerate(noise)]


def stored(view: View) -> torch.Tensor:
    return torch.from_numpy(np.array(Image.open(view.image.path)))


@pytest.fixture
def decoded(monkeypatch) -> list[tuple[str, int]]:
    """The name of each photo that is decoded, and for how many views, in this order."""
    decoded = []

    def counting(sources, background=None):
        decoded.append((sources[0][0].path.name, len(sources)))
        return load_views(sources, background)

    monkeypatch.setattr("snowsplat.data.photos.image_loader.load_views", counting)
    return decoded


def wait_until_idle(loader: ImageLoader) -> None:
    """Wait until no thread decodes an image."""
    for _ in range(1000):
        with loader._lock:
            if not loader._running:
                return
        threading.Event().wait(0.01)


def test_images_are_planar_in_memory(views):
    with ImageLoader(views) as loader:
        image = loader.get(views[3])
    assert torch.equal(image.rgb, stored(views[3]))
    assert image.planes.is_contiguous()
    assert image.planes.shape == (3, 16, 20)
    assert image.alpha is None
    assert torch.equal(image.over(torch.zeros(3)), stored(views[3]) / 255.0)


@pytest.mark.parametrize("factor", [2, 4])
def test_downscale_is_the_mean_of_a_box(views, factor):
    with ImageLoader(views) as loader:
        small = loader.get(views[0], factor).rgb.double()
    boxes = stored(views[0]).double().unflatten(0, (-1, factor)).unflatten(2, (-1, factor))
    assert (small - boxes.mean((1, 3))).abs().max() <= 0.5 + 1e-9


def test_downscale_of_sizes_that_do_not_divide():
    """A ramp stays a ramp, at the positions that the scaled intrinsics predict."""
    ramp = np.tile(np.linspace(0, 250, 51).astype(np.uint8), (3, 33, 1))
    small = resize_area(ramp, 12, 8)
    assert small.shape == (3, 8, 12)
    centres = (np.arange(12) + 0.5) * 51 / 12
    assert np.abs(small[0, 0] - 5 * (centres - 0.5)).max() <= 0.5 + 1e-9
    assert resize_area(np.full((1, 7, 9), 255, np.uint8), 4, 3).min() == 255


@pytest.mark.parametrize(
    "device", ["cpu", pytest.param("cuda", marks=[pytest.mark.gpu, needs_gpu])]
)
@pytest.mark.parametrize("kind", ["noise", "mask", "rows"])
def test_a_gpu_reduces_to_the_same_values(kind, device):
    """Means of whole pixels and of parts; constant rows have means at half of a level."""
    random = np.random.default_rng(0)
    for width, height in random.integers(1, 90, (40, 2)):
        planes = random.integers(0, 256, (3, height, width)).astype(np.uint8)
        if kind == "mask":
            planes = 255 * (planes > 100).astype(np.uint8)
        elif kind == "rows":
            planes = planes[:, :, :1].repeat(width, 2)
        for factor in (2, 4):
            size = max(1, int(width) // factor), max(1, int(height) // factor)
            found = resize_area_on_gpu(torch.from_numpy(planes).to(device), *size).cpu()
            assert np.array_equal(found, resize_area(planes, *size)), (width, height, factor)


def rgba(tmp_path):
    pixels = np.zeros((8, 8, 4), np.uint8)
    pixels[..., 0] = 200
    pixels[:4, :, 3] = 255
    pixels[4:, :4, 3] = 51  # a fifth
    return make_view(tmp_path / "a.png", pixels)


def test_alpha_is_kept_or_composited(tmp_path):
    view = rgba(tmp_path)
    with ImageLoader([view]) as loader:
        image = loader.get(view)
        assert image.planes.shape == (4, 8, 8)
        assert image.alpha[[0, 7, 7], [0, 0, 7]].tolist() == [255, 51, 0]
        over = image.over(torch.tensor([0.0, 1.0, 0.0]))
        expected = torch.tensor([0.2 * 200 / 255, 0.8, 0.0])
        assert torch.allclose(over[7, 0], expected, atol=1e-6)
    with ImageLoader([view], background=(0, 1, 0)) as loader:
        composited = loader.get(view)
    assert composited.planes.shape == (3, 8, 8)
    assert composited.rgb[7, 0].tolist() == [40, 204, 0]
    assert composited.rgb[7, 7].tolist() == [0, 255, 0]


def test_downscale_and_background_commute(tmp_path):
    view = rgba(tmp_path)
    background = torch.tensor([0.3, 0.6, 0.9])
    with ImageLoader([view]) as loader:
        later = loader.get(view, 4).over(background) * 255
    with ImageLoader([view], background=background.tolist()) as loader:
        before = loader.get(view, 4).rgb
    assert (later - before).abs().max() <= 1.1


def test_alpha_of_an_opaque_image_is_dropped(tmp_path):
    view = make_view(tmp_path / "a.png", np.full((4, 4, 4), 255, np.uint8))
    assert load_image(view.image).shape == (3, 4, 4)


@pytest.mark.parametrize(
    ("mode", "expected"),
    [
        ("L", [100, 100, 100]),
        ("1", [255, 255, 255]),
        ("P", [100, 100, 100]),
        ("CMYK", [100, 100, 100]),
    ],
)
def test_other_kinds_of_pixels(tmp_path, mode, expected):
    path = tmp_path / ("a.tif" if mode == "CMYK" else "a.png")
    Image.new("L", (4, 4), expected[0]).convert(mode).save(path)
    assert load_image(ImageSource(path, 4, 4))[:, 0, 0].tolist() == expected


def test_sixteen_bit_grey_is_scaled(tmp_path):
    Image.fromarray(np.full((4, 4), 100 * 257, np.uint16)).save(tmp_path / "a.png")
    assert load_image(ImageSource(tmp_path / "a.png", 4, 4)).unique().tolist() == [100]


def test_a_downscaled_mask_keeps_only_pixels_that_are_fully_inside(views, tmp_path):
    mask = np.zeros((16, 20), np.uint8)
    mask[:, :7] = 255
    Image.fromarray(mask).save(tmp_path / "mask.png")
    view = View("v", views[0].camera, views[0].image, ImageSource(tmp_path / "mask.png", 20, 16))
    with ImageLoader([view]) as loader:
        assert loader.get(view).mask.sum() == 7 * 16
        assert loader.get(view, 2).mask.sum() == 3 * 8


def test_a_mask_is_white_from_128_on(tmp_path):
    Image.fromarray(np.array([[0, 127, 128, 255]], np.uint8)).save(tmp_path / "mask.png")
    mask = load_mask(ImageSource(tmp_path / "mask.png", 4, 1))
    assert mask.tolist() == [[False, False, True, True]]


def test_a_budget_for_two_images_returns_the_same_pixels(views):
    one = 3 * 16 * 20
    order = [views[i] for i in torch.randperm(10).tolist() * 3]
    with ImageLoader(views, budget_bytes=2 * one, threads=3) as loader:
        for start in range(0, 30, 10):
            loader.prefetch(order[start : start + 10])
            for view in order[start : start + 10]:
                assert torch.equal(loader.get(view).rgb, stored(view))
                assert loader.cached_bytes <= 2 * one


def test_images_within_the_budget_are_decoded_once(views, decoded):
    with ImageLoader(views) as loader:
        for _ in range(3):
            loader.prefetch(reversed(views))
            for view in reversed(views):
                loader.get(view)
        for view in views:  # smaller versions are made from the cached images
            loader.get(view, 2)
        assert loader.cached_bytes == 10 * 3 * (16 * 20 + 8 * 10)
    assert sorted(decoded) == [(f"{i}.png", 1) for i in range(10)]


@pytest.mark.parametrize("fits", [True, False])
def test_a_photo_of_several_views_is_decoded_for_those_that_stay(tmp_path, decoded, fits):
    pixels = np.random.default_rng(0).integers(0, 256, (60, 60, 3)).astype(np.uint8)
    photo = make_view(tmp_path / "a.png", pixels)
    mask = ImageSource(tmp_path / "mask.png", 60, 60)
    Image.fromarray(pixels[..., 0]).save(mask.path)
    views = []
    for part in lens_views(lens_of("FISHEYE", 60, 60, (20.0, 20.0, 30.0, 30.0))):
        size = {"width": part.width, "height": part.height, "view": part}
        shown = dataclasses.replace(photo.image, **size), dataclasses.replace(mask, **size)
        views.append(View(part.name, photo.camera, *shown))
    one = 5 * views[0].image.width * views[0].image.height
    threads, budget = (3, None) if fits else (1, 4 * one)  # two images are decoded ahead
    with ImageLoader(views, threads=threads, budget_bytes=budget) as loader:
        for _ in range(2):
            loader.prefetch(views)
            for view in views:
                image = loader.get(view)
                assert torch.equal(image.planes, load_image(view.image))
                assert torch.equal(image.mask, load_mask(view.mask))
    assert len(views) > 2
    if fits:
        assert decoded == [("a.png", len(views))]
    else:
        assert 1 < max(count for _, count in decoded) <= 3
        assert len(decoded) < 2 * len(views)


def test_prefetching_stays_within_half_of_the_budget(views):
    one = 4 * 16 * 20  # largest size of an image in bytes, with alpha
    with ImageLoader(views, budget_bytes=6 * one, threads=2) as loader:
        loader.prefetch(views)
        for future in list(loader._running.values()):
            future.result()
        assert loader.cached_bytes <= 3 * one
        for view in views:
            assert torch.equal(loader.get(view).rgb, stored(view))


def test_an_image_decoded_ahead_makes_room_for_the_next_when_it_is_requested(views, decoded):
    """The request for a view outside of the order changes nothing."""
    one = 4 * 16 * 20
    with ImageLoader(views, budget_bytes=2 * one) as loader:
        loader.prefetch(views[:3])
        wait_until_idle(loader)
        loader.get(views[9])
        loader.get(views[0])
        wait_until_idle(loader)
    assert decoded == [("0.png", 1), ("9.png", 1), ("1.png", 1)]


def test_images_that_are_ready_at_once_are_decoded_once(views, monkeypatch):
    """The callback of a decoded image then runs inside of the loop that submits the images."""
    submitted = []

    def decode_now(decode, key):
        submitted.append(key[0].path.name)
        future: Future = Future()
        future.set_result(decode(key))
        return future

    with ImageLoader(views) as loader:
        monkeypatch.setattr(loader._pool, "submit", decode_now)
        loader.prefetch(views)
        assert loader.cached_bytes == 10 * 3 * 16 * 20
    assert submitted == [f"{i}.png" for i in range(10)]


def test_damaged_images_raise_when_requested(views):
    path = views[4].image.path
    path.write_bytes(path.read_bytes()[:-200])
    with ImageLoader(views) as loader:
        loader.prefetch(views)
        for view in views[:4]:
            loader.get(view)
        with pytest.raises(UserError, match=r"4\.png: cannot be decoded"):
            loader.get(views[4])
        assert torch.equal(loader.get(views[5]).rgb, stored(views[5]))


def test_a_deleted_image(views):
    views[0].image.path.unlink()
    with ImageLoader(views) as loader, pytest.raises(UserError, match="no such image"):
        loader.get(views[0])


def test_a_closed_loader_has_no_threads_and_no_images(views):
    before = set(threading.enumerate())
    loader = ImageLoader(views)
    loader.prefetch(views)
    assert set(threading.enumerate()) - before
    loader.close()
    assert set(threading.enumerate()) <= before
    assert loader.cached_bytes == 0


def test_closing_cancels_images_that_no_thread_decodes_yet(views, monkeypatch):
    started, decoded = threading.Event(), []

    def until_cancelled(sources, background=None):
        decoded.append(sources[0][0].path.name)
        started.set()
        for _ in range(1000):
            with loader._lock:
                if len(loader._running) == 1:
                    break
            threading.Event().wait(0.01)
        return load_views(sources, background)

    monkeypatch.setattr("snowsplat.data.photos.image_loader.load_views", until_cancelled)
    loader = ImageLoader(views, threads=1)
    loader.prefetch(views)
    assert len(loader._running) == 2
    assert started.wait(10)
    loader.close()
    assert decoded == ["0.png"]


def test_other_downscale_factors_are_rejected(views):
    with ImageLoader(views) as loader, pytest.raises(ValueError, match="1, 2 or 4"):
        loader.get(views[0], 3)


def test_an_image_that_a_thread_decodes_is_awaited(views, monkeypatch):
    """`get` does not decode it a second time."""
    started, release = threading.Event(), threading.Event()
    decoded = []

    def slow(sources, background=None):
        decoded.append(sources[0][0].path.name)
        if len(decoded) == 1:
            started.set()
            release.wait(10)
        return load_views(sources, background)

    monkeypatch.setattr("snowsplat.data.photos.image_loader.load_views", slow)
    with ImageLoader(views) as loader:
        loader.prefetch(views[:1])
        assert started.wait(10)
        timer = threading.Timer(0.05, release.set)
        timer.start()
        assert torch.equal(loader.get(views[0]).rgb, stored(views[0]))
        timer.join()
    assert decoded == ["0.png"]


def test_images_decoded_ahead_are_removed_if_nothing_else_is_cached(tmp_path):
    """The estimated size may be too small: 3 // 4 is 0 pixels, but the image has 1 pixel."""
    pixels = np.full((3, 3, 3), 9, np.uint8)
    views = [make_view(tmp_path / f"{i}.png", pixels) for i in range(3)]
    with ImageLoader(views, budget_bytes=0, threads=3) as loader:
        loader.prefetch(views, 4)
        wait_until_idle(loader)
        assert loader.cached_bytes == 3


def test_thirty_two_bit_grey_is_scaled_like_sixteen_bits_and_clamped(tmp_path):
    pixels = np.array([[-65536, -1, 0, 255, 256, 65535, 65536, 1 << 30]], np.int32)
    Image.fromarray(pixels).save(tmp_path / "a.tif")
    planes = load_image(ImageSource(tmp_path / "a.tif", 8, 1))
    assert planes[:, 0].tolist() == [[0, 0, 0, 0, 1, 255, 255, 255]] * 3


V2 = "/sys/fs/cgroup/memory.max", "/sys/fs/cgroup/memory.current"
V1 = tuple(f"/sys/fs/cgroup/memory/memory.{name}_in_bytes" for name in ("limit", "usage"))
MEMINFO = {"/proc/meminfo": "MemTotal: 90 kB\nMemFree: 10 kB\nMemAvailable:  50 kB\n"}


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        (MEMINFO, 50 * 1024),
        ({**MEMINFO, V2[0]: "9000\n", V2[1]: "2000\n"}, 7000),
        ({**MEMINFO, V1[0]: "9000\n", V1[1]: "2000\n"}, 7000),
        ({**MEMINFO, V2[0]: "2000\n", V2[1]: "9000\n"}, 0),
        ({**MEMINFO, V2[0]: "max\n", V2[1]: "9000\n"}, 50 * 1024),
        ({**MEMINFO, V1[0]: "9223372036854771712\n", V1[1]: "9000\n"}, 50 * 1024),
        ({**MEMINFO, V2[0]: "6000", V2[1]: "0", V1[0]: "5000", V1[1]: "0"}, 5000),
        ({"/proc/meminfo": "MemFree: 10 kB\n"}, 3 * 4096 // 2),
        ({}, 3 * 4096 // 2),
    ],
)
def test_available_memory_is_limited_by_the_control_group(monkeypatch, files, expected):
    """Names and units as in proc(5) and in the kernel's documentation of cgroups 1 and 2."""

    class FakePath:
        def __init__(self, path):
            self.path = path

        def read_text(self, encoding=None):
            if self.path not in files:
                raise FileNotFoundError(self.path)
            return files[self.path]

    system = {"SC_PHYS_PAGES": 3, "SC_PAGE_SIZE": 4096}
    monkeypatch.setattr("snowsplat.util.machine.Path", FakePath)
    monkeypatch.setattr(os, "sysconf_names", dict.fromkeys(system, 0), raising=False)
    monkeypatch.setattr(os, "sysconf", system.__getitem__, raising=False)
    assert available_memory() == expected
    if not files:  # a system that reports nothing
        monkeypatch.delattr(os, "sysconf")
        assert available_memory() == 4 << 30


@pytest.mark.parametrize("suffix", ["jpg", "webp"])
def test_more_light_is_a_larger_value(tmp_path, suffix):
    def value(name, tags):
        exif = Image.Exif()
        exif.get_ifd(0x8769).update(tags)
        path = tmp_path / f"{name}.{suffix}"
        Image.new("RGB", (8, 8)).save(path, exif=exif)
        return exif_exposure(path)

    usual = value("usual", {TIME: 0.01, STOP: 4.0, ISO: 100})
    assert value("longer", {TIME: 0.02, STOP: 4.0, ISO: 100}) == pytest.approx(usual + 1)
    assert value("wider", {TIME: 0.01, STOP: 2.0, ISO: 100}) == pytest.approx(usual + 2)
    assert value("faster", {TIME: 0.01, STOP: 4.0, ISO: 400}) == pytest.approx(usual + 2)
    assert value("no time", {STOP: 4.0, ISO: 100}) is None
    assert value("no light", {TIME: 0.0, STOP: 4.0, ISO: 100}) is None


def test_files_without_exposure(tmp_path):
    Image.new("RGB", (8, 8)).save(tmp_path / "plain.png")
    (tmp_path / "text.jpg").write_text("not a photo")
    for name in ("plain.png", "text.jpg", "missing.jpg"):
        assert exif_exposure(tmp_path / name) is None
