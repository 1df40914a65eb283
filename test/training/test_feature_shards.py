"""What a frozen backbone sees, kept: a trainer learns from it as from the images."""

import shutil
from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.captures.shards import new_shard
from relpose_ros.network.checkpoint import random_network
from relpose_ros.network.efficientnet import EfficientNetLite0
from relpose_ros.network.presets import PRESETS
from relpose_ros.training import trainer
from relpose_ros.training.batches import Augmentation, Scans, ShardError, make_batch, open_scans
from relpose_ros.training.feature_shards import write_feature_shards
from relpose_ros.training.objective import ObjectiveSettings, scene_features
from relpose_ros.training.trainer import Trainer, TrainingSettings


@pytest.fixture
def shards(tmp_path, fake_shard):
    """A folder of two shards of images."""
    for number in range(2):
        with new_shard(tmp_path / "shards" / f"{number:05d}") as arrays:
            arrays |= fake_shard(3, 4, 32, number)
    return tmp_path / "shards"


@torch.no_grad()
def test_kept_maps_say_what_the_images_say(shards, tiny_preset, tmp_path):
    network = random_network(tiny_preset, 0)
    assert write_feature_shards(tmp_path / "features", [shards], network, 1) == 2
    seen, kept = open_scans([shards]), open_scans([tmp_path / "features"])
    assert kept.stages == [1]
    assert (len(kept), kept.views) == (len(seen), seen.views)
    ours, theirs = (make_batch(scans, 3, 3, 180.0, np.random.default_rng(0)) for scans in (kept, seen))
    np.testing.assert_allclose(ours.camera_from_world, theirs.camera_from_world, atol=1e-6)
    np.testing.assert_array_equal(ours.places, theirs.places)
    a, b = (scene_features(network, batch.looks, batch.crop_parameters) for batch in (ours, theirs))
    # Kept in half precision.
    torch.testing.assert_close(a.tokens, b.tokens, atol=5e-3, rtol=5e-3)
    torch.testing.assert_close(a.maps, b.maps, atol=5e-3, rtol=5e-3)


def test_each_copy_is_changed_in_its_own_way_and_none_is_made_twice(shards, tiny_preset, tmp_path):
    network = random_network(tiny_preset, 0)
    folder = tmp_path / "features"
    write_feature_shards(folder, [shards], network, 2, augmentation=Augmentation())
    assert {path.name for path in folder.iterdir()} == {
        f"shards-{number}-{copy}" for number in ("00000", "00001") for copy in (0, 1)
    }
    first, second = (np.load(folder / f"shards-00000-{copy}" / "map_1.npy") for copy in (0, 1))
    assert first.dtype == np.float16
    assert not np.array_equal(first, second)
    (folder / "shards-00000-1" / "map_1.npy").unlink()
    write_feature_shards(folder, [shards], network, 2, augmentation=Augmentation())
    assert not (folder / "shards-00000-1" / "map_1.npy").exists()  # it stood already
    batch = make_batch(open_scans([folder / "shards-00000-0"]), 1, 2, 180.0, np.random.default_rng(0))
    rotations = batch.camera_from_world[0, :, :, :3]
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(-1, -2), np.eye(3)[None].repeat(2, 0), atol=1e-5
    )


def test_what_is_no_shard_of_images_is_refused(shards, tiny_preset, tmp_path, fake_shard):
    network = random_network(tiny_preset, 0)
    features = tmp_path / "features"
    with pytest.raises(ShardError, match="no shards were found"):
        write_feature_shards(features, [tmp_path / "nowhere"], network, 1)
    with pytest.raises(ShardError, match="two shards have one name"):
        write_feature_shards(
            features, [shards, shutil.copytree(shards, tmp_path / "b" / "shards")], network, 1
        )
    write_feature_shards(features, [shards], network, 1)
    with pytest.raises(ShardError, match=r"lacks images\.npy"):
        write_feature_shards(tmp_path / "again", [features], network, 1)
    with pytest.raises(ShardError, match=r"lacks map_1\.npy"):
        open_scans([features, shards])
    kept = {"map_1": np.zeros((1, 2, 8, 4, 4), np.float16), **fake_shard(1, 2, 32, 0)}
    with pytest.raises(ShardError, match=r"map_1 of .* do not mix"):
        Scans([kept, {**kept, "map_1": np.zeros((1, 2, 9, 4, 4), np.float16)}])


def test_a_pretrained_backbone_stays_as_it_was(shards, tiny_preset, tmp_path, monkeypatch):
    monkeypatch.setitem(PRESETS, "tiny", replace(tiny_preset, backbone="efficientnet_lite0"))
    public = EfficientNetLite0()
    monkeypatch.setattr(trainer, "imagenet_backbone", lambda: public)
    objective = ObjectiveSettings(uniform_rotations=16, near_rotations=8, match_weight=0.5, match_places=5)
    settings = TrainingSettings(
        preset="tiny", batch_images=8, max_views=3, pretrained_backbone=True, objective=objective
    )
    network = trainer.initial_network(settings).eval()
    write_feature_shards(tmp_path / "features", [shards], network, 1)
    run = Trainer(settings, tmp_path / "run", open_scans([tmp_path / "features"]), open_scans([shards]))
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    assert all(torch.isfinite(run.train_step()).all() for _ in range(3))
    changed = {name for name, value in run.network.state_dict().items() if not value.equal(before[name])}
    backbone = "feature_extractor.feature_extractor."
    assert "feature_extractor.descriptors.mix.weight" in changed
    assert not any(name.startswith(backbone) for name in changed)
    kept, theirs = run.average.feature_extractor.feature_extractor.state_dict(), public.state_dict()
    assert all(kept[name].equal(theirs[name]) for name in theirs)
    assert run.measure(views=2, count=2)["pair_median"] >= 0  # on images, as it will be used


def test_compact_begins_with_a_public_backbone_and_the_paper_does_not():
    assert trainer.settings_for("compact").pretrained_backbone
    assert not trainer.settings_for("paper").pretrained_backbone
