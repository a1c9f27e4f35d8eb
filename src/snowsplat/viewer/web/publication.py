"""A static web site that shows a scene: any web host can serve its folder.

`write_html` writes the viewer and the scene in a single HTML file. It can be opened from disk in
any browser with WebGL 2, and makes no network requests. The scene is embedded as a SOG file in
base64, the same as that of a published site. Pages are written, but cannot be read.
"""

import base64
import html
import io
from collections.abc import Callable, Mapping
from pathlib import Path

import torch
from PIL import Image

from snowsplat.formats import GaussianArrays
from snowsplat.formats.lod import INDEX
from snowsplat.formats.sog import sog_bytes, write_sog
from snowsplat.project.site_folder import PAGE, POSTER, SCENE, SiteFolder
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.render import render, to_8bit
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_bytes, write_text
from snowsplat.viewer.http.static import Served, served
from snowsplat.viewer.web.panel import Description
from snowsplat.viewer.web.scene import PICTURES, ReadyScene
from snowsplat.viewer.web.viewer_page import asset, content_policy, page, whole_page

#: The size that services recommend for the picture of a link (Open Graph).
POSTER_SIZE = (1200, 630)
#: The file with the surfaces that stop a person who walks.
GROUND = "ground.glb"
#: Largest scene in bytes. Browsers support strings of about 500 million characters, and base64
#: makes 4 characters of 3 bytes.
_LARGEST = 360_000_000
# The scene is passed to the viewer as a blob URL, because browsers limit the length of data URLs.
_SCENE = Path(__file__).with_name("inline_scene.html")


def write_one_file(folder: Path, gaussians: Gaussians) -> str:
    """Write the scene as a SOG file."""
    write_sog(folder / SCENE, GaussianArrays.from_gaussians(gaussians))
    return SCENE


def write_site(
    folder: Path,
    scene: ReadyScene,
    about: Description,
    url: str = "",
    write_scene: Callable[[Path, Gaussians], str] = write_one_file,
) -> None:
    """Write the page, its viewer, the scene and a picture into a folder; see `SiteFolder`.

    Args:
        folder: it must exist. An earlier site is replaced, at once.
        url: the address of the folder on the web, which ends in "/"; "" if it is not known yet.
            Services that show a preview of a link need it to find the picture.
        write_scene: writes the scene into a folder, and returns the name of the file to load.

    Raises:
        UserError: another process writes this site.
        OSError: a file cannot be written.
    """
    content = ""

    def write(files: Path) -> None:
        nonlocal content, scene
        content = write_scene(files, scene.gaussians)
        if content == INDEX:
            scene = scene.complete()
        write_bytes(files / POSTER, _poster(scene))
        if scene.stops.views:
            write_bytes(files / PICTURES, scene.stops.pictures)
        if scene.ground:
            write_bytes(files / GROUND, scene.ground)
        for name in ("index.css", "index.js"):
            write_text(files / name, asset(name))
        write_text(files / "viewer-licence.txt", asset("LICENSE"))

    SiteFolder(folder).replace(write, lambda files: _page(scene, about, url, f"{files}/", content))


def _page(scene: ReadyScene, about: Description, url: str, files: str, content: str) -> str:
    """The page, which loads what is in the folder ``files`` beside it."""
    bootstrap = scene.bootstrap(about, f"./{files}{PICTURES}")
    facts = about.facts(len(scene.gaussians))
    bootstrap |= {"contentUrl": f"./{files}{content}", "posterUrl": f"./{files}{POSTER}"}
    if scene.ground:
        bootstrap["collisionUrl"] = f"./{files}{GROUND}"
    tags = _tags(
        {
            "og:type": "website",
            "og:title": about.title,
            "og:description": f"A scene in 3D: {facts}. Made with snowsplat.",
            "og:image": url + files + POSTER,
            "og:image:width": str(POSTER_SIZE[0]),
            "og:image:height": str(POSTER_SIZE[1]),
            **({"og:url": url} if url else {}),
            "twitter:card": "summary_large_image",
        }
    )
    text = page(about.title, bootstrap, head=tags, files=files)
    # A host may send no headers, so the policy is in the page.
    policy = html.escape(content_policy(text, "'self'"))
    rule = f'<meta http-equiv="Content-Security-Policy" content="{policy}" />'
    charset = '<meta charset="UTF-8" />'
    return text.replace(charset, f"{charset}\n        {rule}", 1)


def site_files(folder: Path) -> tuple[dict[str, Served], dict[str, str]]:
    """The files of a site for `static_app`, and the HTTP headers for them. Links that leave the
    folder are not followed."""
    root = folder.resolve()
    inside = (file for file in folder.rglob("*") if file.resolve().is_relative_to(root))
    files = served(folder, sorted(file for file in inside if file.is_file()))
    # The page contains the rest of its policy.
    return {"": files[PAGE], **files}, {"Content-Security-Policy": "frame-ancestors 'none'"}


def _tags(properties: Mapping[str, str]) -> str:
    """The tags that services read for the preview of a link."""
    return "\n        ".join(
        f'<meta property="{name}" content="{html.escape(value)}" />'
        for name, value in properties.items()
    )


def _poster(scene: ReadyScene) -> bytes:
    """The initial view as a JPEG file."""
    camera = scene.camera(*POSTER_SIZE)
    with torch.no_grad():
        shown = scene.hiding.shown(scene.gaussians.detach())
        image = render(shown, camera, torch.tensor(scene.background)).image
    file = io.BytesIO()
    Image.fromarray(to_8bit(image)).save(file, "JPEG", quality=88)
    return file.getvalue()


def write_html(path: Path | str, scene: ReadyScene, about: Description | None = None) -> None:
    """Write the page of a scene atomically; ``about`` is by default the name of the file.

    Raises:
        UserError: no Gaussians, or too many for one page.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    about = about or Description(path.stem)
    count = len(scene.gaussians)
    if not count:
        raise UserError("{path}: the scene has no Gaussians; a page needs at least one", path=path)
    content = sog_bytes(path, GaussianArrays.from_gaussians(scene.gaussians))
    if len(content) > _LARGEST:
        raise UserError(
            "{path}: {count:,} Gaussians are too many for one page; decimate them, or drop SH "
            "degrees",
            path=path,
            count=count,
        )
    pictures = f"data:image/webp;base64,{_base64(scene.stops.pictures)}"
    bootstrap = scene.bootstrap(about, pictures) | {"contentFilename": "scene.sog"}
    write_text(
        path,
        whole_page(
            about.title,
            bootstrap,
            _SCENE.read_text("utf-8").rstrip("\n").format(scene=_base64(content)),
        ),
    )


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
