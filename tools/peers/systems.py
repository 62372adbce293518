"""The peers: how each is found, installed and run, and what others have measured of those that can't be run."""

from __future__ import annotations

import importlib
import importlib.util
from dataclasses import dataclass

from tools.peers.recording import Runner


@dataclass(frozen=True)
class Peer:
    """A program that can be installed."""

    title: str
    """As the table names it."""
    imports: tuple[str, ...]
    """Modules that it needs."""
    install: str
    """What pip installs."""
    runner: str
    """``module:function`` that runs it."""

    def missing(self) -> str:
        """What to do where it is not installed; empty where it is."""
        absent = [name for name in self.imports if importlib.util.find_spec(name) is None]
        return f"not installed: pip install {self.install}" if absent else ""

    def load(self) -> Runner:
        """The function that runs it."""
        module, _, name = self.runner.partition(":")
        return getattr(importlib.import_module(module), name)


PEERS: dict[str, Peer] = {
    "orb-slam3": Peer("ORB-SLAM3", ("pyorbslam3",), "pyorbslam3 open3d", "tools.peers.orb_slam3:orb_slam3"),
    "small-gicp": Peer(
        "small_gicp + TSDF", ("small_gicp",), "small_gicp open3d", "tools.peers.registration:small_gicp"
    ),
    "kiss-icp": Peer("KISS-ICP", ("kiss_icp",), "kiss-icp open3d", "tools.peers.registration:kiss_icp"),
    "open3d-slam": Peer("Open3D SLAM", ("open3d",), "open3d", "tools.peers.open3d_systems:slam"),
    "open3d-odometry": Peer("Open3D odometry", ("open3d",), "open3d", "tools.peers.open3d_systems:odometry"),
    "redwood": Peer("Redwood pipeline", ("open3d",), "open3d", "tools.peers.open3d_systems:redwood"),
    "warpslam-tsdf": Peer("warpslam, tracking alone + TSDF", ("open3d",), "open3d", "tools.peers.ours:tracking"),
}

CITED: tuple[tuple[str, str, str], ...] = (
    ("BAD-SLAM", "fr1/desk 1.7, fr2/xyz 1.1, fr3/office 1.73", "-"),
    ("Kintinuous", "fr1/desk 3.7, fr2/xyz 2.9, fr3/office 3.0", "-"),
    ("DI-Fusion", "-", "Replica, mean of 8 scenes: 19.40 / 10.19 / 72.96"),
)
"""Name, ATE RMSE [cm], and mesh (accuracy [cm] / completion [cm] / completion ratio [%]) of programs that need CUDA or
weights that are not to be had, from the NICE-SLAM paper (CVPR 2022): Table 2, and Table C of its supplement."""
