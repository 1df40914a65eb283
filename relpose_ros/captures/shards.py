"""Rendered scans on disk, for a trainer that reads faster than anybody can draw.

A shard is a folder of .npy files with one row per scan, all of them memory-mappable:

    images.npy              (M, N, S, S, 3) uint8, RGB crops
    places.npy              (M, N, S/8, S/8, 3) float16, object coordinates seen at the cells' centres,
                            NaN off the object
    masks.npy               (M, N, S, S/8) uint8, a bit per pixel (numpy.packbits), set on the object
    crop_parameters.npy     (M, N, 3) float32, as the network takes them
    camera_from_object.npy  (M, N, 3, 4) float32, optical; unit: the object's bounding radius
    intrinsics.npy          (M, N, 4) float32, fx, fy, cx, cy of the full image, pixels
    crops.npy               (M, N, 3) float32, left, top, side of the crop in the full image, pixels
    image_sizes.npy         (M, N, 2) int32, width and height of the full image
    complete.npy            (M, N) bool, whether the whole object is in the photograph
    symmetry.npy            (M, 5) float32: kind (0 none, 1 discrete, 2 continuous), order (0 continuous or
                            unknown), axis in the object frame (NaN where unknown)
    motion.npy              (M,) uint8: 0 camera, 1 turntable, 2 handled
    names.npy               (M,) text

Beside them plan.json says how the shard was made. Shard k holds the scans k M to k M + M - 1 of its seed; a
shard that stands in its place is whole.
"""

from __future__ import annotations

import json
import logging
import multiprocessing
import shutil
from collections.abc import Mapping
from concurrent.futures import ProcessPoolExecutor, as_completed
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any, NoReturn

import numpy as np
from tqdm import tqdm

from relpose_ros.captures.assets import load_assets
from relpose_ros.captures.renderer import RenderError
from relpose_ros.captures.scans import PLACE_STRIDE, RenderedScan, ScanRenderer
from relpose_ros.captures.scenes import Motion, ScanStyle
from relpose_ros.errors import RelPoseError

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator
    from pathlib import Path

    import numpy.typing as npt

    Arrays = Mapping[str, npt.NDArray[Any]]
    Plan = Mapping[str, Any]
    """How a shard was made, as JSON keeps it."""


PLAN = "plan.json"
_UNFINISHED = ".unfinished"
_LOG = logging.getLogger(__name__)
_MAX_FRUITLESS = 3
"""So many times in a row all processes may die before a shard is whole."""
_MAX_OPEN = 512
"""Arrays, each with a file: half of what Linux distributions let a process have open."""


class ShardError(RelPoseError):
    """A folder holds no shards, or shards of another kind, or none can be written there."""


@dataclass(frozen=True)
class ShardPlan:
    """What the shards of one folder hold."""

    seed: int = 0
    scans: int = 100
    """Per shard."""
    views: int = 10
    """Per scan: more than a training sample takes, which chooses among them."""
    image_size: int = 128
    assets: Path | None = None
    split: str = "train"
    style: ScanStyle = field(default_factory=ScanStyle)

    def as_json(self) -> dict[str, Any]:
        """What is kept beside the shards."""
        assets = None if self.assets is None else str(self.assets.resolve())
        return {"made": "rendered", **asdict(self), "assets": assets}


def write_shards(folder: Path, count: int, plan: ShardPlan, *, processes: int = 1) -> None:
    """Write shards 0 to count - 1 of a plan; those that stand already are left alone.

    It starts processes: a script calls it under ``if __name__ == "__main__"``.

    Args:
        folder: Gets one sub-folder per shard, ``00000`` and on.
        count: Shards.
        plan: Must be the same when a folder is continued.
        processes: Each opens its own OpenGL context.

    Raises:
        RenderError: There is no OpenGL here, or all that draws dies.
        AssetsError: The assets folder is not one.
        ShardError: Shards of another plan stand there, or none can be written.
    """
    missing = _missing(folder, count, plan)
    with tqdm(total=len(missing), unit="shard", desc=f"{plan.scans * plan.views} images each") as progress:
        fruitless = 0
        while missing:
            done = _write_some(folder, plan, missing, processes, progress)
            fruitless = 0 if done else fruitless + 1
            if fruitless == _MAX_FRUITLESS:
                text = f"the processes that draw shards of {folder} die; the graphics driver may be at fault."
                raise RenderError(text)
            missing = _missing(folder, count, plan)


def _missing(folder: Path, count: int, plan: ShardPlan) -> list[int]:
    made = plan.as_json()
    return [k for k in range(count) if not stands(folder / f"{k:05d}", made)]


def _write_some(
    folder: Path, plan: ShardPlan, numbers: list[int], processes: int, progress: tqdm[NoReturn]
) -> int:
    """Write shards until all stand or a process dies, and return how many."""
    done = 0
    # A forked process would share its parent's OpenGL connection.
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        futures = [pool.submit(_write_shard, folder, plan, number) for number in numbers]
        try:
            for future in as_completed(futures):
                future.result()
                done += 1
                progress.update()
        except BrokenProcessPool:
            # A graphics driver that crashes once in tens of thousands of pictures costs the shard at hand,
            # not the night: what is missing is drawn by new processes.
            _LOG.warning("a process that drew shards of %s died; going on with a new one.", folder)
        except BaseException:
            pool.shutdown(wait=False, cancel_futures=True)
            raise
    return done


