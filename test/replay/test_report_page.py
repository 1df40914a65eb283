"""The page's script, in a real browser where there is one."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from relpose_ros.replay.pack import pack
from relpose_ros.replay.replay import replay

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from relpose_ros.estimates import PairRotation, ScanEstimate
    from relpose_ros.views import Scan

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--disable-sync",
    "--disable-background-networking", "--disable-component-update", "--window-size=1200,1000",
    "--virtual-time-budget=30000", "--dump-dom",
)  # fmt: skip

DRIVER = """
<script>
addEventListener("error", event => found.errors.push(event.message));
const found = {errors: []};
const pause = time => new Promise(done => setTimeout(done, time));
const press = key => $("scene").dispatchEvent(new KeyboardEvent("keydown", {key, cancelable: true}));
const where = () => [eye.azimuth, eye.elevation, eye.distance];
const picture = () => {  // without waiting for frames, which are the browser's to give
  for (let k = 0; k < 80; k++) advance();
  return $("scene").toDataURL();
};
const column = k => {
  document.querySelectorAll("#heads button")[k].click();
  const cells = [...$("rows").children].map(row => row.children[k].textContent);
  return [$("heads").children[k].ariaSort, ...cells];
};
(async () => {
  await pause(500);
  found.home = where();
  for (const key of ["ArrowLeft", "ArrowUp", "+"]) press(key);
  found.turned = where();
  $("scene").dispatchEvent(new WheelEvent("wheel", {deltaY: 100, cancelable: true}));
  found.scrolled = where();
  $("scene").dispatchEvent(new WheelEvent("wheel", {deltaY: 100, ctrlKey: true, cancelable: true}));
  found.zoomed = where();
  $("scene").dispatchEvent(new MouseEvent("dblclick"));
  found.back = where();
  found.boxes = ["show-truth", "show-spread", "show-trails"].map(id => $(id).checked);
  const plain = picture();
  $("show-spread").click();
  found.spread_drawn = plain !== picture();
  const bare = picture();
  $("show-trails").click();
  found.trails_drawn = bare !== picture();
  const frame = viewpoint(canvas.clientWidth, canvas.clientHeight);
  found.trails_inside = trails.map(point => project(frame, point)).every(
    ([x, y]) => x > 0 && y > 0 && x < canvas.clientWidth && y < canvas.clientHeight);
  const told = new Set();
  $("play").click();
  for (let k = 0; k < 60; k++) { told.add($("step-name").textContent); await pause(100); }
  found.played = [...told];
  found.playing = $("play").textContent;
  $("step").value = 1; $("step").dispatchEvent(new Event("input"));
  found.slid = $("step-name").textContent;
  const before = picture(), again = picture();
  $("show-truth").click();
  found.drawings = [before === again, before === picture()];
  found.columns = [...$("heads").children].map((_, k) => [column(k), column(k)]);
  found.cards = [...$("pairs").children].map(
    card => [card.querySelector(".flag")?.textContent ?? "", card.querySelector(".meter").textContent]);
  found.heads = [...$("heads").children].map(head => head.textContent);
  found.lead = $("pairs-lead").textContent;
  $("rows").children[0].click();
  found.chosen = [chosen, document.querySelectorAll(".chosen").length, step];
  document.title = JSON.stringify(found);
})().catch(error => { document.title = JSON.stringify({errors: [String(error)]}); });
</script>
"""


pytestmark = pytest.mark.skipif(BROWSER is None, reason="there is no Chromium or Chrome on this machine")


def driven(tmp_path: Path, folder: Path, estimator: Any) -> Any:
    """What the driver finds on the page of a replay."""
    pack(folder, tmp_path / "bag")
    replay(tmp_path / "bag", tmp_path / "out", estimator=estimator)
    page = tmp_path / "driven.html"
    text = (tmp_path / "out/report.html").read_text(encoding="utf-8")
    page.write_text(text.replace("</body>", f"{DRIVER}</body>"), encoding="utf-8")
    command = [str(BROWSER), *FLAGS, f"--user-data-dir={tmp_path / 'profile'}", page.as_uri()]
    shown = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False).stdout
    titled = re.search("<title>(.*?)</title>", shown)
    assert titled is not None, shown[:1000]
    found = json.loads(titled[1].replace("&amp;", "&").replace("&lt;", "<").replace("&gt;", ">"))
    assert found["errors"] == []
    return found


def test_the_page_can_be_turned_played_and_sorted(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]
) -> None:
    folder, truth = capture
    found = driven(tmp_path, folder, fake_estimator(truth, error_deg=20))
    azimuth, elevation, distance = found["home"]
    assert found["turned"][0] > azimuth
    assert found["turned"][1] > elevation
    assert found["turned"][2] < distance
    assert found["scrolled"] == found["turned"], "scrolling is the page's"
    assert found["zoomed"][2] > found["turned"][2]
    assert found["back"] == found["home"]
    names = [f"{k + 1} of 4: {k + 2} views" for k in range(4)]
    assert found["played"] == names
    assert found["playing"] == "Play"
    assert found["slid"] == names[1]
    assert found["drawings"] == [True, False], "without the ground truth it is another one"
    pairs, sure, _, ambiguous, rests_on, *_ = found["columns"]
    assert pairs[0][:3] == ["ascending", "0 1", "0 2"]
    assert pairs[1] == ["descending", *pairs[0][:0:-1]]
    assert sorted(sure[0]) == sorted([*sure[1][1:], "ascending"])
    assert ambiguous[0][:2] == ["descending", "by 180°"], "what is wrong comes first"
    assert (ambiguous[1][0], ambiguous[1][-1]) == ("ascending", "by 180°")
    assert rests_on[0][1] == "the network and matches"
    assert rests_on[1][:2] == ["ascending", "the network alone"]
    assert found["boxes"] == [True, True, False], "the truth and the uncertainty, without earlier estimates"
    name, marked, step = found["chosen"]
    assert re.fullmatch(r"\d-\d", name)
    assert (marked, step) == (2, 3), "a card and a row, of the last estimate"


class Wandering:
    """Its first estimate has all cameras twice as far away; its pairs are those that ``change`` makes."""

    def __init__(self, inner: Any, change: Callable[[PairRotation], PairRotation]) -> None:
        self.inner, self.change = inner, change

    def estimate(self, scan: Scan) -> ScanEstimate:
        made = self.inner.estimate(scan)
        far = 2.0 if len(scan.views) == 2 else 1.0
        cameras = tuple(
            replace(camera, position=far * camera.position, covariance=0.02 * np.eye(6))
            for camera in made.cameras
        )
        return replace(made, cameras=cameras, pairs=tuple(self.change(pair) for pair in made.pairs))


def test_sure_pairs_come_first_and_earlier_estimates_stay_in_sight(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]
) -> None:
    folder, truth = capture
    sure = {(2, 3): 0.3, (1, 2): 0.95, (0, 2): 0.45}

    def changed(pair: PairRotation) -> PairRotation:
        return replace(pair, probability_within_15_deg=sure.get((pair.i, pair.j), 0.8))

    found = driven(tmp_path, folder, Wandering(fake_estimator(truth), changed))
    flags = [flag for flag, _ in found["cards"]]
    assert flags == [*[""] * 7, "ambiguous, 180°", "weak", "weak"]
    assert [part for _, part in found["cards"]] == [
        *("sure95 %", *["sure80 %"] * 6),
        *("sure80 %", "sure45 %", "sure30 %"),
    ]
    assert "; ambiguous, one that has" in found["lead"]
    assert found["spread_drawn"]
    assert (found["trails_drawn"], found["trails_inside"]) == (True, True)


def test_nothing_is_said_of_ambiguity_where_no_pair_is_ambiguous(
    tmp_path: Path, capture: Any, fake_estimator: Callable[..., Any]
) -> None:
    folder, truth = capture

    def changed(pair: PairRotation) -> PairRotation:
        return replace(pair, ambiguous=False, ambiguity_angle=0.0)

    found = driven(tmp_path, folder, Wandering(fake_estimator(truth), changed))
    assert "ambiguous" not in found["lead"]
    assert "ambiguous" not in found["heads"]
    assert {flag for flag, _ in found["cards"]} == {""}
