"""How many wrong cameras the judge finds, and how many right ones it doubts.

    python benchmarks/corrupted_poses.py DATASET ... [--count 300] [--out TABLE.md]

Each dataset is judged as it is, at scales of 10^-3 to 10^3, turned as a whole, and with random
corruptions of its cameras. No training. The table says for each kind how many are impossible (a
training refuses them), doubtful (it warns), or missed; "named" counts those whose finding names the
corruption. A rotation of poses and points together is no corruption, nor are units without points.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections import Counter
from collections.abc import Callable
from itertools import permutations, product
from pathlib import Path

import numpy as np
import torch

from snowsplat.data import Dataset, Points, View, load_dataset
from snowsplat.data.judge.rig import Rig
from snowsplat.data.judge.verdict import judge
from snowsplat.scene.geometry import quat_from_rotation, rotation_from_quat

_Random = np.random.Generator
_OPENGL = np.diag([1.0, -1.0, -1.0])


def _axes(sign: int) -> list[np.ndarray]:
    """The (3, 3) signed permutations with this determinant, without the identity."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        matrix = np.zeros((3, 3))
        matrix[range(3), order] = signs
        if np.linalg.det(matrix) * sign > 0 and (matrix != np.eye(3)).any():
            found.append(matrix)
    return found


_ROTATIONS, _MIRRORS = _axes(1), _axes(-1)


def _camera_axes(rig: Rig, random: _Random) -> Rig:
    axes = _OPENGL if random.random() < 0.3 else _ROTATIONS[random.integers(23)]
    return rig.moved(axes @ rig.rotation, rig.positions)


def _inverted(rig: Rig, random: _Random) -> Rig:
    before, after = (np.eye(3) if random.random() < 0.5 else _OPENGL for _ in range(2))
    rotation = (before @ rig.rotation).transpose(0, 2, 1)
    turned = rig.moved(before @ rig.rotation, rig.positions)
    return rig.moved(after @ rotation, turned.translation)


def _transposed(rig: Rig, random: _Random) -> Rig:
    rotation = rig.rotation.transpose(0, 2, 1)
    if random.random() < 0.5:
        return rig.moved(rotation, rig.positions)
    return dataclasses.replace(rig, rotation=rotation)


def _swapped_translation(rig: Rig, random: _Random) -> Rig:
    if random.random() < 0.5:
        return rig.moved(rig.rotation, rig.translation)
    return dataclasses.replace(rig, translation=rig.positions)


def _quaternion_order(rig: Rig, random: _Random) -> Rig:
    order = ((3, 0, 1, 2), (1, 2, 3, 0))[random.integers(2)]
    quats = quat_from_rotation(torch.from_numpy(rig.rotation))[:, order]
    return dataclasses.replace(rig, rotation=rotation_from_quat(quats).numpy())


def _mirrored(rig: Rig, random: _Random) -> Rig:
    world = _MIRRORS[random.integers(24)]
    camera = np.diag(np.roll([-1.0, 1.0, 1.0], random.integers(3)))
    return rig.moved(camera @ rig.rotation @ world.T, rig.positions @ world.T)


def _zoomed(rig: Rig, random: _Random) -> Rig:
    factor = 10 ** random.uniform(np.log10(3), 1.2)
    return rig.zoomed(factor if random.random() < 0.5 else 1 / factor)


def _shuffled(rig: Rig, random: _Random) -> Rig:
    count, kind = len(rig), random.integers(3)
    if kind == 0:
        return rig.select(random.permutation(count))
    if kind == 1:
        return rig.select((np.arange(count) + random.integers(1, count)) % count)
    return rig.select(np.arange(count)[::-1])


def _turned_world(rig: Rig, random: _Random) -> Rig:
    world = _ROTATIONS[random.integers(23)]
    return rig.moved(rig.rotation @ world.T, rig.positions @ world.T)


def _units(rig: Rig, random: _Random) -> Rig:
    factor = 10 ** random.uniform(np.log10(2.5), 3)
    return rig.moved(
        rig.rotation, rig.positions * (factor if random.random() < 0.5 else 1 / factor)
    )


#: Kinds of corruption: name, function, what a finding about it may be about.
_KINDS: list[tuple[str, Callable[[Rig, _Random], Rig], tuple[str, ...]]] = [
    ("axes of the cameras", _camera_axes, ("axes",)),
    ("inverted", _inverted, ("direction",)),
    ("transposed", _transposed, ("direction",)),
    ("translation for position", _swapped_translation, ("positions",)),
    ("order of quaternions", _quaternion_order, ("quaternions",)),
    ("handedness", _mirrored, ("axes", "points")),
    ("focal × or ÷ 3 to 16", _zoomed, ("focal length", "field of view")),
    ("shuffled names", _shuffled, ("poses",)),
]
_WITH_POINTS = [
    ("axes of poses against points", _turned_world, ("points", "axes")),
    ("units ×or ÷ 2.5 to 1000", _units, ("units", "points")),
]


