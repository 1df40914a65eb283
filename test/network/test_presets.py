"""Presets and variants by name, and switches that contradict each other."""

from __future__ import annotations

from dataclasses import replace

import pytest

from relpose_ros.network.presets import PRESETS, VARIANTS, PresetError, named_preset, variants_of


@pytest.mark.parametrize("name", PRESETS)
def test_presets_and_their_variants_are_found_by_name(name: str) -> None:
    assert named_preset(name) is PRESETS[name]
    for variant, changes in VARIANTS.items():
        varied = named_preset(name, [variant])
        assert varied == replace(PRESETS[name], **changes)
        assert varied != PRESETS[name]
        assert varied.name == name
    both = named_preset(name, ["first-camera", "regression"])
    assert (both.rotation, both.translation_frame) == ("regression", "first_camera")
    assert both == named_preset(name, ["regression", "first-camera"])


@pytest.mark.parametrize("name", PRESETS)
def test_a_preset_tells_its_variants(name: str) -> None:
    assert variants_of(PRESETS[name]) == ()
    for variant in VARIANTS:
        assert variants_of(named_preset(name, [variant])) == (variant,)
    assert variants_of(named_preset(name, ["first-camera", "regression"])) == ("regression", "first-camera")


def test_what_there_is_not_is_refused_with_what_there_is() -> None:
    with pytest.raises(PresetError, match="no preset 'huge'; choose among paper, compact"):
        named_preset("huge")
    with pytest.raises(PresetError, match="no variant 'index'; choose among no-index, pair-context"):
        named_preset("paper", ["index"])
    with pytest.raises(
        PresetError, match="A network's rotation is 'spin'; it must be one of energy, regression"
    ):
        replace(PRESETS["paper"], rotation="spin")  # type: ignore[arg-type]


def test_a_network_that_regresses_correlates_no_pairs() -> None:
    with pytest.raises(PresetError, match="correlation must be None"):
        replace(PRESETS["compact"], rotation="regression")
