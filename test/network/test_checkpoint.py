"""Weights files: what is written is read back; anything else is refused in one sentence and runs nothing."""

from __future__ import annotations

import json
import os
import pickle
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from relpose_ros import cli
from relpose_ros.network import checkpoint
from relpose_ros.network.checkpoint import NetworkFileError
from relpose_ros.network.presets import PRESETS

if TYPE_CHECKING:
    from pathlib import Path

    from relpose_ros.network.relpose import RelPose

TABLE = "feature_extractor.feature_positional_encoding.pos_table_1"


def released_file(network: RelPose, file: Path, **changes: torch.Tensor | None) -> Path:
    """As the authors' trainer writes it; ``changes`` replaces tensors, or drops them."""
    state = {f"module.{name}": tensor for name, tensor in network.state_dict().items()}
    state |= {f"module.{name.replace('__', '.')}": tensor for name, tensor in changes.items()}
    torch.save({"state_dict": {k: v for k, v in state.items() if v is not None}, "iteration": 800000}, file)
    return file


def same_weights(a: RelPose, b: RelPose) -> bool:
    mine, other = a.state_dict(), b.state_dict()
    return list(mine) == list(other) and all(torch.equal(mine[name], other[name]) for name in mine)


def refusal(file: Path) -> str:
    with pytest.raises(NetworkFileError) as caught:
        checkpoint.load_network(file)
    text = str(caught.value)
    assert str(file) in text
    assert text.endswith(".")
    assert "\n" not in text
    assert "weights_only" not in text
    return text


@pytest.fixture
def saved(compact: RelPose, tmp_path: Path) -> Path:
    file = tmp_path / "compact.safetensors"
    checkpoint.write_network(compact, file, {"source": "a test"})
    return file


def test_a_released_checkpoint_loads_and_converts_to_the_same_network(
    compact: RelPose, tmp_path: Path
) -> None:
    source, target = released_file(compact, tmp_path / "ckpt.pth"), tmp_path / "weights.safetensors"
    loaded = checkpoint.load_network(source)
    assert same_weights(loaded, compact)
    assert loaded.preset == PRESETS["compact"]
    assert not loaded.training
    assert not any(parameter.requires_grad for parameter in loaded.parameters())
    written = checkpoint.convert(source, target)
    assert written == checkpoint.read_metadata(target)
    assert written["preset"] == "compact"
    assert written["source"] == "ckpt.pth"
    assert written["digest"] == checkpoint.digest(compact.state_dict())
    assert same_weights(checkpoint.load_network(target), compact)
    assert checkpoint.read_metadata(source) == {}


def test_a_bare_state_dict_and_foreign_safetensors_load_too(compact: RelPose, tmp_path: Path) -> None:
    import safetensors.torch

    torch.save(compact.state_dict(), tmp_path / "bare.pth")
    safetensors.torch.save_file(compact.state_dict(), tmp_path / "foreign.safetensors")
    for name in ("bare.pth", "foreign.safetensors"):
        assert same_weights(checkpoint.load_network(tmp_path / name), compact)


def test_the_prefix_is_taken_off_in_safetensors_too(compact: RelPose, tmp_path: Path) -> None:
    import safetensors.torch

    prefixed = {f"module.{name}": tensor for name, tensor in compact.state_dict().items()}
    metadata = {"preset": "compact", "digest": checkpoint.digest(prefixed)}
    safetensors.torch.save_file(prefixed, tmp_path / "prefixed.safetensors", metadata)
    assert same_weights(checkpoint.load_network(tmp_path / "prefixed.safetensors"), compact)


@pytest.mark.parametrize("dtype", [torch.float16, torch.bfloat16, torch.float64])
def test_a_checkpoint_of_another_precision_is_brought_to_single(
    compact: RelPose, tmp_path: Path, dtype: torch.dtype
) -> None:
    stored = {name: tensor.to(dtype) for name, tensor in compact.state_dict().items()}
    torch.save({"state_dict": stored}, tmp_path / "ckpt.pth")
    loaded = checkpoint.load_network(tmp_path / "ckpt.pth").state_dict()
    assert all(tensor.dtype == torch.float32 for tensor in loaded.values())
    assert all(torch.equal(loaded[name], tensor.float()) for name, tensor in stored.items())


