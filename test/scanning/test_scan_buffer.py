from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relpose_ros.estimates import Verdict
from relpose_ros.scanning.scan_buffer import (
    Decision,
    ScanBuffer,
    most_redundant,
    nearest_angles,
)
from relpose_ros.scanning.settings import ScanSettings
from relpose_ros.views import BoundingBox, Scan, View

if TYPE_CHECKING:
    from collections.abc import Callable

SECOND = 1_000_000_000


def view(stamp: float, frame_id: str = "") -> View:
    pixels = np.zeros((8, 8, 3), np.uint8)
    return View(pixels, BoundingBox(0, 0, 8, 8), 8, 8, stamp_ns=round(stamp * SECOND), frame_id=frame_id)


def buffer_with(*stamps: float, **fields: Any) -> ScanBuffer:
    buffer = ScanBuffer("mug", ScanSettings(**fields))
    for stamp in stamps:
        assert buffer.add(view(stamp), "a").accepted
    return buffer


def stamps_of(buffer: ScanBuffer) -> list[float]:
    return [each.stamp_ns / SECOND for each in buffer.views]


def add(buffer: ScanBuffer, *stamps: float, topic: str = "a") -> list[Decision]:
    return [buffer.add(view(stamp), topic) for stamp in stamps]


def estimate_all(buffer: ScanBuffer, estimator: Any) -> list[bool]:
    """Work until there is none; whether each result stood."""
    stood = []
    while (work := buffer.work()) is not None:
        stood.append(buffer.settle(work, estimator.estimate(Scan("mug", work.views))))
    return stood


def test_first_keeps_the_earliest() -> None:
    buffer = buffer_with(1, 2, 3, keep="first", max_views=3)
    (decision,) = add(buffer, 4)
    assert not decision.accepted
    assert not decision.rejected
    assert decision.reason == "the scan of 'mug' has its 3 views"
    assert stamps_of(buffer) == [1, 2, 3]
    assert (buffer.dropped, buffer.declined) == (1, 1)


def test_latest_keeps_the_newest() -> None:
    buffer = buffer_with(*range(1, 51), keep="latest", max_views=3)
    assert stamps_of(buffer) == [48, 49, 50]
    assert (buffer.dropped, buffer.declined) == (47, 0), "each had a place once"


def test_spread_puts_a_newcomer_from_elsewhere_in_the_place_of_the_most_redundant(
    circle_estimator: Callable[..., Any],
) -> None:
    azimuths = {1: 0.0, 2: 30.0, 3: 33.0, 4: 90.0, 5: 150.0}
    buffer = buffer_with(1, 2, 3, 4, keep="spread", max_views=4)
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp)])
    assert estimate_all(buffer, estimator) == [True]
    assert add(buffer, 5)[0].accepted
    assert stamps_of(buffer) == [1, 2, 3, 4], "undecided until the estimate"
    assert estimate_all(buffer, estimator) == [True]
    # 2 and 3 are closest; 2 is closer to 1 than 3 is to 4.
    assert stamps_of(buffer) == [1, 3, 4, 5]
    assert (buffer.dropped, buffer.declined) == (1, 0), "2 had its place"


def test_spread_undoes_a_swap_that_gains_nothing(circle_estimator: Callable[..., Any]) -> None:
    azimuths = {1: 0.0, 2: 30.0, 3: 90.0, 4: 91.0, 5: 31.5}
    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp)])
    estimate_all(buffer, estimator)
    add(buffer, 4)
    assert estimate_all(buffer, estimator) == [False]
    assert stamps_of(buffer) == [1, 2, 3]
    assert not buffer.has_work()
    again = buffer.add(view(4), "copies")
    assert not again.accepted
    assert not again.rejected, "the same picture by another transport"
    assert (buffer.dropped, buffer.declined) == (1, 1)


def test_spread_never_gives_up_the_first_view(circle_estimator: Callable[..., Any]) -> None:
    azimuths = {1: 0.0, 2: 1.0, 3: 90.0, 4: 180.0}
    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp)])
    estimate_all(buffer, estimator)
    add(buffer, 4)
    estimate_all(buffer, estimator)
    assert stamps_of(buffer) == [1, 3, 4]


