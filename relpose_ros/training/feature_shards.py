"""Shards of what a frozen backbone sees, so that a trainer without a GPU need not look at images at all.

A shard holds of those of `relpose_ros.captures.shards` what training reads, with ``map_1.npy`` and on in the
place of the images: see `relpose_ros.training.batches.MAP`. About 45 kB an image with EfficientNet-Lite0.
"""

from __future__ import annotations

import zlib
from collections import Counter
from dataclasses import asdict
from typing import TYPE_CHECKING

import numpy as np
import torch
from tqdm import tqdm

from relpose_ros.captures.shards import Shard, ShardError, new_shard, read_plan, stands
from relpose_ros.training.batches import FIELDS, MAP, augmented, normalised, shards_in

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
        folder: Gets a sub-folder for each. Changes and seed must be the same when it is continued.
        sources: Folders of shards of images.
        network: Whose backbone looks, and whose other parts say which stages' maps are read.
        copies: How often each scan is changed at random and looked at.
        augmentation: How; None for the scans as they are.
        seed: Of the changes, together with the shard's name.

    Returns:
        How many there are.

    Raises:
        ShardError: There are no shards of images of the network's size there, two have one name, no copies
            or several alike are asked for, or what stands in the folder was made otherwise.
    """
    if copies < 1 or (copies > 1 and augmentation is None):
        text = f"{copies} copies cannot be made; ask for 1 or more, and for 1 of scans as they are."
        raise ShardError(text)
    shards = shards_in([source.resolve() for source in sources])
    wanted = [(f"{path.parent.name}-{path.name}-{copy}", path) for copy in range(copies) for path in shards]
    names = Counter(name for name, _ in wanted)
    if doubled := [path for name, path in wanted if names[name] > 1]:
        text = f"{doubled[0]} and {doubled[1]} would have one name; rename the folder above one of them."
        raise ShardError(text)
    made = {
        "made": "features",
        "network": network.preset.name,
        "augmentation": None if augmentation is None else asdict(augmentation),
        "seed": seed,
    }
    for name, path in tqdm(wanted, unit="shard"):
        of_source = {f"source's {name}": value for name, value in (read_plan(path) or {}).items()}
        plan = {**made, **of_source}
        if stands(folder / name, plan):
            continue
        source = _images_for(network, path)
        generator = np.random.default_rng(zlib.crc32(f"{seed} {name}".encode()))
        rows = []
        for number in range(len(source["images"])):
            row = {field: np.asarray(source[field][number]) for field in ("images", *FIELDS)}
            if augmentation is not None:
                row = augmented(row, augmentation, generator)
            images = normalised(row.pop("images")).to(network.device)
            maps = network.feature_extractor.feature_extractor.stage_maps(images)
            for stage in network.feature_extractor.summarised_shapes:
                row[MAP.format(stage)] = maps[stage].half().cpu().numpy()
            rows.append(row)
        with new_shard(folder / name, plan) as arrays:
            for field in rows[0]:
                arrays[field] = np.stack([row[field] for row in rows])
            arrays["places"] = arrays["places"].astype(np.float16)
    return len(wanted)


def _images_for(network: RelPose, path: Path) -> Shard:
    source = Shard(path)
    if missing := [field for field in ("images", *FIELDS) if field not in source]:
        text = f"{path} has no {missing[0]}.npy: it is no shard of images; name those that it was made of."
        raise ShardError(text)
    side, wanted = source["images"].shape[2], network.preset.image_size
    if side != wanted:
        text = (
            f"{path} has images of {side} pixels, and '{network.preset.name}' looks at {wanted}; "
            f"render or cut them with that size."
        )
        raise ShardError(text)
    return source
