from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.scanning.incoming import (
    Source,
    ViewError,
    object_id_of,
    robot_pose,
    source_of,
    view_from_image,
    view_from_object_view,
)
from relpose_ros.views import BoundingBox, Distortion, Intrinsics

NAN = float("nan")


def picture(width: int = 40, height: int = 32) -> np.ndarray:
    return np.random.default_rng(3).integers(0, 256, (height, width, 3), np.uint8)


def view_of(message: Any) -> Any:
    return view_from_object_view(message, source_of(message, "views"))


def view_of_pair(image: Any, info: Any) -> Any:
    return view_from_image(image, info, source_of(image, "image"))


def test_an_object_view_becomes_a_view(messages: Any) -> None:
    pixels = picture()
    mask = np.zeros((32, 40), np.uint8)
    mask[10:20, 12:24] = 255
    message = messages.object_view(
        messages.rgb(pixels),
        box=(10, 8, 20, 10),
        mask=messages.image(mask.tobytes(), 40, 32, "mono8", 40),
        k=(500, 0, 20.25, 0, 510, 15.75, 0, 0, 1),
        stamp=12.5,
        frame_id="left_optical",
    )
    view = view_of(message)
    # The squared box is 20 wide about (20, 13); 1.2 of it are columns 8 to 32 and rows 1 to 25.
    assert view.origin == (8, 1)
    np.testing.assert_array_equal(view.image, pixels[1:25, 8:32])
    np.testing.assert_array_equal(view.mask, mask[1:25, 8:32] > 0)
    assert view.box == BoundingBox(10.0, 8.0, 30.0, 18.0)
    assert (view.full_width, view.full_height) == (40, 32)
    assert (view.stamp_ns, view.frame_id) == (12_500_000_000, "left_optical")
    assert view.intrinsics == Intrinsics(500.0, 510.0, 20.75, 16.25), "half a pixel to the corner convention"


def test_nobody_needs_to_send_a_mask_or_intrinsics(messages: Any) -> None:
    view = view_of(messages.object_view())
    assert view.mask is None
    assert view.intrinsics is None


def test_a_view_may_come_compressed(messages: Any) -> None:
    data = cv2.imencode(".png", picture())[1].tobytes()
    view = view_of(messages.object_view(compressed=messages.compressed(data, "png")))
    np.testing.assert_array_equal(view.image, picture()[6:26, 6:26, ::-1])


@pytest.mark.parametrize(
    ("size", "crop", "origin"),
    [
        ((40, 32), (0, 0, 0, 0), (6, 6)),  # the whole image
        ((40, 32), (0, 0, 40, 32), (6, 6)),  # the same, said
        ((16, 16), (0, 0, 0, 0), (8, 8)),  # the box alone
        ((16, 16), (8, 8, 16, 16), (8, 8)),
        ((30, 20), (5, 7, 30, 20), (6, 7)),  # a crop with a margin of its own
    ],
)
def test_the_crop_says_where_the_picture_belongs(
    messages: Any, size: tuple[int, int], crop: tuple[int, ...], origin: tuple[int, int]
) -> None:
    """The box is columns and rows 8 to 24, the region kept 6 to 26."""
    whole = picture()
    x, y = crop[:2] if any(crop) else (0, 0) if size == (40, 32) else (8, 8)
    message = messages.object_view(messages.rgb(whole[y : y + size[1], x : x + size[0]]), crop=crop)
    view = view_of(message)
    assert view.origin == origin
    height, width = view.image.shape[:2]
    np.testing.assert_array_equal(
        view.image, whole[origin[1] : origin[1] + height, origin[0] : origin[0] + width]
    )


