from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from relpose_ros.estimates import Verdict
from relpose_ros.replay.recording import Recording


def with_verdicts(letters: str) -> Recording:
    """A recording whose estimates said enough where the letter is E."""
    verdicts = [Verdict.ENOUGH if letter == "E" else Verdict.ONE_MORE_VIEW for letter in letters]
    made: list[Any] = [SimpleNamespace(estimate=SimpleNamespace(verdict=verdict)) for verdict in verdicts]
    return Recording("mug", estimates=made)


@pytest.mark.parametrize(
    ("verdicts", "said"),
    [
        ("..E..", "estimate 3 of 5"),
        (".EEE.", "estimates 2 to 4 of 5"),
        ("EE.E.EEE.", "estimates 1 to 2, 4, 6 to 8 of 9"),
    ],
)
def test_an_enough_that_is_lost_is_told(verdicts: str, said: str) -> None:
    words = with_verdicts(verdicts).lost_enough()
    assert words == f"{said} said enough, the last does not: a planner stops at the first"


@pytest.mark.parametrize("verdicts", ["...", "..E", "E.EE"])
def test_an_enough_that_stands_or_never_was_is_none_that_is_lost(verdicts: str) -> None:
    assert with_verdicts(verdicts).lost_enough() == ""
