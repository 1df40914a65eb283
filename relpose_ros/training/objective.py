"""What training lowers: the negative log-likelihood of relative rotations, and the error of translations.

RelPose++ (section 3) compares the true rotation of a pair with random ones. That is the likelihood with its
normaliser estimated from samples; here the samples may be drawn more densely near the truth, each weighted
by the inverse of its density, which sharpens the energy where uniform samples are too far apart
(400 of them are 25 degrees apart) without changing what is estimated.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import nn

from relpose_ros.geometry import so3
from relpose_ros.geometry.cameras import first_camera_translations, look_at_translations

if TYPE_CHECKING:
    import numpy.typing as npt

    from relpose_ros.network.features import SceneFeatures
    from relpose_ros.network.relpose import RelPose

    FloatArray = npt.NDArray[np.float64]
    Looks = torch.Tensor | list[torch.Tensor | None]


@dataclass(frozen=True)
class ObjectiveSettings:
    """The defaults are the published run's."""

    uniform_rotations: int = 36864
    """Random rotations over all of SO(3) that a batch's pairs are compared with."""
    near_rotations: int = 0
    """Random rotations around the truth, drawn for each pair."""
    near_angles: tuple[float, ...] = (60.0, 25.0)
    """Degrees: radii of the balls around the truth that share ``near_rotations`` equally."""
    pairs: int | None = None
    """Pairs of a scan that are scored, drawn at random; None for all."""
    translation_weight: float = 1.0
    """Of the mean absolute error of translations, beside nats."""
    match_weight: float = 0.0
    """Of the cross entropy of matches between local descriptors, where it is known what each of them sees."""
    match_places: int | None = None
    """Places of each view that are asked where the other view shows them, drawn at random; None for all."""
    match_radius: float = 0.12
    """How far apart on the object two places may lie and still match, object radii: about one descriptor."""


@dataclass(frozen=True, eq=False)
class Batch:
    """Scans of equally many views."""

    looks: Looks
    """(B, N, 3, S, S) images, normalised as `relpose_ros.network.crops` does; or what `RelPose.summarise`
    takes: (B, N, C_k, h_k, w_k) maps of a frozen backbone."""
    crop_parameters: torch.Tensor
    """(B, N, 3)."""
    camera_from_world: FloatArray
    """(B, N, 3, 4), optical."""
    places: torch.Tensor | None = None
    """(B, N, h, w, 3) object coordinates each local descriptor sees, nan off the object; None if unknown."""

    def looks_on(self, device: torch.device) -> Looks:
        """The images or maps, moved to a device."""
        if isinstance(self.looks, torch.Tensor):
            return self.looks.to(device)
        return [None if each is None else each.to(device) for each in self.looks]


@dataclass(frozen=True, eq=False)
class Targets:
    """What the network should say of a batch, and the rotations it is asked about."""

    i: list[int]
    j: list[int]
    """(P,) positions of the pairs' views, i < j."""
    true: torch.Tensor
    """(B, P, 3, 3) camera_j_from_camera_i."""
    uniform: torch.Tensor
    """(K, 3, 3)."""
    near: torch.Tensor
    """(B, P, L, 3, 3)."""
    log_density: torch.Tensor
    """(B, P, 1 + K + L) of the samples, the truth first, relative to the uniform density."""
    rotations: torch.Tensor
    """(B, N, 3, 3) of the cameras in the frame of the first, for networks that regress."""
    translations: torch.Tensor
    """(B, N, 3), in the preset's frame, first camera at distance 1."""
    places: torch.Tensor | None
    """Of the batch."""
    asked: torch.Tensor | None
    """(2, B, P, K) places, by rows of the map, of views i and of views j that are asked for their match;
    None where matches are not learned."""

    def to(self, device: torch.device) -> Targets:
        """The same on a device."""
        moved: dict[str, Any] = {
            name: value.to(device) for name, value in vars(self).items() if isinstance(value, torch.Tensor)
        }
        return replace(self, **moved)


def rotations_near(
    truth: npt.ArrayLike, count: int, angle: float, generator: np.random.Generator
) -> FloatArray:
    """Rotations drawn uniformly among those within ``angle`` of the truth. (P, 3, 3) -> (P, count, 3, 3)."""
    t = np.asarray(truth, np.float64)
    grid = np.linspace(0, angle, 512)
    share = so3.ball_fraction(grid) / so3.ball_fraction(angle)
    turn = np.interp(generator.random((len(t), count)), share, grid)
    axis = generator.normal(size=(len(t), count, 3))
    axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
    return so3.exp(turn[..., None] * axis) @ t[:, None]


