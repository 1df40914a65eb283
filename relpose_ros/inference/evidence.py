"""What an estimate rests on beside the network's energies."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal, get_args

from relpose_ros.errors import RelPoseError

Use = Literal["network", "pairs", "refine"]


class EvidenceError(RelPoseError):
    """Nothing that an estimate could rest on."""


@dataclass(frozen=True)
class EvidenceSettings:
    """Which evidence joins the network's, and what is known of the scale."""

    use: Use = "refine"
    """``network``: nothing beside it. ``pairs``: matched local features join the pairs' energies and the
    camera positions. ``refine``: then a bundle adjustment where views share points."""
    surroundings: bool = False
    """Whether features outside the object's box and mask take part."""
    learned: bool = True
    """Whether the network says anything, of rotations, positions and places that match: False measures what
    SIFT's geometry alone can do."""
    first_view_distance: float = 0.0
    """Metres from the first camera to the object frame's origin; 0: not known. A scan whose robot poses tell
    the scale needs none."""

    def __post_init__(self) -> None:
        """Refuse what is none of it.

        Raises:
            EvidenceError: There is no such use, or no such distance.
        """
        if self.use not in get_args(Use):
            raise EvidenceError(f"evidence is {self.use!r}; choose among {', '.join(get_args(Use))}.")
        if not 0 <= self.first_view_distance < math.inf:
            text = f"first_view_distance is {self.first_view_distance} m; give 0 for unknown, or more."
            raise EvidenceError(text)


SHIPPED = EvidenceSettings()
"""What users get who choose nothing."""
