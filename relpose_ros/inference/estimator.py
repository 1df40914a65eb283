"""The one door to the learned core: a scan in, poses and how far to trust them out."""

from __future__ import annotations

import threading
import time
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import torch

from relpose_ros.errors import RelPoseError
from relpose_ros.estimates import CameraPose, ScanEstimate
from relpose_ros.geometry import cameras
from relpose_ros.inference.calibration import Calibration
from relpose_ros.inference.global_rotations import solve
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import GridEmbeddings, PairEnergies
from relpose_ros.inference.uncertainty import camera_covariances, describe_pairs
from relpose_ros.inference.verdict import judge
from relpose_ros.network.checkpoint import load_network, read_metadata
from relpose_ros.network.crops import crop_view
from relpose_ros.network.features import ViewFeatures
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.inference.global_rotations import JointSolutions
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose
    from relpose_ros.views import Scan, View

    FloatArray = npt.NDArray[np.float64]


class ScanError(RelPoseError):
    """A scan that nothing can be said about."""


class Estimator:
    """Estimates the camera poses of a scan.

    The same scan gives the same answer to the bit, whatever was estimated before it: a view's features are
    computed from that view alone and kept as long as the view is, and nothing else is remembered.
    Safe to call from several threads; one estimate is made at a time.
    """

    def __init__(self, network: RelPose, calibration: Calibration | None = None) -> None:
        """Takes the network as it is.

        Args:
            network: with its weights; they must not change afterwards.
            calibration: of those weights; None says that nobody calibrated them.
        """
        self._network = network.eval()
        self._calibration = calibration
        self._grid = GridEmbeddings(network)
        self._looks: WeakKeyDictionary[View, tuple[ViewFeatures, torch.Tensor]] = WeakKeyDictionary()
        self._lock = threading.Lock()

    @classmethod
    def from_weights(cls, path: Path | None = None, threads: int | None = None) -> Estimator:
        """Loads weights and their calibration.

        Args:
            path: of a weights file; None for the shipped compact weights.
            threads: for torch, of the whole process; None or 0 leaves torch's own choice.

        Raises:
            NetworkFileError: if the file is missing or is none of ours.
        """
        if threads:
            torch.set_num_threads(threads)
        network = load_network(path)
        stored = read_metadata(path).get("calibration")
        return cls(network, Calibration.from_json(stored) if stored else None)

    @torch.no_grad()
    def estimate(self, scan: Scan) -> ScanEstimate:
        """Poses of all views, what each pair knows, and a verdict.

        Raises:
            ScanError: if the scan has fewer than 2 views or more than 8.
        """
        if not MIN_VIEWS <= len(scan.views) <= MAX_VIEWS:
            raise ScanError(
                f"The scan of '{scan.object_id}' has {len(scan.views)} views; "
                f"an estimate takes {MIN_VIEWS} to {MAX_VIEWS}."
            )
        with self._lock:
            start = time.perf_counter()
            features = self._features(scan)
            energies, distributions, solutions = self._solve(features)
            calibration = self._calibration or Calibration()
            translations = self._network.optical_translations(features).double().numpy()
            unit = max(float(np.linalg.norm(translations[0])), 1e-6)
            translations = translations / unit
            solution = solutions.rotations[0]
            rotations = solution.numpy()
            centres = cameras.camera_centre(rotations, translations)
            covariances = camera_covariances(distributions, energies, solution, translations, calibration)
            pairs = describe_pairs(distributions, energies, solution, calibration)
            verdict, weakest, status = judge(pairs, covariances, self._calibration is not None)
            return ScanEstimate(
                object_id=scan.object_id,
                cameras=tuple(
                    CameraPose(view, rotations[view].T, centres[view], covariances[view])
                    for view in range(len(scan.views))
                ),
                pairs=pairs,
                score=float(solutions.scores[0]),
                scale_known=False,
                calibrated=self._calibration is not None,
                verdict=verdict,
                weakest_pair=weakest,
                status=status,
                seconds=time.perf_counter() - start,
            )

    @torch.no_grad()
    def rotations(self, features: SceneFeatures) -> FloatArray:
        """The jointly best rotations, camera_from_object, the first the identity. -> (N, 3, 3)."""
        _, _, solutions = self._solve(features)
        return np.asarray(solutions.rotations[0].numpy())

    def _solve(self, features: SceneFeatures) -> tuple[PairEnergies, PairDistributions, JointSolutions]:
        energies = PairEnergies.of(self._network, features, len(features))
        distributions = search(energies, self._grid)
        return energies, distributions, solve(energies, distributions)

    def _features(self, scan: Scan) -> SceneFeatures:
        looks = []
        for view in scan.views:
            if view not in self._looks:
                image, crop_parameters = crop_view(view, self._network.preset)
                # One view at a time: a batch of another size may round differently, and a scan's answer
                # must not depend on how many of its views arrived together.
                self._looks[view] = (self._network.look(image[None])[0], crop_parameters)
            looks.append(self._looks[view])
        stacked = torch.stack([crop_parameters for _, crop_parameters in looks])
        return self._network.relate(ViewFeatures.stack([look for look, _ in looks]), stacked)
