"""What a frozen backbone sees, kept: a trainer learns from it as from the images."""

import shutil
import zlib
from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros import cli
from relpose_ros.captures.shards import Shard, ShardError, new_shard
from relpose_ros.network.checkpoint import load_network, random_network, write_network
from relpose_ros.network.efficientnet import EfficientNetLite0
from relpose_ros.network.presets import PRESETS
from relpose_ros.network.relpose import NetworkUseError
from relpose_ros.training import settings as training_settings
from relpose_ros.training.batches import (
    Augmentation,
    Scans,
    augmented,
    make_batch,
    normalised,
    open_scans,
)
from relpose_ros.training.feature_shards import write_feature_shards
from relpose_ros.training.imagenet import imagenet_backbone
from relpose_ros.training.objective import ObjectiveSettings, scene_features
from relpose_ros.training.settings import TrainingError, TrainingSettings, initial_network, settings_for
from relpose_ros.training.trainer import Trainer


@pytest.fixture
def shards(tmp_path, fake_shard):
    """A folder of two shards of images."""
    for number in range(2):
        with new_shard(tmp_path / "shards" / f"{number:05d}", {}) as arrays:
            arrays |= fake_shard(3, 4, 32, number)
    return tmp_path / "shards"


@torch.no_grad()
def test_kept_maps_say_what_the_images_say(shards, tiny_preset, tmp_path):
    network = random_network(tiny_preset, 0)
    assert write_feature_shards(tmp_path / "features", [shards], network, 1) == 2
    seen, kept = open_scans([shards]), open_scans([tmp_path / "features"])
    assert kept.map_shapes == {1: (64, 4, 4)}
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
    with pytest.raises(ShardError, match="shards-00000-0 was made with seed 0, not 5"):
        write_feature_shards(folder, [shards], network, 2, augmentation=Augmentation(), seed=5)
    with pytest.raises(ShardError, match=r"shards-00000-0 was made with augmentation .*, not None"):
        write_feature_shards(folder, [shards], network, 1)
    batch = make_batch(open_scans([folder / "shards-00000-0"]), 1, 2, 180.0, np.random.default_rng(0))
    rotations = batch.camera_from_world[0, :, :, :3]
    np.testing.assert_allclose(
        rotations @ rotations.swapaxes(-1, -2), np.eye(3)[None].repeat(2, 0), atol=1e-5
    )


def test_what_is_no_shard_of_images_is_refused(shards, tiny_preset, tmp_path, fake_shard):
    network = random_network(tiny_preset, 0)
    features = tmp_path / "features"
    with pytest.raises(ShardError, match=r"no shards in .*nowhere; make some"):
        write_feature_shards(features, [tmp_path / "nowhere"], network, 1)
    with pytest.raises(ShardError, match=r"shards/0000[01] would have one name"):
        write_feature_shards(
            features, [shards, shutil.copytree(shards, tmp_path / "b" / "shards")], network, 1
        )
    write_feature_shards(features, [shards], network, 1)
    with pytest.raises(ShardError, match=r"no images\.npy: it is no shard of images"):
        write_feature_shards(tmp_path / "again", [features], network, 1)
    for mixed in ([features, shards], [shards, features]):
        with pytest.raises(ShardError, match="images and of features do not mix"):
            open_scans(mixed)
    for copies, how in ((0, Augmentation()), (2, None)):
        with pytest.raises(ShardError, match=f"{copies} copies cannot be made"):
            write_feature_shards(features, [shards], network, copies, augmentation=how)
    large = random_network(replace(tiny_preset, image_size=64), 0)
    with pytest.raises(ShardError, match=r"images of 32 pixels, and 'tiny' looks at 64"):
        write_feature_shards(tmp_path / "large", [shards], large, 1)
    kept = {"map_1": np.zeros((1, 2, 8, 4, 4), np.float16), **fake_shard(1, 2, 32, 0)}
    del kept["images"]
    with pytest.raises(ShardError, match=r"map_1 of .* do not mix"):
        Scans([kept, {**kept, "map_1": np.zeros((1, 2, 9, 4, 4), np.float16)}])


@pytest.fixture
def frozen(tiny_preset, monkeypatch):
    """Settings of a run whose backbone is EfficientNet-Lite0, with weights that stand for the public ones."""
    monkeypatch.setitem(PRESETS, "tiny", replace(tiny_preset, backbone="efficientnet_lite0"))
    with torch.random.fork_rng():
        torch.manual_seed(1)
        public = EfficientNetLite0()
    monkeypatch.setattr(training_settings, "imagenet_backbone", lambda: public)
    objective = ObjectiveSettings(uniform_rotations=16, near_rotations=8, match_weight=0.5, match_places=5)
    return TrainingSettings(
        preset="tiny", batch_images=8, max_views=3, precision="float32", objective=objective
    )


