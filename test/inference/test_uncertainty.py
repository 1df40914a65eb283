from __future__ import annotations

import itertools
import math
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.estimates import Evidence, PairRotation, Verdict
from relpose_ros.geometry import so3
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.global_rotations import solve
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies
from relpose_ros.inference.rotation_evidence import Peak, RotationEvidence
from relpose_ros.inference.uncertainty import (
    SOLVER_FLOOR,
    _turns,
    camera_covariances,
    describe_pairs,
    heaviest_modes,
)
from relpose_ros.inference.verdict import judge, without_room

UNCALIBRATED = Calibration()
UNIFORM_VARIANCE = (math.pi**2 / 3 + 2) / 3  # per axis, of a uniformly random rotation's vector


def told(scene, calibration=UNCALIBRATED, translations=None):
    """Pairs, covariances and the solution of a scene."""
    if translations is None:
        translations = np.tile([0.0, 0.0, 1.0], (len(scene), 1))
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, len(scene))
        distributions = search(energies, GridEmbeddings(scene))
        solutions = solve(energies, distributions)
        pairs = describe_pairs(distributions, energies, solutions.rotations[0], calibration)
        sigmas = np.tile(calibration.position_sigma, (len(scene), 1))
        covariances = camera_covariances(
            distributions, energies, solutions.rotations[0], translations, calibration, sigmas
        )
    return pairs, covariances, solutions.rotations[0].numpy()


def test_a_sharp_pair_has_the_covariance_of_its_density(fisher_scene, cameras_around):
    """Near its mode the energy is -k |w|^2: a Gaussian of variance 1 / 2k per axis."""
    (pair,), _, _ = told(fisher_scene(cameras_around(2, 0), concentration=20.0))
    np.testing.assert_allclose(pair.covariance, np.eye(3) / 40, atol=0.004)
    np.testing.assert_allclose(pair.modes[0].covariance, pair.covariance, atol=0.004)
    assert pair.evidence is Evidence.LEARNED
    assert not pair.ambiguous
    assert pair.ambiguity_angle == 0
    assert pair.solution_angle < 1e-2
    assert pair.entropy < -3


def test_the_heaviest_mode_is_not_the_highest(fisher_scene, cameras_around):
    """A narrow peak e times as high as a broad one holds a fiftieth of its probability."""
    scene = fisher_scene(cameras_around(2, 0))
    broad, narrow = scene.relative(0, 1), so3.exp([0, 2.0, 0]) @ scene.relative(0, 1)
    scene.mixtures[0, 1] = [(broad, 0.0, 8.0), (narrow, 1.0, 250.0)]
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, 2)
        distributions = search(energies, GridEmbeddings(scene))
        heaviest = heaviest_modes(distributions)
        told = solve(energies, heaviest).rotations[0, 1].numpy()
    assert math.degrees(so3.angle_between(distributions.modes[0, 0].numpy(), narrow)) < 1
    assert heaviest.modes.shape == (1, 1, 3, 3)
    assert heaviest.mode_energies[0, 0] < distributions.mode_energies[0, 0] - 0.5
    assert math.degrees(so3.angle_between(told, broad)) < 2


def test_how_far_the_poses_are_from_a_pair_is_told_of_its_modes_alone(fisher_scene, cameras_around):
    """A pair that is sure of something else, and has a peak of a thousandth where the others put it."""
    scene = fisher_scene(cameras_around(3, 0))
    true, wrong = scene.relative(0, 1), so3.exp([0, 2.5, 0]) @ scene.relative(0, 1)
    scene.mixtures[0, 1] = [(wrong, 0.0, 40.0), (true, -5.0, 200.0)]
    for pair in ((0, 2), (1, 2)):
        scene.mixtures[pair] = [(scene.relative(*pair), 0.0, 400.0)]
    pairs, _, solution = told(scene)
    assert math.degrees(so3.angle_between(solution[1], true)) < 1
    assert len(pairs[0].modes) == 1
    assert pairs[0].solution_angle == pytest.approx(2.5, abs=0.05)
    assert pairs[1].solution_angle < 0.01