def test_an_orbit_ends_up_seen_from_all_around(circle_estimator: Callable[..., Any]) -> None:
    """At 10 Hz the first eight views are nearly one: each later frame must be able to replace one of them."""
    estimator = circle_estimator(lambda stamp: 36.0 * stamp)  # a turn in ten seconds
    buffer = ScanBuffer("mug", ScanSettings(keep="spread"))
    for tenth in range(100):
        add(buffer, tenth / 10)
        estimate_all(buffer, estimator)
    directions = np.radians([36.0 * stamp for stamp in stamps_of(buffer)])
    gaps = np.diff(np.append(directions, directions[0] + 2 * np.pi))
    assert len(gaps) == 8
    assert stamps_of(buffer)[0] == 0
    assert np.degrees(gaps).min() > 20
    assert np.degrees(gaps).max() < 90


def test_a_still_camera_does_not_swap_views_for_noise(circle_estimator: Callable[..., Any]) -> None:
    random = np.random.default_rng(0)
    estimator = circle_estimator(lambda stamp: 0.1 * random.standard_normal())
    buffer = ScanBuffer("mug", ScanSettings(keep="spread", max_views=3))
    for stamp in range(30):
        add(buffer, stamp)
        estimate_all(buffer, estimator)
    assert stamps_of(buffer) == [0, 1, 2]


def test_after_a_newcomer_in_vain_the_next_ones_wait_longer_and_longer(
    circle_estimator: Callable[..., Any],
) -> None:
    azimuths = {4.0: 2.0, 4.2: 2.0, 4.6: 2.0, 5.4: 2.0, 6.4: 2.0, 7.4: 170.0, 7.5: 100.0}
    estimator = circle_estimator(lambda stamp: azimuths.get(round(stamp, 1), 30.0 * (stamp - 1)))
    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    estimate_all(buffer, estimator)
    tried = []
    for tenth in range(40, 76):
        (decision,) = add(buffer, tenth / 10)
        if decision.accepted:
            tried.append(tenth / 10)
            estimate_all(buffer, estimator)
        else:
            assert (
                decision.reason
                == "the scan of 'mug' has its 3 views, and one seen just before it gained nothing"
            )
    assert tried == [4.0, 4.2, 4.6, 5.4, 6.4, 7.4, 7.5], "at once again after one that gained"
    assert stamps_of(buffer) == [1, 7.4, 7.5]


def test_the_pause_is_short_again_after_a_newcomer_that_gained(circle_estimator: Callable[..., Any]) -> None:
    azimuths = {4.0: 31.0, 4.2: 31.0, 4.6: 170.0, 4.7: 171.0, 4.9: 100.0}
    estimator = circle_estimator(lambda stamp: azimuths.get(round(stamp, 1), 30.0 * (stamp - 1)))
    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    estimate_all(buffer, estimator)
    stood = []
    for stamp in azimuths:
        assert add(buffer, stamp)[0].accepted, stamp
        stood += estimate_all(buffer, estimator)
    assert stood == [False, False, True, False, True]


def test_a_jump_of_time_ends_the_pause(circle_estimator: Callable[..., Any]) -> None:
    """It would last until the bag that loops is where it was."""
    azimuths = {1: 0.0, 2: 40.0, 3: 90.0, 4: 180.0, 100: 0.0, 101: 40.0, 102: 90.0, 103: 1.0}
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp)])
    buffer = buffer_with(100, 101, 102, keep="spread", max_views=3)
    estimate_all(buffer, estimator)
    add(buffer, 103)
    assert estimate_all(buffer, estimator) == [False]
    add(buffer, 1, 2, 3)
    estimate_all(buffer, estimator)
    assert stamps_of(buffer) == [1, 2, 3]
    assert add(buffer, 4)[0].accepted


def test_those_that_wait_behind_a_newcomer_in_vain_go_with_it(circle_estimator: Callable[..., Any]) -> None:
    azimuths = {1.0: 0.0, 2.0: 90.0, 3.0: 90.5, 3.1: 45.0, 3.3: 170.0}
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp, 1)])
    buffer = buffer_with(1, 2, keep="spread", max_views=2)
    estimate_all(buffer, estimator)
    add(buffer, 3, 3.1, 3.3)
    assert estimate_all(buffer, estimator) == [False, True], "3.1 is not tried"
    assert stamps_of(buffer) == [1, 3.3]


