from __future__ import annotations

import math

import numpy as np
import pytest

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import homogeneous
from relpose_ros.inference import epipolar
from relpose_ros.inference.epipolar import ANGLES, CAP, Poses
from relpose_ros.inference.local_features import match

PIXEL = 1 / 800


def matched(scene, **noise):
    """Rays of the two views of a scene, matched."""
    first, second = scene.features(**noise)
    together = match(first, second)
    return homogeneous(first.rays[together[:, 0]]), homogeneous(second.rays[together[:, 1]])


def truth(scene):
    rotation, direction = scene.relative(0, 1)
    return Poses(rotation[None], direction[None])


def turned(poses, *turns):
    """A pose and others, turned away from it."""
    rotations = so3.exp(np.array([(0.0, 0.0, 0.0), *turns])) @ poses.rotations
    return Poses(rotations, np.repeat(poses.directions, len(rotations), 0))


def test_distances_fall_as_their_derivatives_say(point_scene):
    """At exact points, where the distance's denominator plays no part; of several poses at once."""
    scene = point_scene.ring([0, 30], points=20)
    rays = matched(scene, noise=0)
    poses = truth(scene) + truth(scene)
    distances, jacobian, across = epipolar.linearised(poses, *rays)
    np.testing.assert_allclose(distances, 0, atol=1e-9)
    np.testing.assert_allclose(across @ poses.directions[..., None], 0, atol=1e-12)
    for column, step in enumerate(1e-6 * np.eye(5)):
        ahead, behind = (
            epipolar.distances(poses.moved(np.stack([s, s]), across), *rays) for s in (step, -step)
        )
        np.testing.assert_allclose(jacobian[..., column], (ahead - behind) / 2e-6, atol=1e-5)


def test_a_distance_is_that_from_the_epipolar_line(point_scene):
    """A match moved across its line by a little, in one picture of two: Sampson's share of it."""
    scene = point_scene.ring([0, 30], points=20)
    rays_i, rays_j = matched(scene, noise=0)
    pose = truth(scene)
    lines = np.cross(pose.directions, rays_i @ pose.rotations[0].T)
    normals = lines[:, :2] / np.linalg.norm(lines[:, :2], axis=1, keepdims=True)
    moved = rays_j + 0.002 * np.concatenate([normals, np.zeros((20, 1))], 1)
    back = np.linalg.norm((np.cross(rays_j, pose.directions) @ pose.rotations[0])[:, :2], axis=1)
    there = np.linalg.norm(lines[:, :2], axis=1)
    found = epipolar.distances(pose, rays_i, moved)[0]
    np.testing.assert_allclose(found, 0.002 * there / np.hypot(there, back), rtol=2e-2)


def test_points_lie_in_front_of_the_true_cameras_alone(point_scene):
    scene = point_scene.ring([0, 30])
    rays = matched(scene, noise=0)
    pose = truth(scene)
    about = so3.exp(np.pi * pose.directions) @ pose.rotations  # the essential matrix's other rotation
    others = Poses(
        np.stack([pose.rotations[0], about[0]]), np.stack([-pose.directions[0], pose.directions[0]])
    )
    assert epipolar.in_front(pose, *rays).all()
    assert not epipolar.in_front(others, *rays).any()
    facing = epipolar.facing(others[:1], *rays)
    np.testing.assert_array_equal(facing.directions, pose.directions)


def test_costs_are_least_at_the_truth_and_a_wrong_match_costs_no_more_than_the_cap(point_scene):
    scene = point_scene.ring([0, 30], points=100)
    rays_i, rays_j = matched(scene, noise=0)
    poses = turned(truth(scene), (0.01, 0, 0), (0, 0.1, 0), (0, 0, 0.5))
    costs = epipolar.costs(poses, rays_i, rays_j, PIXEL)
    assert costs[0] < 1e-6
    assert (np.diff(costs) > 0).all()
    wrong = rays_j.copy()
    wrong[7, :2] += 10
    dearer = epipolar.costs(poses[:1], rays_i, wrong, PIXEL)
    assert dearer[0] == pytest.approx(math.log1p(CAP**2))
    behind = Poses(poses.rotations[:1], -poses.directions[:1])
    assert epipolar.costs(behind, rays_i, rays_j, PIXEL)[0] == pytest.approx(100 * math.log1p(CAP**2))


def test_refined_poses_are_the_truth_despite_outliers(point_scene):
    scene = point_scene.ring([0, 30])
    rays = matched(scene, outliers=40)
    starts = turned(truth(scene), (0.05, 0, 0), (0, 0.06, 0), (0.02, -0.03, 0.04))
    found = epipolar.refine(starts, *rays, PIXEL)
    errors = np.degrees(so3.angle_between(found.rotations, starts.rotations[:1]))
    assert errors.max() < 0.5
    np.testing.assert_allclose(np.linalg.norm(found.directions, axis=1), 1)
    # Each by itself: to the bit what it is without the others.
    alone = epipolar.refine(starts[1:2], *rays, PIXEL)
    np.testing.assert_allclose(alone.rotations[0], found.rotations[1], atol=1e-9)


@pytest.mark.parametrize("roll", [0.0, 2.0])
@pytest.mark.parametrize("angle", [18, -44])
def test_the_family_of_a_pose_keeps_its_epipolar_lines(point_scene, angle, roll):
    """Whatever angle a pose of orthographic views has, the true one is in its family."""
    scene = point_scene.ring([0, angle], points=100)
    scene.rotations[1] = so3.exp([0, 0, roll]) @ scene.rotations[1]
    scene.translations[1] = so3.exp([0, 0, roll]) @ scene.translations[1]
    # From ten times as far away, ten times as narrow.
    scene.points /= 10
    rays = matched(scene, noise=0)
    for found in (truth(scene), epipolar.turned_along(truth(scene), *rays, PIXEL / 10)[9:10]):
        family = epipolar.turned_along(found, *rays, PIXEL / 10)
        assert len(family) == len(ANGLES)
        errors = np.degrees(so3.angle_between(family.rotations, truth(scene).rotations[0]))
        assert errors.min() < 1
        # All of it explains the matches but for the perspective that there is; a rolled camera does not.
        near = np.abs(ANGLES) < math.radians(50)
        largest = np.abs(epipolar.distances(family, *rays)).max(1)[near].max()
        assert largest < 0.001
        assert np.abs(epipolar.distances(turned(found, (0, 0, 0.3)), *rays)[1]).max() > 3 * largest
