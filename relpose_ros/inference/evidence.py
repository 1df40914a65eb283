"""What an estimate rests on beside the network's energies."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True)
class EvidenceSettings:
    """Which evidence joins the network's, and what is known of the scale."""

    use: Literal["network", "pairs", "refine"] = "refine"
    """``network``: nothing beside it. ``pairs``: matched local features join the pairs' energies and the
    camera positions. ``refine``: then a bundle adjustment where views share points."""
    surroundings: bool = False
    """Whether features outside the object's box and mask take part."""
    learned: bool = True
    """Whether the network says anything, of rotations and of places that match: False measures what SIFT's
    geometry alone can do."""
    first_view_distance: float = 0.0
    """Metres from the first camera to the object frame's origin; 0: not known. A scan whose robot poses tell
    the scale needs none."""


SHIPPED = EvidenceSettings()
"""What users get who choose nothing."""
