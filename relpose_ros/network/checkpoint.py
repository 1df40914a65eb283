"""Weights in files: opened safely, checked name for name, written with what one must know of them.

Two kinds are read. A safetensors file carries its preset, where it came from, a digest of its weights and
whatever else was learned with them (a calibration). A released checkpoint is a PyTorch file with the
key ``state_dict``; it is unpickled with ``weights_only``, so that it can hold data and run nothing.
"""

from __future__ import annotations

import functools
import hashlib
import json
import pickle
import re
import warnings
import zipfile
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import torch

from relpose_ros.errors import RelPoseError
from relpose_ros.network.encoder import IndexEncoding
from relpose_ros.network.presets import PRESETS, CorrelationSettings, Preset
from relpose_ros.network.relpose import RelPose

if TYPE_CHECKING:
    from collections.abc import Iterable, Mapping
    from types import ModuleType

    Tensors = dict[str, torch.Tensor]

SHIPPED_WEIGHTS = Path(__file__).resolve().parent.parent / "weights" / "compact.safetensors"
_INDEX_TABLE = "feature_extractor.feature_positional_encoding.pos_table_1"
_EXPECTED = (
    "a RelPose++ checkpoint (.pth with the key 'state_dict') or weights written by 'relpose_ros convert'"
)
_NAMES_SHOWN = 5
"""Of one kind, in a refusal: enough to see what is wrong in a sentence that one can read."""
_SIGNATURES = {
    b"version https://git-lfs": "a Git LFS pointer without its file (run 'git lfs pull')",
    b"<": "a web page or XML (did the download ask for a login?)",
    b"{": "JSON text",
    b"\x89PNG": "a PNG image",
    b"\xff\xd8": "a JPEG image",
    b"\x93NUMPY": "a NumPy array",
    b"\x89HDF": "an HDF5 file",
    b"\x89MCAP": "an MCAP recording",
    b"SQLite": "an SQLite database",
    b"\x1f\x8b": "a gzip archive",
    b"%PDF": "a PDF document",
}


class NetworkFileError(RelPoseError):
    """A weights file that is missing, damaged, unsafe, or of another network."""


def load_network(path: Path | str | None = None) -> RelPose:
    """The network of a weights file, ready to use: on the CPU, float32, in eval mode, without gradients.

    Args:
        path: a safetensors file or a released checkpoint; None for the weights that ship with the package.

    Raises:
        NetworkFileError: The file is missing, damaged, unsafe, or holds another network.
    """
    file = _existing(path)
    tensors, metadata = _read(file)
    preset = _stored_preset(metadata, file) or _guessed_preset(tensors, file)
    tensors = _checked(tensors, preset, file)
    with torch.device("meta"):
        network = RelPose(preset)
    # Assigned, so that nobody waits for random weights that are thrown away; copied, because a file
    # that is mapped into memory may change under a running node.
    state = {
        name: (tensor.float() if tensor.is_floating_point() else tensor).clone()
        for name, tensor in tensors.items()
    }
    network.load_state_dict(state, strict=True, assign=True)
    return network.eval().requires_grad_(requires_grad=False)


def read_metadata(path: Path | str | None = None) -> dict[str, str]:
    """What a safetensors file says of its weights: preset, source, digest, perhaps calibration.

    A released checkpoint says nothing: an empty dictionary.

    Raises:
        NetworkFileError: as `load_network`.
    """
    file = _existing(path)
    if _is_safetensors(file):
        return _read_safetensors(file, tensors=False)[1]
    return {}


