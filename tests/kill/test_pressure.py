"""Full and read-only disks, removed folders, limits, narrow terminals: one-line errors, no loss."""

import json
import re
import shutil
import subprocess
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from snowsplat.training.core import checkpoint

from .harness import Ended, check_whole, digest, leftovers, names_in

CPU = ("--device", "cpu", "--threads", 1)


@pytest.fixture(scope="module")
def trained(runner, dataset, tmp_path_factory) -> Path:
    """A training run with checkpoints of steps 20 and 30; read-only for the tests."""
    out = tmp_path_factory.mktemp("of_pressure") / "trained"
    ended = runner.run(
        ["train", dataset, "-o", out, "--iterations", 30, "--checkpoint-every", 10, "--eval", *CPU]
    )
    assert ended.code == 0, ended.text
    return out


@pytest.fixture
def place(runner, tmp_path) -> Iterator[Path]:
    """The output folder; checks that nothing remains in the folder for temporary files."""
    folder = tmp_path / "place"
    folder.mkdir()
    yield folder
    assert not leftovers(runner.temporary)


@contextmanager
def mounted(folder: Path, *options: str) -> Iterator[None]:
    """Mount a file system over ``folder``; the test is skipped without permission."""
    done = subprocess.run(["mount", *options, folder], capture_output=True, text=True)
    if done.returncode:
        pytest.skip(f"needs the right to mount: {done.stderr.strip()}")
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", folder], check=True)


@contextmanager
def read_only(folder: Path) -> Iterator[None]:
    """A read-only file system, also for root."""
    with mounted(folder, "--bind", str(folder)):
        subprocess.run(["mount", "-o", "remount,ro,bind", folder], check=True)
        yield


@contextmanager
def full(folder: Path, kilobytes: int) -> Iterator[None]:
    """A file system of this size."""
    with mounted(folder, "-t", "tmpfs", "-o", f"size={kilobytes}k", "none"):
        yield


def fill(folder: Path) -> None:
    with suppress(OSError), open(folder / "filler", "wb", buffering=0) as filler:
        while filler.write(bytes(4096)):
            pass


def refused(ended: Ended, pattern: str) -> None:
    """Check that the command printed one line on stderr and ended with the code of a user error."""
    assert ended.code == 2, ended.text
    lines = [line for line in ended.text.splitlines() if line.startswith("snowsplat: ")]
    assert len(lines) == 1, ended.text
    assert ended.text.splitlines()[-1] == lines[0]
    assert re.search(pattern, lines[0]), lines[0]


def commands(place: Path, trained: Path, dataset: Path, photos: Path) -> dict[str, list[object]]:
    """One command per subcommand, writing below ``place``; ``place``/trained is a training run."""
    output = place / "trained"
    return {
        "convert": ["convert", trained, place / "a.html"],
        "train": ["train", dataset, "-o", place / "t", "--iterations", 9, *CPU],
        "resume": ["train", "-o", output, "--resume", "--iterations", 60, *CPU],
        "render": ["render", output, *CPU],
        "video": ["render", output, "--path", "ellipse", "--seconds", 0.2, *CPU],
        "evaluate": ["evaluate", output, *CPU],
        "sfm": ["sfm", photos, "-o", place / "c", "--quality", "draft", "--threads", 1],
        "make": ["make", photos, "-o", place / "m", "--quality", "draft", *CPU],
    }


SUBCOMMANDS = ["convert", "train", "resume", "render", "video", "evaluate", "sfm", "make"]


# Disks


@pytest.mark.parametrize("subcommand", SUBCOMMANDS)
def test_a_read_only_folder(subcommand, runner, place, trained, dataset, photos):
    shutil.copytree(trained, place / "trained")
    before = {name: digest(place / name) for name in names_in(place)}
    with read_only(place):
        ended = runner.run(commands(place, trained, dataset, photos)[subcommand])
    if subcommand == "evaluate":  # the figures are printed
        assert (ended.code, "metrics.json was not written" in ended.text) == (0, True)
    else:
        refused(ended, rf"{place}\S*: Read-only file system")
    assert {name: digest(place / name) for name in names_in(place)} == before


