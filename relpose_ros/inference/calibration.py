"""How far a network's energies are log-probabilities: fitted on held-out scans, kept with the weights.

One temperature for all energies (Guo et al. 2017, On calibration of modern neural networks), then factors on
the covariances where they still miss. `relpose_ros.evaluation.calibrate` fits them.
"""

from __future__ import annotations

import json
import math
from dataclasses import asdict, dataclass, fields

from relpose_ros.errors import RelPoseError


class CalibrationError(RelPoseError):
    """A calibration that is none: estimates that rest on it would be called enough for no reason."""


@dataclass(frozen=True)
class Calibration:
    """What turns energies into probabilities that hold. The defaults are those of an uncalibrated network."""

    temperature: float = 1.0
    """Energies are divided by it."""
    pair_spread: float = 1.0
    """Factor on the covariance of a pair's relative rotation."""
    rotation_spread: float = 1.0
    """Factor on the covariance of a camera's rotation."""
    placed_by_boxes: bool = False
    """Whether the boxes tell where cameras stand from the object (`outlines.sighted_translations`) better
    than the network's predicted translations do."""
    position_sigma: tuple[float, float] = (0.1, 0.2)
    """Standard deviations of where a camera stands from the object before matches tell more, across its line
    of sight and along it, in units of the first camera's distance. The defaults are cautious."""
    flat: float = 0.0
    """Share of the uniform distribution that is mixed in: how often the network is plainly wrong of a pair,
    as on photographs unlike its training images. Without it such a pair outvotes all else that is known."""
    match_trust: tuple[float, ...] | None = None
    """Coefficients of `matches.trust` where this network's descriptors helped to match. None: nobody fitted
    any, and SIFT matches alone."""

    def to_json(self) -> str:
        """As kept in the weights' metadata, under ``calibration``."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """Reads what `to_json` wrote; other keys (a report kept beside it) are passed over.

        Raises:
            CalibrationError: It is something else, or says nothing of the temperature.
        """
        try:
            stored = json.loads(text)
            known = {field.name: stored[field.name] for field in fields(cls) if field.name in stored}
            for several in ("position_sigma", "match_trust"):
                if known.get(several) is not None:
                    known[several] = tuple(float(number) for number in known[several])
            found = cls(**known)
            amiss = found._amiss()
        except (ValueError, TypeError, AttributeError) as err:
            raise CalibrationError(f"the calibration cannot be read: {err}; calibrate anew.") from err
        if "temperature" not in known:
            amiss = "has no temperature"
        if amiss:
            raise CalibrationError(f"the calibration {amiss}; calibrate anew.")
        return found

    def _amiss(self) -> str:
        """What makes no sense of it; empty where all does."""
        factors = {name: getattr(self, name) for name in ("temperature", "pair_spread", "rotation_spread")}
        for name, value in factors.items():
            if isinstance(value, bool) or not (math.isfinite(value) and value > 0):
                return f"has a {name} of {value}, which is no positive number"
        if len(self.position_sigma) != 2 or not all(math.isfinite(s) and s > 0 for s in self.position_sigma):
            return f"has a position_sigma of {list(self.position_sigma)}, which are not two positive numbers"
        if not isinstance(self.placed_by_boxes, bool):
            return f"has placed_by_boxes {self.placed_by_boxes!r}, which is neither true nor false"
        if isinstance(self.flat, bool) or not 0 <= self.flat < 1:
            return f"has a flat share of {self.flat}, which does not lie from 0 to below 1"
        trust = self.match_trust
        if trust is not None and (len(trust) != 4 or not all(map(math.isfinite, trust))):
            return f"has a match_trust of {list(trust)}, which are not four numbers"
        return ""