def mixture_log_density(
    angle: npt.ArrayLike, uniform: int, near: int, near_angles: tuple[float, ...]
) -> FloatArray:
    """Log density, relative to uniform, of the samples' mixture, at ``angle`` rad from the truth.

    ``uniform`` samples over all rotations and ``near`` ones shared equally by balls of ``near_angles`` rad.
    """
    a = np.asarray(angle, np.float64)
    density = np.full(a.shape, float(uniform))
    if near:
        for radius in near_angles:
            density += near / len(near_angles) * (a <= radius) / so3.ball_fraction(radius)
    with np.errstate(divide="ignore"):
        return np.asarray(np.log(density / (uniform + near)))


def make_targets(
    batch: Batch, settings: ObjectiveSettings, generator: np.random.Generator, *, translation_frame: str
) -> Targets:
    """Draw the pairs and rotations of one step, and work out the translations.

    Args:
        batch: With cameras in float64; all of this happens before the network, on the CPU.
        settings: How many of what.
        generator: The step's own.
        translation_frame: "look_at" or "first_camera", the preset's.
    """
    pose = np.asarray(batch.camera_from_world, np.float64)
    scans, views = pose.shape[:2]
    i, j = np.triu_indices(views, 1)
    if settings.pairs is not None and len(i) > settings.pairs:
        chosen = np.sort(generator.choice(len(i), settings.pairs, replace=False))
        i, j = i[chosen], j[chosen]
    rotation = pose[..., :3]
    true = rotation[:, j] @ rotation[:, i].swapaxes(-1, -2)
    flat = true.reshape(-1, 3, 3)
    uniform = so3.random_rotations(settings.uniform_rotations, generator)
    radii = tuple(math.radians(angle) for angle in settings.near_angles)
    share = [settings.near_rotations // len(radii)] * (len(radii) if settings.near_rotations else 0)
    near = [rotations_near(flat, count, r, generator) for count, r in zip(share, radii, strict=False)]
    near_all = np.concatenate([np.empty((len(flat), 0, 3, 3)), *near], 1)
    others = np.concatenate([np.broadcast_to(uniform, (len(flat), *uniform.shape)), near_all], 1)
    angles = so3.angle_between(others, flat[:, None])
    angles = np.concatenate([np.zeros((len(flat), 1)), angles], 1)
    log_density = mixture_log_density(angles, len(uniform), near_all.shape[1], radii)
    target = look_at_translations if translation_frame == "look_at" else first_camera_translations
    translations = []
    for scan in pose:
        result = target(scan[:, :, :3], scan[:, :, 3])
        translations.append(result[0] if isinstance(result, tuple) else result)
    return Targets(
        i=[int(k) for k in i],
        j=[int(k) for k in j],
        true=torch.from_numpy(true).float(),
        uniform=torch.from_numpy(uniform).float(),
        near=torch.from_numpy(near_all).float().reshape(scans, len(i), *near_all.shape[1:]),
        log_density=torch.from_numpy(log_density).float().reshape(scans, len(i), -1),
        rotations=torch.from_numpy(rotation @ rotation[:, :1].swapaxes(-1, -2)).float(),
        translations=torch.from_numpy(np.stack(translations)).float(),
        places=batch.places,
        asked=_asked(batch.places, i, j, settings, generator),
    )


def _asked(
    places: torch.Tensor | None,
    i: npt.NDArray[np.int64],
    j: npt.NDArray[np.int64],
    settings: ObjectiveSettings,
    generator: np.random.Generator,
) -> torch.Tensor | None:
    if places is None or settings.match_weight == 0:
        return None
    on_object = np.isfinite(places[..., 0].flatten(2).numpy())  # (B, N, A)
    seen = np.stack([on_object[:, i], on_object[:, j]])
    count = settings.match_places or seen.shape[-1]
    # The largest of random numbers: those on the object first, in random order.
    return torch.from_numpy(np.argsort(-(seen + generator.random(seen.shape)), axis=-1)[..., :count].copy())


def rotation_loss(energies: torch.Tensor, log_density: torch.Tensor) -> torch.Tensor:
    """Mean negative log-likelihood of the first rotation of each row, nats relative to uniform.

    An energy that knows nothing scores 0. With uniform samples this is the published loss less the log of
    their number.

    Args:
        energies: (..., M) of the truth and of M - 1 samples.
        log_density: (..., M) of the samples' mixture, relative to uniform.
    """
    logits = energies.float() - log_density
    normaliser = torch.logsumexp(logits, -1) - math.log(energies.shape[-1])
    return (normaliser - energies[..., 0].float()).mean()


def translation_loss(estimate: torch.Tensor, truth: torch.Tensor) -> torch.Tensor:
    """Mean absolute error. (..., 3) twice -> ()."""
    return (estimate.float() - truth).abs().mean()


def match_loss(
    logits: torch.Tensor, places: torch.Tensor, other_places: torch.Tensor, radius: float
) -> torch.Tensor:
    """Mean cross entropy of where places of one view are found in another.

    The target spreads over the places of the other view near the same point of the object; a place whose
    point the other view does not see within ``radius`` takes no part.

    Args:
        logits: (..., A, B) likeness of A descriptors of one view and B of another.
        places: (..., A, 3) what the first see, nan where it is not the object.
        other_places: (..., B, 3).
        radius: In the unit of the places.
    """
    distance = torch.cdist(places.nan_to_num(1e3), other_places.nan_to_num(-1e3))
    near = torch.exp(-0.5 * (distance / (radius / 2)) ** 2) * (distance <= radius)
    mass = near.sum(-1)
    entropy = -(near * logits.float().log_softmax(-1)).sum(-1) / mass.clamp(min=1e-6)
    seen = mass > 0
    return (entropy * seen).sum() / seen.sum().clamp(min=1)


def scene_features(network: RelPose, looks: Looks, crop_parameters: torch.Tensor) -> SceneFeatures:
    """`RelPose.encode` of the ``looks`` of a batch."""
    views = network.look(looks) if isinstance(looks, torch.Tensor) else network.summarise(looks)
    return network.relate(views, crop_parameters)


class Objective(nn.Module):
    """Network and loss as one module, so that a gradient is averaged over machines in one place."""

    def __init__(self, network: RelPose, settings: ObjectiveSettings) -> None:
        """Wrap the network; its weights stay its own."""
        super().__init__()
        self.network = network
        self._settings = settings

    def forward(
        self,
        looks: Looks,
        crop_parameters: torch.Tensor,
        targets: Targets,
    ) -> torch.Tensor:
        """Loss and its parts. -> (4,): total, rotation (nats), translation, matches (nats)."""
        network, settings = self.network, self._settings
        features = scene_features(network, looks, crop_parameters)
        translation = translation_loss(network.optical_translations(features), targets.translations)
        if network.preset.rotation == "regression":
            # Six numbers have no likelihood: the mean absolute error of the matrix, as for translations.
            rotation = translation_loss(network.optical_rotations(features), targets.rotations)
        else:
            contexts = network.pair_contexts(features, targets.i, targets.j).float()
            # In full precision: energies of near rotations differ by less than half precision tells apart.
            with torch.autocast(contexts.device.type, enabled=False):
                own = network.embed_relative(torch.cat([targets.true[:, :, None], targets.near], 2))
                own_energies = network.pair_energies(contexts, own)
                shared = network.pair_energies(contexts, network.embed_relative(targets.uniform))
                energies = torch.cat([own_energies[..., :1], shared, own_energies[..., 1:]], -1)
                rotation = rotation_loss(energies, targets.log_density)
        matches = self._matches(features, targets)
        total = rotation + settings.translation_weight * translation + settings.match_weight * matches
        return torch.stack([total, rotation, translation, matches])

    def _matches(self, features: SceneFeatures, targets: Targets) -> torch.Tensor:
        """The mean of both directions, as sharp as the network compares descriptors."""
        if features.maps is None or targets.places is None or targets.asked is None:
            return features.tokens.new_zeros(())
        reader = self.network.correlation
        assert reader is not None
        places = targets.places.flatten(2, 3)  # (B, N, A, 3)
        descriptors = features.maps.flatten(-2).mT * reader.sharpness.sqrt()  # (B, N, A, C)
        losses = []
        for one, other, asked in (
            (targets.i, targets.j, targets.asked[0]),
            (targets.j, targets.i, targets.asked[1]),
        ):
            chosen = asked[..., None]
            own, own_places = (
                each[:, one].gather(2, chosen.expand(*asked.shape, each.shape[-1]))
                for each in (descriptors, places)
            )
            logits = own @ descriptors[:, other].mT
            losses.append(match_loss(logits, own_places, places[:, other], self._settings.match_radius))
        return torch.stack(losses).mean()
