"""Good datasets to break."""

import json
import shutil

import pytest

from essjax.builtin import Clip, generate
from essjax.data import import_dataset
from tests.data.check.corrupt import CHESS, SIZE


@pytest.fixture(scope="package")
def good(tmp_path_factory):
    """A camera that flies through a corridor: motion in x and y, disocclusions, all buffers."""
    folder = tmp_path_factory.mktemp("good")
    generate(folder, [Clip("train", "corridor", 0, 7, spp=9)], *SIZE)
    return folder


@pytest.fixture(scope="package")
def chess(tmp_path_factory):
    """Eight frames of the real clip."""
    if not CHESS.is_dir():
        pytest.skip("the path-traced chess clip is not here")
    dump = tmp_path_factory.mktemp("dump")
    meta = json.loads((CHESS / "meta.json").read_text())
    meta["frames"] = {number: record for number, record in meta["frames"].items() if 12 <= int(number) < 20}
    (dump / "meta.json").write_text(json.dumps(meta))
    for number in meta["frames"]:
        for kind in ("lr", "hr"):
            (dump / f"{kind}.{int(number):04d}.exr").symlink_to(CHESS / f"{kind}.{int(number):04d}.exr")
    folder = tmp_path_factory.mktemp("chess")
    import_dataset(dump, folder, "blender", name="chess")
    return folder


@pytest.fixture
def copy(good, tmp_path):
    return shutil.copytree(good, tmp_path / "copy")
