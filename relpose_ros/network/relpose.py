"""RelPose++ (Lin et al., 3DV 2024): from crops to pair energies and translations.

The order of use: `RelPose.look` once per view, `RelPose.relate` once per scan, `RelPose.pair_contexts` once
per pair, then `RelPose.pair_energies` for as many rotations as one likes. All of them take leading batch
dimensions and gradients; a solver takes `RelPose.energy_head` for the last. `energies` and `translations`
speak the released network's convention (see `relpose_ros.network.conventions`); `embed_relative`,
`energy_head`, `optical_translations` and `optical_rotations` speak ours.
"""

from __future__ import annotations

from contextlib import nullcontext
from typing import TYPE_CHECKING

import torch
from torch import nn
from torch.nn import functional

from relpose_ros.errors import RelPoseError
from relpose_ros.network import conventions
from relpose_ros.network.encoder import Encoder, fourier, octaves
from relpose_ros.network.energy_head import EnergyHead
from relpose_ros.network.features import SceneFeatures, ViewFeatures
from relpose_ros.network.heads import CorrelationReader, Regressor

if TYPE_CHECKING:
    from collections.abc import Sequence

    from relpose_ros.network.features import Index
    from relpose_ros.network.presets import Preset


class NetworkUseError(RelPoseError):
    """A network was asked for what its preset does not have, or given arrays of another shape."""