def write_network(
    network: RelPose, path: Path | str, metadata: Mapping[str, str] | None = None, *, half: bool = False
) -> dict[str, str]:
    """Writes weights as safetensors, all at once or not at all.

    Args:
        network: any preset, also one with other numbers or switches than its namesake in `PRESETS`.
        path: of the file; an existing one is replaced.
        metadata: to store beside preset and digest, for instance ``source`` and ``calibration``.
        half: store in float16, half as large and precise to three digits.

    Returns:
        The metadata as written.

    Raises:
        NetworkFileError: The safetensors package is missing or the file cannot be written.
    """
    target = Path(path)
    dtype = torch.float16 if half else torch.float32
    state = {
        name: tensor.detach().cpu().to(dtype if tensor.is_floating_point() else tensor.dtype).contiguous()
        for name, tensor in network.state_dict().items()
    }
    written = {**(metadata or {}), **_preset_metadata(network.preset), "digest": digest(state)}
    beside = target.with_name(target.name + ".partial")
    safetensors = _safetensors()
    try:
        beside.touch()
        mode = beside.stat().st_mode
        safetensors.torch.save_file(state, beside, metadata=written)
        beside.chmod(mode)  # safetensors leaves a file that its owner alone may read
        beside.replace(target)
    except (OSError, safetensors.SafetensorError) as err:
        beside.unlink(missing_ok=True)
        raise NetworkFileError(f"The weights cannot be written to '{target}': {err}.") from err
    return written


def convert(source: Path | str, target: Path | str) -> dict[str, str]:
    """Writes the weights of any accepted file as safetensors, and returns the metadata written.

    What the source says of itself is kept.

    Raises:
        NetworkFileError: as `load_network` and `write_network`.
    """
    network = load_network(source)
    return write_network(network, target, {"source": Path(source).name, **read_metadata(source)})


def random_network(preset: Preset | str, seed: int) -> RelPose:
    """A network with seeded random weights, in eval mode: for tests, benchmarks, and the start of training.

    The caller's random state is left as it was.
    """
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return RelPose(PRESETS[preset] if isinstance(preset, str) else preset).eval()


def digest(tensors: Tensors) -> str:
    """SHA-256 over names, types, shapes and bytes of tensors, in order of their names."""
    total = hashlib.sha256()
    for name in sorted(tensors):
        tensor = tensors[name].contiguous()
        total.update(f"{name} {tensor.dtype} {tuple(tensor.shape)}\n".encode())
        total.update(tensor.reshape(-1).view(torch.uint8).numpy().data)
    return total.hexdigest()


def _existing(path: Path | str | None) -> Path:
    file = SHIPPED_WEIGHTS if path is None else Path(path)
    if file.is_file():
        try:
            file.open("rb").close()
        except OSError as err:
            raise NetworkFileError(f"The weights file '{file}' cannot be read: {err.strerror}.") from err
        return file
    if path is None:
        raise NetworkFileError(f"No weights are installed at '{file}'; name a file with --weights.")
    what = "is a folder" if file.is_dir() else "does not exist"
    raise NetworkFileError(f"The weights file '{file}' {what}; expected {_EXPECTED}.")


def _read(file: Path) -> tuple[Tensors, dict[str, str]]:
    state, metadata = _read_safetensors(file) if _is_safetensors(file) else (_read_checkpoint(file), {})
    return _without_prefix(state, file), metadata


def _is_safetensors(file: Path) -> bool:
    with file.open("rb") as stream:
        head = stream.read(9)
    return len(head) == 9 and head[8:] == b"{" and int.from_bytes(head[:8], "little") < 1 << 32


def _safetensors() -> ModuleType:
    try:
        import safetensors.torch  # here, because the core must import without it
    except ImportError as err:
        text = "Reading and writing safetensors needs the package 'safetensors': pip install safetensors."
        raise NetworkFileError(text) from err
    return safetensors


def _read_safetensors(file: Path, *, tensors: bool = True) -> tuple[Tensors, dict[str, str]]:
    safetensors = _safetensors()
    try:
        with safetensors.safe_open(file, framework="pt") as content:
            metadata = dict(content.metadata() or {})
            state = {name: content.get_tensor(name) for name in content.keys()} if tensors else {}  # noqa: SIM118
    except (OSError, RuntimeError, ValueError, safetensors.SafetensorError) as err:
        text = (
            f"The weights file '{file}' is a damaged or truncated safetensors file ({err}); fetch it again."
        )
        raise NetworkFileError(text) from err
    if tensors and "digest" in metadata and metadata["digest"] != digest(state):
        raise NetworkFileError(
            f"The weights file '{file}' is damaged: its digest is not that of its weights; fetch it again."
        )
    return state, metadata


