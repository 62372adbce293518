"""A batch on Ray: how a cluster is shared, and a real one of two machines that loses a worker."""

from __future__ import annotations

import os
import signal
import sys
from pathlib import Path

import pytest

from warpslam import cli
from warpslam.batch.jobs import Job
from warpslam.batch.local import run_batch
from warpslam.batch.ray_cluster import run_on_ray, share_of_cluster
from warpslam.batch.status import BatchState
from warpslam.camera import Intrinsics
from warpslam.errors import ConfigError
from warpslam.runs.request import RunRequest, Source
from warpslam.synthetic import SyntheticSequence, write_replica

SMALL = (
    "tracking.pixels=64", "tracking.iterations=3", "tracking.ignore_edge_u=4", "tracking.ignore_edge_v=4",
    "mapping.pixels=100", "mapping.every=2", "mapping.first_iterations=60", "mapping.iterations=10",
    "mapping.coarse_iterations=2", "mapping.refinement_rounds=1", "meshing.voxel=0.1",
)  # fmt: skip


@pytest.mark.parametrize(
    ("nodes", "workers", "share"),
    [
        ([{"CPU": 8}], 2, (4, 0)),
        ([{"CPU": 64}], 2, (8, 0)),  # more than eight cores are no use to a run
        ([{"CPU": 2}, {"CPU": 2}, {"CPU": 2}], 1, (2, 0)),  # a task must fit on one machine
        ([{"CPU": 2}], 5, (1, 0)),
        ([{"CPU": 32}, {"CPU": 32}], None, (8, 0)),
        ([{"CPU": 32, "GPU": 4}], None, (8, 1)),
        ([{"CPU": 32, "GPU": 4}], 16, (2, 0.25)),
        ([{}, {"CPU": 4, "GPU": 1}], 1, (4, 1)),
    ],
)
def test_share_of_cluster(nodes, workers, share):
    """Cores and GPUs of a task."""
    total = {name: float(sum(node.get(name, 0) for node in nodes)) for name in ("CPU", "GPU")}
    found = share_of_cluster(total, nodes, workers)
    assert (found["num_cpus"], found["num_gpus"]) == share


def test_cluster_without_cores():
    """A cluster that only manages is told."""
    with pytest.raises(ConfigError, match="no CPU cores"):
        share_of_cluster({"CPU": 0.0}, [{}], 1)


def test_without_ray(monkeypatch, tmp_path, capsys):
    """One line that says what to install."""
    monkeypatch.setitem(sys.modules, "ray", None)
    assert cli.main(["batch", str(tmp_path), "--cluster", "local", "-o", str(tmp_path / "out")]) == 2
    assert "pip install 'ray>=2.59'" in capsys.readouterr().err


@pytest.mark.slow  # starts three Ray daemons and runs three sequences
def test_lost_worker_is_replaced(tmp_path, monkeypatch):
    """Two machines, two sequences, one worker killed in the middle: both finish, one of them at the second attempt,
    from its last checkpoint on and with the same trajectory and mesh as on this machine, and a second batch has
    nothing to do.
    """
    ray = pytest.importorskip("ray", reason="the package ray is not installed")
    from ray.cluster_utils import Cluster

    monkeypatch.setenv("PYTHONPATH", str(Path(cli.__file__).resolve().parents[2]))
    camera = Intrinsics(60.0, 60.0, 39.5, 29.5, 80, 60)
    jobs = []
    for seed in (1, 2):
        write_replica(SyntheticSequence(seed, 6, intrinsics=camera, device="cpu"), tmp_path / f"room{seed}")
        source = Source(str(tmp_path / f"room{seed}"))
        request = RunRequest(source, preset="default", overrides=SMALL, device="cpu", checkpoint_every=2)
        jobs.append(Job(f"room{seed}", request))
    output, killed = tmp_path / "out", []

    def on_update(status):
        if status.name == "room1" and status.done >= 3 and not killed:
            killed.append(BatchState.of(jobs[0], output).fields["pid"])
            os.kill(killed[0], signal.SIGKILL)

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, "include_dashboard": False})
    try:
        for _ in range(2):
            cluster.add_node(num_cpus=1)
        ray.init(address=cluster.address, log_to_driver=False, logging_level="error")
        statuses = run_on_ray(jobs, output, workers=2, on_update=on_update)
        assert killed and [(s.status, s.attempt) for s in statuses] == [("finished", 2), ("finished", 1)]
        assert [s.done for s in statuses] == [6, 6]
        assert [s.resumed_after >= 2 for s in statuses] == [True, False]
        assert BatchState.of(jobs[0], output).fields["pid"] != killed[0]
        assert [s.status for s in run_on_ray(jobs, output)] == ["done before"] * 2
    finally:
        ray.shutdown()
        cluster.shutdown()
    monkeypatch.setenv("WARPSLAM_THREADS", "1")
    (local,) = run_batch(jobs[:1], tmp_path / "local")
    assert local.status == "finished"
    for name in ("trajectory.tum", "mesh.ply"):
        same = [(folder / "room1" / name).read_bytes() for folder in (output, tmp_path / "local")]
        assert same[0] == same[1], name
