"""The protocol: the same orders for everybody, prefixes of each other; a perfect method scores perfectly."""

import json
import time
from dataclasses import dataclass, replace

import numpy as np
import pytest

from relpose_ros.captures.folder import Frame, save_capture
from relpose_ros.evaluation import protocol
from relpose_ros.evaluation.baselines import ConstantTranslation, Estimated, Identity, Known, Poses
from relpose_ros.evaluation.metrics import rotation_errors
from relpose_ros.evaluation.protocol import EvaluationError, PosedViews
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import look_at, translation_of
from relpose_ros.inference.estimator import Estimator
from relpose_ros.inference.outlines import rays_of
from relpose_ros.inference.verdict import LARGEST_ROTATION_DEVIATION
from relpose_ros.network.checkpoint import random_network, write_network
from relpose_ros.network.presets import named_preset
from relpose_ros.views import BoundingBox, Distortion, Intrinsics, View


def posed(count=6, seed=0, name="thing"):
    """Cameras on a sphere, each looking at its centre; a view's image holds its number."""
    generator = np.random.default_rng(seed)
    centres = generator.normal(size=(count, 3))
    centres *= 3 / np.linalg.norm(centres, axis=1, keepdims=True)
    rotations = look_at(centres, np.zeros(3))
    pose = np.concatenate([rotations, translation_of(rotations, centres)[..., None]], -1)
    return PosedViews(
        name, pose, lambda k: View(np.full((8, 8, 3), k, np.uint8), BoundingBox(1, 1, 7, 7), 8, 8)
    )


@dataclass
class Oracle:
    """Knows the poses, in another world and unit; cameras after the ``fails_from``-th get no answer."""

    sequence: PosedViews
    name: str = "oracle"
    fails_from: int = 99

    def poses(self, views):
        pose = self.sequence.camera_from_world[[int(view.image[0, 0, 0]) for view in views]]
        turn = so3.exp([0.3, 0.2, -1.0])
        rotations, translations = pose[:, :, :3] @ turn, 2.5 * pose[:, :, 3]
        rotations[self.fails_from :] = np.nan
        return Poses(rotations, translations)


def test_orders_are_prefixes_seeded_and_independent_of_their_length():
    long = protocol.view_orders("cup", 12, 8, seed=3)
    assert len(long) == protocol.ORDERS
    assert all(len(set(order)) == 8 for order in long)
    assert [order[:3] for order in long] == protocol.view_orders("cup", 12, 3, seed=3)
    assert long != protocol.view_orders("cup", 12, 8, seed=4)
    assert long != protocol.view_orders("mug", 12, 8, seed=3)
    assert {len(order) for order in protocol.view_orders("cup", 5, 8)} == {5}


def test_a_perfect_method_is_perfect_at_every_number_of_views():
    sequence = posed()
    rows = protocol.measure(sequence, [Oracle(sequence)], [2, 4, 6, 8], orders=3)
    assert [row["views"] for row in rows] == [2, 4, 6]  # there are six photos
    for row in rows:
        assert row["scans"] == 3
        assert row["rotation@5"] == row["center@0.1"] == row["translation@0.1"] == 1
        assert row["rotation@median"] < 1e-4
        assert row["rotation@auc60"] == pytest.approx(1)


def test_another_seed_draws_other_scans():
    sequence = posed(8)
    first, again, other = (
        protocol.measure(sequence, [Identity()], [3], orders=2, seed=seed)[0]["rotation@median"]
        for seed in (0, 0, 4)
    )
    assert first == again != other


def test_unless_asked_otherwise_scans_have_two_to_eight_views():
    rows = protocol.evaluate([posed(9)], methods=["identity"], orders=1, progress=False)
    assert [row["views"] for row in rows if row["capture"] == "thing"] == [2, 3, 4, 5, 6, 7, 8]


def test_cameras_without_an_answer_count_as_wrong():
    sequence = posed()
    (row,) = protocol.measure(sequence, [Oracle(sequence, fails_from=3)], [4], orders=2)
    assert row["rotation@30"] == pytest.approx(6 / 12)
    assert row["center@0.3"] == pytest.approx(3 / 4)


def test_constant_translation_keeps_the_rotations_and_suits_cameras_that_look_at_the_object():
    sequence = posed()
    method = ConstantTranslation(Oracle(sequence))
    (row,) = protocol.measure(sequence, [method], [5], orders=2)
    assert row["method"] == "constant-translation"
    assert row["rotation@5"] == 1
    assert row["center@0.1"] == 1  # all of these cameras stand at one distance, facing the origin
    partial = ConstantTranslation(Oracle(sequence, fails_from=2)).poses([sequence.view(k) for k in range(3)])
    assert np.isnan(partial.translations[2]).all()
    assert np.isfinite(partial.translations[:2]).all()