WRONG_OBJECT_VIEWS: list[tuple[dict[str, Any], str]] = [
    ({"box": (8, 8, 0, 0)}, r"the box \[8, 8, 8, 8\] is too small: an object needs 8 x 8 pixels"),
    ({"box": (8, 8, 7, 20)}, r"the box \[8, 8, 15, 28\] is too small"),
    (
        {"box": (30, 8, 16, 16)},
        r"the box \[30, 8, 46, 24\] lies outside the full image of 40 x 32 pixels",
    ),
    ({"box": (2**32 - 1, 8, 2**32 - 1, 16)}, "lies outside the full image"),
    ({"full": (0, 0), "crop": (0, 0, 40, 32)}, "the full image cannot have 0 x 0 pixels"),
    ({"full": (0, 0)}, "full_width and full_height are 0: fill in the size of the camera's full image"),
    ({"full": (2**32 - 1, 32), "crop": (0, 0, 40, 32)}, "the full image cannot have 4294967295 x 32 pixels"),
    (
        {"full": (80, 64)},
        "the picture has 40 x 32 pixels: neither the full image's 80 x 64 nor the box's 16 x 16; fill crop",
    ),
    ({"crop": (0, 0, 20, 32)}, "crop has 20 x 32 pixels, the picture 40 x 32"),
    ({"crop": (1, 0, 40, 32)}, r"the crop \[1, 0, 41, 32\] lies outside the full image"),
    ({"crop": (3, 0, 0, 0)}, "crop has 0 x 0 pixels"),
    (
        {"crop": (30, 30, 40, 32), "full": (100, 100)},
        r"the box \[8, 8, 24, 24\] lies outside the picture, which shows \[30, 30, 70, 62\]",
    ),
    (
        {"crop": (0, 10, 40, 32), "full": (40, 100)},
        r"the box \[8, 8, 24, 24\] lies outside the picture, which shows \[0, 10, 40, 42\]",
    ),
    ({"crop": (10, 0, 40, 32), "full": (100, 32)}, "lies outside the picture, which shows"),
    ({"crop": (0, 0, 40, 32), "full": (100, 32), "box": (30, 8, 16, 16)}, "lies outside the picture, which"),
    ({"crop": (0, 0, 40, 32), "full": (40, 100), "box": (8, 20, 16, 16)}, "lies outside the picture, which"),
    ({"crop": (0, 1, 40, 32)}, r"the crop \[0, 1, 40, 33\] lies outside the full image"),
    ({"k": (NAN, 0, 20, 0, 500, 16, 0, 0, 1)}, r"the intrinsic matrix holds what is no number: \[nan, 0.0,"),
    ({"k": (500, 0, 20, 0, 500, 16, 0, 0, float("inf"))}, "no number"),
    ({"k": (500, 0, 20, 0, 0, 16, 0, 0, 1)}, "focal length in the intrinsic matrix is 500.0, 0.0"),
    (
        {"k": (500, 0, 20, 0, 1e12, 16, 0, 0, 1)},
        "focal length .* is 500.0, 1000000000000.0 for 40 x 32 pixels",
    ),
    (
        {"k": (500, 0, -1e9, 0, 500, 16, 0, 0, 1)},
        "principal point .* is -1000000000.0, 16.0 for 40 x 32 pixels",
    ),
    ({"k": (-500, 0, 20, 0, 500, 16, 0, 0, 1)}, "must be positive"),
    ({"k": (1.2, 0, 0.5, 0, 1.2, 0.5, 0, 0, 1)}, "is 1.2, 1.2 for 40 x 32 pixels: it must be in pixels"),
    ({"k": (500, 0, 20, 0, 1.2, 16, 0, 0, 1)}, "is 500.0, 1.2 for 40 x 32 pixels: it must be in pixels"),
    ({"frame_id": "x" * 129}, r"frame_id has 129 characters, more than 128: 'x{40}'\.\.\."),
    ({"frame_id": "a\x00b"}, r"frame_id 'a\\x00b' holds what cannot be printed"),
]


