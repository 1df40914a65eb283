"""Energies with known optima, made of mixtures of isotropic matrix Fisher densities on SO(3)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
import torch

from relpose_ros.geometry import so3


@dataclass(eq=False)
class FisherScene:
    """Doubles as the features and the model: the seam of a network, with energies that are known in full.

    The energy of pair (i, j) at R is log sum_m exp(log_weight_m + concentration_m (tr(R_m^T R) - 3)):
    its modes are the R_m, and it does not change when the two views are swapped and R inverted.
    """

    cameras: np.ndarray
    """(N, 3, 3) camera_from_object."""
    concentration: float = 20.0
    mixtures: dict[tuple[int, int], list[tuple[np.ndarray, float, float]]] = field(default_factory=dict)
    """Per pair i < j: (camera_j_from_camera_i, log weight, concentration); absent pairs tell the truth."""
    components: int = 4

    def __len__(self) -> int:
        return len(self.cameras)

    def relative(self, i: int, j: int) -> np.ndarray:
        return self.cameras[j] @ self.cameras[i].T

    def pair_contexts(self, features: FisherScene, i: torch.Tensor, j: torch.Tensor) -> torch.Tensor:
        rows = []
        for a, b in zip(i.tolist(), j.tolist(), strict=True):
            mixture = features.mixtures.get((a, b), [(features.relative(a, b), 0.0, features.concentration)])
            padded = mixture + [(np.eye(3), -1e4, 1.0)] * (self.components - len(mixture))
            rows.append(np.stack([np.r_[r.ravel(), w, k] for r, w, k in padded]).ravel())
        return torch.tensor(np.array(rows), dtype=torch.float32)

    def energy_head(self) -> FisherScene:
        return self

    def embed(self, rotations: torch.Tensor) -> torch.Tensor:
        return rotations.flatten(-2).float()

    def energies(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> torch.Tensor:
        mixture = contexts.unflatten(-1, (self.components, 11))
        equation = "pmx,kx->pkm" if embeddings.ndim == 2 else "pmx,pkx->pkm"
        traces = torch.einsum(equation, mixture[..., :9], embeddings)
        return torch.logsumexp(mixture[:, None, :, 9] + mixture[:, None, :, 10] * (traces - 3), -1)

    def energies_and_gradients(
        self, contexts: torch.Tensor, rotations: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        with torch.enable_grad():
            entries = rotations.detach().requires_grad_()
            energies = self.energies(contexts, self.embed(entries))
            (gradients,) = torch.autograd.grad(energies.sum(), entries)
        return energies.detach(), gradients

    def relabelled(self, order: list[int]) -> FisherScene:
        """The same scene with its views in another order."""
        mixtures = {}
        for new_i in range(len(order)):
            for new_j in range(new_i + 1, len(order)):
                i, j = order[new_i], order[new_j]
                old = self.mixtures.get((min(i, j), max(i, j)))
                if old is not None:
                    mixtures[new_i, new_j] = [(r if i < j else r.T, w, k) for r, w, k in old]
        return FisherScene(self.cameras[order], self.concentration, mixtures, self.components)


def around_object(count: int, seed: int) -> np.ndarray:
    """Cameras all around an object, the first the identity. -> (N, 3, 3)."""
    cameras = so3.random_rotations(count, np.random.default_rng(seed))
    return cameras @ cameras[0].T