def test_seconds_are_those_of_new_views_and_a_derived_method_pays_for_its_source():
    sequence, seen = posed(), []

    class Slow:
        name = "relpose"

        def __init__(self):
            self.last = None

        def poses(self, views):
            if self.last != views:
                time.sleep(0.02)
                seen.extend(views)
                self.last = list(views)
            return replace(Oracle(sequence).poses(views), deviations=np.zeros(len(views)))

    slow = Slow()
    rows = protocol.measure(sequence, [slow, Known("relpose-known", slow)], [2, 3], orders=2)
    assert len(set(map(id, seen))) == len(seen) == 2 * (2 + 3)
    assert min(row["seconds"] for row in rows) >= 0.02


def test_cameras_that_are_called_unknown_are_left_out_as_colmap_leaves_out_its_own():
    """One wrong camera of five spoils the alignment of all, unless it is known to be unknown."""
    sequence = posed()

    class OneWrong:
        name = "one-wrong"

        def poses(self, views):
            poses = Oracle(sequence).poses(views)
            translations = poses.translations.copy()
            translations[2] *= -3
            deviations = np.where(np.arange(len(views)) == 2, 2 * LARGEST_ROTATION_DEVIATION, 0.01)
            return Poses(poses.rotations, translations, deviations)

    whole, known = protocol.measure(sequence, [OneWrong(), Known("known", OneWrong())], [5], orders=2)
    assert whole["center@0.1"] < 0.3
    assert known["center@0.1"] == pytest.approx(4 / 5)
    assert known["rotation@5"] == pytest.approx(12 / 20)


def test_the_identity_is_right_only_for_near_neighbours():
    sequence = posed(count=8)
    (row,) = protocol.measure(sequence, [Identity()], [8], orders=1)
    angles = [
        np.degrees(so3.angle_between(a, b))
        for x, a in enumerate(sequence.camera_from_world[:, :, :3])
        for y, b in enumerate(sequence.camera_from_world[:, :, :3])
        if x != y
    ]
    assert row["rotation@30"] == pytest.approx((np.array(angles) <= 30).mean())


def test_evaluate_writes_rows_and_their_mean(tmp_path):
    output = tmp_path / "rows.json"
    sequences = [posed(name="one"), posed(name="two", seed=1)]
    rows = protocol.evaluate(sequences, [2, 3], methods=["identity"], output=output, orders=2, progress=False)
    assert [row["capture"] for row in rows] == ["one", "one", "two", "two", "mean", "mean"]
    for key in ("rotation@15", "rotation@auc60", "center@0.2", "seconds"):
        assert rows[5][key] == pytest.approx((rows[1][key] + rows[3][key]) / 2)
    assert rows[5]["scans"] == 4
    assert json.loads(output.read_text())["rows"] == rows
    text = protocol.table(rows).splitlines()
    assert len(text) == 7
    assert text[0].split()[:4] == ["capture", "method", "N", "scans"]
    assert text[-1].split()[:4] == ["mean", "identity", "3", "4"]


def test_what_was_measured_before_an_interruption_is_kept(tmp_path):
    def interrupted(k):
        raise KeyboardInterrupt

    output = tmp_path / "rows.json"
    sequences = [posed(name="one"), replace(posed(name="two"), view=interrupted)]
    with pytest.raises(KeyboardInterrupt):
        protocol.evaluate(sequences, [2], methods=["identity"], output=output, orders=1, progress=False)
    assert [row["capture"] for row in json.loads(output.read_text())["rows"]] == ["one"]


def test_an_output_that_cannot_be_written_is_told_before_the_work(tmp_path):
    output = tmp_path / "nowhere" / "rows.json"
    sequence = replace(posed(), view=pytest.fail)
    with pytest.raises(EvaluationError, match=r"rows\.json cannot be written: No such file or directory"):
        protocol.evaluate([sequence], [2], methods=["identity"], output=output, progress=False)


