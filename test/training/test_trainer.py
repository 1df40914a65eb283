"""The loop: it learns, resumes to the same weights, stops in time, and its checkpoints survive being cut."""

import contextlib
import csv
import os
import pickle
import signal
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.network.checkpoint import load_network, random_network, read_metadata, write_network
from relpose_ros.network.presets import PRESETS, VARIANTS, PresetError
from relpose_ros.training import checkpoints, trainer
from relpose_ros.training.batches import Augmentation, Scans
from relpose_ros.training.objective import ObjectiveSettings
from relpose_ros.training.pair_accuracy import ACCURACIES, pair_accuracy
from relpose_ros.training.settings import TrainingError, TrainingSettings, settings_for
from relpose_ros.training.trainer import Trainer

pytestmark = pytest.mark.usefixtures("tiny_preset")

SETTINGS = TrainingSettings(
    preset="tiny",
    images=160,
    batch_images=8,
    max_views=4,
    warmup_images=16,
    precision="float32",
    objective=ObjectiveSettings(uniform_rotations=16, near_rotations=8, pairs=3, match_weight=0.5),
)


@pytest.fixture
def scans(fake_shard):
    return Scans([fake_shard(6, 5, 32, 0)])


def weights(network):
    return torch.cat([parameter.detach().flatten() for parameter in network.parameters()])


def test_a_resumed_run_ends_with_the_same_weights_and_curve(tmp_path, scans):
    whole = Trainer(SETTINGS, tmp_path / "whole", scans, scans)
    whole.run(log_every=2, check_every=12, progress=False)
    assert whole.finished
    first = Trainer(SETTINGS, tmp_path / "halves", scans, scans)
    first._end = lambda *_: first.step >= 9
    first.run(log_every=2, check_every=12, progress=False)
    first.train_step()  # what comes after the checkpoint is lost
    second = Trainer(SETTINGS, tmp_path / "halves", scans, scans)
    assert second.step == 9
    second.run(log_every=2, check_every=12, progress=False)
    assert weights(second.network).equal(weights(whole.network))
    assert weights(second.average).equal(weights(whole.average))

    def rows(folder):
        with (tmp_path / folder / trainer.CURVE).open() as stream:
            return {row["step"]: row for row in csv.DictReader(stream)}

    assert len(rows("halves")) == len(rows("whole"))
    for step, row in rows("halves").items():
        for column in ("images", "loss", "learning_rate", "pair@30"):
            assert row[column] == rows("whole")[step][column]
    assert int(step) == whole.step
    assert rows("whole")[step]["pair@30"]  # of the weights that the run ends with
    assert float(rows("whole")[step]["learning_rate"]) == 0


def test_a_forward_pass_in_half_precision_learns_the_same(tmp_path, scans):
    first, half = (
        Trainer(replace(SETTINGS, precision=precision), tmp_path / precision, scans)
        for precision in ("float32", "bfloat16")
    )
    before = weights(half.network)
    torch.testing.assert_close(half.train_step(), first.train_step(), rtol=0.02, atol=0.02)
    assert not weights(half.network).equal(before)
    assert weights(half.network).dtype == torch.float32


def test_time_that_is_up_leaves_a_checkpoint_and_weights(tmp_path, scans):
    run = Trainer(SETTINGS, tmp_path, scans)
    run.run(budget_s=0.0, progress=False)
    assert run.step == 0
    assert not run.finished
    assert Trainer(SETTINGS, tmp_path, scans).step == 0
    metadata = read_metadata(tmp_path / trainer.WEIGHTS)
    assert metadata["images_seen"] == "0"


