"""What else than the network speaks about the relative rotations: a log-density to add to each pair's energy.

A pair's matches put peaks on SO(3), each a mixture component with the probability that it is right; the rest
is flat. However certain a peak, other pairs can outvote it: contradicting it costs a finite price.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import torch

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]

FREEDOM = 4.0
"""Degrees of freedom of Student's t, the shape of a peak: errors of matched rotations have heavier tails than
a Gaussian's, and a slope far from the peak is what an ascent climbs."""
_LOG_VOLUME = math.log(8 * math.pi**2)
"""Of SO(3) in the measure of rotation vectors near zero."""
_LOG_CONSTANT = (
    math.lgamma((FREEDOM + 3) / 2)
    - math.lgamma(FREEDOM / 2)
    - 1.5 * math.log(FREEDOM * math.pi)
    + _LOG_VOLUME
)


@dataclass(frozen=True, eq=False)
class Peak:
    """A rotation that a pair may have."""

    rotation: FloatArray
    """(3, 3) camera_j_from_camera_i."""
    covariance: FloatArray
    """(3, 3) of the rotation vector, left perturbation, rad^2."""
    probability: float
    """That this is the one; those of a pair sum to less than one."""


@dataclass(frozen=True, eq=False)
class _Shapes:
    """Peaks (P, M) as functions of a rotation's nine entries."""

    linear: torch.Tensor
    """(P, M, 9) coefficients of the entries in the squared distance from a peak, in standard deviations."""
    spread: torch.Tensor
    """(P, M, 1) what is added to that."""
    tops: torch.Tensor
    """(P, M, 1) logs of the densities at the peaks, times their probabilities."""


class RotationEvidence:
    """The log-densities of P pairs, relative to uniform."""

    def __init__(self, pairs: Sequence[Sequence[Peak]]) -> None:
        """Take the peaks of each pair; none means no opinion."""
        most = max(1, *(len(peaks) for peaks in pairs))
        self.spoken = tuple(len(peaks) > 0 for peaks in pairs)
        """Of which pairs there is some."""
        rotations = np.tile(np.eye(3), (len(pairs), most, 1, 1))
        covariances = np.tile(np.eye(3), (len(pairs), most, 1, 1))
        weights = np.zeros((len(pairs), most))
        for pair, peaks in enumerate(pairs):
            for k, peak in enumerate(peaks):
                rotations[pair, k], covariances[pair, k] = peak.rotation, peak.covariance
                weights[pair, k] = peak.probability
        if (weights.sum(1) >= 1).any():
            raise ValueError("The probabilities of a pair's peaks must sum to less than one.")
        self._peaks = torch.from_numpy(rotations)
        self._covariances = torch.from_numpy(covariances)
        self._log_weights = torch.from_numpy(weights).log()
        self._log_rest = torch.from_numpy(1 - weights.sum(1)).log()
        self._known_shapes: dict[float, _Shapes] = {}

    def __call__(self, pairs: torch.Tensor, rotations: torch.Tensor, blur: float = 0.0) -> torch.Tensor:
        """Log-density relative to uniform.

        Args:
            pairs: (Q,) int64.
            rotations: (Q, K, 3, 3) or (K, 3, 3) float64, camera_j_from_camera_i.
            blur: standard deviation, rad, by which every peak is widened: half a grid cell makes the value at
                its centre stand for the cell, however sharp the peak.

        Returns:
            (Q, K) float64.
        """
        return torch.logsumexp(self._heights(pairs, rotations, self._shapes(blur))[0], 1)

    def with_gradients(
        self, pairs: torch.Tensor, rotations: torch.Tensor
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """The same without blur, and its derivatives by the nine entries.

        (Q,), (Q, K, 3, 3) -> (Q, K), (Q, K, 3, 3).
        """
        shapes = self._shapes(0.0)
        heights, distances = self._heights(pairs, rotations, shapes)
        values = torch.logsumexp(heights, 1)
        shares = (heights[:, :-1] - values[:, None]).exp()
        slopes = shares * (-(FREEDOM + 3) / 2) / (FREEDOM + distances)
        return values, torch.einsum("qmk,qmx->qkx", slopes, shapes.linear[pairs]).view(rotations.shape)

    def _shapes(self, blur: float) -> _Shapes:
        """All peaks, widened; the same few widths are asked for again and again."""
        if blur not in self._known_shapes:
            eye = torch.eye(3, dtype=torch.float64)
            information = torch.linalg.inv(self._covariances + blur**2 * eye)  # (P, M, 3, 3)
            log_scales = torch.linalg.slogdet(information).logabsdet / 2
            # With v the axis of a turn D times 2 sin(angle / 2), v v^T = D + D^T - (tr D - 1) I. So the
            # distance v^T L v is linear in D: as the rotation vector's where it is small, and smooth all
            # around SO(3).
            spread = information.diagonal(dim1=-2, dim2=-1).sum(-1)
            linear = (2 * information - spread[..., None, None] * eye) @ self._peaks
            tops = self._log_weights + log_scales + _LOG_CONSTANT
            self._known_shapes[blur] = _Shapes(linear.flatten(-2), spread[..., None], tops[..., None])
        return self._known_shapes[blur]

    def _heights(
        self, pairs: torch.Tensor, rotations: torch.Tensor, shapes: _Shapes
    ) -> tuple[torch.Tensor, torch.Tensor]:
        """Logs of the mixture's parts (Q, M + 1, K), the flat rest last; distances from peaks (Q, M, K)."""
        equation = "kx,qmx->qmk" if rotations.ndim == 3 else "qkx,qmx->qmk"
        distances = torch.einsum(equation, rotations.flatten(-2), shapes.linear[pairs])
        distances = (distances + shapes.spread[pairs]).clamp_min(0)
        heights = shapes.tops[pairs] - (FREEDOM + 3) / 2 * torch.log1p(distances / FREEDOM)
        rest = self._log_rest[pairs][:, None, None].expand(-1, -1, heights.shape[-1])
        return torch.cat([heights, rest], 1), distances
