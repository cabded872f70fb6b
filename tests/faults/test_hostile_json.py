"""JSON and TOML that are wrong, or made to harm: one ValueError that names file and key, nothing outside is touched."""

import copy
import functools
import json
import operator

import pytest

from essjax.data import SequenceWriter, import_dataset, read_dataset, read_sequence, write_dataset, write_sequence
from essjax.data.importing.arm import arm_facts
from essjax.data.importing.facts import generic_facts
from essjax.data.importing.recipe import load_recipe
from essjax.data.json_files import read_json
from experiments.comparison import _read_settings
from experiments.training import read_losses
from tests.data.importing.test_blender import dump  # noqa: F401  a fixture
from tests.data.test_store import sequence

HOSTILE = (None, True, -1, 1e999, "maybe", [], {}, 10**400, [[[]]], {"a": {}}, "x" * 3000)
OUTSIDE = ("../x", "..", "a/b", "/tmp", "a\\b", ".hidden", "", "a\0b", "x" * 300)


def refused(read, *parts):
    with pytest.raises(ValueError) as caught:
        read()
    message = str(caught.value)
    assert "\n" not in message and len(message) < 600 and all(part in message for part in parts), message


@pytest.fixture
def root(tmp_path):
    """A dataset of one sequence, with native frames and cameras."""
    write_sequence(tmp_path / "ds", "a", sequence(T=3, native=True), first=8)
    write_dataset(tmp_path / "ds", {"test": ["a"]})
    return tmp_path / "ds"


def places(content, above=()):
    """The path to every value of it."""
    for key, value in content.items() if isinstance(content, dict) else enumerate(content):
        yield (*above, key)
        if isinstance(value, (dict, list)):
            yield from places(value, (*above, key))


def changed(content, path, value):
    content = copy.deepcopy(content)
    functools.reduce(operator.getitem, path[:-1], content)[path[-1]] = value
    return content


FREE = {"source", "size", "notes", "made_from"}
"""Keys that hold anything; ``size`` and the like of dataset.json inform and are not read."""


@pytest.mark.parametrize("name", ["dataset.json", "a/sequence.json"])
def test_wrong_values_anywhere(root, name):
    """Every value in turn becomes something else: refused with the file's name, or read as a dataset."""
    file, refusals = root / name, 0
    content = json.loads(file.read_text())
    for path in places(content):
        if FREE & {*map(str, path)} or path[0] in ("channels", "scale", "native", "ranges") and name == "dataset.json":
            continue
        if len(path) > 4 and 0 not in path[3:]:  # one number of a matrix stands for all
            continue
        for value in HOSTILE:
            file.write_text(json.dumps(changed(content, path, value)))
            try:
                read_sequence(read_dataset(root), "a")
            except ValueError as error:
                assert ".json" in str(error) or "sequence a" in str(error), error
                assert "\n" not in str(error) and len(str(error)) < 600
                refusals += 1
    assert refusals > (100 if name == "dataset.json" else 300)


@pytest.mark.parametrize(
    ("path", "value", "message"),
    [
        (("jitter",), [float("nan"), 0], "jitter: expected 2 numbers in -1..1, got [nan, 0]"),
        (("jitter",), [50, 0], "jitter: expected 2 numbers in -1..1, got [50, 0]"),
        (("exposure",), 0, "exposure: expected a number above 0 or null, got 0"),
        (("exposure",), -1, "exposure: expected a number above 0 or null, got -1"),
        (("cut",), "maybe", "cut: expected true or false, got 'maybe'"),
        (("camera", "focal"), [1], "camera: expected camera_to_world (4x4 numbers), focal and center"),
        (("native_jitter",), None, "native_jitter: expected 2 numbers in -1..1, got None"),
        (("number",), 8, "record 1: number: expected more than 8, got 8: frames are in order"),
    ],
)
def test_wrong_records_are_named(root, path, value, message):
    file = root / "a" / "sequence.json"
    file.write_text(json.dumps(changed(json.loads(file.read_text()), ("frames", 1, *path), value)))
    refused(lambda: read_dataset(root), f"{file}, record 1", message)


