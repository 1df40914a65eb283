"""Batches: views within their angle, and augmentations under which a scan stays true to its poses."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.captures import shards
from relpose_ros.captures.shards import ShardError, new_shard
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import look_at
from relpose_ros.training import batches
from relpose_ros.training.batches import Augmentation, Scans

seeds = st.integers(0, 2**32 - 1)
SIZE, WIDTH, HEIGHT = 32, 64, 48


def true_scan(seed, views=3):
    """Views of a sphere whose ``places`` are the object points that each cell of the crop shows."""
    generator = np.random.default_rng(seed)
    directions = generator.normal(size=(views, 3))
    centres = 4 * directions / np.linalg.norm(directions, axis=1, keepdims=True)
    rotation = look_at(centres, generator.normal(0, 0.3, (views, 3)), generator.normal(size=3))
    translation = -np.einsum("nij,nj->ni", rotation, centres)
    crops = np.column_stack(
        [generator.integers(5, 20, (views, 2)), generator.integers(20, 30, views)]
    ).astype(float)
    focal = 50.0
    cells = SIZE // 8
    ticks = (np.arange(cells) + 0.5) / cells
    places = np.full((views, cells, cells, 3), np.nan, np.float32)
    for n in range(views):
        u = crops[n, 0] + ticks[None, :] * crops[n, 2] + np.zeros((cells, 1))
        v = crops[n, 1] + ticks[:, None] * crops[n, 2] + np.zeros((1, cells))
        ray = np.stack([(u - WIDTH / 2) / focal, (v - HEIGHT / 2) / focal, np.ones_like(u)], -1)
        ray /= np.linalg.norm(ray, axis=-1, keepdims=True)
        ray = ray @ rotation[n]
        b = ray @ centres[n]
        inside = b**2 - (centres[n] @ centres[n] - 1)
        hit = centres[n] + (-b - np.sqrt(np.maximum(inside, 0)))[..., None] * ray
        places[n] = np.where((inside > 0)[..., None], hit, np.nan)
    half = min(WIDTH, HEIGHT) / 2
    parameters = np.column_stack([1 - (crops[:, :2] + crops[:, 2:] / 2) / half, crops[:, 2] / half])
    return batches._Scan(
        images=generator.random((views, SIZE, SIZE, 3), np.float32),
        places=places,
        crops=parameters,
        poses=np.concatenate([rotation, translation[..., None]], -1),
        across=np.tile([WIDTH / half, HEIGHT / half], (views, 1)),
    )


def worst_miss(scan):
    """Pixels of the full image between where the places project and the centres of their cells."""
    half = min(WIDTH, HEIGHT) / 2
    cells = SIZE // 8
    ticks = (np.arange(cells) + 0.5) / cells
    worst, seen = 0.0, 0
    for n in range(len(scan.poses)):
        side = scan.crops[n, 2] * half
        left, top = (1 - scan.crops[n, :2]) * half - side / 2
        local = scan.places[n].astype(float) @ scan.poses[n, :, :3].T + scan.poses[n, :, 3]
        u = 50 * local[..., 0] / local[..., 2] + scan.across[n, 0] * half / 2
        v = 50 * local[..., 1] / local[..., 2] + scan.across[n, 1] * half / 2
        miss = np.hypot(u - (left + ticks[None, :] * side), v - (top + ticks[:, None] * side))
        assert np.allclose(so3.project(scan.poses[n, :, :3]), scan.poses[n, :, :3])
        worst, seen = max(worst, np.nanmax(miss, initial=0.0)), seen + int(np.isfinite(miss).sum())
    assert seen > 0
    return worst


@given(seeds)
@settings(max_examples=15, deadline=None)
def test_mirrored_and_turned_scans_still_show_what_their_poses_say(seed):
    scan = true_scan(seed)
    assert worst_miss(scan) < 1e-3
    mirrored = batches._mirror(scan)
    assert worst_miss(mirrored) < 1e-3
    turned = batches._quarter_turn(scan)
    assert worst_miss(turned) < 1e-3
    assert worst_miss(batches._quarter_turn(batches._mirror(turned))) < 1e-3


@given(seeds)
@settings(max_examples=10, deadline=None)
def test_two_mirrors_and_four_turns_are_nothing(seed):
    scan = true_scan(seed)
    twice = batches._mirror(batches._mirror(scan))
    round_about = scan
    for _ in range(4):
        round_about = batches._quarter_turn(round_about)
    for other in (twice, round_about):
        np.testing.assert_array_equal(other.images, scan.images)
        np.testing.assert_allclose(other.poses, scan.poses, atol=1e-12)
        np.testing.assert_allclose(other.crops, scan.crops, atol=1e-12)
    assert not np.array_equal(batches._mirror(scan).images, scan.images)


@given(seeds, st.integers(2, 8), st.floats(1, 180))
@settings(max_examples=40, deadline=None)
def test_views_are_distinct_and_as_near_as_asked_where_there_are_enough(seed, count, angle):
    generator = np.random.default_rng(seed)
    rotations = so3.random_rotations(10, generator)
    poses = np.concatenate([rotations, np.zeros((10, 3, 1))], -1)
    chosen, within = batches.choose_views(poses, count, angle, generator)
    assert len(set(chosen)) == count
    axes = rotations[:, 2]
    between = np.degrees(np.arccos(np.clip(axes @ axes.T, -1, 1)))
    # Some view has all the others within the angle, or as many nearest ones as were asked for.
    fits, limits = [], []
    for anchor in chosen:
        others = [between[anchor, k] for k in chosen if k != anchor]
        limit = max(angle, np.sort(between[anchor])[count - 1]) + 1e-6
        fits.append(max(others) <= limit)
        limits.append(max(others) <= angle + 1e-6)
    assert any(fits)
    assert not within or any(limits)


def test_scans_of_too_few_views_are_refused_in_a_sentence(fake_shard):
    scans = Scans([fake_shard(1, 5, SIZE, 0), fake_shard(1, 4, SIZE, 1)])
    batches.make_batch(scans, 2, 4, 180.0, np.random.default_rng(0))
    with pytest.raises(ShardError, match="scans of 4 views, and 5 were to be drawn"):
        batches.make_batch(scans, 2, 5, 180.0, np.random.default_rng(0))


def test_a_batch_is_the_same_for_the_same_seed_and_another_for_another(fake_shard):
    scans = Scans([fake_shard(4, 6, 32, 0), fake_shard(3, 5, 32, 1)])
    assert len(scans) == 7
    draw = [
        batches.make_batch(scans, 5, 3, 90.0, np.random.default_rng(seed), Augmentation())
        for seed in (1, 1, 2)
    ]
    assert draw[0].looks.shape == (5, 3, 3, 32, 32)
    assert draw[0].looks.equal(draw[1].looks)
    assert (draw[0].camera_from_world == draw[1].camera_from_world).all()
    assert not draw[0].looks.equal(draw[2].looks)


@pytest.mark.skipif(not Path("/proc/self/maps").exists(), reason="open files are counted on Linux alone")
def test_more_shards_are_read_than_files_can_be_open(fake_shard, tmp_path):
    shard = fake_shard(1, 2, 8, 0)
    for number in range(150):
        with new_shard(tmp_path / f"{number:03d}", {}) as arrays:
            arrays |= shard | {"image_sizes": shard["image_sizes"] + number}
    scans = batches.open_scans([tmp_path])
    assert len(scans) == 150
    assert scans.views == 2
    for number in (*range(150), 0):
        expected = shard["image_sizes"][0] + number
        np.testing.assert_array_equal(scans.row(number)["image_sizes"], expected)
    opened = Path("/proc/self/maps").read_text().count(str(tmp_path))
    assert 0 < opened <= shards._MAX_OPEN < 150 * 5


def test_rows_come_from_the_right_shard(fake_shard):
    shards = [fake_shard(count, 4, 32, seed) for seed, count in enumerate((2, 3, 1))]
    scans = Scans(shards)
    flat = [image for shard in shards for image in shard["images"]]
    for index, images in enumerate(flat):
        np.testing.assert_array_equal(scans.row(index)["images"], images)


def test_the_masked_variant_is_white_off_the_object_and_the_border_stays_black():
    scan = true_scan(3)
    scan.images[:, :, :4] = 0
    masked = batches._recolour(scan, Augmentation(masked=1.0, noisy=1.0), np.random.default_rng(0))
    off = np.kron(~np.isfinite(scan.places[..., 0]), np.ones((1, 8, 8), bool))
    inner = np.zeros_like(off)
    inner[:, 12:20, 12:20] = True
    assert (masked[off & ~inner] == 1).mean() > 0.7
    bare = batches._recolour(scan, Augmentation(masked=0.0, noisy=1.0), np.random.default_rng(0))
    assert (bare[:, :, :4] == 0).all()
    assert (bare[:, :, 4:] > 0).mean() > 0.9


def test_shards_that_do_not_fit_are_refused(tmp_path, fake_shard):
    with pytest.raises(ShardError, match="no shards"):
        Scans([])
    with pytest.raises(ShardError, match="no shards"):
        batches.open_scans([tmp_path])
    with pytest.raises(ShardError, match="do not mix"):
        Scans([fake_shard(1, 2, 32, 0), fake_shard(1, 2, 16, 0)])
    lacking = fake_shard(1, 2, 32, 0)
    del lacking["places"]
    with pytest.raises(ShardError, match=r"places\.npy"):
        Scans([lacking])
