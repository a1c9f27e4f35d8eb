"""Does a small network that predicts depth from one photo generalise?

    python experiments/lift_generalise.py -o OUT

A network of 387,000 weights learns from photos of our ray tracer, whose true depth is known. It
first overfits 4 photos, which shows that the code works. Then it learns from 400 photos, and is
tested on scenes, textures and focal lengths that it has not seen. A second network learns from 400
photos with both texture families and both focal lengths. Scenes and weights are kept in OUT, so an
interrupted run resumes. Results: lift_generalise.json beside this file, and pictures in OUT.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import torch

sys.path.insert(0, str(Path(__file__).with_name("lift_network")))

from measures import measure, priors_of
from network import DepthNet, with_resampling
from pictures import draw_curves, draw_failures

from scenes import FOCAL, OTHER_FOCAL, Shots, make_shots
from snowsplat import ops
from training import Curves, examples, train

RESULTS = Path(__file__).with_suffix(".json")
SEED = 0
OVERFIT_STEPS, STEPS = 300, 700
TRAIN_SCENES, TEST_SCENES = 200, 15


def trained(cache: Path, name: str, sets: Sequence[Shots], steps: int, augment: bool) -> Any:
    """A network, its curves and its processor time, from the cache or trained now."""
    path = cache / f"{name}.pt"
    if not path.exists():
        print(f"training {name}", flush=True)
        start = time.process_time()
        net, curves = train(examples(sets), steps, SEED, augment)
        torch.save(
            {
                "weights": net.state_dict(),
                "curves": asdict(curves),
                "seconds": time.process_time() - start,
            },
            path,
        )
    saved = torch.load(path)
    net = DepthNet(0.0)
    net.load_state_dict(saved["weights"])
    return net.eval(), Curves(**saved["curves"]), saved["seconds"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("-o", "--output", type=Path, required=True)
    out: Path = parser.parse_args().output
    cache = out / "cache"
    torch.set_num_threads(1)
    ops.set_num_threads(1)

    base = make_shots(cache, TRAIN_SCENES, "A", FOCAL, seed=1)
    quarter = TRAIN_SCENES // 4
    mixed = [
        base.first(2 * quarter),
        make_shots(cache, quarter, "B", FOCAL, seed=2),
        make_shots(cache, quarter, "A", OTHER_FOCAL, seed=3),
        make_shots(cache, quarter, "B", OTHER_FOCAL, seed=4),
    ]
    # The same seed: sets with the same textures show the same scenes from the same places.
    tests = {
        "unseen scenes": make_shots(cache, TEST_SCENES, "A", FOCAL, seed=9),
        "other textures": make_shots(cache, TEST_SCENES, "B", FOCAL, seed=9),
        "other focal length": make_shots(cache, TEST_SCENES, "A", OTHER_FOCAL, seed=9),
        "both": make_shots(cache, TEST_SCENES, "B", OTHER_FOCAL, seed=9),
    }
    four = base.first(4)
    nets = {
        "4 photos": trained(cache, "overfit", [four], OVERFIT_STEPS, augment=False),
        "400 photos": trained(cache, "base", [base], STEPS, augment=True),
        "400 mixed photos": trained(cache, "mixed", mixed, STEPS, augment=True),
    }
    results = evaluate(nets, four, base, tests)
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    draw_curves({name: curves for name, (_, curves, _) in nets.items()}, out / "curves.webp")
    draw_failures(nets["400 photos"][0], tests, out)


def evaluate(
    nets: dict[str, tuple[DepthNet, Curves, float]],
    four: Shots,
    base: Shots,
    tests: dict[str, Shots],
) -> dict[str, Any]:
    """All tables: a row per method and set of photos."""
    methods: dict[str, Callable] = dict(priors_of(base))
    methods |= {name: net for name, (net, _, _) in nets.items()}
    overfit, learnt = nets["4 photos"][0], nets["400 photos"][0]
    rows: list[dict[str, Any]] = []

    def add(method: str, photos: str, measured: dict[str, float]) -> None:
        rows.append({"method": method, "photos": photos, **measured})
        print(rows[-1], flush=True)

    add("4 photos", "the same 4", measure(overfit, four))
    add("400 photos", "40 of them", measure(learnt, base.first(40)))
    for name, shots in tests.items():
        for method, predict in methods.items():
            add(method, name, measure(predict, shots))
            if shots.focal != FOCAL:
                corrected = measure(predict, shots, known_focal=True)
                add(f"{method}, focal length known", name, corrected)
        if shots.focal != FOCAL:
            resampled = with_resampling(learnt, shots.focal)
            add("400 photos, resampled to their focal length", name, measure(resampled, shots))
        add("true depth", name, measure(None, shots))
    return {
        "weights": overfit.weights(),
        "seed": SEED,
        "train_photos": len(base),
        "test_photos": len(tests["both"]),
        "steps": {name: len(curves.depth) for name, (_, curves, _) in nets.items()},
        "processor_seconds": {name: round(seconds) for name, (_, _, seconds) in nets.items()},
        "rows": rows,
    }


if __name__ == "__main__":
    main()