@pytest.mark.parametrize("name", OUTSIDE)
def test_names_that_lead_out_of_the_dataset(root, name):
    index, file = root / "dataset.json", root / "a" / "sequence.json"
    content, info = json.loads(index.read_text()), json.loads(file.read_text())
    index.write_text(json.dumps({**content, "sequences": [name]}))
    refused(lambda: read_dataset(root), f"{index}: sequences: expected plain folder names, each once, got")
    index.write_text(json.dumps(changed(content, ("splits", "test", 0, "sequence"), name)))
    refused(lambda: read_dataset(root), f"{index}: split test, segment 0: sequence: expected a plain folder name, got")
    index.write_text(json.dumps(content))
    file.write_text(json.dumps({**info, "name": name}))
    refused(lambda: read_dataset(root), f"{file}: name: expected ")
    refused(lambda: SequenceWriter(root, name), "sequence name: expected a plain folder name")


def test_nesting_numbers_and_keys_without_end(tmp_path):
    file = tmp_path / "x.json"
    for content in ("[" * 200_000, '{"a":' * 200_000, "1" * 100_000, '{"a": ' + "1" * 100_000 + "}"):
        file.write_text(content)
        refused(lambda: read_json(file), f"{file}: expected JSON, cannot read it")
    file.write_text('{"8": 1, "9": 2, "8": 3}')
    refused(lambda: read_json(file), f"{file}: expected JSON, cannot read it (the key '8' is there twice)")
    file.write_text("x = " + "[" * 200_000)
    refused(lambda: load_recipe("generic", file), f"{file}: expected a recipe in TOML")
    file.write_text('[files]\nframe = "../{frame}.exr"')
    refused(lambda: load_recipe("unreal", file), f"{file}: [files] frame: expected a path below the dump's folder")


def test_metadata_of_dumps(tmp_path, dump):  # noqa: F811
    """Each value of each preset's JSON in turn."""
    meta, file = json.loads((dump / "meta.json").read_text()), tmp_path / "x.json"
    for path in [("render_size",), ("frames",), *(("frames", "9", key) for key in meta["frames"]["9"])]:
        for value in HOSTILE:
            (dump / "meta.json").write_text(json.dumps(changed(meta, path, value)))
            refused(lambda: import_dataset(dump, tmp_path / "out", "blender"), "meta.json", str(path[-1]))
    frames = {"08": {"jitter": [0, 0]}, "8": {"jitter": [0, 0]}}
    file.write_text(json.dumps({"frames": frames}))
    refused(lambda: generic_facts(file, 4, 3), f"{file}: frames: expected numbers of frames, each once, got '8'")
    matrix = [[1, 0, 0, 0]] * 4
    record = {"jitter": [0, 0], "exposure": 1.0, "cut": False, "camera_to_world": matrix, "focal": [4, 4]}
    for key in record:
        for value in ("maybe", [1e999, 0], {}, [[[]]], 10**400):
            file.write_text(json.dumps({"frames": {"8": {**record, key: value}}}))
            refused(lambda: generic_facts(file, 4, 3)(8, {}), f"{file}, frame 8", key)
    arm = {"Frame": 8, "CameraFarPlane": -1, "CameraNearPlane": 0.1, "NormalizedPerRatioJitter": [{"X": 0, "Y": 0}]}
    for record, message in (
        ({**arm, "CameraCut": "maybe"}, "entry 0: CameraCut: expected true or false, got 'maybe'"),
        ({**arm, "Frame": "8"}, "entry 0: Frame: expected a whole number"),
        ({**arm, "CameraFarPlane": 10**400}, "frame 8: a field is missing or has the wrong form"),
        ({**arm, "NormalizedPerRatioJitter": [[]]}, "frame 8: a field is missing or has the wrong form"),
        (7, "entry 0: expected an object, got 7"),
    ):
        file.write_text(json.dumps({"Frames": [record]}))
        refused(lambda: arm_facts(file, 4, 3)(8, {}), str(file), message)
    file.write_text(json.dumps({"Frames": [arm, arm]}))
    refused(lambda: arm_facts(file, 4, 3), f"{file}: Frames, entry 1: the frame 8 is there twice")


def test_what_a_run_left_behind(tmp_path):
    """tuning.json by hand, and a log whose last line was torn by a kill: --eval-only reads the lines that are whole."""
    file = tmp_path / "tuning.json"
    file.write_text('{"taau": {"clamp": "none", "alpha": "much", "sigma": 1, "psnr": 30}}')
    refused(lambda: _read_settings(file), f"{file}: taau: alpha: expected a number, got 'much'")
    (tmp_path / "train").mkdir()
    (tmp_path / "train" / "fit.jsonl").write_text('{"step": 1, "loss": 0.5}\n{"step": 2, "lo')
    assert read_losses(tmp_path, "fit") == [(1, 0.5)]
