"""Cameras tried at other places, one at a time, while others of the same solution hold them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import torch

from relpose_ros.geometry import so3_grid
from relpose_ros.inference.pair_distribution import turned_back

if TYPE_CHECKING:
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.inference.pair_energies import PairEnergies


@dataclass(frozen=True, eq=False)
class MovingCameras:
    """G groups of S solutions; in each group one camera is tried at C places, beside O others.

    Places are rotations camera_from_object, (G, S, C, 3, 3) float64.
    """

    energies: PairEnergies
    rotations: torch.Tensor
    """(G, S, N, 3, 3) of the solutions."""
    cameras: torch.Tensor
    """(G,) the camera that moves."""
    others: torch.Tensor
    """(G, O) those that hold it."""

    @classmethod
    def each(cls, energies: PairEnergies, rotations: torch.Tensor) -> MovingCameras:
        """A group for every camera, held by all others. (S, N, 3, 3)."""
        views = energies.views
        cameras = torch.arange(views)
        others = cameras.expand(views, -1)[cameras != cameras[:, None]].view(views, views - 1)
        return cls(energies, rotations.expand(views, -1, -1, -1, -1), cameras, others)

    def only(self, groups: torch.Tensor) -> MovingCameras:
        """Some of the groups. (G,) bool."""
        rotations, cameras, others = self.rotations[groups], self.cameras[groups], self.others[groups]
        return MovingCameras(self.energies, rotations, cameras, others)

    @property
    def here(self) -> torch.Tensor:
        """Where the cameras are, as places. (G, S, 1, 3, 3)."""
        return self.rotations[torch.arange(len(self.cameras)), :, self.cameras][:, :, None]

    @cached_property
    def pairs(self) -> torch.Tensor:
        """(G, O) positions of the camera's pairs."""
        return self.energies.pair_of[self.cameras[:, None], self.others]

    def where_modes_put(self, modes: torch.Tensor) -> torch.Tensor:
        """Places at which modes of its pairs would put a camera. (P, M, 3, 3) -> (G, S, O M, 3, 3)."""
        modes = modes[self.pairs]  # (G, O, M, 3, 3)
        camera_from_other = torch.where(self._forward[..., None, None, None], modes, modes.mT)[:, None]
        return (camera_from_other @ self._held.transpose(1, 2)[:, :, :, None]).flatten(2, 3)

    def heights(self, places: torch.Tensor) -> torch.Tensor:
        """Energy of the camera's pairs at each place. -> (G, S, C) float64."""
        relative = self._relative(places)
        values = self.energies.at(self.pairs.flatten(), relative.flatten(2, 3).flatten(0, 1))
        return values.double().view(relative.shape[:4]).sum(1)

    def uphill(self, places: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """`heights`, and their gradients for left perturbations of the places. -> (G, S, C), (G, S, C, 3)."""
        relative = self._relative(places)
        values, slopes = self.energies.uphill(self.pairs.flatten(), relative.flatten(2, 3).flatten(0, 1))
        slopes = slopes.view(relative.shape[:-1])
        forward = self._forward[..., None, None, None]
        slopes = torch.where(forward, slopes, turned_back(relative, slopes))
        return values.view(relative.shape[:4]).sum(1), slopes.sum(1)

    def remembered(self, distributions: PairDistributions, places: torch.Tensor) -> torch.Tensor:
        """What the coarse grid remembers of `heights`; no energy is evaluated. -> (G, S, C)."""
        relative = self._relative(places)
        cells = so3_grid.cells_at(distributions.coarse_level, relative)
        known = distributions.coarse[self.pairs]  # (G, O, cells)
        return known.gather(2, cells.flatten(2)).view(cells.shape).sum(1)

    @cached_property
    def _forward(self) -> torch.Tensor:
        """(G, O) whether the camera comes second in the pair, so that the pair is camera_from_other."""
        return self.cameras[:, None] > self.others

    @cached_property
    def _held(self) -> torch.Tensor:
        """(G, O, S, 3, 3) rotations of the others."""
        return self.rotations[torch.arange(len(self.cameras))[:, None], :, self.others]

    def _relative(self, places: torch.Tensor) -> torch.Tensor:
        """Relative rotations of the camera's pairs, in the order of their views. -> (G, O, S, C, 3, 3)."""
        groups, solutions, count = places.shape[:3]
        # One product of a tall and a wide matrix for each group and solution, each tile of it a rotation.
        wide = self._held.permute(0, 2, 4, 1, 3).flatten(3)  # (G, S, 3, 3 O)
        tiles = (places.flatten(2, 3) @ wide).view(groups, solutions, count, 3, -1, 3)
        camera_from_other = tiles.permute(0, 4, 1, 2, 3, 5)
        forward = self._forward[..., None, None, None, None]
        return torch.where(forward, camera_from_other, camera_from_other.mT)
