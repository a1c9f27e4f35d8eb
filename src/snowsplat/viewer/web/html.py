"""A self-contained page: the viewer and the scene in a single HTML file.

It can be opened from disk in any browser with WebGL 2, and makes no network requests. The scene is
embedded as a compressed PLY file in base64. Pages are written, but cannot be read.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from pathlib import Path

from snowsplat.formats import GaussianArrays
from snowsplat.formats.compressed_ply import encode_compressed_ply
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.initial_view import InitialView, overview
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
from snowsplat.viewer.web.page import settings, whole_page

#: Largest scene in bytes. Browsers support strings of about 500 million characters, and base64
#: makes 4 characters of 3 bytes.
_LARGEST = 360_000_000

# The scene is passed to the viewer as a blob URL, because browsers limit the length of data URLs.
_SCENE = """        <script type="text/plain" id="scene">{scene}</script>
        <script>
            const scene = document.getElementById('scene');
            const base64 = scene.textContent;
            scene.remove();
            const parts = [];
            for (let at = 0; at < base64.length; at += 1 << 22) {{
                const text = atob(base64.slice(at, at + (1 << 22)));
                const bytes = new Uint8Array(text.length);
                for (let i = 0; i < text.length; i++) bytes[i] = text.charCodeAt(i);
                parts.push(bytes);
            }}
            const bootstrap = document.getElementById('sse-bootstrap');
            const contentUrl = URL.createObjectURL(new Blob(parts));
            bootstrap.textContent = JSON.stringify({{
                ...JSON.parse(bootstrap.textContent), contentUrl
            }});
        </script>"""


def write_html(
    path: Path | str,
    gaussians: Gaussians,
    start: InitialView | None = None,
    film: Sequence[InitialView] = (),
) -> None:
    """Write the page atomically. Its first view is ``start``; default: an overview of the scene.

    The animation of the page is ``film``; see `page.settings`.

    Raises:
        UserError: no Gaussians, or too many for one page.
        OSError: the folder is missing or not writable, or the disk is full.
    """
    path = Path(path)
    if not len(gaussians):
        raise UserError(f"{path}: the scene has no Gaussians; a page needs at least one")
    scene = encode_compressed_ply(path, GaussianArrays.from_gaussians(gaussians))
    if len(scene) > _LARGEST:
        raise UserError(
            f"{path}: {len(gaussians):,} Gaussians are too many for one page; "
            "decimate them, or drop SH degrees"
        )
    encoded = base64.b64encode(scene).decode("ascii")
    background = (0.0, 0.0, 0.0)
    bootstrap = {
        "settings": settings(start or overview(gaussians), background, film),
        "contentFilename": "scene.compressed.ply",
    }
    write_text(path, whole_page(path.stem, bootstrap, _SCENE.format(scene=encoded)))
