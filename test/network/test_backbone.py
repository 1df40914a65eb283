"""The backbone's own parts; that the whole of it is the published one, the golden values say."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.network.backbone import Backbone, Blur, group_norm
from relpose_ros.network.presets import Preset


def test_blur_by_hand() -> None:
    image = np.random.default_rng(0).normal(size=(2, 3, 6, 8))
    # Reflected without repeating the edge: one pixel before, two behind.
    rows, columns = [1, *range(6), 4, 3], [1, *range(8), 6, 5]
    padded = image[:, :, rows][:, :, :, columns]
    taps = np.outer([1, 3, 3, 1], [1, 3, 3, 1]) / 64
    expected = np.zeros((2, 3, 3, 4))
    for row in range(3):
        for column in range(4):
            window = padded[:, :, 2 * row : 2 * row + 4, 2 * column : 2 * column + 4]
            expected[:, :, row, column] = (window * taps).sum((-2, -1))
    blurred = Blur(3)(torch.from_numpy(image).float())
    assert blurred.numpy() == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize(
    ("channels", "groups"), [(32, 8), (64, 8), (128, 8), (256, 16), (512, 32), (1024, 32), (2048, 32)]
)
def test_groups_by_width(channels: int, groups: int) -> None:
    assert group_norm(channels).num_groups == groups


def test_each_stage_halves_the_one_before_from_a_quarter_on() -> None:
    preset = replace(Preset("small"), stem_width=8, stage_widths=(8, 16, 24), stage_depths=(2, 1, 2))
    backbone = Backbone(preset)
    maps = backbone.stage_maps(torch.zeros(2, 3, 64, 64))
    assert backbone.widths == [32, 64, 96]
    assert [tuple(m.shape) for m in maps] == [
        (2, w, s, s) for w, s in zip(backbone.widths, (16, 8, 4), strict=True)
    ]


@torch.no_grad()
def test_blurs_make_features_steadier_under_a_shift_of_one_pixel(monkeypatch: pytest.MonkeyPatch) -> None:
    """Why the paper has them: the same random network, with them and with every second pixel instead."""
    generator = torch.Generator().manual_seed(0)
    image = torch.nn.functional.interpolate(
        torch.randn(4, 3, 24, 24, generator=generator), 128, mode="bicubic"
    )
    torch.manual_seed(0)
    backbone = Backbone(replace(Preset("small"), stem_width=16, stage_widths=(16, 32), stage_depths=(1, 1)))
    changes = []
    for blurs in (True, False):
        if not blurs:
            monkeypatch.setattr(Blur, "forward", lambda _self, x: x[..., ::2, ::2])
        before, after = (backbone.stage_maps(part)[1] for part in (image[..., :-1], image[..., 1:]))
        changes.append(((before - after).norm() / before.norm()).item())
    assert changes[0] < 0.8 * changes[1]
