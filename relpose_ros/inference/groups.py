"""Which views, or views and points, hang together."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    IntArray = npt.NDArray[np.int64]


def groups(ends: IntArray, others: IntArray, count: int) -> IntArray:
    """Of each of some nodes the number of its group, those of nodes tied to each other.

    Args:
        ends: (T,) one node of each tie.
        others: (T,) the other one.
        count: how many nodes there are.

    Returns:
        (count,), numbers from 0 without gaps.
    """
    from scipy.sparse import coo_matrix
    from scipy.sparse.csgraph import connected_components

    graph = coo_matrix((np.ones(len(ends)), (ends, others)), (count, count))
    return np.asarray(connected_components(graph, directed=False)[1], np.int64)
