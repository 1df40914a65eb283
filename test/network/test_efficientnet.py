"""EfficientNet-Lite0: the shape its public weights have."""

from __future__ import annotations

import torch

from relpose_ros.network.efficientnet import EfficientNetLite0, InvertedResidual


@torch.no_grad()
def test_maps_at_four_resolutions() -> None:
    torch.manual_seed(0)
    backbone = EfficientNetLite0()
    images = torch.randn(2, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    maps = backbone.stage_maps(images)
    expected = [(2, w, s, s) for w, s in zip((24, 40, 112, 320), (32, 16, 8, 4), strict=True)]
    assert [tuple(each.shape) for each in maps] == expected
    assert backbone.widths == [24, 40, 112, 320]
    # What an image says does not fade on the way through random weights.
    for each in maps:
        assert (each[0] - each[1]).std() > 0.2


def test_it_has_the_published_number_of_weights() -> None:
    """4,652,008 with the classifier, of which 1,280 features and 1000 classes take 1,693,160; batch norms,
    two numbers a channel, are one here."""
    backbone = EfficientNetLite0()
    blocks = [module for module in backbone.modules() if isinstance(module, InvertedResidual)]
    assert len(blocks) == 16
    biases = sum(p.numel() for p in backbone.parameters() if p.ndim == 1)
    assert sum(p.numel() for p in backbone.parameters()) + biases == 4_652_008 - 1_693_160


@torch.no_grad()
def test_blocks_add_what_came_in_where_shapes_allow() -> None:
    backbone = EfficientNetLite0()
    block = backbone.stages[1][1]  # type: ignore[index]
    assert isinstance(block, InvertedResidual)
    assert block.adds
    block.project.weight.zero_()
    assert block.project.bias is not None
    block.project.bias.zero_()
    x = torch.randn(1, 24, 8, 8, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(block(x), x)
    assert not backbone.stages[1][0].adds  # type: ignore[index]
