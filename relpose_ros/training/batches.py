"""Batches for training: scans from shards, some of their views, and changes that leave the poses exact."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch.nn import functional

from relpose_ros.captures.shards import Shard, ShardError, shard_folders
from relpose_ros.network.crops import IMAGE_MEAN, IMAGE_STD
from relpose_ros.training.objective import Batch

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.captures.shards import Arrays
    from relpose_ros.training.objective import Looks

    FloatArray = npt.NDArray[np.float64]
    Images = npt.NDArray[np.float32]

FIELDS = ("crop_parameters", "camera_from_object", "places", "image_sizes")
"""What is used of a shard beside its images; see `relpose_ros.captures.shards`."""
MAP = "map_{}"
"""Instead of images: what leaves a stage of a backbone that is not trained, (M, N, C, h, w) float16. Images
are changed at random before, if at all."""
_MOST_STAGES = 8

DRAWS = 20
"""How often another scan is drawn when one lacks views within the angle asked for."""
_HOW_TO_MAKE_SHARDS = "make some with 'relpose_ros render DIR --as shards'"


class Scans:
    """Scans, a row each, in any number of shards. The arrays stay where they are, for instance on disk."""

    def __init__(self, shards: Sequence[Arrays], *, first_map: bool = False) -> None:
        """Take shards, such as those that `Shard` reads.

        Args:
            shards: Their arrays by name.
            first_map: Whether to read the first of their maps alone, where they hold maps.

        Raises:
            ShardError: There are none, or they differ in the size of their images, or in the backbone that
                looked at them.
        """
        if not shards:
            text = f"there are no shards to learn from; {_HOW_TO_MAKE_SHARDS}."
            raise ShardError(text)
        self.map_shapes = {
            stage: shards[0][MAP.format(stage)].shape[2:]
            for stage in range(_MOST_STAGES)
            if MAP.format(stage) in shards[0]
        }
        """(C, h, w) by stage, of the backbone whose maps are there instead of images; empty where there are
        images."""
        if first_map:
            self.map_shapes = dict(list(self.map_shapes.items())[:1])
        looks = [MAP.format(stage) for stage in self.map_shapes] or ["images"]
        self._fields = (*looks, *FIELDS)
        for shard in shards:
            if ("images" in shard) != ("images" in looks):
                text = "shards of images and of features do not mix; name folders of one kind."
                raise ShardError(text)
            if missing := [name for name in self._fields if name not in shard]:
                text = f"a shard lacks {missing[0]}.npy; render it again."
                raise ShardError(text)
            for name in looks:
                if (shape := shard[name].shape[2:]) != shards[0][name].shape[2:]:
                    sizes = f"{shape} and {shards[0][name].shape[2:]}"
                    text = f"shards of {name} of {sizes} do not mix; render them alike."
                    raise ShardError(text)
        self._shards = shards
        shapes = [shard["camera_from_object"].shape for shard in shards]
        self._ends = np.cumsum([scans for scans, *_ in shapes])
        self.views = min(views for _, views, *_ in shapes)
        """Views that every scan has at least."""

    def __len__(self) -> int:
        return int(self._ends[-1])

    def first_maps(self) -> Scans:
        """The same scans with the first of their maps alone, for a backbone that is trained from there on."""
        return Scans(self._shards, first_map=True)

    def row(self, index: int) -> dict[str, npt.NDArray[Any]]:
        """One scan: its images or maps and the arrays of `FIELDS`, without copying them."""
        shard = int(np.searchsorted(self._ends, index, side="right"))
        within = index - len(self) if shard >= len(self._ends) else index - int(self._ends[shard])
        return {name: self._shards[shard][name][within] for name in self._fields}


def shards_in(folders: Sequence[Path]) -> list[Path]:
    """The folders of all shards under the given ones, in order of their names.

    Raises:
        ShardError: There are none.
    """
    found = shard_folders(folders)
    if not found:
        raise ShardError(f"there are no shards in {', '.join(map(str, folders))}; {_HOW_TO_MAKE_SHARDS}.")
    return found


def open_scans(folders: Iterable[Path]) -> Scans:
    """All shards under the given folders, memory-mapped, in order of their names.

    Raises:
        ShardError: as `Scans`.
    """
    return Scans([Shard(path) for path in shards_in(list(folders))])


@dataclass(frozen=True)
class Augmentation:
    """What is changed in a scan each time its images are seen, exactly in the poses or without touching them.

    What shards of features hold was changed when they were made, and is not changed again.
    """

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
        augmentation: None for the scans as they are. Maps of a backbone are taken as they are always.

    Raises:
        ShardError: There are scans of fewer views.
    """
    if views > scans.views:
        text = f"there are scans of {scans.views} views, and {views} were to be drawn; render scans of more."
        raise ShardError(text)
    drawn = []
    for _ in range(count):
        for _ in range(DRAWS):
            row = scans.row(int(generator.integers(len(scans))))
            chosen, within = choose_views(row["camera_from_object"], views, max_angle, generator)
            if within:
                break
        row = {name: np.asarray(array[chosen]) for name, array in row.items()}
        drawn.append(
            row if augmentation is None or scans.map_shapes else augmented(row, augmentation, generator)
        )
    together = {name: np.stack([row[name] for row in drawn]) for name in drawn[0]}
    looks: Looks
    if scans.map_shapes:
        looks = [None] * min(scans.map_shapes)
        looks += [torch.from_numpy(together[MAP.format(stage)]).float() for stage in scans.map_shapes]
    else:
        looks = normalised(together["images"])
    return Batch(
        looks=looks,
        crop_parameters=torch.from_numpy(together["crop_parameters"]).float(),
        camera_from_world=together["camera_from_object"].astype(np.float64),
        places=torch.from_numpy(together["places"].astype(np.float32)),
    )


def normalised(images: npt.NDArray[Any]) -> torch.Tensor:
    """Images as the network takes them. (..., S, S, 3) uint8, or 0 to 1 -> (..., 3, S, S)."""
    scale = np.float32(255 if images.dtype == np.uint8 else 1)
    scaled = images.astype(np.float32) / scale
    scaled -= np.array(IMAGE_MEAN, np.float32)
    scaled /= np.array(IMAGE_STD, np.float32)
    return torch.from_numpy(scaled).movedim(-1, -3)


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


def augmented(
    row: Mapping[str, npt.NDArray[Any]], augmentation: Augmentation, generator: np.random.Generator
) -> dict[str, npt.NDArray[Any]]:
    """Views of a scan, changed at random: the arrays of `FIELDS`, and the images as float32 from 0 to 1."""
    sizes = row["image_sizes"]
    scan = _Scan(
        images=np.asarray(row["images"], np.float32) / np.float32(255),
        places=np.asarray(row["places"], np.float32),
        crops=np.asarray(row["crop_parameters"], np.float64),
        poses=np.asarray(row["camera_from_object"], np.float64),
        across=2 * sizes / sizes.min(-1, keepdims=True),
    )
    scan = replace(scan, images=_recolour(scan, augmentation, generator))
    if generator.random() < augmentation.mirror:
        scan = _mirror(scan)
    if generator.random() < augmentation.quarter_turns:
        for _ in range(int(generator.integers(1, 4))):
            scan = _quarter_turn(scan)
            sizes = sizes[:, ::-1]
    return {
        "images": scan.images,
        "crop_parameters": scan.crops,
        "camera_from_object": scan.poses,
        "places": scan.places,
        "image_sizes": sizes,
    }


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
