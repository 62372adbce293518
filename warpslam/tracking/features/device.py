"""Features on the device, and the launches that match them and find a pose from the matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.kernels.features.agreement import depth_agreement
from warpslam.kernels.features.arrays import NO_OWNER, Feature, Features, Matches, Motion, View
from warpslam.kernels.features.matching import Search, match_points, settle_matches
from warpslam.kernels.features.pose import PoseState, Solver, normal_equations, robust_pose
from warpslam.kernels.gauss_newton import Mat66d, Vec6d
from warpslam.tracking.features.detection import DEPTH_STRIDE, FeatureFrame, cell_layout
from warpslam.tracking.features.settings import FeatureSettings

FEATURE: np.dtype = np.dtype(Feature.numpy_dtype())  # type: ignore[attr-defined]
"""`Feature` as a record of NumPy."""

_BLOCK = 32
_AGREEMENT_STEP = 2
"""Of the thinned depth: every eighth pixel of the image."""


@dataclass(frozen=True, eq=False)
class DeviceFrame:
    """A `FeatureFrame` on the device."""

    features: Features
    steady: np.ndarray
    """Features with depth that does not step, bool (n,), on the host."""
    thin_depth: wp.array
    motion: Motion


@dataclass(frozen=True, eq=False)
class FoundPose:
    """A pose from matches, on the host."""

    T_camera_reference: np.ndarray
    """float64 (4, 4)."""
    H: np.ndarray
    """float64 (6, 6)."""
    b: np.ndarray
    """float64 (6,)."""
    matches: int
    """Features that were matched."""
    inliers: int
    """Features among them that agree with the pose."""
    depth_errors: np.ndarray
    """1/z - 1/d of the rows that are inliers [1/m], 0 without depth; float32 (rows,)."""
    features: np.ndarray
    """Feature of each of these rows, int32 (rows,)."""

    @property
    def share(self) -> float:
        """Inliers among the matches, in [0, 1]."""
        return self.inliers / max(self.matches, 1)


class PoseFinder:
    """Launches of the kernels of features on one device.

    Arrays of matches are reused from call to call, and grow.
    """

    def __init__(self, camera: Intrinsics, device: wp.Device, settings: FeatureSettings) -> None:
        self.camera, self.device, self.settings = camera, device, settings
        self.view = _view(camera, settings)
        self._thin_camera = camera.strided(DEPTH_STRIDE)
        self._lanes = _BLOCK if device.is_cuda else 1
        self._matches = Matches()
        self._rows = self._features = self._slots = 0
        self._start = wp.zeros(1, dtype=wp.mat44d, device=device)
        self._state = PoseState()
        self._state.T_camera_reference = wp.zeros(1, dtype=wp.mat44d, device=device)
        self._state.normal = wp.zeros(1, dtype=Mat66d, device=device)
        self._state.right = wp.zeros(1, dtype=Vec6d, device=device)
        self._state.summary = wp.zeros(3, dtype=int, device=device)
        self._counts = wp.zeros((2, 2), dtype=int, device=device)

    def upload(self, frame: FeatureFrame) -> DeviceFrame:
        """Bring a frame to the device."""
        measured = np.zeros(len(frame), FEATURE)
        measured["pixel"], measured["octave"], measured["point"] = frame.pixels, frame.octaves, frame.points
        measured["pixel_sigma"] = self.settings.pixel_sigma * self.settings.scales[frame.octaves]
        measured["inverse_depth"] = np.where(frame.depth > 0, 1.0 / np.maximum(frame.depth, 1e-6), 0.0)
        measured["on_edge"], measured["row_time"] = frame.on_edge, frame.row_times
        features = self.measurements(measured)
        features.descriptor = self._array(frame.descriptors.view(np.uint64), wp.uint64)
        features.starts = self._array(frame.starts, int)
        motion = Motion()
        motion.translation, motion.rotation = wp.vec3(*frame.twist[:3]), wp.vec3(*frame.twist[3:])
        steady = (frame.depth > 0) & ~frame.on_edge
        return DeviceFrame(features, steady, self._array(frame.thin_depth, float), motion)

    def measurements(self, measured: np.ndarray) -> Features:
        """What a pose can be found from, but not matched by projection: records of type `FEATURE` (n,)."""
        features = Features()
        features.count = len(measured)
        features.feature = self._array(measured, Feature)
        return features

    def match(
        self,
        sources: Sequence[tuple[DeviceFrame, np.ndarray]],
        frame: DeviceFrame,
        T_camera_reference: np.ndarray,
        *,
        radius: float,
        limit: int,
        ratio: float,
    ) -> None:
        """Match the points of ``sources``, each with its T_reference_source (4, 4), with a frame by projection."""
        self._resize(len(sources), max(s.features.count for s, _ in sources), frame.features.count)
        self._matches.owner.fill_(int(NO_OWNER))
        self._start.assign(np.ascontiguousarray(T_camera_reference, np.float64)[None])
        search = Search()
        search.radius, search.limit, search.ratio = radius, limit, ratio
        for slot, (source, T) in enumerate(sources):
            inputs = [source.features, frame.features, self.view, wp.mat44(*np.float32(T).ravel()), self._start, search]
            self._launch(match_points, self._matches.stride, [*inputs, slot, self._matches])
        self._launch(settle_matches, self._matches.row_count, [self._matches])

    def pair(self, points: np.ndarray, features: np.ndarray, feature_count: int) -> None:
        """Matches that are known: points (n, 3) in reference axes [m], and the feature (n,) of each."""
        n = len(points)
        self._resize(1, n, feature_count)
        self._matches.point[:n].assign(np.ascontiguousarray(points, np.float32))
        self._matches.feature[:n].assign(np.ascontiguousarray(features, np.int32))
        self._matches.weight[:n].fill_(1.0)

    def solve(
        self,
        features: Features,
        motion: Motion,
        T_camera_reference: np.ndarray,
        depth_sigma: float,
        *,
        rounds: int = 4,
        iterations: int = 10,
    ) -> FoundPose:
        """Robust pose of the matches as they stand, from a start (4, 4)."""
        self._run(robust_pose, features, motion, T_camera_reference, depth_sigma, rounds, iterations)
        return self._found(features)

    def evaluate(
        self, features: Features, motion: Motion, T_camera_reference: np.ndarray, depth_sigma: float
    ) -> FoundPose:
        """Normal equations of the matches at a given pose (4, 4), with Huber."""
        self._run(normal_equations, features, motion, T_camera_reference, depth_sigma, 0, 0)
        return self._found(features)

    def agreement(self, a: DeviceFrame, b: DeviceFrame, T_b_a: np.ndarray) -> tuple[float, int]:
        """Share of the depth of two frames that agrees, both ways, and the lesser of the two counts of pixels."""
        self._counts.zero_()
        focal = wp.vec2(self._thin_camera.fx, self._thin_camera.fy)
        center = wp.vec2(self._thin_camera.cx, self._thin_camera.cy)
        both = [wp.mat44(*np.float32(T).ravel()) for T in (T_b_a, np.linalg.inv(T_b_a))]
        height, width = a.thin_depth.shape
        dim = (-(-height // _AGREEMENT_STEP), -(-width // _AGREEMENT_STEP))
        inputs = [a.thin_depth, b.thin_depth, *both, focal, center, _AGREEMENT_STEP, self._counts]
        self._launch(depth_agreement, dim, inputs)
        (compared_a, good_a), (compared_b, good_b) = self._counts.numpy().tolist()
        return (good_a + good_b) / max(compared_a + compared_b, 1), min(compared_a, compared_b)

    def _run(
        self,
        kernel: wp.Kernel,
        features: Features,
        motion: Motion,
        T_camera_reference: np.ndarray,
        depth_sigma: float,
        rounds: int,
        iterations: int,
    ) -> None:
        solver = Solver()
        solver.rounds, solver.iterations, solver.lanes = rounds, iterations, self._lanes
        solver.depth_sigma, solver.edge_factor = depth_sigma, self.settings.edge_factor
        self._start.assign(np.ascontiguousarray(T_camera_reference, np.float64)[None])
        inputs = [self._matches, features, self.view, motion, solver, self._start, self._state]
        self._launch(kernel, self._lanes, inputs)

    def _found(self, features: Features) -> FoundPose:
        rows, state = self._matches.row_count, self._state
        feature = self._matches.feature[:rows].numpy()
        inlier = (self._matches.inlier[:rows].numpy() != 0) & (feature >= 0)
        good = feature[inlier]
        return FoundPose(
            T_camera_reference=state.T_camera_reference.numpy()[0].copy(),
            H=state.normal.numpy()[0].copy(),
            b=state.right.numpy()[0].copy(),
            matches=_distinct(feature[feature >= 0], features.count),
            inliers=_distinct(good, features.count),
            depth_errors=self._matches.depth_error[:rows].numpy()[inlier],
            features=good,
        )

    def _resize(self, slots: int, stride: int, features: int) -> None:
        """Room for so many matches."""
        matches, device = self._matches, self.device
        stride = max(stride, 1)
        matches.stride, matches.slot_count, matches.row_count = stride, slots, slots * stride
        if matches.row_count > self._rows:
            self._rows = -(-matches.row_count // 1024) * 1024
            matches.point = wp.zeros(self._rows, dtype=wp.vec3, device=device)
            for name in ("feature", "key", "inlier"):
                setattr(matches, name, wp.zeros(self._rows, dtype=int, device=device))
            for name in ("weight", "depth_error"):
                setattr(matches, name, wp.zeros(self._rows, dtype=float, device=device))
        if slots > self._slots or features > self._features:
            self._slots, self._features = max(slots, self._slots), max(-(-features // 1024) * 1024, self._features)
            matches.owner = wp.zeros((self._slots, self._features), dtype=int, device=device)

    def _array(self, values: np.ndarray, dtype: type) -> wp.array:
        # On the CPU the array lends its memory.
        return wp.array(np.ascontiguousarray(values), dtype=dtype, device=self.device, copy=self.device.is_cuda)

    def _launch(self, kernel: wp.Kernel, dim: int | tuple[int, int], inputs: list) -> None:
        wp.launch(kernel, dim=dim, inputs=inputs, device=self.device, block_dim=_BLOCK, record_tape=False)


def _distinct(features: np.ndarray, count: int) -> int:
    seen = np.zeros(count, bool)
    seen[features] = True
    return int(seen.sum())


def _view(camera: Intrinsics, settings: FeatureSettings) -> View:
    view = View()
    view.focal, view.center = wp.vec2(camera.fx, camera.fy), wp.vec2(camera.cx, camera.cy)
    view.size = wp.vec2(float(camera.width), float(camera.height))
    view.cell = float(settings.cell)
    view.columns, view.rows = cell_layout(camera, settings)
    view.octave_factor, view.octaves = settings.octave_factor, settings.octaves
    return view
