from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest

from relpose_ros.inference import local_features
from relpose_ros.inference.local_features import (
    LARGEST_SCALE,
    LONGEST_SIDE,
    DescriptorMap,
    LocalFeatures,
    find_features,
    match,
)
from relpose_ros.inference.matches import NOTHING, relate
from relpose_ros.inference.outlines import find_outline
from relpose_ros.views import BoundingBox, Distortion, Intrinsics, View


def pixels(features, view):
    """Where features are, in the full image."""
    intrinsics = view.intrinsics or Intrinsics.guessed(view.full_width, view.full_height)
    return features.rays * [intrinsics.fx, intrinsics.fy] + [intrinsics.cx, intrinsics.cy]


def features_of(descriptors):
    count = len(descriptors)
    rays, orientations = np.zeros((count, 2)), np.zeros(count)
    return LocalFeatures(rays, orientations, descriptors, np.arange(count), count, 1.0, False)


# Which features belong together.


def test_matches_are_mutual_and_distinct():
    generator = np.random.default_rng(0)
    descriptors = generator.standard_normal((6, 128)).astype(np.float32)
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    first = features_of(descriptors)
    # The second view has 3, 1, 0 in that order, and 5 twice: what looks the same twice matches nothing.
    second = features_of(descriptors[[3, 1, 0, 5, 5]])
    assert match(first, second).tolist() == [[0, 2], [1, 1], [3, 0]]
    assert match(second, first).tolist() == [[0, 3], [1, 1], [2, 0]]


def test_of_two_that_resemble_one_the_nearer_matches():
    generator = np.random.default_rng(1)
    descriptors = generator.standard_normal((4, 128)).astype(np.float32)
    descriptors[3] = descriptors[0] + 0.3 * descriptors[3]
    descriptors /= np.linalg.norm(descriptors, axis=1, keepdims=True)
    first = features_of(descriptors[[3, 0, 1]])
    second = features_of(descriptors[:3])
    assert match(first, second).tolist() == [[1, 0], [2, 1]]


@pytest.mark.parametrize("count", [0, 1])
def test_one_feature_cannot_be_distinct(count):
    none = features_of(np.ones((count, 128), np.float32))
    some = features_of(np.eye(5, 128, dtype=np.float32))
    assert match(none, some).shape == (0, 2)
    assert match(some, none).shape == (0, 2)


def test_no_two_matches_are_of_the_same_places():
    descriptors = np.eye(4, 128, dtype=np.float32)
    twice = replace(features_of(descriptors), places=np.array([0, 1, 0, 3]))
    assert match(twice, twice).tolist() == [[0, 0], [1, 1], [3, 3]]
    # In one view alone the same place may match two.
    assert match(twice, features_of(descriptors)).tolist() == [[0, 0], [1, 1], [2, 2], [3, 3]]


def test_squeezed_features_match_plain_ones_not_each_other():
    descriptors = np.eye(6, 128, dtype=np.float32)
    first = replace(features_of(descriptors[:4]), plain=2)
    second = replace(features_of(descriptors[[2, 5, 1, 3]]), plain=2)
    assert match(first, second).tolist() == [[2, 0], [1, 2]]


# What a network says beside SIFT.


def ramp(left=0, top=0, side=80):
    """A map whose descriptors turn from (1, 0) at the crop's left to (0, 1) at its right."""
    angle = np.tile((np.arange(8) + 0.5) / 8 * np.pi / 2, (8, 1)).astype(np.float32)
    return DescriptorMap(np.stack([np.cos(angle), np.sin(angle)]), left, top, side)


def test_descriptors_are_read_where_they_are_in_the_picture():
    places = np.array([[120.0, 50.0], [145.0, 90.0], [175.0, 70.0], [180.5, 70.0], [140.0, 29.0]])
    found = ramp(100, 30).at(places)
    assert found.dtype == np.float32
    angle = (places[:3, 0] - 100) / 80 * np.pi / 2
    np.testing.assert_allclose(found[:3], np.stack([np.cos(angle), np.sin(angle)], 1), atol=2e-3)
    np.testing.assert_array_equal(found[3:], 0, "nothing is known outside the crop")
    # The map's outermost places are half a place inside the crop; what is beyond them is as they are.
    np.testing.assert_allclose(ramp().at(np.array([[0.0, 40.0]]))[0], ramp().descriptors[:, 0, 0], atol=1e-6)


