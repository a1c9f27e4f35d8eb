"""From each format to each other one: what changes is what the format says that it loses."""

import itertools
from dataclasses import replace

import numpy as np
import pytest
import torch

from snowsplat.formats import read_arrays, usd, write_gaussians
from snowsplat.formats.registry import FORMATS
from snowsplat.scene.gaussians import Gaussians
from snowsplat.scene.geometry import rotation_from_quat

from ..usd import USD

NAMES = ["compressed PLY", "PLY", "SPZ", "SOG", "streamed SOG", "glTF", "splat"]
NAMES += ["USD"] if USD else []
BY_NAME = {format.name: format for format in FORMATS}
ROUNDING = 2e-5

#: The largest differences by what the line of a format must name: positions, logarithms of scales,
#: angles of rotations in radians, opacities, colours (SH of degree 0), other SH. Those that are
#: not here are equal, or rounded if the line says so.
PRECISION = {
    "compressed PLY": {"means": 0.003, "scales": 0.005, "rotations": 0.01, "other": 0.02},
    "SPZ": {"means": 1e-4, "scales": 0.04, "rotations": 0.01, "other": 0.03},
    "SOG": (sog := {"means": 1e-4, "scales": 0.02, "rotations": 0.02, "other": 0.02}),
    "streamed SOG": sog,
    "splat": {"rotations": 0.03, "other": 0.02, "sh": np.inf},
    "PLY": {},
    "glTF": {},
    "USD": {},
}
WORDS = {"means": "position", "rotations": "rotations", "sh": "all SH", "scales": "scale"}


@pytest.fixture(autouse=True)
def _in_this_process(monkeypatch):
    monkeypatch.setattr(usd, "check_readable", lambda *_: None)


def scene() -> Gaussians:
    """Gaussians of a grid, so that each is found again in another order."""
    generator = torch.Generator().manual_seed(3)
    grid = torch.tensor(list(itertools.product(range(4), range(4), range(3)))).float()
    count = len(grid)

    def uniform(low: float, high: float, *shape: int) -> torch.Tensor:
        return low + (high - low) * torch.rand(count, *shape, generator=generator)

    return Gaussians(
        grid + uniform(-0.3, 0.3, 3),
        uniform(-4.0, -1.0, 3),
        torch.nn.functional.normalize(uniform(-1.0, 1.0, 4), dim=1),
        uniform(-3.0, 3.0),
        uniform(-1.0, 1.0, 1, 3),
        uniform(-0.3, 0.3, 15, 3),
        antialiased=True,
        origin=(500_000.0, 20.0, -5_400_000.0),
        metres_per_unit=1.0,  # others are scaled for glTF
    )


def differences(one: Gaussians, other: Gaussians) -> dict[str, float]:
    places, found = (
        s.means.double() + torch.tensor(s.origin, dtype=torch.float64) for s in (one, other)
    )
    nearest = torch.cdist(places, found).argmin(1)
    assert len(set(nearest.tolist())) == len(one)
    other = replace(other.select(nearest), means=other.means[nearest])
    turns = [
        rotation_from_quat(torch.nn.functional.normalize(s.quats, dim=1)) for s in (one, other)
    ]
    sh = torch.zeros_like(one.sh_rest)
    sh[:, : other.sh_rest.shape[1]] = other.sh_rest
    return {
        "means": float((places - found[nearest]).abs().max()),
        "scales": float((one.log_scales - other.log_scales).abs().max()),
        "rotations": float((turns[0] - turns[1]).abs().max()),
        "other": float((one.opacities - other.opacities).abs().max()),
        "colours": float((one.sh_dc - other.sh_dc).abs().max()),
        "sh": float((one.sh_rest - sh).abs().max()) if one.sh_rest.numel() else 0.0,
    }


@pytest.mark.parametrize("first", NAMES)
def test_every_pair(tmp_path, first):
    """What is lost on the way from the first format to the second one is named by the second."""
    begin = tmp_path / f"a{BY_NAME[first].suffixes[0]}"
    begin.parent.mkdir(exist_ok=True)
    _write(begin, scene())
    before = read_arrays(begin).to_gaussians()
    for name in NAMES:
        format = BY_NAME[name]
        path = tmp_path / f"b{format.suffixes[0]}"
        _write(path, before)
        after = read_arrays(path).to_gaussians()
        assert after.metres_per_unit == before.metres_per_unit
        kept = after.antialiased == before.antialiased
        assert kept or "antialiased" in str(format.loses), f"{first} to {name}"
        limits = PRECISION[name]
        line = str(format.loses).replace("all other values", "scales, rotations")
        assert all(WORDS.get(what, "") in line for what in limits), line
        usual = ROUNDING if limits or "rounding" in line else 0.0
        for what, most in differences(before, after).items():
            key = what if what in limits else "other" if what in ("colours", "sh") else what
            allowed = limits.get(key, usual)
            assert most <= allowed, f"{first} to {name}: {what} {most}"


def _write(path, gaussians: Gaussians) -> None:
    path.parent.mkdir(exist_ok=True)
    write_gaussians(path, gaussians)
