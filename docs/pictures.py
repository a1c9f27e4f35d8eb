"""Makes the pictures of the README and of the documentation.

    python -c "from snowsplat.synthetic.photographer import write_synthetic_photos as write; \
        write('out/table', 36, 1024, 768)"
    snowsplat make out/table -o out/scenes/table
    git clone https://github.com/pierotofy/dataset_banana out/banana  # 16 photos, MIT License
    snowsplat make out/banana/images -o out/scenes/banana --quality draft
    python docs/pictures.py out/scenes/table out/scenes/banana

Needs Chromium. Writes to docs/pictures: scene.webp and real.webp (moving pictures: the camera moves
around the scene), studio.webp (the page of the scene in the studio), globe.webp (a moving picture:
the scene in a snow globe), web.webp and live.webp (the two viewers) and report.webp (the report of
the training).
"""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import quote

import av
from PIL import Image

import snowsplat

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from tests.browser import Browser, Page  # noqa: E402

PICTURES = Path(__file__).with_name("pictures")
WIDTH, HEIGHT = 1280, 800
#: The moving picture: a size and rate that make it small enough for a page that is often opened.
FILM = snowsplat.VideoOptions(path="ellipse", seconds=5.0, fps=10.0, size="560x350")
FILM_QUALITY = 42
GLOBE = snowsplat.GlobeOptions(name="snowsplat", size="400", fps=10.0)
GLOBE_QUALITY = 30


def film(scene: Path, target: Path) -> None:
    """An animated WebP file of a camera that moves around the scene."""
    with TemporaryDirectory() as folder:
        video = Path(folder) / "film.mp4"
        snowsplat.render_video(scene, FILM, target=video)
        animate(video, target, FILM.fps, FILM_QUALITY)


def globe(scene: Path, target: Path) -> None:
    """An animated WebP file of the scene in a snow globe."""
    with TemporaryDirectory() as folder:
        video = Path(folder) / "globe.mp4"
        snowsplat.make_globe(scene, Path(folder) / "globe.html", GLOBE, video=video)
        animate(video, target, GLOBE.fps, GLOBE_QUALITY)


def animate(video: Path, target: Path, fps: float, quality: int) -> None:
    """The frames of a video as an animated WebP file."""
    with av.open(str(video)) as container:
        first, *rest = [frame.to_image() for frame in container.decode(video=0)]
    first.save(
        target,
        save_all=True,
        append_images=rest,
        duration=round(1000 / fps),
        loop=0,
        quality=quality,
        method=6,
    )


def shoot(page: Page, target: Path) -> None:
    """Save what a tab shows, with the controls of a viewer, which appear when the mouse moves."""
    for x in (640, 642):
        page.call("Input.dispatchMouseEvent", type="mouseMoved", x=x, y=400)
    time.sleep(1)
    Image.fromarray(page.screenshot()).save(target, quality=85, method=6)


def studio(made: Path, browser: Browser, target: Path) -> None:
    """The page of a scene in the studio of its folder."""
    command = [sys.executable, "-m", "snowsplat", "studio", str(made.parent), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        url = next(line.split()[-1] for line in process.stdout if "http://" in line)
        page = browser.open(f"{url}#{quote(made.name)}")
        page.wait_for("!!document.querySelector('iframe')", 200)
        page.wait_for("!!document.querySelector('iframe').contentWindow.app", 200)
        page.evaluate("window.scrollTo(0, 60)")
        time.sleep(3)
        shoot(page, target)
        page.close()
        process.terminate()


@contextmanager
def training(dataset: Path) -> Iterator[str]:
    """The address of the page of a training run, which ends with the context."""
    with TemporaryDirectory() as folder:
        out = Path(folder) / "table"  # the page shows this name
        command = [sys.executable, "-m", "snowsplat", "train", str(dataset), "-o", str(out)]
        command += ["--eval", "--view"]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            url = ""
            for line in process.stdout:  # until the page is ready
                if line.startswith("watch it in a browser: "):
                    url = line.split()[-1]
                if line.startswith("step"):
                    break
            yield url
            process.terminate()


def main(made: Path, real: Path) -> None:
    PICTURES.mkdir(exist_ok=True)
    film(made, PICTURES / "scene.webp")
    film(real, PICTURES / "real.webp")
    globe(made, PICTURES / "globe.webp")
    with Browser(WIDTH, HEIGHT, frames=5.0) as browser, TemporaryDirectory() as folder:
        shoot(browser.open((made / "scene" / "report.html").as_uri()), PICTURES / "report.webp")
        studio(made, browser, PICTURES / "studio.webp")
        html = Path(folder) / "scene.html"
        snowsplat.convert(made, html)
        page = browser.open(f"{html.as_uri()}?webgl")
        page.wait_for("!!window.app", 120)
        time.sleep(3)  # the first picture is coarse
        shoot(page, PICTURES / "web.webp")
        page.close()
        with training(made / "dataset") as url:
            page = browser.open(url)
            page.evaluate("document.documentElement.dataset.theme = 'dark'")
            page.evaluate("document.getElementById('language').hidden = true")  # needs a font
            page.evaluate("document.getElementById('frustums').click()")
            page.wait_for("/Step 1,[5-9]/.test(document.getElementById('status').innerText)", 600)
            shoot(page, PICTURES / "live.webp")


if __name__ == "__main__":
    main(*map(Path, sys.argv[1:]))