@pytest.mark.parametrize(("fields", "said"), WRONG_OBJECT_VIEWS)
def test_a_wrong_object_view_is_rejected_with_topic_stamp_and_value(
    messages: Any, fields: dict[str, Any], said: str
) -> None:
    with pytest.raises(ViewError, match=rf"^views, stamp 7\.000000009: .*{said}.*\.$"):
        view_of(messages.object_view(stamp=(7, 9), **fields))


def test_a_wrong_picture_is_rejected_with_topic_stamp_and_value(messages: Any) -> None:
    cut_off = messages.image(bytes(100), 40, 32, "rgb8", 120)
    jpeg = messages.compressed(b"\xff\xd8 no picture")
    small = messages.image(bytes(100), 10, 10, "mono8", 10)
    coloured = messages.rgb(picture())
    for fields, said in [
        ({"image": cut_off}, "the data are cut off: 100 bytes"),
        ({"image": messages.image()}, "the picture has no pixels: 0 x 0"),
        ({"compressed": jpeg}, "the JPEG's header is broken"),
        ({"image": coloured, "compressed": jpeg}, "both image and compressed are filled"),
        ({"mask": small}, "the mask has 10 x 10 pixels, the picture 40 x 32"),
        ({"mask": coloured}, "the mask's encoding is 'rgb8'"),
        (
            {"mask": messages.image(bytes(99), 40, 32, "mono8", 40)},
            "the mask: the data are cut off: 99 bytes",
        ),
    ]:
        with pytest.raises(ViewError, match=rf"^views, stamp 7\.000000009: .*{said}.*\.$"):
            view_of(messages.object_view(stamp=(7, 9), **fields))


@pytest.mark.parametrize("stamp", [(-1, 0), (5, 1_000_000_000), (5, 2**32 - 1)])
def test_a_stamp_that_is_no_time_is_rejected(messages: Any, stamp: tuple[int, int]) -> None:
    with pytest.raises(
        ViewError, match=f"views: the stamp is no time: sec is {stamp[0]}, nanosec is {stamp[1]}"
    ):
        source_of(messages.object_view(stamp=stamp), "views")


def test_the_object_id_is_checked_and_has_a_default(messages: Any) -> None:
    source = Source("views", 0, "")
    assert object_id_of(messages.object_view(object_id="mug"), source, "object") == "mug"
    assert object_id_of(messages.object_view(object_id=""), source, "object") == "object"
    with pytest.raises(ViewError, match="object_id has 5000 characters, more than 128: 'x"):
        object_id_of(messages.object_view(object_id="x" * 5000), source, "object")
    with pytest.raises(ViewError, match="cannot be printed"):
        object_id_of(messages.object_view(object_id="a\nb"), source, "object")


@pytest.mark.parametrize("compressed", [False, True])
@pytest.mark.parametrize(
    ("size", "roi", "box", "origin"),
    [
        ((40, 32), (0, 0, 0, 0), (0, 0, 40, 32), (0, 0)),
        ((40, 32), (0, 0, 40, 32), (0, 0, 40, 32), (0, 0)),
        ((40, 32), (10, 4, 20, 20), (10, 4, 30, 24), (8, 2)),
        ((20, 20), (10, 4, 20, 20), (10, 4, 30, 24), (10, 4)),
    ],
)
def test_the_roi_of_a_camera_info_is_the_box(
    messages: Any,
    size: tuple[int, int],
    roi: tuple[int, int, int, int],
    box: tuple[int, int, int, int],
    origin: tuple[int, int],
    compressed: bool,
) -> None:
    pixels = picture(*size)
    if compressed:
        data = cv2.imencode(".png", np.ascontiguousarray(pixels[..., ::-1]))[1].tobytes()
        image = messages.compressed(data, "png", stamp=2.0)
    else:
        image = messages.rgb(pixels, stamp=2.0)
    view = view_of_pair(image, messages.camera_info(40, 32, roi, stamp=2.0))
    assert view.box == BoundingBox(*map(float, box))
    assert (view.full_width, view.full_height) == (40, 32)
    assert view.origin == origin
    assert view.intrinsics == Intrinsics(500.0, 500.0, 320.5, 240.5)
    height, width = view.image.shape[:2]
    x, y = (origin[0] - roi[0], origin[1] - roi[1]) if size != (40, 32) else origin
    np.testing.assert_array_equal(view.image, pixels[y : y + height, x : x + width])


