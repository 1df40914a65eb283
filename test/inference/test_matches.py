from __future__ import annotations

import gc
import itertools
import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from relpose_ros.captures.folder import load_capture
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous
from relpose_ros.inference import matches, two_view_poses
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.local_features import DescriptorMap, LocalFeatures, find_features
from relpose_ros.inference.matches import (
    MATCHING_FLOOR,
    NOTHING,
    Matcher,
    TwoViewGeometry,
    peaks,
    relate,
    trust,
)
from relpose_ros.inference.outlines import Outline
from relpose_ros.inference.two_view_poses import LEAST_MATCHES, RelativePose, Support, explain
from relpose_ros.network.checkpoint import read_metadata
from relpose_ros.network.crops import crop_square
from relpose_ros.views import BoundingBox


def degrees(a, b):
    return math.degrees(so3.angle_between(a, b))


def between(a, b):
    """Angle of two vectors, degrees."""
    return math.degrees(math.atan2(np.linalg.norm(np.cross(a, b)), a @ b))


# What two views of known points say.


@pytest.mark.parametrize("angle", [8, 25, 60])
def test_pose_of_two_views_despite_outliers(point_scene, angle):
    scene = point_scene.ring([0, angle], points=200)
    first, second = scene.features(outliers=60)
    found = relate(first, second)
    rotation, direction = scene.relative(0, 1)
    assert degrees(found.poses[0].rotation, rotation) < 0.6
    assert between(found.poses[0].direction, direction) < 3
    assert found.probability > 0.95
    assert sum(pose.weight for pose in found.poses) == pytest.approx(1)
    # Inliers are those that obey the pose: nearly all true matches, hardly an outlier.
    same = (first.descriptors[found.inliers[:, 0]] == second.descriptors[found.inliers[:, 1]]).all(1)
    assert same.all()
    assert 130 <= len(found.inliers) <= 152


def test_exact_points_give_the_exact_pose(point_scene):
    scene = point_scene.ring([0, 30])
    found = relate(*scene.features(noise=0))
    rotation, direction = scene.relative(0, 1)
    assert degrees(found.poses[0].rotation, rotation) < 1e-3
    assert between(found.poses[0].direction, direction) < 1e-3


def test_narrow_views_of_a_small_object_do_not_hide_their_angle(point_scene):
    """Nearly orthographic: the minima along the open angle are all found, or the right one wins."""
    best, told = 0, 0
    for seed in range(12):
        scene = point_scene.ring([0, 40], points=150, seed=seed)
        scene.points *= 0.4
        found = relate(*scene.features(noise=0.5, outliers=30, seed=seed))
        errors = [degrees(pose.rotation, scene.relative(0, 1)[0]) for pose in found.poses]
        best += errors[0] < 5
        told += min(errors) < 5
    assert best >= 10
    assert told == 12


def test_swapping_the_views_inverts_the_pose(point_scene):
    first, second = point_scene.ring([0, 25]).features(noise=0.3)
    there, back = relate(first, second).poses[0], relate(second, first).poses[0]
    assert degrees(there.rotation, back.rotation.T) < 0.2
    assert between(there.direction, -there.rotation @ back.direction) < 1


def test_same_bits_twice(point_scene):
    features = point_scene.ring([0, 25]).features(outliers=80)
    first, second = relate(*features), relate(*features)
    assert first.inliers.tobytes() == second.inliers.tobytes()
    assert first.probability == second.probability
    for a, b in zip(first.poses, second.poses, strict=True):
        for name in ("rotation", "direction", "covariance", "direction_covariance"):
            assert getattr(a, name).tobytes() == getattr(b, name).tobytes()


