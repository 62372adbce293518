"""Rows of features as they join a pose's normal equations beside those of the images."""

from __future__ import annotations

import numpy as np

from warpslam.kernels.direct import registration
from warpslam.poses import inverse, motion_between, orthonormalized
from warpslam.tracking.direct.pyramid import records
from warpslam.tracking.direct.window import PairRows
from warpslam.tracking.features.device import FoundPose
from warpslam.tracking.features.witness import FeatureRows

LEAST_INLIERS = 20
"""Features that must agree with a pose for their rows to count."""
SAME_STEP, SAME_TURN = 0.1, 5.0
"""Poses further apart [m], [degrees] are two places; neither the joint registration nor features must take a camera to
another.
"""
FEATURE_WEIGHT = 5.0
"""Of a feature's row against one of the images. On rendered sequences, whose truth is known, squared errors of poses
are 15 to 54 times what the images' normal matrix says, and 3 to 4 times what that of the features says.
"""
WEAK_SIGMA = 0.005
"""Standard deviation [m] of the position from which a direction counts as weak: features are asked."""
LINEARIZATIONS = 2
"""Times that rows are linearised, at most."""
FAR_STEP, FAR_TURN = 0.01, 0.5
"""A pose that is further [m], [degrees] from where rows were linearised needs them anew."""


def feature_rows(rows: FeatureRows, T_world_reference: np.ndarray, T_frame_reference: np.ndarray) -> np.ndarray | None:
    """Rows linearised at a pose, `registration.OtherRows` (1,); None where too few features agree with it.

    Args:
        rows: Matches of the frame with keyframes.
        T_world_reference: The reference keyframe's pose, (4, 4).
        T_frame_reference: Where they are linearised, (4, 4).
    """
    found = rows.at(T_world_reference @ inverse(T_frame_reference))
    if found.inliers < LEAST_INLIERS:
        return None
    joining = records(registration.OtherRows)
    joining["T"] = T_frame_reference
    joining["H"], joining["g"] = FEATURE_WEIGHT * found.H, FEATURE_WEIGHT * found.b
    return joining


def pair_rows(found: FoundPose, T_later_earlier: np.ndarray) -> PairRows | None:
    """What features say of two keyframes believed to be at T_later_earlier (4, 4); None where they see another
    place: a period of the surface further, say.
    """
    T = orthonormalized(found.T_camera_reference @ T_later_earlier)
    if is_elsewhere(T, T_later_earlier):
        return None
    return PairRows(T, FEATURE_WEIGHT * found.H, FEATURE_WEIGHT * found.b)


def is_elsewhere(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether two poses (4, 4) are two places."""
    step, turn = motion_between(a, b)
    return bool(step > SAME_STEP or turn > SAME_TURN)


def is_far(a: np.ndarray, b: np.ndarray) -> bool:
    """Whether rows linearised at one pose (4, 4) don't hold at another."""
    step, turn = motion_between(a, b)
    return bool(step > FAR_STEP or turn > FAR_TURN)


def weakest_sigma(covariance: np.ndarray) -> float:
    """Standard deviation of the position in its worst direction [m], of a covariance (6, 6)."""
    return float(np.linalg.eigvalsh(covariance[:3, :3])[-1]) ** 0.5
