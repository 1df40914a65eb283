"""A folder of meshes and pictures that makes rendered scans richer: ``--assets DIR``.

Layout: ``meshes/manifest.csv`` (columns name, file, kind, split, group, symmetry), the .glb files it
names, and ``backgrounds/manifest.csv`` (columns name, file, kind) with panoramas
(``hdri_equirectangular``), ``surface`` and ``pattern`` pictures. z is up in the raw mesh axes.
"""

from __future__ import annotations

import csv
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

from relpose_ros.captures import shapes, textures
from relpose_ros.captures.objects import Part, SyntheticObject
from relpose_ros.captures.shapes import Symmetry, SymmetryKind
from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from relpose_ros.captures.textures import Image

SPLITS = ("train", "held_out")
TEXTURED_SHARE = 0.7
"""How often a mesh keeps its own picture; the others are bare shapes under random textures."""


class AssetsError(RelPoseError):
    """The assets folder is not what its layout says."""


@dataclass(frozen=True)
class MeshEntry:
    """One line of the mesh manifest."""

    name: str
    file: Path
    textured: bool
    group: str
    symmetry: SymmetryKind


@dataclass(frozen=True)
class Assets:
    """What a folder offers for one split. Files are read on use and kept."""

    folder: Path
    groups: tuple[tuple[MeshEntry, ...], ...]
    """Textured meshes; near-duplicates share a group and are drawn by group."""
    bare: tuple[MeshEntry, ...]
    """Shapes without a texture of their own."""
    panoramas: tuple[Path, ...]
    surfaces: tuple[Path, ...]
    """Photographed materials."""
    patterns: tuple[Path, ...]
    unchanged: bool = False
    """Whether its meshes are all that is scanned, and as they are: held-out objects are measured on."""

    def random_object(self, rng: np.random.Generator) -> SyntheticObject:
        """A mesh of this split, sometimes under another texture."""
        if self.bare and not self.unchanged and rng.random() > TEXTURED_SHARE:
            entry = self.bare[int(rng.integers(len(self.bare)))]
            mesh, _ = read_mesh(entry.file)
            return SyntheticObject((Part(mesh, self.random_surface(rng), *_finish(rng)),), name=entry.name)
        group = self.groups[int(rng.integers(len(self.groups)))]
        return self.textured_object(group[int(rng.integers(len(group)))], rng)

    def textured_object(self, entry: MeshEntry, rng: np.random.Generator) -> SyntheticObject:
        """One mesh with its own picture, its colours a little changed in the train split."""
        mesh, picture = read_mesh(entry.file)
        if picture is None:
            picture = self.random_surface(rng)
        elif not self.unchanged:
            gain = np.exp(rng.normal(0, 0.12, 3) + rng.normal(0, 0.15))
            table = np.clip(np.arange(256)[:, None] * gain, 0, 255).astype(np.uint8)
            picture = np.asarray(cv2.LUT(picture, table[None]), np.uint8)
            if rng.random() < 0.2:
                picture = np.ascontiguousarray(picture[..., rng.permutation(3)])
        symmetry = Symmetry(entry.symmetry, None, 1 if entry.symmetry is SymmetryKind.NONE else 0)
        return SyntheticObject((Part(mesh, picture, *_finish(rng)),), symmetry, entry.name)

    def random_surface(self, rng: np.random.Generator) -> Image:
        """A photographed material, a pattern, or a procedural texture."""
        pictures = self.surfaces if rng.random() < 0.8 else self.patterns
        if pictures and rng.random() < 0.65:
            picture = read_picture(pictures[int(rng.integers(len(pictures)))])
            size = 256
            if min(picture.shape[:2]) > size and rng.random() < 0.5:
                y, x = (int(rng.integers(0, n - size)) for n in picture.shape[:2])
                return np.ascontiguousarray(picture[y : y + size, x : x + size])
            return np.asarray(cv2.resize(picture, (size, size), interpolation=cv2.INTER_AREA), np.uint8)
        return textures.surface(rng)


def _finish(rng: np.random.Generator) -> tuple[float, float]:
    """Gloss and relief of a mesh."""
    return float(rng.uniform(0, 0.4) * (rng.random() < 0.5)), float(
        rng.uniform(0, 0.015) * (rng.random() < 0.4)
    )


