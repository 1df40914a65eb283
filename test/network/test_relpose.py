"""The network's seams: batches, pairs, contexts, gradients, and the variants of the paper."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from relpose_ros.geometry import so3
from relpose_ros.network.checkpoint import SHIPPED_WEIGHTS, random_network
from relpose_ros.network.features import SceneFeatures, ViewFeatures
from relpose_ros.network.presets import PRESETS, Preset
from relpose_ros.network.relpose import NetworkUseError, RelPose

COMPACT = PRESETS["compact"]
# The published structure (bottlenecks, blurs, average pool, no correlation), small enough for a test.
NARROW = Preset(
    "narrow",
    image_size=64,
    stem_width=16,
    stage_widths=(8, 8, 16),
    stage_depths=(1, 1, 2),
    pooled_width=64,
    crop_frequencies=2,
    layers=2,
    heads=2,
    head_width=16,
    feedforward_width=64,
    energy_width=32,
    translation_widths=(48, 24),
)
VARIANTS = {
    "compact": COMPACT,
    "narrow": NARROW,
    "no index": replace(COMPACT, index_encoding=False),
    "pair context": replace(COMPACT, pair_context=True),
    "regression, look-at": replace(COMPACT, rotation="regression", correlation=None),
    "regression, first camera": replace(NARROW, rotation="regression", translation_frame="first_camera"),
    "first camera": replace(NARROW, translation_frame="first_camera"),
}


def inputs(preset: Preset, *leading: int, seed: int = 0) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    images = torch.randn(*leading, 3, preset.image_size, preset.image_size, generator=generator)
    return images, torch.rand(*leading, 3, generator=generator) - 0.5


def rotations(count: int, seed: int = 0) -> torch.Tensor:
    return torch.from_numpy(so3.random_rotations(count, np.random.default_rng(seed))).float()


@pytest.fixture(scope="module", params=VARIANTS.values(), ids=VARIANTS.keys())
def network(request: pytest.FixtureRequest) -> RelPose:
    return random_network(request.param, 3)


@pytest.fixture(
    scope="module", params=[name for name, preset in VARIANTS.items() if preset.rotation == "energy"]
)
def energy_network(request: pytest.FixtureRequest) -> RelPose:
    return random_network(VARIANTS[request.param], 3)


def has_energy(network: RelPose) -> bool:
    return network.preset.rotation == "energy"


@torch.no_grad()
def test_a_batch_of_scans_is_each_scan_on_its_own(network: RelPose) -> None:
    images, crops = inputs(network.preset, 2, 3)
    batch = network.encode(images, crops)
    single = network.encode(images[1], crops[1])
    assert len(batch) == len(single) == 3
    assert torch.allclose(batch.tokens[1], single.tokens, atol=1e-4)
    assert torch.allclose(
        network.optical_translations(batch)[1], network.optical_translations(single), atol=1e-4
    )
    if has_energy(network):
        i, j = [0, 0, 1], [1, 2, 2]
        contexts, alone = network.pair_contexts(batch, i, j), network.pair_contexts(single, i, j)
        assert contexts.shape == (2, 3, network.preset.energy_width)
        assert torch.allclose(contexts[1], alone, atol=1e-4)
        embeddings = network.embed_relative(rotations(6))
        energies = network.pair_energies(contexts, embeddings)
        assert torch.allclose(energies[1], network.pair_energies(alone, embeddings), atol=1e-4)
        own = network.embed_relative(rotations(36).reshape(2, 3, 6, 3, 3))
        assert network.pair_energies(contexts, own).shape == (2, 3, 6)
        assert torch.allclose(
            network.pair_energies(contexts, own)[1, 2],
            network.pair_energies(alone[2:], own[1, 2])[0],
            atol=1e-5,
        )
    else:
        assert torch.allclose(
            network.optical_rotations(batch)[1], network.optical_rotations(single), atol=1e-4
        )


def test_every_parameter_learns(network: RelPose) -> None:
    images, crops = inputs(network.preset, 2, 3)
    network.zero_grad()
    features = network.encode(images, crops)
    loss = network.optical_translations(features).square().sum()
    if has_energy(network):
        contexts = network.pair_contexts(features, [0, 0, 1], [1, 2, 2])
        loss = (
            loss + network.pair_energies(contexts, network.embed_relative(rotations(5))).logsumexp(-1).sum()
        )
    else:
        loss = loss + (network.optical_rotations(features) * torch.randn(3, 3)).sum()
    loss.backward()
    idle = [name for name, p in network.named_parameters() if p.grad is None or not p.grad.abs().sum() > 0]
    assert idle == []


@torch.no_grad()
def test_views_hear_each_other_only_as_far_as_the_context_reaches(energy_network: RelPose) -> None:
    network = energy_network
    images, crops = inputs(network.preset, 3)
    other_images, other_crops = images.clone(), crops.clone()
    other_images[2], other_crops[2] = inputs(network.preset, 1, seed=9)[0][0], 0.3
    before, after = (
        network.pair_contexts(network.encode(*scan), [0], [1])
        for scan in ((images, crops), (other_images, other_crops))
    )
    assert torch.allclose(before, after, atol=1e-5) == network.preset.pair_context


@torch.no_grad()
def test_without_index_encoding_the_order_of_views_means_nothing() -> None:
    images, crops = inputs(COMPACT, 4)
    order = [2, 0, 3, 1]
    for indexed in (True, False):
        network = random_network(replace(COMPACT, index_encoding=indexed), 5)
        tokens = network.encode(images, crops).tokens[order]
        relabelled = network.encode(images[order], crops[order]).tokens
        assert torch.allclose(tokens, relabelled, atol=1e-4) != indexed


@torch.no_grad()
def test_the_energy_is_the_sum_of_its_parts_through_the_perceptron(energy_network: RelPose) -> None:
    """Layer by layer as published, without merging the last two."""
    network = energy_network
    features = network.encode(*inputs(network.preset, 3))
    turned = rotations(7)
    context, embedding = network.pair_contexts(features, [1], [2]), network.embed_rotations(turned)
    expected = network.layers(context + embedding)[:, 0]
    assert torch.allclose(network.pair_energies(context, embedding)[0], expected, atol=1e-5)
    if not network.preset.pair_context:
        assert torch.allclose(network.energies(features[1], features[2], turned), expected, atol=1e-5)
        assert not torch.allclose(network.energies(features[2], features[1], turned), expected, atol=1e-5)


@torch.no_grad()
def test_a_view_looked_at_alone_is_the_view_looked_at_among_others(compact: RelPose) -> None:
    """What lets an estimate keep a view's features while its scan grows."""
    images, crops = inputs(COMPACT, 3)
    together = compact.look(images)
    alone = ViewFeatures.stack([compact.look(images[k : k + 1])[0] for k in range(3)])
    assert torch.allclose(alone.pooled, together.pooled, atol=1e-4)
    assert alone.maps is not None
    assert together.maps is not None
    assert torch.allclose(alone.maps, together.maps, atol=1e-4)
    assert alone.maps.norm(dim=-3).allclose(torch.ones(3, 16, 16))
    assert torch.allclose(
        compact.relate(alone, crops).tokens, compact.encode(images, crops).tokens, atol=1e-3
    )


