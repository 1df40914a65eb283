"""How far a network's energies are log-probabilities: fitted on held-out scans, kept with the weights."""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass, fields


@dataclass(frozen=True)
class Calibration:
    """What turns energies into probabilities that hold. The defaults are those of an uncalibrated network."""

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

    def to_json(self) -> str:
        """As kept in the weights' metadata, under ``calibration``."""
        return json.dumps(asdict(self))

    @classmethod
    def from_json(cls, text: str) -> Calibration:
        """Reads what `to_json` wrote; other keys (a report kept beside it) are passed over."""
        stored = json.loads(text)
        known = {field.name: stored[field.name] for field in fields(cls) if field.name in stored}
        if "translation_sigma" in known:
            known["translation_sigma"] = tuple(float(sigma) for sigma in known["translation_sigma"])
        return cls(**known)
