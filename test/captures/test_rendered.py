"""Whole photographs as capture folders, and the scans that come with the package."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pytest

from relpose_ros.captures.demo import DEMO_SCANS
from relpose_ros.captures.rendered import render_capture
from relpose_ros.captures.renderer import Renderer, Window

if TYPE_CHECKING:
    from relpose_ros.captures.scenes import Scene

DEMO = {demo.name: demo for demo in DEMO_SCANS}
BAGS = Path(__file__).resolve().parents[2] / "bags"


def test_a_rendered_capture_is_a_capture(renderer: Renderer, tmp_path: Path) -> None:
    del renderer
    capture = render_capture(tmp_path / "a", 1, 0, 2)
    assert len(capture.photos) == 2
    for k, photo in enumerate(capture.photos):
        view = capture.view(k)
        assert photo.camera_from_world is not None
        assert view.mask is not None
        rows, columns = np.nonzero(view.mask)
        # The mask may be less than the box where something stands before the object.
        assert columns.min() >= photo.box.x0 - 1
        assert columns.max() <= photo.box.x1 + 1
        assert rows.min() >= photo.box.y0 - 1
        assert rows.max() <= photo.box.y1 + 1


def silhouettes(renderer: Renderer, scene: Scene) -> np.ndarray:
    whole = [Window(0, 0, shot.width, shot.height) for shot in scene.shots]
    return renderer.draw(scene, whole, (160, 120), supersampling=1)[..., 3] > 0


def test_the_mug_hides_its_handle_in_some_views(renderer: Renderer) -> None:
    scene = DEMO["ambiguous_mug"].scene()
    cup, _ = scene.thing.parts
    with_handle = silhouettes(renderer, scene)
    without = silhouettes(renderer, replace(scene, thing=replace(scene.thing, parts=(cup,))))
    sticks_out = (with_handle & ~without).sum((1, 2))
    assert (sticks_out == 0).sum() >= 2
    assert (sticks_out > 50).sum() >= 3


@pytest.mark.parametrize("name", DEMO)
def test_demo_objects_are_whole_in_every_photograph(name: str) -> None:
    scene = DEMO[name].scene()
    assert all(shot.complete for shot in scene.shots)
    assert len(scene.shots) == (40 if name == "orbit" else 8)


def test_the_bags_that_come_with_the_package_are_small() -> None:
    assert {path.name for path in BAGS.iterdir() if path.is_dir()} == set(DEMO)
    assert sum(path.stat().st_size for path in BAGS.rglob("*") if path.is_file()) < 10e6
