from __future__ import annotations

import copy
import json
import logging
import math
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from rosbags.rosbag2 import StoragePlugin, Writer

from relpose_ros.estimates import ObjectPose, Verdict
from relpose_ros.geometry import so3
from relpose_ros.replay import bags
from relpose_ros.replay.bags import BagError, BagReader
from relpose_ros.replay.pack import pack
from relpose_ros.replay.replay import ReplayError, replay
from relpose_ros.scanning.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable

    from relpose_ros.replay.bags import Record
    from relpose_ros.replay.comparison import TruePose

    Fake = Callable[..., Any]
    Capture = tuple[Path, list[TruePose]]
    Rewrite = Callable[[Path, Path, Callable[[Record], Iterable[Record]]], Path]

OUTPUTS = {"estimates", "scan.json", "report.html"}


def contents(folder: Path) -> dict[str, bytes]:
    return {
        str(file.relative_to(folder)): file.read_bytes()
        for file in sorted(folder.rglob("*"))
        if file.is_file() and file.name != "report.html"
    }


def records(path: Path) -> list[Record]:
    with BagReader(path) as bag:
        return list(bag.records(bag.topics))


@pytest.mark.parametrize("form", ["image", "object_view"])
def test_one_estimate_for_each_view_from_the_second_on(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, form: Any
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag", form=form)
    replay(tmp_path / "bag", tmp_path / "out", estimator=fake_estimator(truth))
    assert {each.name for each in (tmp_path / "out").iterdir()} == OUTPUTS

    scan = json.loads((tmp_path / "out/scan.json").read_text(), parse_constant=pytest.fail)
    assert set(scan) == {"object_id", "views", "estimates"}
    assert scan["object_id"] == {"image": "object", "object_view": "cup"}[form]
    assert scan["views"] == [
        {
            "index": k,
            "stamp_ns": (k + 1) * 10**9,
            "frame_id": "camera_optical_frame",
            "box": [14.0, 10.0, 42.0, 38.0],
        }
        for k in range(5)
    ]
    assert [each["views"] for each in scan["estimates"]] == [list(range(n)) for n in (2, 3, 4, 5)]
    for estimate in scan["estimates"]:
        assert set(estimate) == {
            *("views", "verdict", "calibrated", "weakest_pair", "score", "status", "cameras", "pairs"),
            *("scale_known", "scale_deviation", "object_pose"),
        }
        enough = len(estimate["views"]) > 2
        assert (estimate["verdict"], estimate["calibrated"]) == (
            "ENOUGH" if enough else "ONE_MORE_VIEW",
            False,
        )
        assert estimate["weakest_pair"] < len(estimate["pairs"])
        assert (estimate["scale_deviation"], estimate["object_pose"]) == (0.0, None)
        count = len(estimate["views"])
        assert [camera["view"] for camera in estimate["cameras"]] == list(range(count))
        assert [(p["i"], p["j"]) for p in estimate["pairs"]] == [
            (i, j) for i in range(count) for j in range(i + 1, count)
        ]
        for camera in estimate["cameras"]:
            assert set(camera) == {"view", "position", "orientation_xyzw", "covariance"}
            assert [len(camera[k]) for k in ("position", "orientation_xyzw", "covariance")] == [3, 4, 36]
        for pair in estimate["pairs"]:
            assert set(pair) == {
                *("i", "j", "orientation_xyzw", "covariance", "probability_within_15_deg"),
                *("entropy", "ambiguous", "ambiguity_angle", "solution_probability", "solution_angle"),
                *("evidence", "modes"),
            }
            assert pair["evidence"] == (["LEARNED"] if pair["ambiguous"] else ["LEARNED", "GEOMETRIC"])
            assert len(pair["covariance"]) == 9
            for mode in pair["modes"]:
                assert set(mode) == {"orientation_xyzw", "weight", "covariance"}
    # The numbers are the estimator's own.
    last = scan["estimates"][-1]["cameras"]
    relative = so3.from_quaternion_xyzw(last[3]["orientation_xyzw"])
    wanted = truth[0].world_from_camera.T @ truth[3].world_from_camera
    np.testing.assert_allclose(relative, wanted, atol=1e-9)


def test_the_bag_holds_what_the_node_would_have_sent(
    tmp_path: Path, capture: Capture, fake_estimator: Fake
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    replay(
        tmp_path / "bag",
        tmp_path / "out",
        settings=ScanSettings(object_frame="the_cup"),
        estimator=fake_estimator(truth),
    )
    sent = records(tmp_path / "out/estimates")
    assert [(each.topic, each.log_time_ns) for each in sent] == [
        (f"/scan_node/{name}", second * 10**9)
        for second in (2, 3, 4, 5)
        for name in ("estimate", "poses", "markers")
    ]
    estimate, poses, markers = (each.message for each in sent[-3:])
    assert [each.header.frame_id for each in (estimate, poses)] == ["the_cup"] * 2
    assert estimate.header.stamp.sec == 5
    assert estimate.seconds == 0
    assert [camera.header.stamp.sec for camera in estimate.cameras] == [1, 2, 3, 4, 5]
    assert len(poses.poses) == 5
    assert poses.poses[3].position.x == estimate.cameras[3].pose.pose.position.x
    assert len(markers.markers) > 10


def test_two_runs_write_the_same_bytes(tmp_path: Path, capture: Capture, fake_estimator: Fake) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    for name in ("one", "two"):
        replay(tmp_path / "bag", tmp_path / name, estimator=fake_estimator(truth))
    assert contents(tmp_path / "one") == contents(tmp_path / "two")
    assert set(contents(tmp_path / "one")) == {
        "scan.json",
        "estimates/estimates.mcap",
        "estimates/metadata.yaml",
    }


@pytest.mark.parametrize("plugin", list(StoragePlugin))
@pytest.mark.parametrize("single", [False, True])
def test_every_kind_of_bag_gives_the_same_answer(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, plugin: StoragePlugin, single: bool
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "reference")
    replay(tmp_path / "reference", tmp_path / "wanted", estimator=fake_estimator(truth))
    store = bags._base_store()
    with Writer(tmp_path / "bag", version=9, storage_plugin=plugin) as writer:
        connections: dict[str, Any] = {}
        for record in records(tmp_path / "reference"):
            kind = record.message.__msgtype__
            if record.topic not in connections:
                connections[record.topic] = writer.add_connection(record.topic, kind, typestore=store)
            data = store.serialize_cdr(record.message, kind)
            writer.write(connections[record.topic], record.log_time_ns, data)
    path = next((tmp_path / "bag").glob("bag.*")) if single else tmp_path / "bag"
    replay(path, tmp_path / "out", estimator=fake_estimator(truth))
    assert contents(tmp_path / "out") == contents(tmp_path / "wanted")


def test_every_object_has_its_own_folder(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "cup_bag", form="object_view")

    def repeat(record: Record) -> Iterable[Record]:
        if record.topic != "/object_view":
            return
        for name in ["a/b", "../..", "Mug", "mug", *(["lonely"] if record.log_time_ns == 10**9 else [])]:
            changed = bags._base_store().types[record.message.__msgtype__](
                **{**vars(record.message), "object_id": name}
            )
            yield record._replace(message=changed)

    rewrite(tmp_path / "cup_bag", tmp_path / "bag", repeat)
    settings = ScanSettings(max_scans=8)
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=fake_estimator(truth))
    found = {}
    for each in (tmp_path / "out").iterdir():
        assert {inner.name for inner in each.iterdir()} == OUTPUTS
        found[each.name] = json.loads((each / "scan.json").read_text())["object_id"]
    assert found == {"a_b": "a/b", "_": "../..", "Mug": "Mug", "mug-2": "mug"}
    # An earlier output of several objects is replaced like that of one.
    replay(tmp_path / "cup_bag", tmp_path / "out", estimator=fake_estimator(truth))
    assert {each.name for each in (tmp_path / "out").iterdir()} == OUTPUTS


def test_an_object_that_made_room_for_another_keeps_its_output(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "one", form="object_view")

    def rename(record: Record) -> Iterable[Record]:
        record.message.object_id = "early" if record.log_time_ns <= 3 * 10**9 else "later"
        yield record

    rewrite(tmp_path / "one", tmp_path / "bag", rename)
    settings = ScanSettings(max_scans=1)
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=fake_estimator(truth))
    for name, counts in (("early", [2, 3]), ("later", [2])):
        scan = json.loads((tmp_path / "out" / name / "scan.json").read_text())
        assert [len(each["cameras"]) for each in scan["estimates"]] == counts


