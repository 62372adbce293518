"""``warpslam mesh``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, quiet_warp


def add(commands: Any) -> None:
    """Add the command."""
    mesh = add_command(commands, "mesh", _mesh, "extract the mesh of a run again")
    mesh.add_argument("run", metavar="RUN", help="run folder")
    mesh.add_argument("--voxel", type=float, metavar="M", help="edge of a marching-cubes cell [m]")
    mesh.add_argument("--device", help="cpu, cuda:0, ... (default: a GPU if there is one)")
    mesh.add_argument("-o", "--output", metavar="FILE", help="PLY file (default: RUN/mesh.ply)")


def _mesh(options: argparse.Namespace) -> int:
    from warpslam.revisit import extract_mesh
    from warpslam.run_folder import RunFolder

    quiet_warp()
    mesh, path = extract_mesh(RunFolder.open(options.run), options.voxel, options.output, options.device)
    print(f"{path}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces")
    return 0
