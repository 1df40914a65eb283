"""The sizes and switches of a network: everything in which one network differs from another."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin, get_type_hints

from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence


class PresetError(RelPoseError):
    """There is no such preset or variant, or its switches contradict each other."""


@dataclass(frozen=True)
class CorrelationSettings:
    """How two views' local features are compared and the result is read.

    Descriptors have the resolution of one backbone stage and hear of the coarser ones. Each place of view i
    is told where in view j it is found, as ``match_width`` learned functions of the place; convolutions read
    the image of those.
    """

    stage: int
    """Backbone stage (from 0) whose resolution the descriptors have."""
    map_side: int
    """Side of that map, in descriptors."""
    descriptor_width: int
    match_width: int
    layout_widths: tuple[int, int]
    summary_width: int
    descriptor_depth: int = 0
    """Residual blocks between the maps of the stages and the descriptors."""


@dataclass(frozen=True)
class Preset:
    """A network in numbers. The defaults are the published RelPose++ (arXiv 2305.04926)."""

    name: str
    image_size: int = 224
    """Side of a crop, pixels."""
    crop_antialias: bool = False
    """Whether a crop is low-pass filtered when it is shrunk."""
    backbone: Literal["residual", "efficientnet_lite0"] = "residual"
    """What looks at a view. EfficientNet-Lite0 has sizes of its own: those of stem and stages here are the
    residual network's."""
    stem_width: int = 64
    stage_widths: tuple[int, ...] = (64, 128, 256, 512)
    stage_depths: tuple[int, ...] = (3, 4, 6, 3)
    layout_width: int | None = None
    """Channels kept at each place when the last map becomes a token; None: the plain average of the map."""
    pooled_width: int = 2048
    """Numbers that describe a view; with the encoded crop parameters they are its token."""
    crop_frequencies: int = 8
    rotation_frequencies: int = 8
    max_views: int = 8
    layers: int = 8
    heads: int = 12
    head_width: int = 64
    feedforward_width: int = 1536
    energy_width: int = 256
    translation_widths: tuple[int, int] = (1024, 512)
    correlation: CorrelationSettings | None = None

    index_encoding: bool = True
    """Whether a token knows the position of its view in the scan."""
    pair_context: bool = False
    """Whether the transformer sees only the two views of a pair at a time."""
    rotation: Literal["energy", "regression"] = "energy"
    """A distribution over each pair's rotation, or one rotation a view, as six numbers (Zhou et al. 2019)."""
    translation_frame: Literal["look_at", "first_camera"] = "look_at"
    """Origin of the world in which translations are predicted."""

    def __post_init__(self) -> None:
        for field, kind in get_type_hints(Preset).items():
            value = getattr(self, field)
            if get_origin(kind) is Literal and value not in get_args(kind):
                known = ", ".join(get_args(kind))
                raise PresetError(f"A network's {field} is {value!r}; it must be one of {known}.")
        if self.rotation == "regression" and self.correlation is not None:
            text = "A network that regresses rotations looks at no pairs: its correlation must be None."
            raise PresetError(text)

    @property
    def crop_width(self) -> int:
        """Numbers that encode the three crop parameters."""
        return 3 * 2 * self.crop_frequencies

    @property
    def token_width(self) -> int:
        """Width of a token."""
        return self.pooled_width + self.crop_width

    @property
    def small_convolutions(self) -> bool:
        """Whether those of one view are too small for several threads to share.

        On two cores one view took as long on one thread as on both; the residual network shares them well.
        """
        return self.backbone == "efficientnet_lite0"


PRESETS = {
    "paper": Preset("paper"),
    "compact": Preset(
        "compact",
        image_size=128,
        crop_antialias=True,
        backbone="efficientnet_lite0",
        layout_width=64,
        pooled_width=232,
        crop_frequencies=4,
        rotation_frequencies=4,
        layers=4,
        heads=8,
        head_width=32,
        feedforward_width=512,
        energy_width=128,
        translation_widths=(256, 128),
        correlation=CorrelationSettings(
            stage=1,
            map_side=16,
            descriptor_width=64,
            match_width=48,
            layout_widths=(64, 96),
            summary_width=256,
            descriptor_depth=1,
        ),
    ),
}
"""The two networks this package knows by name."""

VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "no-index": {"index_encoding": False},
    "pair-context": {"pair_context": True},
    "regression": {"rotation": "regression", "correlation": None},
    "first-camera": {"translation_frame": "first_camera"},
}
"""The ablations of the paper, as changes of a preset. Several may be made at once: ``regression`` alone
regresses poses in the look-at frame, together with ``first-camera`` in that of the first camera."""


def named_preset(name: str, variants: Sequence[str] = ()) -> Preset:
    """A preset with some of the variants.

    Raises:
        PresetError: There is no preset or variant of that name.
    """
    if name not in PRESETS:
        raise PresetError(f"There is no preset '{name}'; choose among {', '.join(PRESETS)}.")
    preset = PRESETS[name]
    for variant in variants:
        if variant not in VARIANTS:
            raise PresetError(f"There is no variant '{variant}'; choose among {', '.join(VARIANTS)}.")
        preset = replace(preset, **VARIANTS[variant])
    return preset


def variants_of(preset: Preset) -> tuple[str, ...]:
    """The variants that were made of a preset, in the order of `VARIANTS`."""
    return tuple(
        name
        for name, changes in VARIANTS.items()
        if all(getattr(preset, field) == value for field, value in changes.items())
    )
