"""Shards of what a frozen backbone sees, so that a trainer without a GPU need not look at images at all.

A shard is that of `relpose_ros.captures.shards` with ``map_1.npy`` and on in the place of its images: see
`relpose_ros.training.batches.MAP`. About 45 kB an image with EfficientNet-Lite0.
"""

from __future__ import annotations

import zlib
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from relpose_ros.captures.shards import new_shard, read_shard, shard_folders
from relpose_ros.training.batches import FIELDS, MAP, ShardError, augmented, normalised

if TYPE_CHECKING:
    from collections.abc import Iterable
    from pathlib import Path

    from relpose_ros.network.relpose import RelPose
    from relpose_ros.training.batches import Augmentation


@torch.no_grad()
def write_feature_shards(
    folder: Path,
    sources: Iterable[Path],
    network: RelPose,
    copies: int,
    *,
    augmentation: Augmentation | None = None,
    seed: int = 0,
) -> int:
    """Write ``copies`` shards of each shard, with a progress bar; those that stand already are left alone.

    Args:
        folder: Gets a sub-folder for each.
        sources: Folders of shards of images.
        network: Whose backbone looks, and whose other parts say which stages' maps are read.
        copies: How often each scan is changed at random and looked at.
        augmentation: How; None for the scans as they are.
        seed: Of the changes, together with the shard's name.

    Returns:
        How many there are.

    Raises:
        ShardError: There are no shards of images there, or two of one name.
    """
    descriptors = network.feature_extractor.descriptors
    backbone = network.feature_extractor.feature_extractor
    first = len(backbone.widths) - 1 if descriptors is None else descriptors.stage
    wanted = [
        (f"{path.parent.name}-{path.name}-{copy}", path)
        for copy in range(copies)
        for path in shard_folders(sources)
    ]
    if not wanted or len({name for name, _ in wanted}) < len(wanted):
        text = "no shards were found." if not wanted else "two shards have one name; rename a folder."
        raise ShardError(text)
    for name, path in tqdm(wanted, unit="shard"):
        if (folder / name).exists():
            continue
        source = read_shard(path)
        if missing := [field for field in ("images", *FIELDS) if field not in source]:
            text = f"{path} lacks {missing[0]}.npy; render it again."
            raise ShardError(text)
        generator = np.random.default_rng(zlib.crc32(f"{seed} {name}".encode()))
        rows = []
        for number in range(len(source["images"])):
            row = {field: np.asarray(source[field][number]) for field in ("images", *FIELDS)}
            if augmentation is not None:
                row = augmented(row, augmentation, generator)
            maps = backbone.stage_maps(normalised(row.pop("images")))
            for stage in range(first, len(maps)):
                row[MAP.format(stage)] = maps[stage].half().numpy()
            rows.append(row)
        with new_shard(folder / name) as arrays:
            for field in rows[0]:
                kept = np.stack([row[field] for row in rows])
                small = kept.dtype == np.float64
                arrays[field] = kept.astype(np.float32) if small else kept
            arrays["places"] = arrays["places"].astype(np.float16)
    return len(wanted)