@pytest.mark.parametrize(
    ("topic", "rectification", "bent"),
    [
        ("/camera/image_raw", "auto", True),
        ("/camera/image_rect_color/compressed", "auto", False),
        ("/cam_direct/image_raw", "auto", True),
        ("/camera/image_rect", "raw", True),
        ("/camera/image_raw", "rectified", False),
    ],
)
def test_a_raw_picture_has_the_lens_s_distortion_and_a_rectified_one_a_matrix_of_its_own(
    messages: Any, topic: str, rectification: str, bent: bool
) -> None:
    image, info = messages.rgb(picture()), messages.camera_info(40, 32)
    info.d[0] = -0.3
    info.p[:] = [400, 0, 20, 0, 0, 410, 16, 0, 0, 0, 1, 0]
    view = view_from_image(image, info, source_of(image, topic), rectification)
    if bent:
        assert view.intrinsics == Intrinsics(500.0, 500.0, 320.5, 240.5)
        assert view.distortion == Distortion((-0.3, 0.0, 0.0, 0.0, 0.0))
    else:
        assert view.intrinsics == Intrinsics(400.0, 410.0, 20.5, 16.5)
        assert view.distortion is None


def test_a_rectified_picture_without_a_matrix_of_its_own_has_that_of_the_raw_one(messages: Any) -> None:
    """As of drivers that leave P empty; what the lens bent is straight all the same."""
    image, info = messages.rgb(picture()), messages.camera_info(40, 32)
    info.d[0] = -0.3
    assert not any(info.p)
    view = view_from_image(image, info, source_of(image, "/camera/image_rect"))
    assert view.intrinsics == Intrinsics(500.0, 500.0, 320.5, 240.5)
    assert view.distortion is None


def test_a_straight_lens_and_an_unknown_camera_have_no_distortion(messages: Any) -> None:
    assert view_of_pair(messages.rgb(picture()), messages.camera_info(40, 32)).distortion is None
    info = messages.camera_info(40, 32, k=(0,) * 9)
    info.d[0] = 0.1
    assert view_of_pair(messages.rgb(picture()), info).distortion is None


def test_a_fisheye_lens_of_four_zeros_bends_by_the_angle_alone(messages: Any) -> None:
    info = messages.camera_info(40, 32)
    info.distortion_model, info.d = "equidistant", np.zeros(4)
    view = view_of_pair(messages.rgb(picture()), info)
    assert view.distortion == Distortion((0.0, 0.0, 0.0, 0.0), equidistant=True)
    info.d = np.zeros(0)
    assert view_of_pair(messages.rgb(picture()), info).distortion is None


@pytest.mark.parametrize("count", [8, 12, 14])
def test_a_rational_polynomial_may_have_a_prism_and_a_tilt(messages: Any, count: int) -> None:
    info = messages.camera_info(40, 32)
    info.distortion_model, info.d = "rational_polynomial", np.full(count, 0.01)
    assert view_of_pair(messages.rgb(picture()), info).distortion == Distortion((0.01,) * count)


@pytest.mark.parametrize(
    ("model", "first", "said"),
    [
        ("plumb_bob", NAN, "no number"),
        ("omni", 0.1, "'omni'"),
        ("equidistant", 0.1, "5 numbers: give 4"),
        ("rational_polynomial", 0.1, "5 numbers: give 8 or 12 or 14"),
    ],
)
def test_a_distortion_that_is_none_is_rejected(messages: Any, model: str, first: float, said: str) -> None:
    info = messages.camera_info(40, 32)
    info.distortion_model, info.d[0] = model, first
    with pytest.raises(ViewError, match=said):
        view_of_pair(messages.rgb(picture()), info)


