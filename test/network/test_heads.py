"""The correlation reader against the softmaxes it stands for, and what it can and cannot tell apart."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn import functional

from relpose_ros.network.heads import CorrelationReader
from relpose_ros.network.presets import PRESETS

SETTINGS = PRESETS["compact"].correlation
assert SETTINGS is not None
SIDE, VALUES = SETTINGS.map_side, SETTINGS.match_width


def reader() -> CorrelationReader:
    torch.manual_seed(0)
    return CorrelationReader(SETTINGS, 32).eval()


def descriptors(seed: int, pairs: int = 2) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    maps = torch.randn(pairs, SETTINGS.descriptor_width, SIDE, SIDE, generator=generator)
    return functional.normalize(maps, dim=1)


def places_read(head: CorrelationReader, maps_i: torch.Tensor, maps_j: torch.Tensor) -> torch.Tensor:
    """What the convolutions are given: (P, 2 VALUES + 1, h, w)."""
    seen = []
    hook = head.read_layout.register_forward_pre_hook(lambda module, inputs: seen.append(inputs[0]))
    head(maps_i, maps_j)
    hook.remove()
    return seen[0]


@torch.no_grad()
def test_one_exponential_gives_both_softmaxes() -> None:
    head = reader()
    torch.nn.init.normal_(head.claimed_by)
    maps_i, maps_j = descriptors(1), descriptors(2)
    sharp = 20 * torch.einsum("pcx,pcy->pxy", maps_i.flatten(2), maps_j.flatten(2))
    found = sharp.softmax(2) @ head.matched_at
    claims = sharp.softmax(1)
    expected = torch.cat([found, claims @ head.claimed_by, claims.sum(2, keepdim=True)], -1)
    ours = places_read(head, maps_i, maps_j).flatten(2).mT
    assert torch.allclose(ours, expected, atol=1e-4)


@torch.no_grad()
def test_a_place_is_told_where_it_is_found() -> None:
    """View j is view i moved: what is read at a place is the learned function of where it went."""
    head = reader()
    head.log_sharpness.fill_(np.log(40))
    maps = descriptors(3, 1)
    moved = maps.roll((3, -2), (2, 3))
    read = places_read(head, maps, moved)[0, :VALUES]
    functions = head.matched_at.mT.unflatten(1, (SIDE, SIDE))
    inner = (slice(None), slice(0, SIDE - 3), slice(2, SIDE))
    expected = functions.roll((-3, 2), (1, 2))
    assert torch.allclose(read[inner], expected[inner], atol=1e-3)


def test_the_initial_functions_of_place_are_smooth_orthogonal_and_of_both_axes() -> None:
    functions = reader().matched_at.detach().double()
    gram = functions.mT @ functions
    assert torch.allclose(gram, torch.diag(gram.diagonal()), atol=1e-3)
    assert functions.sum(0).abs().max() < 1e-3
    first, second = functions.mT.unflatten(1, (SIDE, SIDE))[:2]
    assert torch.allclose(first, second.mT)  # the slowest along each axis
    assert (first.diff(dim=1) < 0).all()


@torch.no_grad()
def test_the_order_of_the_views_matters_and_pairs_do_not_see_each_other() -> None:
    head = reader()
    maps_i, maps_j = descriptors(4), descriptors(5)
    assert not torch.allclose(head(maps_i, maps_j), head(maps_j, maps_i), atol=1e-3)
    assert torch.allclose(head(maps_i, maps_j)[1:], head(maps_i[1:], maps_j[1:]), atol=1e-5)


@pytest.mark.parametrize("log_sharpness", [-3.0, 10.0])
def test_no_sharpness_makes_it_fail(log_sharpness: float) -> None:
    head = reader()
    with torch.no_grad():
        head.log_sharpness.fill_(log_sharpness)
    opposite = descriptors(6)
    out = head(opposite, -opposite)
    out.sum().backward()
    assert out.isfinite().all()
    assert all(p.grad is not None and p.grad.isfinite().all() for p in head.parameters())
