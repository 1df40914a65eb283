"""A calibration as it is kept with the weights."""

from __future__ import annotations

from dataclasses import replace

import pytest

from relpose_ros.inference.calibration import Calibration, CalibrationError


def test_kept_with_the_weights_as_text():
    calibration = Calibration(2.5, 1.1, 0.9, True, (0.1, 0.3), match_trust=(-9.0, 2.0, -3.0, 1.0))
    assert Calibration.from_json(calibration.to_json()) == calibration
    alone = replace(calibration, match_trust=None)
    assert Calibration.from_json(alone.to_json()) == alone
    assert Calibration.from_json('{"temperature": 2.0, "report": {"pairs": 3}}') == Calibration(
        temperature=2.0
    )


@pytest.mark.parametrize(
    "text",
    [
        *("[]", "{}", "{temperature: 1}", '"text"', "null", '{"flat": 0.2}', '{"temperature": "warm"}'),
        *('{"temperature": 0}', '{"temperature": NaN}', '{"temperature": 1, "flat": 1}'),
        *('{"temperature": 1, "position_sigma": 3}', '{"temperature": 1, "position_sigma": [0, 1]}'),
        *('{"temperature": 1, "match_trust": [1, 2]}', '{"temperature": 1, "position_sigma": [0.1]}'),
        *('{"temperature": true}', '{"temperature": 1, "placed_by_boxes": "no"}'),
        *('{"temperature": 1, "position_sigma": [0.1, 0.1, 0.1]}', '{"temperature": 1, "flat": -0.1}'),
        '{"temperature": 1, "match_trust": [1, 2, NaN, 4]}',
    ],
)
def test_what_is_no_calibration_counts_as_none(text):
    with pytest.raises(CalibrationError, match="calibrate anew"):
        Calibration.from_json(text)


def test_what_is_wrong_with_a_calibration_is_named():
    with pytest.raises(CalibrationError, match="has a pair_spread of -2, which is no positive number"):
        Calibration.from_json('{"temperature": 1, "pair_spread": -2}')
