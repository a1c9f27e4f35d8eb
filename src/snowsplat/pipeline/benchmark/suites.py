"""The protocols of the usual benchmark suites, and the figures published for them."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

_PAPER = (
    "Kerbl et al. 2023, 3D Gaussian Splatting for Real-Time Radiance Field Rendering, tables of "
    "the supplement; 30,000 steps"
)


@dataclass(frozen=True)
class Figures:
    """Published figures; None: not published."""

    psnr: float
    ssim: float | None = None
    lpips: float | None = None


@dataclass(frozen=True)
class Suite:
    """A protocol."""

    title: str  # the name for readers
    protocol: str  # how photos are scaled and held out, in sentences
    # For each scene, the number by which the photos are divided. The official smaller photos (such
    # as images_4) are used if the dataset has them. Scenes that are not listed have their full
    # size.
    resolutions: Mapping[str, int] = field(default_factory=dict)
    # Settings of the training that the protocol fixes.
    settings: Mapping[str, Any] = field(default_factory=dict)
    published: Mapping[str, Figures] = field(default_factory=dict)  # figures of each scene
    source: str = ""  # the source of the published figures


SUITES = {
    "mipnerf360": Suite(
        "Mip-NeRF 360",
        "Outdoor scenes at a quarter, indoor scenes at half of the size of the photos, with the "
        "official smaller photos if they are there. Every 8th photo is a test photo.",
        resolutions={
            **dict.fromkeys(("bicycle", "flowers", "garden", "stump", "treehill"), 4),
            **dict.fromkeys(("room", "counter", "kitchen", "bonsai"), 2),
        },
        published={
            "bicycle": Figures(25.246, 0.771, 0.205),
            "flowers": Figures(21.520, 0.605, 0.336),
            "garden": Figures(27.410, 0.868, 0.103),
            "stump": Figures(26.550, 0.775, 0.210),
            "treehill": Figures(22.490, 0.638, 0.317),
            "room": Figures(30.632, 0.914, 0.220),
            "counter": Figures(28.700, 0.905, 0.204),
            "kitchen": Figures(30.317, 0.922, 0.129),
            "bonsai": Figures(31.980, 0.938, 0.205),
        },
        source=_PAPER,
    ),
    "tandt": Suite(
        "Tanks and Temples",
        "The two scenes truck and train, as distributed with the paper, at their full size. Every "
        "8th photo is a test photo.",
        published={"truck": Figures(25.187, 0.879, 0.148), "train": Figures(21.097, 0.802, 0.218)},
        source=_PAPER,
    ),
    "db": Suite(
        "Deep Blending",
        "The two scenes drjohnson and playroom, as distributed with the paper, at their full size. "
        "Every 8th photo is a test photo.",
        published={
            "drjohnson": Figures(28.766, 0.899, 0.244),
            "playroom": Figures(30.044, 0.906, 0.241),
        },
        source=_PAPER,
    ),
    "blender": Suite(
        "Blender (NeRF synthetic)",
        "Images of 800×800 before a white background; the test set is that of the dataset "
        "(transforms_test.json).",
        settings={"background": "white"},
        published={
            "mic": Figures(35.36),
            "chair": Figures(35.83),
            "ship": Figures(30.80),
            "materials": Figures(30.00),
            "lego": Figures(35.78),
            "drums": Figures(26.15),
            "ficus": Figures(34.87),
            "hotdog": Figures(37.72),
        },
        source=_PAPER,
    ),
    "custom": Suite(
        "Own scenes", "Every 8th photo is a test photo, unless the dataset has a split of its own."
    ),
}


def suite_of(scenes: Iterable[str]) -> str:
    """The name of the suite to which all scenes belong; "custom" if there is none."""
    names = set(scenes)
    for name, suite in SUITES.items():
        if names and names <= {*suite.published, *suite.resolutions}:
            return name
    return "custom"
