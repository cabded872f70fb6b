"""What every variant makes of every preset, as JSON: what its factory and objectives receive, and its training.

``python -m tests.experiments.golden`` writes ``golden.json`` again, after a change of settings that is meant.
"""

import functools
import inspect
import json
import sys
from pathlib import Path

from essjax import methods, train
from essjax.interfaces import Method, Network
from experiments.members import _member, settings_of
from experiments.settings import PRESETS
from experiments.training import check_crop
from experiments.variants import VARIANTS, compared

FILE = Path(__file__).with_name("golden.json")
AT = (0.0, 0.2, 0.5, 0.8, 1.0)
"""Progress at which decays are sampled."""
DATA = (
    "seed", "size", "scale", "train_sequences", "validation_sequences", "test_sequences", "train_frames", "test_frames",
    "train_spp", "test_spp", "mip_bias", "jitter", "fresh", "optimizer", "save_every", "average", "validations", "tune",
    "warmup", "pictures", "optimize",
)  # fmt: skip


def functions():
    """Code -> name of each factory and objective."""
    members = {name: getattr(module, name) for module in (methods, train) for name in module.__all__}
    found = {name: inspect.unwrap(value) for name, value in members.items() if inspect.isfunction(value)}
    makes = lambda name: name.endswith("_objective") or inspect.signature(found[name]).return_annotation is Method
    return {found[name].__code__: name for name in found if makes(name)}


class Calls(list):
    """While it is entered: each call of a factory or objective as text, defaults included, without those inside."""

    def __enter__(self):
        self.depth, self.names = 0, functions()
        sys.setprofile(self.on_event)
        return self

    def __exit__(self, *error):
        sys.setprofile(None)

    def on_event(self, frame, event, argument):
        name = self.names.get(frame.f_code)
        if name and event == "call":
            if not self.depth:
                given = {key: plain(value) for key, value in frame.f_locals.items() if not isinstance(value, Network)}
                self.append(f"{name}({', '.join(f'{key}={given[key]}' for key in sorted(given))})")
            self.depth += 1
        elif name and event == "return":
            self.depth -= 1


def plain(value):
    """A value as text that is the same in every process."""
    if isinstance(value, Method):
        return value.info.name
    if isinstance(value, functools.partial):
        return f"{plain(value.func)}{value.args}{value.keywords}"
    return value.__name__ if inspect.isfunction(value) else repr(value)


def resolved(name, preset):
    """What a run of variant ``name`` does with ``preset``."""
    settings = settings_of(name, preset)
    with Calls() as calls:
        member = _member(name, settings, Path())
    shared = {**vars(settings), **vars(settings.data), **vars(settings.training), **vars(settings.evaluation)}
    return {
        "data": {key: shared[key] for key in DATA},
        "rows": compared([name]),
        "calls": sorted(set(calls)),
        "stages": {
            stage.name: {
                "method": stage.method.info.name, "recurrent": any(task.recurrent for task in stage.tasks.values()),
                "batch": stage.settings.batch, "clip": stage.settings.clip, "rate": stage.settings.learning_rate,
                "crop": check_crop(stage.settings, *settings.data.size, settings.data.scale),
                "decay": [round(stage.decay(progress), 12) for progress in AT],
                "steps": stage.budget.steps, "seconds": stage.budget.seconds,
                "ranges": stage.ranges, "vgg": stage.vgg,
            }
            for stage in member.stages
        },
    }  # fmt: skip


def lines():
    """One entry per line of the file, as JSON has it; what all variants or all presets share stands there once."""
    flat = {}
    for preset in PRESETS:
        for name in VARIANTS:
            entry = resolved(name, preset)
            for where, value in ((f"data, {preset}", entry.pop("data")), (f"rows, {name}", entry.pop("rows"))):
                if value not in flat.setdefault(where, []):
                    flat[where].append(value)
            flat |= {f"{name}, {preset}, {part}": value for part, value in entry.items() if value}
    return json.loads(json.dumps(flat))


def text(flat):
    """The content of the file."""
    return "{\n" + ",\n".join(f"{json.dumps(key)}: {json.dumps(value)}" for key, value in flat.items()) + "\n}\n"


if __name__ == "__main__":
    FILE.write_text(text(lines()))