def stands(folder: Path, plan: Plan) -> bool:
    """Whether a shard stands in its place, so that it need not be made again.

    Raises:
        ShardError: It does, and was made by another plan, or does not say by which.
    """
    if not folder.exists():
        return False
    made, asked = read_plan(folder), json.loads(json.dumps(plan))
    if made is None:
        text = f"{folder} does not say how it was made, having no {PLAN}: name another folder, or remove it."
        raise ShardError(text)
    for name in {**asked, **made}:
        if made.get(name) != asked.get(name):
            text = (
                f"{folder} was made with {name} {made.get(name)!r}, not {asked.get(name)!r}: "
                "name another folder, or remove that one."
            )
            raise ShardError(text)
    return True


def read_plan(folder: Path) -> dict[str, Any] | None:
    """How a shard was made; None where it does not say."""
    path = folder / PLAN
    if not path.exists():
        return None
    plan: dict[str, Any] = json.loads(path.read_text(encoding="utf-8"))
    return plan


@contextmanager
def new_shard(folder: Path, plan: Plan) -> Iterator[dict[str, npt.NDArray[Any]]]:
    """Arrays to fill, by their names, which stand in their place as a shard when all are whole.

    Raises:
        ShardError: They cannot be written.
    """
    unfinished = folder.with_name(folder.name + _UNFINISHED)
    shutil.rmtree(unfinished, ignore_errors=True)  # of a run that was cut off
    with _written(folder):
        unfinished.mkdir(parents=True)
    arrays: dict[str, npt.NDArray[Any]] = {}
    yield arrays
    with _written(folder):
        (unfinished / PLAN).write_text(json.dumps(plan, indent=1) + "\n", encoding="utf-8")
        for name, array in arrays.items():
            np.save(unfinished / f"{name}.npy", array)
        unfinished.rename(folder)


@contextmanager
def _written(folder: Path) -> Iterator[None]:
    try:
        yield
    except OSError as err:
        text = f"{folder} cannot be written: {err.strerror or err}; make room, or name another place."
        raise ShardError(text) from err


def shard_folders(folders: Iterable[Path]) -> list[Path]:
    """The shards under some folders that are whole, in order of their names."""
    found = {path.parent for folder in folders for path in folder.rglob("camera_from_object.npy")}
    return sorted(path for path in found if path.suffix != _UNFINISHED)


class Shard(Mapping[str, "npt.NDArray[Any]"]):
    """The arrays of one shard by name, each memory-mapped when it is asked for.

    The latest stay open, of all shards together, and no more: with a shard of every sequence of CO3D there
    are more arrays than a system opens at once.
    """

    def __init__(self, folder: Path) -> None:
        """Look at the names alone."""
        self._folder = folder
        self._names = sorted(path.stem for path in folder.glob("*.npy"))

    def __getitem__(self, name: str) -> npt.NDArray[Any]:
        """An array, opened now."""
        if name not in self._names:
            raise KeyError(name)
        path = self._folder / f"{name}.npy"
        return _mapped(path, path.stat().st_mtime_ns)

    def __iter__(self) -> Iterator[str]:
        """The names."""
        return iter(self._names)

    def __len__(self) -> int:
        """How many arrays."""
        return len(self._names)


@lru_cache(maxsize=_MAX_OPEN)
def _mapped(path: Path, _written_ns: int) -> npt.NDArray[Any]:
    """An array of a file that was written at a time: another that takes its place is another."""
    array: npt.NDArray[Any] = np.load(path, mmap_mode="r")
    return array


_renderers: dict[ShardPlan, ScanRenderer] = {}
"""One per process: opening a context and reading the assets takes longer than many scans."""


def _write_shard(folder: Path, plan: ShardPlan, number: int) -> None:
    if plan not in _renderers:
        assets = None if plan.assets is None else load_assets(plan.assets, plan.split)
        _renderers[plan] = ScanRenderer(plan.seed, plan.image_size, assets=assets, style=plan.style)
    renderer = _renderers[plan]
    m, n, s, cells = plan.scans, plan.views, plan.image_size, plan.image_size // PLACE_STRIDE
    with new_shard(folder / f"{number:05d}", plan.as_json()) as arrays:
        arrays.update(
            images=np.empty((m, n, s, s, 3), np.uint8),
            places=np.empty((m, n, cells, cells, 3), np.float16),
            masks=np.empty((m, n, s, s // 8), np.uint8),
            crop_parameters=np.empty((m, n, 3), np.float32),
            camera_from_object=np.empty((m, n, 3, 4), np.float32),
            intrinsics=np.empty((m, n, 4), np.float32),
            crops=np.empty((m, n, 3), np.float32),
            image_sizes=np.empty((m, n, 2), np.int32),
            complete=np.empty((m, n), np.bool_),
            symmetry=np.empty((m, 5), np.float32),
            motion=np.empty(m, np.uint8),
            names=np.empty(m, "U64"),
        )
        for row in range(m):
            _fill(arrays, row, renderer.scan(number * m + row, n))


def _fill(arrays: Arrays, row: int, scan: RenderedScan) -> None:
    for name in (
        "images",
        "places",
        "crop_parameters",
        "camera_from_object",
        "intrinsics",
        "crops",
        "image_sizes",
        "complete",
    ):
        arrays[name][row] = getattr(scan, name)
    arrays["masks"][row] = np.packbits(scan.coverage >= 128, axis=-1)
    axis = (np.nan,) * 3 if scan.symmetry.axis is None else scan.symmetry.axis
    arrays["symmetry"][row] = (int(scan.symmetry.kind), scan.symmetry.order, *axis)
    arrays["motion"][row] = list(Motion).index(scan.motion)
    arrays["names"][row] = scan.name
