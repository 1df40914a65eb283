"""Random things and their textures."""

from __future__ import annotations

import numpy as np
import pytest

from relpose_ros.captures import objects, textures
from relpose_ros.captures.shapes import SymmetryKind
from relpose_ros.geometry import so3


@pytest.mark.parametrize("seed", range(40))
def test_things_fill_the_unit_sphere_and_are_sound(seed: int) -> None:
    thing = objects.random_object(np.random.default_rng(seed))
    points = np.concatenate([part.mesh.positions for part in thing.parts])
    assert np.allclose(points.max(0) + points.min(0), 0, atol=1e-9)
    assert np.linalg.norm(points, axis=1).max() == pytest.approx(1)
    for part in thing.parts:
        assert np.isfinite(part.mesh.normals).all()
        assert np.isfinite(part.mesh.uvs).all()
        assert part.mesh.triangles.max() < len(part.mesh.positions)
        assert part.texture.dtype == np.uint8
        assert part.texture.shape == (part.texture.shape[0], part.texture.shape[0], 3)


def test_the_same_seed_gives_the_same_thing() -> None:
    first, again = (objects.random_object(np.random.default_rng(7)) for _ in range(2))
    for a, b in zip(first.parts, again.parts, strict=True):
        assert np.array_equal(a.mesh.positions, b.mesh.positions)
        assert np.array_equal(a.texture, b.texture)


def test_what_is_called_symmetric_is() -> None:
    found = 0
    for seed in range(400):
        thing = objects.random_object(np.random.default_rng(seed))
        if thing.symmetry.kind is not SymmetryKind.CONTINUOUS:
            continue
        found += 1
        axis = np.asarray(thing.symmetry.axis)
        turn = so3.exp(axis * 2 * np.pi / 36)  # one sector of the lathe
        for part in thing.parts:
            turned = part.mesh.positions @ turn.T
            places = part.mesh.positions
            square = (turned**2).sum(1)[:, None] + (places**2).sum(1) - 2 * turned @ places.T
            assert square.min(1).max() < 1e-9
            assert (part.texture == part.texture[:, :1]).all(), "the texture changes around the axis"
        if found == 2:
            return
    pytest.fail("no symmetric thing in 400")


def test_a_symmetry_axis_turns_with_its_thing() -> None:
    rng = np.random.default_rng(0)
    thing = next(t for t in (objects.bottle(rng, textures.surface) for _ in range(200)) if t.symmetry.axis)
    turn = so3.exp([0.3, -1.0, 0.5])
    assert np.allclose(thing.transformed(turn).symmetry.axis, turn @ np.asarray(thing.symmetry.axis))


@pytest.mark.parametrize("number", range(24))
def test_patterns_use_the_whole_range_and_differ(number: int) -> None:
    grey = textures.pattern(number)
    assert grey.shape == (256, 256)
    assert (grey.min(), grey.max()) == (0, 255)
    assert not np.array_equal(grey, textures.pattern((number + 1) % 24))


def test_a_room_is_twice_as_wide_as_high() -> None:
    assert textures.room(3, 64).shape == (64, 128, 3)
    assert np.array_equal(textures.room(3, 64), textures.room(3, 64))


def test_a_palette_without_contrast_is_one_colour() -> None:
    colours = textures.palette(np.random.default_rng(0), contrast=0.0)
    assert (colours == colours[0]).all()
