"""Damaged files of every kind: a reader raises a one-line error or returns a valid result.

It does so within the limits of `guarded`. SNOWSPLAT_FUZZ=2000 tests 2000 random examples per
reader. Without it there are few examples, the same in each run.
"""

import logging
import os
import warnings

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from snowsplat.util.errors import UserError

from .damage import KINDS, damaged, damaged_json
from .limits import guarded
from .readers import READERS, Reader

EXAMPLES = int(os.environ.get("SNOWSPLAT_FUZZ", "0"))
FUZZ = settings(
    max_examples=EXAMPLES or 30,
    derandomize=not EXAMPLES,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)
change = st.tuples(
    st.sampled_from(KINDS),
    st.booleans(),
    st.floats(0, 1),
    st.integers(0, 255),
    st.integers(0, 255),
)


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

    @pytest.mark.filterwarnings("ignore")
    @FUZZ
    @given(changes=st.lists(change, min_size=1, max_size=4), as_json=st.booleans())
    def attempt(changes, as_json):
        break_it = damaged_json if reader.json and as_json else damaged
        survives(reader, break_it(valid, changes))

    attempt()
    reader.write(valid)


@pytest.mark.parametrize("reader", READERS, ids=lambda reader: reader.name)
def test_empty_files_and_noise(reader):
    for data in (b"", b"\0", bytes(5000), bytes(range(256)) * 20, b"[" * 5000, b"\n" * 5000):
        survives(reader, data)
    reader.write(reader.valid)
