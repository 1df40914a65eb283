"""Scans that need no renderer, and a network small enough to train in a test."""

from dataclasses import replace

import numpy as np
import pytest

from relpose_ros.geometry import so3
from relpose_ros.network.presets import PRESETS


def make_shard(scans, views, size, seed):
    """Random pictures with consistent poses: cameras on a sphere that look at the origin, roughly upright."""
    generator = np.random.default_rng(seed)
    rotations = so3.random_rotations(scans * views, generator).reshape(scans, views, 3, 3)
    translations = np.broadcast_to([0.0, 0.0, 3.0], (scans, views, 3)) + generator.normal(
        0, 0.1, (scans, views, 3)
    )
    cells = size // 8
    places = generator.normal(size=(scans, views, cells, cells, 3)).astype(np.float16)
    places[generator.random((scans, views, cells, cells)) < 0.3] = np.nan
    return {
        "images": generator.integers(0, 256, (scans, views, size, size, 3), dtype=np.uint8),
        "crop_parameters": generator.normal(size=(scans, views, 3)).astype(np.float32),
        "camera_from_object": np.concatenate([rotations, translations[..., None]], -1),
        "places": places,
        "image_sizes": np.broadcast_to([640, 480], (scans, views, 2)).astype(np.int32),
    }


@pytest.fixture(scope="session")
def fake_shard():
    """`make_shard`: scans, views, image size, seed."""
    return make_shard


@pytest.fixture
def tiny_preset(monkeypatch):
    """A preset called ``tiny``: the compact network's parts, a few thousand weights."""
    compact = PRESETS["compact"]
    tiny = replace(
        compact,
        name="tiny",
        image_size=32,
        backbone="residual",
        stem_width=8,
        stage_widths=(8, 16),
        stage_depths=(1, 1),
        layout_width=8,
        pooled_width=24 - 3 * 2 * compact.crop_frequencies + 24,
        layers=1,
        heads=2,
        head_width=8,
        feedforward_width=16,
        energy_width=16,
        translation_widths=(16, 16),
        correlation=replace(
            compact.correlation,
            stage=1,
            map_side=4,
            descriptor_width=8,
            match_width=4,
            layout_widths=(16, 16),
            summary_width=8,
        ),
    )
    monkeypatch.setitem(PRESETS, "tiny", tiny)
    return tiny
