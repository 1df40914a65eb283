"""The encoder's own parts."""

from __future__ import annotations

import math

import pytest
import torch

from relpose_ros.network.encoder import Attention, IndexEncoding, LayoutPool, fourier, octaves


def test_the_encoding_is_all_sines_then_all_cosines_value_by_value() -> None:
    encoded = fourier(torch.tensor([[0.5, -0.25]]), octaves(3))
    angles = [0.5, 1.0, 2.0, -0.25, -0.5, -1.0]
    expected = [math.sin(a) for a in angles] + [math.cos(a) for a in angles]
    assert encoded.tolist()[0] == pytest.approx(expected)


def test_the_index_encoding_by_its_formula() -> None:
    table = IndexEncoding(8, 10)(torch.zeros(3, 10))
    for view in range(3):
        for column in range(10):
            angle = view / 10000 ** (2 * (column // 2) / 10)
            expected = math.cos(angle) if column % 2 else math.sin(angle)
            assert table[view, column].item() == pytest.approx(expected, abs=1e-6)


@torch.no_grad()
def test_attention_by_its_formula() -> None:
    torch.manual_seed(0)
    attention = Attention(12, heads=2, head_width=4).double()
    tokens = torch.randn(5, 12, dtype=torch.float64)
    q, k, v = (tokens @ w.T for w in attention.to_qkv.weight.chunk(3))
    heads = []
    for head in (slice(0, 4), slice(4, 8)):
        weights = (q[:, head] @ k[:, head].T / math.sqrt(4)).softmax(-1)
        heads.append(weights @ v[:, head])
    expected = attention.to_out(torch.cat(heads, -1))
    assert torch.allclose(attention(tokens), expected)
    assert torch.allclose(attention(tokens.expand(2, 3, 5, 12)), expected)


@torch.no_grad()
def test_a_pooled_layout_knows_where_things_are() -> None:
    torch.manual_seed(0)
    pool = LayoutPool(8, side=4, kept=6, width=10)
    feature_map = torch.randn(2, 8, 4, 4)
    assert pool(feature_map).shape == (2, 10)
    assert not torch.allclose(pool(feature_map), pool(feature_map.flip(-1)), atol=1e-3)