def test_views_that_make_way_are_numbered_once(
    tmp_path: Path, capture: Capture, fake_estimator: Fake
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    settings = ScanSettings(max_views=3, keep="latest")
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=fake_estimator(truth))
    scan = json.loads((tmp_path / "out/scan.json").read_text())
    assert [view["stamp_ns"] for view in scan["views"]] == [k * 10**9 for k in (1, 2, 3, 4, 5)]
    assert [each["views"] for each in scan["estimates"]] == [[0, 1], [0, 1, 2], [1, 2, 3], [2, 3, 4]]
    assert [camera["view"] for camera in scan["estimates"][-1]["cameras"]] == [0, 1, 2]


@pytest.mark.parametrize(
    ("keep", "told"),
    [
        ("first", "5 pictures came, 3 were held at some time, 2 came when the scan was full"),
        ("latest", ""),
        ("spread", "5 pictures came, 4 were held at some time, 1 came from no new direction"),
    ],
)
def test_pictures_without_a_place_are_counted(
    tmp_path: Path,
    capture: Capture,
    fake_estimator: Fake,
    caplog: pytest.LogCaptureFixture,
    keep: str,
    told: str,
) -> None:
    folder, truth = capture
    # The fourth camera looks as the second one does, the fifth stays where it is.
    truth[3] = truth[1]
    pack(folder, tmp_path / "bag")
    settings = ScanSettings(max_views=3, keep=keep)
    with caplog.at_level(logging.INFO, "relpose_ros"):
        replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=fake_estimator(truth))
    page = (tmp_path / "out/report.html").read_text()
    if told:
        assert f"Of 'object': {told}" in caplog.text
        assert told in page
    else:
        assert "pictures came" not in caplog.text
        assert "5 views were used" in page