def test_the_format_before_archives_loads_and_is_refused_where_it_ends_early(
    compact: RelPose, tmp_path: Path
) -> None:
    file = tmp_path / "ckpt.pth"
    torch.save({"state_dict": compact.state_dict()}, file, _use_new_zipfile_serialization=False)
    assert same_weights(checkpoint.load_network(file), compact)
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert "damaged or truncated" in refusal(file)


def test_metadata_of_another_preset_is_refused_with_the_names(compact: RelPose, tmp_path: Path) -> None:
    import safetensors.torch

    file = tmp_path / "weights.safetensors"
    safetensors.torch.save_file(compact.state_dict(), file, {"preset": "paper"})
    text = refusal(file)
    assert "does not fit the 'paper' network: it lacks feature_extractor." in text
    assert "embedding (1, 1, 4) instead of (1, 1, 8)" in text


def test_an_index_table_that_is_missing_or_longer_is_rebuilt(compact: RelPose, tmp_path: Path) -> None:
    longer = torch.full((1, 20, 256), 7.0)
    for change in (None, longer):
        file = released_file(compact, tmp_path / "ckpt.pth", **{TABLE: change})
        assert same_weights(checkpoint.load_network(file), compact)


def test_nothing_else_is_forgiven_and_the_names_are_listed(compact: RelPose, tmp_path: Path) -> None:
    file = tmp_path / "ckpt.pth"
    for change in (torch.zeros(1, 5, 256), torch.zeros(1, 20, 255), torch.zeros(20, 256)):
        assert TABLE in refusal(released_file(compact, file, **{TABLE: change}))
    text = refusal(
        released_file(
            compact, file, layers__4__bias=None, extra=torch.zeros(1), layers__3__weight=torch.zeros(2, 2)
        )
    )
    assert "lacks layers.4.bias;" in text
    assert "in excess extra;" in text
    assert "layers.3.weight (2, 2) instead of (128, 128)" in text
    many = {f"spare{number}": torch.zeros(1) for number in range(400)}
    text = refusal(released_file(compact, file, **many))
    assert "in excess spare0, spare1, spare2, spare3, spare4 and 395 more" in text
    broken = compact.state_dict()["layers.1.bias"].clone()
    broken[3] = float("nan")
    assert "infinite or missing in layers.1.bias" in refusal(
        released_file(compact, file, layers__1__bias=broken)
    )


@pytest.mark.parametrize(
    "bias",
    [
        torch.zeros(128, dtype=torch.int64),
        torch.zeros(128, dtype=torch.bool),
        torch.zeros(128, dtype=torch.complex64),
        torch.zeros(128, device="meta"),
        torch.ones(128).to_sparse(),
    ],
    ids=lambda bias: f"{bias.dtype} {bias.layout} {bias.device}",
)
def test_weights_that_are_no_plain_numbers_are_refused_by_name(
    compact: RelPose, tmp_path: Path, bias: torch.Tensor
) -> None:
    file = released_file(compact, tmp_path / "ckpt.pth", layers__1__bias=bias)
    assert "as anything but plain fractions layers.1.bias" in refusal(file)


def test_a_name_with_and_without_prefix_is_refused(compact: RelPose, tmp_path: Path) -> None:
    state = {f"module.{name}": tensor for name, tensor in compact.state_dict().items()}
    torch.save({"state_dict": {**state, "layers.1.bias": torch.zeros(128)}}, tmp_path / "ckpt.pth")
    assert "the name layers.1.bias;" in refusal(tmp_path / "ckpt.pth")