def _read_checkpoint(file: Path) -> Tensors:
    with file.open("rb") as stream:
        head = stream.read(24)
    if not head:
        raise NetworkFileError(f"The weights file '{file}' is empty; expected {_EXPECTED}.")
    kind = next((kind for magic, kind in _SIGNATURES.items() if head.startswith(magic)), None)
    if kind is None and head.startswith(b"PK"):
        kind = _foreign_archive(file)
    elif kind is None and not head.startswith(b"\x80"):
        kind = "of no format that is known"
    if kind is not None:
        raise NetworkFileError(f"The weights file '{file}' is {kind}; expected {_EXPECTED}.")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of pickle protocols: what cannot be read is refused below
            content = torch.load(file, map_location="cpu", weights_only=True)
    except Exception as err:  # a damaged pickle can raise anything
        raise NetworkFileError(_refusal(file, err)) from err
    return _state_dict(content, file)


def _foreign_archive(file: Path) -> str | None:
    """What a zip archive is, if it is no PyTorch checkpoint."""
    try:
        with zipfile.ZipFile(file) as archive:
            names = archive.namelist()
    except zipfile.BadZipFile:
        # Not left to torch: what another reader makes of it has not been looked at here.
        return "a damaged or truncated archive"
    if any(name.endswith(".npy") for name in names):
        return "a NumPy archive"
    if any(name.endswith("/constants.pkl") for name in names):
        return "a TorchScript program"
    return None if any(name.endswith("data.pkl") for name in names) else "a zip archive"


def _refusal(file: Path, err: Exception) -> str:
    if wanted := re.search(r"GLOBAL ([\w.]+)", str(err)):
        return (
            f"The weights file '{file}' was refused: it is a Python pickle that asks for '{wanted[1]}', "
            f"which could run code; expected {_EXPECTED}."
        )
    # The text of the error would advise to open the file unsafely.
    more = " or holds more than tensors" if isinstance(err, pickle.UnpicklingError) else ""
    return f"The weights file '{file}' was refused: it is damaged or truncated{more}; expected {_EXPECTED}."


def _state_dict(content: Any, file: Path) -> Tensors:
    state = content.get("state_dict", content) if isinstance(content, dict) else content
    if not isinstance(state, dict):
        raise NetworkFileError(
            f"The weights file '{file}' holds a {type(state).__name__}; expected {_EXPECTED}."
        )
    if not state or not all(isinstance(value, torch.Tensor) for value in state.values()):
        names = _listed(str(name) for name in state)
        raise NetworkFileError(
            f"The weights file '{file}' has no state dict but {names or 'nothing'}; expected {_EXPECTED}."
        )
    return {str(name): tensor for name, tensor in state.items()}


def _without_prefix(state: Tensors, file: Path) -> Tensors:
    """Names as they were before a trainer's wrapper put "module." before each."""
    bare = [name.removeprefix("module.") for name in state]
    if twice := [name for name, times in Counter(bare).items() if times > 1]:
        raise NetworkFileError(
            f"The weights file '{file}' holds with and without 'module.' before the name {_listed(twice)}; "
            f"expected {_EXPECTED}."
        )
    return dict(zip(bare, state.values(), strict=True))


def _preset_metadata(preset: Preset) -> dict[str, str]:
    """The preset's name, and as JSON what it has otherwise than its namesake."""
    namesake = asdict(PRESETS.get(preset.name, Preset(preset.name)))
    changed = {field: value for field, value in asdict(preset).items() if value != namesake[field]}
    return {"preset": preset.name} | ({"preset_changes": json.dumps(changed)} if changed else {})


