"""Each flag of the programs of the reference implementation: done, without effect, or refused."""

import re

import pytest

from snowsplat.cli import main as cli
from snowsplat.cli.flag_errors import _FLAGS, spellings
from snowsplat.cli.reference_flags import programs
from snowsplat.cli.subcommands import SUBCOMMANDS, advice, load_subcommand

# The command lines of the programs, from their documentation: a value where a flag takes one.
LINES = {
    "train": """
        --source_path garden|-s garden  --model_path out|-m out  --images images_4|-i images_4
        --depths depths|-d depths  --resolution 2|-r 2|-r -1  --white_background|-w
        --train_test_exp  --data_device cpu|--data_device=cuda  --eval  --sh_degree 2
        --convert_SHs_python  --compute_cov3D_python  --debug  --antialiasing
        --iterations 70  --position_lr_init 0.00016  --position_lr_final 1.6e-06
        --position_lr_delay_mult 0.01  --position_lr_max_steps 30000  --feature_lr 0.0025
        --opacity_lr 0.05  --scaling_lr 0.005  --rotation_lr 0.001  --exposure_lr_init 0.01
        --exposure_lr_final 0.001  --exposure_lr_delay_steps 0  --exposure_lr_delay_mult 0.0
        --percent_dense 0.01  --lambda_dssim 0.2  --densification_interval 100
        --opacity_reset_interval 3000  --densify_from_iter 500  --densify_until_iter 15000
        --densify_grad_threshold 0.0002  --depth_l1_weight_init 1.0
        --depth_l1_weight_final 0.01  --random_background  --optimizer_type sparse_adam
        --ip 127.0.0.1  --port 6009  --debug_from -1  --detect_anomaly
        --test_iterations 7000 30000|--test_iterations -1  --save_iterations 7000 30000  --quiet
        --disable_viewer  --checkpoint_iterations 7000 30000  --start_checkpoint chkpnt7000.pth
    """,
    "render": """
        --source_path garden|-s garden  --model_path out|-m out  --images images_4|-i images_4
        --depths depths|-d depths  --resolution 2|-r 2  --white_background|-w  --train_test_exp
        --data_device cpu  --eval  --sh_degree 2  --convert_SHs_python  --compute_cov3D_python
        --debug  --antialiasing  --iteration 7000|--iteration -1  --skip_train  --skip_test
        --quiet
    """,
    "evaluate": "--model_paths out|-m out|-m out second|--model_paths out second third",
    "sfm": """
        --no_gpu  --skip_matching  --source_path garden|-s garden  --camera OPENCV
        --colmap_executable colmap  --resize  --magick_executable magick
    """,
}
BASE = {
    "train": ["garden", "-o", "trained"],
    "render": ["out"],
    "evaluate": [],
    "sfm": ["photos", "-o", "garden"],
}
REFUSED = {
    "--depths": "--init",
    "-d": "--init",
    "--train_test_exp": "--exposure",
    "--checkpoint_iterations": "--checkpoint-every",
    "--start_checkpoint": "--resume",
}
CASES = [
    (subcommand, line.split())
    for subcommand, lines in LINES.items()
    for line in re.split(r"\s\s+|\|", lines.strip())
]


def test_the_table_has_every_flag_and_no_other():
    for subcommand, (_, flags) in programs().items():
        listed = [spelling for flag in flags for spelling in flag.spellings]
        assert len(listed) == len(set(listed))
        documented = {words[0].partition("=")[0] for name, words in CASES if name == subcommand}
        assert set(listed) == documented


@pytest.mark.parametrize(("subcommand", "words"), CASES, ids=lambda x: str(x))
def test_a_flag_is_done_or_without_effect_or_refused(subcommand, words, capsys):
    """What remains is a valid command line of the subcommand."""
    name = words[0].partition("=")[0]
    (flag,) = (f for f in programs()[subcommand][1] if name in f.spellings)
    arguments = [subcommand, *BASE[subcommand], *words]
    if flag.outcome == "refused":
        with pytest.raises(cli.UserError, match=rf"^{name}: .*use {REFUSED[name]}"):
            cli.parse(arguments)
        assert REFUSED[name] in spellings(cli.load_subcommand(subcommand))
        return
    parsed = cli.parse(arguments)
    noted = capsys.readouterr().err.splitlines()
    without = cli.parse([subcommand, *BASE[subcommand]])
    if flag.outcome == "ignored" or flag.only_with:
        assert noted == [f"snowsplat: {name} has no effect: {flag.note}"]
        assert parsed == without
    else:
        assert noted == []
        assert parsed != without or words == ["--quiet"]


def parsed(*arguments: str) -> object:
    return cli.parse(arguments)


def test_flags_that_are_replaced():
    train = parsed("train", "garden", "-o", "out", "--random_background", "--antialiasing")
    assert train.options.settings == {"background": "random", "antialias": True}
    assert parsed("render", "out", "--antialiasing").options.antialias is True
    page = parsed("train", "g", "-o", "out", "--view", "--ip=0.0.0.0", "--port", "6009")
    assert (page.address.host, page.address.port) == ("0.0.0.0", 6009)
    evaluate = parsed("evaluate", "-m", "a", "b", "--split", "train")
    assert [str(path) for path in evaluate.model_paths] == ["a", "b"]
    assert evaluate.split == "train"


def test_the_flags_to_use_exist():
    known = {name for sub in SUBCOMMANDS for name in spellings(load_subcommand(sub))}
    assert set(_FLAGS) <= known
    words = [word for words in _FLAGS.values() for word in words.split()]
    assert len(words) == len(set(words))


@pytest.mark.parametrize(
    ("line", "error"),
    [
        (
            "train --data_dir garden --data_factor 4 --result_dir out",
            "--data_dir: use no flag: snowsplat train DATASET -o OUT --eval; "
            "--data_factor: use -r; --result_dir: use -o",
        ),
        (
            "train garden -o out --pipeline.model.sh-degree=2 --strategy.cap_max 9 --sharp 2",
            "--pipeline.model.sh-degree: use --sh-degree; --strategy.cap_max: use --max-gaussians",
        ),
        ("evaluate --load-config c.yml", "--load-config: use no flag: snowsplat evaluate OUT"),
        ("convert -s garden --resize", "-s: convert.py is snowsplat sfm -s DATASET"),
        ("evaluate out --max-steps 4", "--max-steps: unknown flag; leave it out"),  # it has none
        ("make photos --gpu --iterations 9", "--gpu: use --device; --iterations: use --quality"),
        (
            "train mcmc garden -o out",
            "garden: too many names; use --recipe mcmc; snowsplat train DATASET -o OUT --eval",
        ),
    ],
)
def test_an_error_names_what_to_use(line, error):
    with pytest.raises(cli.UserError) as raised:
        cli.parse(line.split())
    assert str(raised.value) == error


@pytest.mark.parametrize(
    ("word", "use"),
    [("ns-process-data", "sfm"), ("convert.py", "sfm"), ("metrics.py", "evaluate")],
)
def test_words_of_other_programs(word, use):
    assert advice(word) == f"use {use}"
