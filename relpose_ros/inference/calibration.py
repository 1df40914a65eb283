"""How far a network's energies can be taken as log-probabilities: fitted on held-out scans, kept with the weights."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields
from typing import Any


@dataclass(frozen=True)
class Calibration:
    """What turns energies into probabilities that hold. The defaults are those of a network nobody calibrated."""

    temperature: float = 1.0
    """Energies are divided by it."""
    pair_spread: float = 1.0
    """Factor on the covariance of a pair's relative rotation."""
    camera_spread: float = 1.0
    """Factor on the covariance of a camera's rotation."""
    translation_sigma: tuple[float, float, float] = (0.1, 0.1, 0.2)
    """Standard deviation of a predicted translation in the camera's axes, in units of the first camera's
    distance. The defaults are cautious: the object's place across the view is read off its box, its depth
    off the box's size alone."""

    def to_json(self) -> dict[str, Any]:
        """Plain values for the weights' metadata."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Calibration:
        """Reads what `to_json` wrote; unknown keys (a report stored beside it) are ignored."""
        known = {field.name: values[field.name] for field in fields(cls) if field.name in values}
        if "translation_sigma" in known:
            known["translation_sigma"] = tuple(float(sigma) for sigma in known["translation_sigma"])
        return cls(**known)
