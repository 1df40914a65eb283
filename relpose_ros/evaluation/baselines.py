"""Ways to get poses from views: the shipped estimator, and what it is measured against."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from relpose_ros.geometry.cameras import translation_of
from relpose_ros.inference.verdict import LARGEST_ROTATION_DEVIATION, rotation_deviations
from relpose_ros.views import Scan

if TYPE_CHECKING:
    from collections.abc import Sequence

    import numpy.typing as npt

    from relpose_ros.estimates import ScanEstimate
    from relpose_ros.inference.estimator import Estimator
    from relpose_ros.views import Intrinsics, View

    FloatArray = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Poses:
    """camera_from_world of each view, in a world and unit of the method's own."""

    rotations: FloatArray
    """(N, 3, 3), nan where the method has no answer."""
    translations: FloatArray
    """(N, 3), nan likewise."""
    deviations: FloatArray | None = None
    """(N,) stated standard deviation of each rotation about its worst axis, rad; None: not stated."""
    estimate: ScanEstimate | None = None
    """What else the method says, where it is an estimator."""


class Method(Protocol):
    """Something that estimates the poses of a scan."""

    name: str
    """As it stands in a table."""

    def poses(self, views: Sequence[View]) -> Poses:
        """Poses of 2 to 8 views, in their order."""
        ...


class Estimated:
    """The estimator of this package."""

    def __init__(self, name: str, estimator: Estimator) -> None:
        """Wrap an estimator."""
        self.name = name
        self._estimator = estimator
        self._last: tuple[tuple[View, ...], Poses] | None = None

    def poses(self, views: Sequence[View]) -> Poses:
        """See `Method`. The latest answer is kept: a method that changes it asks for the same one."""
        key = tuple(views)
        if self._last is None or self._last[0] != key:
            estimate = self._estimator.estimate(Scan(object_id="evaluation", views=key))
            rotations = np.stack([camera.object_from_camera.T for camera in estimate.cameras])
            positions = np.stack([camera.position for camera in estimate.cameras])
            deviations = rotation_deviations(np.stack([camera.covariance for camera in estimate.cameras]))
            translations = translation_of(rotations, positions)
            self._last = key, Poses(rotations, translations, deviations, estimate)
        return self._last[1]


class Known:
    """The cameras of an estimate that it calls known itself.

    A camera that nothing ties to the others is placed anywhere, and one such camera turns and shrinks the
    alignment in which all centres are measured. COLMAP leaves it out; so does this.
    """

    def __init__(self, name: str, poses_from: Method) -> None:
        """Take the poses of a method that states deviations."""
        self.name = name
        self._method = poses_from

    def poses(self, views: Sequence[View]) -> Poses:
        """See `Method`."""
        poses = self._method.poses(views)
        assert poses.deviations is not None
        unknown = poses.deviations > LARGEST_ROTATION_DEVIATION
        rotations, translations = poses.rotations.copy(), poses.translations.copy()
        rotations[unknown], translations[unknown] = np.nan, np.nan
        return Poses(rotations, translations, poses.deviations)


class ConstantTranslation:
    """Rotations of another method, every camera at distance 1 and facing the object (an ablation)."""

    def __init__(self, rotations_from: Method) -> None:
        """Take the rotations of ``rotations_from``."""
        self.name = "constant-translation"
        self._method = rotations_from

    def poses(self, views: Sequence[View]) -> Poses:
        """See `Method`."""
        rotations = self._method.poses(views).rotations
        translations = np.where(np.isfinite(rotations[:, :, 0]), [0.0, 0.0, 1.0], np.nan)
        return Poses(rotations, translations)


class Identity:
    """All cameras at one place, one way round: what a scan of near neighbours rewards."""

    name = "identity"

    def poses(self, views: Sequence[View]) -> Poses:
        """See `Method`."""
        return Poses(np.tile(np.eye(3), (len(views), 1, 1)), np.tile([0.0, 0.0, 1.0], (len(views), 1)))


