"""Other programs side by side with ours: what they are given, how they are judged, and the table."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from tools.peers import __main__ as command
from tools.peers import ours, worker
from tools.peers import recording as recordings
from tools.peers.__main__ import Row, judge, judge_mesh, run, table
from tools.peers.open3d_systems import _fragments
from tools.peers.orb_vocabulary import BRANCHES, LEVELS, SMALLEST, tree
from tools.peers.recording import Account, Recording, stored_depth
from tools.peers.systems import PEERS, Peer
from warpslam.camera import Intrinsics
from warpslam.evaluation import load_mesh
from warpslam.runtime.environment import resident_bytes
from warpslam.storage.tum import read_tum, write_tum
from warpslam.synthetic import SyntheticSequence, write_replica

CAMERA = Intrinsics(250.0, 250.0, 159.5, 119.5, 320, 240)


@pytest.fixture(scope="module")
def folder(tmp_path_factory) -> Path:
    """Ten frames of a room, and its surface."""
    path = tmp_path_factory.mktemp("room") / "room"
    sequence = SyntheticSequence(0, 10, intrinsics=CAMERA, device="cpu")
    write_replica(sequence, path)
    sequence.mesh.export(path / "mesh.ply")
    return path


def test_recording(folder):
    """The frames that are asked for, with their times and true poses; points are those of the depth image."""
    recording = Recording(folder, "1:9:3", depth_range=2.5)
    assert recording.indices == [1, 4, 7] and len(recording) == 3
    np.testing.assert_allclose(recording.times, [1 / 30, 4 / 30, 7 / 30])
    np.testing.assert_array_equal(recording.truth, recording.sequence.ground_truth()[1:9:3])
    assert recording[1].index == 4
    depth, points = recording[1].depth, recording.points(1, stride=4)
    assert points.shape[1] == 3 and 0.1 < points[:, 2].min() and points[:, 2].max() < 2.5
    u, v = CAMERA.project(*points.T)
    assert np.abs(u / 4 - np.round(u / 4)).max() < 1e-6
    np.testing.assert_allclose(depth[np.round(v).astype(int), np.round(u).astype(int)], points[:, 2], rtol=1e-6)


def test_depth_is_stored_to_the_fifth_of_a_millimetre():
    """And what does not fit into 16 bits is missing."""
    np.testing.assert_array_equal(stored_depth(np.array([0.0, 1.0, 2.00011, 20.0], np.float32)), [0, 5000, 10001, 0])
    assert stored_depth(np.zeros((2, 2), np.float32)).dtype == np.uint16


def test_account(folder, tmp_path):
    """Poses from the identity on come out from the first true pose on; frames without a pose are left out."""
    recording = Recording(folder, "0:4")
    account = Account(recording, tmp_path)
    for number, pose in enumerate(np.linalg.inv(recording.truth[0]) @ recording.truth):
        account.add(np.full((4, 4), np.nan) if number == 2 else pose, ok=number != 2)
    with account.timed("tracking"):
        sum(range(10**5))
    account.write()
    times, poses = read_tum(tmp_path / "trajectory.tum")
    np.testing.assert_allclose(times, recording.times[[0, 1, 3]])
    np.testing.assert_allclose(poses, recording.truth[[0, 1, 3]], atol=1e-8)
    record = json.loads((tmp_path / "run.json").read_text())
    assert record["lost"] == [2] and record["cpu_seconds"]["tracking"] > 0


def test_every_peer_can_be_loaded():
    """Its function is there even where its package is not, and then the row says what to install."""
    for peer in PEERS.values():
        assert callable(peer.load())
    absent = Peer("X", ("no_such_module",), "no-such-package", "tools.peers.registration:kiss_icp")
    assert absent.missing() == "not installed: pip install no-such-package"
    assert Peer("X", ("json",), "x", "tools.peers.registration:kiss_icp").missing() == ""


def test_process_is_measured(tmp_path):
    """CPU time and memory are those of the process, whatever this one holds; its output and exit status are kept."""
    held = np.ones(400 * 2**17)  # 400 MiB
    busy = "import sys, time\nwhile time.process_time() < 0.4: pass\nb = bytearray(2**26); print('out'); sys.exit(3)"
    code, cpu, seconds, peak = run([sys.executable, "-c", busy], tmp_path / "log")
    assert resident_bytes() > held.nbytes
    assert code == 3 and 0.4 <= cpu < 5 and seconds >= 0.4 and 64 < peak < 160
    assert (tmp_path / "log").read_text() == "out\n"


def test_command_that_can_not_be_started(tmp_path):
    """It has failed, and its log says why."""
    code, cpu, _, peak = run([str(tmp_path / "nothing")], tmp_path / "log")
    assert code == 1 and cpu == peak == 0 and "FileNotFoundError" in (tmp_path / "log").read_text()


def test_judge(folder, tmp_path):
    """ATE is over frames with a pose after alignment; lost frames are those that the program names."""
    recording = Recording(folder, "0:8")
    poses = np.array([[0, -1, 0, 5.0], [1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]) @ recording.truth
    write_tum(tmp_path / "trajectory.tum", recording.times[:6], poses[:6])
    (tmp_path / "run.json").write_text(
        json.dumps({"lost": [3], "remarks": ["so"], "cpu_seconds": {"tracking": 4.0, "setup": 8.0}})
    )
    row = Row("peer", cpu_seconds_a_frame=3.0)
    judge(row, tmp_path, recording)
    assert row.ate_cm < 1e-5 and row.lost == 1 and row.without_pose == 2
    assert row.tracking_cpu_seconds_a_frame == 0.5 and row.cpu_seconds_a_frame == 2.0 and row.remarks == ["so"]
    poses[4, 2, 3] += 0.02
    write_tum(tmp_path / "trajectory.tum", recording.times, poses)
    judge(row, tmp_path, recording)
    assert 0.3 < row.ate_cm < 2 / np.sqrt(8) and row.ate_max_cm > 1 and row.without_pose == 0
    (tmp_path / "run.json").unlink()
    (tmp_path / "metrics.json").write_text(json.dumps({"frames": {"OK": 5, "LOST": 2, "SKIPPED": 1}}))
    judge(row, tmp_path, recording)
    assert row.lost == 3


def test_mesh_is_judged(folder, tmp_path, small_evaluation):
    """The true surface is right to the millimetre, a moved one is not."""
    recording, truth = Recording(folder), load_mesh(folder / "mesh.ply")
    (tmp_path / "mesh.ply").write_bytes((folder / "mesh.ply").read_bytes())
    row = Row("peer")
    judge_mesh(row, tmp_path, recording, truth)
    assert row.mesh["accuracy_cm"] < 2.0 and row.mesh["completion_ratio"] > 95.0
    other = Row("peer")
    judge_mesh(other, tmp_path / "nothing", recording, truth)
    assert other.mesh == {}


def test_table():
    """Figures, problems, remarks and cited rows, with the mesh where one is judged."""
    rows = [
        Row("A", ate_cm=1.234, ate_max_cm=2.0, lost=3, without_pose=2, cpu_seconds_a_frame=0.1234, wall_seconds=12.4,
            peak_mib=99.6, mesh={"a": 1.0, "b": 2.0, "c": 95.0}, remarks=["own words"]),
        Row("B", problem="not installed: pip install b"),
    ]  # fmt: skip
    lines = table(rows, meshes=True).splitlines()
    assert (
        lines[2] == "| A; own words | 1.23 (2.00) | 3, 2 without a pose | 0.123 (-) | 12 | 100 | 1.00 / 2.00 / 95.00 |"
    )
    assert lines[3].startswith("| B | not installed: pip install b |")
    assert any(line.startswith("| BAD-SLAM (cited) | fr1/desk 1.7, fr2/xyz 1.1") for line in lines)
    assert any("DI-Fusion (cited)" in line for line in lines)
    assert "DI-Fusion" not in table(rows, meshes=False)  # its figures are of meshes alone
    assert {line.count("|") for line in lines} == {8}


def test_command(folder, tmp_path, monkeypatch, capsys):
    """One table; a peer that is not there, and one that fails, have a row that says so; ours is run by its command."""
    commands = []

    def fake(words: list[str], log: Path):
        commands.append(words)
        if "warpslam" in words:
            out = Path(words[words.index("-o") + 1])
            sequence = Recording(folder, "0:5")
            write_tum(out / "trajectory.tum", sequence.times, sequence.truth)
            (out / "metrics.json").write_text(json.dumps({"frames": {"OK": 5}}))
            return 0, 2.5, 3.0, 100.0
        return 1, 0.0, 0.0, 0.0

    monkeypatch.setattr(command, "run", fake)
    monkeypatch.setattr(Peer, "missing", lambda self: "" if "Open3D" in self.title else "-")
    arguments = [str(folder), "--frames", "0:5", "--out", str(tmp_path), "--set", "mapping.enabled=true"]
    assert command.main([*arguments, "--systems", "kiss-icp", "open3d-slam", "warpslam"]) == 0
    out = capsys.readouterr().out
    assert "| KISS-ICP | - |" in out and "failed with exit status 1" in out
    assert "| warpslam | 0.00 (0.00) | 0 | 0.500 (-) | 3 | 100 |" in out
    assert [words[1:3] for words in commands] == [["-m", "tools.peers.worker"], ["-m", "warpslam"]]
    assert commands[1][-2:] == ["--set", "mapping.enabled=true"] and "0:5" in commands[0]
    assert len(json.loads((tmp_path / "peers.json").read_text())) == 3
    assert command.main([str(tmp_path / "nothing")]) == 2


def test_fragments_are_counted(tmp_path):
    """Steps between neighbours that stand still to the bit had no odometry; loops and other files do not count."""
    moved = np.eye(4)
    moved[0, 3] = 0.01
    edges = [(moved, False), (np.eye(4), False), (np.eye(4), True)]
    graph = {"edges": [{"transformation": T.ravel().tolist(), "uncertain": uncertain} for T, uncertain in edges]}
    for name in ("fragment_000.json", "fragment_001.json", "fragment_optimized_000.json"):
        (tmp_path / name).write_text(json.dumps(graph))
    assert _fragments(tmp_path) == "2 fragments, 2 of 4 steps without odometry"


def test_ours_is_run_as_the_peers_are(folder, tmp_path, monkeypatch):
    """Tracking alone; frames that are lost are not fused."""
    fused = []
    monkeypatch.setattr(ours, "fuse", lambda recording, poses, path: fused.append(poses))
    read = Recording.__getitem__

    def blinded(self, number):
        frame = read(self, number)
        return replace(frame, depth=np.zeros_like(frame.depth)) if number == 4 else frame

    monkeypatch.setattr(Recording, "__getitem__", blinded)
    recording = Recording(folder)
    account = Account(recording, tmp_path)
    ours.tracking(recording, account, True)
    account.write()
    row = Row("ours", cpu_seconds_a_frame=0.0)
    judge(row, tmp_path, recording)
    assert account.lost == [4] and row.lost == 1 and row.ate_cm < 2.0
    assert set(account.cpu_seconds) == {"setup", "tracking", "mesh"}
    (poses,) = fused
    assert np.flatnonzero(~np.isfinite(poses).all(axis=(1, 2))).tolist() == [4]
    np.testing.assert_allclose(poses[0], recording.truth[0], atol=1e-9)


def test_vocabulary():
    """Every descriptor has a word below the root; nodes name parents before them; weights are those of TF-IDF."""
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 256, size=(600, 32)).astype(np.uint8)
    owners = np.repeat(np.arange(6), 100)
    lines, words = tree(descriptors, owners, 6, rng)
    nodes = [line.split() for line in lines]
    assert all(len(node) == 35 and int(node[0]) < number + 1 for number, node in enumerate(nodes))
    assert sum(int(node[1]) for node in nodes) == words > BRANCHES
    level = [0]
    children = np.zeros(len(nodes) + 1, int)
    for node in nodes:
        parent = int(node[0])
        children[parent] += 1
        level.append(level[parent] + 1)
        assert parent == 0 or nodes[parent - 1][1] == "0"
        assert 0.0 <= float(node[34]) <= np.log(6) + 1e-6 and (node[1] == "1" or float(node[34]) == 0.0)
    assert max(level) <= LEVELS and children.max() <= BRANCHES
    assert (children[1:][[node[1] == "1" for node in nodes]] == 0).all()
    assert words >= 600 / (SMALLEST * BRANCHES)


@pytest.mark.parametrize("system", PEERS)
def test_peers_find_the_camera(folder, tmp_path, system):
    """Where a peer is installed: a smooth walk through a room, to some centimetres, with a mesh of it."""
    if missing := PEERS[system].missing():
        pytest.skip(missing)
    if system == "redwood":
        pytest.skip("takes fragments of 100 frames")
    log = tmp_path / "log"
    code, *_ = run([sys.executable, "-m", "tools.peers.worker", system, str(folder), str(tmp_path)], log)
    assert code == 0, log.read_text()
    row = Row(system)
    judge(row, tmp_path, Recording(folder))
    assert row.ate_cm < 5.0 and row.lost is not None and (tmp_path / "mesh.ply").stat().st_size > 1000


def test_worker_says_what_is_wrong(tmp_path, capsys):
    """A folder that can't be read is an error in one line."""
    assert worker.main(["kiss-icp", str(tmp_path / "nowhere"), str(tmp_path / "out")]) == 2
    assert "no such folder" in capsys.readouterr().err
    assert recordings.FARTHEST > max(recordings.DEPTH_RANGE.values())
