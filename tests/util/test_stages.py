"""Stages are done once, and again when anything that they depend on has changed."""

import json

import pytest

from snowsplat.util.errors import UserError
from snowsplat.util.stages import Stages


class _Job:
    """Two stages, the second made from the first; counts what it does."""

    def __init__(self, folder):
        self.folder, self.done, self.reasons = folder, [], []

    def run(self, first="a", second="b"):
        stages = Stages(self.folder / "job.json", ["one", "two"])
        self.done.clear(), self.reasons.clear()
        return [
            self._stage(stages, "one", first, self.folder / "one.txt"),
            self._stage(stages, "two", second, self.folder / "two"),
        ]

    def _stage(self, stages, name, word, out):
        def work():
            return self._work(name, word, out)

        return stages.run(name, {"word": word}, [out], work, self.reasons.append)

    def _work(self, name, word, out):
        self.done.append(name)
        if name == "two":
            out.mkdir(exist_ok=True)
            out = out / "file.txt"
        out.write_text(word)
        return {"word": word}


@pytest.fixture
def job(tmp_path):
    return _Job(tmp_path)


def test_finished_stages_are_not_done_again(job):
    first = job.run()
    assert job.done == ["one", "two"]
    assert not any(outcome.again for outcome in first)
    second = job.run()
    assert job.done == []
    assert all(outcome.again for outcome in second)
    assert [outcome.result for outcome in second] == [{"word": "a"}, {"word": "b"}]
    assert [outcome.seconds for outcome in second] == [outcome.seconds for outcome in first]


def test_a_changed_setting_is_named_and_later_stages_follow(job):
    job.run()
    job.run(first="c")
    assert job.done == ["one", "two"]
    assert job.reasons == ["changed: word"]
    job.run(first="c", second="d")
    assert job.done == ["two"]


@pytest.mark.parametrize("lost", ["one.txt", "two/file.txt"])
def test_missing_files_are_made_again(job, lost):
    job.run()
    (job.folder / lost).unlink()
    job.run()
    assert job.done == (["one", "two"] if lost == "one.txt" else ["two"])
    assert job.reasons == ["files of it are missing"]


def test_a_stage_that_fails_is_not_finished_and_keeps_the_earlier_ones(job):
    job.run()
    work = job._work

    def fail(name, word, out):
        work(name, word, out)
        raise KeyboardInterrupt

    job._work = fail
    with pytest.raises(KeyboardInterrupt):
        job.run(second="d")
    job._work = work
    job.run()  # the old setting: but the files are no longer those of it
    assert job.done == ["two"]


def test_a_damaged_record_is_named(tmp_path):
    for content in ("{", "[]", json.dumps({"stages": {}})):
        (tmp_path / "job.json").write_text(content)
        with pytest.raises(UserError, match=r"job\.json: damaged"):
            Stages(tmp_path / "job.json", ["one"])