def test_each_mode_has_a_covariance_of_its_own(fisher_scene, cameras_around):
    """The heavier mode comes first, and the narrow one is the higher."""
    scene = fisher_scene(cameras_around(2, 0))
    broad, narrow = scene.relative(0, 1), so3.exp([0, 2.0, 0]) @ scene.relative(0, 1)
    scene.mixtures[0, 1] = [(broad, 0.0, 8.0), (narrow, 2.0, 100.0)]
    (pair,), _, _ = told(scene)
    angles = [math.degrees(so3.angle_between(mode.camera_j_from_camera_i, broad)) for mode in pair.modes[:2]]
    assert angles[0] < 3 < 100 < angles[1]
    first, second = (np.trace(mode.covariance) / 3 for mode in pair.modes[:2])
    assert first == pytest.approx(1 / 16, rel=0.3)
    assert second == pytest.approx(1 / 200, rel=0.5)


def test_only_what_the_network_says_alone_is_widened_by_its_factor(fisher_scene, cameras_around):
    """The width of a matched peak is fitted by itself."""
    scene = fisher_scene(cameras_around(3, 0), concentration=20.0)
    peaks = [[Peak(scene.relative(0, 1), 1e-3 * np.eye(3), 0.9)], [], []]
    energies = PairEnergies.of(scene, scene, 3, evidence=RotationEvidence(peaks))
    distributions = search(energies, GridEmbeddings(scene))
    plain, widened = (
        describe_pairs(
            distributions, energies, torch.from_numpy(scene.cameras), Calibration(pair_spread=factor)
        )
        for factor in (1.0, 4.0)
    )
    for before, after, factor in zip(plain, widened, (1, 4, 4), strict=True):
        np.testing.assert_allclose(after.covariance, factor * before.covariance)
        np.testing.assert_allclose(after.modes[0].covariance, factor * before.modes[0].covariance)


def test_the_cameras_rotations_are_widened_by_their_factor(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(3, 2), concentration=50.0)
    plain, widened = (told(scene, Calibration(rotation_spread=factor))[1] for factor in (1.0, 4.0))
    np.testing.assert_allclose(widened[1:, 3:, 3:], 4 * plain[1:, 3:, 3:], rtol=0.01, atol=1e-5)


def test_only_where_matches_are_sure_is_a_gross_error_no_part_of_the_covariance(fisher_scene, cameras_around):
    """A sharp peak, and otherwise any rotation: of three in five the rest counts, of 97 in a hundred not."""
    scene = fisher_scene(cameras_around(2, 4), concentration=0.0)
    deviations = []
    for chance in (0.6, 0.97):
        evidence = RotationEvidence([[Peak(scene.relative(0, 1), 1e-4 * np.eye(3), chance)]])
        energies = PairEnergies.of(scene, scene, 2, evidence=evidence)
        covariances = camera_covariances(
            search(energies, GridEmbeddings(scene)),
            energies,
            torch.from_numpy(scene.cameras),
            np.tile([0.0, 0.0, 1.0], (2, 1)),
            UNCALIBRATED,
            np.full((2, 2), 0.1),
        )
        deviations.append(math.degrees(math.sqrt(np.trace(covariances[1, 3:, 3:]) / 3)))
    assert deviations[0] > 30
    assert deviations[1] < 3


def test_the_first_cameras_distance_is_the_unit(fisher_scene, cameras_around):
    calibration = Calibration(position_sigma=(0.02, 0.05))
    _, covariances, _ = told(fisher_scene(cameras_around(3, 5)), calibration)
    assert covariances[0, 2, 2] == pytest.approx(SOLVER_FLOOR**2, rel=0.01)
    np.testing.assert_allclose(np.diag(covariances[0, :2, :2]), 0.02**2, rtol=0.02)


def test_a_camera_that_may_look_any_way_may_stand_anywhere_around_the_object(fisher_scene, cameras_around):
    """Half of the time on the other side of it."""
    calibration = Calibration(position_sigma=(0.01, 0.01))
    _, covariances, rotations = told(fisher_scene(cameras_around(2, 3), concentration=0.0), calibration)
    ray = rotations[1].T @ [0, 0, 1]
    along = ray @ covariances[1, :3, :3] @ ray
    draws = so3.random_rotations(20_000, np.random.default_rng(0))[:, 2, 2] - 1
    assert 0.5 * (draws**2).mean() < along < 2 * (draws**2).mean() + 2


