"""Local features of a view, and which of two views' features belong together: SIFT (Lowe 2004).

A surface seen at a slant is squeezed. So that it matches, features are found in a squeezed picture too: in
one direction and by one factor of all that ASIFT (Morel and Yu 2009) tries, since cameras go around an object
more than over it, and the rest costs more than it adds.

SIFT knows a few pixels around a feature. A network that has learned to tell the places of an object from each
other speaks beside it, where there is one.

Image coordinates are rays (x / z, y / z) of the pinhole camera.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.inference.outlines import find_outline, focal_lengths, known_rays, rays_of

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.inference.outlines import Outline
    from relpose_ros.views import View

    FloatArray = npt.NDArray[np.float64]
    IntArray = npt.NDArray[np.int64]
    Descriptors = npt.NDArray[np.float32]

MOST_FEATURES = 2500
"""The strongest; with fewer, views far apart do not match."""
MOST_SQUEEZED = 1200
"""Of the squeezed picture: more match hardly more, and matching costs the most."""
LEAST_SHARE = 0.1
"""Of a picture, the least that a mask is taken to fill: SIFT is asked for as many more features as the mask
fills less, and its time grows with them."""
LONGEST_SIDE = 640
"""Pixels: a larger part of an image is shrunk to it. Finer features add time and hardly any matches."""
LARGEST_SCALE = 1.5
"""A smaller part is enlarged, up to this: SIFT finds little in a small crop as it is."""
CONTRAST = 0.01
"""A quarter of Lowe's: plain objects have few features of any contrast, and a bad one costs little."""
RATIO = 0.85
"""Largest distance of a match relative to the second best in either view (Lowe 2004), on root-normalised
descriptors."""
LEARNED_RATIO = 0.93
"""The same where a network speaks too: what looks alike elsewhere on the object is further away then."""
LEARNED_SHARE = 0.3
"""Of the network's descriptors in the likeness of two features; the rest is SIFT's. Chosen on 373 pairs of
views within 110 degrees (two photographed captures, ten rendered ones, none trained on): 196 had a pose right
to 10 degrees with it, 170 without, 191 with 0.2 and 189 with 0.4. That is the shipped network; others that
learned the same should be like it."""
SIFT_NUMBERS = 128
"""In a descriptor of SIFT's."""
ROUNDING = 1e-5
"""Of a squared distance of descriptors."""
SQUEEZE = 2.0
"""Factor by which the width of the picture is divided: surfaces turned by 60 degrees."""
SAME_PLACE = 2.0
"""Pixels within which a feature of the squeezed picture is one of the picture as it is."""


@dataclass(frozen=True, eq=False)
class DescriptorMap:
    """What a network says of the places of a view, and where in the view they are."""

    descriptors: Descriptors
    """(C, h, w), unit length, at the middles of equal parts of the crop."""
    left: int
    top: int
    """Of the crop, pixels of the full image."""
    side: int
    """Of the crop, pixels."""

    def at(self, pixels: FloatArray) -> Descriptors:
        """Unit descriptors of pixels (K, 2) of the full image, zero outside the crop. -> (K, C)."""
        import torch

        places = torch.from_numpy(2 * (pixels - [self.left, self.top]) / self.side - 1).float()
        sampled = torch.nn.functional.grid_sample(
            *(torch.from_numpy(self.descriptors)[None], places[None, None]),
            padding_mode="border",
            align_corners=False,
        )[0, :, 0].T
        inside = (places.abs() <= 1).all(1, keepdim=True)
        return np.asarray((torch.nn.functional.normalize(sampled) * inside).numpy())


@dataclass(frozen=True, eq=False)
class LocalFeatures:
    """The local features of one view."""

    rays: FloatArray
    """(K, 2)."""
    orientations: FloatArray
    """(K,) rad, of the gradients that a feature's descriptor is relative to."""
    descriptors: Descriptors
    """(K, 128), unit length, root-normalised (Arandjelovic and Zisserman 2012); (K, 128 + C) with a network's
    behind them."""
    places: IntArray
    """(K,) position of the first feature at the same place: mostly a feature's own."""
    plain: int
    """How many there are, from the first, of the picture as it is; the others are of the squeezed one."""
    pixel: float
    """A pixel of the picture in which they were found, in units of ``rays``: the scale of their accuracy."""
    guessed: bool
    """Whether the intrinsics are a guess."""
    strays: bool = False
    """Whether features of what stands around the object may be among them, although they should not: a box
    has room for them, and no mask tells them apart."""
    learned: bool = False
    """Whether a network's descriptors are among ``descriptors``."""
    outline: Outline | None = None
    """As `relpose_ros.inference.outlines.find_outline` has it."""

    @cached_property
    def by_sift(self) -> LocalFeatures:
        """The same with SIFT's descriptors alone."""
        of_sift = self.descriptors[:, :SIFT_NUMBERS]
        lengths = np.linalg.norm(of_sift, axis=1, keepdims=True)
        return replace(self, descriptors=of_sift / np.maximum(lengths, 1e-9), learned=False)

    @cached_property
    def extent(self) -> float:
        """`extent` of all rays, the same for every pair of the view."""
        return extent(self.rays)


