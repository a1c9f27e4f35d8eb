"""JSON with some values replaced by unsuitable ones."""

import copy
from typing import Any

from hypothesis import strategies as st

ODD = [None, True, -1, 0, 1, 7, 2**31, 10**18, 1e308, -0.5, "", "a", "meta.json", [], {}, [0], [[]]]
ODD += [float("nan"), float("inf"), {"a": 1}, [0.0] * 300]

#: The place in the document (as a fraction of all places), and the index of the new value in `ODD`;
#: None removes the element.
changes = st.lists(
    st.tuples(st.floats(0, 0.999), st.one_of(st.none(), st.integers(0, len(ODD) - 1))),
    min_size=1,
    max_size=4,
)


def places(value: Any) -> list[tuple[Any, Any]]:
    """Container and key of every element of ``value``; of lists, only the first four elements."""
    found: list[tuple[Any, Any]] = []
    keys: list[Any] = []
    if isinstance(value, dict):
        keys = list(value)
    elif isinstance(value, list):
        keys = list(range(min(len(value), 4)))
    for key in keys:
        found += [(value, key), *places(value[key])]
    return found


def damaged(document: dict[str, Any], changes: list[tuple[float, int | None]]) -> dict[str, Any]:
    document = copy.deepcopy(document)
    for where, what in changes:
        there = places(document)
        if there:
            container, key = there[int(where * len(there))]
            if what is None:
                del container[key]
            else:
                container[key] = copy.deepcopy(ODD[what])
    return document
