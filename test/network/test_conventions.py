"""The released convention against ours, by a second derivation: from where a camera stands and looks.

Nothing here uses F = diag(-1, -1, 1). A camera is a place, a direction of sight and a direction of up in
the world. The released axes are left, up and forward; ours are right, down and forward.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.geometry import cameras, so3
from relpose_ros.network import conventions
from relpose_ros.network.checkpoint import random_network
from relpose_ros.views import Intrinsics

seeds = st.integers(0, 2**31)


@dataclass
class PlacedCamera:
    centre: np.ndarray
    forward: np.ndarray
    up: np.ndarray

    @classmethod
    def random(cls, generator: np.random.Generator) -> PlacedCamera:
        centre, forward, hint = generator.normal(size=(3, 3))
        return cls.looking(centre, forward, hint)

    @classmethod
    def looking(cls, centre: np.ndarray, forward: np.ndarray, hint: np.ndarray) -> PlacedCamera:
        forward = forward / np.linalg.norm(forward)
        up = hint - (hint @ forward) * forward
        return cls(centre, forward, up / np.linalg.norm(up))

    @property
    def left(self) -> np.ndarray:
        # Facing north (y) with up z, west (-x) is to the left: up x forward.
        return np.cross(self.up, self.forward)

    def released(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Row vectors: a point's coordinates along left, up and forward are its products with columns."""
        rotation = np.stack([self.left, self.up, self.forward], 1)
        return torch.from_numpy(rotation), torch.from_numpy(-self.centre @ rotation)

    def optical(self) -> tuple[np.ndarray, np.ndarray]:
        rotation = np.stack([-self.left, -self.up, self.forward])
        return rotation, rotation @ -self.centre


@given(seeds)
def test_a_released_camera_becomes_the_optical_camera_that_stands_and_looks_the_same(seed: int) -> None:
    camera = PlacedCamera.random(np.random.default_rng(seed))
    rotation, translation = camera.released()
    expected_rotation, expected_translation = camera.optical()
    ours = conventions.optical_rotation(rotation), conventions.optical_translation(translation)
    assert ours[0].numpy() == pytest.approx(expected_rotation, abs=1e-12)
    assert ours[1].numpy() == pytest.approx(expected_translation, abs=1e-12)
    assert cameras.camera_centre(ours[0], ours[1]) == pytest.approx(camera.centre, abs=1e-12)


@given(seeds)
def test_both_ways_and_back(seed: int) -> None:
    rotation = torch.from_numpy(so3.random_rotations(3, np.random.default_rng(seed)))
    there = conventions.optical_rotation(rotation)
    assert torch.equal(conventions.released_rotation(there), rotation)
    assert torch.equal(conventions.optical_rotation(conventions.released_rotation(rotation)), rotation)
    assert torch.equal(conventions.released_relative(conventions.released_relative(rotation)), rotation)
    assert torch.equal(
        conventions.optical_translation(conventions.optical_translation(rotation[0])), rotation[0]
    )


@given(seeds)
def test_a_pair_is_scored_at_the_product_of_its_released_rotations(seed: int) -> None:
    generator = np.random.default_rng(seed)
    first, second = PlacedCamera.random(generator), PlacedCamera.random(generator)
    released = first.released()[0].T @ second.released()[0]
    camera_j_from_camera_i = torch.from_numpy(second.optical()[0] @ first.optical()[0].T)
    assert conventions.released_relative(camera_j_from_camera_i).numpy() == pytest.approx(
        released.numpy(), abs=1e-12
    )


def test_the_network_embeds_optical_rotations_as_the_released_ones_they_are() -> None:
    network = random_network("compact", 0).double()
    generator = np.random.default_rng(3)
    first, second = PlacedCamera.random(generator), PlacedCamera.random(generator)
    released = first.released()[0].T @ second.released()[0]
    optical = torch.from_numpy(second.optical()[0] @ first.optical()[0].T)
    assert torch.allclose(network.embed_relative(optical), network.embed_rotations(released))
    assert not torch.allclose(network.embed_relative(optical), network.embed_rotations(optical))


@pytest.mark.parametrize("seed", range(5))
def test_points_of_a_rendered_scene_project_where_they_were_drawn(seed: int) -> None:
    """The picture is drawn in the released convention: on a screen, x grows leftwards and y upwards."""
    generator = np.random.default_rng(seed)
    size, focal = 96, 110.0
    points = generator.uniform(-0.5, 0.5, (6, 3))
    camera = PlacedCamera.looking(
        np.array([2.0, 1, 0.5]), np.array([-2.0, -1, -0.5]), generator.normal(size=3)
    )
    rotation, translation = camera.released()
    local = points @ rotation.numpy() + translation.numpy()
    picture = np.zeros((size, size))
    for x, y, z in local:
        from_left_edge = size / 2 - focal * x / z
        from_top_edge = size / 2 - focal * y / z
        picture[int(from_top_edge), int(from_left_edge)] = 1

    pixels = cameras.project_points(
        points,
        conventions.optical_rotation(rotation).numpy(),
        conventions.optical_translation(translation).numpy(),
        Intrinsics(focal, focal, size / 2, size / 2),
    )
    columns, rows = np.floor(pixels).astype(int).T
    assert (picture[rows, columns] == 1).all()
    assert picture.sum() == len({*zip(rows, columns, strict=True)})