def test_spread_takes_newcomers_in_turn_and_lets_the_oldest_go(circle_estimator: Callable[..., Any]) -> None:
    estimator = circle_estimator(lambda stamp: 3.0 * stamp)
    buffer = buffer_with(*range(50), keep="spread", max_views=4)
    assert stamps_of(buffer) == [0, 1, 2, 3]
    assert (buffer.dropped, buffer.declined) == (42, 42), "four held, four in turn"
    estimate_all(buffer, estimator)
    assert stamps_of(buffer)[0] == 0
    assert stamps_of(buffer)[-1] >= 46
    assert (buffer.dropped, buffer.declined) == (46, 44), "two of the four gained nothing"


@pytest.mark.parametrize("keep", ["first", "latest", "spread"])
def test_a_late_view_is_rejected_and_so_is_a_repeated_stamp(keep: str) -> None:
    buffer = buffer_with(1.0, 1.5, keep=keep)
    repeated, late, good = add(buffer, 1.0, 1.2, 1.6)
    assert repeated.rejected
    assert "give each picture its own stamp, and each camera its own frame_id" in repeated.reason
    assert late.rejected
    assert late.reason == (
        "it is 0.300 s older than the newest view of 'mug' on this topic with frame_id '': "
        "views of a camera have to come in the order of their stamps"
    )
    assert good.accepted
    assert stamps_of(buffer) == [1.0, 1.5, 1.6]


def test_a_camera_that_lags_behind_another_on_its_topic_is_no_jump() -> None:
    """Its own clock goes on; what it sends first may be late, several in a row."""
    buffer = ScanBuffer("mug", ScanSettings())
    for stamp in (100, 100.5, 101, 102.5):
        assert buffer.add(view(stamp, "left"), "a").accepted
    late = [buffer.add(view(stamp, "right"), "a") for stamp in (101.0, 101.4)]
    assert all(each.rejected for each in late)
    assert buffer.add(view(102.6, "right"), "a").accepted
    assert buffer.add(view(105, "left"), "a").accepted
    assert all(buffer.add(view(stamp, "right"), "a").accepted for stamp in (103, 103.5))
    assert buffer.add(view(103.2, "right"), "a").rejected
    assert stamps_of(buffer) == [100, 100.5, 101, 102.5, 102.6, 103, 103.5, 105]


def test_views_of_a_camera_that_delivers_late_find_their_place() -> None:
    """Two cameras at 30 Hz, one of them 40 ms late: neither has to wait for the other."""
    buffer = ScanBuffer("mug", ScanSettings(keep="latest"))
    sent = [(k / 30, k / 30, "left") for k in range(10)] + [
        (k / 30 + 0.04, k / 30 + 0.001, "right") for k in range(10)
    ]
    decisions = {(stamp, frame): buffer.add(view(stamp, frame), "a") for _, stamp, frame in sorted(sent)}
    assert all(decision.accepted for decision in decisions.values())
    assert stamps_of(buffer) == sorted(stamps_of(buffer))
    early = buffer.add(view(0.0, "third"), "a")
    assert early.rejected
    assert "older than the first view of 'mug', in whose axes the poses are told" in early.reason


