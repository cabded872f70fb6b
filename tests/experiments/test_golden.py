"""What variants make of presets is what is recorded: settings that change unseen change every result."""

import json

from tests.experiments import golden

AGAIN = "\nIf this is meant, record it again: python -m tests.experiments.golden"


def test_every_variant_and_preset_is_resolved_as_recorded():
    expected, found = json.loads(golden.FILE.read_text()), golden.lines()
    differences = [
        f"{key}:\n  recorded {expected.get(key)}\n  now      {found.get(key)}"
        for key in dict.fromkeys((*expected, *found))
        if expected.get(key) != found.get(key)
    ]
    assert not differences, "\n".join(differences[:20]) + AGAIN


def test_the_record_has_arguments_and_defaults():
    """Of ExtraSS by hand: a width that the preset gives, sigmas that nobody gives; nothing from within the factory."""
    calls = golden.resolved("extrass", "paper")["calls"]
    assert [call.partition("(")[0] for call in calls] == [
        "extrass",
        "extrass_e",
        "extrass_objective",
        "frnet_objective",
    ]
    assert calls[0].startswith("extrass(frnet_width=24, scale=2, sigma_distance=") and calls[0].endswith("width=24)")
    calls = golden.resolved("classifier", "smoke")["calls"]
    assert any(call.startswith("composition_objective(method=classifier, temporal_weight=0.1") for call in calls)
    assert not any("Network" in call or " at 0x" in call for call in calls)
