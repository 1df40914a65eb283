"""Where a camera sees the object, by the box around it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.geometry import cameras, so3
from relpose_ros.inference.outlines import (
    AHEAD,
    UNSIGHTED_SIGMA,
    Outline,
    find_outline,
    position_sigmas,
    sighted_translations,
    sightlines,
)
from relpose_ros.views import BoundingBox, Distortion, Intrinsics, View


def test_the_outline_is_the_box_as_the_camera_sees_it(textured):
    box = BoundingBox(40, 20, 100, 100)
    view = replace(textured(0), box=box, intrinsics=Intrinsics(200, 100, 100, 80))
    outline = find_outline(view)
    assert np.linalg.norm(outline.middle) == pytest.approx(1)
    np.testing.assert_allclose(outline.middle[:2] / outline.middle[2], [-0.15, -0.2], atol=0.015)
    left, right, top, bottom = np.arctan([-0.3, 0.0, -0.6, 0.2])
    # Seen at a slant, each side takes up a little less than on an axis of the picture.
    assert 0.95 * (right - left) < outline.sides[0] < right - left
    assert 0.95 * (bottom - top) < outline.sides[1] < bottom - top
    assert not outline.guessed
    ahead = find_outline(replace(view, box=BoundingBox(70, 40, 130, 120)))
    np.testing.assert_allclose(ahead.middle, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(ahead.sides, 2 * np.arctan([30 / 200, 40 / 100]), atol=1e-12)
    # The same in a message that carries no more than the object.
    part = replace(view, image=view.image[20:100, 40:100], origin=(40, 20))
    np.testing.assert_array_equal(find_outline(part).middle, outline.middle)
    assert find_outline(replace(view, box=BoundingBox(0, 0, 200, 160))) is None
    # A barrel lens shrinks what lies far from the axis.
    bent = find_outline(replace(view, distortion=Distortion((-0.2, 0.0, 0.0, 0.0, 0.0))))
    assert (bent.sides > 1.02 * outline.sides).all()


@pytest.mark.parametrize("box", [(1, 0, 200, 160), (0, 1, 200, 160), (0, 0, 199, 160), (0, 0, 200, 159)])
def test_a_box_that_leaves_a_strip_of_the_picture_tells(textured, box):
    """As of an object that the picture cuts off on three sides."""
    assert find_outline(replace(textured(0), box=BoundingBox(*box))) is not None


def test_without_intrinsics_a_box_still_says_which_way_the_object_is(textured):
    view = replace(textured(0), box=BoundingBox(120, 20, 180, 60))
    outline = find_outline(view)
    assert outline.guessed
    (ray,) = sightlines([outline])
    assert ray[0] > 0 > ray[1]
    assert np.linalg.norm(ray) == pytest.approx(1)


def test_a_box_whose_edge_no_lens_shows_tells_the_direction_alone(textured):
    """By a focal length of two pixels rays end 40 pixels from the middle."""
    short = Intrinsics(2, 2, 100, 80)
    outline = find_outline(replace(textured(0), box=BoundingBox(110, 60, 150, 100), intrinsics=short))
    np.testing.assert_allclose(outline.middle, np.array([15, 0, 1]) / np.hypot(15, 1), atol=1e-12)
    assert np.isnan(outline.sides).all()
    assert find_outline(replace(textured(0), box=BoundingBox(150, 60, 190, 100), intrinsics=short)) is None


def test_boxes_place_cameras_that_see_an_object_in_their_corners():
    """Cameras at several distances around a ball, which is nowhere near the middle of their pictures."""
    generator = np.random.default_rng(0)
    rotations = so3.random_rotations(5, generator)
    object_in_camera = generator.normal((0, 0, 1), 0.3, (5, 3))
    distances = np.linalg.norm(object_in_camera, axis=1)
    outlines = [
        Outline(place / distance, np.full(2, 0.1 / distance))
        for place, distance in zip(object_in_camera, distances, strict=True)
    ]
    placed = sighted_translations(outlines)
    assert np.linalg.norm(placed[0]) == pytest.approx(1)
    # Exact in direction; of the sizes half is believed to come from the distance.
    true = object_in_camera / distances[:, None]
    np.testing.assert_allclose(placed / np.linalg.norm(placed, axis=1, keepdims=True), true, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(placed, axis=1) ** 2, distances / distances[0], atol=1e-12)
    # So the object is where the lines of sight meet.
    centres = cameras.camera_centre(rotations, placed)
    origin = cameras.closest_point_to_rays(cameras.in_world(rotations, sightlines(outlines)), centres)
    np.testing.assert_allclose(origin, 0, atol=1e-9)


def test_a_view_without_a_box_is_ahead_and_as_far_as_the_others():
    near, far = (Outline(AHEAD, np.full(2, side)) for side in (0.4, 0.1))
    placed = sighted_translations([near, None, far])
    np.testing.assert_allclose(placed, [[0, 0, 1], [0, 0, 2**0.5], [0, 0, 2]], atol=1e-12)
    np.testing.assert_array_equal(sighted_translations([None, None]), [[0, 0, 1], [0, 0, 1]])
    flat = Outline(AHEAD, np.array([0.3, 0.0]))  # a box of no height
    assert np.isfinite(sighted_translations([flat, near])).all()


@pytest.mark.parametrize("bearing_deg", [0, 20, 35, 45])
def test_a_ball_looks_alike_wherever_in_the_picture_it_is(bearing_deg):
    """In pixels of a pinhole's picture it grows towards the edge, to twice its width and more."""
    radius, bearing = 0.15, np.radians(bearing_deg)
    around = np.linspace(0, 2 * np.pi, 2000)
    # The cone of rays that touch it.
    axis = np.array([np.sin(bearing), 0, np.cos(bearing)])
    side, up = np.array([np.cos(bearing), 0, -np.sin(bearing)]), np.array([0.0, 1, 0])
    spread = np.cos(around)[:, None] * side + np.sin(around)[:, None] * up
    rays = np.sqrt(1 - radius**2) * axis + radius * spread
    x, y = (1000 * rays[:, k] / rays[:, 2] + 2000 for k in (0, 1))
    view = View(
        np.zeros((8, 8, 3), np.uint8),
        BoundingBox(x.min(), y.min(), x.max(), y.max()),
        4000,
        4000,
        intrinsics=Intrinsics(1000, 1000, 2000, 2000),
    )
    outline = find_outline(view)
    assert np.degrees(np.arccos(outline.middle @ axis)) < 0.7
    assert outline.sides.prod() ** 0.5 == pytest.approx(2 * np.arcsin(radius), rel=0.02)


def test_positions_are_known_the_less_the_less_is_known_of_the_view():
    known = Outline(AHEAD, np.full(2, 0.3))
    aside = Outline(np.array([0.6, 0, 0.8]), np.full(2, 0.3), guessed=True)
    edgeless = Outline(AHEAD, np.full(2, np.nan))
    sigmas = position_sigmas([known, aside, edgeless, None], (0.04, 0.1))
    np.testing.assert_allclose(sigmas[0], (0.04, 0.1))
    assert sigmas[1, 0] == pytest.approx(np.hypot(0.04, 0.2 * np.arcsin(0.6)))
    assert sigmas[1, 1] == 0.1
    np.testing.assert_allclose(sigmas[2:], [(0.04, UNSIGHTED_SIGMA[1]), UNSIGHTED_SIGMA])
    assert (position_sigmas([None], (0.3, 0.5)) == (0.3, 0.5)).all(), "a fit may know better"
