"""Cameras: where they stand, what they see, and the world about the point they look at."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.geometry import cameras, so3
from relpose_ros.views import Intrinsics

seeds = st.integers(0, 2**31)
INTRINSICS = Intrinsics(500, 520, 320, 240)


def ring(seed: int, count: int = 5) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Cameras all around a random point, exactly facing it: rotations, translations, the point."""
    generator = np.random.default_rng(seed)
    point = generator.normal(size=3)
    directions = generator.normal(size=(count, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    centres = point + directions * generator.uniform(1, 4, (count, 1))
    rotation = cameras.look_at(centres, point, up=generator.normal(size=3))
    return rotation, cameras.translation_of(rotation, centres), point


@given(seeds)
def test_centre_and_translation_are_inverse_and_the_centre_maps_to_zero(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rotation, translation = so3.random_rotations(4, generator), generator.normal(size=(4, 3))
    centre = cameras.camera_centre(rotation, translation)
    assert np.einsum("nij,nj->ni", rotation, centre) + translation == pytest.approx(
        np.zeros((4, 3)), abs=1e-12
    )
    assert cameras.translation_of(rotation, centre) == pytest.approx(translation, abs=1e-12)


@given(seeds)
def test_a_camera_that_looks_at_a_point_sees_it_in_the_middle_and_upright(seed: int) -> None:
    generator = np.random.default_rng(seed)
    centre, target, up = generator.normal(size=(3, 3))
    rotation = cameras.look_at(centre, target, up)
    assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-9)
    assert np.linalg.det(rotation) == pytest.approx(1)
    points = np.stack([target, target + 0.01 * up])
    pixels = cameras.project_points(points, rotation, cameras.translation_of(rotation, centre), INTRINSICS)
    assert pixels[0] == pytest.approx([320, 240], abs=1e-6)
    assert pixels[1, 0] == pytest.approx(320, abs=1e-6)
    assert pixels[1, 1] < 240


def test_a_camera_that_looks_along_up_gets_some_rotation() -> None:
    rotation = cameras.look_at([0, 0, 3], [0, 0, 0])
    assert rotation @ rotation.T == pytest.approx(np.eye(3))
    assert rotation[2] == pytest.approx([0, 0, -1])


def test_projection_by_hand() -> None:
    points = [[0.2, 0.1, 2.0], [0, 0, -1], [0, 0, 0]]
    pixels = cameras.project_points(points, np.eye(3), np.zeros(3), INTRINSICS)
    assert pixels[0] == pytest.approx([500 * 0.1 + 320, 520 * 0.05 + 240])
    assert np.isnan(pixels[1:]).all()


@given(seeds)
def test_the_closest_point_to_axes_that_meet_is_where_they_meet(seed: int) -> None:
    rotation, translation, point = ring(seed)
    found = cameras.closest_point_to_axes(rotation, cameras.camera_centre(rotation, translation))
    assert found == pytest.approx(point, abs=1e-6)


@given(seeds)
def test_the_closest_point_has_the_least_distance_to_axes_that_do_not_meet(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rotation, centres = so3.random_rotations(4, generator), generator.normal(size=(4, 3))

    def cost(point: np.ndarray) -> float:
        offset = point - centres
        along = (offset * rotation[:, 2]).sum(1, keepdims=True)
        return float(((offset - along * rotation[:, 2]) ** 2).sum())

    found = cameras.closest_point_to_axes(rotation, centres)
    for _ in range(20):
        assert cost(found) <= cost(found + 0.1 * generator.normal(size=3)) + 1e-12


def test_parallel_axes_give_the_point_nearest_to_the_cameras() -> None:
    centres = np.array([[0.0, 0, 0], [2, 0, 1]])
    found = cameras.closest_point_to_axes(np.broadcast_to(np.eye(3), (2, 3, 3)), centres)
    assert found == pytest.approx([1, 0, 0.5])


@given(seeds)
def test_look_at_translations_put_the_object_ahead_of_each_camera_at_its_relative_distance(seed: int) -> None:
    rotation, translation, point = ring(seed)
    moved, found, scale = cameras.look_at_translations(rotation, translation)
    distance = np.linalg.norm(cameras.camera_centre(rotation, translation) - point, axis=1)
    assert found == pytest.approx(point, abs=1e-6)
    assert scale == pytest.approx(1 / distance[0])
    expected = np.stack([0 * distance, 0 * distance, distance / distance[0]], -1)
    assert moved == pytest.approx(expected, abs=1e-6)


@given(seeds)
def test_look_at_translations_do_not_depend_on_the_world(seed: int) -> None:
    generator = np.random.default_rng(seed)
    rotation = so3.random_rotations(5, generator)
    translation = generator.normal(size=(5, 3))
    moved, point, scale = cameras.look_at_translations(rotation, translation)
    assert np.linalg.norm(moved[0]) == pytest.approx(1)
    # x = s' Q x' + b: another origin, other axes, another unit.
    (turn,), shift, unit = (
        so3.random_rotations(1, generator),
        generator.normal(size=3),
        generator.uniform(0.2, 5),
    )
    other = cameras.look_at_translations(rotation @ turn, (translation + rotation @ shift) / unit)
    assert other[0] == pytest.approx(moved, abs=1e-6)
    # The centres in the new world are the old ones about the point, in the new unit.
    old_centres = cameras.camera_centre(rotation, translation)
    new_centres = cameras.camera_centre(rotation, moved)
    assert new_centres == pytest.approx((old_centres - point) * scale, abs=1e-6)


@given(seeds)
def test_first_camera_translations_measure_from_the_first_camera_in_the_same_unit(seed: int) -> None:
    rotation, translation, point = ring(seed)
    centres = cameras.camera_centre(rotation, translation)
    targets = cameras.first_camera_translations(rotation, translation)
    assert targets[0] == pytest.approx(np.zeros(3), abs=1e-12)
    expected = (centres - centres[0]) / np.linalg.norm(centres[0] - point)
    assert cameras.camera_centre(rotation, targets) == pytest.approx(expected, abs=1e-6)