def extent(rays: FloatArray) -> float:
    """Standard deviation of rays (K, 2) along the direction in which it is least."""
    return float(np.sqrt(max(np.linalg.eigvalsh(np.cov(rays.T))[0], 0.0)))


def find_features(
    view: View, learned: DescriptorMap | None = None, *, surroundings: bool = False
) -> LocalFeatures:
    """SIFT features of the object, or of all the picture.

    Args:
        view: Its intrinsics are guessed from the size of the image where it has none.
        learned: What a network says of its places.
        surroundings: Whether what lies outside the object's box and mask takes part. A static table helps a
            moving camera, and misleads where the object is what turns.
    """
    import cv2

    left, top, picture = _part(view, surroundings)
    scale = min(LARGEST_SCALE, LONGEST_SIDE / max(picture.shape[:2]))
    grey: Any = cv2.cvtColor(picture, cv2.COLOR_RGB2GRAY)
    region: Any = None
    if view.mask is not None and not surroundings:
        rows, columns = slice(top, top + grey.shape[0]), slice(left, left + grey.shape[1])
        region = view.mask[rows, columns].astype(np.uint8)
    if scale != 1:
        size = (max(1, round(scale * grey.shape[1])), max(1, round(scale * grey.shape[0])))
        grey = cv2.resize(grey, size, interpolation=cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR)
        region = None if region is None else cv2.resize(region, size, interpolation=cv2.INTER_NEAREST)
    narrow, narrow_region = _squeezed(grey, region)
    # Every pair of one view more waits for both.
    with ThreadPoolExecutor(min(2, cv2.getNumThreads())) as pool:
        found = list(
            pool.map(_detect, (grey, narrow), (region, narrow_region), (MOST_FEATURES, MOST_SQUEEZED))
        )
    found[1][0][:, 0] *= grey.shape[1] / narrow.shape[1]
    points, orientations, descriptors = (np.concatenate(parts) for parts in zip(*found, strict=True))
    # Sizes are whole: the sides may have been scaled a little differently.
    pixels = points * [picture.shape[1] / grey.shape[1], picture.shape[0] / grey.shape[0]]
    pixels += [left + view.origin[0], top + view.origin[1]]
    if learned is not None:
        descriptors = _joined(descriptors, learned.at(pixels))
    rays = rays_of(view, pixels)
    known = known_rays(rays)
    plain = int(known[: len(found[0][0])].sum())
    places = _places(points[known], plain)
    pixel = 1 / (scale * float(focal_lengths(view).mean()))
    return LocalFeatures(
        *(rays[known], orientations[known], descriptors[known], places, plain, pixel),
        guessed=view.intrinsics is None,
        strays=view.mask is None and not surroundings,
        learned=learned is not None,
        outline=find_outline(view),
    )


def match(first: LocalFeatures, second: LocalFeatures) -> IntArray:
    """Features that are each other's nearest, and much nearer than either's second.

    Of two squeezed pictures none says more than of the pictures as they are.

    Returns:
        (M, 2) positions; no two of the same places.

    Raises:
        ValueError: A network's descriptors are among those of one view alone.
    """
    if first.learned != second.learned:
        raise ValueError("A network has described one of the two views alone: they cannot be compared.")
    ratio = LEARNED_RATIO if first.learned else RATIO
    plain_i, squeezed_i = np.split(first.descriptors, [first.plain])
    plain_j, squeezed_j = np.split(second.descriptors, [second.plain])
    found = np.concatenate(
        [
            _nearest(plain_i, plain_j, ratio),
            _nearest(squeezed_i, plain_j, ratio) + np.array([first.plain, 0]),
            _nearest(plain_i, squeezed_j, ratio) + np.array([0, second.plain]),
        ]
    )
    places = np.stack([first.places[found[:, 0]], second.places[found[:, 1]]], 1)
    return found[np.sort(np.unique(places, axis=0, return_index=True)[1])]


