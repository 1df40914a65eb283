"""Procedural pictures: surface textures, labels with text, rulers, and rooms seen all around.

A pattern is drawn once per process in grey and coloured anew for each use, because drawing noise
costs far more than looking colours up. Images are RGB uint8.
"""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING

import cv2
import numpy as np

if TYPE_CHECKING:
    import numpy.typing as npt

    Image = npt.NDArray[np.uint8]
    FloatArray = npt.NDArray[np.float64]

PATTERN_COUNT = 480
ROOM_COUNT = 48
_SALT = 0x7E47
"""Keeps the streams of the pattern bank apart from those of the scans."""
_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
# fmt: off
_SYLLABLES = (
    "ba", "co", "di", "fe", "gu", "ha", "jo", "ka", "lu", "mi", "no", "pe", "ra",
    "su", "to", "vi", "wa", "xe", "yo", "zu", "an", "or", "el", "is", "th", "qu",
)
# fmt: on


def fractal_noise(
    rng: np.random.Generator, size: tuple[int, int], *, coarsest: int = 3, roughness: float = 0.55
) -> FloatArray:
    """Sum of smooth random grids, each twice as fine as the one before, scaled to 0..1.

    Args:
        rng: Source of the grids.
        size: Height and width in pixels.
        coarsest: Cells of the first grid along the longer side.
        roughness: Amplitude of a grid relative to the one before.
    """
    height, width = size
    total = np.zeros(size, np.float32)
    cells, amplitude = coarsest, 1.0
    while cells <= max(size):
        rows = max(2, round(cells * height / max(size)))
        columns = max(2, round(cells * width / max(size)))
        grid = rng.random((rows, columns), np.float32)
        total += amplitude * cv2.resize(grid, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, amplitude = cells * 2, amplitude * roughness
    low, high = float(total.min()), float(total.max())
    return np.asarray((total - low) / max(high - low, 1e-6), np.float64)


@lru_cache(maxsize=PATTERN_COUNT)
def pattern(number: int, size: int = 256) -> Image:
    """Grey pattern ``number`` of the bank, (size, size): the same in every process."""
    rng = np.random.default_rng([_SALT, number])
    y, x = np.mgrid[0:size, 0:size] / size
    kind = number % 12
    if kind in (0, 1, 2):
        grey = fractal_noise(
            rng, (size, size), coarsest=int(rng.integers(2, 24)), roughness=rng.uniform(0.4, 0.95)
        )
    elif kind == 3:
        # Marble and wood: rings or lines bent by noise.
        bend = fractal_noise(rng, (size, size), coarsest=3, roughness=0.5) * rng.uniform(0.5, 4)
        along = x * rng.integers(1, 6) + y * rng.integers(0, 3)
        grey = 0.5 + 0.5 * np.sin(2 * np.pi * (along + bend))
    elif kind == 4:
        phase = x * rng.integers(0, 9) + y * rng.integers(1, 9) + rng.random()
        grey = (phase % 1 > rng.uniform(0.2, 0.8)).astype(np.float64)
    elif kind == 5:
        columns, rows = rng.integers(2, 14, 2)
        grey = ((x * columns).astype(int) + (y * rows).astype(int)) % 2 * 1.0
    elif kind == 6:
        grey = _dots(rng, size)
    elif kind == 7:
        grey = _cells(rng, size)
    elif kind == 8:
        grey = _bricks(rng, x, y)
    elif kind == 9:
        # Scratches, speckle and stains on a worn surface.
        grey = _scratches(rng, size)
    elif kind == 10:
        grey = _shapes(rng, size)
    else:
        # Thresholded noise: camouflage, map-like patches.
        noise = fractal_noise(rng, (size, size), coarsest=int(rng.integers(3, 12)), roughness=0.45)
        grey = np.floor(noise * rng.integers(2, 6)) / 5
    if kind > 2 and rng.random() < 0.6:
        grey = grey + rng.uniform(0.05, 0.5) * fractal_noise(rng, (size, size), coarsest=6, roughness=0.75)
    grey = (grey - grey.min()) / max(float(np.ptp(grey)), 1e-6)
    return np.asarray(grey * 255, np.uint8)


def _dots(rng: np.random.Generator, size: int) -> FloatArray:
    image = np.zeros((size, size), np.uint8)
    for _ in range(int(rng.integers(6, 60))):
        centre = rng.integers(0, size, 2).tolist()
        cv2.circle(
            image, centre, int(rng.integers(2, size // 8)), int(rng.integers(60, 255)), -1, cv2.LINE_AA
        )
    return image / 255.0


def _cells(rng: np.random.Generator, size: int) -> FloatArray:
    """Voronoi cells or their borders: leather, pebbles, tiles."""
    seeds = np.full((size, size), 255, np.uint8)
    count = int(rng.integers(12, 160))
    seeds[rng.integers(0, size, count), rng.integers(0, size, count)] = 0
    distance, labels = cv2.distanceTransformWithLabels(seeds, cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL)
    if rng.random() < 0.5:
        return np.asarray(distance / distance.max(), np.float64)
    return np.asarray(rng.random(int(labels.max()) + 1)[labels], np.float64)


def _bricks(rng: np.random.Generator, x: FloatArray, y: FloatArray) -> FloatArray:
    rows, columns = int(rng.integers(3, 12)), int(rng.integers(2, 8))
    row = np.floor(y * rows).astype(int)
    u = (x * columns + 0.5 * (row % 2)) % columns
    brick = np.floor(u).astype(int)
    shade = rng.uniform(0.4, 1, (rows, columns))[row % rows, brick % columns]
    joint = rng.uniform(0.03, 0.12)
    inside = (u % 1 > joint) & (y * rows % 1 > joint)
    return np.asarray(np.where(inside, shade, rng.uniform(0, 0.3)))


def _scratches(rng: np.random.Generator, size: int) -> FloatArray:
    image = (fractal_noise(rng, (size, size), coarsest=4, roughness=0.7) * 140).astype(np.uint8)
    for _ in range(int(rng.integers(10, 80))):
        start = rng.integers(0, size, 2)
        end = start + rng.normal(0, size / 6, 2).astype(int)
        shade = int(rng.integers(0, 255))
        cv2.line(image, start.tolist(), end.tolist(), shade, int(rng.integers(1, 3)), cv2.LINE_AA)
    return image / 255.0


def _shapes(rng: np.random.Generator, size: int) -> FloatArray:
    image = np.full((size, size), int(rng.integers(0, 255)), np.uint8)
    for _ in range(int(rng.integers(5, 40))):
        corner, extent = rng.integers(0, size, 2), rng.integers(size // 40, size // 3, 2)
        shade = int(rng.integers(0, 255))
        if rng.random() < 0.5:
            cv2.rectangle(image, corner.tolist(), (corner + extent).tolist(), shade, -1)
        else:
            points = (corner + rng.normal(0, 1, (int(rng.integers(3, 6)), 2)) * extent).astype(np.int32)
            cv2.fillPoly(image, [points], shade, cv2.LINE_AA)
    return image / 255.0


def random_colour(rng: np.random.Generator) -> FloatArray:
    """(3,) RGB 0..1. Greys and browns are as common as strong colours, as on real things."""
    kind = rng.random()
    if kind < 0.35:
        return np.clip(rng.uniform(0.05, 0.95) + rng.normal(0, 0.03, 3), 0, 1)
    if kind < 0.6:
        earth = np.array([0.62, 0.45, 0.3]) * rng.uniform(0.3, 1.4) + rng.normal(0, 0.06, 3)
        return np.clip(earth, 0, 1)
    colour = rng.random(3)
    return np.asarray(colour + (colour.mean() - colour) * rng.uniform(0, 0.7))


def palette(rng: np.random.Generator, stops: int | None = None, contrast: float = 1.0) -> Image:
    """(256, 3) colours that run through a few random ones; low contrast keeps them close together."""
    count = int(rng.integers(2, 5)) if stops is None else stops
    base = random_colour(rng)
    colours = np.stack([base] + [random_colour(rng) for _ in range(count - 1)])
    colours = base + (colours - base) * contrast
    place = np.linspace(0, 1, count)
    ramp = np.stack([np.interp(np.linspace(0, 1, 256), place, colours[:, k]) for k in range(3)], -1)
    return np.asarray(np.clip(ramp, 0, 1) * 255, np.uint8)


def coloured(grey: Image, colours: Image) -> Image:
    """Look a (H, W) pattern up in a (256, 3) palette -> (H, W, 3)."""
    return colours[grey]


def surface(rng: np.random.Generator, size: int = 256, contrast: float | None = None) -> Image:
    """A random material, (size, size, 3)."""
    if contrast is None:
        contrast = rng.uniform(0.1, 0.5) if rng.random() < 0.5 else rng.uniform(0.5, 1)
    picture = coloured(pattern(int(rng.integers(PATTERN_COUNT)), size), palette(rng, contrast=contrast))
    return worn(picture, rng) if rng.random() < 0.5 else picture


def worn(picture: Image, rng: np.random.Generator) -> Image:
    """Dirt, fading and grain over a (H, W, 3) texture: real surfaces are seldom as clean as patterns."""
    mask = pattern(12 * int(rng.integers(PATTERN_COUNT // 12)) + int(rng.integers(3)))
    height, width = picture.shape[:2]
    shade = cv2.resize(mask, (width, height)).astype(np.float32) / 255 - 0.5
    strength = rng.uniform(0.1, 0.7)
    return np.asarray(np.clip(picture * (1 + strength * shade[..., None]), 0, 255), np.uint8)


def word(rng: np.random.Generator) -> str:
    """A pronounceable made-up word or a number."""
    if rng.random() < 0.2:
        return str(int(rng.integers(1, 99999)))
    text = "".join(rng.choice(_SYLLABLES) for _ in range(int(rng.integers(1, 4))))
    return text.upper() if rng.random() < 0.6 else text.capitalize()


def write_text(
    image: Image, rng: np.random.Generator, text: str, centre: tuple[float, float], width: float
) -> None:
    """Write ``text`` into ``image`` about ``centre`` (x, y), ``width`` pixels wide."""
    font = int(rng.choice(_FONTS))
    natural = cv2.getTextSize(text, font, 1.0, 1)[0]
    scale = width / max(natural[0], 1)
    thickness = max(1, round(scale * rng.uniform(1, 4)))
    position = (int(centre[0] - width / 2), int(centre[1] + natural[1] * scale / 2))
    colour = (random_colour(rng) * 255).astype(int).tolist()
    cv2.putText(image, text, position, font, scale, colour, thickness, cv2.LINE_AA)


def label(rng: np.random.Generator, height: int, width: int) -> Image:
    """A printed label: a plain or patterned ground, panels, words, small print, a bar code."""
    if rng.random() < 0.4:
        grey = pattern(int(rng.integers(PATTERN_COUNT)))
        colours = palette(rng, contrast=rng.uniform(0.2, 1))
        image = np.asarray(cv2.resize(coloured(grey, colours), (width, height)), np.uint8)
    else:
        image = np.empty((height, width, 3), np.uint8)
        image[:] = (random_colour(rng) * 255).astype(np.uint8)
    for _ in range(int(rng.integers(0, 5))):
        corner = rng.random(2) * (width, height)
        extent = rng.uniform(0.08, 0.6, 2) * (width, height)
        colour = (random_colour(rng) * 255).astype(int).tolist()
        start, end = corner.astype(int).tolist(), (corner + extent).astype(int).tolist()
        if rng.random() < 0.7:
            cv2.rectangle(image, start, end, colour, -1)
        else:
            axes = np.maximum(extent / 2, 1).astype(int).tolist()
            cv2.ellipse(image, start, axes, 0, 0, 360, colour, -1, cv2.LINE_AA)
    for _ in range(int(rng.integers(1, 4))):
        text, wide = word(rng), rng.uniform(0.3, 0.9) * width
        write_text(image, rng, text, (rng.uniform(0.4, 0.6) * width, rng.uniform(0.1, 0.9) * height), wide)
    if rng.random() < 0.5:
        top, left = rng.uniform(0.5, 0.8) * height, rng.uniform(0.05, 0.5) * width
        for line in range(int(rng.integers(2, 6))):
            y = top + line * max(4.0, height / 28)
            write_text(image, rng, word(rng) + " " + word(rng), (left + width / 6, y), width / 3)
    if rng.random() < 0.3:
        bars = np.repeat(rng.integers(0, 2, 40).astype(np.uint8) * 255, 2)[: max(8, width // 4)]
        y, x = int(rng.uniform(0, 0.8) * height), int(rng.uniform(0, 0.7) * width)
        patch = image[y : y + height // 8, x : x + len(bars)]
        patch[:] = bars[None, : patch.shape[1], None]
    return np.ascontiguousarray(image)


def scale_card(rng: np.random.Generator, size: int = 256) -> Image:
    """A card as laid beside things that are photographed: a ruler, a checkerboard, a marker, a note."""
    image = np.full((size, size, 3), 245, np.uint8)
    kind = int(rng.integers(4))
    if kind == 0:
        steps = int(rng.integers(4, 12))
        fields = np.arange(size) * steps // size
        image[: size // 2, fields % 2 == 0] = 15
        image[size // 2 :, fields % 2 == 1] = 15
    elif kind == 1:
        fields = np.arange(size) * int(rng.integers(4, 9)) // size
        image[(fields[:, None] + fields[None]) % 2 == 0] = 10
    elif kind == 2:
        code = np.zeros((7, 7), np.uint8)
        code[1:-1, 1:-1] = rng.integers(0, 2, (5, 5)) * 255
        image[:] = cv2.resize(code, (size, size), interpolation=cv2.INTER_NEAREST)[..., None]
    else:
        image = label(rng, size, size)
    return image


@lru_cache(maxsize=ROOM_COUNT)
def room(number: int, height: int = 256) -> Image:
    """Panorama ``number`` of the bank, equirectangular (height, 2 height, 3), row 0 straight up.

    Walls with things on and before them, windows, lamps, a floor: or sky, skyline and land.
    """
    rng = np.random.default_rng([_SALT, 1, number])
    width = 2 * height
    image = np.empty((height, width, 3), np.float32)
    horizon = int(height * rng.uniform(0.45, 0.55))
    indoors = rng.random() < 0.7
    above, below, far = random_colour(rng), random_colour(rng), random_colour(rng)
    rise = np.linspace(0, 1, horizon)[:, None, None]
    fall = np.linspace(0, 1, height - horizon)[:, None, None]
    image[:horizon] = above * (1 - rise) * rng.uniform(0.7, 1.2) + far * rise
    image[horizon:] = below * (0.5 + 0.5 * fall)
    canvas = np.ascontiguousarray(np.clip(image, 0, 1) * 255).astype(np.uint8)
    for _ in range(int(rng.integers(15, 70))):
        _furnish(canvas, rng, horizon, indoors)
    if indoors:
        for _ in range(int(rng.integers(1, 5))):
            x, y = int(rng.uniform(0, width)), int(rng.uniform(0.03, 0.3) * height)
            span = rng.uniform(0.01, 0.06, 2) * width
            cv2.rectangle(canvas, (x, y), (x + int(span[0]), y + int(span[1])), (255, 255, 250), -1)
    grain = fractal_noise(rng, (height, width), coarsest=16, roughness=0.8)[..., None] - 0.5
    shade = 1 + rng.uniform(0.1, 0.5) * grain
    return np.asarray(np.clip(cv2.GaussianBlur(canvas, (3, 3), 0) * shade, 0, 255), np.uint8)


def _furnish(canvas: Image, rng: np.random.Generator, horizon: int, indoors: bool) -> None:
    height, width = canvas.shape[:2]
    w, h = (rng.uniform(0.01, 0.12) * width, rng.uniform(0.02, 0.35 if indoors else 0.2) * height)
    x = rng.uniform(-0.05, 1) * width
    bottom = (
        horizon + rng.uniform(-0.25, 0.2) * height if indoors else horizon + rng.uniform(-0.01, 0.06) * height
    )
    x0, y0, x1, y1 = int(x), int(bottom - h), int(x + w), int(bottom)
    kind = rng.random()
    colour = (random_colour(rng) * 255).astype(int).tolist()
    if kind < 0.25 and x0 >= 0 and y0 >= 0 and x1 < width and y1 < height and x1 > x0 and y1 > y0:
        canvas[y0:y1, x0:x1] = cv2.resize(surface(rng), (x1 - x0, y1 - y0), interpolation=cv2.INTER_AREA)
    elif kind < 0.85:
        cv2.rectangle(canvas, (x0, y0), (x1, y1), colour, -1)
        cv2.rectangle(canvas, (x0, y0), (x1, y1), [c // 2 for c in colour], 1)
    else:
        axes = (max(1, int(w / 2)), max(1, int(h / 2)))
        cv2.ellipse(canvas, (x0, (y0 + y1) // 2), axes, 0, 0, 360, colour, -1)
