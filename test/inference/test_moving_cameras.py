from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from relpose_ros.geometry import so3, so3_grid
from relpose_ros.inference.moving_cameras import MovingCameras
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies


@pytest.fixture
def moving(fisher_scene, cameras_around):
    """Every camera of four in three solutions, of which the first is the truth."""
    scene = fisher_scene(cameras_around(4, 0), concentration=2.0)
    solutions = np.stack(
        [scene.cameras, *so3.random_rotations(8, np.random.default_rng(1)).reshape(2, 4, 3, 3)]
    )
    with torch.no_grad():
        energies = PairEnergies.of(scene, scene, 4)
    return scene, MovingCameras.each(energies, torch.from_numpy(solutions))


def places_for(moving, count):
    groups, solutions = moving.rotations.shape[:2]
    drawn = so3.random_rotations(groups * solutions * count, np.random.default_rng(2))
    return torch.from_numpy(drawn).view(groups, solutions, count, 3, 3)


def test_heights_are_the_sum_over_the_cameras_pairs(moving):
    scene, moving = moving
    places = places_for(moving, 2)
    heights = moving.heights(places)
    for camera, solution, place in itertools.product(range(4), range(3), range(2)):
        rotations = moving.rotations[camera, solution].clone()
        rotations[camera] = places[camera, solution, place]
        total = 0.0
        for other in set(range(4)) - {camera}:
            i, j = sorted((camera, other))
            relative = rotations[j] @ rotations[i].T
            total += 2.0 * (np.trace(scene.relative(i, j).T @ relative.numpy()) - 3)
        assert float(heights[camera, solution, place]) == pytest.approx(total, abs=1e-4)


def test_uphill_is_the_slope_of_the_heights(moving):
    _, moving = moving
    places = places_for(moving, 2)
    heights, slopes = moving.uphill(places)
    torch.testing.assert_close(heights, moving.heights(places), atol=1e-4, rtol=0)
    for axis in range(3):
        turn = 1e-2 * np.eye(3)[axis]
        up, down = (moving.heights(torch.from_numpy(so3.exp(sign * turn)) @ places) for sign in (1, -1))
        torch.testing.assert_close(slopes[..., axis], (up - down) / 2e-2, atol=5e-3, rtol=5e-3)


def test_cameras_are_where_they_are_and_true_modes_put_them_there(moving):
    scene, moving = moving
    truth = torch.from_numpy(scene.cameras)
    torch.testing.assert_close(moving.here[:, 0, 0], truth)
    modes = torch.from_numpy(np.stack([scene.relative(i, j) for i, j in itertools.combinations(range(4), 2)]))
    put = moving.where_modes_put(modes[:, None])[:, 0]  # of the solution that is the truth
    torch.testing.assert_close(put, truth[:, None].expand(4, 3, 3, 3))


def test_the_coarse_grid_remembers_the_highest_energy_near_a_place(moving):
    scene, moving = moving
    with torch.no_grad():
        distributions = search(moving.energies, GridEmbeddings(scene))
    places = places_for(moving, 5)
    remembered = moving.remembered(distributions, places)
    # Smooth energies change little over half a cell, by which a place may be off the cell's best.
    change = 2.0 * 3 * 2 * so3_grid.cell_spacing(distributions.coarse_level)
    assert (remembered - moving.heights(places)).abs().max() < change


def test_some_groups_are_those_groups(moving):
    _, moving = moving
    places = places_for(moving, 2)
    chosen = torch.tensor([False, True, False, True])
    some = moving.only(chosen)
    torch.testing.assert_close(some.heights(places[chosen]), moving.heights(places)[chosen])
    assert some.cameras.tolist() == [1, 3]
