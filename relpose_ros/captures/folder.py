"""A capture: photographs of one object in a folder, with boxes and, where known, cameras and masks.

``cameras.json`` lists the images; ``images/`` and ``masks/`` hold them. Coordinates are those of
``relpose_ros.views`` (corner convention), cameras are optical (x right, y down, z forward) and
``camera_from_world`` is in a world frame and scale of the capture's own.
"""

from __future__ import annotations

import json
import math
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from relpose_ros.errors import RelPoseError
from relpose_ros.views import BoundingBox, Intrinsics, View

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy.typing as npt

    from relpose_ros.estimates import FloatArray

LISTING = "cameras.json"
CONVENTION = "OpenCV: x right, y down, z forward; camera_from_world"
ROTATION_TOLERANCE = 1e-3
"""Files hold poses rounded to a few digits: how far R R^T may be from the identity."""


class CaptureError(RelPoseError):
    """A capture folder cannot be read or written."""


@dataclass(frozen=True, eq=False)
class Photo:
    """One image of a capture, not yet read."""

    file: Path
    """The image, JPEG or PNG."""
    mask: Path | None
    """8 bit, 255 on the object, the image's size; None where nobody segmented it."""
    width: int
    height: int
    """Pixels."""
    box: BoundingBox
    intrinsics: Intrinsics | None
    camera_from_world: FloatArray | None
    """(3, 4), rotation and translation; None where the pose is unknown."""
    complete: bool
    """False when the object is cut by the image border."""
    source: str
    """File name at the source, for attribution."""

    def read_image(self) -> npt.NDArray[np.uint8]:
        """Return the (H, W, 3) RGB pixels.

        Raises:
            CaptureError: The file is no image, or not of the size that cameras.json says.
        """
        import cv2

        pixels = _read_pixels(self.file, cv2.IMREAD_COLOR, (self.height, self.width))
        return np.ascontiguousarray(pixels[..., ::-1])

    def read_mask(self) -> npt.NDArray[np.bool_] | None:
        """Return the (H, W) mask, True on the object, or None.

        Raises:
            CaptureError: The file is no image, or not of the photo's size.
        """
        if self.mask is None:
            return None
        import cv2

        mask: npt.NDArray[np.bool_] = (
            _read_pixels(self.mask, cv2.IMREAD_GRAYSCALE, (self.height, self.width)) >= 128
        )
        return mask


@dataclass(frozen=True, eq=False)
class Capture:
    """All photos of one object, in the file's order."""

    folder: Path
    photos: tuple[Photo, ...]

    @property
    def name(self) -> str:
        """The folder's name: the object's id."""
        return self.folder.name

    def view(self, k: int, *, masked: bool = True) -> View:
        """Read photo ``k`` as a view (stamp 0: a capture knows no time).

        Args:
            k: Position in ``photos``.
            masked: Whether to read the mask too, where there is one.

        Raises:
            CaptureError: The image or its mask cannot be read.
        """
        photo = self.photos[k]
        return View(
            image=photo.read_image(),
            box=photo.box,
            full_width=photo.width,
            full_height=photo.height,
            intrinsics=photo.intrinsics,
            mask=photo.read_mask() if masked else None,
        )


@dataclass(frozen=True, eq=False)
class Frame:
    """What a writer knows of one photo: the whole image as a view, and where its camera stood."""

    view: View
    """``origin`` (0, 0) and the full image; stamp and frame are not kept."""
    camera_from_world: FloatArray | None = None
    """(3, 4)."""
    complete: bool = True
    source: str = ""


