"""Makes the scenes and the pictures of the page "Gallery".

    python docs/gallery.py                 # all
    python docs/gallery.py still-life      # one of them

The scenes are procedural: no file of anybody else is in them. A scene becomes a page of
one file in build/gallery, which `make docs` copies into the site if it is there, and a picture in
docs/pictures. Nothing is made that is there already.
"""

import shutil
import sys
from collections.abc import Callable
from pathlib import Path

import torch
from PIL import Image

import snowsplat
from snowsplat.extras.anamorph.make_anamorph import make_anamorph
from snowsplat.pipeline.output.scene_source import load_viewable
from snowsplat.scene.render import render, to_8bit
from snowsplat.synthetic.photographer import write_synthetic_photos

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT), str(ROOT / "benchmarks")]

from street_dataset import write_street_dataset  # noqa: E402

PAGES, WORK = ROOT / "build" / "gallery", ROOT / "build" / "gallery-work"
PICTURE_SIZE = 600, 400


def room(seed: int) -> Callable[[Path], object]:
    """The photographer of a room with a table; the seed decides on everything in it."""
    return lambda folder: write_synthetic_photos(folder, 40, 640, 480, seed)


#: Name -> what writes the photos, and the quality.
SCENES: dict[str, tuple[Callable[[Path], object], str]] = {
    "still-life": (room(0), "draft"),
    "red-room": (room(3), "draft"),
    "street": (lambda folder: write_street_dataset(folder, 120, 480, 320), "draft"),
}
#: The scene that is put into a snow globe, another page.
GLOBE = "still-life"


def make(name: str) -> Path:
    """The output folder of a scene, which is made if it is not there."""
    photos, made = WORK / name / "photos", WORK / name / "made"
    write, quality = SCENES[name]
    if not made.exists():
        write(photos)
        snowsplat.make(photos, made, snowsplat.MakeOptions(quality=quality))
    return made


def picture(made: Path, target: Path) -> None:
    """What the page of a scene shows first."""
    scene = load_viewable(made).ready()
    with torch.no_grad():
        image = render(
            scene.gaussians.detach(), scene.camera(*PICTURE_SIZE), torch.tensor(scene.background)
        ).image
    Image.fromarray(to_8bit(image)).save(target, quality=80, method=6)


def main(names: list[str]) -> None:
    PAGES.mkdir(parents=True, exist_ok=True)
    for name in names or [*SCENES, "globe", "anamorph"]:
        page = PAGES / f"gallery-{name}.html"
        target = ROOT / "docs" / "pictures" / f"gallery-{name}.webp"
        if page.exists():
            continue
        if name == "anamorph":  # its picture is that of its guide
            pictures = [target.with_name(f"gallery-{scene}.webp") for scene in SCENES]
            shutil.copy(make_anamorph(pictures, WORK / name, overwrite=True).page, page)
        elif name == "globe":  # its picture is one of docs/pictures.py
            snowsplat.make_globe(make(GLOBE), page, snowsplat.GlobeOptions(name="snowsplat"))
        else:
            made = make(name)
            snowsplat.convert(made, page)
            picture(made, target)


if __name__ == "__main__":
    main(sys.argv[1:])
