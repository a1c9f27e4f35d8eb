"""A static web site that shows a scene: any web host can serve its folder."""

from __future__ import annotations

import html
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path

import torch
from PIL import Image

from snowsplat.formats import GaussianArrays
from snowsplat.formats.sog import write_sog
from snowsplat.scene.camera import Camera
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import look_at
from snowsplat.scene.initial_view import InitialView
from snowsplat.scene.render import render
from snowsplat.util.files import atomic_path, write_text
from snowsplat.viewer.web.page import asset, content_policy, page, settings
from snowsplat.viewer.web.scene import ready

SCENE, POSTER = "scene.sog", "poster.jpg"
#: The size that services recommend for the picture of a link (Open Graph).
POSTER_SIZE = (1200, 630)

_ABOUT = """        <style>
            .about {{
                position: fixed; z-index: 1; top: 0; left: 0; margin: 12px 16px; max-width: 70%;
                color: #fff; font: 14px/1.4 system-ui, sans-serif; text-shadow: 0 0 4px #000;
                pointer-events: none;
            }}
            .about b {{ font-size: 18px; display: block; }}
        </style>
        <div class="about"><b>{title}</b>{facts}</div>"""


@dataclass(frozen=True)
class Description:
    """What a page says about its scene.

    Attributes:
        title: the name of the scene.
        licence: the licence of the scene, such as "CC BY 4.0"; "" if it is not stated.
        url: the address of the folder on the web, which ends in "/"; "" if it is not known yet.
            Services that show a preview of a link need it to find the picture.
    """

    title: str
    licence: str = ""
    url: str = ""

    def facts(self, gaussians: int) -> str:
        """The facts in one line: number of Gaussians, date, licence."""
        known = (f"{gaussians:,} Gaussians", date.today().isoformat(), self.licence)
        return " · ".join(filter(None, known))


def write_site(
    folder: Path,
    gaussians: Gaussians,
    cameras: Sequence[Camera],
    background: Sequence[float],
    about: Description,
) -> None:
    """Write the page, its viewer, the scene in SOG format and a picture into a folder.

    Args:
        folder: it must exist. Files of an earlier site are replaced.
        cameras: the cameras of the photos; see `scene.ready`.
        background: red, green, blue in 0..1.

    Raises:
        OSError: a file cannot be written.
    """
    gaussians, start, film = ready(gaussians, cameras)
    write_sog(folder / SCENE, GaussianArrays.from_gaussians(gaussians))
    with atomic_path(folder / POSTER) as temporary:
        temporary.write_bytes(_poster(gaussians, start, background))
    for name in ("index.css", "index.js"):
        write_text(folder / name, asset(name))
    write_text(folder / "viewer-licence.txt", asset("LICENSE"))
    bootstrap = {
        "settings": settings(start, background, film),
        "contentUrl": f"./{SCENE}",
        "posterUrl": f"./{POSTER}",
    }
    facts = about.facts(len(gaussians))
    body = _ABOUT.format(title=html.escape(about.title), facts=html.escape(facts))
    tags = _tags(
        {
            "og:type": "website",
            "og:title": about.title,
            "og:description": f"A scene in 3D: {facts}. Made with snowsplat.",
            "og:image": about.url + POSTER,
            "og:image:width": str(POSTER_SIZE[0]),
            "og:image:height": str(POSTER_SIZE[1]),
            **({"og:url": about.url} if about.url else {}),
            "twitter:card": "summary_large_image",
        }
    )
    text = page(about.title, bootstrap, head=tags, body=body)
    # A host may send no headers, so the policy is in the page.
    policy = html.escape(content_policy(text, "'self'"))
    rule = f'<meta http-equiv="Content-Security-Policy" content="{policy}" />'
    charset = '<meta charset="UTF-8" />'
    write_text(folder / "index.html", text.replace(charset, f"{charset}\n        {rule}", 1))


def _tags(properties: Mapping[str, str]) -> str:
    """The tags that services read for the preview of a link."""
    return "\n        ".join(
        f'<meta property="{name}" content="{html.escape(value)}" />'
        for name, value in properties.items()
    )


def _poster(gaussians: Gaussians, start: InitialView, background: Sequence[float]) -> bytes:
    """The initial view as a JPEG file."""
    width, height = POSTER_SIZE
    position, target = (
        torch.tensor(point, dtype=torch.float64) for point in (start.position, start.target)
    )
    pose = look_at(position, target, torch.tensor([0.0, -1.0, 0.0], dtype=torch.float64))
    focal = 0.5 * width / float(torch.tan(torch.tensor(start.fov).deg2rad() / 2))
    camera = Camera(width, height, focal, focal, width / 2, height / 2, pose)
    with torch.no_grad():
        image = render(gaussians.detach(), camera, torch.tensor(background)).image
    pixels = image.clamp(0, 1).mul(255).round().to(torch.uint8).numpy()
    file = io.BytesIO()
    Image.fromarray(pixels).save(file, "JPEG", quality=88)
    return file.getvalue()
