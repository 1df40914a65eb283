from __future__ import annotations

import itertools
import logging
import threading
import time
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relpose_ros.errors import RelPoseError
from relpose_ros.estimates import Verdict
from relpose_ros.inference.verdict import WITHOUT_ROOM
from relpose_ros.scanning.image_decoding import ENCODINGS
from relpose_ros.scanning.scan_buffer import ScanBuffer
from relpose_ros.scanning.scanner import Receipt, Scanner, TopicStatistics
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.views import Scan, View

SECOND = 1_000_000_000


def pixels(seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (32, 40, 3), np.uint8)


def send_views(scanner: Scanner, messages: Any, *stamps: float, **fields: Any) -> list[Receipt]:
    return [
        scanner.receive("object_view", "views", messages.object_view(stamp=stamp, **fields))
        for stamp in stamps
    ]


def stamps_of(scan: Scan) -> list[float]:
    return [view.stamp_ns / SECOND for view in scan.views]


def drain(scanner: Scanner) -> list[Any]:
    results = []
    while scanner.pending():
        results += scanner.estimate_pending()
    return results


def test_an_estimate_follows_each_view_from_the_second_on(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    counts = []
    for stamp in range(1, 6):
        (receipt,) = send_views(scanner, messages, stamp)
        assert receipt == Receipt(True, "mug", "")
        counts.append([len(result.scan.views) for result in drain(scanner)])
    assert counts == [[], [2], [3], [4], [5]]
    assert not scanner.pending()
    assert scanner.estimate_pending() == []


@pytest.mark.parametrize("kind", ["image", "compressed"])
@pytest.mark.parametrize("info_first", [False, True])
def test_an_image_and_its_camera_info_make_a_view(
    messages: Any, circle_estimator: Callable[..., Any], kind: Any, info_first: bool
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings(object_id="thing"))
    data = cv2.imencode(".png", pixels())[1].tobytes()
    for stamp in (1, 2):
        image = (
            messages.rgb(pixels(), stamp=stamp)
            if kind == "image"
            else messages.compressed(data, "png", stamp=stamp)
        )
        info = messages.camera_info(40, 32, (4, 4, 20, 20), stamp=stamp)
        halves = [(kind, "picture", image), ("camera_info", "info", info)]
        first, second = halves[::-1] if info_first else halves
        assert scanner.receive(*first) == Receipt(False, "", "")
        assert scanner.receive(*second) == Receipt(True, "thing", "")
    (result,) = drain(scanner)
    assert stamps_of(result.scan) == [1, 2]
    assert result.scan.object_id == "thing"
    counts = scanner.statistics().topics
    assert counts["picture"] == counts["info"] == TopicStatistics(2, 2, 0, "")


def test_a_picture_that_comes_raw_and_compressed_is_one_view(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    data = cv2.imencode(".png", pixels())[1].tobytes()
    receipts = [
        scanner.receive("image", "image", messages.rgb(pixels(), stamp=1)),
        scanner.receive("compressed", "image/compressed", messages.compressed(data, stamp=1)),
        scanner.receive("camera_info", "info", messages.camera_info(40, 32, stamp=1)),
        scanner.receive("image", "image", messages.rgb(pixels(), stamp=2)),
        scanner.receive("camera_info", "info", messages.camera_info(40, 32, stamp=2)),
        scanner.receive("compressed", "image/compressed", messages.compressed(data, stamp=2)),
    ]
    assert [receipt.accepted for receipt in receipts] == [False, False, True, False, True, False]
    assert not any(receipt.rejected for receipt in receipts)
    assert scanner.statistics().scans["object"].views == 2


def test_two_cameras_that_are_triggered_together_are_two_views(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    both = [(stamp, frame) for stamp in (1, 2) for frame in ("left", "right")]
    for stamp, frame in both:
        assert send_views(scanner, messages, stamp, frame_id=frame) == [Receipt(True, "mug", "")]
    (again,) = send_views(scanner, messages, 2, frame_id="left")
    assert again.rejected
    assert again.reason.startswith(
        "views, stamp 2.000000000: a view with this stamp and frame_id 'left' came on"
    )
    (result,) = drain(scanner)
    assert [(view.stamp_ns / SECOND, view.frame_id) for view in result.scan.views] == both


def test_a_driver_that_sets_no_stamp_is_told(messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    first, second = send_views(scanner, messages, 0, 0)
    assert first.accepted
    assert second.rejected
    assert "stamp 0.000000000" in second.reason
    assert "its own stamp" in second.reason


def test_a_wrong_pair_is_rejected_under_the_name_of_the_image(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    scanner.receive("image", "image", messages.rgb(pixels(), stamp=1))
    receipt = scanner.receive("camera_info", "info", messages.camera_info(4, 4, stamp=1))
    assert receipt.rejected
    assert receipt.reason.startswith("image, stamp 1.000000000: the picture has 40 x 32 pixels")
    counts = scanner.statistics().topics
    assert counts["image"] == TopicStatistics(1, 0, 1, receipt.reason)
    assert counts["info"] == TopicStatistics(1, 0, 0, "")


def test_cameras_are_paired_apart(bag_messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    scanner.receive("image", "left/image", bag_messages.rgb(pixels(), stamp=1), "left")
    info = bag_messages.camera_info(40, 32, stamp=1)
    assert not scanner.receive("camera_info", "right/info", info, "right").accepted
    assert scanner.receive("camera_info", "left/info", info, "left").accepted


def test_each_object_is_a_scan_of_its_own(messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    for stamp, object_id in enumerate(["mug", "can", "mug", "", "can", ""]):
        send_views(scanner, messages, stamp, object_id=object_id)
    results = {result.scan.object_id: stamps_of(result.scan) for result in drain(scanner)}
    assert results == {"mug": [0, 2], "can": [1, 4], "object": [3, 5]}


def test_the_object_seen_longest_ago_makes_room(
    bag_messages: Any, circle_estimator: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    scanner = Scanner(circle_estimator(), ScanSettings(max_scans=2))
    for stamp, object_id in enumerate(["mug", "can", "mug", "jar"]):
        send_views(scanner, bag_messages, stamp, object_id=object_id)
    assert list(scanner.statistics().scans) == ["mug", "jar"]
    assert "The scan of 'can' with 1 views is forgotten to make room: max_scans is 2." in caplog.text
    rejected = send_views(scanner, bag_messages, 9, object_id="bad", box=(0, 0, 0, 0))
    assert rejected[0].rejected
    assert list(scanner.statistics().scans) == ["mug", "jar"], "a bad message makes no room for itself"


def test_what_stands_around_is_kept_where_it_may_match(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    """A box of 16 pixels in a picture of 40 x 32; the node keeps no more of a picture than it looks at."""
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1)
    scanner.change_settings(ScanSettings(surroundings=True))
    send_views(scanner, bag_messages, 2)
    (result,) = drain(scanner)
    assert [view.image.shape[:2] for view in result.scan.views] == [(20, 20), (32, 40)]
    assert [view.origin for view in result.scan.views] == [(6, 6), (0, 0)]


def test_an_object_whose_scan_is_full_is_seen_all_the_same(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings(max_scans=2, max_views=2, keep="first"))
    send_views(scanner, bag_messages, 1, 2, object_id="mug")
    send_views(scanner, bag_messages, 3, object_id="can")
    (declined,) = send_views(scanner, bag_messages, 4, object_id="mug")
    assert (declined.accepted, declined.rejected) == (False, False)
    assert scanner.drop_last_view().object_id == "mug"
    send_views(scanner, bag_messages, 5, object_id="jar")
    assert list(scanner.statistics().scans) == ["mug", "jar"]


def test_a_rejected_message_is_counted_with_its_reason(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, messages, 1, 2)
    (receipt,) = send_views(scanner, messages, 3, box=(0, 0, 100, 100))
    assert receipt.rejected
    assert not receipt.accepted
    assert receipt.reason.startswith("views, stamp 3.000000000: the box [0, 0, 100, 100] lies outside")
    (late,) = send_views(scanner, messages, 1.5)
    assert late.rejected
    assert late.reason.startswith("views, stamp 1.500000000: it is 0.500 s older than the newest view")
    (repeated,) = send_views(scanner, messages, 2)
    assert repeated.rejected
    counts = scanner.statistics().topics["views"]
    assert counts == TopicStatistics(received=5, used=2, rejected=3, last_reason=repeated.reason)


def test_a_view_the_scan_cannot_want_is_not_decoded(
    bag_messages: Any, circle_estimator: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings(keep="first", max_views=2))
    send_views(scanner, bag_messages, 1, 1.5)
    monkeypatch.setattr("relpose_ros.scanning.image_decoding.decode_image", None)
    receipts = send_views(scanner, bag_messages, 1, 1.5, 3)
    assert [receipt.rejected for receipt in receipts] == [True, True, False]


def test_statistics_tell_the_state_of_each_scan(messages: Any, circle_estimator: Callable[..., Any]) -> None:
    ticks = iter(range(100))
    scanner = Scanner(circle_estimator(), ScanSettings(), clock=lambda: float(next(ticks)))
    send_views(scanner, messages, 1)
    before = scanner.statistics().scans["mug"]
    assert (before.views, before.estimates, before.latency_s, before.weakest_pair) == (1, 0, None, None)
    send_views(scanner, messages, 2, 3)
    drain(scanner)
    after = scanner.statistics().scans["mug"]
    assert (after.views, after.estimates, after.latency_s) == (3, 1, 1.0)
    assert (after.status, after.weakest_pair, after.dropped, after.declined) == (
        "one more view",
        (1, 2),
        0,
        0,
    )
    assert after.weakest_probability == pytest.approx(0.8)
    scanner.receive("image", "image", messages.rgb(pixels()))
    assert scanner.statistics().waiting == 1


def test_images_that_find_no_camera_info_are_noticed(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    now = [0.0]
    scanner = Scanner(circle_estimator(), ScanSettings(), clock=lambda: now[0])

    def receive(kind: Any, stamp: int) -> None:
        size = (40, 32, (4, 4, 20, 20))
        message = (
            bag_messages.rgb(pixels(), stamp=stamp)
            if kind == "image"
            else bag_messages.camera_info(*size, stamp=stamp)
        )
        scanner.receive(kind, kind, message)

    receive("camera_info", 1)
    assert scanner.statistics().unpaired_s is None, "a camera info alone is no image"
    now[0] = 10.0
    receive("image", 2)
    now[0] = 13.0
    receive("image", 3)
    assert scanner.statistics().unpaired_s == 3.0
    receive("camera_info", 3)
    assert scanner.statistics().unpaired_s is None, "one lost camera info is no matter"
    receive("image", 4)
    scanner.reset("for a test")
    assert scanner.statistics().unpaired_s is None


def test_camera_infos_whose_images_are_lost_are_counted(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    now = [0.0]
    scanner = Scanner(circle_estimator(), ScanSettings(), clock=lambda: now[0])

    def send(stamps: range, lost: Callable[[int], bool]) -> None:
        for stamp in stamps:
            info = bag_messages.camera_info(40, 32, (4, 4, 20, 20), stamp=stamp)
            scanner.receive("camera_info", "info", info)
            if not lost(stamp):
                scanner.receive("image", "image", bag_messages.rgb(pixels(), stamp=stamp))
            now[0] += 1.0

    def told() -> tuple[int, bool]:
        statistics = scanner.statistics()
        return statistics.infos_alone, statistics.images_missing

    send(range(1, 4), lambda _: True)
    assert told() == (1, False), "two of the three may still find theirs"
    send(range(4, 6), lambda _: True)
    assert told() == (3, True)
    send(range(6, 16), lambda stamp: stamp % 4 == 0)
    now[0] += 3.0
    assert told() == (7, False), "most images come"
    send(range(16, 26), lambda stamp: stamp % 4 != 0)
    now[0] += 3.0
    assert told() == (14, True)
    scanner.reset("for a test")
    assert told() == (14, False)


def test_a_camera_info_that_comes_again_without_its_image_is_lost_too(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    """As of a bag that loops: the image of the last round is none of this one."""
    now = [0.0]
    scanner = Scanner(circle_estimator(), ScanSettings(), clock=lambda: now[0])
    scanner.receive("image", "image", bag_messages.rgb(pixels(), stamp=1))
    for alone in (0, 1):
        scanner.receive("camera_info", "info", bag_messages.camera_info(40, 32, (4, 4, 20, 20), stamp=1))
        now[0] += 3.0
        assert scanner.statistics().infos_alone == alone


def test_another_setting_says_how_far_back_a_jump_lies_for_images_that_wait(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    scanner.receive("image", "image", bag_messages.rgb(pixels(), stamp=10))
    scanner.change_settings(ScanSettings(backward_jump_s=60.0))
    for stamp in (5, 6):
        scanner.receive("image", "image", bag_messages.rgb(pixels(), stamp=stamp))
    info = bag_messages.camera_info(40, 32, (4, 4, 20, 20), stamp=10)
    assert scanner.receive("camera_info", "info", info).accepted, "no jump of time had the image forgotten"


def test_other_evidence_has_every_scan_estimated_again(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    send_views(scanner, bag_messages, 3, 4, object_id="can")
    drain(scanner)
    scanner.change_settings(ScanSettings(pairing_queue=3))
    assert not scanner.pending(), "the views are as they were"
    scanner.change_settings(ScanSettings(pairing_queue=3, evidence="network"))
    assert sorted(result.scan.object_id for result in drain(scanner)) == ["can", "mug"]


def test_reset_forgets_one_object_or_all(
    bag_messages: Any, circle_estimator: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    send_views(scanner, bag_messages, 1, object_id="can")
    scanner.receive("image", "image", bag_messages.rgb(pixels()))
    assert scanner.reset("a test asked for it", "can") == 1
    assert list(scanner.statistics().scans) == ["mug"]
    assert scanner.reset("the clock jumped") == 2
    assert "The scan of 'mug' with 2 views is forgotten: the clock jumped." in caplog.text
    assert scanner.statistics().scans == {}
    assert scanner.statistics().waiting == 0
    assert not scanner.pending()
    assert scanner.reset("again") == 0
    assert [receipt.accepted for receipt in send_views(scanner, bag_messages, 0.5, 1)] == [True, True]


def test_dropping_the_last_view(bag_messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    assert scanner.drop_last_view() == Receipt(False, "", "There is no view to drop.")
    send_views(scanner, bag_messages, 1, 2, 3)
    send_views(scanner, bag_messages, 4, 5, object_id="can")
    drain(scanner)
    dropped = scanner.drop_last_view()
    assert dropped == Receipt(True, "can", "The view of 'can' with stamp 5.000000000 is dropped.")
    assert scanner.drop_last_view("mug").accepted
    assert scanner.drop_last_view("jar") == Receipt(False, "jar", "There is no view of 'jar' to drop.")
    taken_back, result = sorted(drain(scanner), key=lambda each: each.scan.object_id)
    assert (result.scan.object_id, stamps_of(result.scan)) == ("mug", [1, 2])
    assert (taken_back.scan.object_id, stamps_of(taken_back.scan)) == ("can", [4, 5])
    assert (taken_back.estimate.cameras, taken_back.estimate.pairs) == ((), ())
    assert taken_back.estimate.verdict == Verdict.ONE_MORE_VIEW
    assert taken_back.estimate.status == "one more view: only one is left"
    assert scanner.statistics().scans["can"].status == ""


def test_what_was_told_of_views_that_are_gone_is_taken_back_once(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings(max_scans=2))
    for object_id in ("mug", "can"):
        send_views(scanner, bag_messages, 1, 2, object_id=object_id)
    drain(scanner)
    send_views(scanner, bag_messages, 5, object_id="jar")
    scanner.reset("a test asked for it")
    scanner.reset("again")
    assert scanner.pending()
    results = scanner.estimate_pending()
    assert [(each.scan.object_id, each.estimate.status) for each in results] == [
        ("mug", "no view is left: another object needed the room"),
        ("can", "no view is left: a test asked for it"),
    ], "nothing was told of the jar"
    assert not any(each.estimate.cameras for each in results)
    assert not scanner.pending()


def test_what_is_taken_back_comes_in_the_order_in_which_it_happened(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    """Else a client that keeps the last message would keep the wrong one."""
    inner = circle_estimator()

    def estimate(scan: Scan) -> ScanEstimate:
        if scan.object_id == "can":  # while the new mug waits, its old estimate made
            scanner.reset("a test asked for it", "mug")
            send_views(scanner, bag_messages, 3, 4)
        return inner.estimate(scan)

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    send_views(scanner, bag_messages, 1, 2, object_id="can")
    told = [
        (each.scan.object_id, stamps_of(each.scan), len(each.estimate.cameras)) for each in drain(scanner)
    ]
    assert told == [("mug", [1, 2], 2), ("mug", [1, 2], 0), ("can", [1, 2], 2), ("mug", [3, 4], 2)]


@pytest.mark.parametrize("keep", ["latest", "spread", "first"])
def test_no_object_waits_for_ever_for_another_one_whose_views_keep_coming(
    bag_messages: Any, circle_estimator: Callable[..., Any], keep: str
) -> None:
    """A detector that sends both, mug and can, while an estimate takes longer than a frame."""
    inner, stamps = circle_estimator(), itertools.count(10)
    estimated = []

    def estimate(scan: Scan) -> ScanEstimate:
        estimated.append(scan.object_id)
        for stamp in itertools.islice(stamps, 3):
            for object_id in ("mug", "can"):
                send_views(scanner, bag_messages, stamp, object_id=object_id)
        return inner.estimate(scan)

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings(keep=keep, max_views=4))
    for object_id in ("mug", "can"):
        send_views(scanner, bag_messages, 1, 2, object_id=object_id)
    for _ in range(8):
        scanner.estimate_pending()
    turns = [estimated.count(object_id) for object_id in ("mug", "can")]
    assert abs(turns[0] - turns[1]) <= 1
    assert min(turns) >= 1


def test_objects_are_estimated_one_by_one_in_turn(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    """So that what is told of one need not wait for all the others."""
    scanner = Scanner(circle_estimator(), ScanSettings())
    for object_id in ("mug", "can", "mug"):
        send_views(scanner, bag_messages, *((1, 2) if object_id != "mug" else ()), object_id=object_id)
    send_views(scanner, bag_messages, 1, 2, object_id="jar")
    send_views(scanner, bag_messages, 3, object_id="can")
    assert [[each.scan.object_id for each in scanner.estimate_pending()] for _ in range(3)] == [
        ["jar"],
        ["can"],
        [],
    ]
    assert scanner.objects() == ["jar", "can"]


@pytest.mark.parametrize("what", ["reset", "drop", "jump", "more", "other"])
def test_a_result_stands_until_its_views_are_forgotten(
    bag_messages: Any, circle_estimator: Callable[..., Any], what: str
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings(keep="latest", max_views=3))
    send_views(scanner, bag_messages, 10, 11, 12)
    (result,) = scanner.estimate_pending()
    assert scanner.stands(result)
    if what == "reset":
        scanner.reset("a test asked for it")
    elif what == "drop":
        scanner.drop_last_view()
    elif what == "jump":
        send_views(scanner, bag_messages, 1, 2)
    elif what == "more":  # a view let go by the keep policy
        send_views(scanner, bag_messages, 13)
    else:
        send_views(scanner, bag_messages, 1, 2, object_id="can")
        scanner.drop_last_view("can")
    assert scanner.stands(result) is (what in {"more", "other"})
    if what == "more":
        (newer,) = scanner.estimate_pending()
        assert scanner.stands(newer)
        assert not scanner.stands(result)


def test_what_was_reset_meanwhile_is_not_estimated(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    inner = circle_estimator()
    estimated = []

    def estimate(scan: Scan) -> ScanEstimate:
        estimated.append(scan.object_id)
        scanner.reset("a test asked for it")
        return inner.estimate(scan)

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings())
    for object_id in ("mug", "can", "jar"):
        send_views(scanner, bag_messages, 1, 2, object_id=object_id)
    assert scanner.estimate_now() == []
    assert estimated == ["mug"]


def test_an_estimate_may_be_asked_for(bag_messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1)
    assert scanner.estimate_now() == []
    send_views(scanner, bag_messages, 2)
    send_views(scanner, bag_messages, 3, 4, object_id="can")
    assert len(drain(scanner)) == 2
    assert [result.scan.object_id for result in scanner.estimate_now()] == ["mug", "can"]
    assert [result.scan.object_id for result in scanner.estimate_now("can")] == ["can"]
    assert scanner.estimate_now("jar") == []
    assert not scanner.pending()


def test_other_settings_count_from_the_next_message_on(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1, 2, 3, 4)
    send_views(scanner, bag_messages, 5, object_id="can")
    scanner.change_settings(ScanSettings(max_views=2, keep="latest", max_scans=1, object_id="thing"))
    assert list(scanner.statistics().scans) == ["can"]
    send_views(scanner, bag_messages, 6, 7, object_id="can")
    (result,) = drain(scanner)
    assert stamps_of(result.scan) == [6, 7]
    assert send_views(scanner, bag_messages, 8, object_id="")[0].object_id == "thing"


def test_a_bag_that_loops_resets_the_scan(
    bag_messages: Any, circle_estimator: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    scans = []
    for _ in range(2):
        for stamp in (10, 12, 14, 16):
            send_views(scanner, bag_messages, stamp)
            scans += [stamps_of(result.scan) for result in drain(scanner)]
    assert scans == 2 * [[10, 12], [10, 12, 14], [10, 12, 14, 16]]
    assert "Time jumped backwards from 16.000000000 to 10.000000000" in caplog.text


def test_spread_publishes_no_trial_that_is_undone(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    azimuths = {1: 0.0, 2: 40.0, 3: 41.0, 4: 120.0, 5: 200.0, 6: 119.0}
    scanner = Scanner(
        circle_estimator(lambda stamp: azimuths[round(stamp)]), ScanSettings(keep="spread", max_views=4)
    )
    results = []
    for stamp in azimuths:
        (receipt,) = send_views(scanner, bag_messages, stamp)
        assert receipt.accepted
        assert ("the scan is full" in receipt.reason) == (stamp > 4)
        results.append([stamps_of(result.scan) for result in drain(scanner)])
    assert results == [[], [[1, 2]], [[1, 2, 3]], [[1, 2, 3, 4]], [[1, 3, 4, 5]], []]


class SlowEstimator:
    """Stops in the middle of an estimate until it is told to go on."""

    def __init__(self, inner: Any) -> None:
        self.inner = inner
        self.entered = threading.Event()
        self.go_on = threading.Event()

    def estimate(self, scan: Scan) -> ScanEstimate:
        self.entered.set()
        assert self.go_on.wait(10)
        return self.inner.estimate(scan)


def in_background(work: Callable[[], Any]) -> tuple[threading.Thread, list[Any]]:
    answers: list[Any] = []
    thread = threading.Thread(target=lambda: answers.append(work()))
    thread.start()
    return thread, answers


def test_views_are_taken_while_the_estimator_runs(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    estimator = SlowEstimator(circle_estimator())
    scanner = Scanner(estimator, ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    thread, answers = in_background(scanner.estimate_pending)
    assert estimator.entered.wait(10)
    assert all(receipt.accepted for receipt in send_views(scanner, bag_messages, 3, 4, 5))
    assert scanner.statistics().scans["mug"].views == 5
    assert scanner.pending()
    estimator.go_on.set()
    thread.join(10)
    assert [stamps_of(result.scan) for result in answers[0]] == [[1, 2]]
    assert [stamps_of(result.scan) for result in drain(scanner)] == [[1, 2, 3, 4, 5]]


@pytest.mark.parametrize("what", ["reset", "drop", "replaced"])
def test_a_result_whose_views_are_gone_is_dropped(
    bag_messages: Any, circle_estimator: Callable[..., Any], what: str
) -> None:
    estimator = SlowEstimator(circle_estimator())
    scanner = Scanner(estimator, ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    thread, answers = in_background(scanner.estimate_pending)
    assert estimator.entered.wait(10)
    if what == "drop":
        scanner.drop_last_view()
    else:
        scanner.reset("a test asked for it")
    if what == "replaced":
        send_views(scanner, bag_messages, 3, 4)
    estimator.go_on.set()
    thread.join(10)
    assert answers == [[]]
    assert [stamps_of(result.scan) for result in drain(scanner)] == ([[3, 4]] if what == "replaced" else [])


def test_an_estimator_that_fails_does_not_end_the_scan(
    bag_messages: Any, circle_estimator: Callable[..., Any], caplog: pytest.LogCaptureFixture
) -> None:
    inner = circle_estimator()

    def estimate(scan: Scan) -> ScanEstimate:
        if len(scan.views) == 2:
            raise RuntimeError("out of memory")
        if len(scan.views) == 3:
            raise RelPoseError("two of the views are the same")
        return inner.estimate(scan)

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    assert drain(scanner) == []
    assert "The estimate of 'mug' from 2 views failed: out of memory. The views are kept." in caplog.text
    assert "Traceback" in caplog.text
    caplog.clear()
    send_views(scanner, bag_messages, 3)
    assert drain(scanner) == []
    assert "two of the views are the same" in caplog.text
    assert "Traceback" not in caplog.text
    assert scanner.statistics().failed == 2
    assert "two of the views" in scanner.statistics().last_failure
    assert "two of the views" in scanner.statistics().scans["mug"].failure
    send_views(scanner, bag_messages, 4)
    (result,) = drain(scanner)
    assert stamps_of(result.scan) == [1, 2, 3, 4]
    assert scanner.statistics().scans["mug"].failure == ""


def test_a_scan_that_has_lost_its_views_fails_no_longer(bag_messages: Any) -> None:
    def estimate(scan: Scan) -> ScanEstimate:
        raise RelPoseError("no view of it will do")

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    drain(scanner)
    assert scanner.statistics().scans["mug"].failure
    scanner.drop_last_view()
    assert scanner.statistics().scans["mug"].failure == ""


def test_a_scan_whose_estimates_all_fail_is_told_all_the_time(bag_messages: Any) -> None:
    """Those without one or the other view, of which nothing is logged, too."""

    def estimate(scan: Scan) -> ScanEstimate:
        raise RelPoseError("no view of it will do")

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings())
    for stamp in range(1, 7):
        send_views(scanner, bag_messages, stamp)
        while scanner.pending():
            scanner.estimate_pending()
            assert "no view of it will do" in scanner.statistics().scans["mug"].failure


def test_many_threads_lose_no_view(bag_messages: Any, circle_estimator: Callable[..., Any]) -> None:
    """Four objects from four threads, while two more ask for estimates and statistics."""
    scanner = Scanner(circle_estimator(), ScanSettings(keep="first", max_scans=4))
    built = {
        f"object {k}": [bag_messages.object_view(stamp=stamp, object_id=f"object {k}") for stamp in range(8)]
        for k in range(4)
    }
    results: list[Any] = []
    stop = threading.Event()

    def work() -> None:
        while not stop.is_set():
            results.extend(scanner.estimate_pending())
            scanner.statistics()
            time.sleep(0.001)

    def feed(object_id: str) -> None:
        for message in built[object_id]:
            assert scanner.receive("object_view", object_id, message).accepted
            time.sleep(0.001)

    workers = [threading.Thread(target=work) for _ in range(2)]
    feeders = [threading.Thread(target=feed, args=(object_id,)) for object_id in built]
    for thread in workers + feeders:
        thread.start()
    for thread in feeders:
        thread.join(30)
    stop.set()
    for thread in workers:
        thread.join(30)
    results += drain(scanner)
    for object_id in built:
        counts = [len(result.scan.views) for result in results if result.scan.object_id == object_id]
        assert counts[-1] == 8
        assert counts == sorted(set(counts)), "each estimate has more views than the last"
        assert scanner.statistics().scans[object_id].views == 8


def test_the_same_messages_give_the_same_results(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    def run() -> list[list[float]]:
        scanner = Scanner(circle_estimator(lambda stamp: (37 * stamp) % 360), ScanSettings())
        scans = []
        for stamp in range(40):
            send_views(scanner, bag_messages, stamp)
            scans += [stamps_of(result.scan) for result in drain(scanner)]
        return scans

    assert run() == run()


@pytest.mark.parametrize("message", [None, 5, "view", object(), SimpleNamespace(header=None), [], {}])
@pytest.mark.parametrize("kind", ["object_view", "image", "compressed", "camera_info"])
def test_what_is_no_message_at_all_is_rejected(
    circle_estimator: Callable[..., Any], kind: Any, message: Any
) -> None:
    receipt = Scanner(circle_estimator(), ScanSettings()).receive(kind, "topic", message)
    assert receipt.rejected
    assert receipt.reason.startswith(f"topic: the message cannot be read as {kind}: AttributeError")


def test_an_unknown_kind_is_the_callers_mistake(circle_estimator: Callable[..., Any]) -> None:
    with pytest.raises(ValueError, match="no message kind 'pointcloud'"):
        Scanner(circle_estimator(), ScanSettings()).receive("pointcloud", "topic", None)  # type: ignore[arg-type]


NUMBERS = (0, 1, 2, 7, 8, 15, 16, 31, 32, 33, 39, 40, 41, 120, 121, 2**16, 2**31, 2**32 - 1)
MATRICES = tuple(
    np.array(values, np.float64)
    for values in (
        [0.0] * 9, [np.nan] * 9, [np.inf, 0, 0, 0, 1, 0, 0, 0, 1], [-1, 0, 0, 0, -1, 0, 0, 0, 1],
        [1e-300, 0, 1e300, 0, 1e-300, -1e300, 0, 0, 0],
    )
)  # fmt: skip
NAMES = ("", "mug", "can", "x" * 129, "x" * 100_000, "a\0b", "\ud800", "\N{SNOWMAN}", "\n")
JPEG = cv2.imencode(".jpg", pixels())[1].tobytes()
PNG = cv2.imencode(".png", pixels())[1].tobytes()
BLOBS = tuple(
    np.frombuffer(data, np.uint8)
    for data in (
        b"", b"\0", bytes(99), bytes(3839), bytes(3840), bytes(1280), JPEG, JPEG[:-2], JPEG[:30], JPEG[2:],
        PNG, PNG[:40], PNG[:-12], b"\xff\xd8\xff\xd9", b"\xff" * 4000, JPEG + JPEG,
        PNG[:16] + b"\xff" * 8 + PNG[24:],
    )
)  # fmt: skip
STAMPS = (-(2**31), -1, 0, 1, 2, 3, 5, 8, 2**31 - 1)
ROI = {"x_offset": NUMBERS, "y_offset": NUMBERS, "width": NUMBERS, "height": NUMBERS}
HEADER = {
    "header.frame_id": NAMES,
    "header.stamp.sec": STAMPS,
    "header.stamp.nanosec": (0, 1, 999_999_999, 1_000_000_000, 2**32 - 1),
}
IMAGE = {
    "width": NUMBERS,
    "height": NUMBERS,
    "step": NUMBERS,
    "encoding": (*ENCODINGS, "", "32FC1", "jpeg", "x" * 10_000, "\ud800"),
    "is_bigendian": (0, 1, 255),
    "data": BLOBS,
}
COMPRESSED = {"format": ("", "jpeg", "16UC1; compressedDepth", "x" * 10_000), "data": BLOBS}


def under(prefix: str, fields: dict[str, Any]) -> dict[str, Any]:
    return {f"{prefix}.{name}": values for name, values in fields.items()}


FIELDS: dict[str, list[tuple[str, Any]]] = {
    kind: list(fields.items())
    for kind, fields in {
        "object_view": {
            **HEADER,
            **under("image", IMAGE),
            **under("compressed", COMPRESSED),
            **under("mask", IMAGE),
            **under("box", ROI),
            **under("crop", ROI),
            "object_id": NAMES,
            "full_width": NUMBERS,
            "full_height": NUMBERS,
            "k": MATRICES,
        },
        "image": HEADER | IMAGE,
        "compressed": HEADER | COMPRESSED,
        "camera_info": {
            **HEADER,
            **under("roi", ROI),
            "width": NUMBERS,
            "height": NUMBERS,
            "k": MATRICES,
            "binning_x": NUMBERS,
            "binning_y": NUMBERS,
        },
    }.items()
}


def good_message(messages: Any, kind: str, stamp: int) -> Any:
    if kind == "object_view":
        mask = messages.image(bytes(1280), 40, 32, "mono8", 40)
        return messages.object_view(messages.rgb(pixels()), mask=mask, stamp=stamp, object_id="object")
    if kind == "image":
        return messages.rgb(pixels(), stamp=stamp)
    if kind == "compressed":
        return messages.compressed(JPEG, stamp=stamp)
    return messages.camera_info(40, 32, (4, 4, 20, 20), stamp=stamp)


def spoil(message: Any, path: str, value: Any) -> None:
    *parents, name = path.split(".")
    for parent in parents:
        message = getattr(message, parent)
    setattr(message, name, value)


ARRIVALS = st.lists(
    st.tuples(
        st.sampled_from(sorted(FIELDS)),
        st.integers(0, 9),
        st.lists(st.tuples(st.integers(0, 30), st.integers(0, 30)), max_size=3),
    ),
    min_size=40,
    max_size=40,
)


@pytest.fixture
def jumps(monkeypatch: pytest.MonkeyPatch) -> list[View]:
    """The first views after each jump of time that a scan followed."""
    views: list[View] = []
    follow_jump = ScanBuffer._follow_jump

    def follow(buffer: ScanBuffer, first: View) -> None:
        views.append(first)
        follow_jump(buffer, first)

    monkeypatch.setattr(ScanBuffer, "_follow_jump", follow)
    return views


@pytest.mark.usefixtures("quiet_log")
@settings(max_examples=300, suppress_health_check=list(HealthCheck))
@given(arrivals=ARRIVALS, keep=st.sampled_from(["first", "latest", "spread"]))
def test_twelve_thousand_malformed_messages_cost_no_view(
    bag_messages: Any,
    circle_estimator: Callable[..., Any],
    jumps: list[View],
    arrivals: list[Any],
    keep: str,
) -> None:
    """The fields of good messages are replaced by what lies at their limits and beyond.

    No exception escapes, none is needed as a safety net either, and a message that is not accepted leaves the
    views that are held as they are, unless it confirms that time jumped: then the view before it may take the
    place of one from the future.
    """
    scanner = Scanner(circle_estimator(), ScanSettings(keep=keep, max_views=3, pairing_queue=3, max_scans=2))
    send_views(scanner, bag_messages, 4, 4.5, object_id="object")
    held = held_views(scanner)
    for kind, stamp, faults in arrivals:
        message = good_message(bag_messages, kind, stamp)
        for field, value in faults:
            path, values = FIELDS[kind][field % len(FIELDS[kind])]
            spoil(message, path, values[value % len(values)])
        jumps.clear()
        receipt = scanner.receive(kind, kind, message)
        assert "cannot be read" not in receipt.reason
        assert len(receipt.reason) < 1000
        now = held_views(scanner)
        if not receipt.accepted and not jumps:
            assert now == held
        held = now
        drain(scanner)
        held = held_views(scanner)
        assert len(held) <= 2
        assert all(len(views) <= 3 for views in held.values())


def held_views(scanner: Scanner) -> dict[str, tuple[Any, ...]]:
    """The views themselves: two are equal only if they are the same."""
    return {object_id: state.buffer.views for object_id, state in scanner._scans.items()}


@pytest.mark.parametrize("kind", ["raw", "jpeg"])
def test_how_long_a_callback_takes(
    graph_messages: Any,
    circle_estimator: Callable[..., Any],
    kind: str,
    record_property: Callable[..., None],
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Printed, not judged: a test that depends on the clock fails on someone's machine."""
    frame = np.zeros((1080, 1920, 3), np.uint8)
    frame[:, :, 0] = np.arange(1920) // 8
    fields: dict[str, Any] = {"box": (700, 300, 500, 450), "full": (1920, 1080)}
    if kind == "raw":
        fields["image"] = graph_messages.rgb(frame)
    else:
        fields["compressed"] = graph_messages.compressed(cv2.imencode(".jpg", frame)[1].tobytes())
    scanner = Scanner(circle_estimator(), ScanSettings(keep="latest"))
    spent = []
    for stamp in range(20):
        message = graph_messages.object_view(stamp=stamp, **fields)
        started = time.perf_counter()
        assert scanner.receive("object_view", "views", message).accepted
        spent.append(1e3 * (time.perf_counter() - started))
    with capsys.disabled():
        print(f"\n1920 x 1080 {kind}: median {np.median(spent):.2f} ms, slowest {max(spent):.2f} ms")
    (result,) = drain(scanner)
    assert result.scan.views[0].image.shape == (600, 600, 3)


@pytest.mark.parametrize("keep", ["first", "latest", "spread"])
def test_a_full_scan_is_not_told_to_take_one_more_view(
    bag_messages: Any, circle_estimator: Callable[..., Any], keep: str
) -> None:
    inner = circle_estimator()

    def estimate(scan: Scan) -> ScanEstimate:
        return replace(inner.estimate(scan), status="one more view: pair 0-1 knows hardly anything")

    scanner = Scanner(SimpleNamespace(estimate=estimate), ScanSettings(max_views=3, keep=keep))
    told = []
    for stamp in (1, 2, 3):
        send_views(scanner, bag_messages, stamp)
        told += [result.estimate.status for result in drain(scanner)]
    assert told[0] == "one more view: pair 0-1 knows hardly anything"
    assert told[1] == f"not enough: pair 0-1 knows hardly anything; {WITHOUT_ROOM[keep]}"


def send_pose(scanner: Scanner, messages: Any, stamp: float, x: float = 0.0, **fields: Any) -> Receipt:
    message = messages.camera_pose((x, 0.0, 0.0), stamp=stamp, **fields)
    return scanner.receive("camera_pose", "camera_pose", message)


def poses_of(scan: Scan) -> list[float | None]:
    return [None if pose is None else float(pose.position[0]) for pose in scan.robot_poses]


def test_a_camera_pose_belongs_to_the_view_of_its_stamp(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    assert send_pose(scanner, messages, 1, 0.1) == Receipt(False, "", "")
    send_views(scanner, messages, 1, 2, 3)
    assert send_pose(scanner, messages, 3, 0.3) == Receipt(True, "mug", "")
    (result,) = drain(scanner)
    assert poses_of(result.scan) == [0.1, None, 0.3]
    assert scanner.statistics().topics["camera_pose"] == TopicStatistics(2, 2, 0, "")


def test_a_pose_that_comes_after_the_estimate_has_it_made_anew(
    messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, messages, 1, 2)
    (before,) = drain(scanner)
    assert before.scan.robot_poses == ()
    assert send_pose(scanner, messages, 2, 0.2).accepted
    (after,) = drain(scanner)
    assert poses_of(after.scan) == [None, 0.2]
    assert not send_pose(scanner, messages, 2, 0.2).accepted, "nothing new"
    assert not send_pose(scanner, messages, 2.5).accepted, "no view has this stamp yet"
    assert not scanner.pending()


def test_views_on_trial_have_the_poses_of_their_own_stamps(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    """A newcomer stands last, in the place of another view: of the views held the poses would be others."""
    azimuths = {1: 0.0, 2: 40.0, 3: 41.0, 4: 120.0, 5: 119.0}
    estimator = circle_estimator(lambda stamp: azimuths[round(stamp)])
    scanner = Scanner(estimator, ScanSettings(keep="spread", max_views=3))
    for stamp in azimuths:
        send_pose(scanner, bag_messages, stamp, float(stamp))
        send_views(scanner, bag_messages, stamp)
        drain(scanner)
    assert [stamps_of(scan) for scan in estimator.scans[-2:]] == [[1, 3, 4], [1, 4, 5]]
    for scan in estimator.scans:
        assert poses_of(scan) == stamps_of(scan)


def test_a_bad_pose_costs_no_view(messages: Any, circle_estimator: Callable[..., Any]) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    receipt = send_pose(scanner, messages, 1, orientation=(0.0, 0.0, 0.0, 0.0))
    assert receipt.rejected
    assert receipt.reason.startswith("camera_pose, stamp 1.000000000: the orientation [0.0, 0.0, 0.0, 0.0]")
    send_views(scanner, messages, 1, 2)
    assert send_pose(scanner, messages, 2, float("nan")).rejected
    (result,) = drain(scanner)
    assert stamps_of(result.scan) == [1, 2]
    assert result.scan.robot_poses == ()
    assert scanner.statistics().topics["camera_pose"].rejected == 2


def test_a_pose_without_a_covariance_takes_the_deviations_of_the_settings(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    settings = ScanSettings(camera_pose_position_deviation=0.1, camera_pose_rotation_deviation=0.2)
    scanner = Scanner(circle_estimator(), settings)
    send_pose(scanner, bag_messages, 1)
    send_views(scanner, bag_messages, 1, 2)
    (result,) = drain(scanner)
    np.testing.assert_allclose(np.diag(result.scan.robot_poses[0].covariance), np.repeat([0.01, 0.04], 3))


def test_poses_of_no_view_are_counted_when_they_go(
    bag_messages: Any, circle_estimator: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("relpose_ros.scanning.robot_poses.KEPT", 2)
    scanner = Scanner(circle_estimator(), ScanSettings())
    for stamp in (1, 1.5, 2):
        send_pose(scanner, bag_messages, stamp)
    counts = scanner.statistics().topics["camera_pose"]
    assert (counts.used, counts.rejected) == (0, 1)
    assert counts.last_reason == (
        "camera_pose, stamp 1.000000000: no view has this stamp: a camera's pose takes the stamp of the "
        "image."
    )


def test_a_reset_forgets_the_poses_of_the_views_it_forgets(
    bag_messages: Any, circle_estimator: Callable[..., Any]
) -> None:
    scanner = Scanner(circle_estimator(), ScanSettings())
    send_views(scanner, bag_messages, 1, 2)
    send_views(scanner, bag_messages, 3, 4, object_id="can")
    for stamp in (1, 2, 3, 4):
        send_pose(scanner, bag_messages, stamp, float(stamp))
    drain(scanner)
    scanner.reset("a test asked for it", "mug")
    send_views(scanner, bag_messages, 1, 2)
    scanner.estimate_now()
    results = {each.scan.object_id: poses_of(each.scan) for each in scanner.estimate_now()}
    assert results == {"mug": [], "can": [3.0, 4.0]}
