"""Stages are executed once, and repeated if anything that they depend on has changed."""

import json

import pytest

from snowsplat.util.errors import UserError
from snowsplat.util.stages import Stages


class _Job:
    """A job of two stages, of which the second depends on the first; lists what it executes."""

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


def test_finished_stages_are_not_repeated(job):
    first = job.run()
    assert job.done == ["one", "two"]
    assert not any(outcome.again for outcome in first)
    second = job.run()
    assert job.done == []
    assert all(outcome.again for outcome in second)
    assert [outcome.result for outcome in second] == [{"word": "a"}, {"word": "b"}]
    assert [outcome.seconds for outcome in second] == [outcome.seconds for outcome in first]


def test_a_changed_setting_is_reported_and_later_stages_are_repeated(job):
    job.run()
    job.run(first="c")
    assert job.done == ["one", "two"]
    assert job.reasons == ["changed: word"]
    job.run(first="c", second="d")
    assert job.done == ["two"]


@pytest.mark.parametrize("lost", ["one.txt", "two/file.txt"])
def test_missing_files_are_written_again(job, lost):
    job.run()
    (job.folder / lost).unlink()
    job.run()
    assert job.done == (["one", "two"] if lost == "one.txt" else ["two"])
    assert job.reasons == ["its files are missing"]


def test_a_failed_stage_is_not_finished_and_earlier_ones_stay_finished(job):
    job.run()
    work = job._work

    def fail(name, word, out):
        work(name, word, out)
        raise KeyboardInterrupt

    job._work = fail
    with pytest.raises(KeyboardInterrupt):
        job.run(second="d")
    job._work = work
    job.run()  # the setting is the old one again, but the files are not
    assert job.done == ["two"]


def test_a_damaged_record_is_reported(tmp_path):
    for content in ("{", "[]", json.dumps({"stages": {}})):
        (tmp_path / "job.json").write_text(content)
        with pytest.raises(UserError, match=r"job\.json: damaged"):
            Stages(tmp_path / "job.json", ["one"])
