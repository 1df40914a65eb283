"""Matches that a turn of the camera in its place explains: what stands still around an object that moves."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from relpose_ros.geometry import cameras, so3

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.inference.local_features import LocalFeatures

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

TURNS_TRIED = 200
"""Turns of a camera in its place, by two matches each: some twenty where a third of all follow one."""

Directions = tuple["FloatArray", "FloatArray"]
"""Unit vectors (M, 3) of matched features in camera i and in camera j."""


def directions_of(first: LocalFeatures, second: LocalFeatures, matches: IntArray) -> Directions:
    """Of matches (M, 2) of two views."""
    return cameras.directions(first.rays[matches[:, 0]]), cameras.directions(second.rays[matches[:, 1]])


def follows(turn: FloatArray, directions: Directions, reach: float) -> npt.NDArray[np.bool_]:
    """Which matches a turn (..., 3, 3) of the camera in its place explains, to some angle. -> (..., M)."""
    turned = directions[0] @ np.swapaxes(turn, -1, -2)
    return np.asarray(np.linalg.norm(turned - directions[1], axis=-1) < reach)


def commonest_turn(directions: Directions, reach: float) -> FloatArray:
    """The turn of a camera in its place that explains the most matches, found by pairs of them. -> (3, 3)."""
    drawn = np.random.default_rng(0).integers(0, len(directions[0]), (2, TURNS_TRIED))
    frames = []
    for own in directions:
        first, second = own[drawn]
        across = np.cross(first, second)
        across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
        frames.append(np.stack([first, across, np.cross(first, across)], -1))
    turns = frames[1] @ frames[0].transpose(0, 2, 1)
    following = follows(turns, directions, reach)
    of_best = following[following.sum(1).argmax()]
    return so3.project(directions[1][of_best].T @ directions[0][of_best])
