from __future__ import annotations

import json
import re
from dataclasses import replace
from html.parser import HTMLParser
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from relpose_ros.estimates import Mode, PairRotation, ScanEstimate, Verdict
from relpose_ros.geometry import so3
from relpose_ros.inference.verdict import WITHOUT_ROOM
from relpose_ros.replay.pack import pack
from relpose_ros.replay.recording import PICTURE_SIDE, Recording
from relpose_ros.replay.replay import replay
from relpose_ros.replay.report import Cells, write_report, yaw_pitch_roll
from relpose_ros.scanning.scanner import Result
from relpose_ros.scanning.settings import ScanSettings
from relpose_ros.views import BoundingBox, Distortion, Intrinsics, Scan, View

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def data_of(page: str) -> Any:
    found = re.search(r'<script id="data" type="application/json">(.*?)</script>', page, re.DOTALL)
    assert found is not None
    return json.loads(found[1], parse_constant=pytest.fail)


@pytest.fixture
def page(tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]) -> str:
    folder, truth = capture
    pack(folder, tmp_path / "bag")
    settings = ScanSettings(object_id="<b>mug & cup")
    estimator = fake_estimator(truth, error_deg=20)
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=estimator)
    return (tmp_path / "out/report.html").read_text()


class Links(HTMLParser):
    """Collects everything that a browser would load or follow."""

    def __init__(self) -> None:
        super().__init__()
        self.links: list[str] = []

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag in ("link", "iframe", "base", "object", "embed"):
            self.links.append(tag)
        loading = ("src", "href", "srcset", "action", "data", "xlink:href")
        self.links += [str(value) for name, value in attrs if name in loading]


def test_the_page_needs_nothing_but_itself(page: str) -> None:
    parser = Links()
    parser.feed(page)
    assert parser.links == []
    assert re.findall(r"https?:|//[a-z]+\.|url\(|@import|import\(|fetch\(|XMLHttpRequest", page) == []
    assert "default-src 'none'" in page
    assert "{{" not in page


def test_the_page_says_in_words_what_came_out(page: str) -> None:
    assert "Enough to act on" in page
    assert "5 views were used; the last of 4 estimates rests on 5." in page
    # Cameras 1 to 4 are turned by the same 20 degrees about their own axes, the first is not.
    assert "of 10 relative rotations are right to 15°" in page
    assert "&lt;b&gt;mug &amp; cup in bag" in page
    assert "<b>mug" not in page


@pytest.mark.parametrize(
    ("max_views", "heading"),
    [(8, '<div class="verdict more"'), (3, '<div class="verdict short"')],
)
def test_the_heading_asks_for_a_view_only_where_there_is_room(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any], max_views: int, heading: str
) -> None:
    folder, truth = capture
    inner = fake_estimator(truth)

    class Doubting:
        def estimate(self, scan: Scan) -> ScanEstimate:
            words = "one more view: pair 0-1 says hardly anything"
            return replace(inner.estimate(scan), verdict=Verdict.ONE_MORE_VIEW, status=words)

    pack(folder, tmp_path / "bag")
    settings = ScanSettings(max_views=max_views, keep="spread")
    replay(tmp_path / "bag", tmp_path / "out", settings=settings, estimator=Doubting())
    page = (tmp_path / "out/report.html").read_text()
    assert heading in page
    has_room = max_views > 5
    assert ("One more view needed" in page, "Not enough yet" in page) == (has_room, not has_room)
    advice = f"; {WITHOUT_ROOM['spread']}."
    assert f"<p>Pair 0-1 says hardly anything{'.' if has_room else advice}</p>" in page


def test_what_is_drawn_is_what_was_estimated(page: str) -> None:
    data = data_of(page)
    assert len(data["views"]) == 5
    assert [len(step["cameras"]) for step in data["steps"]] == [2, 3, 4, 5]
    assert data["colours"][0] == "#ff0000"
    assert data["colours"][7] == "#ff00ff"
    last = data["steps"][-1]
    errors = {(pair["i"], pair["j"]): pair["error"] for pair in last["pairs"]}
    assert all(errors[0, j] == pytest.approx(20, abs=1e-3) for j in range(1, 5))
    assert max(last["centres"].values()) == pytest.approx(0, abs=1e-5)
    for view, pose in last["truth"].items():
        assert pose["p"] == pytest.approx(last["cameras"][int(view)]["p"], abs=1e-4)
    ambiguous = [pair for pair in last["pairs"] if pair["ambiguous"] is not None]
    assert [(pair["i"], pair["j"], pair["ambiguous"]) for pair in ambiguous] == [(0, 1, 180)]
    assert [(pair["i"], pair["j"]) for pair in last["pairs"] if not pair["matched"]] == [(0, 1)]
    points = np.array(data["distributions"][0]["points"])
    assert points[:, 3].sum() == pytest.approx(0.95, abs=0.01)


angle = st.floats(-179, 179)


@given(angle, st.floats(-85, 85), angle)
def test_yaw_pitch_and_roll_recompose(yaw: float, pitch: float, roll: float) -> None:
    y, p, r = np.radians([yaw, pitch, roll])
    camera_i_from_camera_j = so3.exp([0, y, 0]) @ so3.exp([p, 0, 0]) @ so3.exp([0, 0, r])
    np.testing.assert_allclose(yaw_pitch_roll(camera_i_from_camera_j.T), [yaw, pitch, roll], atol=1e-6)