def test_the_counts_of_a_scan_that_made_room_are_not_made_up(
    tmp_path: Path, write_posed_capture: Callable[..., Any], fake_estimator: Fake, rewrite: Rewrite
) -> None:
    truth = write_posed_capture(tmp_path / "cup", 9)
    pack(tmp_path / "cup", tmp_path / "one", form="object_view")

    def rename(record: Record) -> Iterable[Record]:
        record.message.object_id = "jar" if 4 <= record.log_time_ns // 10**9 <= 6 else "mug"
        yield record

    rewrite(tmp_path / "one", tmp_path / "bag", rename)
    settings = ScanSettings(max_scans=1, max_views=2, keep="first")
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=fake_estimator(truth))
    assert "4 views were used" in (tmp_path / "out/mug/report.html").read_text(), "of six, two declined"


def test_an_enough_that_a_later_estimate_takes_back_is_told(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, caplog: pytest.LogCaptureFixture
) -> None:
    folder, truth = capture
    inner = fake_estimator(truth)

    class Doubting:
        def estimate(self, scan: Any) -> Any:
            estimate = inner.estimate(scan)
            last = len(scan.views) == 5
            return replace(estimate, verdict=Verdict.ONE_MORE_VIEW) if last else estimate

    pack(folder, tmp_path / "bag")
    with caplog.at_level(logging.INFO, "relpose_ros"):
        replay(tmp_path / "bag", tmp_path / "out", estimator=Doubting())
    told = "stimates 2 to 3 of 4 said enough, the last does not: a planner stops at the first."
    assert f"Of 'object': e{told}" in caplog.text
    assert f"E{told}" in (tmp_path / "out/report.html").read_text()


