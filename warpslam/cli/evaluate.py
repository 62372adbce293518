"""``warpslam eval``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, print_reconstruction


def add(commands: Any) -> None:
    """Add the command."""
    evaluate = add_command(commands, "eval", _eval, "trajectory and reconstruction errors of a run")
    evaluate.add_argument("run", metavar="RUN", help="run folder")
    evaluate.add_argument("--truth", metavar="FILE", help="TUM trajectory to compare with (default: the run's own)")
    evaluate.add_argument("--max-difference", type=float, default=0.02, metavar="S", help="for pairing [s] (0.02)")
    evaluate.add_argument("--truth-mesh", metavar="FILE", help="true surface to compare the mesh with")
    evaluate.add_argument("--json", action="store_true", help="print JSON")


def _eval(options: argparse.Namespace) -> int:
    from warpslam.revisit import evaluate_run
    from warpslam.run_folder import RunFolder, to_json

    metrics = evaluate_run(
        RunFolder.open(options.run),
        options.truth,
        max_difference=options.max_difference,
        truth_mesh=options.truth_mesh,
    )
    if options.json:
        print(to_json(metrics))
        return 0
    rows = [("ATE aligned", 100, "cm", metrics["ate_m"]["aligned"])]
    rows.append(("ATE unaligned", 100, "cm", metrics["ate_m"]["unaligned"]))
    if "rpe" in metrics:
        rows.append(("RPE translation", 100, "cm", metrics["rpe"]["translation_m"]))
        rows.append(("RPE rotation", 1, "deg", metrics["rpe"]["rotation_deg"]))
    for name, scale, unit, values in rows:
        rest = "  ".join(f"{key} {scale * values[key]:.3f}" for key in ("mean", "median", "max"))
        print(f"{name:16} RMSE {scale * values['rmse']:.3f} {unit}  {rest}")
    print(f"{'frames':16} {metrics['frames']['compared']} of {metrics['frames']['estimated']} compared")
    if "reconstruction" in metrics:
        print_reconstruction(metrics["reconstruction"])
    return 0