def _views(dataset: Dataset) -> list[View]:
    return sorted([*dataset.train, *dataset.test], key=lambda view: view.name)


def _with_rig(dataset: Dataset, rig: Rig, points: Points | None) -> Dataset:
    views = []
    for i, view in enumerate(_views(dataset)):
        camera = view.camera
        pose = np.concatenate([rig.rotation[i], rig.translation[i][:, None]], 1)
        width, height = camera.width, camera.height
        camera = dataclasses.replace(
            camera,
            fx=float(rig.focal[i, 0] * width),
            fy=float(rig.focal[i, 1] * height),
            cx=float(rig.centre[i, 0] * width),
            cy=float(rig.centre[i, 1] * height),
            cam_from_world=torch.from_numpy(pose),
        )
        views.append(dataclasses.replace(view, camera=camera))
    return dataclasses.replace(dataset, train=views, test=[], points=points)


def _right(dataset: Dataset, random: _Random) -> list[tuple[str, Dataset]]:
    """The dataset in other frames and units: as right as it was."""
    rig, points = Rig.of([view.camera for view in _views(dataset)]), dataset.points
    found = [("unchanged", dataset)]
    for scale in 10.0 ** np.arange(-3, 4):
        matrix = scale * np.linalg.qr(random.normal(size=(3, 3)))[0]
        matrix *= np.sign(np.linalg.det(matrix))
        moved = rig.moved(rig.rotation @ (matrix / scale).T, rig.positions @ matrix.T)
        xyz = None if points is None else points.xyz.double().numpy() @ matrix.T
        other = (
            None
            if points is None or xyz is None
            else dataclasses.replace(points, xyz=torch.from_numpy(xyz).float())
        )
        found.append((f"turned, scaled by {scale:g}", _with_rig(dataset, moved, other)))
    return found


def main() -> None:
    """Judge all of them, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("datasets", nargs="+", type=Path)
    parser.add_argument("--count", type=int, default=300, help="corruptions, of all datasets")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, help="also write the table here")
    args = parser.parse_args()
    random = np.random.default_rng(args.seed)
    results: Counter[tuple[str, str, str]] = Counter()
    seconds: list[float] = []

    def record(name: str, kind: str, dataset: Dataset, about: tuple[str, ...]) -> None:
        started = time.monotonic()
        findings = judge(dataset)
        seconds.append(time.monotonic() - started)
        verdict = "impossible" if any(f.impossible for f in findings) else "doubtful"
        results[name, kind, verdict if findings else "missed"] += 1
        results[name, kind, "named"] += any(f.about in about for f in findings)
        print(f"{name}: {kind}: {'; '.join(f.text for f in findings) or 'nothing'}", flush=True)

    for number, path in enumerate(args.datasets):
        dataset, name = load_dataset(path), path.name
        rig = Rig.of([view.camera for view in _views(dataset)])
        for _, right in _right(dataset, random):
            record(name, "right", right, ())
        kinds = _KINDS + (_WITH_POINTS if dataset.points is not None else [])
        for i in range(number, args.count, len(args.datasets)):
            kind, corrupt, about = kinds[i // len(args.datasets) % len(kinds)]
            record(name, kind, _with_rig(dataset, corrupt(rig, random), dataset.points), about)
    table = _table(results, seconds)
    print("\n" + table)
    if args.out is not None:
        args.out.write_text(table, encoding="utf-8")


def _table(results: Counter[tuple[str, str, str]], seconds: list[float]) -> str:
    lines = [
        "| dataset | cameras | impossible | doubtful | no finding | named |",
        "|---|---|--:|--:|--:|--:|",
    ]
    for name, kind in dict.fromkeys((name, kind) for name, kind, _ in results):
        cells = [
            results[name, kind, verdict]
            for verdict in ("impossible", "doubtful", "missed", "named")
        ]
        lines.append(f"| {name} | {kind} | {' | '.join(map(str, cells))} |")
    wrong = {key: n for key, n in results.items() if key[1] != "right" and key[2] != "named"}
    missed = sum(n for key, n in wrong.items() if key[2] == "missed")
    alarms = sum(
        n
        for key, n in results.items()
        if key[1] == "right" and key[2] in ("impossible", "doubtful")
    )
    total = sum(wrong.values())
    lines.append(
        f"\n{total - missed} of {total} corruptions found; {alarms} false alarms; "
        f"{np.median(seconds):.2f} s a dataset in the median"
    )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