def test_an_archive_that_cannot_be_listed_is_not_opened(
    compact: RelPose, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = released_file(compact, tmp_path / "ckpt.pth")
    file.write_bytes(file.read_bytes()[:-30])
    opened: list[object] = []
    monkeypatch.setattr(torch, "load", lambda *given, **options: opened.append(given) or {})
    assert "damaged or truncated archive" in refusal(file)
    assert opened == []


def test_other_metadata_is_kept_through_writing_and_conversion(saved: Path, tmp_path: Path) -> None:
    calibration = json.dumps({"temperature": 1.7, "note": "säfe"})
    network = checkpoint.load_network(saved)
    checkpoint.write_network(network, saved, {**checkpoint.read_metadata(saved), "calibration": calibration})
    metadata = checkpoint.convert(saved, tmp_path / "again.safetensors")
    assert metadata["calibration"] == calibration
    assert metadata["source"] == "a test"
    assert checkpoint.read_metadata(tmp_path / "again.safetensors") == metadata


@pytest.mark.parametrize(
    "changes",
    [
        {"index_encoding": False},
        {"pair_context": True, "translation_frame": "first_camera"},
        {"rotation": "regression", "correlation": None},
        {"backbone": "residual", "stage_widths": (16, 32, 64, 128), "name": "tiny"},
        {"correlation": replace(PRESETS["compact"].correlation, layout_widths=(32, 48))},  # type: ignore[type-var]
    ],
)
def test_a_network_with_other_numbers_or_switches_says_so(changes: dict[str, object], tmp_path: Path) -> None:
    preset = replace(PRESETS["compact"], **changes)  # type: ignore[arg-type]
    network = checkpoint.random_network(preset, 0)
    checkpoint.write_network(network, tmp_path / "w.safetensors")
    loaded = checkpoint.load_network(tmp_path / "w.safetensors")
    assert loaded.preset == preset
    assert same_weights(loaded, network)


def test_half_precision_is_half_as_large_and_close(compact: RelPose, saved: Path, tmp_path: Path) -> None:
    half = tmp_path / "half.safetensors"
    checkpoint.write_network(compact, half, half=True)
    assert half.stat().st_size < 0.51 * saved.stat().st_size
    loaded = checkpoint.load_network(half)
    assert next(loaded.parameters()).dtype == torch.float32
    for ours, theirs in zip(loaded.parameters(), compact.parameters(), strict=True):
        assert torch.allclose(ours, theirs, rtol=1e-3, atol=1e-6)


def test_whoever_may_read_new_files_may_read_written_weights(saved: Path, tmp_path: Path) -> None:
    plain = tmp_path / "plain"
    plain.touch()
    assert saved.stat().st_mode == plain.stat().st_mode


def test_a_file_that_may_not_be_read_is_refused(saved: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def forbidden(*given: object, **options: object) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", forbidden)
    assert "cannot be read: Permission denied" in refusal(saved)


def test_the_command_converts(compact: RelPose, tmp_path: Path) -> None:
    source, target = released_file(compact, tmp_path / "ckpt.pth"), tmp_path / "weights.safetensors"
    assert cli.main(["convert", str(source), "--output", str(target)]) == 0
    assert same_weights(checkpoint.load_network(target), compact)


def test_loaded_weights_do_not_hang_on_the_file(saved: Path, compact: RelPose) -> None:
    loaded = checkpoint.load_network(saved)
    with saved.open("r+b") as stream:
        stream.seek(-4096, 2)
        stream.write(bytes(4096))
    assert same_weights(loaded, compact)


def test_random_networks_repeat_by_seed_and_leave_the_callers_random_state() -> None:
    torch.manual_seed(5)
    expected = torch.rand(3)
    torch.manual_seed(5)
    first = checkpoint.random_network("compact", 1)
    assert torch.equal(torch.rand(3), expected)
    assert same_weights(first, checkpoint.random_network("compact", 1))
    assert not same_weights(first, checkpoint.random_network("compact", 2))


class Trap:
    """Unpickled by an unsafe reader, it leaves a folder behind."""

    def __init__(self, target: Path) -> None:
        self.target = target

    def __reduce__(self) -> tuple[object, ...]:
        return os.mkdir, (str(self.target),)


@pytest.mark.parametrize("protocol", range(6))
@pytest.mark.parametrize("wrapped", [True, False])
def test_a_hostile_file_is_refused_and_runs_nothing(protocol: int, wrapped: bool, tmp_path: Path) -> None:
    trap, file = tmp_path / "trap", tmp_path / "ckpt.pth"
    content = {"state_dict": {"module.layers.1.bias": Trap(trap)}}
    if wrapped:
        torch.save(content, file, pickle_protocol=protocol)
    else:
        file.write_bytes(pickle.dumps(content, protocol))
    assert "refused" in refusal(file) or protocol < 2  # those have no signature and are not even opened
    assert not trap.exists()
    pickle.loads(pickle.dumps(content, protocol))
    assert trap.exists(), "the trap itself does not work"


def test_a_hostile_file_is_told_by_what_it_asks_for(tmp_path: Path) -> None:
    torch.save({"state_dict": Trap(tmp_path / "trap")}, tmp_path / "ckpt.pth")
    assert "asks for 'posix.mkdir'" in refusal(tmp_path / "ckpt.pth")


@pytest.mark.parametrize("share", [0.0, 0.0001, 0.3, 0.9, 0.99999])
@pytest.mark.parametrize("kind", ["ckpt.pth", "weights.safetensors"])
def test_a_truncated_file_is_refused(compact: RelPose, tmp_path: Path, kind: str, share: float) -> None:
    file = tmp_path / kind
    released_file(compact, file) if kind == "ckpt.pth" else checkpoint.write_network(compact, file)
    content = file.read_bytes()
    file.write_bytes(content[: int(len(content) * share)])
    text = refusal(file)
    assert "empty" in text if share == 0 else "damaged" in text or "no format" in text


def test_one_changed_bit_is_noticed(saved: Path) -> None:
    content = bytearray(saved.read_bytes())
    content[len(content) // 2] ^= 1
    saved.write_bytes(content)
    assert "its digest is not that of its weights" in refusal(saved)


@given(
    st.binary(max_size=300),
    st.sampled_from([b"", b"PK\x03\x04", b"\x80\x02", b"\x80\x04", b"\x10" + bytes(7) + b"{"]),
)
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture], max_examples=200)
def test_any_bytes_at_all_are_refused_in_one_sentence(tmp_path: Path, content: bytes, head: bytes) -> None:
    file = tmp_path / "any"
    file.write_bytes(head + content)
    refusal(file)


def test_foreign_files_are_called_by_their_name(tmp_path: Path) -> None:
    file = tmp_path / "file"

    def told(content: bytes) -> str:
        file.write_bytes(content)
        return refusal(file)

    assert "is empty" in told(b"")
    assert "a web page" in told(b"<!DOCTYPE html><html>")
    assert "git lfs pull" in told(b"version https://git-lfs.github.com/spec/v1\noid sha256:00\n")
    assert "a PNG image" in told(b"\x89PNG\r\n\x1a\n" + bytes(50))
    assert "of no format that is known" in told(b"plain text")
    np.savez(tmp_path / "arrays.npz", a=np.zeros(3))
    assert "a NumPy archive" in refusal(tmp_path / "arrays.npz")
    torch.save([1, 2], file)
    assert "holds a list" in refusal(file)
    torch.save({"model": 3, "epoch": 1}, file)
    assert "no state dict but model, epoch" in refusal(file)
    torch.save({"state_dict": {}}, file)
    assert "no state dict but nothing" in refusal(file)
    torch.save({"conv1.weight": torch.zeros(2), "fc.bias": torch.zeros(2)}, file)
    assert "another network (2 tensors such as 'conv1.weight')" in refusal(file)
    assert "is a folder" in refusal(tmp_path)
    assert "does not exist" in refusal(tmp_path / "nowhere")


def test_a_network_from_the_future_is_refused(saved: Path, compact: RelPose) -> None:
    import safetensors.torch

    for changes in (
        *('{"wavelets": 3}', "[", "3", '{"correlation": {"stage": 1}}', '{"correlation": 5}'),
        *(
            '{"backbone": "residual", "stem_width": -5}',
            '{"heads": "x"}',
            '{"descriptor_depth": 1}',
            '{"layers": null}',
        ),
        *(
            '{"rotation": "spin"}',
            '{"backbone": 3}',
            '{"translation_frame": "lookat"}',
            '{"image_size": 1.5}',
        ),
    ):
        metadata = {"preset": "compact", "preset_changes": changes}
        safetensors.torch.save_file(compact.state_dict(), saved, metadata)
        assert "a network unknown here" in refusal(saved)


def test_what_cannot_be_written_is_said_and_leaves_the_old_file(saved: Path, compact: RelPose) -> None:
    with pytest.raises(NetworkFileError, match="cannot be written"):
        checkpoint.write_network(compact, saved.parent / "nowhere" / "w.safetensors")
    assert [file.name for file in saved.parent.iterdir()] == [saved.name]


def test_without_shipped_weights_the_option_is_named(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(checkpoint, "SHIPPED_WEIGHTS", tmp_path / "compact.safetensors")
    with pytest.raises(NetworkFileError, match="--weights"):
        checkpoint.load_network()


def test_shipped_weights_are_the_default(
    monkeypatch: pytest.MonkeyPatch, saved: Path, compact: RelPose
) -> None:
    monkeypatch.setattr(checkpoint, "SHIPPED_WEIGHTS", saved)
    assert same_weights(checkpoint.load_network(), compact)
    assert checkpoint.read_metadata()["source"] == "a test"
