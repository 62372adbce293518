"""The comparison of decoders at run time: tools/compare.py."""

import re

import numpy as np
import pytest

from tools.decoders import compare
from warpslam.camera import Intrinsics
from warpslam.synthetic import SyntheticSequence, write_replica

CAMERA = Intrinsics(50.0, 50.0, 31.5, 23.5, 64, 48)
QUICK = ["--set", "mapping.first_iterations=20", "mapping.iterations=3", "mapping.pixels=100", "mapping.coarse=false"]


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Five frames of a room, written as a Replica sequence."""
    path = tmp_path_factory.mktemp("room")
    write_replica(SyntheticSequence(1_000_000, 5, intrinsics=CAMERA), path)
    return path


def test_views_gives_a_row_for_each_budget(folder, capsys):
    """Each cell holds three finite errors; more iterations on the same views are better."""
    command = ["views", "ours", "--sequence", str(folder), "--step", "2", "--budgets", "2", "40", *QUICK]
    assert compare.main([*command, "mapping.first_iterations=5"]) == 0
    cells = [line.split("|")[2] for line in capsys.readouterr().out.splitlines() if re.match(r"\| \d", line)]
    errors = np.array([[float(value) for value in cell.split(",")] for cell in cells])
    assert errors.shape == (2, 3) and np.isfinite(errors).all()
    assert errors[1, 0] < errors[0, 0]


def test_residual_tells_silent_decoders_from_random_ones(folder, capsys):
    """The package's fine decoder is silent without its feature, a random one is not."""
    assert compare.main(["residual", "ours", "random", "--sequence", str(folder), "--step", "4", *QUICK]) == 0
    ours, chance = (float(x) for x in re.findall(r"for ([\d.]+) %", capsys.readouterr().out))
    assert ours > 80 > 50 > chance


def test_observed_is_in_front_of_the_surface():
    """What lies between camera and surface was seen; what lies behind the surface or the camera was not."""
    sequence = SyntheticSequence(1_000_000, 2, intrinsics=CAMERA)
    points, seen, shape = compare._observed(sequence, range(1))
    assert np.prod(shape) == len(points) == len(seen)
    T, depth = sequence[0].T_world_camera, sequence[0].depth
    z = (points - T[:3, 3]) @ T[:3, 2]
    assert not seen[z < 0].any() and not seen[z > depth.max() + 0.05].any()
    u, v = 32, 24
    ray = T[:3, :3] @ [(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, 1.0]
    for share, expected in ((0.5, True), (0.8, True)):
        place = T[:3, 3] + share * depth[v, u] * ray
        assert seen[np.linalg.norm(points - place, axis=1).argmin()] == expected


def test_wrong_names_are_refused(folder, capsys):
    """A decoder that is neither known nor a file ends with a message."""
    with pytest.raises(SystemExit):
        compare.main(["residual", "x=/nowhere.pth", "--sequence", str(folder)])
    assert "/nowhere.pth" in capsys.readouterr().err
    assert compare.main(["views", "random", "--sequence", "/nowhere"]) == 2