def load_capture(folder: Path) -> Capture:
    """Read a capture's list of photos; the images stay on disk until asked for.

    Raises:
        CaptureError: The folder or an entry of its cameras.json is missing or makes no sense.
    """
    folder = Path(folder)
    listing = folder / LISTING
    if not folder.is_dir():
        what = "is no folder" if folder.exists() else "does not exist"
        text = f"{folder} {what}; a capture is a folder with cameras.json and images/."
        raise CaptureError(text)
    try:
        content = json.loads(listing.read_text(encoding="utf-8"))
    except FileNotFoundError as err:
        example = '{"file": "images/000.jpg", "width": 960, "height": 640, "box": [x0, y0, x1, y1]}'
        text = (
            f"{folder} holds no cameras.json, which lists a capture's images and boxes; at the least "
            f'{{"images": [{example}, ...]}}.'
        )
        raise CaptureError(text) from err
    except (OSError, ValueError) as err:
        text = f"{listing} cannot be read as JSON: {err}."
        raise CaptureError(text) from err
    if not isinstance(content, dict) or not isinstance(content.get("images"), list):
        text = f"{listing} has no list called 'images'."
        raise CaptureError(text)
    convention = content.get("convention", CONVENTION)
    if convention != CONVENTION:
        text = f"{listing} has the convention {convention!r}; only {CONVENTION!r} is read."
        raise CaptureError(text)
    if not content["images"]:
        text = f"{listing} lists no images."
        raise CaptureError(text)
    return Capture(
        folder=folder.resolve(),
        photos=tuple(
            _photo(folder.resolve(), entry, f"image {k} of {listing}")
            for k, entry in enumerate(content["images"])
        ),
    )


def save_capture(folder: Path, frames: Iterable[Frame], *, jpeg_quality: int = 95) -> Capture:
    """Write frames as a capture folder and return it as loaded.

    Args:
        folder: Created; must not hold a capture already.
        frames: Consumed one by one, so that a generator of many images needs little memory.
        jpeg_quality: 1 to 100.

    Raises:
        CaptureError: The folder holds a capture already, or a frame is not a whole image.
    """
    import cv2

    folder = Path(folder)
    listing = folder / LISTING
    if listing.exists():
        text = f"{folder} holds a capture already; name another folder or remove it."
        raise CaptureError(text)
    (folder / "images").mkdir(parents=True, exist_ok=True)
    entries: list[dict[str, Any]] = []
    for k, frame in enumerate(frames):
        view = frame.view
        if view.image.shape != (view.full_height, view.full_width, 3):
            text = (
                f"frame {k} has pixels of shape {view.image.shape}, not the whole image of "
                f"{view.full_width} x {view.full_height}; a capture holds whole images."
            )
            raise CaptureError(text)
        _write_pixels(
            folder / f"images/{k:03d}.jpg", view.image[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, jpeg_quality]
        )
        if view.mask is not None:
            (folder / "masks").mkdir(exist_ok=True)
            _write_pixels(folder / f"masks/{k:03d}.png", view.mask.astype(np.uint8) * 255, [])
        entries.append(_entry(f"images/{k:03d}.jpg", frame))
    # One image a line, so that a person can read the file and a diff shows what changed.
    lines = ",\n".join(f"  {json.dumps(entry)}" for entry in entries)
    listing.write_text(
        f'{{"convention": {json.dumps(CONVENTION)}, "images": [\n{lines}\n]}}\n', encoding="utf-8"
    )
    return load_capture(folder)


def _entry(file: str, frame: Frame) -> dict[str, Any]:
    view = frame.view
    entry: dict[str, Any] = {
        "file": file,
        "source": frame.source or Path(file).name,
        "width": view.full_width,
        "height": view.full_height,
    }
    if view.intrinsics is not None:
        for name in ("fx", "fy", "cx", "cy"):
            entry[name] = round(float(getattr(view.intrinsics, name)), 6)
    if frame.camera_from_world is not None:
        entry["camera_from_world"] = np.asarray(frame.camera_from_world, dtype=np.float64).round(9).tolist()
    entry["box"] = [round(float(edge), 3) for edge in (view.box.x0, view.box.y0, view.box.x1, view.box.y1)]
    entry["complete"] = frame.complete
    return entry


def _photo(folder: Path, entry: object, where: str) -> Photo:
    if not isinstance(entry, dict):
        text = f"{where} is {entry!r}, not an object with 'file', 'width', 'height' and 'box'."
        raise CaptureError(text)
    if missing := [key for key in ("file", "width", "height", "box") if key not in entry]:
        text = f"{where} has no {missing[0]!r}."
        raise CaptureError(text)
    file = (folder / str(entry["file"])).resolve()
    if not file.is_relative_to(folder):
        text = f"{where} names {entry['file']!r}, outside the capture's folder."
        raise CaptureError(text)
    if not file.is_file():
        text = f"{where} names {entry['file']!r}, which is not in the folder."
        raise CaptureError(text)
    width, height = _numbers(entry, ("width", "height"), where)
    if min(width, height) < 1 or not width.is_integer() or not height.is_integer():
        text = f"{where} has the size {entry['width']} x {entry['height']}; both must be whole and positive."
        raise CaptureError(text)
    mask = folder / "masks" / f"{file.stem}.png"
    return Photo(
        file=file,
        mask=mask if mask.is_file() else None,
        width=int(width),
        height=int(height),
        box=_box(entry["box"], width, height, where),
        intrinsics=_intrinsics(entry, where),
        camera_from_world=_camera_from_world(entry, where),
        complete=bool(entry.get("complete", True)),
        source=str(entry.get("source", file.name)),
    )


