"""Real captures as shards, so that a trainer reads photographs and renderings alike."""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from tqdm import tqdm

from relpose_ros.captures.scans import PLACE_STRIDE
from relpose_ros.captures.shards import new_shard, stands
from relpose_ros.errors import RelPoseError
from relpose_ros.network.crops import IMAGE_MEAN, IMAGE_STD, crop_view

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.captures.folder import Capture
    from relpose_ros.network.presets import Preset

CROP_SCALES = (1.1, 1.2)
"""Side of a training crop in sides of the box (RelPose++, section 4)."""
CROP_SHIFT = 0.07
"""Largest shift of a training crop, in sides of the box."""


class CaptureShardError(RelPoseError):
    """A capture cannot be learned from."""


def capture_shard(
    capture: Capture, preset: Preset, copies: int, *, masked_copies: int = 0, seed: int = 0
) -> dict[str, npt.NDArray[Any]]:
    """The photos of a capture whose pose is known, cropped several times with other jitter.

    Args:
        capture: Of a folder, or of CO3D.
        preset: Says how large a crop is, and how it is filtered.
        copies: Scans of the shard; each holds all photos.
        masked_copies: How many of them show the object alone, where the capture has masks.
        seed: Of the jitter.

    Returns:
        The arrays of a shard (see `relpose_ros.captures.shards`) that training reads; nothing is known
        of what each place of the object looks like, so ``places`` is nan.

    Raises:
        CaptureShardError: Fewer than two photos have a pose.
    """
    known = [k for k, photo in enumerate(capture.photos) if photo.camera_from_world is not None]
    if len(known) < 2:
        text = f"{capture.folder} has {len(known)} photos with a pose; at least 2 are needed to learn from."
        raise CaptureShardError(text)
    generator = np.random.default_rng(seed)
    size, cells = preset.image_size, preset.image_size // PLACE_STRIDE
    mean, std = torch.tensor(IMAGE_MEAN)[:, None, None], torch.tensor(IMAGE_STD)[:, None, None]
    images = np.empty((copies, len(known), size, size, 3), np.uint8)
    parameters = np.empty((copies, len(known), 3), np.float32)
    for column, k in enumerate(known):
        views = {masked: capture.view(k, masked=masked) for masked in {False, masked_copies > 0}}
        for copy in range(copies):
            shift = generator.uniform(-CROP_SHIFT, CROP_SHIFT, 2)
            image, parameters[copy, column] = crop_view(
                views[copy < masked_copies],
                preset,
                float(generator.uniform(*CROP_SCALES)),
                (float(shift[0]), float(shift[1])),
            )
            pixels = ((image * std + mean) * 255).round().clamp(0, 255)
            images[copy, column] = pixels.byte().movedim(0, -1).numpy()
    poses = np.stack([pose for photo in capture.photos if (pose := photo.camera_from_world) is not None])
    sizes = np.array([(capture.photos[k].width, capture.photos[k].height) for k in known], np.int32)
    return {
        "images": images,
        "crop_parameters": parameters,
        "camera_from_object": np.tile(poses, (copies, 1, 1, 1)),
        "places": np.full((copies, len(known), cells, cells, 3), np.nan, np.float16),
        "image_sizes": np.tile(sizes, (copies, 1, 1)),
    }


def write_capture_shards(
    folder: Path,
    captures: Iterable[Capture],
    preset: Preset,
    copies: int,
    *,
    masked_copies: int = 0,
    seed: int = 0,
) -> int:
    """Write a shard of each capture, with a progress bar; those that stand already are left as they are.

    Args:
        folder: Gets a sub-folder per capture, named as it is.
        captures: Read one after the other. Their names draw the jitter, together with the seed.
        preset: See `capture_shard`, like the rest.
        copies: Of each photo.
        masked_copies: How many of them show the object alone.
        seed: Of the jitter.

    Returns:
        How many captures there were.

    Raises:
        CaptureShardError: There are no copies to make, or two captures have one name.
        ShardError: A shard that stands there was made otherwise, or none can be written.
    """
    if copies < 1 or not 0 <= masked_copies <= copies:
        text = f"{copies} copies, {masked_copies} of them masked, cannot be made; ask for 1 or more."
        raise CaptureShardError(text)
    plan = {
        "made": "photographs",
        "preset": preset.name,
        "image_size": preset.image_size,
        "copies": copies,
        "masked_copies": masked_copies,
        "seed": seed,
    }
    written: set[str] = set()
    for capture in tqdm(captures, unit="capture"):
        if capture.name in written:
            text = f"two captures are called {capture.name}; rename the folder of one, {capture.folder}."
            raise CaptureShardError(text)
        written.add(capture.name)
        if stands(folder / capture.name, plan):
            continue
        own_seed = zlib.crc32(f"{seed} {capture.name}".encode())
        with new_shard(folder / capture.name, plan) as arrays:
            arrays |= capture_shard(capture, preset, copies, masked_copies=masked_copies, seed=own_seed)
    return len(written)
