"""How good a run is: trajectories (`ate`, `rpe`), reconstructions under named protocols, and rendered images."""

from warpslam.evaluation.culling import DEFAULT_PROTOCOL, PROTOCOLS, Culling, Views, sample_surface, visible_points
from warpslam.evaluation.image_errors import depth_l1, psnr, rendering_metrics, ssim
from warpslam.evaluation.protocols import evaluate_mesh
from warpslam.evaluation.reconstruction import (
    ReconstructionResult,
    accuracy,
    align_icp,
    completion,
    completion_ratio,
    evaluate_reconstruction,
    f_score,
    load_mesh,
    reconstruction_metrics,
)
from warpslam.evaluation.trajectory_errors import (
    AteResult,
    RpeResult,
    Statistics,
    align_horn,
    ate,
    rpe,
    trajectory_metrics,
)
from warpslam.evaluation.virtual_views import VirtualDepth, virtual_depth
from warpslam.poses import transform_poses
from warpslam.storage.tum import associate, read_tum, write_tum

__all__ = [
    "DEFAULT_PROTOCOL",
    "PROTOCOLS",
    "AteResult",
    "Culling",
    "ReconstructionResult",
    "RpeResult",
    "Statistics",
    "Views",
    "VirtualDepth",
    "accuracy",
    "align_horn",
    "align_icp",
    "associate",
    "ate",
    "completion",
    "completion_ratio",
    "depth_l1",
    "evaluate_mesh",
    "evaluate_reconstruction",
    "f_score",
    "load_mesh",
    "psnr",
    "read_tum",
    "reconstruction_metrics",
    "rendering_metrics",
    "rpe",
    "sample_surface",
    "ssim",
    "trajectory_metrics",
    "transform_poses",
    "virtual_depth",
    "visible_points",
    "write_tum",
]
