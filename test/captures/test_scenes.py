"""Cameras of a scan, and boxes."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.captures import scenes
from relpose_ros.captures.scenes import Motion, ScanStyle
from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import project_points
from relpose_ros.views import Intrinsics


@given(st.integers(0, 10_000), st.floats(5, 180), st.booleans())
def test_steps_between_cameras_stay_within_the_limit(seed: int, largest: float, above: bool) -> None:
    found = scenes.directions(np.random.default_rng(seed), 8, largest, above_ground=above)
    assert np.allclose(np.linalg.norm(found, axis=1), 1)
    steps = np.degrees(np.arccos(np.clip((found[1:] * found[:-1]).sum(1), -1, 1)))
    assert steps.max() <= largest + 1e-6
    elevation = np.degrees(np.arcsin(found[:, 2]))
    assert elevation.min() >= (3.0 if above else -10.0) - 1e-6
    assert elevation.max() <= 85 + 1e-6


def test_cameras_reach_opposite_sides_and_neighbours() -> None:
    angles = []
    for seed in range(60):
        found = scenes.directions(np.random.default_rng(seed), 8, 180)
        angles += np.degrees(np.arccos(np.clip(found @ found.T, -1, 1)))[np.triu_indices(8, 1)].tolist()
    assert min(angles) < 5
    assert max(angles) > 160


@given(st.integers(0, 10_000))
def test_a_box_holds_what_is_in_the_image(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.normal(0, 0.5, (50, 3))
    intrinsics = Intrinsics(300, 310, 160, 120)
    pose = np.column_stack([so3.exp(rng.normal(size=3)), (*rng.normal(0, 1, 2), 4.0)])
    box, complete = scenes.bounding_box(points, pose, intrinsics, 320, 240)
    pixels = project_points(points, pose[:, :3], pose[:, 3], intrinsics)
    inside = ((pixels >= 0) & (pixels <= (320, 240))).all(1)
    assert complete == inside.all()
    seen = pixels[inside]
    assert ((seen >= (box.x0 - 1e-6, box.y0 - 1e-6)) & (seen <= (box.x1 + 1e-6, box.y1 + 1e-6))).all()
    assert 0 <= box.x0 < box.x1 <= 320
    assert 0 <= box.y0 < box.y1 <= 240


@pytest.mark.parametrize("motion", Motion)
def test_what_moves_between_views(motion: Motion) -> None:
    shares = tuple(float(motion is kind) for kind in Motion)
    scene = scenes.random_scene(np.random.default_rng(4), 5, ScanStyle(motions=shares))
    assert scene.motion is motion
    turns = [shot.world_from_object for shot in scene.shots]
    if motion is Motion.CAMERA:
        assert all(np.array_equal(turn, np.eye(3)) for turn in turns)
    elif motion is Motion.TURNTABLE:
        for turn, shot in zip(turns, scene.shots, strict=True):
            assert np.allclose(turn[2], (0, 0, 1))
            # The camera always looks from azimuth 0 of the room.
            backward = turn @ -shot.camera_from_object[2, :3]
            assert np.arctan2(backward[1], backward[0]) == pytest.approx(0, abs=1e-9)
    else:
        assert scene.surroundings.ground is None
        assert not np.allclose(turns[0], turns[1])


def test_objects_look_out_of_the_camera_towards_the_image() -> None:
    for seed in range(20):
        scene = scenes.random_scene(np.random.default_rng(seed), 4, ScanStyle())
        for shot in scene.shots:
            assert shot.camera_from_object[2, 3] > 1, "the bounding sphere must lie before the camera"
            again = shot.camera_from_world @ np.append(shot.world_from_object @ (0.1, 0.2, 0.3), 1)
            assert np.allclose(again, shot.camera_from_object @ (0.1, 0.2, 0.3, 1))


def test_the_angle_knob_bounds_every_scan() -> None:
    style = ScanStyle(max_neighbour_degrees=(10.0, 20.0))
    for seed in range(10):
        scene = scenes.random_scene(np.random.default_rng(seed), 6, style)
        centres = np.array([-s.camera_from_object[:, :3].T @ s.camera_from_object[:, 3] for s in scene.shots])
        toward = centres / np.linalg.norm(centres, axis=1, keepdims=True)
        assert np.degrees(np.arccos((toward[1:] * toward[:-1]).sum(1))).max() <= 20 + 1e-6
