"""What a folder holds is found out by what lies in it."""

import numpy as np
import pytest

from relpose_ros.captures.folder import CaptureError, Frame, save_capture
from relpose_ros.captures.opening import open_captures
from relpose_ros.views import BoundingBox, View


def names(folder, *split):
    return [capture.name for capture in open_captures(folder, *split)]


def test_a_capture_folder_is_itself_and_a_folder_of_such_is_all_of_them(tmp_path):
    view = View(np.zeros((20, 30, 3), np.uint8), BoundingBox(2, 2, 18, 18), 30, 20)
    save_capture(tmp_path / "cup", [Frame(view)])
    save_capture(tmp_path / "axe", [Frame(view)])
    assert names(tmp_path / "cup") == ["cup"]
    assert names(tmp_path) == ["axe", "cup"]


def test_a_category_gives_its_sequences_and_the_dataset_those_of_a_split(
    tmp_path, write_category, monkeypatch
):
    write_category(tmp_path, "kite", ["110_1_2", "100_3_4"])
    write_category(tmp_path, "ball", ["7_8_9"])
    write_category(tmp_path, "cup", ["5_5_5"])
    assert names(tmp_path / "kite") == ["100_3_4", "110_1_2"]
    assert names(tmp_path) == ["7_8_9", "100_3_4", "110_1_2"]
    assert names(tmp_path, "train") == ["5_5_5"]
    monkeypatch.chdir(tmp_path / "cup")
    assert names(type(tmp_path)(".")) == ["5_5_5"]


def test_what_is_nothing_of_the_kind_is_refused_in_a_sentence(tmp_path, write_category):
    with pytest.raises(CaptureError, match="does not exist; a capture is a folder"):
        names(tmp_path / "missing")
    with pytest.raises(
        CaptureError, match=r"neither a capture, which has cameras\.json, nor a folder of such, nor"
    ):
        names(tmp_path)
    write_category(tmp_path, "cup", ["5_5_5"], frames=1)
    with pytest.raises(CaptureError, match="holds no sequence with two frames"):
        names(tmp_path / "cup")
    with pytest.raises(CaptureError, match="holds no sequence of the split 'held_out'"):
        names(tmp_path)
