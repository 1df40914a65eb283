"""Checkpoints in pieces, so that they pass through stores that refuse large files."""

from __future__ import annotations

import hashlib
import io
import json
import os
from typing import TYPE_CHECKING, Any

import torch

from relpose_ros.training.settings import TrainingError

if TYPE_CHECKING:
    from pathlib import Path

    State = dict[str, Any]

PIECE_BYTES = 16 * 2**20
LISTING = "checkpoint.json"
"""Names the pieces; a run that has one goes on with it."""


def save_pieces(state: State, folder: Path, piece_bytes: int = PIECE_BYTES) -> None:
    """Write a checkpoint as files of limited size; the listing, written last, makes it the current one."""
    buffer = io.BytesIO()
    torch.save(state, buffer)
    content = buffer.getvalue()
    digest = hashlib.sha256(content).hexdigest()
    names = []
    for number, start in enumerate(range(0, len(content), piece_bytes)):
        names.append(f"checkpoint-{digest[:12]}.{number:03d}")
        (folder / names[-1]).write_bytes(content[start : start + piece_bytes])
    listing = folder / LISTING
    partial = listing.with_suffix(".partial")
    partial.write_text(json.dumps({"pieces": names, "sha256": digest}) + "\n", encoding="utf-8")
    os.replace(partial, listing)  # noqa: PTH105 - a rename within one folder is all or nothing
    for old in folder.glob("checkpoint-*.[0-9][0-9][0-9]"):
        if old.name not in names:
            old.unlink()


def load_pieces(folder: Path) -> State:
    """Read what `save_pieces` wrote.

    Raises:
        TrainingError: A piece is missing or damaged.
    """
    try:
        listing = json.loads((folder / LISTING).read_text(encoding="utf-8"))
        content = b"".join((folder / name).read_bytes() for name in listing["pieces"])
    except (OSError, ValueError, KeyError) as err:
        text = f"the checkpoint in {folder} cannot be read: {err}."
        raise TrainingError(text) from err
    if hashlib.sha256(content).hexdigest() != listing["sha256"]:
        text = f"the checkpoint in {folder} is damaged: its pieces do not have the digest in {LISTING}."
        raise TrainingError(text)
    state: State = torch.load(io.BytesIO(content), map_location="cpu", weights_only=True)
    return state
