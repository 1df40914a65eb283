"""Bodies: closed where they should be, outside out, normals upright on their faces."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.captures import shapes
from relpose_ros.geometry import so3

CLOSED = {
    "box": shapes.box((1.0, 2.0, 0.5)),
    "sphere": shapes.superquadric(),
    "cushion": shapes.superquadric(0.3, 1.6),
    "cone": shapes.lathe([(0, -1), (1, -1), (0, 1)]),
    "vase": shapes.lathe([(0, 0), (0.8, 0), (1.0, 0.6), (0.3, 1.4), (0.5, 2.0), (0, 2.0)]),
    "handle": shapes.tube(shapes.smooth_path([(0, 0, 0), (1, 0, 0.4), (1, 1, 1)], 12), 0.1),
    "star": shapes.prism([(1, 0), (0.3, 0.3), (0, 1), (-0.3, 0.3), (-1, 0), (0, -1)], 1.0, taper=0.5),
}


def volume(mesh: shapes.Mesh) -> float:
    """By the divergence theorem: right only for a closed surface, and positive only with its outside out."""
    a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6)


def face_agreement(mesh: shapes.Mesh) -> np.ndarray:
    """Cosine between each face's own normal and those of its corners, where the face has an area."""
    a, b, c = (mesh.positions[mesh.triangles[:, k]] for k in range(3))
    face = np.cross(b - a, c - a)
    area = np.linalg.norm(face, axis=1)
    solid = area > 1e-6 * area.max()
    face = face[solid] / area[solid, None]
    return np.einsum("fkj,fj->fk", mesh.normals[mesh.triangles[solid]], face)


@pytest.mark.parametrize("name", CLOSED)
def test_bodies_are_closed_and_outside_out(name: str) -> None:
    mesh = CLOSED[name]
    assert volume(mesh) > 0
    # A translation does not change the volume of a closed body; it does of an open one.
    assert volume(mesh.moved((3.0, -2.0, 5.0))) == pytest.approx(volume(mesh), abs=1e-9)
    assert np.allclose(np.linalg.norm(mesh.normals, axis=1), 1)
    assert np.mean(face_agreement(mesh) > 0.5) > 0.98


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (shapes.box((1.0, 2.0, 0.5)), 1.0),
        (shapes.superquadric(rings=80, sectors=120), 4 / 3 * np.pi),
        (shapes.lathe([(0, 0), (1, 0), (1, 2), (0, 2)], sectors=200), 2 * np.pi),
        (shapes.lathe([(0, 0), (1, 0), (0, 3)], sectors=200), np.pi),
        (shapes.prism([(1, 0), (0, 1), (-1, 0), (0, -1)], 3.0), 6.0),
        (shapes.tube([(0, 0, 0), (0, 0, 1), (0, 0, 2)], 0.5, sides=200), np.pi / 2),
    ],
)
def test_volumes_are_those_of_the_textbook(mesh: shapes.Mesh, expected: float) -> None:
    assert volume(mesh) == pytest.approx(expected, rel=2e-3)


@given(
    st.lists(st.floats(-2, 2), min_size=3, max_size=3),
    st.lists(st.floats(0.2, 3), min_size=3, max_size=3),
    st.booleans(),
)
def test_normals_stay_upright_under_any_stretch(
    turn: list[float], stretch: list[float], mirrored: bool
) -> None:
    factors = np.array(stretch) * (-1 if mirrored else 1, 1, 1)
    mesh = shapes.box((1.0, 2.0, 0.5)).transformed(so3.exp(turn) @ np.diag(factors), (1.0, 2.0, 3.0))
    # Mirroring turns the triangles' sense around, not the outside.
    assert np.allclose(face_agreement(mesh), -1 if mirrored else 1, atol=1e-9)
    outward = mesh.positions - mesh.positions.mean(0)
    assert (np.einsum("ij,ij->i", mesh.normals, outward) > 0).all()


def test_creases_stay_hard_and_curves_become_smooth() -> None:
    cube = shapes.box((1, 1, 1))
    _, corner = np.unique(cube.positions, axis=0, return_inverse=True)
    welded = np.unique(cube.positions, axis=0)
    faces = corner.reshape(-1)[cube.triangles]
    hard = shapes.creased(welded, faces, np.zeros((8, 2)))
    assert np.allclose(np.abs(hard.normals).max(1), 1)
    assert len(hard.positions) == 24

    ball = shapes.superquadric(rings=40, sectors=60)
    smooth = shapes.creased(ball.positions, ball.triangles, ball.uvs)
    assert (np.einsum("ij,ij->i", smooth.normals, smooth.positions) > 0.995).all()


@given(st.integers(0, 1000))
def test_displacement_opens_no_seams(seed: int) -> None:
    ball = shapes.superquadric(rings=10, sectors=12)
    rough = shapes.displaced(ball, np.random.default_rng(seed), 0.1)
    _, place = np.unique(np.round(ball.positions, 9), axis=0, return_inverse=True)
    for group in range(int(place.max()) + 1):
        together = rough.positions[place.reshape(-1) == group]
        assert np.ptp(together, axis=0).max() < 1e-6


def test_a_smooth_path_passes_through_its_points() -> None:
    points = np.array([(0, 0, 0), (1, 2, 0), (3, 1, 1), (4, 4, 4)], float)
    path = shapes.smooth_path(points, 31)
    assert np.allclose(path[::10], points)


def test_a_merged_mesh_keeps_each_triangle_where_it_was() -> None:
    parts = [CLOSED["box"], CLOSED["cone"].moved((2, 0, 0))]
    whole = shapes.merge(parts)
    expected = np.concatenate([part.positions[part.triangles] for part in parts])
    assert np.array_equal(whole.positions[whole.triangles], expected)