def test_an_uncalibrated_camera_needs_no_size(messages: Any) -> None:
    view = view_of_pair(messages.rgb(picture()), messages.camera_info(0, 0, k=(0,) * 9))
    assert (view.full_width, view.full_height, view.intrinsics) == (40, 32, None)


@pytest.mark.parametrize(
    ("info", "said"),
    [
        (
            {"width": 80, "height": 64},
            "the picture has 40 x 32 pixels: neither the 80 x 64 of camera_info nor the 80 x 64 of its roi",
        ),
        ({"width": 80, "height": 64, "roi": (0, 0, 20, 20)}, "nor the 20 x 20 of its roi"),
        ({"width": 0, "height": 0, "roi": (4, 4, 20, 20)}, "width and height in camera_info are 0"),
        ({"width": 40, "height": 32, "roi": (4, 4, 0, 0)}, r"the box \[4, 4, 4, 4\] is too small"),
        ({"width": 40, "height": 32, "roi": (30, 4, 20, 20)}, "lies outside the full image of 40 x 32"),
        ({"width": 50, "height": 40, "roi": (30, 4, 40, 32)}, "lies outside the full image of 50 x 40"),
        ({"width": 40, "height": 32, "binning": (2, 2)}, "binning is 2 x 2 in camera_info"),
        ({"width": 40, "height": 32, "binning": (0, 2)}, "binning is 0 x 2 in camera_info"),
        ({"width": 40, "height": 32, "k": (NAN,) * 9}, "no number"),
    ],
)
def test_a_wrong_camera_info_is_rejected(messages: Any, info: dict[str, Any], said: str) -> None:
    with pytest.raises(ViewError, match=rf"^image, stamp 1\.000000000: .*{said}.*\.$"):
        view_of_pair(messages.rgb(picture()), messages.camera_info(**info))


@pytest.mark.parametrize("size", [(10_000, 8), (8, 10_000)])
def test_a_strip_of_a_picture_is_refused_before_it_takes_the_memory(
    messages: Any, size: tuple[int, int]
) -> None:
    """The network's crop would be a square on its longer side."""
    width, height = size
    strip = messages.image(bytes(3 * width * height), width, height, "rgb8", 3 * width)
    said = rf"the box \[0, 0, {width}, {height}\] is too large: a side has at most 8192 pixels"
    with pytest.raises(ViewError, match=said):
        view_of(messages.object_view(image=strip, full=size, box=(0, 0, *size)))


def test_binning_by_one_is_none(messages: Any) -> None:
    assert view_of_pair(messages.rgb(picture()), messages.camera_info(40, 32, binning=(1, 1))).box.width == 40


@settings(max_examples=300)
@given(
    box=st.tuples(*(st.integers(0, 60),) * 2, *(st.integers(8, 60),) * 2),
    full=st.tuples(st.integers(8, 64), st.integers(8, 64)),
)
def test_a_view_holds_the_network_crop_as_far_as_there_is_a_picture(
    bag_messages: Any, box: tuple[int, int, int, int], full: tuple[int, int]
) -> None:
    """The network's crop is the squared box scaled by 1.15."""
    pixels = picture(*full)
    inside = box[0] + box[2] <= full[0] and box[1] + box[3] <= full[1]
    message = bag_messages.object_view(bag_messages.rgb(pixels), box=box, full=full)
    if not inside:
        with pytest.raises(ViewError, match="outside the full image"):
            view_of(message)
        return
    view = view_of(message)
    half = 1.15 * max(box[2], box[3]) / 2
    (x0, y0), (height, width) = view.origin, view.image.shape[:2]
    x, y = box[0] + box[2] / 2, box[1] + box[3] / 2
    assert x0 <= max(0, x - half)
    assert y0 <= max(0, y - half)
    assert x0 + width >= min(full[0], x + half)
    assert y0 + height >= min(full[1], y + half)
    np.testing.assert_array_equal(view.image, pixels[y0 : y0 + height, x0 : x0 + width])


