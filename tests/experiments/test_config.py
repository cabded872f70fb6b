import dataclasses

import pytest

from experiments.config import _LEAST, _POSITIVE, PRESETS, Config, make_config
from experiments.variants import VARIANTS, compared, config_of, get_variant, stages_of


def test_overrides_are_typed():
    overrides = ["size=[128,72]", "steps=10", "seconds=null", "learning_rate=1e-3", "tune=false", "vgg=w.npz"]
    config = make_config("quick", overrides)
    assert (config.size, config.steps, config.seconds, config.learning_rate) == ((128, 72), 10, None, 1e-3)
    assert config.tune is False and config.vgg == "w.npz"


@pytest.mark.parametrize(
    ("preset", "overrides", "message"),
    [
        ("fast", [], "unknown preset 'fast'; choose one of smoke, quick, paper"),
        ("quick", ["widht=3"], "unknown key 'widht'; valid keys are seed, size"),
        ("quick", ["width"], "expected key=value"),
        ("quick", ["width=wide"], "width=wide: expected int"),
        ("quick", ["size=[96]"], r"size=\[96\]: expected \[width,height\]"),
        ("quick", ["seconds=null"], "steps and seconds are both null"),
        ("quick", ["test_frames=1"], "--set test_frames: expected at least 2 frames, got 1"),
        ("quick", ["width=0"], "--set width: expected at least 1 channel, got 0"),
        ("quick", ["seed=-1"], "--set seed: expected at least 0, got -1"),
        ("quick", ["scale=0"], "--set scale: expected at least 1, got 0"),
        ("quick", ["warmup=-3"], "--set warmup: expected at least 0 frames, got -3"),
        ("quick", ["test_spp=0"], "--set test_spp: expected at least 1 sample, got 0"),
        ("quick", ["steps=-1", "seconds=null"], "--set steps: expected at least 1 step, got -1"),
        ("quick", ["first_steps=0"], "--set first_steps: expected at least 1 step, got 0"),
        ("quick", ["seconds=0"], "--set seconds: expected a number above 0, got 0"),
        ("quick", ["first_seconds=Infinity"], "--set first_seconds: expected a number above 0, got inf"),
        ("quick", ["learning_rate=NaN"], "--set learning_rate: expected a number above 0, got nan"),
        ("quick", ["vgg_weight=NaN"], "--set vgg_weight: expected at least 0, got nan"),
        ("quick", ["average=1"], r"--set average: expected a decay in \[0, 1\), got 1"),
        ("quick", ["average=NaN"], r"--set average: expected a decay in \[0, 1\), got nan"),
        ("quick", ["validations=0"], "--set validations: expected at least 1 validation, got 0"),
        ("quick", ["mip_bias=-Infinity"], "--set mip_bias: expected a finite number, got -inf"),
    ],
)
def test_bad_settings_say_what_is_valid(preset, overrides, message):
    with pytest.raises(ValueError, match=message):
        make_config(preset, overrides)


def test_every_number_has_a_bound():
    kinds = (int, float, int | None, float | None)
    numbers = {field.name for field in dataclasses.fields(Config) if field.type in kinds}
    assert numbers - {"mip_bias", "average"} == set(_LEAST) | set(_POSITIVE)


def test_every_preset_passes_its_own_check():
    for preset in PRESETS:
        make_config(preset, [])


def test_variants_are_listed_for_an_unknown_name():
    with pytest.raises(ValueError, match="unknown variant 'extras'; choose one of extrass, extrass-e"):
        get_variant("extras")


def test_a_comparison_ends_with_the_variant_and_names_it_once():
    for name in VARIANTS:
        rows = compared([name])
        assert rows[-1] == name and rows.count(name) == 1 and set(rows) <= set(VARIANTS)
    assert "extrass-e" in compared(["extrass"]) and "extrass-e" not in compared(["extrass-w"])


def test_a_variant_changes_training_alone_and_the_command_line_has_the_last_word():
    data = {"seed", "size", "scale", "mip_bias", "train_spp", "test_spp", "train_frames", "test_frames", "optimize"}
    data |= {f"{split}_sequences" for split in ("train", "validation", "test")}
    for name, variant in VARIANTS.items():
        assert set(variant.presets) <= set(PRESETS), name
        assert not data & {key for settings in variant.presets.values() for key in settings}, name
        assert variant.weights is None or not (variant.presets or variant.stages(PRESETS["smoke"])), name
        assert all(config_of(name, preset, []) for preset in PRESETS)
    changed = {"quick": {"batch": 2, "width": 5}}
    config = make_config("quick", ["width=7"], changed)
    assert (config.batch, config.width) == (2, 7) and make_config("smoke", [], changed) == PRESETS["smoke"]


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.stages(PRESETS["smoke"])])
def test_anneal_is_a_switch_of_every_stage(name):
    """Without it each stage keeps its peak; with it (the default of ``quick``) each one decays."""
    kept = [stage.decay(1.0) for stage in stages_of(name, config_of(name, "quick", ["anneal=false"]))]
    decayed = [stage.decay(1.0) for stage in stages_of(name, config_of(name, "quick", []))]
    assert kept == [1.0] * len(decayed) and max(decayed) < 0.1 and decayed


def test_a_crop_that_a_paper_gives_in_output_pixels_follows_the_scale():
    """Thesis 002, section 4.3.2: 256 / f_u."""
    for name in ("dlctus", "dlctus-theta-0.5", "dlctus-dilated", "nsrr"):
        for scale, side in ((2, 128), (4, 64)):
            assert config_of(name, "paper", [f"scale={scale}"]).crop == (side, side), name
        assert config_of(name, "paper", ["scale=4", "crop=[40,32]"]).crop == (40, 32)
        assert config_of(name, "quick", ["scale=4"]).crop == PRESETS["quick"].crop
    assert config_of("extrass", "paper", ["scale=4"]).crop == PRESETS["paper"].crop  # not said there