@torch.no_grad()
def test_a_backbone_in_bfloat16_says_nearly_the_same_in_single_precision() -> None:
    network = random_network(replace(COMPACT, backbone="residual", stage_depths=(1, 1, 1, 1)), 1)
    images = torch.randn(2, 3, 128, 128, generator=torch.Generator().manual_seed(0))
    exact = network.look(images)
    network.backbone_in_bfloat16 = True
    lowered = network.look(images)
    assert exact.maps is not None
    assert lowered.maps is not None
    for ours, expected in ((lowered.pooled, exact.pooled), (lowered.maps, exact.maps)):
        assert ours.dtype == torch.float32
        error = float((ours - expected).norm() / expected.norm())
        assert 1e-5 < error < 2e-2
    assert torch.equal(network.look(images).pooled, lowered.pooled)
    with torch.autocast("cpu", torch.bfloat16):
        assert network.look(images).pooled.dtype == torch.float32
    compact = random_network("compact", 1)
    exact = compact.look(images)
    compact.backbone_in_bfloat16 = True
    assert torch.equal(compact.look(images).pooled, exact.pooled)


def test_features_are_indexed_by_view() -> None:
    features = SceneFeatures(torch.arange(24.0).reshape(2, 3, 4), torch.zeros(2, 3, 5, 6, 7))
    assert len(features) == 3
    assert torch.equal(features[1].tokens, features.tokens[:, 1])
    assert features[[2, 0]].tokens.tolist() == features.tokens[:, [2, 0]].tolist()
    assert features[1:].maps is not None
    assert features[1:].maps.shape == (2, 2, 5, 6, 7)
    back = SceneFeatures.stack([features[k] for k in range(3)])
    assert torch.equal(back.tokens, features.tokens)
    assert back.maps is not None
    assert back.maps.shape == (2, 3, 5, 6, 7)