def test_wrong_questions_are_answered_with_a_sentence():
    with pytest.raises(EvaluationError, match="no capture"):
        protocol.evaluate([], progress=False)
    with pytest.raises(EvaluationError, match="between 2 and 8"):
        protocol.evaluate([posed()], [1, 2], methods=["identity"], progress=False)
    few = replace(posed(), camera_from_world=posed().camera_from_world[:3])
    with pytest.raises(EvaluationError, match="no capture has 5 views with a pose, the most have 3"):
        protocol.evaluate([few], [5, 8], methods=["identity"], progress=False)
    for orders, seed in ((0, 0), (5, -1)):
        with pytest.raises(EvaluationError, match=f"{orders} orders by the seed {seed}"):
            protocol.evaluate([posed()], [2], seed=seed, orders=orders, methods=["identity"], progress=False)
    place = [1.0, 2.0, 3.0]
    turns = posed().camera_from_world[:, :, :3]
    turned = replace(
        posed(), camera_from_world=np.concatenate([turns, -turns @ np.reshape(place, (3, 1))], 2)
    )
    with pytest.raises(EvaluationError, match="all its cameras at one place"):
        protocol.evaluate([turned], [2], methods=["identity"], progress=False)
    with pytest.raises(EvaluationError, match="magic"):
        protocol.evaluate([posed()], [2], methods=["magic"], progress=False)


@pytest.fixture
def weights(tmp_path):
    """Writes a network of random weights and names the file."""

    def write(*variants):
        file = tmp_path / f"{'_'.join(variants) or 'plain'}.safetensors"
        write_network(random_network(named_preset("compact", variants), 0), file)
        return file

    return write


def test_each_method_rests_on_its_own_evidence(weights):
    chosen = protocol._methods([*protocol.EVIDENCE], weights(), 0, None)
    assert {each.name: each._estimator._evidence for each in chosen} == protocol.EVIDENCE


def test_variants_of_the_paper_are_rows_beside_the_methods(weights):
    sequence = posed(3)
    files = [weights("regression"), weights("regression", "first-camera"), weights("no-index")]
    rows = protocol.evaluate([sequence], [3], methods=["identity"], variants=files, orders=1, progress=False)
    rows = {row["method"]: row for row in rows if row["capture"] == "thing"}
    assert list(rows) == ["identity", "regression", "regression+first-camera", "no-index"]
    views = [sequence.view(k) for (order,) in [protocol.view_orders("thing", 3, 3, orders=1)] for k in order]
    alone = Estimated("regression", Estimator.from_weights(files[0])).poses(views)
    true = sequence.camera_from_world[protocol.view_orders("thing", 3, 3, orders=1)[0], :, :3]
    errors = rotation_errors(alone.rotations, true)
    assert rows["regression"]["rotation@median"] == pytest.approx(np.median(errors))
    assert rows["regression"]["rotation@median"] != rows["no-index"]["rotation@median"]
    assert rows["regression"]["enough"] == 0
    assert rows["regression"]["stated@15"] < 0.001
    assert "enough" not in rows["identity"]


def test_what_is_no_variant_or_one_twice_is_refused(weights):
    with pytest.raises(
        EvaluationError, match=r"plain\.safetensors holds the network 'compact' and no variant"
    ):
        protocol.evaluate([posed()], [2], methods=[], variants=[weights()], progress=False)
    with pytest.raises(EvaluationError, match="holds another pair-context"):
        protocol.evaluate([posed()], [2], methods=[], variants=[weights("pair-context")] * 2, progress=False)


def test_weights_that_regress_are_measured_by_the_methods_they_have(weights):
    sequence = posed(3)
    for method in ("relpose", "relpose-known", "both", "geometry"):
        with pytest.raises(EvaluationError, match=f"measure 'learned', not '{method}'"):
            protocol.evaluate([sequence], [2], weights("regression"), [method], progress=False)
    pytest.importorskip("pycolmap")
    rows = protocol.evaluate([sequence], [2], weights("regression"), orders=1, progress=False)
    methods = [row["method"] for row in rows if row["capture"] == "thing"]
    assert methods == ["learned", "constant-translation", "identity", "pycolmap"]


def test_in_the_mean_statements_are_held_against_all_scans_together(weights):
    """Of one pair a probability can only be far from a frequency; of all pairs it need not be."""
    sequences = [posed(4, seed=seed, name=str(seed)) for seed in range(4)]
    file = weights("first-camera")
    rows = protocol.evaluate(sequences, [2], file, ["learned"], orders=1, progress=False)
    errors = [row["calibration_error@15"] for row in rows]
    assert rows[-1]["stated@15"] == pytest.approx(np.mean([row["stated@15"] for row in rows[:-1]]))
    assert errors[-1] <= np.mean(errors[:-1]) + 1e-12
    lines = protocol.trust_table(rows).splitlines()
    assert [line.split()[0] for line in lines] == ["capture", "mean"]
    assert protocol.trust_table([{"capture": "mean", "method": "identity"}]) == ""