def test_features_of_one_place_are_told_as_the_first_there(point_scene):
    first, second = point_scene.ring([0, 25]).features()
    twice = replace(first, places=first.places // 2 * 2)
    found = relate(twice, second)
    assert len(found.inliers) > 50
    assert (found.inliers[:, 0] % 2 == 0).all()


def test_more_points_say_it_more_exactly(point_scene):
    few = relate(*point_scene.ring([0, 25], points=40).features()).poses[0]
    many = relate(*point_scene.ring([0, 25], points=640).features()).poses[0]
    ratio = np.trace(few.covariance) / np.trace(many.covariance)
    assert 5 < ratio < 60  # 16 times the points
    assert np.trace(few.direction_covariance) > 4 * np.trace(many.direction_covariance)


def test_stated_covariances_are_those_of_the_errors(point_scene):
    """Over many draws: squared Mahalanobis distances of rotation and direction, 3 and 2 on average."""
    of_rotation, of_direction = [], []
    for seed in range(40):
        scene = point_scene.ring([0, 25], points=120, seed=seed)
        pose = relate(*scene.features(noise=0.7, seed=seed)).poses[0]
        rotation, direction = scene.relative(0, 1)
        turn = so3.log(rotation @ pose.rotation.T)
        of_rotation.append(turn @ np.linalg.solve(pose.covariance, turn))
        shift = direction - pose.direction
        of_direction.append(shift @ np.linalg.pinv(pose.direction_covariance, rcond=1e-6) @ shift)
        eigenvalues = np.linalg.eigvalsh(pose.covariance)
        assert eigenvalues.min() > 0
        np.testing.assert_allclose(pose.direction_covariance @ pose.direction, 0, atol=1e-12)
    assert 1.5 < np.median(of_rotation) < 5  # 2.37 of a chi-square with 3 degrees of freedom
    assert 0.7 < np.median(of_direction) < 3  # 1.39 with 2
    assert np.mean(np.array(of_rotation) < 3 * 7.8) > 0.9


def test_of_points_on_a_plane_the_truth_is_among_the_poses(point_scene):
    right, honest = 0, 0
    for seed in range(8):
        scene = point_scene.ring([0, 30], seed=seed)
        scene.points[:, 2] = 0.1 * scene.points[:, 0] + 0.3 * scene.points[:, 1]
        found = relate(*scene.features(seed=seed))
        angles = [degrees(pose.rotation, scene.relative(0, 1)[0]) for pose in found.poses]
        right += min(angles) < 3
        # What cannot be told apart shares the probability.
        honest += angles[0] < 3 or found.poses[0].weight < 0.9
    assert right >= 7
    assert honest == 8


@pytest.mark.parametrize("noise", [0.0, 0.5])
def test_a_camera_that_only_turned(point_scene, noise):
    scene = point_scene.ring([0, 15])
    scene.translations[1] = scene.rotations[1] @ scene.translations[0]
    found = relate(*scene.features(noise=noise))
    assert min(degrees(pose.rotation, scene.relative(0, 1)[0]) for pose in found.poses) < 1.5
    moved = point_scene.ring([0, 15])
    parallax = relate(*moved.features()).poses[0]
    for pose in found.poses:
        assert np.trace(pose.direction_covariance) > 20 * np.trace(parallax.direction_covariance)


def test_too_few_matches_say_nothing(point_scene):
    scene = point_scene.ring([0, 25], points=LEAST_MATCHES - 1)
    assert relate(*scene.features(noise=0)) is NOTHING
    assert not NOTHING.agrees(np.eye(3))
    assert peaks(NOTHING) == []


@pytest.mark.parametrize("seed", range(6))
def test_wrong_matches_alone_are_not_trusted(point_scene, seed):
    scene = point_scene.ring([0, 25], points=80)
    found = relate(*scene.features(outliers=80, seed=seed))
    assert found.probability < 0.5
    assert peaks(found) == []
    assert not found.agrees(found.poses[0].rotation if found.poses else np.eye(3))


def test_identical_features_everywhere_say_nothing():
    """All rays the same, or all on a line: nothing to hold a pose, and no exception."""
    generator = np.random.default_rng(0)
    descriptors = generator.standard_normal((30, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    on_line = np.linspace(-0.2, 0.2, 30)[:, None] * [1.0, 0.3]
    same, line = (
        LocalFeatures(rays, np.zeros(30), descriptors, np.arange(30), 30, 1 / 800, False)
        for rays in (np.zeros((30, 2)), on_line)
    )
    for first, second in [(same, same), (line, line), (same, line)]:
        found = relate(first, second)
        assert all(np.isfinite(pose.rotation).all() for pose in found.poses)


def test_a_guessed_focal_length_widens_what_is_stated(point_scene):
    scene = point_scene.ring([0, 30])
    known = relate(*scene.features())
    first, second = scene.features()
    guessed = relate(first, replace(second, guessed=True))
    np.testing.assert_array_equal(guessed.poses[0].rotation, known.poses[0].rotation)
    added = guessed.poses[0].covariance - known.poses[0].covariance
    # In proportion to the angle, most about the axis that was turned about.
    axis = so3.log(known.poses[0].rotation)
    angle = np.linalg.norm(axis)
    assert math.sqrt(axis @ added @ axis) / angle == pytest.approx(0.2 * angle * math.sqrt(1.25))
    assert np.linalg.eigvalsh(added).min() > 0
    wider = guessed.poses[0].direction_covariance - known.poses[0].direction_covariance
    np.testing.assert_allclose(np.linalg.eigvalsh(wider), [0, 0.01, 0.01], atol=1e-9)


# The background behind a turntable.


def test_a_static_background_takes_no_part(ball_on_a_turntable, rotation_of_ball):
    views = [ball_on_a_turntable(turn) for turn in (0, 20)]
    truth = rotation_of_ball(20) @ rotation_of_ball(0).T
    found = relate(*(find_features(view) for view in views))
    assert found.probability > 0.5
    assert degrees(found.poses[0].rotation, truth) < 4
    # Admitted, it says that nothing moved.
    misled = relate(*(find_features(view, surroundings=True) for view in views))
    assert degrees(misled.poses[0].rotation, np.eye(3)) < 3


def unspoken(_view):
    """No network."""


SHIPPED_TRUST = Calibration.from_json(read_metadata(None)["calibration"]).match_trust


def undecided(view):
    """A network that takes all places for the same."""
    left, top, side = crop_square(view.box)
    return DescriptorMap(np.full((4, 2, 2), 0.5, np.float32), left, top, side)


def shaken(view, turn_deg):
    """As a camera sees it that turns in its place."""
    lens = view.intrinsics
    # OpenCV's (0, 0) is the first pixel's centre.
    pixels = np.array([[lens.fx, 0, lens.cx - 0.5], [0, lens.fy, lens.cy - 0.5], [0, 0, 1]])
    homography = pixels @ so3.exp(np.radians(turn_deg)) @ np.linalg.inv(pixels)
    size = view.image.shape[1::-1]
    image = cv2.warpPerspective(view.image, homography, size, borderMode=cv2.BORDER_REFLECT)
    return replace(view, image=image)


@pytest.mark.parametrize("network", [unspoken, undecided])
@pytest.mark.parametrize("bounded", [True, False])
@pytest.mark.parametrize("turn_deg", [(0.2, 0.2, 0), (0.5, 0.5, 0), (2, 0, 0), (0, 0, 1), (0.5, 0.5, 2)])
def test_a_background_before_a_camera_that_turns_in_its_place_says_nothing_either(
    ball_on_a_turntable, rotation_of_ball, turn_deg, bounded, network
):
    """It was meant to stand still. In a whole picture wall and object may suit one pose, that of the wall."""
    views = [ball_on_a_turntable(turn, masked=False) for turn in (0, 20, 180)]
    if not bounded:
        whole = BoundingBox(0, 0, views[0].full_width, views[0].full_height)
        views = [replace(view, box=whole) for view in views]
    views = [views[0], *(shaken(view, turn_deg) for view in views[1:])]
    first, same, other = (find_features(view, network(view)) for view in views)
    found = relate(first, same, learned_trust=SHIPPED_TRUST)
    truth = so3.exp(np.radians(turn_deg)) @ rotation_of_ball(20) @ rotation_of_ball(0).T
    assert found.probability > 0.5
    assert degrees(found.poses[0].rotation, truth) < 5
    assert relate(first, other, learned_trust=SHIPPED_TRUST).probability == 0, (
        "the other side: nothing else is in both"
    )


def test_a_camera_that_moves_a_little_around_an_object_is_no_shaking_one(point_scene):
    """Five degrees: near and far parts of the object shift by some pixels more or less."""
    scene = point_scene.ring([0, 5], points=200)
    free = [replace(each, strays=True) for each in scene.features()]
    found = relate(*free)
    assert len(found.inliers) > 150
    assert degrees(found.poses[0].rotation, scene.relative(0, 1)[0]) < 1


@pytest.mark.parametrize("masked", [False, True])
def test_where_something_stands_still_sift_is_asked_alone(ball_on_a_turntable, masked):
    """A network was taught objects, and takes one brick of a wall for the next."""
    views = [ball_on_a_turntable(turn, masked=masked) for turn in (0, 20)]
    features = [find_features(view, undecided(view)) for view in views]
    support = explain(*features).support
    assert support.learned is masked
    numbers = {"coefficients": SHIPPED_TRUST} if masked else {}
    assert relate(*features, learned_trust=SHIPPED_TRUST).probability == trust(support, **numbers)
    if masked:
        with pytest.raises(ValueError, match="how far to trust that must be given"):
            relate(*features)
    else:
        assert relate(*features).probability == trust(support)


@pytest.mark.parametrize(("angle", "learned"), [(3, False), (40, True)])
def test_of_cameras_that_hardly_moved_sift_says_enough(point_scene, angle, learned):
    """They may as well have turned in their places before a wall."""
    scene = point_scene.ring([0, angle], points=200)
    found = explain(*(replace(each, strays=True, learned=True) for each in scene.features()))
    assert found.support.learned is learned
    assert len(found.inliers) > 150
    assert degrees(found.poses[0].rotation, scene.relative(0, 1)[0]) < 1


@pytest.mark.parametrize("network", [unspoken, undecided])
@pytest.mark.parametrize(("bounded", "least", "most"), [(True, 0.5, 4), (False, 0.9, 3)])
def test_without_a_mask_what_stays_in_place_says_nothing(
    ball_on_a_turntable, rotation_of_ball, bounded, least, most, network
):
    """A box has corners that do not turn; without a region of interest most of the picture does not."""
    views = [ball_on_a_turntable(turn, masked=False) for turn in (0, 20, 180)]
    if not bounded:
        whole = BoundingBox(0, 0, views[0].full_width, views[0].full_height)
        views = [replace(view, box=whole) for view in views]
    features = [find_features(view, network(view)) for view in views]
    found = relate(features[0], features[1], learned_trust=SHIPPED_TRUST)
    truth = rotation_of_ball(20) @ rotation_of_ball(0).T
    assert found.probability > least
    assert degrees(found.poses[0].rotation, truth) < most
    assert relate(features[0], features[2], learned_trust=SHIPPED_TRUST).probability == 0, (
        "the other side: nothing else is in both"
    )
    assert relate(features[0], features[0]).probability == 0, (
        "of a picture taken twice nobody knows whether anything moved"
    )


# Trust, and what becomes of it.


def support(inliers=30, residual=0.45, spread=0.8):
    return Support(inliers, residual, spread)


def test_trust_grows_with_what_speaks_for_a_pose():
    assert trust(support(100)) > trust(support(50)) > trust(support(25)) > 0.5
    assert 0 < trust(support(LEAST_MATCHES)) < trust(support(25))
    assert 0 < trust(support(LEAST_MATCHES - 1)) < 0.5
    assert trust(support(10_000)) < 1
    assert trust(support(residual=0.3)) > trust(support(residual=0.7))
    assert trust(support(spread=0.9)) > trust(support(spread=0.1))
    # Nothing of it may be zero, and yet it can be.
    assert 0 <= trust(support(residual=0.0, spread=0.0)) < 1


def test_matches_that_a_network_helped_to_are_trusted_by_numbers_of_their_own():
    """More of them are accidental."""
    for inliers in (20, 40, 80):
        assert trust(support(inliers), SHIPPED_TRUST) < trust(support(inliers)) - 0.03


def test_accidental_matches_support_a_pose_less(point_scene):
    """Points seen twice, and pictures that have none in common: those obey some pose, but not as nearly."""
    right = explain(*point_scene.ring([0, 25], points=40).features(noise=0.3))
    found = [
        explain(*point_scene.ring([0, 25], points=4000, seed=seed).features(outliers=4000, seed=seed))
        for seed in range(5)
    ]
    accidental = [each for each in found if each is not None]
    assert accidental
    assert all(right.support.residual < each.support.residual for each in accidental)
    assert all(trust(each.support) < 0.5 for each in accidental)
    assert trust(right.support) > 0.9


def outlined(features, local):
    """Of an object somewhere in the camera's axes; its apparent size goes with the square of its nearness."""
    side = 0.2 / (local @ local)
    return replace(features, outline=Outline(local / np.linalg.norm(local), np.array([side, side])))


def test_cameras_that_look_at_the_object_tell_between_explanations(point_scene):
    """Of nearly orthographic views: the right angle weighs more where the boxes are known."""
    alone, together = [], []
    for seed in range(12):
        scene = point_scene.ring([0, 40], points=150, seed=seed)
        scene.points *= 0.4
        views = scene.features(noise=0.5, outliers=30, seed=seed)
        boxes = [outlined(view, local) for view, local in zip(views, scene.translations, strict=True)]
        for pair, weights in ((views, alone), (boxes, together)):
            poses = relate(*pair).poses
            right = [p.weight for p in poses if degrees(p.rotation, scene.relative(0, 1)[0]) < 8]
            weights.append(sum(right))
    assert np.mean(together) > np.mean(alone)
    assert np.log(np.maximum(together, 1e-3)).mean() > np.log(np.maximum(alone, 1e-3)).mean()


@pytest.mark.parametrize("roll", [0.0, 2.0, 3.0, -3.2])
def test_only_features_that_turn_alike_match(point_scene, roll):
    """The same rays and descriptors: what differs is how the features lie in the pictures."""
    first, second = point_scene.ring([0, 25], points=200).features()
    rolled = replace(second, orientations=second.orientations + roll)
    assert len(relate(first, rolled).inliers) == len(relate(first, second).inliers) > 150
    # Each second one turned otherwise.
    odd = np.arange(len(second.orientations)) % 2
    tossed = replace(rolled, orientations=rolled.orientations + 2.5 * odd)
    found = relate(first, tossed)
    assert 70 < len(found.inliers) < 130
    assert np.ptp(odd[found.inliers[:, 1]]) == 0


def pose(rotation, weight, sigma=0.01):
    return RelativePose(rotation, np.array([1.0, 0, 0]), sigma**2 * np.eye(3), np.zeros((3, 3)), weight)


def test_peaks_share_the_probability_of_the_poses():
    poses = (pose(np.eye(3), 0.7), pose(so3.exp([0, 1.0, 0]), 0.3))
    found = peaks(TwoViewGeometry(poses, np.zeros((9, 2), np.int64), 0.9))
    assert sum(peak.probability for peak in found) == pytest.approx(0.9)
    by_pose = [sum(p.probability for p in found if degrees(p.rotation, each.rotation) < 1) for each in poses]
    assert by_pose == pytest.approx([0.63, 0.27])
    # Never sharper than the intrinsics allow, and a share of it is much wider.
    deviations = [math.degrees(math.sqrt(np.linalg.eigvalsh(peak.covariance).max())) for peak in found]
    assert min(deviations) > 0.3
    assert sorted(deviations)[-1] > 5


def test_no_peak_is_sharper_than_the_intrinsics_allow():
    found = peaks(TwoViewGeometry((pose(np.eye(3), 1.0, sigma=1e-6),), np.zeros((9, 2), np.int64), 0.9))
    assert len(found) == 2
    for peak in found:
        assert np.linalg.eigvalsh(peak.covariance).min() >= MATCHING_FLOOR**2


def test_matches_that_are_more_likely_wrong_than_right_put_no_peak():
    one = (pose(np.eye(3), 1.0),)
    told = [bool(peaks(TwoViewGeometry(one, np.zeros((9, 2), np.int64), chance))) for chance in (0.49, 0.51)]
    assert told == [False, True]


@pytest.mark.parametrize(("weights", "told"), [((0.3, 0.25), True), ((0.2, 0.15, 0.1), False)])
def test_poses_that_are_a_few_of_many_say_nothing(weights, told):
    poses = tuple(pose(so3.exp([0, k, 0]), weight) for k, weight in enumerate(weights))
    assert bool(peaks(TwoViewGeometry(poses, np.zeros((200, 2), np.int64), 0.98))) == told


def test_only_trusted_matches_with_the_cameras_rotation_count():
    geometry = TwoViewGeometry((pose(np.eye(3), 1.0),), np.zeros((9, 2), np.int64), 0.9)
    assert geometry.agrees(so3.exp([0, math.radians(9), 0]))
    assert not geometry.agrees(so3.exp([0, math.radians(11), 0]))
    assert not replace(geometry, probability=0.4).agrees(np.eye(3))
    turned = pose(so3.exp([0, 1.0, 0]), 0.5)
    assert not replace(geometry, poses=(pose(np.eye(3), 0.5), turned)).agrees(np.eye(3)), "of two, either"


def test_the_chance_of_a_rotation_is_that_of_the_poses_about_it():
    poses = tuple(pose(so3.exp([0, math.radians(at), 0]), w) for at, w in ((0, 0.5), (20, 0.3), (60, 0.2)))
    geometry = TwoViewGeometry(poses, np.zeros((9, 2), np.int64), 0.9)
    chances = [geometry.chance_of(so3.exp([0, math.radians(at), 0])) for at in (5, 65, 120)]
    assert chances == pytest.approx([0.9 * 0.8, 0.9 * 0.2, 0.0])
    assert NOTHING.chance_of(np.eye(3)) == 0


# What is kept.


def test_a_view_and_a_pair_are_looked_at_once_and_forgotten_with_the_view(textured, monkeypatch):
    looked, related = [], []
    for name, calls in (("find_features", looked), ("relate", related)):
        real = getattr(matches, name)
        monkeypatch.setattr(matches, name, _counting(real, calls))
    matcher = Matcher()
    views = [textured(seed, 60, 60) for seed in range(3)]
    assert list(matcher.geometries(views[:2])) == [(0, 1)]
    assert list(matcher.geometries(views)) == [(0, 1), (0, 2), (1, 2)]
    assert list(matcher.geometries(views[1:])) == [(0, 1)]
    assert len(looked) == 3
    assert len(related) == 3
    del views, looked[:], related[:]
    gc.collect()
    assert len(matcher._features) == 0
    assert len(matcher._pairs) == 0


def _counting(real, calls):
    def counted(*arguments, **options):
        calls.append(len(arguments))
        return real(*arguments, **options)

    return counted


def test_neighbouring_photographs(shared):
    """20 to 40 degrees apart, an outdoor object without masks."""
    capture = load_capture(shared / "captures" / "dev" / "saharov32")
    errors = []
    for i in (0, 6, 12, 18, 24, 28):
        rotations = [np.asarray(capture.photos[k].camera_from_world)[:, :3] for k in (i, i + 2)]
        truth = rotations[1] @ rotations[0].T
        assert 18 < degrees(truth, np.eye(3)) < 40
        found = relate(*(find_features(capture.view(k)) for k in (i, i + 2)))
        errors.append(degrees(found.poses[0].rotation, truth) if found.poses else 180)
    assert np.mean(np.array(errors) < 5) >= 0.8, errors


def test_the_same_bits_on_any_number_of_threads(textured):
    whole = textured(0, 120, 260)
    whole = replace(whole, mask=np.ones(whole.image.shape[:2], bool))  # what stays in place is the object
    boxes = [BoundingBox(left, 0, left + 140, 120) for left in (0, 30, 60, 90)]
    threads, found = torch.get_num_threads(), []
    try:
        for count in (1, 3):
            torch.set_num_threads(count)
            found.append(Matcher().geometries([replace(whole, box=box) for box in boxes]))
    finally:
        torch.set_num_threads(threads)
    one, three = found
    assert list(one) == list(three) == list(itertools.combinations(range(4), 2))
    assert any(geometry.poses for geometry in one.values())
    for pair, geometry in one.items():
        assert geometry.probability == three[pair].probability
        assert geometry.inliers.tobytes() == three[pair].inliers.tobytes()
        for a, b in zip(geometry.poses, three[pair].poses, strict=True):
            assert a.rotation.tobytes() == b.rotation.tobytes()
            assert a.covariance.tobytes() == b.covariance.tobytes()


@pytest.mark.parametrize("seed", range(12))
def test_points_that_all_but_coincide_give_rotations_or_nothing(seed):
    generator = np.random.default_rng(seed)
    rays_i = homogeneous(0.1 + 1e-4 * generator.standard_normal((40, 2)))
    rays_j = rays_i.copy()
    rays_j[:, :2] += 1e-4 * generator.standard_normal((40, 2))
    poses = two_view_poses._of_plane(rays_i, rays_j, 1e-3)
    np.testing.assert_allclose(np.linalg.det(poses.rotations), 1, atol=1e-5)
    square = poses.rotations @ poses.rotations.transpose(0, 2, 1)
    np.testing.assert_allclose(square, np.broadcast_to(np.eye(3), square.shape), atol=1e-5)