def test_learned_descriptors_stand_behind_sifts(textured):
    view = textured(0)
    plain, joined = find_features(view), find_features(view, ramp(side=160))
    assert not plain.learned
    assert joined.learned
    assert joined.descriptors.shape == (len(plain.descriptors), 130)
    assert joined.descriptors.dtype == np.float32, "twice the numbers take twice the time"
    np.testing.assert_array_equal(joined.rays, plain.rays)
    np.testing.assert_allclose(np.linalg.norm(joined.descriptors, axis=1), 1, atol=1e-5)
    outside = pixels(plain, view)[:, 0] > 160
    assert 10 < outside.sum() < len(outside) - 10
    np.testing.assert_array_equal(joined.descriptors[outside, :128], plain.descriptors[outside])
    np.testing.assert_array_equal(joined.descriptors[outside, 128:], 0)
    likeness = joined.descriptors[~outside, :128] @ plain.descriptors[~outside].T
    np.testing.assert_allclose(likeness.diagonal(), np.sqrt(0.7), atol=1e-4)
    assert not joined.by_sift.learned
    np.testing.assert_allclose(joined.by_sift.descriptors, plain.descriptors, atol=1e-6)


def test_a_network_tells_apart_what_sift_takes_for_the_same():
    """Two features that look the same match nothing, until their places are told from each other."""
    same = np.eye(3, 128, dtype=np.float32)[[0, 0, 1]]
    assert match(features_of(same), features_of(same)).tolist() == [[2, 2]]
    places = np.eye(3, 16, dtype=np.float32)
    told = replace(features_of(local_features._joined(same, places)), learned=True)
    assert match(told, told).tolist() == [[0, 0], [1, 1], [2, 2]]


def test_views_that_a_network_described_match_only_each_other():
    plain = features_of(np.eye(4, 128, dtype=np.float32))
    with pytest.raises(ValueError, match="one of the two views alone"):
        match(plain, replace(plain, learned=True))


@pytest.mark.parametrize(("ratio", "by_sift", "with_network"), [(0.80, 1, 1), (0.89, 0, 1), (0.96, 0, 0)])
def test_a_network_allows_a_nearer_rival(ratio, by_sift, with_network):
    """Of one feature and two that are nearly as far from it, by the ratio of the distances."""
    near = 0.5
    descriptors = np.zeros((3, 128), np.float32)
    descriptors[0, 0] = 1
    for row, distance in ((1, near), (2, near / ratio)):
        likeness = 1 - distance**2 / 2
        descriptors[row, [0, row]] = likeness, math.sqrt(1 - likeness**2)
    far = np.eye(1, 128, 9, dtype=np.float32)
    first, second = features_of(np.concatenate([descriptors[:1], far])), features_of(descriptors[1:])
    assert [0, 0] in match(first, second).tolist() or not by_sift
    assert len(match(first, second)) == by_sift
    assert len(match(replace(first, learned=True), replace(second, learned=True))) == with_network


# Features of a picture.


def test_features_lie_where_the_picture_has_them(textured):
    """The same whether the part was shrunk, its sides to whole pixels that are not quite in proportion."""
    view = textured(2, 612, 1187, intrinsics=Intrinsics(900, 910, 590, 310))
    shrunk = find_features(view)
    assert not shrunk.guessed
    assert shrunk.pixel == pytest.approx(1187 / LONGEST_SIDE / 905)
    np.testing.assert_allclose(np.linalg.norm(shrunk.descriptors, axis=1), 1, atol=1e-5)
    shifts = []
    for top in (0, 452):
        part = find_features(replace(view, box=BoundingBox(100, top, 500, top + 160)))
        assert part.pixel == pytest.approx(1 / LARGEST_SCALE / 905)
        together = match(shrunk, part)
        assert len(together) > 50
        apart = (shrunk.rays[together[:, 0]] - part.rays[together[:, 1]]) * [900, 910]
        shifts.append(np.median(apart, axis=0))
    # SIFT itself has a bias of a quarter of a pixel of the picture it was given.
    assert np.abs(shifts).max() < 0.4
    assert abs(shifts[1][1] - shifts[0][1]) < 0.2


def test_a_mirrored_picture_has_mirrored_features(textured):
    """Pixels are counted from the first one's corner: what is at x comes to the width less x."""
    view = textured(3)
    mirrored = replace(view, image=np.ascontiguousarray(view.image[:, ::-1]))
    places, others = (pixels(find_features(each), each) for each in (view, mirrored))
    others[:, 0] = 200 - others[:, 0]
    apart = np.linalg.norm(places[:, None] - others[None], axis=-1)
    near = apart.min(1) < 1.5
    assert near.sum() > 100
    error = np.median((places - others[apart.argmin(1)])[near], axis=0) / 2
    # SIFT's own bias is a quarter of a pixel of the picture it was given.
    assert -0.06 < error[0] * LARGEST_SCALE < 0.32


