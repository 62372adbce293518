"""``warpslam eval``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, add_device_option, print_reconstruction, print_rendering, quiet_warp
from warpslam.cli.progress import working
from warpslam.evaluation import DEFAULT_PROTOCOL, PROTOCOLS
from warpslam.pipeline.finished import evaluate_run
from warpslam.runs.folder import RunFolder
from warpslam.runs.metrics import EvaluationMetrics
from warpslam.storage.json_files import to_json


def add(commands: Any) -> None:
    """Add the command."""
    evaluate = add_command(commands, "eval", _eval, "trajectory and reconstruction errors of a run")
    evaluate.add_argument("run", metavar="RUN", help="run folder")
    evaluate.add_argument("--truth", metavar="FILE", help="TUM trajectory to compare with (default: the run's own)")
    evaluate.add_argument("--max-difference", type=float, default=0.02, metavar="S", help="for pairing [s] (0.02)")
    evaluate.add_argument(
        "--gt-mesh", "--truth-mesh", dest="truth_mesh", metavar="FILE", help="true surface to compare the mesh with"
    )
    evaluate.add_argument(
        "--protocol", metavar="NAME",
        help="which surface counts in that: frustum (what lies in a frame's image), frustum+occlusion (and is not "
        "hidden there; the default), frustum+occlusion+virtual (or is seen by virtual cameras), or all of them",
    )  # fmt: skip
    evaluate.add_argument(
        "--views", type=int, default=0, metavar="N", help="render N frames in full for PSNR, SSIM and depth L1 (0)"
    )
    add_device_option(evaluate)
    evaluate.add_argument("--json", action="store_true", help="print JSON")


def _eval(options: argparse.Namespace) -> int:
    quiet_warp()
    # The default comes first, so that "reconstruction" is of the same protocol with and without the others.
    protocols = [options.protocol or DEFAULT_PROTOCOL]
    if options.protocol == "all":
        protocols = sorted(PROTOCOLS, key=lambda name: name != DEFAULT_PROTOCOL)
    with working("evaluating"):
        figures = evaluate_run(
            RunFolder.open(options.run),
            options.truth,
            max_difference=options.max_difference,
            truth_mesh=options.truth_mesh,
            protocols=protocols,
            rendered_views=options.views,
            device=options.device,
        )
    if options.json:
        print(to_json(figures))
        return 0
    metrics = EvaluationMetrics()
    metrics.fill(figures)
    rows = [("ATE aligned", 100, "cm", metrics.ate_m.aligned), ("ATE unaligned", 100, "cm", metrics.ate_m.unaligned)]
    if metrics.has("rpe"):
        rows.append(("RPE translation", 100, "cm", metrics.rpe.translation_m))
        rows.append(("RPE rotation", 1, "deg", metrics.rpe.rotation_deg))
    for name, scale, unit, error in rows:
        rest = "  ".join(f"{key} {scale * (getattr(error, key) or 0):.3f}" for key in ("mean", "median", "max"))
        print(f"{name:16} RMSE {scale * (error.rmse or 0):.3f} {unit}  {rest}")
    print(f"{'frames':16} {metrics.frames.compared} of {metrics.frames.estimated} compared")
    if metrics.has("reconstruction"):
        print_reconstruction(*(metrics.reconstruction_by_protocol.values() or [metrics.reconstruction]))
    if metrics.has("rendering"):
        print_rendering(metrics.rendering)
    return 0
