"""What a camera does to a picture: exposure, colour balance, blur, grain, JPEG."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Image = npt.NDArray[np.uint8]


@dataclass(frozen=True)
class Camera:
    """How one camera develops its pictures, the same for a whole scan."""

    target: float
    """Mean brightness that its exposure control aims at, 0 to 1."""
    control: float
    """How fully it reaches it, 0 to 1."""
    balance: tuple[float, float, float]
    """Gain of red, green and blue."""
    contrast: float
    saturation: float
    blur: float
    """Standard deviation of the usual defocus, pixels."""
    grain: float
    """Standard deviation of the noise, grey values."""
    jpeg_quality: int
    """1 to 100; 100 leaves compression out."""
    sharpening: float


def random_camera(rng: np.random.Generator) -> Camera:
    """Anything from a good camera to a poor one."""
    gain = 1 + rng.normal(0, 0.05, 3)
    return Camera(
        target=float(rng.uniform(0.35, 0.6)),
        control=float(rng.uniform(0.3, 1.0)),
        balance=(float(gain[0]), float(gain[1]), float(gain[2])),
        contrast=float(rng.uniform(0.85, 1.3)),
        saturation=float(rng.uniform(0.6, 1.2)),
        blur=float(rng.uniform(0.3, 1.0)) if rng.random() < 0.3 else 0.0,
        grain=float(rng.uniform(0, 8)) if rng.random() < 0.6 else 0.0,
        jpeg_quality=int(rng.integers(35, 96)) if rng.random() < 0.6 else 100,
        sharpening=float(rng.uniform(0, 1.0)) if rng.random() < 0.3 else 0.0,
    )


def develop(
    picture: Image, camera: Camera, rng: np.random.Generator, within: npt.NDArray[np.bool_] | None = None
) -> Image:
    """One photograph by ``camera``: (H, W, 3) RGB in and out.

    Args:
        picture: As rendered.
        camera: The scan's camera.
        rng: Source of what differs between photographs.
        within: (H, W), where there is image at all; the rest stays as it is.
    """
    seen = picture if within is None else picture[within]
    brightness = max(float(seen.mean()) / 255, 0.02) if seen.size else 0.5
    exposure = (camera.target / brightness) ** camera.control * float(np.exp(rng.normal(0, 0.06)))
    exposure = float(np.clip(exposure, 0.4, 3.0))
    levels = (
        np.arange(256)[:, None] / 255 * exposure * np.asarray(camera.balance) * (1 + rng.normal(0, 0.01, 3))
    )
    # A shoulder instead of a cut keeps highlights from turning flat.
    levels = np.where(levels > 0.8, 0.8 + 0.2 * np.tanh((levels - 0.8) / 0.2), levels)
    levels = 0.5 + (levels - 0.5) * camera.contrast
    table = np.clip(levels * 255, 0, 255).astype(np.uint8)
    result: Any = cv2.LUT(picture, table[None])
    if abs(camera.saturation - 1) > 0.02:
        grey = cv2.cvtColor(cv2.cvtColor(result, cv2.COLOR_RGB2GRAY), cv2.COLOR_GRAY2RGB)
        result = cv2.addWeighted(result, camera.saturation, grey, 1 - camera.saturation, 0)
    if camera.sharpening > 0:
        soft = cv2.GaussianBlur(result, (0, 0), 1.0)
        result = cv2.addWeighted(result, 1 + camera.sharpening, soft, -camera.sharpening, 0)
    if camera.blur > 0:
        result = cv2.GaussianBlur(result, (0, 0), camera.blur * float(rng.uniform(0.6, 1.3)))
    if rng.random() < 0.06:
        result = _shaken(result, rng)
    if camera.grain > 0:
        # Cut from one long strip: drawing normal numbers anew costs more than all the rest.
        height, width = result.shape[:2]
        start = (
            int(rng.integers(0, len(_GRAIN) - height * width * 3))
            if height * width * 3 < len(_GRAIN)
            else None
        )
        grain = (
            _GRAIN[start : start + height * width * 3]
            if start is not None
            else rng.normal(0, 1, height * width * 3)
        )
        noisy = result + camera.grain * np.asarray(grain, np.float32).reshape(result.shape)
        result = np.clip(noisy, 0, 255).astype(np.uint8)
    if camera.jpeg_quality < 100:
        _, coded = cv2.imencode(".jpg", result, [cv2.IMWRITE_JPEG_QUALITY, camera.jpeg_quality])
        result = cv2.imdecode(coded, cv2.IMREAD_COLOR)
    if within is not None:
        result = np.where(within[..., None], result, 0)
    return np.asarray(result, np.uint8)


def _shaken(picture: Image, rng: np.random.Generator) -> Image:
    """Blur of a moving camera, a few pixels along a line."""
    angle, length = rng.uniform(0, np.pi), rng.uniform(1, 3)
    kernel = np.zeros((9, 9), np.float32)
    end = length * np.array([np.cos(angle), np.sin(angle)])
    start, stop = (4 - end).round().astype(int).tolist(), (4 + end).round().astype(int).tolist()
    cv2.line(kernel, start, stop, 1.0, 1)
    return np.asarray(cv2.filter2D(picture, -1, kernel / kernel.sum()), np.uint8)


_GRAIN = np.random.default_rng(0x6A1).normal(0, 1, 400_000).astype(np.float32)
