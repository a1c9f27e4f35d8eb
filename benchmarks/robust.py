"""Writes procedural datasets, without and with something that moves, for `recipes.py`.

    python benchmarks/robust.py out/scenes
    python benchmarks/recipes.py default default:transients=auto --datasets out/scenes \\
        --captures still moving --hold-outs eighth --seeds 5 --out out/moving

    still     the still life of `snowsplat demo`, without lens distortion; exact poses
    moving    the same photos, but a person is in 20% of them, each time at another place. The
              photos that are held out (every 8th) are those of `still`

The points are those of the true surfaces, with an error of about a pixel.
"""

import argparse
import shutil
from collections.abc import Sequence
from pathlib import Path

from passer_by import chosen_photos, passers_by, shooting
from traced import write_traced

from snowsplat.synthetic.photographer import phone_lens, walk
from snowsplat.synthetic.still_life import still_life

COUNT = 48
SIZE = (400, 300)
#: Share of the photos with the person.
SHARE = 0.2


def still_and_moving(out: Path, seed: int) -> None:
    lens = phone_lens(*SIZE, distortion=(0.0, 0.0, 0.0, 0.0))
    poses = walk(COUNT, seed)
    scene = still_life(seed)
    write_traced(out / "still", lambda: scene, lens, poses, seed=seed)
    photos = chosen_photos(COUNT, SHARE, seed)
    passing = passers_by([(i, poses[i]) for i in photos], seed)
    images = out / "moving" / "images"
    images.mkdir(parents=True, exist_ok=True)
    for path in sorted((out / "still" / "images").iterdir()):
        if int(path.stem[-4:]) - 1 not in passing:
            shutil.copyfile(path, images / path.name)
    shoot = shooting(lens, poses, passing)
    write_traced(out / "moving", lambda: scene, lens, poses, seed=seed, shoot=shoot)
    # Points on the surfaces, with the colours of the photos without the person.
    shutil.copytree(out / "still" / "sparse", out / "moving" / "sparse", dirs_exist_ok=True)


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder for the datasets")
    parser.add_argument("--seed", type=int, default=0, help="seed of the scene")
    flags = parser.parse_args(arguments)
    still_and_moving(flags.out, flags.seed)


if __name__ == "__main__":
    main()
