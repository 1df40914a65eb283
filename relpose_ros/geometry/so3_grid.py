"""Nested equivolumetric grid on SO(3): HEALPix on the sphere times a circle.

Yershova et al. 2010 (Generating uniform incremental grids on SO(3) using the Hopf fibration), as used by
Murphy et al. 2021 (Implicit-PDF). Level r has 72 * 8^r cells of equal volume: 12 * 4^r HEALPix pixels,
each with 6 * 2^r tilts. The cells nest: cell k of a level lies in cell k // 8 of the level above, and the
index of a cell is its level-0 index followed by one octal digit a level: tilt bit, then the two pixel bits.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]

BASE_TILTS = 6
BASE_CELLS = 12 * BASE_TILTS
MAX_LEVEL = 8
"""1.2 thousand million cells: beyond it an index would still be exact, an array of cells would not fit."""
LAST_TABULATED = 3
"""Centres of whole levels are kept up to this one, 3 MB in all, and looked up."""


def size(level: int) -> int:
    """Number of cells of a level: 72 * 8^level."""
    if not 0 <= level <= MAX_LEVEL:
        raise ValueError(f"The rotation grid has the levels 0 to {MAX_LEVEL}, there is no level {level}.")
    return int(BASE_CELLS * 8**level)


@lru_cache(maxsize=8)
def grid(level: int) -> FloatArray:
    """Centres of all cells of a level, read-only. -> (72 * 8^level, 3, 3)."""
    rotations = _worked_out(level, np.arange(size(level)))
    rotations.flags.writeable = False
    return rotations


def children(cells: npt.ArrayLike) -> IntArray:
    """Indices, one level down, of the eight cells inside each. (..., K) -> (..., 8 K), parents in order."""
    inside = np.asarray(cells, np.int64)[..., None] * 8 + np.arange(8)
    return np.asarray(inside.reshape(*inside.shape[:-2], -1))


def cell_spacing(level: int) -> float:
    """Edge in rad of a cube with the volume of one cell: 1.12 at level 0, halved at each level.

    SO(3) has the volume 8 pi^2 where lengths are rotation angles.
    """
    return float((8 * np.pi**2 / size(level)) ** (1 / 3))


def cell_rotations(level: int, cells: npt.ArrayLike) -> FloatArray:
    """Centres of the given cells of a level. (...) indices -> (..., 3, 3)."""
    asked = np.asarray(cells, np.int64)
    if asked.size and not (asked.min() >= 0 and asked.max() < size(level)):
        raise ValueError(
            f"Level {level} of the rotation grid has {size(level)} cells; an index lies outside."
        )
    return grid(level)[asked] if level <= LAST_TABULATED else _worked_out(level, asked)


def centres(level: int, cells: torch.Tensor) -> torch.Tensor:
    """`cell_rotations` in torch. (...) int64 -> (..., 3, 3) float64."""
    return torch.from_numpy(cell_rotations(level, cells.numpy()))


def _worked_out(level: int, rest: IntArray) -> FloatArray:
    """Centres of cells, from the digits of their indices. (...) -> (..., 3, 3)."""
    column, row, tilt = np.zeros_like(rest), np.zeros_like(rest), np.zeros_like(rest)
    for bit in range(level):
        digit = rest & 7
        column |= (digit & 1) << bit
        row |= (digit >> 1 & 1) << bit
        tilt |= (digit >> 2) << bit
        rest = rest >> 3
    tilt |= (rest % BASE_TILTS) << level
    belt = 1 - rest // BASE_TILTS // 4
    azimuth, height = _pixel_centre(rest // BASE_TILTS, column, row, 1 << level)
    turn = (tilt + 0.5) * (2 * np.pi / (BASE_TILTS << level))
    # Tilts count from a frame that is smooth over each diamond, also where four of them meet at a pole:
    # counted from the meridian, polar cells would be sheared by up to a quarter turn at every level.
    return _from_hopf(azimuth, height, turn - belt * azimuth)


def cells_at(level: int, rotations: torch.Tensor) -> torch.Tensor:
    """The cells of a level in which rotations lie: `cell_rotations` undone. (..., 3, 3) -> (...) indices.

    In torch: a solver asks for tens of thousands.
    """
    entries = rotations.flatten(-2).unbind(-1)
    (xx, xy, xz), (yx, yy, yz), height = entries[:3], entries[3:6], entries[8]
    azimuth = torch.atan2(yz, xz)
    ca, sa = azimuth.cos(), azimuth.sin()
    # The second row of Rz(-azimuth) R is (sin, cos, .) of the turn also where the z axis goes to a pole.
    turn = torch.atan2(ca * yx - sa * xx, ca * yy - sa * xy)
    x, y = _projected(azimuth, height)
    # Lines along a diamond's edges are a unit apart; floor says which diamond, the rest where in it.
    east, north = (y + 1 + x) / 2, (y + 1 - x) / 2
    column, row = east.floor().long(), north.floor().long()
    belt = column + row
    quarter = (column - row - belt.abs()) // 2 % 4
    side, tilts = 1 << level, BASE_TILTS << level
    column = ((east - column) * side).long().clamp(0, side - 1)
    row = ((north - row) * side).long().clamp(0, side - 1)
    tilt = ((turn + belt * azimuth) * (tilts / (2 * math.pi))).floor().long() % tilts
    cells = ((1 - belt) * 4 + quarter) * BASE_TILTS + (tilt >> level)
    for bit in reversed(range(level)):
        cells = cells * 8 + ((tilt >> bit & 1) << 2 | (row >> bit & 1) << 1 | column >> bit & 1)
    return cells


def _projected(azimuth: torch.Tensor, height: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """The HEALPix map projection, in units of pi/4: x along the equator, y up, -2 to 2."""
    x = azimuth * (4 / math.pi)
    width = (3 * (1 - height.abs()).clamp_min(0)).sqrt()  # of a polar diamond at that height
    shrunk = width.clamp_min(1e-6)
    middle = 2 * (x / 2).floor() + 1
    inside = (x - middle).clamp(1e-6 - 1, 1 - 1e-6) * shrunk  # on an edge no floor is safe
    polar = width <= 1 + 1e-9
    return (
        torch.where(polar, middle + inside, x),
        torch.where(polar, height.sign() * (2 - shrunk), 1.5 * height),
    )


def _pixel_centre(
    face: IntArray, column: IntArray, row: IntArray, side: int
) -> tuple[FloatArray, FloatArray]:
    """Azimuth and height z of HEALPix pixels, from their place in one of the twelve base diamonds.

    By the inverse of the HEALPix map projection (Calabretta and Roukema 2007), in which every pixel is
    a square standing on its corner: belts of diamonds at latitude +1, 0, -1 (in units of pi/4).
    """
    belt = 1 - face // 4
    middle = (np.pi / 2) * (face % 4) + (np.pi / 4) * np.abs(belt)
    east, north = (column + 0.5) / side, (row + 0.5) / side
    x = middle + (np.pi / 4) * (east - north)
    y = belt + east + north - 1
    polar = np.abs(y) > 1
    width = np.where(polar, 2 - np.abs(y), 1.0)  # parallels shrink towards a pole
    azimuth = middle + (x - middle) / width
    height = np.where(polar, np.sign(y) * (1 - width * width / 3), y * (2 / 3))
    return azimuth, height


def _from_hopf(azimuth: FloatArray, height: FloatArray, turn: FloatArray) -> FloatArray:
    """``Rz(azimuth) Ry(polar angle) Rz(turn)``: where the z axis goes, and its turn about itself."""
    c, s = height, np.sqrt(np.maximum(0, 1 - height * height))
    ca, sa, ct, st = np.cos(azimuth), np.sin(azimuth), np.cos(turn), np.sin(turn)
    rows = [
        *(ca * c * ct - sa * st, -ca * c * st - sa * ct, ca * s),
        *(sa * c * ct + ca * st, -sa * c * st + ca * ct, sa * s),
        *(-s * ct, s * st, c),
    ]
    return np.stack(rows, -1).reshape(*azimuth.shape, 3, 3)
