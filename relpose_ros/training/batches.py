"""Batches for training: scans from shards, some of their views, and changes that leave the poses exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn import functional

from relpose_ros.captures.shards import read_shard, shard_folders
from relpose_ros.errors import RelPoseError
from relpose_ros.network.crops import IMAGE_MEAN, IMAGE_STD
from relpose_ros.training.objective import Batch

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    FloatArray = npt.NDArray[np.float64]
    Images = npt.NDArray[np.float32]

FIELDS = ("images", "crop_parameters", "camera_from_object", "places", "image_sizes")
"""What is used of a shard; see `relpose_ros.captures.shards`."""


DRAWS = 20
"""How often another scan is drawn when one lacks views within the angle asked for."""


class ShardError(RelPoseError):
    """A folder holds no shards, or shards of another kind."""


class Scans:
    """Scans, a row each, in any number of shards. The arrays stay where they are, for instance on disk."""

    def __init__(self, shards: Sequence[Mapping[str, npt.NDArray[Any]]]) -> None:
        """Take shards as `read_shard` gives them.

        Raises:
            ShardError: There are none, or they differ in the size of their images.
        """
        if not shards:
            text = "there are no shards to learn from; make some with 'relpose_ros render'."
            raise ShardError(text)
        for shard in shards:
            if missing := [name for name in FIELDS if name not in shard]:
                text = f"a shard lacks {missing[0]}.npy; render it again."
                raise ShardError(text)
            if shard["images"].shape[2:] != shards[0]["images"].shape[2:]:
                sizes = f"{shard['images'].shape[2:]} and {shards[0]['images'].shape[2:]}"
                text = f"shards of images of {sizes} do not mix; render them alike."
                raise ShardError(text)
        self._shards = list(shards)
        self._ends = np.cumsum([len(shard["images"]) for shard in shards])

    def __len__(self) -> int:
        return int(self._ends[-1])

    @property
    def image_size(self) -> int:
        """Side of the crops, pixels."""
        return int(self._shards[0]["images"].shape[2])

    @property
    def views(self) -> int:
        """Views that every scan has at least."""
        return min(int(shard["images"].shape[1]) for shard in self._shards)

    def row(self, index: int) -> dict[str, npt.NDArray[Any]]:
        """One scan: the arrays of `FIELDS`, without copying them."""
        shard = int(np.searchsorted(self._ends, index, side="right"))
        within = index - len(self) if shard >= len(self._ends) else index - int(self._ends[shard])
        return {name: self._shards[shard][name][within] for name in FIELDS}


def open_scans(folders: Iterable[Path]) -> Scans:
    """All shards under the given folders, memory-mapped, in order of their names.

    Raises:
        ShardError: as `Scans`.
    """
    return Scans([read_shard(path) for path in shard_folders(folders)])


@dataclass(frozen=True)
class Augmentation:
    """What is changed in a scan each time it is seen: exactly in the poses, or without touching them."""

    mirror: float = 0.5
    """Probability that the world is mirrored."""
    quarter_turns: float = 0.2
    """Probability that all images of a scan are turned by the same multiple of 90 degrees."""
    masked: float = 0.15
    """Probability that a scan is shown as segmented: white outside the object."""
    grey: float = 0.05
    """Probability that a scan is shown without colour."""
    gain: float = 0.15
    """Standard deviation of each image's brightness and each scan's colour balance, as factors."""
    noisy: float = 0.25
    """Probability that a scan gets more noise than it was rendered with."""
    noise: float = 0.04
    """Largest standard deviation of that noise, of the full range."""


def choose_views(
    camera_from_object: FloatArray, count: int, max_angle: float, generator: np.random.Generator
) -> tuple[list[int], bool]:
    """Views of a scan whose viewing directions lie within an angle of a random one's, in random order.

    Where too few do, the nearest are taken, and the second value is False.

    Args:
        camera_from_object: (M, 3, 4).
        count: How many, at most M.
        max_angle: Degrees.
        generator: Of the draw.
    """
    directions = camera_from_object[:, 2, :3]
    anchor = int(generator.integers(len(directions)))
    angles = np.degrees(np.arccos(np.clip(directions @ directions[anchor], -1, 1)))
    angles[anchor] = -1
    within = int((angles <= max_angle).sum()) - 1
    near = np.argsort(angles, kind="stable")[1 : 1 + max(within, count - 1)]
    others = generator.choice(near, count - 1, replace=False)
    return [int(k) for k in generator.permutation([anchor, *others])], within >= count - 1


def make_batch(
    scans: Scans,
    count: int,
    views: int,
    max_angle: float,
    generator: np.random.Generator,
    augmentation: Augmentation | None = None,
) -> Batch:
    """Draw ``count`` scans of ``views`` views.

    Args:
        scans: To draw from.
        count: B.
        views: N.
        max_angle: Of `choose_views`, degrees.
        generator: The step's own.
        augmentation: None for the scans as they are.

    Raises:
        ShardError: There are scans of fewer views.
    """
    if views > scans.views:
        text = f"there are scans of {scans.views} views, and {views} were to be drawn; render scans of more."
        raise ShardError(text)
    rows = []
    for _ in range(count):
        for _ in range(DRAWS):
            row = scans.row(int(generator.integers(len(scans))))
            chosen, within = choose_views(row["camera_from_object"], views, max_angle, generator)
            if within:
                break
        scan = _Scan(
            images=np.asarray(row["images"][chosen], np.float32) / np.float32(255),
            places=np.asarray(row["places"][chosen], np.float32),
            crops=np.asarray(row["crop_parameters"][chosen], np.float64),
            poses=np.asarray(row["camera_from_object"][chosen], np.float64),
            across=2 * row["image_sizes"][chosen] / row["image_sizes"][chosen].min(-1, keepdims=True),
        )
        rows.append(scan if augmentation is None else _augment(scan, augmentation, generator))
    images = np.stack([scan.images for scan in rows])
    images -= np.array(IMAGE_MEAN, np.float32)
    images /= np.array(IMAGE_STD, np.float32)
    return Batch(
        images=torch.from_numpy(images).movedim(-1, -3),
        crop_parameters=torch.from_numpy(np.stack([scan.crops for scan in rows])).float(),
        camera_from_world=np.stack([scan.poses for scan in rows]),
        places=torch.from_numpy(np.stack([scan.places for scan in rows])),
    )


@dataclass(frozen=True, eq=False)
class _Scan:
    """N views in the making."""

    images: Images
    """(N, S, S, 3), 0 to 1."""
    places: npt.NDArray[np.float32]
    """(N, h, w, 3)."""
    crops: FloatArray
    """(N, 3) crop parameters."""
    poses: FloatArray
    """(N, 3, 4)."""
    across: FloatArray
    """(N, 2) width and height of the full image in halves of its shorter side."""


def _augment(scan: _Scan, augmentation: Augmentation, generator: np.random.Generator) -> _Scan:
    scan = replace(scan, images=_recolour(scan, augmentation, generator))
    if generator.random() < augmentation.mirror:
        scan = _mirror(scan)
    if generator.random() < augmentation.quarter_turns:
        for _ in range(int(generator.integers(1, 4))):
            scan = _quarter_turn(scan)
    return scan


def _recolour(scan: _Scan, augmentation: Augmentation, generator: np.random.Generator) -> Images:
    """Other light and colours, noise, and sometimes no background."""
    balance = 1 + augmentation.gain * generator.normal(size=(1, 1, 1, 3))
    exposure = 1 + augmentation.gain * generator.normal(size=(len(scan.images), 1, 1, 1))
    changed = scan.images * (balance * exposure).astype(np.float32)
    if generator.random() < augmentation.grey:
        changed[:] = changed.mean(-1, keepdims=True)
    if generator.random() < augmentation.noisy:
        noise = np.float32(augmentation.noise * generator.random())
        changed += noise * generator.standard_normal(changed.shape, np.float32)
    outside = scan.images.max(-1, keepdims=True) == 0  # beside the photograph a crop is black in any light
    changed = np.clip(np.where(outside, 0, changed), 0, 1)
    object_cells = np.isfinite(scan.places[..., 0])
    if generator.random() < augmentation.masked and object_cells.any():
        seen = torch.from_numpy(object_cells).float()[:, None]
        mask = (
            functional.interpolate(seen, changed.shape[1:3], mode="bilinear", align_corners=False)[:, 0] > 0.4
        )
        changed = np.where(mask.numpy()[..., None], changed, np.float32(1))
    return changed


def _mirror(scan: _Scan) -> _Scan:
    """The scan of the mirrored world: images flipped left to right, x turned in camera and object alike."""
    flip = np.array([-1.0, 1.0, 1.0])
    crops = scan.crops.copy()
    crops[:, 0] = 2 - scan.across[:, 0] - crops[:, 0]
    return replace(
        scan,
        images=scan.images[:, :, ::-1],
        places=scan.places[:, :, ::-1] * flip.astype(np.float32),
        crops=crops,
        poses=scan.poses * flip[:, None] * np.append(flip, 1.0),
    )


def _quarter_turn(scan: _Scan) -> _Scan:
    """All images turned by 90 degrees counter-clockwise, and the cameras with them."""
    # What was right (+x) is now up (-y), what was down (+y) is now right (+x).
    turn = np.array([[0.0, 1, 0], [-1, 0, 0], [0, 0, 1]])
    crops = np.stack([scan.crops[:, 1], 2 - scan.across[:, 0] - scan.crops[:, 0], scan.crops[:, 2]], -1)
    return _Scan(
        images=np.rot90(scan.images, axes=(1, 2)),
        places=np.rot90(scan.places, axes=(1, 2)),
        crops=crops,
        poses=turn @ scan.poses,
        across=scan.across[:, ::-1],
    )
