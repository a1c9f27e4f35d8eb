"""Figures of the page "The reference": the images of its example, from the code of the page."""

import re

import numpy as np
from drawing import FOLDER, Drawing

import scene


def main() -> None:
    page = (FOLDER.parent / "reference.md").read_text(encoding="utf-8")
    blocks = re.findall(r"^```python\n(.*?)^```", page, re.MULTILINE | re.DOTALL)
    names: dict = {}
    for block in blocks[:5]:
        exec(block, names)
    alpha, depth = names["alpha"].numpy(), names["depth"].numpy()
    expected = np.where(alpha > 0.02, depth / np.maximum(alpha, 0.02), np.nan)
    shade = np.nan_to_num((expected - 2.9) / 1.3, nan=1.0)
    for name, words, image in (
        ("image", "image", scene.pixels(names["image"])),
        ("alpha", "opacity", np.rint(255 * alpha).astype(np.uint8)[..., None].repeat(3, axis=2)),
        (
            "depth",
            "depth 2.9 to 4.2",
            np.rint(255 * shade.clip(0, 1)).astype(np.uint8)[..., None].repeat(3, axis=2),
        ),
    ):
        panel = Drawing(222, 209, margins=(0, 24, 0, 0))
        panel.title(words)
        panel.picture(image, (0, 0), (1, 1), pixelated=True)
        panel.rectangle((0, 0), (1, 1), "line")
        panel.save(f"reference-{name}", f"Three Gaussians: {words}")


if __name__ == "__main__":
    main()
