"""Flags and words of gsplat and nerfstudio: an error names what to use here."""

import pytest

from snowsplat.cli import main as cli
from snowsplat.cli.flag_errors import _FLAGS, spellings
from snowsplat.cli.subcommands import SUBCOMMANDS, advice, load_subcommand


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
