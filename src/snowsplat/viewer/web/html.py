"""A self-contained page: the viewer and the scene in a single HTML file.

It can be opened from disk in any browser with WebGL 2, and makes no network requests. The scene is
embedded as a SOG file in base64, the same as that of a published site. Pages are written, but
cannot be read.
"""

from __future__ import annotations

import base64
from pathlib import Path

from snowsplat.formats import GaussianArrays
from snowsplat.formats.sog import sog_bytes
from snowsplat.util.errors import UserError
from snowsplat.util.files import write_text
from snowsplat.viewer.web.panel import Description
from snowsplat.viewer.web.scene import ReadyScene
from snowsplat.viewer.web.viewer_page import whole_page

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
    write_text(path, whole_page(about.title, bootstrap, _SCENE.format(scene=_base64(content))))


def _base64(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")
