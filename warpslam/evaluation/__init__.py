"""How good a run is: trajectories (`ate`, `rpe`) and reconstructions (`evaluate_reconstruction`, `depth_l1`)."""

from warpslam.evaluation.reconstruction import (
    ReconstructionResult,
    accuracy,
    align_icp,
    completion,
    completion_ratio,
    cull_mesh,
    depth_l1,
    evaluate_reconstruction,
    sample_surface,
    visible_points,
)
from warpslam.evaluation.trajectory import (
    AteResult,
    RpeResult,
    Statistics,
    align_horn,
    associate,
    ate,
    read_tum,
    rpe,
    transform_poses,
    write_tum,
)

__all__ = [
    "AteResult",
    "ReconstructionResult",
    "RpeResult",
    "Statistics",
    "accuracy",
    "align_horn",
    "align_icp",
    "associate",
    "ate",
    "completion",
    "completion_ratio",
    "cull_mesh",
    "depth_l1",
    "evaluate_reconstruction",
    "read_tum",
    "rpe",
    "sample_surface",
    "transform_poses",
    "visible_points",
    "write_tum",
]