@torch.no_grad()
def test_translations_start_from_one_ahead_of_the_look_at_point_and_are_turned_to_optical_axes() -> None:
    for frame, ahead in (("look_at", 1.0), ("first_camera", 0.0)):
        network = random_network(replace(NARROW, translation_frame=frame), 0)
        features = network.encode(*inputs(NARROW, 3))
        network.translation_regressor.decode[1].weight.zero_()
        network.translation_regressor.decode[1].bias.copy_(torch.tensor([0.1, 0.2, 0.3]))
        assert network.translations(features).numpy() == pytest.approx(
            np.tile([0.1, 0.2, 0.3 + ahead], (3, 1)), abs=1e-6
        )
        assert network.optical_translations(features).numpy() == pytest.approx(
            np.tile([-0.1, -0.2, 0.3 + ahead], (3, 1)), abs=1e-6
        )


@torch.no_grad()
def test_in_pair_context_translations_are_read_beside_the_first_view_alone() -> None:
    network = random_network(VARIANTS["pair context"], 3)
    images, crops = inputs(COMPACT, 3)
    all_three = network.translations(network.encode(images, crops))
    first_and_third = network.translations(network.encode(images[[0, 2]], crops[[0, 2]]))
    assert torch.allclose(all_three[2], first_and_third[1], atol=1e-4)
    assert torch.allclose(
        all_three[:2], network.translations(network.encode(images[:2], crops[:2])), atol=1e-4
    )


@torch.no_grad()
def test_regressed_rotations_are_rotations_and_the_first_is_the_identity() -> None:
    network = random_network(VARIANTS["regression, look-at"], 3)
    rotation = network.optical_rotations(network.encode(*inputs(COMPACT, 2, 4)))
    identity = torch.eye(3).expand(2, 4, 3, 3)
    assert torch.allclose(rotation @ rotation.mT, identity, atol=1e-5)
    assert torch.allclose(torch.linalg.det(rotation), torch.ones(2, 4))
    assert torch.allclose(rotation[:, 0], identity[:, 0], atol=1e-5)
    assert not torch.allclose(rotation[:, 1], identity[:, 1], atol=1e-2)


def test_the_compact_network_keeps_within_its_bounds(compact: RelPose) -> None:
    weights = sum(p.numel() for p in compact.parameters())
    assert weights <= 12e6
    assert SHIPPED_WEIGHTS.stat().st_size <= 25e6


@pytest.mark.parametrize("dtype", [torch.float64, torch.bfloat16])
@torch.no_grad()
def test_every_tensor_made_on_the_way_has_the_weights_type(dtype: torch.dtype) -> None:
    network = random_network(COMPACT, 2).to(dtype)
    images, crops = inputs(COMPACT, 2)
    features = network.encode(images.to(dtype), crops.to(dtype))
    energies = network.pair_energies(
        network.pair_contexts(features, [0], [1]), network.embed_relative(rotations(3))
    )
    assert energies.dtype == network.optical_translations(features).dtype == dtype
    assert energies.isfinite().all()


@pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device")
@torch.no_grad()
def test_every_tensor_made_on_the_way_is_where_the_weights_are() -> None:
    images, crops = inputs(COMPACT, 2)
    results = []
    for device in ("cpu", "cuda"):
        network = random_network(COMPACT, 2).to(device)
        features = network.encode(images.to(device), crops.to(device))
        contexts = network.pair_contexts(features, [0], [1])
        results.append(network.pair_energies(contexts, network.embed_relative(rotations(3).to(device))).cpu())
        assert network.optical_translations(features).device == network.device
    assert torch.allclose(*results, atol=1e-3)


def test_wrong_inputs_are_refused_with_their_shapes(compact: RelPose) -> None:
    images, crops = inputs(COMPACT, 9)
    with pytest.raises(NetworkUseError, match=r"\(N, 3, 128, 128\); given \(9, 3, 64, 64\)"):
        compact.look(images[..., :64, :64])
    looked = ViewFeatures(torch.zeros(9, COMPACT.pooled_width), None)
    with pytest.raises(NetworkUseError, match="at most 8 views, it was given 9"):
        compact.relate(looked, crops)
    with pytest.raises(NetworkUseError, match=r"shape \(2, 3\), they were given \(3, 3\)"):
        compact.relate(looked[:2], crops[:3])


def test_a_network_says_what_it_does_not_have(compact: RelPose) -> None:
    features = SceneFeatures(torch.zeros(2, COMPACT.token_width), None)
    with pytest.raises(NetworkUseError, match="use the solver"):
        compact.optical_rotations(features)
    regression = random_network(VARIANTS["regression, look-at"], 0)
    with pytest.raises(NetworkUseError, match="has no pair energies"):
        regression.pair_contexts(features, [0], [1])
    with pytest.raises(NetworkUseError, match="has no pair energies"):
        regression.embed_relative(rotations(1))
