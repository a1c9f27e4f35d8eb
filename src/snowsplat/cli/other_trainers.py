"""What to use for flags and words of gsplat's `simple_trainer.py` and of nerfstudio.

They are not accepted, because what they do differs in detail: an error names what to use instead.
Those of the reference implementation are accepted, see `reference_flags`; only the name of its
`convert.py` is that of another subcommand here.
"""

from __future__ import annotations

from collections.abc import Collection

from snowsplat.cli.subcommands import SUBCOMMANDS

# The flag to use -> flags of the others, without the group before a dot.
_FLAGS = {
    "-o": "result-dir output-dir output-path experiment-name",
    "-r": "data-factor downscale-factor camera-res-scale-factor",
    "--iterations": "max-steps max-num-iterations steps max-iterations num-iterations",
    "--max-gaussians": "cap-max max-gs-num",
    "--eval": "test-every eval-mode eval-interval train-split-fraction",
    "--test-iterations": "eval-steps steps-per-eval-all-images",
    "--save-iterations": "save-steps ply-steps",
    "--checkpoint-every": "steps-per-save",
    "--resume": "load-dir load-checkpoint",
    "--batch": "batch-size",
    "--refine-poses": "pose-opt camera-optimizer",
    "--exposure": "app-opt use-bilateral-grid use-bilagrid post-processing",
    "--antialias": "rasterize-mode",
    "--background": "random-bkgd background-color",
    "--init": "init-type random-init",
    "--view": "vis viewer",
    "--ssim-weight": "ssim-lambda",
    "--grad-threshold": "grow-grad2d densify-grad-thresh",
    "--abs-grad": "absgrad use-absgrad",
    "--densify-from": "refine-start-iter warmup-length",
    "--densify-until": "refine-stop-iter stop-split-at",
    "--densify-interval": "refine-every",
    "--opacity-reset-interval": "reset-every reset-alpha-every",
    "--log": "tb-every tensorboard",
    "--processes": "num-devices",
    "--lr-means": "means-lr",
    "--lr-log-scales": "scales-lr",
    "--lr-quats": "quats-lr",
    "--lr-opacity-logits": "opacities-lr",
    "--lr-sh-dc": "sh0-lr",
    "--lr-sh-rest": "shN-lr",
}
_INPUTS = ["data", "data-dir", "ckpt", "load-config", "input"]


def advice(subcommand: str, name: str, flags: Collection[str]) -> str | None:
    """What to use for an unknown flag of a subcommand; None if it is not known.

    Args:
        name: the flag with "-" for "_", such as "--strategy.refine-every".
        flags: those that the subcommand has.
    """
    *groups, word = name.removeprefix("--").split(".")
    if word in _INPUTS and subcommand in SUBCOMMANDS:
        return f"use no flag: snowsplat {subcommand} {SUBCOMMANDS[subcommand].usage}"
    if (subcommand, name) in (("convert", "-s"), ("convert", "--source-path")):
        return "convert.py is snowsplat sfm -s DATASET"
    if groups and f"--{word}" in flags:
        return f"use --{word}"
    if word == "stop-overfitting":
        return "leave it out; it was removed, because the default recipe does not overfit"
    if word in ("save-ply", "disable-video"):
        return "leave it out; train writes the scene as PLY, and render writes videos"
    of_word = {w: new for new, words in _FLAGS.items() for w in words.split()}
    new = next((of_word[w] for w in (word, *groups[::-1]) if w in of_word), None)
    return f"use {new}" if new in flags else None
