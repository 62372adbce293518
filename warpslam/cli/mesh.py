"""``warpslam mesh``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, add_device_option, quiet_warp
from warpslam.cli.progress import working

_DEFAULT_ROUNDS = 5


def add(commands: Any) -> None:
    """Add the command."""
    mesh = add_command(commands, "mesh", _mesh, "extract the mesh of a run again")
    mesh.add_argument("run", metavar="RUN", help="run folder")
    mesh.add_argument("--voxel", type=float, metavar="M", help="edge of a marching-cubes cell [m]")
    mesh.add_argument("--forecast", action="store_true", help="add, in cyan, what the coarse level expects unseen")
    mesh.add_argument(
        "--refine", type=int, nargs="?", const=_DEFAULT_ROUNDS, default=0, metavar="N",
        help=f"refine the whole map before, in N more rounds ({_DEFAULT_ROUNDS}); the saved map stays as it is",
    )  # fmt: skip
    mesh.add_argument("--faces", type=int, metavar="N", help="reduce the mesh to about N faces (fast-simplification)")
    mesh.add_argument("--points", action="store_true", help="write the vertices and their colours alone, as .ply")
    mesh.add_argument(
        "--texture", type=int, nargs="?", const=2048, metavar="PX",
        help="a texture PX wide (2048) in place of vertex colours, in .glb or .obj (pip install xatlas)",
    )  # fmt: skip
    add_device_option(mesh)
    mesh.add_argument(
        "-o", "--output", metavar="FILE",
        help=".ply, .glb, .obj or .stl file (default: RUN/mesh.ply, or RUN/mesh_forecast.ply with --forecast)",
    )  # fmt: skip


def _mesh(options: argparse.Namespace) -> int:
    from warpslam.pipeline.finished import extract_mesh
    from warpslam.runs.folder import RunFolder

    quiet_warp()
    with working("extracting the mesh"):
        mesh, path = extract_mesh(
            RunFolder.open(options.run),
            options.voxel,
            options.output,
            options.device,
            forecast=options.forecast,
            refinement_rounds=options.refine,
            faces=options.faces,
            points_only=options.points,
            texture=options.texture,
        )
    ahead = mesh.metadata.get("forecast_faces")
    extra = f", {ahead} of them forecast" if options.forecast and options.faces is None and ahead is not None else ""
    print(f"{path}: {len(mesh.vertices)} vertices, {len(mesh.faces)} faces{extra}")
    return 0