@pytest.mark.parametrize("subcommand", SUBCOMMANDS)
def test_a_full_disk(subcommand, runner, place, trained, dataset, photos):
    # There is hardly more space than the existing files need.
    used = sum((trained / name).stat().st_size // 4096 + 1 for name in names_in(trained)) * 4
    with full(place, used + 60 + 4 * len(names_in(trained))):
        shutil.copytree(trained, place / "trained")
        fill(place)
        before = {name: digest(place / name) for name in names_in(place)}
        ended = runner.run(commands(place, trained, dataset, photos)[subcommand])
        if subcommand == "evaluate":
            assert (ended.code, "metrics.json was not written" in ended.text) == (0, True)
        else:
            refused(ended, r"No space left on device|the disk is full|the disk has 0")
        assert not leftovers(place)
        after = {name: digest(place / name) for name in names_in(place)}
        changed = {name for name in before if after.get(name) != before[name]}
        assert not changed, f"{subcommand} changed {changed}"


def test_a_full_disk_keeps_the_old_site(runner, place, trained):
    site = place / "site"
    with full(place, 8000):
        assert runner.run(["publish", trained, "-o", site]).code == 0
        fill(place)
        before = {name: digest(place / name) for name in names_in(place)}
        refused(
            runner.run(["publish", trained, "-o", site, "--overwrite", "--title", "New"]),
            rf"{site}\S*: No space left on device",
        )
        assert not leftovers(place)
        assert {name: digest(place / name) for name in names_in(place)} == before


def test_a_disk_that_becomes_full_during_training(runner, place, dataset):
    """The last checkpoint stays valid. With free space, the resumed run produces the same scene."""
    out = place / "out"
    command = ["train", dataset, "-o", out, "--iterations", 60, "--checkpoint-every", 10, *CPU]
    assert runner.run(command).code == 0
    scene = out / "point_cloud/iteration_60/point_cloud.ply"
    whole = digest(scene)
    size = max(path.stat().st_size for path in out.glob("checkpoints/*"))
    shutil.rmtree(out)
    # Space for two and a half checkpoints and the other files.
    with full(place, 32 + int(2.5 * size) // 1024):
        refused(runner.run(command), rf"{out}/checkpoints/step_\S+: No space left on device")
        check_whole(place)
        newest = checkpoint.latest(out / "checkpoints")
        assert newest is not None
        assert not leftovers(place)
        subprocess.run(["mount", "-o", "remount,size=10m", place], check=True)
        again = runner.run([*command, "--resume"])
        assert again.code == 0, again.text
        assert f"step {newest.step} of 60" in again.text
        assert digest(scene) == whole


def test_a_disk_too_full_for_the_first_scene(runner, place, dataset):
    """The training run has no result, so nothing is kept, and the same command starts again."""
    out = place / "out"
    command = ["train", dataset, "-o", out, "--iterations", 20, "--save-iterations", 10, *CPU]
    with full(place, 90):
        refused(runner.run(command), rf"{out}/point_cloud/\S+: No space left on device")
        assert not out.exists()
        subprocess.run(["mount", "-o", "remount,size=10m", place], check=True)
        again = runner.run(command)
        assert again.code == 0, again.text


def test_a_disk_that_becomes_full_during_sfm(runner, place, photos):
    """Finished stages are kept; with free space the same command resumes."""
    out = place / "garden"
    command = ["sfm", photos, "-o", out, "--quality", "draft", "--threads", 1]
    with full(place, 700):
        refused(
            runner.run(command), rf"{out}: the disk is full; free some space, then run the same"
        )
        assert list(json.loads((out / "sfm.json").read_text())["stages"]) == ["photos"]
        subprocess.run(["mount", "-o", "remount,size=50m", place], check=True)
        again = runner.run(command)
        assert again.code == 0, again.text
        assert again.text.count("done before") == 1
        assert not leftovers(place)


# Removed folders


def when(condition: Callable[[], bool], then: Callable[[], object]) -> Callable[[int], None]:
    """For `Zygote.run`: call a function as soon as a condition is true."""

    def wait(pid: int) -> None:
        while not condition():
            if not Path(f"/proc/{pid}").exists():
                return
            time.sleep(0.001)
        then()

    return wait


def has_checkpoint(out: Path) -> Callable[[], bool]:
    return lambda: any(out.glob("checkpoints/step_*"))


def test_a_training_run_whose_folder_is_moved_continues(runner, place, dataset):
    """The training run creates a new folder, so that hours of work are not lost."""
    out, elsewhere = place / "out", place / "elsewhere"
    command = ["train", dataset, "-o", out, "--iterations", 400, "--checkpoint-every", 10, "--eval"]
    ended = runner.run(
        [*command, *CPU],
        while_it_runs=when(has_checkpoint(out), lambda: out.rename(elsewhere)),
    )
    assert ended.code == 0, ended.text
    assert ended.text.count("snowsplat: ") == 1
    assert f"snowsplat: warning: {out}: was removed; it is created again" in ended.text
    check_whole(place)
    assert not leftovers(place)
    assert checkpoint.latest(elsewhere / "checkpoints") is not None
    assert (out / "point_cloud/iteration_400/point_cloud.ply").is_file()
    assert runner.run(["evaluate", out, *CPU]).code == 0


def test_a_training_run_whose_photos_are_removed(runner, place, dataset):
    """The photos are removed at the start or before the run resumes. Saved files are kept."""
    mine, out = place / "dataset", place / "out"
    shutil.copytree(dataset, mine)
    command = ["train", mine, "-o", out, "--iterations", 40, "--checkpoint-every", 10, *CPU]
    assert runner.run(command).code == 0
    before = {name: digest(out / name) for name in names_in(out)}
    (mine / "images").rename(place / "moved")
    ended = runner.run(["train", "-o", out, "--resume", "--iterations", 60, *CPU])
    refused(ended, rf"{mine}/images")
    assert {name: digest(out / name) for name in names_in(out)} == before

    (place / "moved").rename(mine / "images")
    begun = (place / "two" / "config.json").exists
    ended = runner.run(
        ["train", mine, "-o", place / "two", "--iterations", 40, *CPU],
        while_it_runs=when(begun, lambda: shutil.rmtree(mine / "images")),
    )
    if ended.code:  # else all photos had been read
        refused(ended, rf"{mine}/images/\S+")
    assert not leftovers(place)


@pytest.mark.parametrize("subcommand", [pytest.param("sfm", marks=pytest.mark.nightly), "make"])
def test_photos_or_the_folder_are_removed_during_sfm(subcommand, runner, place, photos):
    mine, out = place / "photos", place / "out"
    shutil.copytree(photos, mine)
    command = [subcommand, mine, "-o", out, "--quality", "draft", "--threads", 1]
    inner = out / "dataset" if subcommand == "make" else out
    begun = (inner / "distorted" / "database.db").exists
    # The photos have been copied already, so it may succeed.
    ended = runner.run(command, while_it_runs=when(begun, lambda: shutil.rmtree(inner / "input")))
    refused(ended, r"input|images")
    shutil.rmtree(out, ignore_errors=True)
    ended = runner.run(command, while_it_runs=when(begun, lambda: out.rename(place / "moved")))
    refused(ended, rf"{out}\S*: No such file or directory")
    check_whole(place / "moved")


# Limits


@pytest.mark.parametrize("subcommand", ["convert", "train", "resume", "render", "video", "sfm"])
def test_a_limit_of_the_size_of_files(subcommand, runner, place, trained, dataset, photos):
    shutil.copytree(trained, place / "trained")
    before = {name: digest(place / name) for name in names_in(place)}
    limit = {"sfm": 50_000, "resume": 5000}.get(subcommand, 500)
    ended = runner.run(
        commands(place, trained, dataset, photos)[subcommand], limits={"RLIMIT_FSIZE": limit}
    )
    refused(ended, r"File too large")
    assert not leftovers(place)
    check_whole(place)
    kept = {name for name in before if name not in ("trained/config.json", "trained/cfg_args")}
    assert all(digest(place / name) == before[name] for name in kept)


@pytest.mark.parametrize("subcommand", SUBCOMMANDS)
def test_a_limit_of_open_files(subcommand, runner, place, trained, dataset, photos):
    """The limit is so low that hardly any file can be opened."""
    shutil.copytree(trained, place / "trained")
    before = names_in(place)
    ended = runner.run(
        commands(place, trained, dataset, photos)[subcommand], limits={"RLIMIT_NOFILE": 1}
    )
    refused(ended, r"Too many open files")
    assert not leftovers(place)
    assert names_in(place) >= before
    check_whole(place)


# A terminal of 24 columns


def shown(text: str) -> list[str]:
    """The lines on the screen; longer lines are wrapped."""
    lines = []
    for line in text.split("\n"):
        last = ""
        for part in line.split("\r"):
            part = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", part)
            last = part or last
        lines.append(last)
    return lines


def bars(text: str) -> list[str]:
    """All states of the progress line, which overwrites itself."""
    found = re.findall(r"\r\x1b\[2K([^\r\n]*)(?=\r\x1b)", text)
    return [re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", bar) for bar in found]


def test_a_narrow_terminal(runner, place, trained, dataset, photos):
    all_commands = commands(place, trained, dataset, photos)
    shutil.copytree(trained, place / "trained")
    longer = ["train", dataset, "-o", place / "t", "--iterations", 300, *CPU]
    for command in (longer, all_commands["sfm"], all_commands["video"], all_commands["evaluate"]):
        ended = runner.run(command, columns=24)
        assert ended.code == 0, ended.text
        assert "Traceback" not in ended.text
        for bar in bars(ended.text):
            assert len(bar) <= 24, bar
        if command is longer:
            steps = [re.match(r"(\d+)/300\b", bar) for bar in bars(ended.text)]
            assert steps, ended.text
            assert all(steps), bars(ended.text)  # numbers are not truncated
            assert ended.text.count("\x1b[?25l") == ended.text.count("\x1b[?25h") == 1  # cursor
    ended = runner.run(["train", dataset, "-o", place / "t", *CPU], columns=24)
    assert ended.code == 2
    assert len(shown(ended.text.strip())) == 1