def _box(value: object, width: float, height: float, where: str) -> BoundingBox:
    edges = _array(value, (4,), "box", where)
    box = BoundingBox(*(float(edge) for edge in edges))
    inside = min(box.x0, box.y0) >= 0 and box.x1 <= width and box.y1 <= height
    if not inside or box.width <= 0 or box.height <= 0:
        text = (
            f"{where} has the box {edges.tolist()}, which is empty or not inside the image of "
            f"{width:.0f} x {height:.0f}; it is [left, top, right, bottom] in pixels."
        )
        raise CaptureError(text)
    return box


def _intrinsics(entry: dict[str, Any], where: str) -> Intrinsics | None:
    names = ("fx", "fy", "cx", "cy")
    present = [name for name in names if entry.get(name) is not None]
    if not present:
        return None
    if len(present) < len(names):
        text = f"{where} has {', '.join(present)} but not all of fx, fy, cx, cy."
        raise CaptureError(text)
    fx, fy, cx, cy = _numbers(entry, names, where)
    if min(fx, fy) <= 0:
        text = f"{where} has the focal lengths {fx} and {fy}; both must be positive."
        raise CaptureError(text)
    return Intrinsics(fx=fx, fy=fy, cx=cx, cy=cy)


def _camera_from_world(entry: dict[str, Any], where: str) -> FloatArray | None:
    if entry.get("camera_from_world") is None:
        return None
    pose = _array(entry["camera_from_world"], (3, 4), "camera_from_world", where)
    rotation = pose[:, :3]
    error = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if error > ROTATION_TOLERANCE or np.linalg.det(rotation) < 0:
        text = f"{where} has a camera_from_world whose left 3x3 is no rotation (R R^T is off by {error:.2g})."
        raise CaptureError(text)
    return pose


def _numbers(entry: dict[str, Any], names: tuple[str, ...], where: str) -> list[float]:
    for name in names:
        value = entry[name]
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            text = f"{where} has {value!r} as {name!r}; a finite number is needed."
            raise CaptureError(text)
    return [float(entry[name]) for name in names]


def _array(value: object, shape: tuple[int, ...], name: str, where: str) -> FloatArray:
    try:
        array = np.asarray(value, dtype=np.float64)
    except (TypeError, ValueError):
        array = np.empty(0)
    if array.shape != shape or not np.isfinite(array).all():
        size = " x ".join(str(length) for length in shape)
        text = f"{where} has {value!r} as {name!r}; {size} finite numbers are needed."
        raise CaptureError(text)
    return array


def _read_pixels(path: Path, flags: int, size: tuple[int, int]) -> npt.NDArray[np.uint8]:
    import cv2

    try:
        encoded = np.frombuffer(path.read_bytes(), dtype=np.uint8)
    except OSError as err:
        text = f"{path} cannot be read: {err}."
        raise CaptureError(text) from err
    # cameras.json counts the stored pixels: a viewer's EXIF rotation must not turn them.
    pixels = cv2.imdecode(encoded, flags | cv2.IMREAD_IGNORE_ORIENTATION) if encoded.size else None
    if pixels is None:
        text = f"{path} is no readable image."
        raise CaptureError(text)
    if pixels.shape[:2] != size:
        text = (
            f"{path} is {pixels.shape[1]} x {pixels.shape[0]} pixels, but its entry in cameras.json "
            f"says {size[1]} x {size[0]}."
        )
        raise CaptureError(text)
    return np.asarray(pixels, dtype=np.uint8)


def _write_pixels(path: Path, pixels: npt.NDArray[np.uint8], options: list[int]) -> None:
    import cv2

    written, encoded = cv2.imencode(path.suffix, np.ascontiguousarray(pixels), options)
    if not written:
        text = f"{path} could not be encoded."
        raise CaptureError(text)
    path.write_bytes(encoded.tobytes())
