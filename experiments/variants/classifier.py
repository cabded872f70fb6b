"""Classifier-guided temporal supersampling (Guo et al. 2022)."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from essjax import methods
from essjax.interfaces import Method
from essjax.labels import Thresholds
from essjax.sizes import output_size
from essjax.train import classification_objective, composition_objective
from experiments.classes import QUESTIONS, class_remark, evaluate_classes
from experiments.evaluate import Clip
from experiments.report.classes import write_class_sheet
from experiments.settings import Settings
from experiments.variants.base import Found, Page, StageRecipe, Variant


def thresholds(settings: Settings) -> Thresholds:
    """Those of the labels at the size of a run's reference."""
    return Thresholds.of_height(output_size(settings.data.scale, settings.data.size[::-1])[0])


def _inspect(method: Method, variables: Any, clips: Sequence[Clip], settings: Settings, folder: Path) -> Found | None:
    """Scores against the automatic labels, and the classes as pictures beside the report."""
    scores, maps = evaluate_classes(method, variables, clips, thresholds(settings), settings.compiler_options)
    for each in maps:
        title = f"{each.sequence}, frame {each.frame}"
        write_class_sheet(folder, title, each.reference, each.predicted, each.automatic, QUESTIONS)
    return Found(scores, class_remark("classifier", scores)) if scores else None


VARIANTS = {
    "classifier": Variant(
        "classifier-guided supersampling: classes say what becomes of history; every frame rendered",
        methods.classifier,
        {
            "classifier": StageRecipe(
                classification_objective, given=lambda s: {"thresholds": thresholds(s)}, ranges=True
            ),
            "composition": StageRecipe(composition_objective),
        },
        {
            #                                    smoke quick paper
            "method.width":                     (8,    16,   32),
            "method.composition_width":         (8,    32,   64),
            "classifier.batch":                 (2,    2,    8),
            "classifier.learning_rate":         (1e-3, 1e-2, 1e-3),
            "classifier.steps":                 (4,    None, 100 * 900),
            "classifier.seconds":               (None, 200.0, None),
            "composition.batch":                (2,    2,    12),
            "composition.learning_rate":        (3e-3, 3e-3, 1e-3),
            "composition.steps":                (6,    None, 120 * 600),
            "composition.seconds":              (None, 90.0, None),
            "composition.loss.temporal_weight": (0.1,  0.1,  1.0),
        },
        inspect=_inspect,
        key="classes",
        page=Page(
            "Guo et al. 2022",
            "a classifier labels ghosting and aliasing pixels; history is rectified by class and blended by a small "
            "network",
            "rectification and some widths are in a main paper that we do not have",
        ),
    ),
}  # fmt: skip
