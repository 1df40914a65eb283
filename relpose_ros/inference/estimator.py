"""The one door to the learned core: a scan in, poses and how far to trust them out."""

from __future__ import annotations

import contextlib
import math
import threading
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING
from weakref import WeakKeyDictionary

import numpy as np
import torch

from relpose_ros.errors import RelPoseError
from relpose_ros.estimates import CameraPose, ScanEstimate, Verdict
from relpose_ros.geometry import cameras, so3_grid
from relpose_ros.inference import bundle_adjustment
from relpose_ros.inference.calibration import Calibration, CalibrationError
from relpose_ros.inference.camera_positions import apart, baseline, joined, place
from relpose_ros.inference.evidence import SHIPPED, EvidenceSettings
from relpose_ros.inference.global_rotations import joint_scores, solve
from relpose_ros.inference.local_features import DescriptorMap
from relpose_ros.inference.matches import Matcher, peaks
from relpose_ros.inference.outlines import (
    find_outline,
    position_sigmas,
    sighted_translations,
    sightlines,
)
from relpose_ros.inference.pair_distribution import search
from relpose_ros.inference.pair_energies import COARSE_LEVEL, GridEmbeddings, PairEnergies
from relpose_ros.inference.predictions import (
    about_the_object,
    predicted_translations,
    regressed_poses,
)
from relpose_ros.inference.refined_poses import settle
from relpose_ros.inference.robot_frame import RobotFrame, find_robot_frame
from relpose_ros.inference.rotation_evidence import RotationEvidence
from relpose_ros.inference.side_by_side import side_by_side
from relpose_ros.inference.uncertainty import (
    camera_covariances,
    covariances_of_unknown_trust,
    describe_pairs,
    heaviest_modes,
    pairs_of_unknown_trust,
)
from relpose_ros.inference.verdict import WITHOUT_PROBABILITIES, judge
from relpose_ros.network.checkpoint import SHIPPED_WEIGHTS, NetworkFileError, load_network, read_metadata
from relpose_ros.network.crops import crop_square, crop_view
from relpose_ros.network.features import ViewFeatures
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Mapping, Sequence
    from pathlib import Path

    import numpy.typing as npt

    from relpose_ros.estimates import PairRotation
    from relpose_ros.inference.camera_positions import Baseline
    from relpose_ros.inference.matches import TwoViewGeometry
    from relpose_ros.inference.outlines import Outline
    from relpose_ros.inference.pair_distribution import PairDistributions
    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.presets import Preset
    from relpose_ros.network.relpose import RelPose
    from relpose_ros.views import Scan, View

    FloatArray = npt.NDArray[np.float64]


class ScanError(RelPoseError):
    """A scan that nothing can be said about."""


@dataclass(frozen=True, eq=False)
class _Look:
    """What the network sees in one view."""

    features: ViewFeatures
    crop_parameters: torch.Tensor
    """(3,)."""
    descriptor_map: DescriptorMap | None
    """What it says of single places, where its preset has descriptors."""


@dataclass(frozen=True, eq=False)
class _Found:
    """What a scan's views and pairs say, each by itself."""

    features: SceneFeatures
    outlines: list[Outline | None]
    geometries: dict[tuple[int, int], TwoViewGeometry]
    energies: PairEnergies
    distributions: PairDistributions
    calibration: Calibration
    """What still applies: the energies have their temperature and uniform share, so 1 and 0 of those."""

    @property
    def weighted_energies(self) -> PairEnergies:
        """The energies as they add up over a scan.

        Every view takes part in N - 1 pairs, whose errors in the network's eyes go together. Those of matches
        hardly do: beside them the sum of the network's energies counts N / 2 times too much.
        """
        if self.energies.evidence is None:
            return self.energies
        return replace(self.energies, weight=2 / self.energies.views)