def test_yaw_pitch_and_roll_have_the_signs_that_the_page_tells() -> None:
    """Optical axes: x right, y down, z forward."""
    looks_right = np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]])  # its z is the other's x
    looks_up = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])  # its z is the other's -y
    clockwise = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # its right is the other's down
    assert yaw_pitch_roll(looks_right.T) == pytest.approx([90, 0, 0])
    assert yaw_pitch_roll(looks_up.T)[1] == pytest.approx(90)
    assert yaw_pitch_roll(clockwise.T) == pytest.approx([0, 0, 90])


def one_recording(fake_estimator: Callable[..., Any], truth: Any) -> Recording:
    views = tuple(
        View(np.zeros((8, 8, 3), np.uint8), BoundingBox(1, 1, 7, 7), 8, 8, stamp_ns=k * 10**9) for k in (1, 2)
    )
    recording = Recording("mug")
    scan = Scan("mug", views)
    for _ in range(3):
        recording.add(Result(scan, fake_estimator(truth).estimate(scan)), 5)
    return recording


def test_a_given_distribution_is_drawn_as_it_is(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]
) -> None:
    rotations = so3.exp(np.radians([[0, 30, 0], [0, 0, 40], [0, 5, 0]]))
    cells = {(0, 1): Cells(rotations.transpose(0, 2, 1), np.array([0.2, 0.79995, 0.00005]))}
    write_report(
        tmp_path / "page.html", one_recording(fake_estimator, capture[1]), {}, [("why", 3)], "bag", cells
    )
    data = data_of((tmp_path / "page.html").read_text())
    assert data["sampled"] is False
    np.testing.assert_allclose(
        data["distributions"][0]["points"], [[0, 0, 40, 0.8], [30, 0, 0, 0.2]], atol=1e-3
    )
    assert data["rejected"] == [["why", 3]]
    assert "truth" not in data["steps"][0]


def test_many_estimates_are_thinned(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("relpose_ros.replay.report.MAX_STEPS", 2)
    write_report(tmp_path / "page.html", one_recording(fake_estimator, capture[1]), {}, [], "bag")
    data = data_of((tmp_path / "page.html").read_text())
    assert (len(data["steps"]), data["thinned"]) == (2, 1)


def test_a_flat_covariance_can_be_drawn(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]
) -> None:
    recording = one_recording(fake_estimator, capture[1])
    estimate = recording.estimates[-1].estimate
    pair = estimate.pairs[0]
    certain = PairRotation(
        **{**vars(pair), "modes": (Mode(pair.camera_j_from_camera_i, 1.0, np.zeros((3, 3))),)}
    )
    object.__setattr__(estimate, "pairs", (certain,))
    write_report(tmp_path / "page.html", recording, {}, [], "bag")
    points = np.array(data_of((tmp_path / "page.html").read_text())["distributions"][0]["points"])
    assert np.ptp(points[:, :3], axis=0) == pytest.approx(0, abs=1e-3)


@pytest.mark.parametrize(
    ("k1", "expected"),
    [
        # Of (x, y) = (-0.4, -0.3) and (0.1, 0.2) on the bent image, by x (1 + k1 r^2) solved by hand.
        (0.2, [(-0.38251, -0.28688), (0.09903, 0.19806)]),
        (-40.0, [(-0.4, -0.3), (0.1, 0.2)]),  # no ray is bent there: as if there were no lens
    ],
)
def test_the_corners_of_a_picture_are_as_they_were_before_the_lens(k1: float, expected: list) -> None:
    lens = Distortion((k1, 0.0, 0.0, 0.0))
    size = 100 / 2.3  # its picture is 50 pixels wide, from 60 and 70 on
    box = BoundingBox(85 - size / 2, 95 - size / 2, 85 + size / 2, 95 + size / 2)
    view = View(
        np.zeros((200, 200, 3), np.uint8),
        box,
        200,
        200,
        intrinsics=Intrinsics(100, 100, 100, 100),
        distortion=lens,
    )
    recording = Recording("mug")
    recording.add(Result(Scan("mug", (view,)), object()), 0)  # type: ignore[arg-type]
    corners = recording.views[0].corners
    np.testing.assert_allclose(corners[[0, 2]], expected, atol=1e-5)


def test_a_picture_shows_the_square_about_the_box() -> None:
    image = np.zeros((100, 200, 3), np.uint8)
    image[:, 100:] = (255, 0, 0)
    recording = Recording("mug")
    box = BoundingBox(80, 0, 120, 40)
    intrinsics = Intrinsics(100, 100, 100, 50)
    views = (
        View(image, box, 200, 100, intrinsics=intrinsics),
        View(image[:60, 70:150], box, 200, 100, origin=(70, 0), intrinsics=intrinsics),
    )

    class NoEstimate:
        pass

    recording.add(Result(Scan("mug", views), NoEstimate()), 0)  # type: ignore[arg-type]
    pictures = []
    for record in recording.views:
        assert record.view.image.size == 0
        # The square is 46 wide about (100, 20): 77 to 123, -3 to 43.
        corners = [[-0.23, -0.53], [0.23, -0.53], [0.23, -0.07], [-0.23, -0.07]]
        np.testing.assert_allclose(record.corners, corners)
        picture = cv2.imdecode(np.frombuffer(record.picture, np.uint8), cv2.IMREAD_COLOR)
        assert picture.shape == (PICTURE_SIDE, PICTURE_SIDE, 3)
        blue, green, red = picture[PICTURE_SIDE // 2].astype(int).T
        assert red[: PICTURE_SIDE // 2 - 8].max() < 20
        assert red[PICTURE_SIDE // 2 + 8 :].min() > 235
        assert abs(picture[2].astype(int) - 128).max() < 40
        assert max(blue.max(), green.max()) < 60
        pictures.append(record.picture)
    # A crop of the image shows the same, pixel for pixel.
    assert pictures[0] == pictures[1]
