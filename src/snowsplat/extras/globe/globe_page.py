"""Writes a globe as a self-contained HTML page: `write_page`.

The page makes no network requests, and can be opened from disk in any browser with WebGL 2. Its
script and shaders are in the folder `web`; the constants in them come from the modules of this
package. The Gaussians are quantised to 26 bytes each, and embedded in base64.
"""

import base64
import hashlib
import html
import json
from pathlib import Path
from string import Template
from typing import Any

import numpy as np
import torch

from snowsplat.extras.globe import dimensions, glass, globe_video, physics
from snowsplat.extras.globe import globe_video as video
from snowsplat.extras.globe.layout import Arrangement
from snowsplat.ops import reference
from snowsplat.scene.gaussians import SH_REST_COUNTS, Gaussians
from snowsplat.util.files import make_parent, write_text
from snowsplat.util.safe_json import printable

_WEB = Path(__file__).with_name("web")
_SHADERS = {
    "common": "common.glsl",
    "behind": "behind.frag",
    "front": "front.frag",
    "vertex": "splats.vert",
    "fragment": "splats.frag",
}


def write_page(path: Path | str, arrangement: Arrangement, name: str) -> None:
    """Write the page of at least one Gaussian atomically. ``name``: on the plate, and the title.

    Raises: OSError: the folder is missing or not writable, or the disk is full.
    """
    columns, data = encode(arrangement.gaussians)
    simulation = _source("simulation.js")
    about = {
        "name": name,
        "count": len(arrangement.gaussians),
        "surrounded": arrangement.surrounded,
        "columns": columns,
        "constants": constants(),
        "glsl": glsl_constants(arrangement.gaussians.antialiased),
        "shaders": {key: _source(file) for key, file in _SHADERS.items()},
        "simulation": simulation,
    }
    # The page also uses the random numbers of the simulation.
    script = simulation + _source("renderer.js") + _source("main.js")
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    policy = f"default-src 'none'; script-src 'sha256-{digest}' blob:; worker-src blob:; " + (
        "style-src 'unsafe-inline'; img-src data:; base-uri 'none'; form-action 'none'"
    )
    shown = html.escape(printable(name))
    page = Template(_source("globe.html")).substitute(
        policy=html.escape(policy, quote=False),
        title=f"{shown} - snow globe",
        label=f"The scene {shown} in a snow globe",
        data=base64.b64encode(data).decode(),
        # "<" could end the script element.
        about=json.dumps(about).replace("<", "\\u003c"),
        script=script,
    )
    make_parent(Path(path))
    write_text(Path(path), page)


def constants() -> dict[str, Any]:
    """The constants of this package that the script of the page uses."""
    of_video = ("DISTANCE", "ELEVATION", "FOCAL", "MIDDLE", "SHAKE_DIRECTION")
    return physics.constants() | {
        "BASE": [[ring.y, ring.half, ring.radius, ring.edge] for ring in dimensions.BASE],
        "PLATE": glass.PLATE,
        **{name: getattr(video, name) for name in of_video},
    }


def glsl_constants(antialiased: bool) -> str:
    """The constants of this package that the shaders use, as GLSL declarations."""
    modules: dict[Any, tuple[str, ...]] = {
        dimensions: ("FLOOR", "FLOOR_RADIUS", "BLEND", "GROUND"),
        glass: ("PLATE_Y", "FRESNEL"),
        globe_video: ("BRIGHTER", "WHITE", "OPAQUE"),
        reference: ("C1",),
    }
    numbers = {name: getattr(m, name) for m, names in modules.items() for name in names}
    lines = [f"const float {name} = {value!r};" for name, value in numbers.items()]
    lines.append(f"const bool ANTIALIASED = {str(antialiased).lower()};")
    vectors = {name: getattr(glass, name) for name in ("SNOW", "BRASS", "LIGHT", "PLATE")}
    vectors["FLAKE"] = physics.FLAKE
    for name, value in vectors.items():
        lines.append(f"const vec{len(value)} {name} = {_vector(value)};")
    for name in ("BACKGROUND", "INSIDE", "WOOD"):
        pair = ", ".join(_vector(value) for value in getattr(glass, name))
        lines.append(f"const vec3 {name}[2] = vec3[2]({pair});")
    rings = [_vector((ring.y, ring.half, ring.radius, ring.edge)) for ring in dimensions.BASE]
    lines.append(f"const int BASE_PARTS = {len(rings)};")
    lines.append(f"const vec4 BASE[{len(rings)}] = vec4[{len(rings)}]({', '.join(rings)});")
    return "\n".join(lines) + "\n"