def load_assets(folder: Path, split: str = "train") -> Assets:
    """Read the manifests of an assets folder.

    Args:
        folder: Holds ``meshes`` and ``backgrounds``.
        split: ``train``, or ``held_out`` for the objects that no training may see.

    Raises:
        AssetsError: A manifest is missing or lacks a column, or the split is unknown or empty.
    """
    folder = Path(folder).resolve()
    if split not in SPLITS:
        text = f"the split {split!r} is unknown; there are {' and '.join(SPLITS)}."
        raise AssetsError(text)
    entries = []
    for row in _manifest(folder / "meshes", ("name", "file", "kind", "split", "group", "symmetry")):
        if row["split"] == split:
            symmetry = SymmetryKind[row["symmetry"].upper()] if row["symmetry"] else SymmetryKind.NONE
            file = folder / "meshes" / row["file"]
            entries.append(MeshEntry(row["name"], file, row["kind"] == "textured", row["group"], symmetry))
    groups: dict[str, list[MeshEntry]] = {}
    for entry in entries:
        if entry.textured:
            groups.setdefault(entry.group, []).append(entry)
    if not groups:
        text = f"{folder / 'meshes' / 'manifest.csv'} has no textured mesh of the split {split!r}."
        raise AssetsError(text)
    pictures = list(_manifest(folder / "backgrounds", ("file", "kind")))
    return Assets(
        folder=folder,
        groups=tuple(tuple(group) for group in groups.values()),
        bare=tuple(entry for entry in entries if not entry.textured),
        panoramas=tuple(folder / "backgrounds" / p["file"] for p in pictures if p["kind"].startswith("hdri")),
        surfaces=tuple(folder / "backgrounds" / p["file"] for p in pictures if p["kind"] == "surface"),
        patterns=tuple(folder / "backgrounds" / p["file"] for p in pictures if p["kind"] == "pattern"),
        unchanged=split != "train",
    )


def _manifest(folder: Path, columns: tuple[str, ...]) -> list[dict[str, str]]:
    path = folder / "manifest.csv"
    try:
        with path.open(newline="", encoding="utf-8") as file:
            rows = list(csv.DictReader(file))
    except OSError as err:
        text = (
            f"{path} cannot be read; an assets folder holds meshes/manifest.csv and backgrounds/manifest.csv."
        )
        raise AssetsError(text) from err
    missing = [column for column in columns if not rows or column not in rows[0]]
    if missing:
        text = f"{path} has no column {missing[0]!r}."
        raise AssetsError(text)
    return rows


@lru_cache(maxsize=512)
def read_mesh(path: Path) -> tuple[shapes.Mesh, Image | None]:
    """A .glb file's triangles and base-colour picture (None without one).

    Raises:
        AssetsError: The file is missing, unreadable or without triangles.
    """
    import trimesh

    try:
        loaded: Any = trimesh.load(path, force="mesh", process=False)
    except (OSError, ValueError, KeyError) as err:
        text = f"{path} cannot be read as a mesh: {err}."
        raise AssetsError(text) from err
    faces = np.asarray(getattr(loaded, "faces", ()), np.int64)
    if faces.ndim != 2 or not len(faces):
        text = f"{path} holds no triangles."
        raise AssetsError(text)
    uv = getattr(loaded.visual, "uv", None)
    uvs = np.zeros((len(loaded.vertices), 2)) if uv is None else np.asarray(uv, np.float64)
    # trimesh counts v upwards from the picture's bottom, textures here from row 0 downwards.
    uvs = np.column_stack([uvs[:, 0], 1 - uvs[:, 1]])
    material = getattr(loaded.visual, "material", None)
    picture = getattr(material, "baseColorTexture", None)
    pixels = None if picture is None else np.ascontiguousarray(np.asarray(picture.convert("RGB"), np.uint8))
    return shapes.creased(loaded.vertices, faces, uvs), pixels


@lru_cache(maxsize=512)
def read_picture(path: Path) -> Image:
    """An RGB picture, (H, W, 3).

    Raises:
        AssetsError: The file is missing or no image.
    """
    pixels = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if pixels is None:
        text = f"{path} is no readable image."
        raise AssetsError(text)
    return np.ascontiguousarray(pixels[..., ::-1])
