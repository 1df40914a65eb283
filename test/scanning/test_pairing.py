"""Pictures and camera infos meet by their stamps."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from relpose_ros.scanning.incoming import Source
from relpose_ros.scanning.pairing import Arrival, Pairing


def arrival(stamp: int, what: str = "") -> Arrival:
    return Arrival((what, stamp), Source("topic", stamp, ""))


def pairs(pairing: Pairing, kind: Any, *stamps: int, camera: str = "") -> list[tuple[Any, Any]]:
    found = [pair for stamp in stamps for pair in pairing.add(kind, arrival(stamp, kind), camera)]
    return [(pair.image.message, pair.info.message) for pair in found]


def test_images_and_infos_meet_whichever_comes_first() -> None:
    pairing = Pairing(5, 1000)
    assert pairs(pairing, "image", 1, 2) == []
    assert pairs(pairing, "camera_info", 2) == [(("image", 2), ("camera_info", 2))]
    assert pairs(pairing, "camera_info", 3) == []
    assert pairs(pairing, "image", 3) == [(("image", 3), ("camera_info", 3))]
    assert pairing.waiting() == 1


def test_one_info_serves_the_raw_and_the_compressed_picture() -> None:
    pairing = Pairing(5, 1000)
    assert pairs(pairing, "image", 1) == []
    assert len(pairs(pairing, "camera_info", 1)) == 1
    assert len(pairs(pairing, "compressed", 1)) == 1
    assert pairs(pairing, "image", 2) == pairs(pairing, "compressed", 2) == []
    assert len(pairs(pairing, "camera_info", 2)) == 2


def test_cameras_are_not_mixed() -> None:
    pairing = Pairing(5, 1000)
    assert pairs(pairing, "image", 1, camera="left") == []
    assert pairs(pairing, "camera_info", 1, camera="right") == []
    assert len(pairs(pairing, "camera_info", 1, camera="left")) == 1


def of_frame(stamp: int, frame: str) -> Arrival:
    return Arrival((frame, stamp), Source("topic", stamp, frame))


def frames(pairing: Pairing, kind: Any, stamp: int, frame: str) -> list[tuple[str, str]]:
    found = pairing.add(kind, of_frame(stamp, frame), "")
    return [(pair.image.source.frame_id, pair.info.source.frame_id) for pair in found]


def test_cameras_of_one_stamp_are_told_apart_by_their_frames() -> None:
    """As of a stereo camera whose halves publish on the same two topics."""
    pairing = Pairing(5, 1000)
    assert frames(pairing, "image", 1, "left") == []
    assert frames(pairing, "camera_info", 1, "right") == []
    assert pairing.frames_apart == ("left", "right")
    assert frames(pairing, "image", 1, "right") == [("right", "right")]
    assert frames(pairing, "camera_info", 1, "left") == [("left", "left")]
    assert pairing.frames_apart is None
    assert pairing.waiting() == 0


@pytest.mark.parametrize(("image", "info"), [("", "camera"), ("camera", ""), ("/camera", "camera")])
@pytest.mark.parametrize("first", ["image", "camera_info"])
def test_a_frame_that_is_not_named_is_any(image: str, info: str, first: str) -> None:
    pairing = Pairing(5, 1000)
    halves = [("image", image), ("camera_info", info)]
    (one, other) = halves if first == "image" else halves[::-1]
    assert frames(pairing, one[0], 1, one[1]) == []
    assert frames(pairing, other[0], 1, other[1]) == [(image, info)]


def test_images_whose_infos_are_of_another_frame_wait_and_it_is_noted() -> None:
    pairing = Pairing(2, 1000)
    for stamp in range(4):
        assert frames(pairing, "camera_info", stamp, "info") == frames(pairing, "image", stamp, "image") == []
    assert pairing.frames_apart == ("image", "info")
    assert (pairing.waiting(), pairing.images_alone) == (2, 2)
    pairing.clear()
    assert pairing.frames_apart is None


def test_what_waits_longest_goes_when_there_is_too_much() -> None:
    pairing = Pairing(3, 1000)
    pairs(pairing, "image", *range(10))
    assert (pairing.waiting(), pairing.images_alone) == (3, 7)
    assert [image[1] for image, _ in pairs(pairing, "camera_info", *range(10))] == [7, 8, 9]
    assert (pairing.waiting(), pairing.images_alone) == (0, 7)


def test_pairing_goes_on_after_time_jumped_back() -> None:
    pairing = Pairing(30, 1000)
    pairs(pairing, "image", *range(0, 20_000, 500))
    assert pairing.waiting() == 30
    # The bag starts again; only images before had lost their infos.
    found = []
    for stamp in range(0, 20_000, 500):
        found += pairs(pairing, "image", stamp) + pairs(pairing, "camera_info", stamp)
    assert [info[1] for _, info in found] == list(range(0, 20_000, 500))
    assert pairing.waiting() == 0, "the images of the first round are forgotten"


def test_what_lies_ahead_of_a_jump_waits_no_longer() -> None:
    pairing = Pairing(30, 1000)
    pairs(pairing, "image", 10_000, 10_500, 0, 500)
    assert pairing.waiting() == 2
    assert pairs(pairing, "camera_info", 10_000, 10_500) == []


def test_a_stamp_that_is_never_set_is_no_jump() -> None:
    pairing = Pairing(30, 1000)
    pairs(pairing, "image", 5000, 0, 0, 0)
    assert len(pairs(pairing, "camera_info", 5000)) == 1


def test_a_garbage_stamp_costs_no_waiting_image() -> None:
    pairing = Pairing(30, 1000)
    pairs(pairing, "image", 5000, 5100, 0, 5200, 10**18, 5300, 5400)
    assert len(pairs(pairing, "camera_info", 5000, 5100, 5200, 5300, 5400)) == 5


@settings(max_examples=200)
@given(
    st.lists(
        st.tuples(st.sampled_from(["image", "compressed", "camera_info"]), st.integers(0, 12)), max_size=60
    )
)
def test_pairs_always_have_one_stamp_and_memory_is_bounded(arrivals: list[tuple[Any, int]]) -> None:
    pairing = Pairing(4, 3)
    for kind, stamp in arrivals:
        for pair in pairing.add(kind, arrival(stamp, kind), ""):
            assert pair.image.source.stamp_ns == pair.info.source.stamp_ns == stamp
            assert pair.info.message[0] == "camera_info"
            assert pair.image.message[0] != "camera_info"
        assert pairing.waiting() <= 8