def test_features_are_those_of_the_box(textured):
    view = textured(0, box=BoundingBox(50, 40, 150, 120))
    inside = pixels(find_features(view), view)
    assert len(inside) > 20
    assert (inside >= [50, 40]).all()
    assert (inside <= [150, 120]).all()
    everywhere = pixels(find_features(view, surroundings=True), view)
    assert ((everywhere < [50, 40]) | (everywhere > [150, 120])).any(1).sum() > 20


def test_features_are_those_of_the_mask(textured):
    mask = np.zeros((160, 200), bool)
    mask[30:130, 60:140] = True
    view = textured(0, mask=mask)
    inside = pixels(find_features(view), view)
    assert len(inside) > 20
    column, row = np.floor(inside).astype(int).T
    near = cv2.dilate(mask.astype(np.uint8), np.ones((3, 3), np.uint8)) > 0
    assert near[row, column].all()
    assert len(find_features(view, surroundings=True).rays) > len(inside)


def test_what_lies_outside_the_mask_takes_no_place_of_the_objects_features(textured, monkeypatch):
    monkeypatch.setattr(local_features, "MOST_FEATURES", 40)
    mask = np.zeros((160, 200), bool)
    mask[40:120, 50:130] = True
    masked, whole = (find_features(textured(0, mask=each)) for each in (mask, None))
    assert masked.plain == whole.plain == 40


def test_the_strongest_features_are_kept(textured, monkeypatch):
    view = textured(0, mask=np.ones((160, 200), bool))
    every = find_features(view)
    monkeypatch.setattr(local_features, "MOST_FEATURES", every.plain // 2)
    some = find_features(view)
    assert some.plain == every.plain // 2
    np.testing.assert_array_equal(some.rays[: some.plain], every.rays[: some.plain])


def test_a_crop_says_what_the_whole_picture_says(textured):
    whole = textured(1, box=BoundingBox(60, 40, 160, 130), mask=np.ones((160, 200), bool))
    crop = replace(whole, image=whole.image[30:140, 50:170], mask=whole.mask[30:140, 50:170], origin=(50, 30))
    a, b = find_features(whole), find_features(crop)
    assert len(a.rays) > 20
    np.testing.assert_array_equal(a.rays, b.rays)
    np.testing.assert_array_equal(a.descriptors, b.descriptors)
    assert a.pixel == b.pixel


def test_without_intrinsics_the_focal_length_is_guessed(textured):
    view = textured(0)
    features = find_features(view)
    assert features.guessed
    assert features.pixel == pytest.approx(1 / (LARGEST_SCALE * 1.2 * 200))
    known = find_features(replace(view, intrinsics=Intrinsics(240, 240, 100, 80)))
    assert not known.guessed
    np.testing.assert_allclose(known.rays, features.rays)


def bent_by_a_polynomial(rays, coefficients):
    points = np.concatenate([rays, np.ones((len(rays), 1))], 1)[:, None]
    return cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.eye(3), coefficients)[0]


@pytest.mark.parametrize(
    ("distortion", "bend"),
    [
        (
            Distortion((-0.3, 0.1, 0.002, -0.001, 0.0)),
            bent_by_a_polynomial,
        ),
        (
            Distortion((-0.38, 0.14, 0.0, 0.0)),
            bent_by_a_polynomial,
        ),
        (
            Distortion((0.1, -0.02, 0.003, 0.0), equidistant=True),
            lambda rays, d: cv2.fisheye.distortPoints(rays[:, None], np.eye(3), d),
        ),
    ],
)
def test_rays_are_straightened_where_a_lens_bent_them(textured, distortion, bend):
    view = textured(0, intrinsics=Intrinsics(240, 240, 100, 80))
    bent, straight = (find_features(each).rays for each in (view, replace(view, distortion=distortion)))
    assert np.abs(bent - straight).max() > 0.005
    np.testing.assert_allclose(bend(straight, np.array(distortion.coefficients))[:, 0], bent, atol=1e-6)


def test_where_no_ray_is_known_of_a_pixel_nothing_is_made_of_it(textured):
    """A fisheye model that turns back before the corners of the picture."""
    lens = Distortion((0.1, -0.05, -0.02, -0.01), equidistant=True)
    view = textured(0, intrinsics=Intrinsics(50, 50, 100, 80))
    narrow, wide = (
        find_features(replace(view, distortion=lens, box=box))
        for box in (BoundingBox(60, 50, 140, 110), BoundingBox(5, 5, 195, 155))
    )
    assert np.isfinite(narrow.outline.sides).all()
    assert np.isnan(wide.outline.sides).all()
    for features in (narrow, wide):
        assert 0 < len(features.rays) == len(features.descriptors) == len(features.places)
        assert np.abs(features.rays).max() < 20
        assert features.places.max() < len(features.rays)
    assert len(wide.rays) < len(find_features(replace(view, box=BoundingBox(5, 5, 195, 155))).rays)