@torch.no_grad()
def test_copies_are_what_the_changed_images_show(shards, frozen, tmp_path):
    network = initial_network(frozen)
    write_feature_shards(tmp_path / "features", [shards], network, 1, augmentation=Augmentation(), seed=3)
    generator = np.random.default_rng(zlib.crc32(b"3 shards-00001-0"))
    source, kept = Shard(shards / "00001"), Shard(tmp_path / "features" / "shards-00001-0")
    sizes = set()
    for number in range(3):
        row = augmented({name: source[name][number] for name in source}, Augmentation(), generator)
        maps = network.feature_extractor.feature_extractor.stage_maps(normalised(row["images"]))
        for stage in (1, 2, 3):
            expected = maps[stage].half().numpy()
            np.testing.assert_array_equal(kept[f"map_{stage}"][number], expected)
        np.testing.assert_array_equal(kept["camera_from_object"][number], row["camera_from_object"])
        np.testing.assert_array_equal(kept["places"][number], row["places"].astype(np.float16))
        sizes.add(tuple(kept["image_sizes"][number][0]))
    assert "map_0" not in kept
    assert sizes <= {(640, 480), (480, 640)}


def test_a_pretrained_backbone_stays_as_it_was(shards, frozen, tmp_path):
    public = training_settings.imagenet_backbone().state_dict()
    write_feature_shards(tmp_path / "features", [shards], initial_network(frozen), 1)
    features = open_scans([tmp_path / "features"])
    run = Trainer(frozen, tmp_path / "run", features, open_scans([shards]))
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    assert all(torch.isfinite(run.train_step()).all() for _ in range(3))
    changed = {name for name, value in run.network.state_dict().items() if not value.equal(before[name])}
    assert "feature_extractor.descriptors.mix.weight" in changed
    assert not any(name.startswith("feature_extractor.feature_extractor.") for name in changed)
    assert run.measure(views=2, count=2)["pair_median"] >= 0  # on images, as it will be used
    run.save()

    # What goes on has it too, and so has what begins with weights stored in half precision.
    half = tmp_path / "half.safetensors"
    write_network(run.average, half, {"images_seen": "5"}, half=True)
    again = Trainer(frozen, tmp_path / "run", features)
    begun = Trainer(frozen, tmp_path / "begun", features, start_from=half)
    assert begun.images == 5
    for network in (run.average, again.network, again.average, begun.network, begun.average):
        kept = network.feature_extractor.feature_extractor.state_dict()
        assert all(kept[name].equal(public[name]) for name in public)
    again.train_step()


def test_a_pretrained_backbone_can_be_trained_from_its_first_map_on(shards, frozen, tmp_path):
    public = training_settings.imagenet_backbone().state_dict()
    write_feature_shards(tmp_path / "features", [shards], initial_network(frozen), 1)
    features = open_scans([tmp_path / "features"])
    settings = replace(frozen, backbone_rate=0.25, warmup_images=0, decay=0.0)
    run = Trainer(settings, tmp_path / "run", features, features)
    before = {name: value.clone() for name, value in run.network.state_dict().items()}
    run.train_step()
    backbone = "feature_extractor.feature_extractor."
    steps = {name: (value - before[name]).abs().max() for name, value in run.network.state_dict().items()}
    own = {name.removeprefix(backbone): step for name, step in steps.items() if name.startswith(backbone)}
    # Map 1 leaves stage 2: before it, and between channels of their own, nothing moves.
    moved = {name for name, step in own.items() if step > 0}
    behind = tuple(f"stages.{stage}." for stage in range(3, 7))
    assert moved <= {name for name in own if name.startswith(behind) and "depthwise" not in name}
    assert {"stages.3.0.expand.weight", "stages.6.0.project.weight", "stages.6.0.project.bias"} <= moved
    # The first step of Adam is as long as the learning rate.
    assert max(own.values()) == pytest.approx(0.25 * settings.learning_rate, rel=1e-2)
    assert steps["feature_extractor.descriptors.mix.weight"] == pytest.approx(
        settings.learning_rate, rel=2e-2
    )
    assert run.measure(views=2, count=2)["pair_median"] >= 0
    run.save()

    again = Trainer(settings, tmp_path / "run", features)
    for one, other in zip(again.network.parameters(), run.network.parameters(), strict=True):
        assert one.equal(other)
    again.train_step()
    # Weights that begin another run keep what was trained, and the rest in full precision.
    half = tmp_path / "half.safetensors"
    write_network(run.network, half, {"images_seen": "5"}, half=True)
    begun = Trainer(settings, tmp_path / "begun", features, start_from=half).network.state_dict()
    for name in own:
        stored = run.network.state_dict()[backbone + name].half().float()
        assert begun[backbone + name].equal(stored if name in moved else public[name])