def test_rejected_messages_are_counted_by_their_reason(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, caplog: pytest.LogCaptureFixture, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "good")

    def spoil(record: Record) -> Iterable[Record]:
        if record.topic == "/camera_info" and record.log_time_ns in (2 * 10**9, 4 * 10**9):
            record.message.roi.width = 500 + record.log_time_ns // 10**9
        yield record

    rewrite(tmp_path / "good", tmp_path / "bag", spoil)
    with caplog.at_level(logging.WARNING, "relpose_ros"):
        replay(tmp_path / "bag", tmp_path / "out", estimator=fake_estimator(truth))
    assert "2 rejected: " in caplog.text
    assert "outside the full image of 64 x 48" in caplog.text
    scan = json.loads((tmp_path / "out/scan.json").read_text())
    assert [view["stamp_ns"] // 10**9 for view in scan["views"]] == [1, 3, 5]


def test_pictures_without_a_camera_info_are_told(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, caplog: pytest.LogCaptureFixture, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "good")

    def lose(record: Record) -> Iterable[Record]:
        if record.topic != "/camera_info" or record.log_time_ns not in (2 * 10**9, 4 * 10**9):
            yield record

    rewrite(tmp_path / "good", tmp_path / "bag", lose)
    for name, limit in (("waiting", 30), ("crowded", 1)):
        caplog.clear()
        with caplog.at_level(logging.WARNING, "relpose_ros"):
            settings = ScanSettings(pairing_queue=limit)
            replay(tmp_path / "bag", tmp_path / name, estimator=fake_estimator(truth), settings=settings)
        assert "2 rejected: A picture found no camera info of its stamp and frame_id before" in caplog.text


def test_no_estimate_is_an_error_that_says_why(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "one", views=[0])
    with pytest.raises(ReplayError, match="one view could be used, and an estimate takes two"):
        replay(tmp_path / "one", tmp_path / "out", estimator=fake_estimator(truth))

    pack(folder, tmp_path / "good")

    def no_box(record: Record) -> Iterable[Record]:
        if record.topic == "/camera_info":
            record.message.roi.width = 500
        yield record

    rewrite(tmp_path / "good", tmp_path / "bad", no_box)
    with pytest.raises(ReplayError, match=r"no view could be used.*5 messages were rejected, such as"):
        replay(tmp_path / "bad", tmp_path / "out", estimator=fake_estimator(truth))

    def late(record: Record) -> Iterable[Record]:
        if record.topic == "/camera_info":
            record.message.header.stamp.nanosec = 1
        yield record

    rewrite(tmp_path / "good", tmp_path / "apart", late)
    with pytest.raises(
        ReplayError, match="5 pictures came, and no camera info of their stamps and frame_id before"
    ):
        replay(tmp_path / "apart", tmp_path / "out", estimator=fake_estimator(truth))

    class Broken:
        def estimate(self, scan: Any) -> Any:
            raise RuntimeError("no luck")

    with pytest.raises(ReplayError, match="no luck"):
        replay(tmp_path / "good", tmp_path / "out", estimator=Broken())
    assert not (tmp_path / "out").exists()


def test_only_an_earlier_replay_is_replaced(tmp_path: Path, capture: Capture, fake_estimator: Fake) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    output = tmp_path / "out"
    output.mkdir()
    replay(tmp_path / "bag", output, estimator=fake_estimator(truth))
    before = contents(output)
    (output / "scan.json").write_text("{}")
    replay(tmp_path / "bag", output, estimator=fake_estimator(truth))
    assert contents(output) == before

    (output / "thesis.tex").write_text("years of work")
    with pytest.raises(ReplayError, match=r"holds thesis\.tex, which no replay wrote"):
        replay(tmp_path / "bag", output, estimator=fake_estimator(truth))
    assert (output / "thesis.tex").read_text() == "years of work"
    with pytest.raises(ReplayError, match="is a file"):
        replay(tmp_path / "bag", output / "thesis.tex", estimator=fake_estimator(truth))
    with pytest.raises(ReplayError, match="cannot be written"):
        replay(tmp_path / "bag", output / "thesis.tex" / "sub", estimator=fake_estimator(truth))
    # The shell that replays stands in it, and would stand in a folder that is gone.
    with pytest.raises(ReplayError, match="cannot be replaced as a whole"):
        replay(tmp_path / "bag", Path(), estimator=fake_estimator(truth))
    # The bag itself is no output either, although its folder could be named by mistake.
    with pytest.raises(ReplayError, match="which no replay wrote"):
        replay(tmp_path / "bag", tmp_path / "bag", estimator=fake_estimator(truth))
    assert {each.name for each in tmp_path.iterdir()} == {"cup", "bag", "out"}


def test_a_true_pose_that_is_none_is_left_out(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, caplog: pytest.LogCaptureFixture, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "good")

    def spoil(record: Record) -> Iterable[Record]:
        if record.topic == "/ground_truth/pose" and record.log_time_ns == 10**9:
            record.message.pose.position.x = math.nan
        yield record

    rewrite(tmp_path / "good", tmp_path / "bag", spoil)
    with caplog.at_level(logging.WARNING, "relpose_ros"):
        replay(tmp_path / "bag", tmp_path / "out", estimator=fake_estimator(truth))
    assert "stamp 1000000000 ns is no pose" in caplog.text
    assert "NaN" not in (tmp_path / "out/report.html").read_text()


@pytest.mark.parametrize("truth_of_both", [False, True])
def test_cameras_that_are_triggered_together_give_a_view_each(
    tmp_path: Path, capture: Capture, fake_estimator: Fake, truth_of_both: bool, rewrite: Rewrite
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "one")

    def double(record: Record) -> Iterable[Record]:
        for frame in ("left", "right"):
            changed = copy.deepcopy(record.message)
            if record.topic != "/ground_truth/pose":
                changed.header.frame_id = frame
            elif frame == "right":
                if not truth_of_both:
                    continue
                changed.pose.position.x += 1.0
            yield record._replace(topic=f"/{frame}{record.topic}", message=changed)

    rewrite(tmp_path / "one", tmp_path / "both", double)
    with pytest.raises(BagError, match="several cameras; choose with --topic: /left/image/compressed, "):
        replay(tmp_path / "both", tmp_path / "out", estimator=fake_estimator(truth))
    topics = [f"/{frame}/image/compressed" for frame in ("left", "right")]
    replay(tmp_path / "both", tmp_path / "out", topics=topics, estimator=fake_estimator(truth))
    views = json.loads((tmp_path / "out/scan.json").read_text())["views"]
    seen = [(view["stamp_ns"] // 10**9, view["frame_id"]) for view in views]
    assert seen[:4] == [(1, "left"), (1, "right"), (2, "left"), (2, "right")]
    page = (tmp_path / "out/report.html").read_text()
    assert "Against the ground truth, " not in page, "one pose a stamp is one camera's"

    replay(tmp_path / "both", tmp_path / "out", topics=topics[:1], estimator=fake_estimator(truth))
    page = (tmp_path / "out/report.html").read_text()
    assert ("Against the ground truth, " in page) != truth_of_both


def with_camera_poses(record: Record) -> Iterable[Record]:
    """The true poses once more, as the robot's own."""
    yield record
    if record.topic == "/ground_truth/pose":
        yield record._replace(topic="/camera_pose")


def test_the_robots_camera_poses_reach_the_estimator(
    tmp_path: Path, capture: Capture, rewrite: Rewrite, fake_estimator: Fake
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "plain")
    rewrite(tmp_path / "plain", tmp_path / "bag", with_camera_poses)
    inner = fake_estimator(truth)

    class Metric:
        def estimate(self, scan: Any) -> Any:
            if len(scan.views) < 3:
                return inner.estimate(scan)
            pose = ObjectPose("world", so3.exp([0, 0, 0.5]), np.array([0.3, 0.2, 0.1]), np.diag([1.0] * 6))
            metric = inner.estimate(scan)
            return replace(metric, scale_known=True, scale_deviation=0.05, object_pose=pose)

    replay(tmp_path / "bag", tmp_path / "out", estimator=Metric())
    last = inner.scans[-1]
    assert [pose.frame_id for pose in last.robot_poses] == ["capture_world"] * 5
    for pose, true in zip(last.robot_poses, truth, strict=True):
        np.testing.assert_allclose(pose.robot_from_camera, true.world_from_camera, atol=1e-9)
        np.testing.assert_allclose(pose.position, true.centre, atol=1e-9)

    told = json.loads((tmp_path / "out/scan.json").read_text())["estimates"]
    assert told[0]["object_pose"] is None
    assert (told[-1]["scale_known"], told[-1]["scale_deviation"]) == (True, 0.05)
    assert told[-1]["object_pose"]["frame_id"] == "world"
    assert told[-1]["object_pose"]["position"] == [0.3, 0.2, 0.1]
    assert len(told[-1]["object_pose"]["covariance"]) == 36
    sent = records(tmp_path / "out/estimates")[-3].message
    assert sent.object_pose.header.frame_id == "world"
    assert sent.object_pose.pose.pose.position.x == 0.3
    assert "Positions are in metres, their scale to 5 %." in (tmp_path / "out/report.html").read_text()


def test_camera_poses_of_no_view_are_told(
    tmp_path: Path,
    capture: Capture,
    rewrite: Rewrite,
    fake_estimator: Fake,
    caplog: pytest.LogCaptureFixture,
) -> None:
    folder, truth = capture
    pack(folder, tmp_path / "plain")

    def late(record: Record) -> Iterable[Record]:
        for each in with_camera_poses(record):
            if each.topic == "/camera_pose":
                changed = copy.deepcopy(each.message)
                changed.header.stamp.nanosec = 1
                yield each._replace(message=changed)
            else:
                yield each

    rewrite(tmp_path / "plain", tmp_path / "bag", late)
    with caplog.at_level(logging.WARNING, "relpose_ros"):
        replay(tmp_path / "bag", tmp_path / "out", estimator=fake_estimator(truth))
    assert "None of the 5 camera poses on /camera_pose has the stamp of a view" in caplog.text