def test_a_modes_covariance_is_that_of_its_core_and_the_total_one_holds_all(fisher_scene, cameras_around):
    """A sharp peak, a sixth of near misses ten degrees off, a twentieth that may be anywhere."""
    scene = fisher_scene(cameras_around(2, 0))
    true = scene.relative(0, 1)
    sharp = 400.0
    # exp(-k |w|^2) holds (pi / k)^(3/2) of the 8 pi^2 that all rotations have.
    heights = [(share * 8 * math.sqrt(math.pi) * k**1.5, k) for share, k in ((0.8, sharp), (0.15, 30.0))]
    scene.mixtures[0, 1] = [(true, math.log(height), k) for height, k in [*heights, (0.05, 0.0)]]
    (pair,), _, _ = told(scene)
    exact = 1 / (2 * sharp)
    own = np.trace(pair.modes[0].covariance) / 3
    assert exact < own < 2.5 * exact
    assert np.trace(pair.covariance) / 3 > 5 * exact
    assert pair.modes[0].weight > 0.85


@pytest.mark.parametrize("concentration", [5.0, 20.0, 80.0])
def test_probability_within_15_degrees_is_that_of_the_density(fisher_scene, cameras_around, concentration):
    (pair,), _, _ = told(fisher_scene(cameras_around(2, 1), concentration))
    angles = np.linspace(0, math.pi, 20_001)
    density = np.exp(2 * concentration * (np.cos(angles) - 1)) * (1 - np.cos(angles))
    inside = density[angles <= math.radians(15)].sum() / density.sum()
    assert pair.probability_within_15_deg == pytest.approx(inside, abs=0.05)
    assert pair.solution_probability == pytest.approx(inside, abs=0.05)


def test_temperature_spreads_a_pair(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(2, 2), concentration=20.0)
    (pair,), _, _ = told(scene, Calibration(temperature=4.0))
    np.testing.assert_allclose(pair.covariance, np.eye(3) / 10, atol=0.02)


def test_a_flat_pair_knows_nothing_and_is_not_called_ambiguous(fisher_scene, cameras_around):
    (pair,), covariances, _ = told(fisher_scene(cameras_around(2, 3), concentration=0.0))
    assert pair.entropy == pytest.approx(0, abs=1e-6)
    assert pair.probability_within_15_deg < 0.01
    assert not pair.ambiguous
    np.testing.assert_allclose(pair.covariance, UNIFORM_VARIANCE * np.eye(3), rtol=0.1, atol=0.05)
    assert np.linalg.eigvalsh(covariances[1, 3:, 3:])[0] > 0.8 * UNIFORM_VARIANCE


@given(angle=st.floats(60, 180), share=st.floats(0.25, 0.48), seed=st.integers(0, 1000))
@settings(max_examples=12)
def test_a_symmetric_pair_is_ambiguous_by_its_angle_and_weights(fisher_scene_type, angle, share, seed):
    scene_type, cameras_around = fisher_scene_type
    scene = scene_type(cameras_around(2, seed))
    true = scene.relative(0, 1)
    other = so3.exp([0, math.radians(angle), 0]) @ true
    scene.mixtures[0, 1] = [(true, math.log(1 - share), 60.0), (other, math.log(share), 60.0)]
    (pair,), covariances, _ = told(scene)
    assert pair.ambiguous
    assert math.degrees(pair.ambiguity_angle) == pytest.approx(angle, abs=3)
    assert [mode.weight for mode in pair.modes[:2]] == pytest.approx([1 - share, share], abs=0.08)
    # The other explanation is a turn about camera 1's y axis, and shows in its variance.
    own = scene.cameras[1] @ covariances[1, 3:, 3:] @ scene.cameras[1].T
    assert own[1, 1] > 0.5 * share * math.radians(angle) ** 2
    assert own[1, 1] > 5 * own[0, 0]


def test_covariance_follows_curvature_and_grows_where_views_are_fewer_tied(fisher_scene, cameras_around):
    """A chain 0-1-2 whose pair 0-2 says nothing: each link adds its variance."""
    scene = fisher_scene(cameras_around(3, 4), concentration=50.0)
    scene.mixtures[0, 2] = [(np.eye(3), 0.0, 0.0)]
    _, covariances, _ = told(scene)
    # The joint energy is divided by N / 2, so a link of variance 1 / 2k counts as 1.5 / 2k.
    np.testing.assert_allclose(covariances[1, 3:, 3:], np.eye(3) * 1.5 / 100, atol=0.002)
    np.testing.assert_allclose(covariances[2, 3:, 3:], np.eye(3) * 3.0 / 100, atol=0.004)