@dataclass(frozen=True, eq=False)
class _Told:
    """What there is to tell of a scan, the first camera at distance 1."""

    rotations: FloatArray
    """(N, 3, 3) camera_from_object."""
    centres: FloatArray
    """(N, 3)."""
    joint: FloatArray
    """(6 N, 6 N) their covariance, as `camera_positions.joined` orders it."""
    pairs: tuple[PairRotation, ...]
    score: float
    verdict: tuple[Verdict, int, str]


def _require_scan(what: str, views: int) -> None:
    if not MIN_VIEWS <= views <= MAX_VIEWS:
        raise ScanError(f"{what} {views} views; an estimate takes {MIN_VIEWS} to {MAX_VIEWS}.")


OWN_THREADS = torch.get_num_threads()
"""As many as torch takes by itself."""
LARGEST_LOSS = 0.5
"""Nats a pair: refined poses that lose more of the joint energy contradict the pairs, and are not taken."""


class Estimator:
    """Estimates the camera poses of a scan.

    The same scan gives the same answer to the bit, whatever was estimated before it: a view's features are
    computed from that view alone and kept as long as the view is, a pair's matches as long as both are, and
    nothing else is remembered.
    Safe to call from several threads; one estimate is made at a time.

    A network that regresses poses has no distribution which matches could join and no calibration: its poses
    are told as they are, as uncertain as can be, and never called enough.
    """

    def __init__(
        self,
        network: RelPose,
        calibration: Calibration | None = None,
        evidence: EvidenceSettings = SHIPPED,
    ) -> None:
        """Takes the network as it is.

        Args:
            network: with its weights; they must not change afterwards.
            calibration: of those weights; None says that nobody calibrated them.
            evidence: what else to rest on.
        """
        self._network = network.eval()
        # In the views' order of memory: a convolution would rearrange its weights at every view.
        network.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
        self._regresses = network.preset.rotation == "regression"
        self._calibration = None if self._regresses else calibration
        self._match_trust = None if self._calibration is None else self._calibration.match_trust
        self._evidence = evidence
        self._matcher = self._matcher_of(evidence)
        self._grid = GridEmbeddings(network)
        self._looks: WeakKeyDictionary[View, _Look] = WeakKeyDictionary()
        self._lock = threading.Lock()

    @classmethod
    def from_weights(
        cls,
        path: Path | None = None,
        threads: int | None = None,
        evidence: EvidenceSettings = SHIPPED,
        *,
        backbone_in_bfloat16: bool = False,
    ) -> Estimator:
        """Loads weights and their calibration.

        Args:
            path: of a weights file; None for the shipped compact weights.
            threads: for torch and OpenCV, of the whole process; 0 for as many as they take by themselves,
                None leaves them as they are.
            evidence: what else than the network to rest on.
            backbone_in_bfloat16: of the published network: sooner on some processors, and less exact.

        Raises:
            NetworkFileError: if the file is missing or is none of ours, or its calibration is none.
        """
        if threads is not None:
            torch.set_num_threads(threads or OWN_THREADS)
            with contextlib.suppress(ImportError):  # the network alone does without it
                import cv2

                cv2.setNumThreads(threads or -1)
        network = load_network(path)
        network.backbone_in_bfloat16 = backbone_in_bfloat16
        stored = read_metadata(path).get("calibration")
        try:
            calibration = None if stored is None else Calibration.from_json(stored)
        except CalibrationError as err:
            raise NetworkFileError(f"{path or SHIPPED_WEIGHTS}: {err}") from err
        return cls(network, calibration, evidence)

    @property
    def preset(self) -> Preset:
        """Of its network."""
        return self._network.preset

    def with_evidence(self, evidence: EvidenceSettings) -> Estimator:
        """An estimator of the same weights and calibration with other evidence; they share nothing else."""
        return Estimator(self._network, self._calibration, evidence)

    def rest_on(self, evidence: EvidenceSettings) -> None:
        """Goes on with other evidence from the next estimate on."""
        with self._lock:
            # A matcher keeps the features of the views held, which take a third of a second a view to find.
            if _of_matches(evidence) != _of_matches(self._evidence):
                self._matcher = self._matcher_of(evidence)
            self._evidence = evidence

    @torch.no_grad()
    def estimate(self, scan: Scan) -> ScanEstimate:
        """Poses of all views, what each pair knows, and a verdict.

        Raises:
            ScanError: if the scan has fewer than 2 views or more than 8.
        """
        _require_scan(f"The scan of '{scan.object_id}' has", len(scan.views))
        with self._lock:
            start = time.perf_counter()
            told = self._regressed(scan) if self._regresses else self._solved(scan)
            rotations = told.rotations
            robot: RobotFrame | str = ""
            if scan.robot_poses:
                robot = find_robot_frame(rotations, told.centres, told.joint, scan.robot_poses)
            in_robot = robot if isinstance(robot, RobotFrame) else None
            unit, deviation = self._evidence.first_view_distance or 1.0, 0.0
            if in_robot is not None:
                unit, deviation = in_robot.scale, in_robot.deviation
            centres, covariances = _scaled(told.centres, apart(told.joint), unit, deviation)
            verdict, weakest, status = told.verdict
            if isinstance(robot, str) and robot:
                status += f" (the robot's camera poses do not tell the scale: {robot})"
            return ScanEstimate(
                object_id=scan.object_id,
                cameras=tuple(
                    CameraPose(view, rotations[view].T, centres[view], covariances[view])
                    for view in range(len(scan.views))
                ),
                pairs=told.pairs,
                score=told.score,
                scale_known=in_robot is not None or self._evidence.first_view_distance > 0,
                calibrated=self._calibration is not None,
                verdict=verdict,
                weakest_pair=weakest,
                status=status,
                seconds=time.perf_counter() - start,
                scale_deviation=deviation,
                object_pose=None if in_robot is None else in_robot.object_pose,
            )

    @torch.no_grad()
    def pair_masses(self, scan: Scan) -> list[tuple[FloatArray, FloatArray]]:
        """Each pair's whole distribution, to be looked at: cell centres (L, 3, 3) and probabilities (L,).

        Pairs i < j, ordered by i, then j; rotations are camera_j_from_camera_i.
        """
        with self._lock:
            if self._regresses:
                cells = so3_grid.grid(COARSE_LEVEL)
                count = len(scan.views) * (len(scan.views) - 1) // 2
                return [(cells, np.full(len(cells), 1 / len(cells)))] * count
            distributions = self._search(scan).distributions
            return [
                (rotations.numpy(), masses.numpy())
                for rotations, masses in zip(distributions.rotations, distributions.masses(), strict=True)
            ]

    @torch.no_grad()
    def features(self, scan: Scan) -> SceneFeatures:
        """What the network sees in the views, each looked at once and kept as long as the view is."""
        with self._lock:
            return self._features(scan)

    def descriptor_map(self, view: View) -> DescriptorMap | None:
        """What the network says of the places of a view; None where its preset has no descriptors."""
        with self._lock:
            return self._looked_at([view])[0].descriptor_map

    @torch.no_grad()
    def rotations(self, features: SceneFeatures) -> FloatArray:
        """The jointly best rotations, camera_from_object, the first the identity. -> (N, 3, 3).

        Raises:
            ScanError: There are fewer than 2 views or more than 8.
        """
        _require_scan("The features are of", len(features))
        with self._lock:
            if self._regresses:
                return regressed_poses(self._network, features)[0]
            energies = PairEnergies.of(self._network, features, len(features))
            return np.asarray(solve(energies, search(energies, self._grid)).rotations[0].numpy())

    def _solved(self, scan: Scan) -> _Told:
        """What the pairs' distributions say together."""
        found = self._search(scan)
        known = found.distributions
        if len(scan.views) == 2 and self._calibration is not None:
            # With one pair nothing can outvote a narrow peak, which is hardly ever right: where probabilities
            # hold, the mode with the most of them counts, and not the highest density.
            known = heaviest_modes(known)
        solution = solve(found.weighted_energies, known).rotations[0]
        translations = self._translations(found, solution.numpy())
        covariances = camera_covariances(
            *(found.distributions, found.energies, solution, translations, found.calibration),
            position_sigmas(found.outlines, found.calibration.position_sigma),
        )
        rotations, centres, joint = self._place(scan, found, solution.numpy(), translations, covariances)
        solution = torch.from_numpy(rotations)
        pairs = describe_pairs(found.distributions, found.energies, solution, found.calibration)
        return _Told(
            rotations,
            centres,
            joint,
            pairs,
            score=float(joint_scores(found.energies, solution[None])[0]),
            verdict=judge(
                pairs,
                apart(joint),
                self._calibration is not None,
                guessed=any(view.intrinsics is None for view in scan.views),
                seen=sightlines(found.outlines),
            ),
        )

    def _regressed(self, scan: Scan) -> _Told:
        """What a network says that gives one pose a view, and no probability of it."""
        rotations, translations = regressed_poses(self._network, self._features(scan))
        outlines = _outlines(scan)
        translations = about_the_object(rotations, translations, outlines)
        sigmas = position_sigmas(outlines, Calibration().position_sigma)
        return _Told(
            rotations,
            cameras.camera_centre(rotations, translations),
            joined(covariances_of_unknown_trust(rotations, translations, sigmas)),
            pairs_of_unknown_trust(rotations),
            score=0.0,
            verdict=(Verdict.ONE_MORE_VIEW, 0, WITHOUT_PROBABILITIES),
        )

    def _search(self, scan: Scan) -> _Found:
        """Everything that is known of the pairs before their rotations are brought together."""
        features = self._features(scan)
        calibration = self._calibration or Calibration()
        geometries = {}
        if self._matcher is not None:
            geometries = self._matcher.geometries(scan.views, self._descriptor_maps(scan.views))
        spoken = [peaks(each) for each in geometries.values()]
        # The temperature belongs to the network's energies, not to what is added to them.
        temperature = calibration.temperature if self._evidence.learned else math.inf
        energies = PairEnergies.of(
            self._network,
            features,
            len(features),
            temperature,
            RotationEvidence(spoken) if any(spoken) else None,
        )
        if calibration.flat > 0:
            energies = energies.mixed(self._grid, calibration.flat)
        return _Found(
            features,
            _outlines(scan),
            geometries,
            energies,
            search(energies, self._grid),
            replace(calibration, temperature=1.0, flat=0.0),
        )

    def _translations(self, found: _Found, rotations: FloatArray) -> FloatArray:
        """Where the cameras stand from the object before matches tell more. -> (N, 3)."""
        if found.calibration.placed_by_boxes or not self._evidence.learned:
            return sighted_translations(found.outlines)
        predicted = predicted_translations(self._network, found.features, rotations)
        return about_the_object(rotations, predicted, found.outlines)

    def _place(
        self,
        scan: Scan,
        found: _Found,
        rotations: FloatArray,
        translations: FloatArray,
        covariances: FloatArray,
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Rotations, camera centres and their joint covariance with what the matches say of positions."""
        centres, joint = cameras.camera_centre(rotations, translations), joined(covariances)
        baselines = _baselines(found.geometries, rotations, covariances)
        placed, placed_joint = place(centres, joint, baselines)
        refined = self._refine(scan, found, rotations, placed)
        if refined is None:
            return rotations, placed, placed_joint
        # The directions between cameras that moved are told by the points, and better.
        guessed = any(view.intrinsics is None for view in scan.views)
        settled, settled_joint = settle(refined, joint, sightlines(found.outlines), guessed=guessed)
        others = [camera for camera in range(len(rotations)) if camera not in refined.moved]
        left = [each for each in baselines if each.i in others or each.j in others]
        settled[others] = centres[others]
        return refined.rotations, *place(settled, settled_joint, left)

    def _refine(
        self, scan: Scan, found: _Found, rotations: FloatArray, centres: FloatArray
    ) -> bundle_adjustment.Refined | None:
        """What a bundle adjustment makes of the poses, where it improves them."""
        if self._matcher is None or self._evidence.use != "refine":
            return None
        refined = bundle_adjustment.refine(
            rotations,
            cameras.translation_of(rotations, centres),
            [self._matcher.features(view) for view in scan.views],
            found.geometries,
        )
        if refined is None:
            return None
        both = torch.from_numpy(np.stack([rotations, refined.rotations]))
        energies = found.weighted_energies
        before, after = joint_scores(energies, both).tolist()
        return None if after < before - LARGEST_LOSS * energies.count else refined

    def _features(self, scan: Scan) -> SceneFeatures:
        looks = self._looked_at(scan.views)
        stacked = torch.stack([look.crop_parameters for look in looks])
        return self._network.relate(ViewFeatures.stack([look.features for look in looks]), stacked)

    def _looked_at(self, views: Sequence[View]) -> list[_Look]:
        # Each view by itself: a batch of another size may round differently, and a scan's answer must not
        # depend on how many of its views arrived together.
        new = [view for view in dict.fromkeys(views) if view not in self._looks]
        if self.preset.small_convolutions:
            side_by_side(self._look, new)
        else:
            for view in new:
                self._look(view)
        return [self._looks[view] for view in views]

    @torch.no_grad()  # of the caller's it would not hear in a thread of its own
    def _look(self, view: View) -> None:
        image, crop_parameters = crop_view(view, self.preset)
        features, descriptor_map = self._network.look(image[None])[0], None
        if features.maps is not None:
            descriptor_map = DescriptorMap(features.maps.numpy(), *crop_square(view.box))
        self._looks[view] = _Look(features, crop_parameters, descriptor_map)

    def _descriptor_maps(self, views: Sequence[View]) -> dict[View, DescriptorMap]:
        """What stands beside SIFT's descriptors.

        Of weights whose calibration does not say so nobody knows how well they tell places apart, and of what
        is around the object no network was taught anything.
        """
        if self._match_trust is None or self._evidence.surroundings or not self._evidence.learned:
            return {}
        maps = {view: look.descriptor_map for view, look in zip(views, self._looked_at(views), strict=True)}
        return {view: known for view, known in maps.items() if known is not None}

    def _matcher_of(self, evidence: EvidenceSettings) -> Matcher | None:
        alone = self._regresses or evidence.use == "network"
        if alone:
            return None
        return Matcher(surroundings=evidence.surroundings, learned_trust=self._match_trust)


def _of_matches(evidence: EvidenceSettings) -> tuple[bool, bool, bool]:
    """What matches depend on."""
    return evidence.use == "network", evidence.surroundings, evidence.learned


def _outlines(scan: Scan) -> list[Outline | None]:
    return [find_outline(view) for view in scan.views]


def _baselines(
    geometries: Mapping[tuple[int, int], TwoViewGeometry], rotations: FloatArray, covariances: FloatArray
) -> list[Baseline]:
    """The directions between cameras by those pairs' matches that agree with their rotations."""
    return [
        baseline(
            *(i, j, rotations[j], geometry.poses[0].direction, geometry.poses[0].direction_covariance),
            covariances[j, 3:, 3:],
        )
        for (i, j), geometry in geometries.items()
        if geometry.agrees(rotations[j] @ rotations[i].T)
    ]


def _scaled(
    centres: FloatArray, covariances: FloatArray, unit: float, deviation: float
) -> tuple[FloatArray, FloatArray]:
    """Centres (N, 3) and covariances (N, 6, 6) in another unit, itself known to a relative deviation."""
    centres, scale = unit * centres, np.repeat([unit, 1.0], 3)
    covariances = scale[:, None] * covariances * scale
    covariances[:, :3, :3] += deviation**2 * centres[:, :, None] * centres[:, None, :]
    return centres, covariances
