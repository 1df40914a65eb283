"""Rendered scans and shards: the same for the same seed, and true to what is written beside them."""

from __future__ import annotations

import multiprocessing
import threading
import time
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from relpose_ros.captures.renderer import Renderer, RenderError
from relpose_ros.captures.scans import PLACE_STRIDE, ScanRenderer
from relpose_ros.captures.shards import Shard, ShardError, ShardPlan, write_shards
from relpose_ros.network.crops import crop_parameters

if TYPE_CHECKING:
    from pathlib import Path


SIZE = 64


@pytest.fixture(scope="module")
def scans(renderer: Renderer) -> ScanRenderer:
    del renderer  # only to skip where nothing can be drawn
    return ScanRenderer(3, SIZE)


def test_shapes_and_types(scans: ScanRenderer) -> None:
    scan = scans.scan(0, 4)
    cells = SIZE // PLACE_STRIDE
    assert scan.images.shape == (4, SIZE, SIZE, 3)
    assert scan.images.dtype == np.uint8
    assert scan.coverage.shape == (4, SIZE, SIZE)
    assert scan.places.shape == (4, cells, cells, 3)
    assert scan.camera_from_object.shape == (4, 3, 4)
    rotations = scan.camera_from_object[..., :3]
    assert np.allclose(rotations @ rotations.swapaxes(1, 2), np.eye(3))
    assert np.allclose(np.linalg.det(rotations), 1)


def test_a_scan_depends_on_seed_and_index_alone(scans: ScanRenderer) -> None:
    first = scans.scan(5, 3)
    scans.scan(6, 3)
    again = scans.scan(5, 3)
    assert np.array_equal(first.images, again.images)
    assert np.array_equal(first.places, again.places, equal_nan=True)
    assert not np.array_equal(first.images, ScanRenderer(4, SIZE).scan(5, 3).images)


def test_crop_parameters_are_those_of_the_network(scans: ScanRenderer) -> None:
    scan = scans.scan(7, 3)
    for crop, size, told in zip(scan.crops, scan.image_sizes, scan.crop_parameters, strict=True):
        assert np.allclose(crop_parameters(*crop.tolist(), *size.tolist()), told)


def test_an_odd_size_is_told(renderer: Renderer) -> None:
    del renderer
    with pytest.raises(RenderError, match="100 pixels"):
        ScanRenderer(0, 100)


def test_objects_are_in_their_crops(scans: ScanRenderer) -> None:
    shares = np.concatenate([(scans.scan(k, 3).coverage > 127).mean((1, 2)) for k in range(8, 14)])
    assert (shares > 0).all()
    assert np.median(shares) > 0.15


def test_shards_are_continued_though_a_process_dies(scans: ScanRenderer, tmp_path: Path) -> None:
    plan = ShardPlan(seed=3, scans=2, views=3, image_size=SIZE)
    write_shards(tmp_path, 1, plan)
    before = (tmp_path / "00000/images.npy").stat().st_mtime_ns

    def kill_one() -> None:
        while not list(tmp_path.glob("*.unfinished")):
            time.sleep(0.01)
        multiprocessing.active_children()[0].kill()

    killer = threading.Thread(target=kill_one)
    killer.start()
    write_shards(tmp_path, 2, plan)
    killer.join()
    assert (tmp_path / "00000/images.npy").stat().st_mtime_ns == before
    assert sorted(path.name for path in tmp_path.iterdir()) == ["00000", "00001"]
    with pytest.raises(ShardError, match="00000 was made with views 3, not 4: name another folder"):
        write_shards(tmp_path, 2, replace(plan, views=4))
    shard = Shard(tmp_path / "00001")
    for row in range(2):
        scan = scans.scan(2 + row, 3)
        assert np.array_equal(shard["images"][row], scan.images)
        assert np.allclose(shard["camera_from_object"][row], scan.camera_from_object)
        masks = np.unpackbits(shard["masks"][row], axis=-1).astype(bool)
        assert np.array_equal(masks, scan.coverage >= 128)
        assert shard["names"][row] == scan.name
