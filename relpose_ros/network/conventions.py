"""Between the released network's convention and ours. Nothing outside this package sees the former.

Released: PyTorch3D camera axes (x left, y up, z forward) and row vectors, ``x_camera = x_world R + t``.
Ours: optical axes (x right, y down, z forward) and column vectors, ``x_camera = R x_world + t``.
With F = diag(-1, -1, 1), ``R_optical = F R^T`` and ``t_optical = F t``; both have the same world axes.

All functions take torch tensors of any dtype with any leading dimensions.
"""

from __future__ import annotations

import torch


def _flip(like: torch.Tensor) -> torch.Tensor:
    return torch.tensor([-1.0, -1.0, 1.0], dtype=like.dtype, device=like.device)


def optical_rotation(released: torch.Tensor) -> torch.Tensor:
    """camera_from_world of a released rotation: ``F R^T``. (..., 3, 3) -> (..., 3, 3)."""
    return _flip(released)[:, None] * released.mT


def released_rotation(camera_from_world: torch.Tensor) -> torch.Tensor:
    """Inverse of `optical_rotation`: ``R^T F``. (..., 3, 3) -> (..., 3, 3)."""
    return camera_from_world.mT * _flip(camera_from_world)


def optical_translation(released: torch.Tensor) -> torch.Tensor:
    """Optical translation of a released one: ``F t``. It is its own inverse. (..., 3) -> (..., 3)."""
    return released * _flip(released)


def released_relative(camera_j_from_camera_i: torch.Tensor) -> torch.Tensor:
    """What the energy of the pair (i, j) takes: ``R_i^T R_j`` of the released rotations.

    In ours it is ``F (camera_j_from_camera_i)^T F``, which is its own inverse. (..., 3, 3) -> (..., 3, 3).
    """
    flip = _flip(camera_j_from_camera_i)
    return flip[:, None] * camera_j_from_camera_i.mT * flip