def _stored_preset(metadata: Mapping[str, str], file: Path) -> Preset | None:
    if "preset" not in metadata:
        return None
    name = metadata["preset"]
    try:
        changes = json.loads(metadata.get("preset_changes", "{}"))
        changes = {
            field: tuple(value) if isinstance(value, list) else value for field, value in changes.items()
        }
        if changes.get("correlation") is not None:
            settings = changes["correlation"]
            settings["layout_widths"] = tuple(settings["layout_widths"])
            changes["correlation"] = CorrelationSettings(**settings)
        preset = replace(PRESETS.get(name, Preset(name)), **changes)
        _expected(preset)
        return preset
    except Exception as err:  # numbers from a file can make the building of a network fail in any way
        reason = " ".join(str(err).split())
        text = f"The weights file '{file}' describes a network unknown here ({reason}); update relpose_ros."
        raise NetworkFileError(text) from err


def _guessed_preset(tensors: Tensors, file: Path) -> Preset:
    """The known preset of whose names the file has the largest share: a released checkpoint does not say."""
    shared = {preset.name: len(_expected(preset).keys() & tensors.keys()) for preset in PRESETS.values()}
    best = max(shared, key=lambda name: (shared[name] / len(_expected(PRESETS[name])), name))
    if shared[best] < len(tensors) / 4:
        raise NetworkFileError(
            f"The weights file '{file}' holds another network ({len(tensors)} tensors such as "
            f"'{next(iter(tensors))}'); expected {_EXPECTED}."
        )
    return PRESETS[best]


@functools.lru_cache(maxsize=8)
def _expected(preset: Preset) -> Tensors:
    """The state dict's names, shapes and types, without numbers."""
    with torch.device("meta"):
        return dict(RelPose(preset).state_dict())


def _checked(tensors: Tensors, preset: Preset, file: Path) -> Tensors:
    """The tensors as the preset names them; an index table that is missing or longer is rebuilt.

    Raises:
        NetworkFileError: on any other difference, with the names.
    """
    expected = _expected(preset)
    tensors = dict(tensors)
    if _INDEX_TABLE in expected:
        wanted = tuple(expected[_INDEX_TABLE].shape)
        table = tensors.get(_INDEX_TABLE)
        longer = table is not None and table.ndim == 3 and table.shape[1] > wanted[1]
        if table is None or (longer and table.shape[::2] == wanted[::2]):
            tensors[_INDEX_TABLE] = IndexEncoding.table(*wanted[1:])
    complaints = []
    if missing := [name for name in expected if name not in tensors]:
        complaints.append(f"it lacks {_listed(missing)}")
    if unknown := [name for name in tensors if name not in expected]:
        complaints.append(f"it has in excess {_listed(unknown)}")
    if misshapen := [
        f"{name} {tuple(tensors[name].shape)} instead of {tuple(like.shape)}"
        for name, like in expected.items()
        if name in tensors and tensors[name].shape != like.shape
    ]:
        complaints.append(f"it has in another shape {_listed(misshapen)}")
    if mistyped := [
        f"{name} {tensors[name].dtype}"
        for name, like in expected.items()
        if name in tensors and not _can_stand_for(tensors[name], like)
    ]:
        complaints.append(f"it has as anything but plain fractions {_listed(mistyped)}")
    if not complaints and (
        broken := [name for name, tensor in tensors.items() if not tensor.float().sum().isfinite()]
    ):
        complaints.append(f"numbers are infinite or missing in {_listed(broken)}")
    if complaints:
        text = f"The weights file '{file}' does not fit the '{preset.name}' network: {'; '.join(complaints)}."
        raise NetworkFileError(text)
    return tensors


def _can_stand_for(tensor: torch.Tensor, like: torch.Tensor) -> bool:
    """Whether it holds real numbers, each of them, with fractions where those are expected."""
    held = tensor.layout == torch.strided and not (tensor.is_meta or tensor.is_quantized)
    return held and not tensor.is_complex() and (tensor.is_floating_point() or not like.is_floating_point())


def _listed(names: Iterable[str]) -> str:
    every = list(names)
    more = f" and {len(every) - _NAMES_SHOWN} more" if len(every) > _NAMES_SHOWN else ""
    return ", ".join(every[:_NAMES_SHOWN]) + more
