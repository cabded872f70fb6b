"""The guide to a new method: what it shows is a variant that resolves, trains and streams."""

import re
from pathlib import Path

import jax
import numpy as np
import pytest

from essjax.methods import registry
from essjax.rollout import SS
from experiments.members import resolve, settings_of
from experiments.training import initial_state, make_steps
from experiments.variants import VARIANTS
from tests.helpers import make_sequence, streamed

GUIDE = Path(__file__).resolve().parents[1] / "docs/guides/new-method.md"


@pytest.fixture
def code(monkeypatch):
    monkeypatch.setattr(registry, "FACTORIES", dict(registry.FACTORIES))
    (block,) = re.findall(r"^```python\n(.*?)^```", GUIDE.read_text(), re.M | re.S)
    exec(compile(block, str(GUIDE), "exec"), scope := {})
    monkeypatch.setitem(VARIANTS, "blend", scope["VARIANTS"]["blend"])
    return block


def test_the_method_of_the_guide_trains_and_streams(code):
    assert len([line for line in code.splitlines() if line.strip() and not re.match("(import|from) ", line)]) <= 40
    settings = settings_of("blend", "smoke", ["method.share=0.9", "mix.loss.weight=2", "optimize=false"])
    member = resolve({"blend": settings}, "smoke", Path())["blend"]
    (stage,) = member.stages
    clip = make_sequence(0, T=3, B=1, H=6, W=9)
    variables = member.method.init(jax.random.key(0), jax.tree.map(lambda leaf: leaf[0], clip.frames))
    (step,) = make_steps(stage, settings).values()
    state, losses = initial_state(member, stage, variables, dict.fromkeys(stage.tasks, clip)), []
    for _ in range(stage.settings.steps):
        state, terms = step(state, clip, stage.settings.learning_rate)
        losses.append(float(terms["loss"]))
    assert losses[-1] < losses[0] and stage.settings.learning_rate == 0.1
    images = streamed(member.method, state.variables, clip.frames, (SS,) * 3)
    assert images.shape == (3, 1, 12, 18, 3) and np.all(np.isfinite(images))
    with pytest.raises(ValueError, match="unknown setting 'method.shape'; method has share."):
        settings_of("blend", "smoke", ["method.shape=0.9"])