def test_views_that_are_held_are_read_anew_each_time():
    """An estimator would know a view that it met in an earlier order: not so a photo that is read again."""
    given = posed(3)
    views = [replace(given.view(k), mask=np.ones((8, 8), bool)) for k in range(3)]
    sequence = PosedViews.of_views("cup", views, list(given.camera_from_world))
    assert sequence.view(1) is not sequence.view(1)
    assert sequence.view(1).image is views[1].image
    assert sequence.view(1).mask is views[1].mask
    assert PosedViews.of_views("cup", views, list(given.camera_from_world), masked=False).view(1).mask is None
    with pytest.raises(EvaluationError, match="cup has 1 views with a pose"):
        PosedViews.of_views("cup", views[:1], list(given.camera_from_world[:1]))


def test_only_photos_with_a_pose_are_measured_on(tmp_path):
    sequence = posed(3)
    frames = [Frame(sequence.view(k), None if k == 1 else sequence.camera_from_world[k]) for k in range(3)]
    capture = save_capture(tmp_path / "thing", frames)
    views = protocol.posed_views(capture)
    assert views.name == "thing"
    np.testing.assert_allclose(views.camera_from_world, sequence.camera_from_world[[0, 2]], atol=1e-8)
    assert int(views.view(1).image.mean()) == 2
    with pytest.raises(EvaluationError, match="1 photos"):
        protocol.posed_views(save_capture(tmp_path / "lone", frames[:2]))


@pytest.mark.parametrize(
    "lens",
    [
        None,
        Distortion((-0.35, 0.12, 0.001, -0.001, 0.0)),
        Distortion((0.3, -0.2, 0.0, 0.0), equidistant=True),
    ],
    ids=["pinhole", "plumb_bob", "equidistant"],
)
def test_colmap_recovers_a_textured_scene(lens):
    pytest.importorskip("pycolmap")
    cv2 = pytest.importorskip("cv2")
    from relpose_ros.evaluation.baselines import Colmap

    # Two textured planes at an angle, drawn by their homographies.
    generator = np.random.default_rng(0)
    textures = [
        cv2.resize(
            generator.integers(0, 256, (64, 64, 3), dtype=np.uint8), (512, 512), interpolation=cv2.INTER_CUBIC
        )
        for _ in range(2)
    ]
    planes = [  # corner and two edges of a square of side 2
        (np.array([-2.0, -1, 0]), np.array([2.0, 0, 0.6]), np.array([0, 2.0, 0])),
        (np.array([0.0, -1, 0.6]), np.array([2.0, 0, -0.8]), np.array([0, 2.0, 0])),
    ]
    camera = np.array([[400.0, 0, 240], [0, 400, 180], [0, 0, 1]])
    views, rotations = [], []
    for angle in (-0.25, 0.0, 0.25):
        centre = 5 * np.array([np.sin(angle), 0.1 * angle, -np.cos(angle)])
        rotation = look_at(centre, np.zeros(3), (0, -1, 0))
        image = np.zeros((360, 480, 3), np.uint8)
        for texture, (corner, right, down) in zip(textures, planes, strict=True):
            to_world = np.column_stack([right / 512, down / 512, corner])
            homography = camera @ (rotation @ to_world + np.outer(-rotation @ centre, [0, 0, 1]))
            drawn = cv2.warpPerspective(texture, homography, (480, 360))
            inside = cv2.warpPerspective(np.ones((512, 512), np.uint8), homography, (480, 360))
            image[inside > 0] = drawn[inside > 0]
        view = View(image, BoundingBox(0, 0, 480, 360), 480, 360, intrinsics=Intrinsics(400, 400, 240, 180))
        if lens is not None:
            # Where each pixel of the bent picture comes from.
            columns, rows = np.meshgrid(np.arange(480) + 0.5, np.arange(360) + 0.5)
            bent = np.stack([columns, rows], -1).reshape(-1, 2)
            source = 400 * rays_of(replace(view, distortion=lens), bent) + [240 - 0.5, 180 - 0.5]
            maps = source.astype(np.float32).reshape(360, 480, 2)
            view = replace(view, image=cv2.remap(image, maps, None, cv2.INTER_CUBIC), distortion=lens)
        views.append(view)
        rotations.append(rotation)
    estimate = Colmap().poses(views)
    for i, j in ((0, 1), (0, 2)):
        true = rotations[j] @ rotations[i].T
        found = estimate.rotations[j] @ estimate.rotations[i].T
        assert np.degrees(so3.angle_between(found, true)) < 1
