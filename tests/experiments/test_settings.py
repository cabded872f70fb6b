import dataclasses
import functools
import json
from pathlib import Path

import pytest

from essjax import methods
from experiments import comparison
from experiments.members import all_settings, resolve, settings_of
from experiments.settings import PRESETS, SHARED, arguments, flatten, make_settings
from experiments.variants import VARIANTS, compared, get_variant


def test_overrides_are_typed():
    overrides = ["data.size=[128,72]", "frnet.steps=10", "stages.extrassnet.learning_rate=1e-3", "frnet.seconds=null"]
    settings = settings_of("extrass", "quick", [*overrides, "evaluation.tune=false", "training.vgg=w:1.npz"])
    assert settings.data.size == (128, 72) and settings.evaluation.tune is False and settings.training.vgg == "w:1.npz"
    assert (settings.stages["frnet"].steps, settings.stages["frnet"].seconds) == (10, None)
    assert settings.stages["extrassnet"].learning_rate == 1e-3
    assert settings_of("extrass", "quick", ["method.sigma_guide=[0.1,0.2]"]).method.sigma_guide == (0.1, 0.2)


def test_a_stage_may_be_named_alone_or_left_out():
    short = settings_of("extrass", "quick", ["frnet.batch=3", "stages.clip=5", "stages.crop=64"])
    long = [f"stages.{name}.{setting}" for name in ("frnet", "extrassnet") for setting in ("clip=5", "crop=64")]
    assert short == settings_of("extrass", "quick", ["stages.frnet.batch=3", *long])
    assert [stage.batch for stage in short.stages.values()] == [3, 4]


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("widht=3", "unknown setting 'widht'; the top level has seed, .*, method, stages, frnet, extrassnet.$"),
        ("method.widht=3", "'method.widht'; method has width, frnet_width, sigma_guide, sigma_distance.$"),
        ("frnet.loss.weight=3", "unknown setting 'stages.frnet.loss.weight'; stages.frnet.loss has feature_weight.$"),
        ("stages.fasset.batch=3", "stages has frnet, extrassnet. Did you mean stages.frnet.batch or"),
        ("method.scale=4", "method has width, .*. Did you mean data.scale?"),
        ("size=[96,54]", "unknown setting 'size'; .* Did you mean data.size?"),  # as it was called before
        ("first_steps=3", "Did you mean stages.frnet.steps or stages.extrassnet.steps?"),
        ("vgg=w.npz", "Did you mean training.vgg?"),
        ("data=3", "data is a group of settings: size, scale, "),
        ("seed.first=3", "unknown setting 'seed.first'; the top level has seed, "),
        ("width", "--set width: expected path=value."),
        ("method.width=wide", "--set method.width: expected int, got 'wide'"),
        ("data.size=[96]", r"--set data.size: expected \[width,height\], got \(96,\)"),
        ("data.jitter=sobol", r"--set data.jitter: expected Literal\['kronecker', 'dlctus'\], got 'sobol'"),
        ("frnet.seconds=null", "stages.frnet.steps and seconds are both null; give one of them"),
        ("data.test_frames=1", "--set data.test_frames: expected at least 2, got 1"),
        ("method.width=0", "--set method.width: expected at least 1, got 0"),
        ("seed=-1", "--set seed: expected at least 0 and less than .*, got -1"),
        ("evaluation.warmup=-3", "--set evaluation.warmup: expected at least 0, got -3"),
        ("frnet.seconds=0", "--set stages.frnet.seconds: expected a number above 0, got 0"),
        ("frnet.seconds=Infinity", "--set stages.frnet.seconds: expected at least 0, got inf"),
        ("frnet.learning_rate=NaN", "--set stages.frnet.learning_rate: expected at least 0, got nan"),
        ("extrassnet.loss.vgg_weight=NaN", "vgg_weight: expected at least 0, got nan"),
        ("training.average=1", "--set training.average: expected at least 0 and less than 1, got 1"),
        ("training.validations=0", "--set training.validations: expected at least 1, got 0"),
        ("data.mip_bias=-Infinity", "--set data.mip_bias: expected a finite number, got -inf"),
        ("data.size=[0,4]", "--set data.size: expected at least 1, got 0"),
        ("fasset:method.width=3", "'fasset' is not trained in this run; expected one of extrass."),
    ],
)  # fmt: skip
def test_bad_settings_say_what_is_valid(override, message):
    with pytest.raises(ValueError, match=message):
        settings_of("extrass", "quick", [override])


def test_an_unknown_preset():
    with pytest.raises(ValueError, match="unknown preset 'fast'; choose one of smoke, quick, paper"):
        settings_of("extrass", "fast")


def test_in_a_comparison_a_variant_has_settings_of_its_own():
    found = all_settings(["extrass", "fasset"], "quick", ["fasset:method.width=5", "fasset:fasset.clip=9", "seed=3"])
    assert found["fasset"].method.width == 5 and found["fasset"].stages["fasset"].clip == 9
    assert found["extrass"] == settings_of("extrass", "quick", ["seed=3"])
    with pytest.raises(ValueError, match="has width, hidden, .* To set it for one variant alone: VARIANT:path=value"):
        all_settings(["extrass", "fasset"], "quick", ["method.frnet_width=5"])
    with pytest.raises(ValueError, match="--set fasset:data.scale=4: all variants of a run have this in common"):
        all_settings(["extrass", "fasset"], "quick", ["fasset:data.scale=4"])


