"""The connected components of a graph."""

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.integer[Any]]


def components(links: Sequence[Ints] | Ints, count: int) -> Ints:
    """(count,) the smallest node in the component of each node.

    ``links``: the first nodes of all edges and their second nodes, or the three of all triangles.
    """
    label = np.arange(count, dtype=links[0].dtype)
    while True:
        least = np.minimum.reduce([label[nodes] for nodes in links])
        smaller = label.copy()
        for nodes in links:
            np.minimum.at(smaller, label[nodes], least)
            np.minimum.at(smaller, nodes, least)
        while not np.array_equal(smaller, shorter := smaller[smaller]):
            smaller = shorter
        if np.array_equal(smaller, label):
            return label
        label = smaller
