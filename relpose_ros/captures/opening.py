"""Captures of whatever kind a folder holds: one of our own, several, or CO3Dv2."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

from relpose_ros.captures.co3d import (
    FRAME_ANNOTATIONS,
    HELD_OUT_CATEGORIES,
    TRAINING_CATEGORIES,
    load_category,
)
from relpose_ros.captures.folder import LISTING, CaptureError, load_capture

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from relpose_ros.captures.folder import Capture

Split = Literal["held_out", "train"]


def open_captures(folder: Path, split: Split = "held_out") -> Iterator[Capture]:
    """Every capture of a folder, in order of the names.

    Args:
        folder: A capture folder or a folder of such, a category of CO3Dv2, or the folder of all categories.
        split: Which of these are meant then, where they are there.

    Raises:
        CaptureError: It is none of them, nothing in it can be used, or it cannot be read.
    """
    if not folder.is_dir() or (folder / LISTING).exists():
        yield load_capture(folder)
        return
    if inside := sorted(each.parent for each in folder.glob(f"*/{LISTING}")):
        yield from map(load_capture, inside)
        return
    if (folder / FRAME_ANNOTATIONS).exists():
        categories = [folder.resolve()]
    else:
        names = HELD_OUT_CATEGORIES if split == "held_out" else TRAINING_CATEGORIES
        here = [each.parent for each in sorted(folder.resolve().glob(f"*/{FRAME_ANNOTATIONS}"))]
        if not here:
            text = (
                f"{folder} is neither a capture, which has {LISTING}, nor a folder of such, nor a category "
                f"or the folder of all categories of CO3Dv2, which have {FRAME_ANNOTATIONS}."
            )
            raise CaptureError(text)
        categories = [each for each in here if each.name in names]
    found = False
    for category in categories:
        for capture in load_category(category.parent, category.name):
            found = True
            yield capture
    if not found:
        whose = "" if len(categories) == 1 else f" of the split '{split}'"
        text = f"{folder} holds no sequence{whose} with two frames whose camera and object are known."
        raise CaptureError(text)
