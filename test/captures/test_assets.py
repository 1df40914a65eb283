"""Meshes and pictures from a folder."""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np
import pytest

from relpose_ros.captures.assets import AssetsError, load_assets, read_mesh
from relpose_ros.captures.objects import random_object
from relpose_ros.captures.shapes import SymmetryKind

if TYPE_CHECKING:
    from pathlib import Path


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """Two textured boxes, one of them held out, a bare one, a panorama and a surface."""
    trimesh = pytest.importorskip("trimesh")
    from PIL import Image

    lines = ["name,file,kind,split,group,symmetry"]
    (tmp_path / "meshes").mkdir()
    for name, kind, split, symmetry in (
        ("tin", "textured", "train", "continuous"),
        ("beaker", "textured", "held_out", "none"),
        ("peg", "shape", "train", ""),
    ):
        box = trimesh.creation.box((1, 2, 3))
        picture = np.zeros((16, 16, 3), np.uint8)
        picture[:8] = (255, 0, 0)
        if kind == "textured":
            uv = np.column_stack([np.zeros(8), np.where(box.vertices[:, 2] > 0, 0.95, 0.05)])
            material = trimesh.visual.material.PBRMaterial(baseColorTexture=Image.fromarray(picture))
            box.visual = trimesh.visual.TextureVisuals(uv=uv, material=material)
        box.export(tmp_path / "meshes" / f"{name}.glb")
        lines.append(f"{name},{name}.glb,{kind},{split},{name},{symmetry}")
    (tmp_path / "meshes/manifest.csv").write_text("\n".join(lines))
    (tmp_path / "backgrounds").mkdir()
    for name in ("hall", "oak"):
        cv2.imwrite(str(tmp_path / f"backgrounds/{name}.jpg"), np.full((32, 64, 3), 90, np.uint8))
    (tmp_path / "backgrounds/manifest.csv").write_text(
        "name,file,kind\nhall,hall.jpg,hdri_equirectangular\noak,oak.jpg,surface\n"
    )
    return tmp_path


def test_splits_are_kept_apart(folder: Path) -> None:
    train, held_out = load_assets(folder), load_assets(folder, "held_out")
    assert [entry.name for group in train.groups for entry in group] == ["tin"]
    assert [entry.name for entry in train.bare] == ["peg"]
    assert [entry.name for group in held_out.groups for entry in group] == ["beaker"]
    assert [path.name for path in train.panoramas] == ["hall.jpg"]
    assert train.groups[0][0].symmetry is SymmetryKind.CONTINUOUS
    names = {random_object(np.random.default_rng(k), train).name for k in range(60)}
    assert {"tin", "peg"} < names
    assert "beaker" not in names


def test_held_out_things_are_all_there_is_and_unchanged(folder: Path) -> None:
    held_out = load_assets(folder, "held_out")
    for seed in range(5):
        thing = random_object(np.random.default_rng(seed), held_out)
        assert thing.name == "beaker"
        assert np.array_equal(thing.parts[0].texture[0, 0], (255, 0, 0))
        extents = np.ptp(thing.parts[0].mesh.positions, axis=0)
        assert np.allclose(extents / extents[0], (1, 2, 3))


def test_pictures_are_the_right_way_up(folder: Path) -> None:
    mesh, picture = read_mesh(folder / "meshes/tin.glb")
    assert picture is not None
    top = mesh.uvs[mesh.positions[:, 2] > 0]
    rows = (top[:, 1] * picture.shape[0]).astype(int)
    assert (picture[rows, 0] == (255, 0, 0)).all()


@pytest.mark.parametrize(
    ("break_it", "sentence"),
    [
        (lambda f: (f / "meshes/manifest.csv").unlink(), "meshes/manifest.csv"),
        (lambda f: (f / "backgrounds/manifest.csv").write_text("name,kind\na,b\n"), "no column 'file'"),
        (
            lambda f: (f / "meshes/manifest.csv").write_text("name,file,kind,split,group,symmetry\n"),
            "no column",
        ),
    ],
)
def test_a_broken_folder_is_told(folder: Path, break_it: object, sentence: str) -> None:
    break_it(folder)  # type: ignore[operator]
    with pytest.raises(AssetsError, match=sentence):
        load_assets(folder)


def test_an_unknown_split_is_told(folder: Path) -> None:
    with pytest.raises(AssetsError, match="'test' is unknown"):
        load_assets(folder, "test")


def test_a_mesh_that_is_none_is_told(tmp_path: Path) -> None:
    pytest.importorskip("trimesh")
    broken = tmp_path / "a.glb"
    broken.write_bytes(b"no mesh")
    with pytest.raises(AssetsError, match=r"a\.glb"):
        read_mesh(broken)


def test_every_held_out_object_of_the_mesh_pack_reads(shared: Path) -> None:
    if not (shared / "meshes").is_dir():
        pytest.skip("the shared folder has no meshes")
    held_out = load_assets(shared, "held_out")
    assert len(held_out.groups) == 24
    for group in held_out.groups[:3]:
        mesh, picture = read_mesh(group[0].file)
        assert picture is not None
        assert np.linalg.norm(mesh.positions, axis=1).max() == pytest.approx(1, abs=0.01)
