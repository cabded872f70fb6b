"""Import of dumps: ``import_dataset(source, out, preset)`` converts a producer's conventions to essjax's, once.

A preset is a recipe (``recipes/*.toml``) plus code where its dumps need it: ``blender``, ``unreal``, ``arm``.
``files`` finds the frames, ``dump`` reads and converts them with the functions of ``convert``, ``stream`` writes them.
"""

from essjax.data.importing.presets import PRESETS, ImportReport, import_dataset

__all__ = ["PRESETS", "ImportReport", "import_dataset"]