def encode(gaussians: Gaussians) -> tuple[list[dict[str, Any]], bytes]:
    """Quantise the Gaussians: the columns, and their bytes.

    A column is described by its name, its kind (i2, u1 or i1), its offset in bytes, its number of
    values, and by scale and low: the value is low + scale · integer. Colours that depend on the
    direction are reduced to SH degree 1.
    """
    base, sh = _reduced_colors(gaussians)
    values = {
        "position": (gaussians.means, "i2"),
        "log_scales": (gaussians.log_scales.clamp(-12.0, 0.0), "u1"),
        "quat": (gaussians.rotations, "i1"),
        "opacity": (gaussians.opacities, "u1"),
        "color": (base.clamp(-1.0, 2.0), "u1"),
        "sh": (sh.clamp(-1.0, 1.0), "i1"),
    }
    columns: list[dict[str, Any]] = []
    data = b""
    for name, (tensor, kind) in values.items():
        column = tensor.detach().cpu().double().numpy().ravel()
        low, levels = 0.0, {"i2": 32767, "i1": 127, "u1": 255}[kind]
        if kind == "u1":
            low = float(column.min())
        scale = max(float(np.abs(column - low).max()), 1e-6) / levels
        quantised = np.rint((column - low) / scale).astype(kind)
        where = {"name": name, "kind": kind, "offset": len(data), "length": len(column)}
        columns.append(where | {"scale": scale, "low": low})
        data += quantised.astype(f"<{kind}").tobytes()
    return columns, data


def _reduced_colors(gaussians: Gaussians) -> tuple[torch.Tensor, torch.Tensor]:
    """The base colours (N, 3), and the SH coefficients (N, 3, 3) of degree 1 for y, z and x.

    They are the best approximation, by least squares, for the directions from which a globe is
    seen: from the sides, and slightly from above. From the other directions, a scene was not
    photographed, and its colours there are arbitrary.
    """
    degree = SH_REST_COUNTS.index(gaussians.sh_rest.shape[1])
    azimuth = torch.arange(24, dtype=torch.float64) * (2 * torch.pi / 24)
    elevation = torch.deg2rad(torch.arange(-10, 51, 10, dtype=torch.float64))
    azimuth, elevation = (
        grid.ravel() for grid in torch.meshgrid(azimuth, elevation, indexing="ij")
    )
    level = elevation.cos()
    # The direction from the camera; y is down.
    directions = torch.stack([level * azimuth.sin(), elevation.sin(), level * azimuth.cos()], 1)
    full, low = (reference.sh_basis(directions, d) for d in (degree, min(degree, 1)))
    matrix = torch.linalg.lstsq(low, full).solution.to(gaussians.sh_dc.dtype)
    coefficients = torch.cat([gaussians.sh_dc, gaussians.sh_rest], 1)
    reduced = torch.einsum("ij,njc->nic", matrix, coefficients)
    base = 0.5 + reference.C0 * reduced[:, 0]
    if degree == 0:
        return base, torch.zeros(len(base), 3, 3)
    return base, reduced[:, 1:]


def _vector(values: tuple[float, ...]) -> str:
    return f"vec{len(values)}({', '.join(repr(float(value)) for value in values)})"


def _source(name: str) -> str:
    return (_WEB / name).read_text(encoding="utf-8")