def test_features_of_the_picture_as_it_is_are_counted_without_those_of_unknown_rays(textured, monkeypatch):
    every = find_features(textured(0))
    monkeypatch.setattr(local_features, "known_rays", lambda rays: np.arange(len(rays)) >= 10)
    left = find_features(textured(0))
    assert (len(left.rays), left.plain) == (len(every.rays) - 10, every.plain - 10)


def test_a_mask_alone_keeps_strays_out(textured):
    whole = BoundingBox(0, 0, 200, 160)
    view = replace(textured(0), box=whole)
    assert find_features(view).strays
    assert not find_features(view, surroundings=True).strays, "they are asked for"
    assert find_features(replace(view, box=replace(whole, x0=10))).strays, "a box has corners"
    assert not find_features(replace(view, mask=np.ones(view.image.shape[:2], bool))).strays


def test_features_come_with_the_outline_of_their_box(textured):
    view = replace(textured(0), box=BoundingBox(40, 20, 100, 100))
    np.testing.assert_array_equal(find_features(view).outline.middle, find_outline(view).middle)


def test_a_surface_at_a_slant_matches(textured):
    """A picture, and half its width: a surface turned by sixty degrees."""
    view = textured(4, intrinsics=Intrinsics(300, 300, 100, 80))
    narrow = np.ascontiguousarray(cv2.resize(view.image, (100, 160), interpolation=cv2.INTER_AREA))
    slanted = View(narrow, BoundingBox(0, 0, 100, 160), 100, 160, intrinsics=Intrinsics(300, 300, 50, 80))
    for pair in ((view, slanted), (slanted, view)):
        features = [find_features(each) for each in pair]
        together = match(*features)
        places = [pixels(each, v)[m] for each, v, m in zip(features, pair, together.T, strict=True)]
        wide, thin = places if pair[0] is view else places[::-1]
        right = np.linalg.norm(wide * [0.5, 1] - thin, axis=1) < 1.5
        squeezed = (together >= [each.plain for each in features]).any(1)
        assert (right & squeezed).sum() > 30
        assert (right & squeezed).sum() > 3 * (right & ~squeezed).sum()


def test_a_feature_of_both_pictures_has_one_place(textured):
    features = find_features(textured(5))
    squeezed = np.arange(features.plain, len(features.rays))
    shared = squeezed[features.places[squeezed] < features.plain]
    assert len(shared) > 20
    apart = np.linalg.norm(features.rays[shared] - features.rays[features.places[shared]], axis=1)
    assert apart.max() <= 2.0001 * features.pixel
    others = np.setdiff1d(squeezed, shared)
    assert (features.places[others] >= features.plain).all()
    np.testing.assert_array_equal(features.places[features.places], features.places)


@pytest.mark.parametrize("size", [(1, 1), (2, 2), (5, 3), (40, 60)])
def test_pictures_without_features(size):
    image = np.full((*size, 3), 128, np.uint8)
    view = View(image, BoundingBox(0, 0, size[1], size[0]), size[1], size[0])
    features = find_features(view)
    assert features.rays.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert relate(features, features) is NOTHING


@pytest.mark.parametrize(
    "box",
    [
        BoundingBox(50, 50, 51, 51),
        BoundingBox(50, 50, 50.2, 90),
        BoundingBox(190, 150, 260, 220),
        BoundingBox(300, 300, 320, 330),
        BoundingBox(-40, -40, -10, -10),
    ],
)
def test_a_box_with_hardly_a_pixel_has_no_features_of_elsewhere(textured, box):
    view = textured(0, box=box)
    found = pixels(find_features(view), view)
    assert (found >= [box.x0 - 1, box.y0 - 1]).all()
    assert (found <= [box.x1 + 1, box.y1 + 1]).all()


def test_an_empty_mask_has_no_features(textured):
    view = textured(0, mask=np.zeros((160, 200), bool))
    assert len(find_features(view).rays) == 0


def test_the_same_features_on_any_number_of_threads(textured):
    view, threads = textured(0), cv2.getNumThreads()
    try:
        found = []
        for count in (1, 2):
            cv2.setNumThreads(count)
            found.append(find_features(view))
    finally:
        cv2.setNumThreads(threads)
    assert len(found[0].rays) > 200
    for name in ("rays", "orientations", "descriptors", "places"):
        assert getattr(found[0], name).tobytes() == getattr(found[1], name).tobytes()
