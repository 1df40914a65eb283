"""What estimates say of their errors, held against errors of a known distribution."""

from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.estimates import CameraPose, Evidence, Mode, PairRotation, ScanEstimate, Verdict
from relpose_ros.evaluation import trust
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import camera_centre, look_at, look_at_translations, translation_of
from relpose_ros.views import BoundingBox, Intrinsics, View

SIGMA = 0.1
"""Standard deviation of every error drawn here, rad and units of the first camera's distance."""


def truth(generator, count):
    """Cameras about a point of some world, in some unit. -> (N, 3, 3), (N, 3)."""
    target, centres = generator.normal(size=3), generator.normal(size=(count, 3))
    centres = target + 5 * centres / np.linalg.norm(centres, axis=1, keepdims=True)
    rotations = look_at(centres, np.broadcast_to(target, centres.shape))
    return rotations, translation_of(rotations, centres)


def unboxed(count):
    """Views whose box is the whole picture, so that the object is where their axes meet."""
    return [View(np.zeros((2, 2, 3), np.uint8), BoundingBox(0, 0, 2, 2), 2, 2)] * count


def estimated(generator, rotations, translations, *, stated=SIGMA, sightlines=(0, 0, 1)):
    """An estimate whose every number is off by a draw of SIGMA, and which states ``stated``."""
    about_look_at, _, _ = look_at_translations(rotations, translations, sightlines)
    object_axes = rotations @ rotations[0].T
    centres = camera_centre(object_axes, about_look_at)
    covariance = stated**2 * np.eye(6)
    cameras = tuple(
        CameraPose(
            k,
            so3.exp(SIGMA * generator.normal(size=3) * (k > 0)) @ object_axes[k].T,
            centres[k] + SIGMA * generator.normal(size=3) * (k > 0),
            covariance,
        )
        for k in range(len(rotations))
    )
    pairs = []
    for i in range(len(rotations)):
        for j in range(i + 1, len(rotations)):
            true = object_axes[j] @ object_axes[i].T
            found = so3.exp(SIGMA * generator.normal(size=3)) @ true
            mode = Mode(found, 0.9, covariance[:3, :3])
            pairs.append(
                PairRotation(i, j, found, covariance[:3, :3], -3.0, 0.8, (mode,), False, 0.0, 0.8, 0.0)
            )
    return ScanEstimate("cup", cameras, tuple(pairs), 0.0, False, True, Verdict.ENOUGH, 0, "enough", 0.1)


@pytest.fixture
def group():
    def make(scans=80, count=5, **options):
        generator = np.random.default_rng(0)
        made = []
        for _ in range(scans):
            rotations, translations = truth(generator, count)
            estimate = estimated(generator, rotations, translations, **options)
            made.append(trust.statements(estimate, unboxed(len(rotations)), rotations, translations))
        return made

    return make


def test_true_covariances_hold_as_often_as_they_say(group):
    figures = trust.summary(group())
    for what in ("pairs", "rotations", "positions"):
        for level in (50, 90, 95):
            assert figures[f"{what}_inside@{level}"] == pytest.approx(level / 100, abs=0.05)


def test_covariances_that_are_too_small_or_too_large_show(group):
    small, large = trust.summary(group(stated=SIGMA / 3)), trust.summary(group(stated=SIGMA * 3))
    for what in ("pairs", "rotations", "positions"):
        assert small[f"{what}_inside@90"] < 0.3
        assert large[f"{what}_inside@50"] > 0.9


def test_probabilities_are_held_against_frequencies(group):
    figures = trust.summary(group())
    within = np.linalg.norm(SIGMA * np.random.default_rng(1).normal(size=(100_000, 3)), axis=1)
    assert figures["stated@15"] == pytest.approx(0.8)
    assert figures["strongest@15"] == pytest.approx((within < np.radians(15)).mean(), abs=0.03)
    assert figures["calibration_error@15"] == pytest.approx(figures["strongest@15"] - 0.8, abs=1e-9)


def test_pairs_that_matches_speak_of_are_told_apart():
    generator = np.random.default_rng(2)
    rotations, translations = truth(generator, 4)
    estimate = estimated(generator, rotations, translations)
    said = trust.statements(estimate, unboxed(4), rotations, translations)
    assert "matched_stated@15" not in trust.summary([said])
    matched = replace(estimate.pairs[1], evidence=Evidence.GEOMETRIC, probability_within_15_deg=0.99)
    estimate = replace(estimate, pairs=(estimate.pairs[0], matched, *estimate.pairs[2:]))
    figures = trust.summary([trust.statements(estimate, unboxed(len(rotations)), rotations, translations)])
    assert figures["matched_pairs"] == pytest.approx(1 / 6)
    assert figures["matched_stated@15"] == pytest.approx(0.99)
    assert figures["stated@15"] == pytest.approx((5 * 0.8 + 0.99) / 6)


def test_enough_is_wrong_where_a_pair_of_the_final_poses_is_off():
    generator = np.random.default_rng(3)
    rotations, translations = truth(generator, 3)
    estimate = estimated(generator, rotations, translations)
    right = trust.statements(estimate, unboxed(len(rotations)), rotations, translations)
    turned = so3.exp([0, 0, np.radians(60)]) @ estimate.cameras[2].object_from_camera
    cameras = (*estimate.cameras[:2], replace(estimate.cameras[2], object_from_camera=turned))
    wrong = trust.statements(replace(estimate, cameras=cameras), unboxed(3), rotations, translations)
    asks = replace(estimate, cameras=cameras, verdict=Verdict.ONE_MORE_VIEW)
    careful = trust.statements(asks, unboxed(3), rotations, translations)
    figures = trust.summary([right, right, wrong, careful])
    assert (figures["enough"], figures["enough_wrong"]) == (0.75, 0.25)


def test_positions_are_held_against_the_frame_whose_origin_is_in_the_boxes():
    """The same cameras and the same truth: the object is not where the axes meet, and the boxes say so."""
    generator = np.random.default_rng(4)
    rotations, translations = truth(generator, 5)
    about_axes, _, _ = look_at_translations(rotations, translations)
    seen = about_axes + rotations @ [0.4, -0.3, 0.2]
    rays = seen[:, :2] / seen[:, 2:]
    views = [
        replace(view, box=BoundingBox(x - 0.1, y - 0.1, x + 0.1, y + 0.1), intrinsics=Intrinsics(1, 1, 0, 0))
        for view, (x, y) in zip(unboxed(5), rays, strict=True)
    ]
    sightlines = seen / np.linalg.norm(seen, axis=1, keepdims=True)
    estimate = estimated(generator, rotations, translations, sightlines=sightlines)
    assert trust.statements(estimate, views, rotations, translations).position_squares.max() < 20
    assert trust.statements(estimate, unboxed(5), rotations, translations).position_squares.max() > 100