def test_a_view_that_estimates_fail_of_is_found_and_let_go(
    circle_estimator: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    """One failure may pass; of a second one the views are left out in turn that came since all went well."""
    estimator = circle_estimator()
    bad = view(3)

    def estimate_all_but_bad(buffer: ScanBuffer) -> list[tuple[float, ...]]:
        tried = []
        while (work := buffer.work()) is not None:
            tried.append(tuple(each.stamp_ns / 1e9 for each in work.views))
            if bad in work.views:
                buffer.give_up(work)
            else:
                assert buffer.settle(work, estimator.estimate(Scan("mug", work.views)))
        assert not buffer.has_work()
        return tried

    buffer = buffer_with(1, 2)
    assert estimate_all_but_bad(buffer) == [(1, 2)]
    assert buffer.add(bad, "a").accepted
    assert estimate_all_but_bad(buffer) == [(1, 2, 3)]
    assert stamps_of(buffer) == [1, 2, 3]
    add(buffer, 4)
    assert estimate_all_but_bad(buffer) == [(1, 2, 3, 4), (1, 2, 4)]
    assert stamps_of(buffer) == [1, 2, 4]
    assert "stamp 3.000000000 is let go: estimates fail with it, and not without it" in caplog.text
    assert buffer.dropped == 1
    add(buffer, 5)
    assert estimate_all_but_bad(buffer) == [(1, 2, 4, 5)]


def fail(buffer: ScanBuffer) -> None:
    """As an estimator that fails of whatever there is to estimate."""
    work = buffer.work()
    assert work is not None
    buffer.give_up(work)


def test_failures_with_a_good_estimate_between_them_blame_no_view(
    circle_estimator: Callable[..., Any],
) -> None:
    buffer = buffer_with(1, 2, 3)
    fail(buffer)
    add(buffer, 4)
    estimate_all(buffer, circle_estimator())
    add(buffer, 5, 6)
    fail(buffer)
    assert not buffer.has_work(), "it is the first failure since all went well"


def test_no_view_is_blamed_once_all_of_them_were_estimated(circle_estimator: Callable[..., Any]) -> None:
    """A view comes before those that estimates may fail of are left out in turn."""
    buffer = buffer_with(1, 2, 3)
    fail(buffer)
    add(buffer, 4)
    fail(buffer)
    assert buffer.has_work(), "one of the views may be to blame"
    add(buffer, 5)
    work = buffer.work()
    assert work is not None
    assert buffer.settle(work, circle_estimator().estimate(Scan("mug", work.views)))
    assert not buffer.has_work()
    assert stamps_of(buffer) == [1, 2, 3, 4, 5]


def test_of_two_views_none_can_be_left_out() -> None:
    buffer = buffer_with(1, 2)
    fail(buffer)
    buffer.require_work()
    fail(buffer)
    assert not buffer.has_work()


def test_no_newcomer_is_tried_against_an_estimate_of_fewer_views(
    circle_estimator: Callable[..., Any],
) -> None:
    """The last estimate that did not fail is of two of the three views held."""
    buffer = buffer_with(1, 2, keep="spread", max_views=3)
    work = buffer.work()
    assert work is not None
    add(buffer, 3, 9)
    assert buffer.settle(work, circle_estimator().estimate(Scan("mug", work.views)))
    fail(buffer)
    assert not buffer.has_work()


def test_where_no_view_alone_is_to_blame_all_stay() -> None:
    buffer = buffer_with(1, 2)
    tried = []
    for stamp in (3, 4):
        while (work := buffer.work()) is not None:
            tried.append(len(work.views))
            buffer.give_up(work)
        add(buffer, stamp)
    assert tried == [2, 3, 2, 2, 2]
    assert stamps_of(buffer) == [1, 2, 3, 4]


def test_a_camera_that_delivers_late_does_not_turn_its_topics_clock_back() -> None:
    """The clock of the topic tells of a jump, whichever camera's view came last."""
    buffer = ScanBuffer("mug", ScanSettings())
    for stamp, frame in ((99, "left"), (100, "left"), (102, "left"), (101.5, "right")):
        assert buffer.add(view(stamp, frame), "a").accepted
    first, second = (buffer.add(view(stamp, "left"), "a") for stamp in (100.9, 100.95))
    assert "rejected unless the next one confirms that time jumped backwards" in first.reason
    assert second.accepted


def test_another_camera_tells_of_a_jump_by_more_than_a_moment() -> None:
    """A bag of long ago is played on the same topic: no frame of it is known."""
    buffer = ScanBuffer("mug", ScanSettings())
    for stamp in (100, 101):
        assert buffer.add(view(stamp, "left"), "a").accepted
    decisions = [buffer.add(view(stamp, f"frame {stamp}"), "a") for stamp in (10, 10.4, 10.8, 11.2)]
    assert [each.accepted for each in decisions] == [False, False, False, True]
    assert stamps_of(buffer) == [10, 11.2]


def test_a_garbage_stamp_on_one_topic_does_not_block_the_others(caplog: pytest.LogCaptureFixture) -> None:
    buffer = buffer_with(1, 2, 1e6)
    first, second, third = add(buffer, 3, 4, 5, topic="b")
    assert first.rejected
    assert first.reason.startswith("it is 999997.000 s older than the newest view")
    assert "time jumped backwards" in first.reason
    assert second.accepted
    assert third.accepted
    assert stamps_of(buffer) == [1, 2, 3, 4, 5]
    assert "stamp 1000000.000000000 is dropped" in caplog.text


def test_a_garbage_stamp_of_one_camera_does_not_block_the_other_on_its_topic() -> None:
    buffer = ScanBuffer("mug", ScanSettings())
    for stamp, frame in ((1, "left"), (1.1, "right"), (1e6, "left")):
        assert buffer.add(view(stamp, frame), "a").accepted
    first, second, third = (buffer.add(view(stamp, "right"), "a") for stamp in (2, 3, 4))
    assert first.reason.startswith(
        "it is 999998.000 s older than the last one on this topic: rejected unless"
    )
    assert (first.accepted, second.accepted, third.accepted) == (False, True, True)
    assert stamps_of(buffer) == [1, 1.1, 2, 3, 4]


def test_a_garbage_stamp_on_another_topic_does_not_block_one_that_goes_on() -> None:
    buffer = ScanBuffer("mug", ScanSettings())
    for stamp, topic in ((1, "b"), (1e6, "a")):
        assert buffer.add(view(stamp), topic).accepted
    first, second = add(buffer, 2, 3, topic="b")
    assert first.reason.startswith("it is 999998.000 s older than the newest view: rejected unless the next")
    assert second.accepted
    assert stamps_of(buffer) == [1, 2, 3]


def test_a_topic_whose_clock_is_another_takes_nothing_away() -> None:
    buffer = buffer_with(1000, 1001)
    assert all(each.rejected for each in add(buffer, 3, 4, 5, topic="b"))
    assert stamps_of(buffer) == [1000, 1001]


@pytest.mark.parametrize("garbage", [0.0, 2.0, 7.9])
def test_a_lone_stamp_of_the_past_changes_nothing(garbage: float) -> None:
    buffer = buffer_with(9, 10)
    (lone, good) = add(buffer, garbage, 11)
    assert lone.rejected
    assert "rejected unless the next one confirms that time jumped backwards" in lone.reason
    assert good.accepted
    assert add(buffer, garbage + 0.1)[0].rejected, "the two are not one after the other"
    assert stamps_of(buffer) == [9, 10, 11]


@pytest.mark.parametrize("keep", ["first", "latest", "spread"])
def test_a_lone_stamp_of_the_future_is_found_out(keep: str, caplog: pytest.LogCaptureFixture) -> None:
    buffer = buffer_with(1, 2, 1e6, keep=keep, max_views=5)
    first, second, third = add(buffer, 3, 4, 5)
    assert first.rejected
    assert second.accepted
    assert third.accepted
    assert stamps_of(buffer) == [1, 2, 3, 4, 5]
    assert "stamp 1000000.000000000 is dropped: two later messages are older" in caplog.text


def test_the_first_views_fill_the_place_of_one_that_was_garbage() -> None:
    buffer = buffer_with(1, 2, 1e6, keep="first", max_views=3)
    assert [each.accepted for each in add(buffer, 3, 4)] == [False, False]
    assert stamps_of(buffer) == [1, 2, 3]


@pytest.mark.parametrize("keep", ["first", "latest", "spread"])
@pytest.mark.parametrize("count", [2, 3, 8, 20])
def test_a_bag_that_loops_starts_the_scan_anew(
    keep: str, count: int, caplog: pytest.LogCaptureFixture
) -> None:
    buffer = ScanBuffer("mug", ScanSettings(keep=keep))
    stamps = [10.0 + 2 * k for k in range(count)]
    add(buffer, *stamps)
    expected = stamps_of(buffer)
    assert caplog.text == ""
    add(buffer, *stamps)
    assert stamps_of(buffer) == expected
    assert f"Time jumped backwards from {buffer_text(stamps, keep)} to 10.000000000" in caplog.text
    assert "the scan of 'mug' starts anew" in caplog.text


def test_a_short_bag_that_loops_starts_the_scan_anew_at_every_round(caplog: pytest.LogCaptureFixture) -> None:
    buffer = buffer_with(1, 2)
    for _ in range(3):
        assert [each.accepted for each in add(buffer, 1, 2)] == [False, True]
        assert stamps_of(buffer) == [1, 2]
    assert caplog.text.count("Time jumped backwards from 2.000000000 to 1.000000000") == 3


def test_late_copies_are_no_jump() -> None:
    buffer = buffer_with(1, 2, 3, 4)
    assert [each.accepted for each in add(buffer, 1, 5, 2, 6)] == [False, True, False, True]
    assert stamps_of(buffer) == [1, 2, 3, 4, 5, 6]


def buffer_text(stamps: list[float], keep: str) -> str:
    """The newest view held or waiting before the jump."""
    newest = stamps[7] if keep == "first" and len(stamps) > 8 else stamps[-1]
    return f"{newest:.9f}"


def test_a_jump_resets_only_what_lies_before_it() -> None:
    buffer = buffer_with(10, 11, 12)
    assert [each.accepted for each in add(buffer, 1, 2, 3)] == [False, True, True]
    assert stamps_of(buffer) == [1, 2, 3]


def test_a_topic_that_lags_behind_another_is_no_jump() -> None:
    buffer = buffer_with(1, 2, 3, 4, 5, 6)
    lagging = add(buffer, 1, 2, 3, 4, topic="b")
    assert not any(each.accepted or each.rejected for each in lagging)
    assert stamps_of(buffer) == [1, 2, 3, 4, 5, 6]


PAIR = (("left", "a"), ("right", "a"))
"""Frame and topic of two cameras that are triggered together."""
RIG = (("left", "a"), ("right", "b"))
"""The same, each with a topic of its own."""


def add_together(buffer: ScanBuffer, cameras: Any, *stamps: float) -> list[Decision]:
    return [buffer.add(view(stamp, frame), topic) for stamp in stamps for frame, topic in cameras]


def pictures_of(buffer: ScanBuffer) -> list[tuple[float, str]]:
    return [(each.stamp_ns / SECOND, each.frame_id) for each in buffer.views]


@pytest.mark.parametrize("cameras", [PAIR, RIG])
@pytest.mark.parametrize("keep", ["first", "latest", "spread"])
def test_cameras_that_are_triggered_together_give_a_view_each(keep: str, cameras: Any) -> None:
    buffer = ScanBuffer("mug", ScanSettings(keep=keep))
    assert all(each.accepted for each in add_together(buffer, cameras, 1, 2, 3))
    assert pictures_of(buffer) == [(stamp, frame) for stamp in (1, 2, 3) for frame in ("left", "right")]
    repeated = [buffer.add(view(stamp, "right"), "copies") for stamp in (2, 3)]
    assert repeated == 2 * [Decision(False, "a view with this stamp and frame was seen already")]
    assert buffer.add(view(2.5, "right"), cameras[1][1]).rejected, "it is late for the scan, whoever took it"


@pytest.mark.parametrize("cameras", [PAIR, RIG])
@pytest.mark.parametrize("count", [2, 3, 8])
def test_a_bag_of_such_cameras_that_loops_loses_no_view(cameras: Any, count: int) -> None:
    buffer = ScanBuffer("mug", ScanSettings(keep="latest"))
    stamps = [10.0 + 2 * k for k in range(count)]
    for _ in range(3):
        add_together(buffer, cameras, *stamps)
        expected = [(stamp, frame) for stamp in stamps for frame in ("left", "right")]
        assert pictures_of(buffer) == expected[-8:]


@pytest.mark.parametrize("cameras", [PAIR, RIG])
def test_a_picture_that_comes_twice_after_a_jump_is_taken_once(cameras: Any) -> None:
    buffer = buffer_with(10, 11)
    both = [(frame, topic) for frame, topic in cameras] + [
        (frame, f"{topic}/copy") for frame, topic in cameras
    ]
    add_together(buffer, both, 20, 21)
    add_together(buffer, both, 1, 2)
    assert pictures_of(buffer) == [(1, "left"), (1, "right"), (2, "left"), (2, "right")]


def test_such_cameras_with_one_stamp_of_the_future_lose_that_alone() -> None:
    buffer = ScanBuffer("mug", ScanSettings())
    add_together(buffer, PAIR, 1, 2, 1e6, 3, 4)
    assert [stamp for stamp, _ in pictures_of(buffer)] == [1, 1, 2, 2, 3, 3, 4, 4]


def test_dropping_the_last_view_has_the_others_estimated_again(circle_estimator: Callable[..., Any]) -> None:
    buffer = buffer_with(1, 2, 3)
    estimate_all(buffer, circle_estimator())
    dropped = buffer.drop_last()
    assert dropped is not None
    assert dropped.stamp_ns == 3 * SECOND
    assert buffer.has_work()
    assert not add(buffer, 3)[0].accepted, "another transport must not bring it back"
    assert add(buffer, 3.5)[0].accepted
    assert stamps_of(buffer) == [1, 2, 3.5]
    assert [buffer.drop_last() is None for _ in range(4)] == [False, False, False, True]
    assert add(buffer, 0.5)[0].accepted, "an empty scan has no past"


def test_an_estimate_of_views_forgotten_meanwhile_does_not_stand(
    circle_estimator: Callable[..., Any],
) -> None:
    buffer = buffer_with(1, 2, 3)
    work = buffer.work()
    assert work is not None
    buffer.drop_last()
    assert not buffer.settle(work, circle_estimator().estimate(Scan("mug", work.views)))
    assert buffer.has_work()


def test_what_is_dropped_of_a_full_scan_makes_room(circle_estimator: Callable[..., Any]) -> None:
    """Newcomers whose place is not decided yet would take it at once."""
    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    estimate_all(buffer, circle_estimator())
    add(buffer, 9, 10)
    work = buffer.work()
    assert work is not None
    assert work.newcomer is not None
    dropped = buffer.drop_last()
    assert dropped is not None
    assert dropped.stamp_ns == 3 * SECOND
    assert not buffer.settle(work, circle_estimator().estimate(Scan("mug", work.views)))
    estimate_all(buffer, circle_estimator())
    assert stamps_of(buffer) == [1, 2]
    add(buffer, 11)
    assert stamps_of(buffer) == [1, 2, 11]


def test_views_that_come_while_an_estimate_is_made_are_taken_together(
    circle_estimator: Callable[..., Any],
) -> None:
    buffer = buffer_with(1, 2)
    work = buffer.work()
    assert work is not None
    add(buffer, 3, 4, 5)
    assert buffer.settle(work, circle_estimator().estimate(Scan("mug", work.views)))
    following = buffer.work()
    assert following is not None
    assert [each.stamp_ns // SECOND for each in following.views] == [1, 2, 3, 4, 5]
    assert buffer.work() is None


@pytest.mark.parametrize("enough_before", [True, False])
def test_a_scan_that_is_enough_declines_a_view_that_would_undo_it(
    enough_before: bool, circle_estimator: Callable[..., Any]
) -> None:
    """A view from a new direction may take the place of the one that tied the others."""
    circle = circle_estimator()

    class Verdicts:
        def estimate(self, scan: Scan) -> Any:
            undone = any(view.stamp_ns > 10 * SECOND for view in scan.views) or not enough_before
            verdict = Verdict.ONE_MORE_VIEW if undone else Verdict.ENOUGH
            return replace(circle.estimate(scan), verdict=verdict)

    buffer = buffer_with(1, 2, 3, keep="spread", max_views=3)
    assert estimate_all(buffer, Verdicts()) == [True]
    add(buffer, 19)
    assert estimate_all(buffer, Verdicts()) == [not enough_before]
    assert stamps_of(buffer) == ([1, 2, 3] if enough_before else [1, 3, 19])
    assert buffer.declined == (1 if enough_before else 0)


def test_a_failed_estimate_is_tried_again_with_the_next_view() -> None:
    buffer = buffer_with(1, 2, keep="spread", max_views=2)
    work = buffer.work()
    assert work is not None
    buffer.give_up(work)
    assert not buffer.has_work(), "the same views would fail again"
    add(buffer, 3)
    retried = buffer.work()
    assert retried is not None
    assert retried.views == work.views


def test_a_failed_estimate_of_a_full_scan_is_tried_again_with_a_view_that_finds_no_place() -> None:
    buffer = buffer_with(1, 2, keep="first", max_views=2)
    work = buffer.work()
    assert work is not None
    buffer.give_up(work)
    assert not buffer.has_work()
    declined = buffer.declines(3 * SECOND, "camera", "/image")
    assert declined is not None
    assert not declined.accepted
    retried = buffer.work()
    assert retried is not None
    assert retried.views == work.views


def test_a_trial_that_fails_leaves_the_views_as_they_are(circle_estimator: Callable[..., Any]) -> None:
    buffer = buffer_with(1, 2, keep="spread", max_views=2)
    estimate_all(buffer, circle_estimator())
    add(buffer, 9)
    work = buffer.work()
    assert work is not None
    buffer.give_up(work)
    assert not buffer.has_work()
    assert stamps_of(buffer) == [1, 2]
    assert (buffer.dropped, buffer.declined) == (1, 1)
    add(buffer, 10)
    assert estimate_all(buffer, circle_estimator()) == [True, True]
    assert stamps_of(buffer) == [1, 10]


def test_a_failure_of_views_forgotten_meanwhile_says_nothing_about_the_others() -> None:
    buffer = buffer_with(1, 2, 3)
    work = buffer.work()
    assert work is not None
    buffer.drop_last()
    buffer.give_up(work)
    assert buffer.has_work()


def test_other_settings_let_go_of_what_is_too_much() -> None:
    for keep, left in (("first", [1, 2, 3]), ("latest", [3, 4, 5]), ("spread", [1, 2, 3])):
        buffer = buffer_with(1, 2, 3, 4, 5, keep="latest")
        buffer.change_settings(ScanSettings(keep=keep, max_views=3))
        assert stamps_of(buffer) == left, keep
    buffer.change_settings(ScanSettings(keep="spread", max_views=8))
    assert stamps_of(buffer) == [1, 2, 3, 4, 5], "those that had no place are still there"


def test_another_setting_says_how_far_back_a_jump_lies() -> None:
    buffer = buffer_with(10, 11)
    buffer.change_settings(ScanSettings(backward_jump_s=5.0))
    (late,) = add(buffer, 9.5)
    assert "views of a camera have to come in the order of their stamps" in late.reason
    buffer.change_settings(ScanSettings(backward_jump_s=0.1))
    (suspect,) = add(buffer, 10.8)
    assert "rejected unless the next one confirms that time jumped backwards" in suspect.reason


def test_the_most_redundant_view_is_the_one_with_the_closest_neighbours() -> None:
    def directions(*azimuths: float) -> np.ndarray:
        angles = np.radians(azimuths)
        return np.stack([np.sin(angles), 0 * angles, np.cos(angles)], -1)

    assert most_redundant(directions(0, 40, 50, 120)) == 2 - 1
    assert most_redundant(directions(0, 2, 90)) == 1
    assert most_redundant(directions(0, 90)) == 1
    np.testing.assert_allclose(np.degrees(nearest_angles(directions(0, 40, 50, 120))), [40, 10, 10, 70])


@pytest.mark.usefixtures("quiet_log")
@settings(max_examples=500, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    st.lists(
        st.tuples(
            st.sampled_from("ab"),
            st.sampled_from(["", "left"]),
            st.one_of(st.floats(0, 20), st.integers(0, 5)),
        ),
        max_size=40,
    ),
    st.sampled_from(["first", "latest", "spread"]),
)
def test_whatever_stamps_come_the_views_are_ordered_and_all_accounted_for(
    arrivals: list[tuple[str, str, float]], keep: str
) -> None:
    buffer = ScanBuffer("mug", ScanSettings(keep=keep, max_views=3))
    for topic, frame, stamp in arrivals:
        before = buffer.views
        decision = buffer.add(view(stamp, frame), topic)
        views = buffer.views
        stamps = [each.stamp_ns for each in views]
        assert stamps == sorted(stamps)
        assert len(set(pictures_of(buffer))) == len(views)
        assert len(views) <= 3
        if decision.rejected:
            assert decision.reason
            assert views == before, "a rejected view costs none that is held"