DEVIATIONS = (0.005, 0.01)


def pose_of(message: Any) -> Any:
    return robot_pose(message, source_of(message, "camera_pose"), DEVIATIONS)


def test_a_robots_pose_of_a_camera(messages: Any) -> None:
    half = np.sqrt(0.5)
    pose = pose_of(messages.camera_pose((1.0, 2.0, 3.0), (0.0, 0.0, half, half), frame_id="arm_base"))
    assert pose.frame_id == "arm_base"
    np.testing.assert_allclose(pose.robot_from_camera, [[0, -1, 0], [1, 0, 0], [0, 0, 1]], atol=1e-12)
    np.testing.assert_array_equal(pose.position, [1.0, 2.0, 3.0])
    np.testing.assert_allclose(pose.covariance, np.diag([0.005**2] * 3 + [0.01**2] * 3))


def test_a_covariance_that_comes_with_a_pose_counts_unless_it_is_all_zero(messages: Any) -> None:
    own = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    own[0, 4] = own[4, 0] = 0.05
    np.testing.assert_allclose(pose_of(messages.camera_pose(covariance=own)).covariance, own)
    unknown = pose_of(messages.camera_pose(covariance=np.zeros((6, 6))))
    np.testing.assert_allclose(unknown.covariance, np.diag([0.005**2] * 3 + [0.01**2] * 3))


def test_a_covariance_is_made_symmetric(messages: Any) -> None:
    lopsided = np.diag([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    lopsided[0, 4] = 0.1
    expected = np.diag(np.diag(lopsided))
    expected[0, 4] = expected[4, 0] = 0.05
    np.testing.assert_allclose(pose_of(messages.camera_pose(covariance=lopsided)).covariance, expected)


def test_a_quaternion_that_was_rounded_is_normalised(messages: Any) -> None:
    rotation = pose_of(messages.camera_pose(orientation=(0.0, 0.0, 0.0, 1.004))).robot_from_camera
    np.testing.assert_allclose(rotation, np.eye(3), atol=1e-12)


@pytest.mark.parametrize(
    ("fields", "said"),
    [
        ({"frame_id": ""}, "frame_id is empty: it names the robot's frame in which the pose is"),
        ({"frame_id": "a\x00b"}, "cannot be printed"),
        ({"position": (0.0, NAN, 0.0)}, r"the position holds what is no number: \[0.0, nan, 0.0\]"),
        ({"orientation": (0.0, 0.0, 0.0, 0.0)}, "has length 0: a rotation's quaternion has 1"),
        ({"orientation": (0.0, NAN, 0.0, 1.0)}, "has length nan: a rotation's quaternion has 1"),
        ({"orientation": (0.0, 0.0, 0.0, 1.1)}, r"orientation \[0.0, 0.0, 0.0, 1.1\] has length 1.1"),
        ({"covariance": np.full((6, 6), NAN)}, "the covariance holds what is no number"),
        ({"covariance": np.diag([1, 1, 1, 1, 1, -1.0])}, "negative eigenvalue; leave it all zero where"),
    ],
)
def test_a_wrong_pose_is_rejected_with_topic_stamp_and_value(
    messages: Any, fields: dict[str, Any], said: str
) -> None:
    with pytest.raises(ViewError, match=rf"^camera_pose, stamp 7\.000000009: .*{said}.*\.$"):
        pose_of(messages.camera_pose(stamp=(7, 9), **fields))


def test_a_pose_whose_stamp_is_no_time_is_rejected(messages: Any) -> None:
    with pytest.raises(ViewError, match="camera_pose: the stamp is no time: sec is -1"):
        pose_of(messages.camera_pose(stamp=(-1, 0)))
