"""PSNR of independent viewers, compared with the renderings of snowsplat.

    npm install --no-package-lock --prefix benchmarks/viewers
    python benchmarks/viewers.py OUT

OUT is the output folder of a training. For each viewer and each format that it reads, the scene is
written in this format and opened in a headless Chromium, with the exact camera of a photo. The
picture is compared with the rendering of the same file by snowsplat, so that the loss of the format
does not count. "as it comes" is without settings of the viewer, "set" is with those that bring its
picture nearest to ours. With --check, the exit code is 1 if a row is below `Viewer.formats`; OUT is
then that of `snowsplat demo`.

Nothing is loaded from the network. The viewers draw with a GPU in software, which takes a while.
"""

import argparse
import functools
import json
import math
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import torch
from PIL import Image
from torch import Tensor

from snowsplat.evaluation.metrics import psnr
from snowsplat.formats import GaussianArrays, read_gaussians, write_gaussians
from snowsplat.formats.packing import UP_BACK
from snowsplat.formats.spz import write_spz
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.scene.camera import Camera
from snowsplat.scene.edit import with_sh_degree
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from tests.browser import Browser, BrowserError, Page, chromium

FOLDER = Path(__file__).resolve().parent / "viewers"
PLY, COMPRESSED, SPLAT, SOG = ".ply", ".compressed.ply", ".splat", ".sog"
SPZ = {f".v{version}.spz": version for version in (2, 3, 4)}
#: Axis signs of a camera in OpenCV axes, as those of OpenGL, and of a file with y up.
FLIP = torch.diag(torch.tensor([*map(float, UP_BACK), 1.0], dtype=torch.float64))


@dataclass(frozen=True)
class Viewer:
    """A viewer, what it reads, and how it is set.

    Attributes:
        package: the npm package; its version is in viewers/package.json.
        script: the module in viewers/ that shows a scene with it.
        formats: the suffixes of the formats that it reads, and the PSNR in dB that it must reach
            with each: 2 dB below that of the first photo of the demo.
        options: the settings for a picture like ours, for ``script``.
        antialiased: those that differ for an antialiased scene.
        sh_degree: the highest degree that it draws; the scene is reduced to it.
    """

    name: str
    package: str
    script: str
    formats: dict[str, float]
    options: dict[str, Any] = field(default_factory=dict)
    antialiased: dict[str, Any] = field(default_factory=dict)
    sh_degree: int = 3