def _joined(descriptors: Descriptors, learned: Descriptors) -> Descriptors:
    """SIFT's descriptors (K, 128) with the network's (K, C) behind them, unit length. -> (K, 128 + C).

    Of places that the network did not see SIFT speaks alone.
    """
    share = LEARNED_SHARE * (learned**2).sum(1, keepdims=True)
    return np.concatenate([np.sqrt(1 - share) * descriptors, math.sqrt(LEARNED_SHARE) * learned], 1)


def _nearest(first: Descriptors, second: Descriptors, ratio: float) -> IntArray:
    """Descriptors that are each other's nearest, by Lowe's ratio test from both sides. -> (M, 2)."""
    if len(first) < 2 or len(second) < 2:
        return np.zeros((0, 2), np.int64)
    likeness = first @ second.T
    best = likeness.argmax(1)
    rows = np.arange(len(likeness))
    highest = likeness[rows, best]
    likeness[rows, best] = -1
    chosen = rows[_apart(highest, likeness.max(1), ratio)]
    # The other way round for the few that are left alone, and worked out anew: columns are slow to read.
    columns = second[best[chosen]] @ first.T
    mutual = columns.argmax(1) == chosen
    columns[np.arange(len(chosen)), chosen] = -1
    chosen = chosen[mutual & _apart(highest[chosen], columns.max(1), ratio)]
    return np.stack([chosen, best[chosen]], 1)


def _apart(best: Descriptors, second: Descriptors, ratio: float) -> npt.NDArray[np.bool_]:
    """Lowe's ratio test, by inner products of unit descriptors: of two that look the same, none is nearer."""
    return np.asarray(2 - 2 * best + ROUNDING < ratio**2 * (2 - 2 * second))


def _detect(grey: Any, region: Any, most: int) -> tuple[FloatArray, FloatArray, Descriptors]:
    """Points (K, 2) from the corner of the first pixel, orientations and descriptors."""
    import cv2

    # SIFT counts the features outside the region too, before it drops them.
    share = 1.0 if region is None else max(float(region.mean()), LEAST_SHARE)
    create: Any = vars(cv2)["SIFT_create"]  # in every version, and in no version's type stubs
    sift = create(nfeatures=round(most / share), contrastThreshold=CONTRAST)
    points, found = sift.detectAndCompute(grey, region)
    descriptors = np.zeros((0, SIFT_NUMBERS), np.float32) if found is None else found
    strongest = np.argsort([-point.response for point in points], kind="stable")[:most]
    points, descriptors = [points[k] for k in strongest], descriptors[strongest]
    descriptors = np.sqrt(descriptors / np.maximum(descriptors.sum(1, keepdims=True), 1e-9))
    # OpenCV's (0, 0) is the first pixel's centre.
    places = np.array([point.pt for point in points], np.float64).reshape(-1, 2) + 0.5
    return places, np.radians([point.angle for point in points]), descriptors


def _squeezed(grey: Any, region: Any) -> tuple[Any, Any]:
    """A picture and the part of it that counts, to half its width."""
    import cv2

    size = (max(1, round(grey.shape[1] / SQUEEZE)), grey.shape[0])
    narrow = cv2.resize(grey, size, interpolation=cv2.INTER_AREA)
    return narrow, None if region is None else cv2.resize(region, size, interpolation=cv2.INTER_NEAREST)


def _places(points: FloatArray, plain: int) -> IntArray:
    """Of each feature the first at its place; SIFT has several where a gradient's direction is not clear."""
    from scipy.spatial import cKDTree

    _, first, inverse = np.unique(points, axis=0, return_index=True, return_inverse=True)
    places = np.asarray(first[inverse.reshape(-1)], np.int64)
    if 0 < plain < len(points):
        distance, nearest = cKDTree(points[:plain]).query(points[plain:], distance_upper_bound=SAME_PLACE)
        near = np.isfinite(distance)
        places[plain:][near] = places[nearest[near]]
    return places


def _part(view: View, surroundings: bool) -> tuple[int, int, npt.NDArray[np.uint8]]:
    """Column, row (in ``view.image``) and pixels of where to look."""
    height, width = view.image.shape[:2]
    if surroundings:
        return 0, 0, view.image
    x, y = view.origin
    left, top = (
        min(max(round(view.box.x0 - x), 0), width - 1),
        min(max(round(view.box.y0 - y), 0), height - 1),
    )
    # One pixel at least, which has no features, as a box outside the image has none.
    right, bottom = max(round(view.box.x1 - x), left + 1), max(round(view.box.y1 - y), top + 1)
    return left, top, view.image[top:bottom, left:right]
