"""The programs to start from run, in small, and do what they say."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
from PIL import Image

import warpslam
from warpslam import examples
from warpslam.examples import first_steps, known_poses, localize_in_a_map, own_camera

SMALL = (*first_steps.SETTINGS, "mapping.first_iterations=60", "mapping.iterations=10", "mapping.refinement_rounds=1")
PROGRAMS = sorted(path.stem for path in Path(examples.__file__).parent.glob("[!_]*.py"))


def test_every_program_is_listed():
    """The package's description names each program, and each is short enough to be read at once."""
    assert PROGRAMS == ["first_steps", "known_poses", "live_camera", "localize_in_a_map", "own_camera", "own_reader"]
    for name in PROGRAMS:
        assert f"    {name} " in examples.__doc__
        assert len((Path(examples.__file__).parent / f"{name}.py").read_text().splitlines()) <= 45


def test_first_steps(tmp_path, capsys):
    """Every frame is told, the trajectory is near the truth, and a mesh is written."""
    assert first_steps.main(6, settings=SMALL, output=tmp_path / "room.ply") < 0.02
    out = capsys.readouterr().out
    assert len(re.findall(r"^frame \d: OK, camera at \[", out, re.MULTILINE)) == 6
    assert "ATE RMSE" in out and (tmp_path / "room.ply").stat().st_size > 10_000


def test_own_camera_tells_of_a_frame_that_is_no_use(capsys):
    """The black frame is skipped with a reason; the others are tracked."""
    slam = own_camera.main(6, settings=SMALL)
    out = capsys.readouterr().out
    assert "frame 3 at 0.10 s is SKIPPED: " in out and "{'OK': 5, 'SKIPPED': 1}" in out
    assert len(slam.trajectory.poses) == 6


def test_known_poses_are_not_changed(tmp_path):
    """The rendered depth fits the frame that lies beside its rendering in the picture."""
    assert known_poses.main(4, settings=SMALL, output=tmp_path / "view.png") < 0.05
    picture = np.asarray(Image.open(tmp_path / "view.png"), dtype=float)
    assert picture.shape == (120, 320, 3)
    assert np.abs(picture[:, :160] - picture[:, 160:]).mean() < 40


def test_localize_in_a_map(capsys):
    """A camera that begins at the map's end is found, confirmed by three frames more, and followed back."""
    assert localize_in_a_map.main(9, settings=SMALL) < 0.05
    out = capsys.readouterr().out
    assert re.findall(r"^frame (\d): OK", out, re.MULTILINE) == ["5", "4", "3", "2", "1", "0"]
    assert re.findall(r"^frame (\d): LOST, found again", out, re.MULTILINE) == ["8", "7", "6"]


def test_runs_as_a_module(tmp_path):
    """As the page says: python -m, with a number of frames and settings; the mesh lies in the working directory."""
    command = [sys.executable, "-m", "warpslam.examples.first_steps", "3", *SMALL[len(first_steps.SETTINGS) :]]
    path = os.pathsep.join([str(Path(warpslam.__file__).parent.parent), os.environ.get("PYTHONPATH", "")])
    environment = {**os.environ, "PYTHONPATH": path}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(": OK") == 3 and (tmp_path / "first_steps.ply").exists()