@pytest.mark.parametrize(
    "numbers",
    [(signal.SIGINT,), (signal.SIGTERM,), (signal.SIGINT, signal.SIGTERM), (signal.SIGTERM, signal.SIGTERM)],
)
def test_a_signal_ends_a_run_after_its_step_and_saves_it(tmp_path, scans, monkeypatch, numbers):
    run = Trainer(SETTINGS, tmp_path, scans)
    step = run.train_step

    def interrupted():
        if run.step == 2:
            for number in numbers:
                signal.raise_signal(number)
        return step()

    monkeypatch.setattr(run, "train_step", interrupted)
    before = signal.getsignal(numbers[0])
    with pytest.raises(KeyboardInterrupt):
        run.run(progress=False)
    assert signal.getsignal(numbers[0]) is before
    assert Trainer(SETTINGS, tmp_path, scans).step == 3


def test_a_signal_to_all_processes_leaves_those_that_prepare_batches_their_work(tmp_path, scans):
    """As of a terminal or a service; they are ended by the trainer."""
    (tmp_path / "run.pickle").write_bytes(
        pickle.dumps((SETTINGS.network, replace(SETTINGS, images=10**7), scans._shards[0]))
    )
    script = tmp_path / "script.py"
    script.write_text(TRAINED_WITH_A_WORKER)
    process = subprocess.Popen(
        [sys.executable, str(script), str(tmp_path)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
        env={**os.environ, "OMP_NUM_THREADS": "1"},
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "a step\n"
        os.killpg(process.pid, signal.SIGTERM)
        rest = process.communicate(timeout=120)[0]
    finally:
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    assert rest.splitlines()[-1] == "saved", rest


def test_a_second_signal_ends_a_run_at_once(tmp_path, scans, monkeypatch):
    run = Trainer(SETTINGS, tmp_path, scans)

    def impatient():
        signal.raise_signal(signal.SIGINT)
        signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(run, "train_step", impatient)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            run.run(progress=False)
    finally:
        signal.signal(signal.SIGINT, before)
    assert not (tmp_path / checkpoints.LISTING).exists()


@pytest.mark.parametrize(
    ("device", "match"), [("gpu", "'gpu' is no device to train on"), ("cuda:99", "the device cuda:99 cannot")]
)
def test_a_device_that_is_not_there_is_refused(tmp_path, scans, device, match):
    with pytest.raises(TrainingError, match=match):
        Trainer(SETTINGS, tmp_path, scans, device=device)


def test_a_backbone_that_would_climb_is_refused():
    for rate in (-0.3, float("nan"), float("inf")):
        with pytest.raises(TrainingError, match=f"the backbone's rate is {rate}"):
            replace(SETTINGS, backbone_rate=rate)


def test_a_curve_that_was_emptied_goes_on(tmp_path, scans):
    run = Trainer(SETTINGS, tmp_path, scans)
    run._end = lambda *_: run.step >= 2
    run.run(log_every=2, progress=False)
    (tmp_path / trainer.CURVE).write_text("", encoding="utf-8")
    Trainer(SETTINGS, tmp_path, scans).run(log_every=4, progress=False)
    with (tmp_path / trainer.CURVE).open() as stream:
        assert next(csv.DictReader(stream))["step"] == "4"


def test_a_file_is_no_folder_of_a_run(tmp_path, scans):
    (tmp_path / "file").touch()
    with pytest.raises(TrainingError, match=r"file cannot be the folder of a run: File exists"):
        Trainer(SETTINGS, tmp_path / "file", scans)


def test_a_run_begins_with_the_weights_it_is_given_and_counts_on(tmp_path, scans):
    first = Trainer(replace(SETTINGS, images=80), tmp_path / "first", scans)
    first.run(progress=False)
    given = tmp_path / "first" / trainer.WEIGHTS
    second = Trainer(replace(SETTINGS, seed=1), tmp_path / "second", scans, start_from=given)
    assert weights(second.network).equal(weights(first.average))
    assert second.images == first.images >= 80
    assert second.learning_rate() == pytest.approx(SETTINGS.learning_rate / 2)  # the optimizer is new
    second.train_step()
    moved = weights(second.average) - weights(first.average)
    # What was given is not forgotten as random weights are.
    assert 0 < moved.norm() < 0.01 * (weights(second.network) - weights(first.average)).norm()
    second.save()
    resumed = Trainer(replace(SETTINGS, seed=1), tmp_path / "second", scans, start_from=given)
    assert resumed.images == second.images
    assert resumed.learning_rate() == second.learning_rate()
    assert int(read_metadata(tmp_path / "second" / trainer.WEIGHTS)["images_seen"]) == second.images


def test_given_weights_that_do_not_say_what_they_saw_are_kept_all_the_same(tmp_path, scans):
    given = tmp_path / "released.safetensors"
    write_network(random_network(SETTINGS.network, 3), given)
    run = Trainer(SETTINGS, tmp_path / "run", scans, start_from=given)
    before = weights(run.average)
    run.train_step()
    assert 0 < (weights(run.average) - before).norm() < 0.01 * (weights(run.network) - before).norm()


def test_weights_that_have_seen_all_that_is_asked_for_begin_no_run(tmp_path, scans):
    given = tmp_path / "given.safetensors"
    write_network(random_network(SETTINGS.network, 3), given, {"images_seen": str(SETTINGS.images)})
    with pytest.raises(TrainingError, match=f"has seen {SETTINGS.images} images"):
        Trainer(SETTINGS, tmp_path / "run", scans, start_from=given)


def test_scans_of_too_few_views_are_refused_before_the_first_step(tmp_path, scans):
    many = replace(SETTINGS, max_views=scans.views + 1)
    with pytest.raises(TrainingError, match=f"scans of {scans.views} views only"):
        Trainer(many, tmp_path / "run", scans)


def test_a_measurement_that_fails_leaves_a_checkpoint(tmp_path, scans, monkeypatch):
    run = Trainer(SETTINGS, tmp_path / "run", scans, scans)
    monkeypatch.setattr(run, "measure", lambda: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        run.run(check_every=4, progress=False)
    assert Trainer(SETTINGS, tmp_path / "run", scans, scans).step == 4


def test_the_curve_of_a_run_without_a_checkpoint_begins_anew(tmp_path, scans):
    (tmp_path / "run").mkdir()
    curve = tmp_path / "run" / trainer.CURVE
    curve.write_text("step,images\n2,16\n", encoding="utf-8")
    run = Trainer(SETTINGS, tmp_path / "run", scans)
    run._end = lambda *_: run.step >= 2
    run.run(log_every=2, progress=False)
    with curve.open() as stream:
        assert [row["step"] for row in csv.DictReader(stream)] == ["2"]


def test_weights_of_another_network_begin_no_run(tmp_path, scans):
    Trainer(replace(SETTINGS, variants=("no-index",)), tmp_path / "first", scans).save()
    with pytest.raises(TrainingError, match=r"weights\.safetensors holds another network than 'tiny'"):
        Trainer(SETTINGS, tmp_path / "second", scans, start_from=tmp_path / "first" / trainer.WEIGHTS)


def test_it_learns_a_handful_of_scans(tmp_path, fake_shard):
    settings = replace(
        SETTINGS,
        images=1600,
        learning_rate=5e-3,
        objective=replace(SETTINGS.objective, match_weight=0.0),
        augmentation=Augmentation(mirror=0, quarter_turns=0, masked=0, grey=0, gain=0, noisy=0),
        curriculum=((0.0, 180.0),),
    )
    run = Trainer(settings, tmp_path, Scans([fake_shard(1, 4, 32, 0)]))
    losses = [run.train_step().tolist() for _ in range(150)]
    assert np.mean([loss[1] for loss in losses[:5]]) > -0.3  # knows nothing
    assert np.mean([loss[1] for loss in losses[-20:]]) < -1.0


@pytest.mark.parametrize("frame", [(), ("first-camera",)])
def test_a_network_that_regresses_learns_poses_too(tmp_path, fake_shard, frame):
    settings = replace(
        SETTINGS,
        variants=("regression", *frame),
        images=1600,
        min_views=4,
        learning_rate=5e-3,
        augmentation=Augmentation(mirror=0, quarter_turns=0, masked=0, grey=0, gain=0, noisy=0),
        curriculum=((0.0, 180.0),),
    )
    run = Trainer(settings, tmp_path, Scans([fake_shard(1, 4, 32, 0)]))
    losses = np.array([run.train_step().tolist() for _ in range(150)])
    assert (losses[-20:].mean(0) < 0.7 * losses[:5].mean(0))[:3].all()
    assert losses[:, 3].max() == 0  # nothing is matched


def test_the_learning_rate_rises_stays_and_falls(tmp_path, scans):
    run = Trainer(SETTINGS, tmp_path, scans)
    rates = []
    for images in range(0, 160, 8):
        run.images = images
        rates.append(run.learning_rate())
    assert rates[0] == pytest.approx(SETTINGS.learning_rate / 2)
    assert max(rates) == SETTINGS.learning_rate
    falling = rates[int(len(rates) * 0.65) :]
    assert falling == sorted(falling, reverse=True)
    assert falling[-1] < 0.2 * SETTINGS.learning_rate
    run.images = 0
    assert run.max_angle() == 45
    run.images = 159
    assert run.max_angle() == 180


def test_a_checkpoint_in_pieces_comes_back_whole_and_damage_is_noticed(tmp_path):
    state = {"numbers": torch.arange(1000), "step": 3}
    checkpoints.save_pieces(state, tmp_path, piece_bytes=1000)
    pieces = sorted(tmp_path.glob("checkpoint-*"))
    assert len(pieces) > 5
    assert max(piece.stat().st_size for piece in pieces) <= 1000
    assert checkpoints.load_pieces(tmp_path)["numbers"].equal(state["numbers"])
    checkpoints.save_pieces({"step": 4}, tmp_path, piece_bytes=1000)
    assert checkpoints.load_pieces(tmp_path) == {"step": 4}
    assert not any(piece.exists() for piece in pieces)
    (piece, *_) = tmp_path.glob("checkpoint-*")
    damaged = bytearray(piece.read_bytes())
    damaged[len(damaged) // 2] ^= 1
    piece.write_bytes(damaged)
    with pytest.raises(TrainingError, match="damaged"):
        checkpoints.load_pieces(tmp_path)
    piece.unlink()
    with pytest.raises(TrainingError, match="cannot be read"):
        checkpoints.load_pieces(tmp_path)


def test_a_checkpoint_of_another_network_is_refused(tmp_path, scans, tiny_preset, monkeypatch):
    Trainer(SETTINGS, tmp_path, scans).save()
    monkeypatch.setitem(PRESETS, "tiny", replace(tiny_preset, feedforward_width=8))
    with pytest.raises(TrainingError, match="another network"):
        Trainer(SETTINGS, tmp_path, scans)


def test_unknown_presets_and_variants_are_refused():
    with pytest.raises(PresetError, match="no preset 'large'; choose among paper, compact"):
        settings_for("large")
    with pytest.raises(PresetError, match="no variant 'colour'; choose among no-index, pair-context"):
        settings_for("compact", ["colour"])


@pytest.mark.parametrize("variants", [(), *((name,) for name in VARIANTS), ("regression", "first-camera")])
def test_every_variant_trains_is_measured_resumed_and_read_back(tmp_path, scans, variants):
    settings = replace(SETTINGS, images=24, variants=variants)
    Trainer(replace(settings, images=8), tmp_path, scans, scans).run(progress=False)
    run = Trainer(settings, tmp_path, scans, scans)
    assert run.step == 1
    before = weights(run.network).clone()
    run.run(progress=False)
    assert run.finished
    assert weights(run.network).isfinite().all()
    assert not weights(run.network).equal(before)
    assert set(run.measure(count=3)) == set(ACCURACIES)
    loaded = load_network(tmp_path / trainer.WEIGHTS)
    assert loaded.preset == settings.network
    assert weights(loaded).equal(weights(run.average))
    others = () if variants else ("no-index",)
    with pytest.raises(TrainingError, match="of another network than 'tiny"):
        Trainer(replace(settings, variants=others), tmp_path, scans)


def test_a_variant_is_the_published_run_of_another_network():
    plain, ablated = settings_for("compact"), settings_for("compact", ["regression"])
    assert ablated.network.rotation == "regression"
    assert replace(ablated, variants=(), objective=plain.objective) == plain
    assert settings_for("compact", ["no-index"]).objective == plain.objective


def test_pair_accuracy_of_a_network_that_knows_nothing_is_near_chance(tiny_preset, scans):
    network = random_network(tiny_preset, 0)
    figures = pair_accuracy(network, scans, views=3, count=10)
    assert set(figures) == set(ACCURACIES)
    assert figures["pair@30"] < 0.3
    assert 60 < figures["pair_median"] < 180


def test_under_torchrun_every_process_has_a_gpu_of_its_own(monkeypatch):
    assert trainer._own_device("cuda") == torch.device("cuda")
    monkeypatch.setenv("LOCAL_RANK", "3")
    assert trainer._own_device("cuda") == torch.device("cuda:3")
    assert trainer._own_device("cuda:1") == torch.device("cuda:1")
    assert trainer._own_device("cpu") == torch.device("cpu")


TRAINED_WITH_A_WORKER = """
import pickle, sys
from pathlib import Path
import torch
from relpose_ros.network.presets import PRESETS
from relpose_ros.training.batches import Scans
from relpose_ros.training.trainer import Trainer

torch.set_num_threads(1)
folder = Path(sys.argv[1])
PRESETS["tiny"], settings, shard = pickle.loads((folder / "run.pickle").read_bytes())
run = Trainer(settings, folder / "run", Scans([shard]), workers=1)
step = run.train_step

def told():
    losses = step()
    if run.step == 1:
        print("a step", flush=True)
    return losses

run.train_step = told
try:
    run.run(progress=False)
except KeyboardInterrupt:
    assert Trainer(settings, folder / "run", Scans([shard])).step == run.step >= 1
    print("saved", flush=True)
"""

PROCESS = """
import pickle, sys
from pathlib import Path
import torch
from relpose_ros.network.presets import PRESETS
from relpose_ros.training.batches import Scans
from relpose_ros.training.trainer import Trainer

torch.set_num_threads(1)
folder = Path(sys.argv[1])
PRESETS["tiny"], settings, shard = pickle.loads((folder / "run.pickle").read_bytes())
run = Trainer(settings, folder / "run", Scans([shard]))
run.run(progress=False, check_every=2)
total = sum(parameter.double().sum().item() for parameter in run.network.parameters())
print("weights", total, run.images)
torch.distributed.destroy_process_group()
"""


def test_two_processes_hold_the_same_weights(tmp_path, tiny_preset, fake_shard):
    settings = replace(SETTINGS, images=48, batch_images=4)
    (tmp_path / "run.pickle").write_bytes(pickle.dumps((tiny_preset, settings, fake_shard(6, 5, 32, 0))))
    script = tmp_path / "script.py"
    script.write_text(PROCESS)
    command = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2"]
    command += [str(script), str(tmp_path)]
    environment = {**os.environ, "OMP_NUM_THREADS": "1"}
    done = subprocess.run(command, capture_output=True, text=True, timeout=240, env=environment, check=False)
    assert done.returncode == 0, done.stderr[-2000:]
    ends = [line for line in done.stdout.splitlines() if line.startswith("weights")]
    assert len(ends) == 2
    assert ends[0] == ends[1]
    assert int(ends[0].split()[-1]) >= 48
    assert (tmp_path / "run" / "checkpoint.json").exists()