class Colmap:
    """SIFT, exhaustive matching and incremental mapping by pycolmap, on whole images.

    It gets what it can use: the intrinsics and the lens where they are known, and the mask where there is one
    (an object turned in front of a fixed camera has a background that contradicts its motion).
    Views missing from the largest reconstruction have no answer.
    """

    name = "pycolmap"

    def __init__(self, seed: int = 0) -> None:
        """Import pycolmap, which only this baseline needs."""
        import pycolmap

        self._colmap: Any = pycolmap
        self._seed = seed
        pycolmap.logging.minloglevel = int(pycolmap.logging.Level.FATAL)

    def poses(self, views: Sequence[View]) -> Poses:
        """See `Method`."""
        rotations, translations = np.full((len(views), 3, 3), np.nan), np.full((len(views), 3), np.nan)
        with tempfile.TemporaryDirectory() as folder:
            found = self._reconstruct(views, Path(folder))
        for k, pose in found.items():
            rotations[k], translations[k] = pose[:, :3], pose[:, 3]
        return Poses(rotations, translations)

    def _reconstruct(self, views: Sequence[View], folder: Path) -> dict[int, FloatArray]:
        """camera_from_world (3, 4) of the views in the largest reconstruction, by position."""
        import cv2

        colmap = self._colmap
        colmap.set_random_seed(self._seed)
        database, images, masks = folder / "database.db", folder / "images", folder / "masks"
        for k, view in enumerate(views):
            camera_images = images / str(k)
            camera_images.mkdir(parents=True)
            name = f"{k}/{k}.png"
            cv2.imwrite(str(images / name), view.image[..., ::-1])
            (masks / str(k)).mkdir(parents=True)
            if view.mask is not None:
                cv2.imwrite(str(masks / f"{name}.png"), view.mask.astype(np.uint8) * 255)
            reader = colmap.ImageReaderOptions(mask_path=str(masks) if view.mask is not None else "")
            if view.intrinsics is not None:
                reader.camera_model, reader.camera_params = colmap_camera(view, view.intrinsics)
            colmap.extract_features(
                database,
                images,
                image_names=[name],
                camera_mode=colmap.CameraMode.PER_IMAGE,
                reader_options=reader,
                device=colmap.Device.cpu,
            )
        colmap.match_exhaustive(database, device=colmap.Device.cpu)
        # What is calibrated is known better than a few views tell; a refined lens's eight numbers run away.
        lens_known = any(view.distortion is not None for view in views)
        focal_known = all(view.intrinsics is not None for view in views)
        options = colmap.IncrementalPipelineOptions(
            min_model_size=2,
            multiple_models=True,
            ba_refine_extra_params=not lens_known,
            ba_refine_focal_length=not focal_known,
        )
        options.mapper.abs_pose_refine_focal_length = not focal_known
        models = colmap.incremental_mapping(database, images, folder / "models", options=options)
        if not models:
            return {}
        largest = max(models.values(), key=lambda model: (model.num_reg_images(), model.num_points3D()))
        return {
            int(image.name.partition("/")[0]): np.asarray(image.cam_from_world().matrix())
            for image in largest.images.values()
            if image.has_pose
        }


def colmap_camera(view: View, intrinsics: Intrinsics) -> tuple[str, str]:
    """The name and the parameters of COLMAP's camera model for a view's picture.

    Of a lens it knows eight numbers; OpenCV's thin prisms and tilts are left out.
    """
    x0, y0 = view.origin
    pinhole = (intrinsics.fx, intrinsics.fy, intrinsics.cx - x0, intrinsics.cy - y0)
    lens = () if view.distortion is None else view.distortion.coefficients
    if view.distortion is None:
        model = "PINHOLE"
    elif view.distortion.equidistant:
        model = "OPENCV_FISHEYE"
    else:
        model, lens = "FULL_OPENCV", (*lens, *(0.0,) * 8)[:8]
    return model, ",".join(str(float(number)) for number in (*pinhole, *lens))