def test_every_argument_of_a_factory_is_a_setting_but_for_those_that_make_the_variant():
    def factory(first, scale: int = 2, *, width: int = 3, sigma: float | tuple[float, ...] = 0.5, hook: type = int):
        return first, scale, width, sigma, hook

    assert list(arguments(factory).__dataclass_fields__) == ["width", "sigma"]
    assert list(arguments(functools.partial(factory, sigma=1.0)).__dataclass_fields__) == ["width"]
    assert vars(arguments(factory)()) == {"width": 3, "sigma": 0.5}
    assert "history" not in flatten(settings_of("extranet-no-history", "smoke"))


def test_tables_fill_every_setting_and_pass_their_own_check():
    for name in VARIANTS:
        for preset in PRESETS:
            assert settings_of(name, preset).seed == 0
    with pytest.raises(ValueError, match="--set data.train_spp: expected int, got None"):
        make_settings("quick", table={"data.train_spp": (None, None, None)})


def test_variants_are_listed_for_an_unknown_name():
    with pytest.raises(ValueError, match="unknown variant 'extras'; choose one of extrass, extrass-e"):
        get_variant("extras")


def test_a_comparison_ends_with_the_variant_and_names_it_once():
    for name in VARIANTS:
        rows = compared([name])
        assert rows[-1] == name and rows.count(name) == 1 and set(rows) <= set(VARIANTS)
    assert "extrass-e" in compared(["extrass"]) and "extrass-e" not in compared(["extrass-w"])


def test_a_variant_changes_its_method_and_its_training_alone():
    for name, variant in VARIANTS.items():
        assert not [path for path in variant.presets if path.split(".")[0] in SHARED], name
        assert variant.weights is None or not (variant.presets or variant.stages), name


def members(names, preset="quick", overrides=()):
    return resolve(all_settings(names, preset, overrides), preset, Path("out"))


@pytest.mark.parametrize("name", [name for name, variant in VARIANTS.items() if variant.stages])
def test_anneal_is_a_switch_of_every_stage(name):
    """Without it each stage keeps its peak; with it (the default of ``quick``) each one decays."""
    kept = [stage.decay(1.0) for stage in members([name], overrides=["training.anneal=false"])[name].stages]
    decayed = [stage.decay(1.0) for stage in members([name])[name].stages]
    assert kept == [1.0] * len(decayed) and max(decayed) < 0.1 and decayed


def test_rows_that_hold_the_variables_of_a_training_have_its_widths():
    found = members(["extrass"], overrides=["method.frnet_width=5", "method.width=7", "method.sigma_distance=3.0"])
    part, whole = found["extrass-e"], found["extrass"]
    assert part.owner == whole.owner == "extrass" and [stage.name for stage in part.stages] == ["frnet"]
    assert part.settings is whole.settings and found["taau"].owner == "" and not found["taau"].stages
    alone = members(["extrass-e"])["extrass-e"]
    assert alone.owner == "extrass-e" and alone.settings.method.width == 16
    shared = members(["dlctus-dilated", "dlctus"])
    assert shared["dlctus-dilated"].stages is shared["dlctus"].stages
    assert str(shared["dlctus"].folder) == "out/variants/dlctus" == str(shared["dlctus-dilated"].folder)


def test_a_part_is_made_with_the_arguments_of_the_whole(monkeypatch):
    given = []
    monkeypatch.setitem(
        VARIANTS, "extrass-e", dataclasses.replace(VARIANTS["extrass-e"], factory=_recording(methods.extrass_e, given))
    )
    members(["extrass"], overrides=["method.frnet_width=5", "method.width=7", "method.sigma_distance=3.0"])
    assert [(each["width"], each["sigma_distance"]) for each in given] == [(5, 3.0)]


def _recording(function, given):
    @functools.wraps(function)
    def record(**arguments):
        given.append(arguments)
        return function(**arguments)

    return record


def test_a_crop_that_a_paper_gives_in_output_pixels_follows_the_scale():
    """Thesis 002, section 4.3.2: 256 / f_u."""
    from experiments.training import check_crop

    def crop(name, preset, *overrides):
        settings = settings_of(name, preset, overrides)
        (stage,) = settings.stages.values()
        return check_crop(stage, 960, 540, settings.data.scale)

    for name in ("dlctus", "dlctus-theta-0.5", "dlctus-dilated", "nsrr"):
        for scale, side in ((2, 128), (4, 64)):
            assert crop(name, "paper", f"data.scale={scale}") == (side, side), name
        assert crop(name, "paper", "data.scale=4", "stages.crop=[40,32]") == (40, 32)
        assert crop(name, "quick", "data.scale=4") == (48, 48)
    assert crop("extrass-e", "paper", "data.scale=4") == (128, 128)  # not said there


def test_a_tuned_clamp_is_an_argument_like_any_other():
    member = members(["taau"], overrides=["data.scale=4"])["taau"]
    made = dict(comparison._clamped(member, "none").recipe.arguments)
    assert (made["clamp"], made["scale"]) == ("none", 4) and member.settings.method.clamp == "ycocg"


def test_flat_settings_are_overrides():
    """What ``run.json`` holds gives the same settings again."""
    settings = settings_of("extrass", "paper", ["frnet.batch=3"])
    written = [f"{path}={json.dumps(value)}" for path, value in flatten(settings).items()]
    assert settings_of("extrass", "smoke", written) == settings and len(written) > 40


def test_optimizers_are_those_that_there_are():
    """Named in the settings as well, which must not wait for JAX."""
    from essjax.train import OPTIMIZERS

    for name in OPTIMIZERS:
        assert settings_of("extrass", "quick", [f"training.optimizer={name}"]).training.optimizer == name
    with pytest.raises(ValueError, match=r"training.optimizer: expected Literal\['muon', 'adam'\], got 'sgd'"):
        settings_of("extrass", "quick", ["training.optimizer=sgd"])