VIEWERS = (
    Viewer(
        "Spark",
        "@sparkjsdev/spark",
        "spark",
        {PLY: 42.3, COMPRESSED: 42.8, ".v2.spz": 43.4, ".v3.spz": 43.4, SOG: 42.9, SPLAT: 41.3},
        {
            "preBlurAmount": 0.3,
            "blurAmount": 0.0,
            "maxStdDev": 3.33,
            "minAlpha": 1 / 255,
            "maxPixelRadius": 4096.0,
            "sortRadial": False,
            "accumExtSplats": True,
            "mesh": {"extSplats": True},
        },
        {"preBlurAmount": 0.0, "blurAmount": 0.1},
    ),
    Viewer(
        "GaussianSplats3D",
        "@mkkellogg/gaussian-splats-3d",
        "gaussian_splats_3d",
        {PLY: 38.9, COMPRESSED: 39.8, ".v2.spz": 39.1, SPLAT: 40.8},
        {"sphericalHarmonicsDegree": 2, "integerBasedSort": False},
        {"antialiased": True, "kernel2DSize": 0.1},
        sh_degree=2,
    ),
    Viewer(
        "gsplat.js",
        "gsplat",
        "gsplat",
        {PLY: 35.7, SPLAT: 36.1},
        {"lowPass": 1.2},
        {"lowPass": 0.3},
        sh_degree=0,
    ),
    Viewer(
        "PlayCanvas",
        "playcanvas",
        "playcanvas",
        {PLY: 42.7, COMPRESSED: 42.6, SOG: 43.0},
        {"minPixelSize": 0.0, "minContribution": 0.0, "lowPass": 1.2},
        {"antiAlias": True, "lowPass": 0.4},
    ),
    Viewer(
        "Babylon.js",
        "@babylonjs/core",
        "babylon",
        {PLY: 34.8, COMPRESSED: 33.7, SPLAT: 40.7},
        {"kernelSize": 1.2},
        {"compensation": True, "kernelSize": 0.4},
    ),
)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of a server of the files in ``folder``, for this machine only."""

    class Handler(SimpleHTTPRequestHandler):
        protocol_version = "HTTP/1.1"

        def log_message(self, *_: object) -> None:
            pass

    handler = functools.partial(Handler, directory=str(folder))
    with ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_address[1]}"
        server.shutdown()


def simple(camera: Camera) -> Camera:
    """A similar camera that every viewer has: square pixels, the principal point in the centre."""
    width, height = camera.width, camera.height
    return replace(camera, fx=camera.fy, cx=width / 2, cy=height / 2)


def world_from_camera(camera: Camera, suffix: str) -> list[float]:
    """16 numbers, column by column: from camera axes of OpenGL to the frame of the file."""
    matrix = torch.cat([camera.world_from_cam, torch.tensor([[0.0, 0.0, 0.0, 1.0]]).double()])
    matrix = matrix @ FLIP
    if suffix in SPZ:
        matrix = FLIP @ matrix
    return matrix.T.flatten().tolist()


def write(path: Path, gaussians: Gaussians) -> None:
    version = next((v for suffix, v in SPZ.items() if path.name.endswith(suffix)), None)
    if version is None:
        write_gaussians(path, gaussians)
    else:
        write_spz(path, GaussianArrays.from_gaussians(gaussians), version)


def settled(page: Page, camera: Camera, seconds: float) -> Tensor:
    """(H, W, 3) the picture, when it is no longer black and has not changed for a second."""
    end, before = time.monotonic() + seconds, None
    while time.monotonic() < end:
        now = torch.from_numpy(page.screenshot()[: camera.height, : camera.width].copy())
        if before is not None and now.any() and torch.equal(now, before):
            return now.float() / 255
        before = now
        time.sleep(1.0)
    raise BrowserError(f"no steady picture in {seconds:.0f} s")


@dataclass
class Comparison:
    """One scene and its cameras, in each of the viewers."""

    gaussians: Gaussians
    cameras: list[Camera]
    browser: Browser
    address: str
    folder: Path  # that is served
    images: Path | None

    def psnr(self, viewer: Viewer, suffix: str, options: dict[str, Any]) -> float:
        """The mean over the cameras, in dB.

        Raises:
            BrowserError: the viewer fails.
        """
        path = self.folder / f"scene{viewer.sh_degree}{suffix}"
        if not path.exists():
            write(path, with_sh_degree(self.gaussians, viewer.sh_degree))
        # Formats without a mark: the viewers are told, too.
        scene = replace(read_gaussians(path), antialiased=self.gaussians.antialiased)
        values = []
        for i, camera in enumerate(self.cameras):
            ours = (render(scene, camera).image.clamp(0, 1) * 255).round() / 255
            theirs = self.picture(viewer, path, suffix, camera, options)
            values.append(psnr(theirs, ours))
            if self.images:
                self.images.mkdir(parents=True, exist_ok=True)
                both = torch.cat([ours, theirs, (4 * (ours - theirs).abs()).clamp(0, 1)], 1)
                pixels = (both * 255).round().byte().numpy()
                kind = "set" if options else "plain"
                name = f"{viewer.script}{suffix}.{kind}.{i}.png"
                Image.fromarray(pixels).save(self.images / name)
        return sum(values) / len(values)

    def picture(
        self, viewer: Viewer, path: Path, suffix: str, camera: Camera, options: dict[str, Any]
    ) -> Tensor:
        page = self.browser.open(f"{self.address}/index.html")
        try:
            page.wait_for("window.ready")
            view = {
                "url": f"{self.address}/{path.name}",
                "width": camera.width,
                "height": camera.height,
                "focal": camera.fy,
                "worldFromCamera": world_from_camera(camera, suffix),
                "options": options,
            }
            page.evaluate(f"show({json.dumps(viewer.script)}, {json.dumps(view)})", 180.0)
            return settled(page, camera, 180.0)
        except BrowserError as error:
            raise BrowserError("\n".join([str(error), *page.errors])) from None
        finally:
            page.close()


def rows(comparison: Comparison, viewers: list[Viewer], formats: list[str]) -> int:
    """Print the table; returns the number of rows that are worse than `Viewer.formats`."""
    versions = json.loads((FOLDER / "package.json").read_text())["dependencies"]
    worse = 0
    print("| viewer | format | SH | as it comes | set |\n|---|---|---|---|---|")
    for viewer in viewers:
        if not (FOLDER / "node_modules" / viewer.package).is_dir():
            print(f"{viewer.name}: {viewer.package} is not installed; skipped", file=sys.stderr)
            continue
        for suffix in (s for s in viewer.formats if not formats or s in formats):
            cells = []
            settings = viewer.options
            if comparison.gaussians.antialiased:
                settings = settings | viewer.antialiased
            for options in ({}, settings):
                try:
                    value = comparison.psnr(viewer, suffix, options)
                except BrowserError as error:
                    print(f"{viewer.name}, {suffix}: {error}", file=sys.stderr)
                    value = math.nan
                cells.append(f"{value:.1f}")
            worse += not value >= viewer.formats[suffix]
            name = f"{viewer.name} {versions[viewer.package]}"
            print("|", " | ".join((name, suffix, str(viewer.sh_degree), *cells)), "|", flush=True)
    return worse


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("output", type=Path, metavar="OUT")
    names = {viewer.script: viewer for viewer in VIEWERS}
    parser.add_argument("--viewers", nargs="+", choices=names, default=list(names))
    parser.add_argument("--formats", nargs="+", default=[], metavar="SUFFIX")
    parser.add_argument("--views", type=int, default=2, help="cameras that are compared")
    parser.add_argument("--check", action="store_true", help="compare with the limits")
    parser.add_argument("--images", type=Path, metavar="DIR", help="write ours, theirs, 4 × error")
    arguments = parser.parse_args()
    if chromium() is None:
        print("Chromium is not installed, or not on the PATH; see SNOWSPLAT_CHROMIUM")
        return 2
    scene = load_viewable(arguments.output)
    if not scene.cameras:
        print(f"{arguments.output}: no cameras; use the output folder of a training")
        return 2
    step = max(1, len(scene.cameras) // arguments.views)
    cameras = [simple(camera) for camera in scene.cameras[::step][: arguments.views]]
    width = max(camera.width for camera in cameras)
    height = max(camera.height for camera in cameras)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for file in FOLDER.iterdir():
            (folder / file.name).symlink_to(file)
        with served(folder) as address, Browser(width, height) as browser:
            comparison = Comparison(
                scene.gaussians, cameras, browser, address, folder, arguments.images
            )
            viewers = [names[name] for name in arguments.viewers]
            worse = rows(comparison, viewers, arguments.formats)
            return int(arguments.check and worse > 0)


if __name__ == "__main__":
    sys.exit(main())