def test_pairs_that_say_nothing_say_no_more_together(fisher_scene, cameras_around):
    """Cameras tied to each other, and by nothing to the first: each may look any way."""
    for views, tied in ((3, (1, 2)), (5, (1, 2, 4))):
        scene = fisher_scene(cameras_around(views, 6), concentration=0.0)
        for i, j in itertools.combinations(tied, 2):
            scene.mixtures[i, j] = [(scene.relative(i, j), 0.0, 200.0)]
        _, covariances, _ = told(scene)
        for covariance in covariances[1:]:
            np.testing.assert_allclose(covariance[3:, 3:], UNIFORM_VARIANCE * np.eye(3), rtol=0.15, atol=0.1)


def test_two_groups_tied_by_matches_know_each_other_as_one_pair_would(fisher_scene, cameras_around):
    """Six pairs between them, all with the same mistake to make, hold no better than one does.

    Nor do they where nothing ties the views, and each has an error of its own.
    """
    scene = fisher_scene(cameras_around(5, 7), concentration=1.5)
    peaks = [
        [Peak(scene.relative(i, j), 1e-4 * np.eye(3), 0.99)] if (i < 2) == (j < 2) else []
        for i, j in itertools.combinations(range(5), 2)
    ]
    translations = np.tile([0.0, 0.0, 1.0], (5, 1))
    for evidence in (RotationEvidence(peaks), None):
        energies = PairEnergies.of(scene, scene, 5, evidence=evidence)
        distributions = search(energies, GridEmbeddings(scene))
        solution = torch.from_numpy(scene.cameras)
        pairs = describe_pairs(distributions, energies, solution, UNCALIBRATED)
        covariances = camera_covariances(
            distributions,
            energies,
            solution,
            translations,
            UNCALIBRATED,
            np.full((len(translations), 2), 0.1),
        )
        variances = np.trace(covariances[:, 3:, 3:], axis1=1, axis2=2) / 3
        across = np.mean([np.trace(pair.covariance) / 3 for pair in pairs if pair.i < 2 <= pair.j])
        np.testing.assert_allclose(variances[2:], across, rtol=0.1)
        assert variances[1] < 0.01 if evidence else variances[1] == pytest.approx(across, rel=0.1)


@given(
    seed=st.integers(0, 1000),
    views=st.integers(2, 4),
    concentration=st.sampled_from([0.0, 1.0, 30.0, 1000.0]),
)
@settings(max_examples=8)
def test_covariances_are_never_placeholders(fisher_scene_type, seed, views, concentration):
    scene_type, cameras_around = fisher_scene_type
    translations = np.random.default_rng(seed).normal([0, 0, 1], 0.1, (views, 3))
    _, covariances, _ = told(
        scene_type(cameras_around(views, seed), concentration), translations=translations
    )
    for covariance in covariances:
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 1e-8
        assert np.linalg.eigvalsh(covariance[3:, 3:])[0] >= SOLVER_FLOOR**2 * 0.999
        assert not np.allclose(covariance, np.eye(6))
    np.testing.assert_allclose(covariances[0, 3:, 3:], SOLVER_FLOOR**2 * np.eye(3), atol=1e-12)


def test_a_mode_that_owns_no_mass_is_not_told_to_be_exact(fisher_scene, cameras_around):
    scene = fisher_scene(cameras_around(2, 0), concentration=200.0)
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, 2)
        found = search(energies, GridEmbeddings(scene))
        away = torch.from_numpy(so3.exp([2.0, 0, 0])) @ found.modes[:, :1]
        alone = replace(found, modes=away, mode_energies=found.mode_energies[:, :1])
        (pair,) = describe_pairs(alone, energies, solve(energies, found).rotations[0], UNCALIBRATED)
    assert pair.modes[0].weight < 1e-9
    assert np.linalg.eigvalsh(pair.modes[0].covariance)[0] > 1e-6


