"""The settings of a scanner, in one place: defaults, descriptions, ranges and their validation.

The node declares its ROS parameters from these fields; the replay reads the same parameter file.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from difflib import get_close_matches
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import yaml

from relpose_ros.errors import RelPoseError
from relpose_ros.inference.evidence import EvidenceSettings
from relpose_ros.views import MAX_VIEWS, MIN_VIEWS

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping

    from relpose_ros.inference.estimator import Estimator

MAX_NAME_LENGTH = 128
"""Longest object id or frame name, characters: a longer one is garbage, and would go out in every message."""


class SettingsError(RelPoseError):
    """A setting has a value it cannot have, or the parameter file cannot be read."""


def _setting(
    default: Any,
    description: str,
    *,
    choices: tuple[str, ...] | None = None,
    limits: tuple[float, float] | None = None,
    fixed: bool = False,
) -> Any:
    """A field whose metadata say what a parameter descriptor needs to know.

    ``fixed`` marks what only matters while a node starts, so that setting it later would do nothing.
    """
    metadata = {"description": description, "choices": choices, "range": limits, "fixed": fixed}
    return field(default=default, metadata=metadata)


@dataclass(frozen=True)
class ScanSettings:
    """Everything about a scan that a user may choose.

    Each field's metadata hold ``description`` (str), ``range`` (lowest and highest, or None),
    ``choices`` (allowed words, or None) and ``fixed`` (bool: read once, while the node starts).

    Raises:
        SettingsError: A value has the wrong type or lies outside its range.
    """

    object_frame: str = _setting(
        "object",
        "Name of the object frame in outgoing headers. Keep it apart from map and odom: its scale is mostly "
        "unknown.",
    )
    object_id: str = _setting(
        "object",
        "Object id of views that come without one: all Image + CameraInfo, and ObjectView where it is empty.",
    )
    max_views: int = _setting(
        MAX_VIEWS,
        "Most views held of one object. The network knows 8 at most; fewer make an estimate faster, since "
        "its time grows with the number of pairs.",
        limits=(MIN_VIEWS, MAX_VIEWS),
    )
    keep: str = _setting(
        "spread",
        "Which views stay when more than max_views arrive. first: the earliest, so that frame and set change "
        "no more. latest: the newest, for an object that is moved now and then; the frame moves on "
        "with the oldest view. spread: the first, which sets the frame, and those that look from directions "
        "furthest apart, for an orbit of many frames; where these are enough, none that would undo it.",
        choices=("first", "latest", "spread"),
    )
    max_scans: int = _setting(
        4,
        "Most objects held at once; a further one takes the place of the object seen longest ago. Bounds the "
        "memory where a tracker numbers its objects without end.",
        limits=(1, 64),
    )
    pairing_queue: int = _setting(
        30,
        "Most images, and most camera infos, that wait for the other one of the same stamp. Bounds the "
        "memory: a waiting image is held whole.",
        limits=(1, 1000),
    )
    backward_jump_s: float = _setting(
        1.0,
        "How far back, in seconds, a stamp must lie to count as time jumping backwards (a bag that loops) "
        "and not as a late message. A second message must confirm the jump before the scan starts anew.",
        limits=(0.001, 86400.0),
    )
    image_transports: tuple[str, ...] = _setting(
        ("raw", "compressed"),
        "Which kinds of image topic to listen to: raw (image) and compressed (image/compressed).",
        choices=("raw", "compressed"),
        fixed=True,
    )
    rectification: str = _setting(
        "auto",
        "What the pictures on image are. raw: as the lens bends them, by K and D of camera_info. rectified: "
        "straightened, by its P. auto: rectified where the topic has rect in its name, as image_proc calls "
        "them.",
        choices=("auto", "raw", "rectified"),
    )
    weights: str = _setting(
        "",
        "Path of a weights file, where ~ is the home folder; empty: the compact weights that ship with the "
        "package.",
    )
    precision: str = _setting(
        "float32",
        "What the published network's backbone computes in. bfloat16 takes half the time on processors that "
        "have it, and more on others; it moves energies by some hundredths of their spread. The compact "
        "network takes no notice.",
        choices=("float32", "bfloat16"),
    )
    evidence: str = _setting(
        "refine",
        "What an estimate rests on. network: the network alone. pairs: local features that match between two "
        "views speak for the pair's rotation and for the direction between the cameras. refine: where views "
        "share such points, a bundle adjustment then makes the poses exact. Matching costs a third of a "
        "second a view.",
        choices=("network", "pairs", "refine"),
    )
    surroundings: bool = _setting(
        False,
        "Whether features outside the object's box and mask may match too. A static table helps a camera "
        "that moves around it; where the object is what turns, the table says that nothing moved.",
    )
    first_view_distance: float = _setting(
        0.0,
        "Distance in metres from the first camera to the object, for positions in metres; 0: not known, and "
        "the distance is the unit of length. Where the robot's camera poses tell the scale, they go before "
        "it.",
        limits=(0.0, 1000.0),
    )
    camera_pose_position_deviation: float = _setting(
        0.005,
        "Standard deviation in metres, each axis, of the robot's camera poses where they come without a "
        "covariance: of the arm or the localisation together with the hand-eye calibration.",
        limits=(1e-6, 100.0),
    )
    camera_pose_rotation_deviation: float = _setting(
        0.01,
        "Standard deviation in rad, about each axis, of the robot's camera poses where they come without a "
        "covariance.",
        limits=(1e-6, 3.0),
    )
    threads: int = _setting(
        0,
        "Threads of PyTorch and OpenCV on the CPU; 0: as many as they take by themselves. Fewer leave cores "
        "to others.",
        limits=(0, 256),
    )
    autostart: bool = _setting(
        True,
        "Whether the node configures and activates itself; false leaves that to a lifecycle manager.",
        fixed=True,
    )
    diagnostics: bool = _setting(True, "Whether the node's state goes out on /diagnostics.")
    diagnostics_period_s: float = _setting(
        1.0, "Seconds between two diagnostics messages.", limits=(0.1, 60.0)
    )

    def __post_init__(self) -> None:
        """Refuse what no scanner could work with."""
        for each in fields(self):
            _check(each.name, getattr(self, each.name), each.default, each.metadata)
        for name in ("object_frame", "object_id"):
            value = getattr(self, name)
            if not value or len(value) > MAX_NAME_LENGTH or not value.isprintable():
                text = (
                    f"{name} is {value[:40]!r}: give a name of 1 to {MAX_NAME_LENGTH} printable characters."
                )
                raise SettingsError(text)
        if not self.image_transports:
            raise SettingsError("image_transports is empty: name raw, compressed or both.")

    @property
    def evidence_settings(self) -> EvidenceSettings:
        """What an estimator needs to know of these settings."""
        return EvidenceSettings(
            use=cast("Any", self.evidence),
            surroundings=self.surroundings,
            first_view_distance=self.first_view_distance,
        )

    def load_estimator(self, weights: Path | None = None) -> Estimator:
        """The estimator that these settings ask for.

        Args:
            weights: of another network than that of the settings.

        Raises:
            SettingsError: As `weights_path`.
            NetworkFileError: The weights are missing or none of ours.
        """
        # Here, because PyTorch takes seconds, in which a node must hear signals.
        from relpose_ros.inference.estimator import Estimator

        return Estimator.from_weights(
            weights or self.weights_path,
            self.threads,
            self.evidence_settings,
            backbone_in_bfloat16=self.precision == "bfloat16",
        )

    @property
    def weights_path(self) -> Path | None:
        """The weights file, or None for the weights that ship.

        Raises:
            SettingsError: It begins with the home folder of a user who does not exist.
        """
        try:
            return Path(self.weights).expanduser() if self.weights else None
        except RuntimeError as err:
            text = (
                f"weights is {self.weights!r}: it begins with the home folder of a user who does not exist."
            )
            raise SettingsError(text) from err

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> ScanSettings:
        """Settings from names and values, as a parameter file or a node's parameters have them.

        Names that are missing keep their defaults.

        Raises:
            SettingsError: An unknown name, or a value that its setting cannot have.
        """
        defaults = {each.name: each.default for each in fields(cls)}
        unknown = [str(name) for name in values if name not in defaults]
        if unknown:
            named = ", ".join(f"{name}{did_you_mean(name, defaults)}" for name in unknown)
            raise SettingsError(f"There is no setting {named}: the settings are {', '.join(defaults)}.")
        given = {name: _like_default(value, defaults[name]) for name, value in values.items()}
        return cls(**given)

    @classmethod
    def from_yaml(cls, path: Path) -> ScanSettings:
        """Settings from a ROS 2 parameter file (``/**: ros__parameters: ...``).

        With several nodes in the file, those named ``/**``, ``/**/scan_node``, ``scan_node`` or
        ``/scan_node`` count, a later one over an earlier one. ``use_sim_time`` and ``qos_overrides`` are not
        the scanner's: passed over.

        Raises:
            SettingsError: The file cannot be read, is no parameter file, or holds a wrong value.
        """
        try:
            document = yaml.safe_load(Path(path).read_text(encoding="utf-8"))
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as err:
            raise SettingsError(f"The parameter file {path} cannot be read: {err}.") from err
        values: dict[str, Any] = {}
        found = False
        for node, content in document.items() if isinstance(document, dict) else ():
            if node not in {"/**", "scan_node", "/scan_node", "/**/scan_node"}:
                continue
            parameters = content.get("ros__parameters") if isinstance(content, dict) else None
            if not isinstance(parameters, dict):
                raise SettingsError(f"{path}: {node} has no ros__parameters.")
            found = True
            values.update(parameters)
        if not found:
            text = (
                f"{path} holds no parameters of the scan node: start it with '/**:' and 'ros__parameters:'."
            )
            raise SettingsError(text)
        # ROS takes a dotted name as well as nested ones: qos_overrides./image.subscription.depth.
        foreign = {"use_sim_time", "qos_overrides"}
        own = {name: each for name, each in values.items() if str(name).partition(".")[0] not in foreign}
        return cls.from_mapping(own)


MEANT = "did you mean"


def did_you_mean(name: str, known: Iterable[str]) -> str:
    """The known name that is nearest to a misspelt one, in brackets; empty where none is near."""
    nearest = get_close_matches(name, known, n=1)
    return f" ({MEANT} {nearest[0]}?)" if nearest else ""


def _like_default(value: Any, default: Any) -> Any:
    """A file's or a parameter's spelling of a value, in the type its setting has."""
    if isinstance(default, tuple) and isinstance(value, (list, tuple)):
        return tuple(value)
    if isinstance(default, float) and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    return value


def _check(name: str, value: Any, default: Any, metadata: Mapping[str, Any]) -> None:
    if type(value) is not type(default):
        given, wanted = type(value).__name__, type(default).__name__
        raise SettingsError(f"{name} is {value!r} of type {given}: it must be of type {wanted}.")
    choices = metadata["choices"]
    if choices is not None:
        for word in value if isinstance(value, tuple) else (value,):
            if word not in choices:
                raise SettingsError(f"{name} is {word!r}: it must be one of {', '.join(choices)}.")
    limits = metadata["range"]
    if limits is not None and not (math.isfinite(value) and limits[0] <= value <= limits[1]):
        raise SettingsError(f"{name} is {value}: it must lie between {limits[0]} and {limits[1]}.")
