"""Damaged files of every kind: a reader raises a one-line error or returns a valid result.

It does so within the limits of `guarded`. SNOWSPLAT_FUZZ=2000 tests 2000 random examples per
reader. Without it there are few examples, the same in each run.
"""

import logging
import os
import random
import warnings

import pytest

from snowsplat.util.errors import UserError

from .damage import damaged, damaged_json, random_change
from .limits import guarded
from .readers import READERS, Reader

EXAMPLES = int(os.environ.get("SNOWSPLAT_FUZZ", "0"))


@pytest.fixture(autouse=True)
def quiet():
    """Hide warnings, for example about skipped points; they are not tested here."""
    logging.disable(logging.WARNING)
    warnings.filterwarnings("ignore", module=r"PIL\.")  # as the command line does
    yield
    logging.disable(logging.NOTSET)


def survives(reader: Reader, data: bytes) -> object:
    size = reader.write(data)
    return guarded(lambda: reader.read(reader.folder), reader.folder, size, reader.memory())


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_damaged(reader):
    valid = reader.valid
    result = survives(reader, valid)  # checks the table and loads libraries
    assert not isinstance(result, UserError) or reader.name == "LPIPS weights", result

    generator = random.Random(None if EXAMPLES else reader.name)
    for _ in range(EXAMPLES or 40):
        changes = [random_change(generator) for _ in range(generator.randint(1, 4))]
        as_json = reader.json and generator.random() < 0.5
        try:
            survives(reader, (damaged_json if as_json else damaged)(valid, changes))
        except BaseException:
            print(f"{as_json = }, {changes = }")
            raise
    reader.write(valid)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_empty_files_and_noise(reader):
    for data in (b"", b"\0", bytes(5000), bytes(range(256)) * 20, b"[" * 5000, b"\n" * 5000):
        survives(reader, data)
    reader.write(reader.valid)
