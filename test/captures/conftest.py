"""What the tests of rendering share."""

from __future__ import annotations

import pytest

from relpose_ros.captures.renderer import Renderer, RenderError


@pytest.fixture(scope="session")
def renderer() -> Renderer:
    """One OpenGL context for all tests; skips where there is none."""
    try:
        return Renderer()
    except RenderError as error:
        pytest.skip(str(error))
