"""The format of a folder is told from its file names."""

from __future__ import annotations

import subprocess
import sys
from importlib import resources

import pytest
import yaml

from tests.sequences import writers
from warpslam.sequences import guess_dataset, open_sequence
from warpslam.sequences.calibration import Calibration

LAYOUTS = {
    "replica": lambda folder: writers.write_replica(folder),
    "tum_rgbd": lambda folder: writers.write_tum(folder, [1.0], [1.0], [1.0]),
    "scannet": lambda folder: writers.write_scannet(folder),
    "cofusion": lambda folder: writers.write_cofusion(folder),
    "seven_scenes": lambda folder: writers.write_seven_scenes(folder),
    "icl": lambda folder: writers.write_color_depth(folder, "image"),
    "azure": lambda folder: writers.write_color_depth(folder, "color"),
}


@pytest.mark.parametrize("name", LAYOUTS)
def test_guess(tmp_path, name):
    """Every layout is recognised, from a Path and from a string."""
    assert guess_dataset(LAYOUTS[name](tmp_path)) == name
    assert guess_dataset(str(tmp_path)) == name


@pytest.mark.parametrize(
    ("alias", "name"),
    [("TUM", "tum_rgbd"), ("tumrgbd", "tum_rgbd"), ("7-scenes", "seven_scenes"), ("redwood", "icl"), ("own", "azure")],
)
def test_aliases(tmp_path, alias, name):
    """Other names of the formats open the same reader."""
    folder = LAYOUTS[name](tmp_path)
    by_alias = open_sequence(folder, dataset=alias, camera=writers.CAMERA)
    assert type(by_alias) is type(open_sequence(folder, dataset=name, camera=writers.CAMERA))


def test_built_in_cameras_load():
    """Every camera file in the package is complete and gives intrinsics."""
    files = [f for f in (resources.files("warpslam.sequences") / "cameras").iterdir() if f.name.endswith(".yaml")]
    assert len(files) == 10
    for file in files:
        calibration = Calibration.of_dataset(file.name.removesuffix(".yaml"))
        assert calibration.stored.fx == yaml.safe_load(file.read_text())["fx"]
        assert calibration.intrinsics.width > 400


def test_import_is_light():
    """Importing the package of readers loads neither OpenCV nor a reader."""
    code = (
        "import sys, warpslam.sequences; heavy = ('cv2', 'torch', 'warp', 'yaml'); "
        "print([m for m in sys.modules if m in heavy or m.startswith('warpslam.sequences.')])"
    )
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == "['warpslam.sequences.base']"