def test_the_command_trains_on_features_with_and_without_the_backbone(fake_shard, tmp_path):
    with new_shard(tmp_path / "shards" / "00000", {}) as arrays:
        arrays |= fake_shard(1, 8, 128, 0)
    features, public = tmp_path / "features", imagenet_backbone().state_dict()
    assert cli.main(["features", str(tmp_path / "shards"), "--output", str(features), "--plain"]) == 0
    for name, options in (("frozen", []), ("trained", ["--backbone-rate", "0.3"])):
        command = ["train", str(tmp_path / name), "--scans", str(features), "--images", "1", *options]
        assert cli.main(command) == 0
        backbone = load_network(tmp_path / name / "weights.safetensors").feature_extractor.feature_extractor
        changed = {layer for layer, value in backbone.state_dict().items() if not value.equal(public[layer])}
        assert ("stages.5.0.expand.weight" in changed) == (name == "trained")
        assert "stages.2.0.expand.weight" not in changed


def test_maps_behind_the_first_are_worked_out_where_they_are_missing(shards, frozen):
    network = initial_network(frozen)
    images = normalised(Shard(shards / "00000")["images"][0])
    maps = network.feature_extractor.feature_extractor.stage_maps(images)
    with torch.no_grad():
        seen, given = network.look(images), network.summarise([None, maps[1]])
    torch.testing.assert_close(given.pooled, seen.pooled)
    torch.testing.assert_close(given.maps, seen.maps)
    with pytest.raises(NetworkUseError, match=r"maps \(112, 2, 2\) of stage 2; it was given none"):
        network.summarise([None, maps[1], None])


def test_where_a_backbone_was_trained_is_not_forgotten(shards, frozen, tiny_preset, tmp_path, monkeypatch):
    write_feature_shards(tmp_path / "features", [shards], initial_network(frozen), 1)
    features = open_scans([tmp_path / "features"])
    settings = replace(frozen, backbone_rate=0.5)
    run = Trainer(settings, tmp_path / "run", features)
    run.train_step()
    run.save()
    weights = tmp_path / "run" / "weights.safetensors"
    with pytest.raises(TrainingError, match=r"is of a run whose backbone was trained; name another folder"):
        Trainer(frozen, tmp_path / "run", features)
    with pytest.raises(TrainingError, match="was trained, and the shards hold what it saw before"):
        Trainer(frozen, tmp_path / "begun", features, start_from=weights)
    with pytest.raises(TrainingError, match="was trained, and the shards hold what it saw before"):
        Trainer(frozen, tmp_path / "begun", open_scans([shards]), features, start_from=weights)
    assert Trainer(frozen, tmp_path / "begun", open_scans([shards]), start_from=weights).images == run.images
    monkeypatch.setitem(PRESETS, "tiny", tiny_preset)
    with pytest.raises(TrainingError, match="'tiny' has no pretrained layers behind what it reads"):
        Trainer(settings, tmp_path / "residual", open_scans([shards]))


def test_features_of_another_backbone_are_refused(shards, frozen, tiny_preset, tmp_path, monkeypatch):
    write_feature_shards(tmp_path / "features", [shards], initial_network(frozen), 1)
    features = open_scans([tmp_path / "features"])
    monkeypatch.setitem(PRESETS, "tiny", tiny_preset)
    with pytest.raises(TrainingError, match="features of another backbone than that of 'tiny'"):
        Trainer(frozen, tmp_path / "run", features)
    own = random_network(tiny_preset, 0)
    write_feature_shards(tmp_path / "own", [shards], own, 1)
    with pytest.raises(TrainingError, match="features of another backbone"):
        # It would be trained on, and never looked with.
        Trainer(frozen, tmp_path / "run", open_scans([shards]), open_scans([tmp_path / "own"]))
    with pytest.raises(NetworkUseError, match=r"takes maps \(64, 4, 4\) of stage 1; it was given none"):
        own.summarise([None, None])


def test_compact_has_a_pretrained_backbone_and_the_paper_has_not():
    assert settings_for("compact").pretrained_backbone
    assert not settings_for("paper").pretrained_backbone