def test_position_and_rotation_covary_as_a_camera_on_a_lever(fisher_scene, cameras_around):
    """Against a sample: turns of the camera about the object move its centre too."""
    scene = fisher_scene(cameras_around(2, 5), concentration=200.0)
    translations = np.array([[0.0, 0.0, 1.0], [0.7, -0.5, 1.8]])
    calibration = Calibration(position_sigma=(0.02, 0.05))
    _, covariances, rotations = told(scene, calibration, translations)
    rng = np.random.default_rng(0)
    turns = rng.normal(0, math.sqrt(1 / 400), (40_000, 3))  # of the camera, in its own axes
    across, along = rng.normal(0, 0.02, (40_000, 3)), rng.normal(0, 0.05, (40_000, 1))
    ray = translations[1] / np.linalg.norm(translations[1])
    shifts = across - (across @ ray)[:, None] * ray + along * ray
    turned = so3.exp(turns) @ rotations[1]
    centres = -np.einsum("nji,nj->ni", turned, translations[1] + shifts)
    seen = so3.log(turned.transpose(0, 2, 1) @ rotations[1])  # fixed axes of the object
    sample = np.cov(np.concatenate([centres, seen], 1).T)
    np.testing.assert_allclose(covariances[1], sample, atol=0.06 * np.abs(sample).max())


def test_enough_needs_trusted_pairs_and_calibrated_ones(fisher_scene, cameras_around):
    pairs, covariances, _ = told(fisher_scene(cameras_around(3, 6), concentration=150.0))
    verdict, _, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ENOUGH
    assert words.startswith("enough: 3 of 3 pairs agree")
    verdict, _, words = judge(pairs, covariances, calibrated=False)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert words.startswith("not enough: these weights are not calibrated")


@pytest.mark.parametrize(
    ("keep", "advice"),
    [
        ("first", "the scan is full: drop_last_view makes room for another view, reset for all"),
        ("latest", "take one more view: it takes the place of the oldest"),
        (
            "spread",
            (
                "drop_last_view makes room for a view near that pair, "
                "and one from a new direction takes the place of the view that tells least"
            ),
        ),
    ],
)
def test_a_full_scan_is_told_what_to_do_instead_of_one_more_view(keep, advice):
    words = without_room("one more view: pair 2-5 is ambiguous by about 180 degrees", keep)
    assert words == f"not enough: pair 2-5 is ambiguous by about 180 degrees; {advice}"


@pytest.mark.parametrize(
    "words", ["enough: 3 of 3 pairs agree", "not enough: these weights are not calibrated"]
)
def test_what_asks_for_no_view_stays_as_it_is(words):
    assert without_room(words, "spread") == words


def test_the_verdict_names_the_ambiguous_pair(fisher_scene, cameras_around):
    """View 2 is tied by pairs that cannot tell front from back."""
    scene = fisher_scene(cameras_around(3, 7), concentration=150.0)
    flip = so3.exp([0, math.pi, 0])
    for i in (0, 1):
        true = scene.relative(i, 2)
        scene.mixtures[i, 2] = [(true, 0.0, 150.0), (flip @ true, 0.0, 150.0)]
    pairs, covariances, _ = told(scene)
    verdict, weakest, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert (pairs[weakest].i, pairs[weakest].j) in [(0, 2), (1, 2)]
    assert words == f"one more view: pair {pairs[weakest].i}-2 is ambiguous by about 180 degrees"


def test_a_chain_of_good_pairs_is_enough(fisher_scene, cameras_around):
    """Pair 0-2 says nothing, and need not: others tie both views."""
    scene = fisher_scene(cameras_around(4, 8), concentration=300.0)
    scene.mixtures[0, 2] = [(np.eye(3), 0.0, 0.0)]
    pairs, covariances, _ = told(scene)
    verdict, weakest, _ = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ENOUGH
    assert (pairs[weakest].i, pairs[weakest].j) == (0, 2)


def test_a_pair_that_nothing_checks_is_not_enough(fisher_scene, cameras_around):
    pairs, covariances, _ = told(fisher_scene(cameras_around(2, 8), concentration=300.0))
    verdict, weakest, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert weakest == 0
    assert words == "one more view: view 1 hangs on pair 0-1 alone, which no other pair checks"
    scene = fisher_scene(cameras_around(3, 8), concentration=300.0)
    scene.mixtures[0, 2] = [(np.eye(3), 0.0, 0.0)]
    pairs, covariances, _ = told(scene)
    assert judge(pairs, covariances, calibrated=True)[0] is Verdict.ONE_MORE_VIEW


