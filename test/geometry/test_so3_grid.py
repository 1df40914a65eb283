"""The rotation grid: sizes, nesting, equal volumes, and HEALPix against its published ring formulas."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.geometry import so3, so3_grid

if TYPE_CHECKING:
    from collections.abc import Callable

LEVELS = (0, 1, 2, 3)


def angles(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A, 3, 3) and (B, 3, 3) -> (A, B) angles in rad, to about 1e-7: one matrix product, for large grids."""
    trace = a.reshape(-1, 9) @ b.reshape(-1, 9).T
    return np.arccos(np.clip((trace - 1) / 2, -1, 1))


@pytest.mark.parametrize("level", LEVELS)
def test_a_level_has_as_many_different_rotations_as_it_says(level: int) -> None:
    cells = so3_grid.grid(level)
    assert cells.shape == (72 * 8**level, 3, 3)
    assert cells @ cells.swapaxes(1, 2) == pytest.approx(np.broadcast_to(np.eye(3), cells.shape), abs=1e-12)
    assert np.linalg.det(cells) == pytest.approx(1)
    sample = cells[:: max(1, len(cells) // 300)]
    closest = np.partition(angles(sample, cells), 1, axis=1)
    assert closest[:, 0] == pytest.approx(0, abs=1e-6)
    assert closest[:, 1].min() > 0.3 * so3_grid.cell_spacing(level)


@pytest.mark.parametrize("level", LEVELS)
def test_every_rotation_is_near_a_cell(level: int) -> None:
    drawn = so3.random_rotations(200, np.random.default_rng(level))
    nearest = angles(drawn, so3_grid.grid(level)).min(1)
    assert nearest.max() < 0.85 * so3_grid.cell_spacing(level)


@pytest.mark.parametrize("level", LEVELS)
def test_children_lie_around_their_parent(level: int) -> None:
    parents = so3_grid.grid(level)
    offspring = so3_grid.grid(level + 1).reshape(len(parents), 8, 3, 3)
    distance = so3.angle_between(offspring, parents[:, None])
    assert distance.max() < 0.75 * so3_grid.cell_spacing(level)
    centred = so3.angle_between(so3.project(offspring.sum(1)), parents)
    assert centred.max() < 0.2 * so3_grid.cell_spacing(level)
    assert (so3_grid.children([5, 2]) // 8).tolist() == [5] * 8 + [2] * 8
    assert so3_grid.children([[5, 2], [0, 1]])[1].tolist() == list(range(16))


def test_cells_have_equal_volumes() -> None:
    """Descendants fill a cell evenly: by nearest descendant, random rotations fall evenly on all cells."""
    drawn = so3.random_rotations(6000, np.random.default_rng(1))
    fine = so3_grid.grid(2)
    nearest = np.concatenate([np.argmin(angles(part, fine), 1) for part in np.split(drawn, 6)])
    counts = np.bincount(nearest // 64, minlength=72)
    expected = len(drawn) / 72
    assert ((counts - expected) ** 2 / expected).sum() < 120  # chi squared, 71 degrees of freedom


@pytest.mark.parametrize("level", LEVELS)
def test_first_axes_are_the_healpix_centres_of_the_ring_formulas(level: int) -> None:
    """Gorski et al. 2005, equations 2 to 9: rings of equal height, which a nested order must visit too."""
    side = 2**level
    rings = []
    for ring in range(1, 4 * side):
        from_pole = min(ring, 4 * side - ring)
        if from_pole < side:
            height, count, offset = 1 - from_pole**2 / (3 * side**2), 4 * from_pole, 0.5
        else:
            height, count, offset = (
                4 / 3 - 2 * from_pole / (3 * side),
                4 * side,
                0.5 * ((ring - side + 1) % 2),
            )
        azimuth = (np.arange(count) + offset) * 2 * np.pi / count
        height = height if ring <= 2 * side else -height
        radius = np.sqrt(1 - height**2)
        rings.append(
            np.stack([radius * np.cos(azimuth), radius * np.sin(azimuth), np.full(count, height)], -1)
        )
    expected = np.concatenate(rings)
    axes = so3_grid.grid(level)[:, :, 2]
    assert len(expected) * 6 * side == len(axes)
    assert ((expected @ axes.T > 1 - 1e-12).sum(1) == 6 * side).all()


def test_single_cells_are_those_of_the_whole_level() -> None:
    cells = np.array([0, 71, 72 * 8 - 1, 300])
    assert np.array_equal(so3_grid.cell_rotations(1, cells), so3_grid.grid(1)[cells])
    level = so3_grid.LAST_TABULATED + 1  # up to that one they are looked up in the whole level
    cells = np.array([[0, 71], [72 * 8**level - 1, 300]])
    assert np.array_equal(so3_grid.cell_rotations(level, cells), so3_grid.grid(level)[cells])
    assert so3_grid.cell_rotations(6, [72 * 8**6 - 1]).shape == (1, 3, 3)


@pytest.mark.parametrize("level", [0, 1, 2, 3])
def test_every_centre_lies_in_its_own_cell(level: int) -> None:
    cells = np.arange(so3_grid.size(level))
    assert np.array_equal(cells_at(level, so3_grid.grid(level)), cells)


@given(level=st.integers(0, so3_grid.MAX_LEVEL), share=st.floats(0, 1, exclude_max=True))
def test_cell_rotations_are_undone_at_all_levels(level: int, share: float) -> None:
    cell = int(share * so3_grid.size(level))
    assert cells_at(level, so3_grid.cell_rotations(level, [cell])).tolist() == [cell]


def cells_at(level: int, rotations: np.ndarray) -> np.ndarray:
    return so3_grid.cells_at(level, torch.from_numpy(np.array(rotations))).numpy()


def at_poles_and_edges() -> np.ndarray:
    """Rotations that take the z axis to a pole, or beside one, and to where diamonds meet. -> (K, 3, 3)."""
    azimuths = np.arange(16) * np.pi / 8
    heights = np.array([1, 1 - 1e-15, 1 - 1e-9, 1 - 1e-4, 2 / 3, 1 / 3, 0.0])
    azimuth, height, turn = np.meshgrid(azimuths, np.r_[heights, -heights], [-np.pi, -1.0, 0.0, 2.0])
    polar = np.arccos(height)
    about_z, about_y = np.zeros((2, *azimuth.shape, 3))
    spin = np.zeros_like(about_z)
    about_z[..., 2], about_y[..., 1], spin[..., 2] = azimuth, polar, turn
    return (so3.exp(about_z) @ so3.exp(about_y) @ so3.exp(spin)).reshape(-1, 3, 3)


def anywhere() -> np.ndarray:
    return so3.random_rotations(3000, np.random.default_rng(5))


@pytest.mark.parametrize("level", LEVELS)
@pytest.mark.parametrize("rotations", [anywhere, at_poles_and_edges], ids=["anywhere", "poles and edges"])
def test_a_rotation_lies_near_the_centre_of_its_cell(level: int, rotations: Callable[[], np.ndarray]) -> None:
    drawn = rotations()
    cells = cells_at(level, drawn)
    distance = so3.angle_between(so3_grid.cell_rotations(level, cells), drawn)
    # A corner is twice as far from the centre as the children's centres are.
    assert distance.max() < 1.5 * so3_grid.cell_spacing(level)


@pytest.mark.parametrize("level", LEVELS)
def test_cells_of_rotations_nest(level: int) -> None:
    drawn = anywhere().reshape(60, 50, 3, 3)
    assert np.array_equal(cells_at(level + 1, drawn) // 8, cells_at(level, drawn))


def test_random_rotations_fall_evenly_on_all_cells() -> None:
    counts = np.bincount(cells_at(1, so3.random_rotations(60_000, np.random.default_rng(2))))
    expected = 60_000 / so3_grid.size(1)
    assert ((counts - expected) ** 2 / expected).sum() < 700  # chi squared, 575 degrees of freedom


def test_the_shared_grid_cannot_be_written() -> None:
    with pytest.raises(ValueError, match="read-only"):
        so3_grid.grid(0)[0] = 0


@pytest.mark.parametrize("level", [-1, 9])
def test_there_are_no_other_levels(level: int) -> None:
    with pytest.raises(ValueError, match=f"there is no level {level}"):
        so3_grid.grid(level)


@pytest.mark.parametrize("cell", [-1, 72])
def test_there_are_no_other_cells(cell: int) -> None:
    with pytest.raises(ValueError, match="72 cells"):
        so3_grid.cell_rotations(0, [cell])
