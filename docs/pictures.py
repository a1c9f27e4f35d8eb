"""Makes the pictures of the README and of the documentation.

    python -c "from snowsplat.synthetic.photographer import write_synthetic_photos as write; \
        write('out/table', 36, 1024, 768)"
    snowsplat make out/table -o out/scenes/table
    git clone https://github.com/pierotofy/dataset_banana out/banana  # 16 photos, MIT License
    snowsplat make out/banana/images -o out/scenes/banana --quality draft
    python docs/pictures.py out/scenes/table out/scenes/banana out/banana/images

Needs Chromium. Writes to docs/pictures: scene.webp and real.webp (moving pictures: the camera moves
around the scene), studio.webp (a film of the studio, from the photos to the scene), globe.webp (a
moving picture: the scene in a snow globe), web.webp and live.webp (the two viewers) and report.webp
(the report of the training).
"""

import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

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
#: The film of the studio: what the tab has, what is kept of it.
STUDIO_SIZE, STUDIO_SHOWN, STUDIO_QUALITY = (1120, 780), (784, 546), 40
STUDIO_RUNNING = 60  # pictures of the job
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


class Recording:
    """A film of a tab: pictures, and for how many milliseconds each is shown."""

    def __init__(self, page: Page) -> None:
        self._page = page
        self.images: list[Image.Image] = []
        self._durations: list[int] = []

    def hold(self, milliseconds: int) -> None:
        """Show what the tab shows now; what has not changed is shown for longer."""
        image = Image.fromarray(self._page.screenshot()).resize(
            STUDIO_SHOWN, Image.Resampling.LANCZOS
        )
        if self.images and image.tobytes() == self.images[-1].tobytes():
            self._durations[-1] += milliseconds
        else:
            self.images.append(image)
            self._durations.append(milliseconds)

    def thin(self, first: int, most: int) -> None:
        """Keep at most so many of the pictures from this one on, at equal distances."""
        step = -(-(len(self.images) - first) // most)
        self.images[first:] = self.images[first::step]
        self._durations[first:] = self._durations[first::step]

    def save(self, target: Path) -> None:
        first, *rest = self.images
        options = {"quality": STUDIO_QUALITY, "method": 6, "minimize_size": True, "loop": 0}
        first.save(target, save_all=True, append_images=rest, duration=self._durations, **options)


def studio(photos: Path, target: Path) -> None:
    """A film of the studio: photos are dropped and looked at, and become a scene, which turns."""
    with (
        TemporaryDirectory() as folder,
        served(Path(folder)) as url,
        Browser(*STUDIO_SIZE, frames=10.0) as browser,
    ):
        page = browser.open(url)
        film = Recording(page)
        page.wait_for("!!document.querySelector('.drop')")
        film.hold(1200)
        page.drop(photos)
        page.wait_for("!!document.querySelector('form.card:not([hidden]) .main')", 600)
        page.wait_for("/\\d/.test(document.querySelector('[data-quality=draft]').textContent)", 600)
        film.hold(1500)
        page.evaluate("document.querySelector('input[value=draft]').click()")
        page.evaluate("document.querySelector('form.card').scrollIntoView({block: 'end'})")
        film.hold(1200)
        page.evaluate("document.querySelector('form.card .main').click()")
        page.evaluate("window.scrollTo(0, 0)")
        status = "document.querySelector('.status').dataset.status"
        page.wait_for(f"{status} === 'running'", 600)
        began = len(film.images)
        while page.evaluate(status) == "running":
            film.hold(120)
            time.sleep(1.0)
        film.thin(began, STUDIO_RUNNING)
        page.wait_for("!!document.querySelector('iframe.viewer')?.contentWindow?.app", 600)
        time.sleep(8)  # the first picture is coarse
        film.hold(1500)
        mouse = {"button": "left", "clickCount": 1}
        page.call("Input.dispatchMouseEvent", type="mousePressed", x=460, y=460, **mouse)
        for i in range(24):
            x = 460 + 12 * i
            page.call(
                "Input.dispatchMouseEvent", type="mouseMoved", x=x, y=460, button="left", buttons=1
            )
            time.sleep(0.1)
            film.hold(100)
        page.call("Input.dispatchMouseEvent", type="mouseReleased", x=x, y=460, **mouse)
        time.sleep(1)
        film.hold(2000)
        film.save(target)


@contextmanager
def served(folder: Path) -> Iterator[str]:
    """The address of the studio of a folder, which ends with the context."""
    command = [sys.executable, "-m", "snowsplat", "studio", str(folder), "--no-browser"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        yield next(line.split()[-1] for line in process.stdout if "http://" in line)
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


def main(made: Path, real: Path, photos: Path) -> None:
    PICTURES.mkdir(exist_ok=True)
    film(made, PICTURES / "scene.webp")
    film(real, PICTURES / "real.webp")
    globe(made, PICTURES / "globe.webp")
    studio(photos.absolute(), PICTURES / "studio.webp")
    with Browser(WIDTH, HEIGHT, frames=5.0) as browser, TemporaryDirectory() as folder:
        shoot(browser.open((made / "scene" / "report.html").as_uri()), PICTURES / "report.webp")
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