def test_a_picture_taken_twice_checks_nothing(fisher_scene, cameras_around):
    """Views 0 and 1 are of one place, and so are 2 and 3: all else rests on what is one pair of pictures."""
    two = cameras_around(2, 8)
    twice = two[[0, 0, 1, 1]]
    twice[1] = so3.exp([0.01, 0.0, 0.01]) @ twice[1]
    pairs, covariances, _ = told(fisher_scene(twice, concentration=300.0))
    verdict, weakest, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert {pairs[weakest].i, pairs[weakest].j} & {0, 1}
    assert {pairs[weakest].i, pairs[weakest].j} & {2, 3}
    assert "which no other pair checks" in words
    three = cameras_around(3, 8)[[0, 0, 1, 2]]
    assert judge(*told(fisher_scene(three, concentration=300.0))[:2], True)[0] is Verdict.ENOUGH


def test_with_a_guessed_focal_length_matches_are_not_enough(fisher_scene, cameras_around):
    pairs, covariances, _ = told(fisher_scene(cameras_around(3, 6), concentration=150.0))
    assert judge(pairs, covariances, True, guessed=True)[0] is Verdict.ENOUGH, "the network needs none"
    matched = [replace(pair, evidence=Evidence.LEARNED | Evidence.GEOMETRIC) for pair in pairs]
    assert judge(matched, covariances, True)[0] is Verdict.ENOUGH
    verdict, _, words = judge(matched, covariances, True, guessed=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert words.startswith("not enough: the camera's focal length is a guess")


def test_two_groups_that_one_pair_ties_are_not_enough(fisher_scene, cameras_around):
    """Every view has two sure pairs, and yet half of them may be turned by what the one pair is wrong by."""
    scene = fisher_scene(cameras_around(6, 8), concentration=300.0)
    for i, j in itertools.product(range(3), range(3, 6)):
        if (i, j) != (2, 3):
            scene.mixtures[i, j] = [(np.eye(3), 0.0, 0.0)]
    pairs, covariances, _ = told(scene)
    verdict, weakest, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert (pairs[weakest].i, pairs[weakest].j) == (2, 3)
    assert words == "one more view: views 3, 4 and 5 hang on pair 2-3 alone, which no other pair checks"
    scene.mixtures[1, 4] = [(scene.relative(1, 4), 0.0, 300.0)]
    pairs, covariances, _ = told(scene)
    assert judge(pairs, covariances, calibrated=True)[0] is Verdict.ENOUGH


@pytest.mark.parametrize("turn_deg", [(0, 25, 0), (0, 0, 90)], ids=["pans", "rolls"])
def test_a_camera_that_turns_in_its_place_checks_nothing(fisher_scene, cameras_around, turn_deg):
    two = cameras_around(2, 3)
    turn = so3.exp(np.radians(turn_deg))
    scene = fisher_scene(np.stack([*two, turn @ two[1]]), concentration=300.0)
    pairs, covariances, _ = told(scene)
    ahead = np.array([0.0, 0, 1])
    seen = np.stack([ahead, ahead, turn @ ahead])
    verdict, _, words = judge(pairs, covariances, True, seen=seen)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert "which no other pair checks" in words
    elsewhere = np.stack([ahead, ahead, so3.exp(np.radians([15, 0, 0])) @ turn @ ahead])
    assert judge(pairs, covariances, True, seen=elsewhere)[0] is Verdict.ENOUGH


def test_contradicting_pairs_are_not_enough(fisher_scene, cameras_around):
    """Three sharp pairs around a loop that does not close."""
    scene = fisher_scene(cameras_around(3, 9), concentration=100.0)
    lie = so3.exp([2.0, 0, 0]) @ scene.relative(0, 2)
    scene.mixtures[0, 2] = [(lie, 0.0, 100.0)]
    pairs, covariances, _ = told(scene)
    verdict, _, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert "contradicts the others" in words


@pytest.mark.parametrize("lies", [[(0, 3)], [(0, 3), (1, 4)]], ids=["one", "two"])
def test_of_ten_sure_pairs_one_may_be_outvoted_and_two_may_not(fisher_scene, cameras_around, lies):
    scene = fisher_scene(cameras_around(5, 9), concentration=300.0)
    for i, j in lies:
        lie = so3.exp([1.2, 0, 0]) @ scene.relative(i, j)
        scene.mixtures[i, j] = [(lie, 0.0, 60.0), (np.eye(3), -11.0, 0.0)]  # nearly sure: it can be outvoted
    pairs, covariances, _ = told(scene)
    agreeing = [pair.solution_probability > 0.5 for pair in pairs]
    assert [(pair.i, pair.j) in lies for pair in pairs] == [not agrees for agrees in agreeing]
    verdict, weakest, words = judge(pairs, covariances, calibrated=True)
    if len(lies) == 1:
        assert verdict is Verdict.ENOUGH
        return
    assert verdict is Verdict.ONE_MORE_VIEW
    assert (pairs[weakest].i, pairs[weakest].j) in lies
    assert words.startswith("one more view: 8 of 10 pairs agree, but 2 are as sure of something else: pair ")
    assert words.endswith("contradicts the others by about 69 degrees")


@pytest.mark.parametrize(("deviation_deg", "enough"), [(7.4, True), (7.6, False)])
def test_enough_means_fifteen_degrees_at_two_standard_deviations(
    fisher_scene, cameras_around, deviation_deg, enough
):
    pairs, covariances, _ = told(fisher_scene(cameras_around(3, 6), concentration=150.0))
    covariances = covariances.copy()
    covariances[1, 3:, 3:] = np.diag(np.radians([2.0, deviation_deg, 3.0]) ** 2)
    verdict, _, words = judge(pairs, covariances, calibrated=True)
    assert (verdict is Verdict.ENOUGH) is enough
    assert enough or words.startswith("one more view: rotations are known to about 8 degrees only")


def pairs_of(views, **others):
    """Pairs as sure as agreeing; ``p12=(0.9, 0.3)`` has pair 1-2 be sure by 0.9, and agree by 0.3."""
    cameras = so3.exp(np.arange(views)[:, None] * [0.1, 0.4, 0.0])
    made = []
    for i, j in itertools.combinations(range(views), 2):
        within, agreeing = others.get(f"p{i}{j}", (0.95, 0.95))
        made.append(
            PairRotation(
                i=i,
                j=j,
                camera_j_from_camera_i=cameras[j] @ cameras[i].T,
                covariance=0.01 * np.eye(3),
                entropy=-5.0,
                probability_within_15_deg=within,
                modes=(),
                ambiguous=False,
                ambiguity_angle=0.0,
                solution_probability=agreeing,
                solution_angle=0.0 if agreeing > 0.5 else 1.0,
            )
        )
    return made


EXACT = np.tile(1e-4 * np.eye(6), (8, 1, 1))


def test_a_pair_that_is_sure_of_what_the_poses_are_not_ties_nothing():
    """A chain from view 0 over 3 and 2 to 1, against the order of the views in their pairs."""
    nothing = (0.01, 0.01)
    tied = {"p01": nothing, "p02": nothing, "p13": nothing}
    assert "hangs on pair" in judge(pairs_of(4, **tied), EXACT[:4], True)[2]
    sure_of_else = pairs_of(4, **tied, p12=(0.95, 0.3))
    verdict, weakest, words = judge(sure_of_else, EXACT[:4], True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert "hang" not in words
    assert 1 in (sure_of_else[weakest].i, sure_of_else[weakest].j)


def test_a_pair_that_is_sure_and_does_not_quite_agree_contradicts_nothing():
    """One in three of its probability is around the poses."""
    pairs = pairs_of(5, p03=(0.95, 0.35), p14=(0.95, 0.35), p23=(0.95, 0.35))
    assert judge(pairs, EXACT[:5], True)[0] is Verdict.ENOUGH
    pairs = pairs_of(5, p03=(0.95, 0.05), p14=(0.95, 0.05), p23=(0.95, 0.05))
    assert judge(pairs, EXACT[:5], True)[0] is Verdict.ONE_MORE_VIEW


def test_one_contradiction_for_six_pairs_that_agree_is_enough():
    lie, nothing = (0.95, 0.05), (0.01, 0.01)
    outvoted = {"p02": lie, "p03": nothing, "p14": nothing, "p24": nothing}
    assert judge(pairs_of(5, **outvoted), EXACT[:5], True)[0] is Verdict.ENOUGH
    five = {**outvoted, "p13": nothing}
    verdict, _, words = judge(pairs_of(5, **five), EXACT[:5], True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert words.startswith("one more view: 5 of 10 pairs agree, but 1 are as sure of something else")


def test_the_surest_of_the_pairs_that_contradict_is_named():
    pairs = pairs_of(4, p02=(0.7, 0.05), p13=(0.9, 0.05))
    _, weakest, words = judge(pairs, EXACT[:4], True)
    assert (pairs[weakest].i, pairs[weakest].j) == (1, 3)
    assert "pair 1-3 contradicts the others" in words


def test_of_pairs_that_nothing_checks_the_least_certain_is_named():
    """A chain of views: every pair ties what lies beyond it."""
    nothing = (0.01, 0.01)
    pairs = pairs_of(4, p02=nothing, p03=nothing, p13=nothing, p12=(0.9, 0.85))
    _, weakest, words = judge(pairs, EXACT[:4], True)
    assert (pairs[weakest].i, pairs[weakest].j) == (1, 2)
    assert words == "one more view: views 2 and 3 hang on pair 1-2 alone, which no other pair checks"


def test_of_a_scan_that_is_enough_the_weakest_pair_is_the_one_that_agrees_least():
    pairs = pairs_of(4, p12=(0.95, 0.7))
    verdict, weakest, _ = judge(pairs, EXACT[:4], True)
    assert verdict is Verdict.ENOUGH
    assert (pairs[weakest].i, pairs[weakest].j) == (1, 2)


def test_the_weak_link_is_that_of_the_best_chain():
    """View 2 hangs on 1 by four chances in ten, and on 0 by one in ten: a view between 1 and 2 would help."""
    pairs = pairs_of(3, p02=(0.1, 0.1), p12=(0.4, 0.4))
    _, weakest, words = judge(pairs, EXACT[:3], True)
    assert (pairs[weakest].i, pairs[weakest].j) == (1, 2)
    assert words == "one more view: pair 1-2 knows its rotation to 15 degrees with 40% only"


def test_only_matches_that_are_trusted_ask_for_a_known_focal_length():
    pairs = pairs_of(4, p03=(0.3, 0.3))
    both = Evidence.LEARNED | Evidence.GEOMETRIC
    by_matches = [replace(pair, evidence=both) if (pair.i, pair.j) == (0, 3) else pair for pair in pairs]
    assert judge(by_matches, EXACT[:4], True, guessed=True)[0] is Verdict.ENOUGH
    by_matches = [replace(pair, evidence=both) if (pair.i, pair.j) == (0, 2) else pair for pair in pairs]
    assert judge(by_matches, EXACT[:4], True, guessed=True)[0] is Verdict.ONE_MORE_VIEW


def test_a_pair_that_is_not_trusted_does_not_say_that_two_views_are_one():
    """Two that look alike: the pair of 0 and 1 takes them for one place, and the poses do not."""
    pairs = pairs_of(4, p01=(0.95, 0.4), p23=(0.01, 0.01))
    pairs[0] = replace(pairs[0], camera_j_from_camera_i=np.eye(3))
    assert judge(pairs, EXACT[:4], True)[0] is Verdict.ENOUGH
    pairs[0] = replace(pairs[0], solution_probability=0.95)
    assert judge(pairs, EXACT[:4], True)[0] is Verdict.ONE_MORE_VIEW


def test_flat_pairs_are_not_enough(fisher_scene, cameras_around):
    pairs, covariances, _ = told(fisher_scene(cameras_around(4, 10), concentration=0.2))
    verdict, _, words = judge(pairs, covariances, calibrated=True)
    assert verdict is Verdict.ONE_MORE_VIEW
    assert "hardly anything" in words


def test_pairs_come_in_order(fisher_scene, cameras_around):
    pairs, _, _ = told(fisher_scene(cameras_around(4, 11)))
    assert [(pair.i, pair.j) for pair in pairs] == list(itertools.combinations(range(4), 2))


def test_quick_logarithm_is_the_logarithm():
    axis = np.random.default_rng(0).standard_normal((40, 3))
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    angles = np.r_[
        0, 1e-9, 1e-4, 1e-3, np.linspace(0.1, 3.1, 32), math.pi - 1e-3, math.pi - 1e-6, math.pi - 1e-9, 3.14
    ]
    rotations = so3.exp(axis * angles[:, None])
    np.testing.assert_allclose(_turns(torch.from_numpy(rotations)), so3.log(rotations), atol=1e-9)
