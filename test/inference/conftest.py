"""Points and pictures whose matches and poses are known."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from relpose_ros.geometry import so3
from relpose_ros.inference.local_features import LocalFeatures
from relpose_ros.views import BoundingBox, Intrinsics, View

PIXEL = 1 / 800
"""Of the synthetic features, in units of rays."""


@pytest.fixture
def fisher_scene(fisher_scene_type: tuple[type, object]) -> type:
    return fisher_scene_type[0]


@pytest.fixture
def cameras_around(fisher_scene_type: tuple[type, object]) -> object:
    return fisher_scene_type[1]


@dataclass(eq=False)
class PointScene:
    """Points seen by cameras: local features and matches whose truth is known."""

    rotations: np.ndarray
    """(N, 3, 3) camera_from_object."""
    translations: np.ndarray
    """(N, 3)."""
    points: np.ndarray
    """(K, 3) in the object frame."""

    @classmethod
    def ring(cls, angles_deg: list[float], points: int = 200, seed: int = 0) -> PointScene:
        """Cameras at distance 1 on a bent path around a ball of points, the first the identity."""
        generator = np.random.default_rng(seed)
        rotations = so3.exp(np.radians(angles_deg)[:, None] * [0.25, 0.96, 0.1])
        translations = np.tile([0.02, -0.03, 1.0], (len(angles_deg), 1))
        translations[1:] += 0.05 * generator.standard_normal((len(angles_deg) - 1, 3))
        return cls(rotations, translations, generator.uniform(-0.25, 0.25, (points, 3)))

    def relative(self, i: int, j: int) -> tuple[np.ndarray, np.ndarray]:
        """Rotation and unit translation of camera_j_from_camera_i."""
        rotation = self.rotations[j] @ self.rotations[i].T
        translation = self.translations[j] - rotation @ self.translations[i]
        return rotation, translation / max(np.linalg.norm(translation), 1e-12)

    def features(
        self, noise: float = 0.5, outliers: int = 0, seed: int = 0, guessed: bool = False
    ) -> list[LocalFeatures]:
        """One feature per point and view, the last ``outliers`` of them anywhere; noise in pixels."""
        generator, turning = np.random.default_rng([seed, 1]), np.random.default_rng([seed, 2])
        descriptors = generator.standard_normal((len(self.points), 128)).astype(np.float32)
        descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
        found = []
        for rotation, translation in zip(self.rotations, self.translations, strict=True):
            local = self.points @ rotation.T + translation
            rays = local[:, :2] / local[:, 2:]
            rays = rays + noise * PIXEL * generator.standard_normal(rays.shape)
            rays[len(rays) - outliers :] = generator.uniform(-0.3, 0.3, (outliers, 2))
            orientations = 0.2 * turning.standard_normal(len(rays))
            orientations[len(rays) - outliers :] = turning.uniform(-np.pi, np.pi, outliers)
            order = generator.permutation(len(rays))
            places, plain = np.arange(len(rays)), len(rays)
            found.append(
                LocalFeatures(
                    rays[order], orientations[order], descriptors[order], places, plain, PIXEL, guessed
                )
            )
        return found


@pytest.fixture
def point_scene() -> type[PointScene]:
    return PointScene


@pytest.fixture
def textured() -> object:
    """Views that a blurred noise fills, another one for each seed."""
    import cv2

    def view(seed: int, height: int = 160, width: int = 200, **changes: object) -> View:
        noise = np.random.default_rng(seed).standard_normal((height, width))
        grey = np.clip(128 + 500 * cv2.GaussianBlur(noise, (0, 0), 2.5), 0, 255).astype(np.uint8)
        image = np.repeat(grey[..., None], 3, -1)
        return replace(View(image, BoundingBox(0, 0, width, height), width, height), **changes)

    return view


BALL_FOCAL, BALL_SIZE = 500.0, 240


@pytest.fixture(scope="session")
def ball_on_a_turntable() -> object:
    """Renders a textured ball, turned by some degrees, before a background that stays as it is."""
    generator = np.random.default_rng(0)
    texture = _mottled(generator, 360, 720)
    background = _mottled(generator, BALL_SIZE, BALL_SIZE)
    column, row = np.meshgrid(np.arange(BALL_SIZE) + 0.5, np.arange(BALL_SIZE) + 0.5)
    middle = BALL_SIZE / 2
    rays = np.stack([(column - middle) / BALL_FOCAL, (row - middle) / BALL_FOCAL, np.ones_like(row)], -1)
    # The ball of radius 0.16 at depth 1: |s ray - centre| = radius.
    along, length = rays[..., 2], (rays * rays).sum(-1)
    inner = along**2 - length * (1 - 0.16**2)
    mask = inner > 0
    depth = (along - np.sqrt(np.maximum(inner, 0))) / length
    normals = (depth[..., None] * rays - [0, 0, 1]) / 0.16
    intrinsics = Intrinsics(BALL_FOCAL, BALL_FOCAL, middle, middle)
    rows, columns = np.nonzero(mask)
    box = BoundingBox(columns.min(), rows.min(), columns.max() + 1, rows.max() + 1)

    def view(turn_deg: float, *, masked: bool = True) -> View:
        local = normals @ ball_rotation(turn_deg)  # rows: R^T n
        azimuth = (np.arctan2(local[..., 0], local[..., 2]) / (2 * np.pi) + 0.5) * 719
        height = (np.arcsin(np.clip(local[..., 1], -1, 1)) / np.pi + 0.5) * 359
        shown = texture[height.astype(int), azimuth.astype(int)]
        grey = np.where(mask, shown, background)
        image = np.repeat(grey[..., None], 3, -1).astype(np.uint8)
        return View(image, box, BALL_SIZE, BALL_SIZE, intrinsics=intrinsics, mask=mask if masked else None)

    return view


def ball_rotation(turn_deg: float) -> np.ndarray:
    """camera_from_object of the ball on its turntable."""
    return so3.exp(np.radians(turn_deg) * np.array([0.3, 0.95, 0.05]))


@pytest.fixture
def rotation_of_ball() -> object:
    return ball_rotation


def _mottled(generator: np.random.Generator, height: int, width: int) -> np.ndarray:
    """Smooth noise of many scales, grey values as floats."""
    import cv2

    total = np.zeros((height, width))
    for size in (2, 4, 8):
        noise = generator.standard_normal((height, width))
        blurred = cv2.GaussianBlur(noise, (0, 0), size)
        total += blurred / blurred.std()
    return np.clip(128 + 40 * total, 0, 255)