class RelPose(nn.Module):
    """The network of a preset, with PyTorch's random initial weights. See the module for the order of use."""

    embedding: torch.Tensor

    def __init__(self, preset: Preset) -> None:
        super().__init__()
        self.preset = preset
        self.backbone_in_bfloat16 = False
        """Whether `look` computes in bfloat16 with a residual backbone; all else is done, and told, in the
        weights' own type. EfficientNet-Lite0 has no norm that makes up for rounding, and little to gain."""
        self.register_buffer("embedding", octaves(preset.rotation_frequencies)[None, None])
        self.feature_extractor = Encoder(preset)
        self.translation_regressor = Regressor(preset.token_width, preset.translation_widths, 3)
        if preset.rotation == "regression":
            self.rotation_regressor = Regressor(preset.token_width, preset.translation_widths, 6)
            return
        width = preset.energy_width
        self.embed_feature = nn.Linear(2 * preset.token_width, width)
        self.embed_query = nn.Linear(9 * 2 * preset.rotation_frequencies, width)
        self.layers = nn.Sequential(
            nn.LeakyReLU(),
            nn.Linear(width, width),
            nn.LeakyReLU(),
            nn.Linear(width, width),
            nn.Linear(width, 1),
        )
        settings = preset.correlation
        self.correlation = None if settings is None else CorrelationReader(settings, width)

    @property
    def device(self) -> torch.device:
        """Where the weights are; inputs are expected there too."""
        return self.embedding.device

    def look(self, images: torch.Tensor) -> ViewFeatures:
        """Features of views, each on its own.

        Args:
            images: (..., N, 3, S, S) with the preset's image size S, normalised as in `network.crops`.

        Raises:
            NetworkUseError: The images have another shape.
        """
        side = self.preset.image_size
        if images.ndim < 4 or images.shape[-3:] != (3, side, side):
            raise NetworkUseError(
                f"This network takes crops of shape (N, 3, {side}, {side}); given {tuple(images.shape)}."
            )
        leading = images.shape[:-3]
        # Not autocast with enabled=False: it would switch off the one that a caller is in.
        lowers = self.backbone_in_bfloat16 and self.preset.backbone == "residual"
        lowered = torch.autocast(images.device.type, torch.bfloat16) if lowers else None
        with lowered or nullcontext():
            pooled, maps = self.feature_extractor.look(images.flatten(0, -4))
        if lowered:
            pooled, maps = pooled.to(images.dtype), None if maps is None else maps.to(images.dtype)
        return _as_views(pooled, maps, leading)

    def summarise(self, maps: Sequence[torch.Tensor | None]) -> ViewFeatures:
        """`look` from the maps of the backbone's stages on, for who has kept those of a frozen backbone.

        Args:
            maps: (..., N, C_k, S / 2^(k+2), S / 2^(k+2)) of stage k; None where nothing is read of it. Those
                of the last stages may be missing: the backbone goes on from the last one given.

        Raises:
            NetworkUseError: A map that is read has another shape.
        """
        shapes = self.feature_extractor.summarised_shapes
        for stage, shape in shapes.items():
            if stage >= len(maps) > min(shapes):
                break
            given = maps[stage] if stage < len(maps) else None
            if given is None or given.shape[-3:] != shape:
                has = "none" if given is None else f"one of shape {tuple(given.shape)}"
                raise NetworkUseError(
                    f"This network takes maps {shape} of stage {stage}; it was given {has}."
                )
        last = maps[-1]
        assert last is not None
        flat = [None if each is None else each.flatten(0, -4) for each in maps]
        return _as_views(*self.feature_extractor.summarise(flat), last.shape[:-3])

    def relate(self, view_features: ViewFeatures, crop_parameters: torch.Tensor) -> SceneFeatures:
        """Features of views that have heard each other.

        Args:
            view_features: N views of one scan, leading dimensions allowed.
            crop_parameters: (..., N, 3): where each crop lies in its image.

        Raises:
            NetworkUseError: More views than the network has indices for, or not one crop for each.
        """
        pooled = view_features.pooled
        views = pooled.shape[-2]
        if crop_parameters.shape != (*pooled.shape[:-1], 3):
            raise NetworkUseError(
                f"{views} views need crop parameters of shape {(*pooled.shape[:-1], 3)}, "
                f"they were given {tuple(crop_parameters.shape)}."
            )
        if views > self.preset.max_views:
            raise NetworkUseError(
                f"This network takes at most {self.preset.max_views} views, it was given {views}."
            )
        frequencies = octaves(self.preset.crop_frequencies).to(pooled.device)
        tokens = torch.cat([pooled, fourier(crop_parameters.to(pooled.dtype), frequencies)], -1)
        if not self.preset.pair_context:
            tokens = self.feature_extractor.relate(tokens)
        return SceneFeatures(tokens, view_features.maps)

    def encode(self, images: torch.Tensor, crop_parameters: torch.Tensor) -> SceneFeatures:
        """`look` and `relate` in one."""
        return self.relate(self.look(images), crop_parameters)

    def backbone_features(self, images: torch.Tensor) -> torch.Tensor:
        """Pooled image features, (..., N, 3, S, S) -> (..., N, F)."""
        return self.look(images).pooled

    def pair_contexts(self, features: SceneFeatures, i: Index, j: Index) -> torch.Tensor:
        """Everything that pairs contribute to their energies before a rotation is known.

        Args:
            features: of one scan, leading dimensions allowed.
            i: (P,) positions of the pairs' first views.
            j: (P,) positions of their second views.

        Returns:
            (..., P, H).
        """
        self._require_energy()
        context: torch.Tensor = self.embed_feature(torch.cat(self._pair_tokens(features, i, j), -1))
        if self.correlation is not None and features.maps is not None:
            maps_i, maps_j = features.maps[..., i, :, :, :], features.maps[..., j, :, :, :]
            read = self.correlation(maps_i.flatten(0, -4), maps_j.flatten(0, -4))
            context = context + read.reshape(context.shape)
        return context

    def embed_rotations(self, rotations: torch.Tensor) -> torch.Tensor:
        """Embedding of relative rotations ``R_i^T R_j``, released convention. (..., 3, 3) -> (..., H)."""
        self._require_energy()
        entries = rotations.flatten(-2).to(self.embed_query.weight.dtype)
        out: torch.Tensor = self.embed_query(fourier(entries, self.embedding.flatten()))
        return out

    def embed_relative(self, camera_j_from_camera_i: torch.Tensor) -> torch.Tensor:
        """Embedding of relative rotations between optical frames. (..., 3, 3) -> (..., H)."""
        return self.embed_rotations(conventions.released_relative(camera_j_from_camera_i))

    def pair_energies(self, contexts: torch.Tensor, embeddings: torch.Tensor) -> torch.Tensor:
        """Unnormalised log-likelihoods of rotations.

        Args:
            contexts: (..., P, H) of `pair_contexts`.
            embeddings: (K, H), the same rotations for all pairs, or (..., P, K, H), each pair's own.

        Returns:
            (..., P, K).
        """
        hidden = self.layers[:3](contexts[..., None, :] + embeddings)
        return functional.linear(hidden, *self.last_layers())[..., 0]

    def last_layers(self) -> tuple[torch.Tensor, torch.Tensor]:
        """Weight (1, H) and bias (1,) that do the work of the last two: no activation lies between them."""
        before, last = self.layers[3], self.layers[4]
        assert isinstance(before, nn.Linear)
        assert isinstance(last, nn.Linear)
        return last.weight @ before.weight, functional.linear(before.bias, last.weight, last.bias)

    def energy_head(self) -> EnergyHead:
        """`embed_relative` and `pair_energies` with the weights as they are now, for many rotations."""
        self._require_energy()
        return EnergyHead(self)

    def energies(self, view_i: SceneFeatures, view_j: SceneFeatures, rotations: torch.Tensor) -> torch.Tensor:
        """Energies of relative rotations ``R_i^T R_j`` for two views of one scan. (K, 3, 3) -> (K,)."""
        pair = SceneFeatures.stack([view_i, view_j])
        contexts = self.pair_contexts(pair, [0], [1])
        return self.pair_energies(contexts, self.embed_rotations(rotations))[..., 0, :]

    def translations(self, features: SceneFeatures) -> torch.Tensor:
        """Released translations in the preset's frame, the first camera at distance 1. -> (..., N, 3)."""
        out: torch.Tensor = self.translation_regressor(*self._tokens_with_first(features))
        ahead = 1.0 if self.preset.translation_frame == "look_at" else 0.0
        return out + torch.tensor([0.0, 0.0, ahead], dtype=out.dtype, device=out.device)

    def optical_translations(self, features: SceneFeatures) -> torch.Tensor:
        """Translations camera_from_object, optical, in the first camera's distance. -> (..., N, 3)."""
        return conventions.optical_translation(self.translations(features))

    def optical_rotations(self, features: SceneFeatures) -> torch.Tensor:
        """Regressed rotations camera_from_object, optical, the first the identity. -> (..., N, 3, 3).

        Raises:
            NetworkUseError: The preset gives energies of rotations, and no rotation as such.
        """
        if self.preset.rotation != "regression":
            raise NetworkUseError(
                f"The preset '{self.preset.name}' scores rotations and regresses none: use the solver."
            )
        a, b = self.rotation_regressor(*self._tokens_with_first(features)).unflatten(-1, (2, 3)).unbind(-2)
        x = functional.normalize(a, dim=-1)
        y = functional.normalize(b - (x * b).sum(-1, keepdim=True) * x, dim=-1)
        rotation = torch.stack([x, y, torch.linalg.cross(x, y)], -2)
        return rotation @ rotation[..., :1, :, :].mT

    def _require_energy(self) -> None:
        if self.preset.rotation != "energy":
            raise NetworkUseError(
                f"The preset '{self.preset.name}' regresses rotations and has no pair energies."
            )

    def _pair_tokens(self, features: SceneFeatures, i: Index, j: Index) -> list[torch.Tensor]:
        """Tokens (..., P, D) of the first and the second views of pairs, in the context the preset allows."""
        pair = [features.tokens[..., i, :], features.tokens[..., j, :]]
        if self.preset.pair_context:
            pair = list(self.feature_extractor.relate(torch.stack(pair, -2)).unbind(-2))
        return pair

    def _tokens_with_first(self, features: SceneFeatures) -> list[torch.Tensor]:
        """Tokens (..., N, D) of the views, and beside each that of the first view."""
        views = list(range(len(features)))
        first, each = self._pair_tokens(features, [0] * len(views), views)
        if self.preset.pair_context and len(views) > 1:
            # A view paired with itself was never trained on: the first one is read beside the second.
            first = torch.cat([first[..., 1:2, :], first[..., 1:, :]], -2)
            each = torch.cat([first[..., :1, :], each[..., 1:, :]], -2)
        return [each, first]


def _as_views(pooled: torch.Tensor, maps: torch.Tensor | None, leading: torch.Size) -> ViewFeatures:
    """(B, F) and (B, C, h, w) with the dimensions that B stands for."""
    if maps is not None:
        maps = maps.reshape(*leading, *maps.shape[1:])
    return ViewFeatures(pooled.reshape(*leading, -1), maps)
