"""Kernels of sparse features against NumPy: matching by projection, residuals, their derivatives, the robust pose."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpslam.camera import Intrinsics
from warpslam.kernels.features.arrays import Motion
from warpslam.tracking.features.detection import FeatureFrame
from warpslam.tracking.features.device import FEATURE, PoseFinder
from warpslam.tracking.features.settings import FeatureSettings

CAMERA = Intrinsics(260.0, 255.0, 158.0, 121.0, 320, 240)
SETTINGS = FeatureSettings()
DEPTH_SIGMA = 0.01
DEVICES = wp.get_devices()


@pytest.fixture(params=DEVICES, ids=str)
def finder(request) -> PoseFinder:
    """Launches on each device."""
    return PoseFinder(CAMERA, request.param, SETTINGS)


def exp(xi: np.ndarray) -> np.ndarray:
    """exp of a twist (v, w) by its power series, (4, 4)."""
    v, (x, y, z) = xi[:3], xi[3:]
    A = np.zeros((4, 4))
    A[:3, :3], A[:3, 3] = [[0, -z, y], [z, 0, -x], [-y, x, 0]], v
    total, term = np.eye(4), np.eye(4)
    for n in range(1, 25):
        term = term @ A / n
        total = total + term
    return total


def motion(twist: np.ndarray) -> Motion:
    """The same for kernels."""
    result = Motion()
    result.translation, result.rotation = wp.vec3(*twist[:3]), wp.vec3(*twist[3:])
    return result


def measured_points(
    rng: np.random.Generator, T: np.ndarray, count: int, noise: float, twist: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Points in front of a camera with T_camera_reference, and what it measures of them; a fifth has no depth."""
    x = rng.uniform([-1.0, -0.8, 1.5], [1.0, 0.8, 4.0], (count, 3))
    points = (x - T[:3, 3]) @ T[:3, :3]
    measured = np.zeros(count, FEATURE)
    measured["row_time"] = rng.uniform(-0.015, 0.015, count)
    seen = x - measured["row_time"][:, None] * (twist[:3] + np.cross(twist[3:], x))
    measured["pixel_sigma"] = 1.2 ** rng.integers(0, 5, count)
    pixels = np.column_stack(CAMERA.project(*seen.T))
    measured["pixel"] = pixels + noise * measured["pixel_sigma"][:, None] * rng.normal(size=(count, 2))
    measured["on_edge"] = rng.random(count) < 0.3
    inverse = 1.0 / seen[:, 2] + noise * DEPTH_SIGMA * rng.normal(size=count)
    measured["inverse_depth"] = np.where(rng.random(count) < 0.2, 0.0, inverse)
    return points.astype(np.float32), measured


def residuals(T: np.ndarray, points: np.ndarray, measured: np.ndarray, twist: np.ndarray) -> np.ndarray:
    """Whitened residuals (n, 3) in float64."""
    x = points.astype(float) @ T[:3, :3].T + T[:3, 3]
    x = x - measured["row_time"].astype(float)[:, None] * (twist[:3] + np.cross(twist[3:], x))
    u, v = CAMERA.project(*x.T)
    sigma = DEPTH_SIGMA * np.where(measured["on_edge"] != 0, SETTINGS.edge_factor, 1.0)
    depth = np.where(measured["inverse_depth"] > 0, (1.0 / x[:, 2] - measured["inverse_depth"]) / sigma, 0.0)
    away = np.column_stack([u, v]) - measured["pixel"]
    return np.column_stack([away / measured["pixel_sigma"][:, None], depth])


def weights(r: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Huber's, of points (n,)."""
    limit = np.where(measured["inverse_depth"] > 0, 7.815, 5.991)
    chi2 = (r**2).sum(axis=1)
    return np.where(chi2 > limit, np.sqrt(limit / np.maximum(chi2, 1e-12)), 1.0)


@pytest.mark.parametrize("noise", [0.5, 3.0])
def test_normal_equations_are_those_of_numeric_derivatives(finder, noise):
    """H = J' W J and b = J' W r with J from central differences of exp(xi) T, rolling shutter and Huber included."""
    rng = np.random.default_rng(1)
    T, twist = exp(np.array([0.1, -0.2, 0.15, 0.1, -0.05, 0.2])), np.array([0.5, -0.3, 0.4, 0.8, -0.6, 0.5])
    points, measured = measured_points(rng, T, 200, noise, twist)
    T = exp(np.array([0.002, -0.001, 0.003, 0.001, 0.002, -0.001])) @ T
    finder.pair(points, np.arange(200), 200)
    found = finder.evaluate(finder.measurements(measured), motion(twist), T, DEPTH_SIGMA)
    r, step = residuals(T, points, measured, twist), 1e-5
    J = np.stack(
        [
            (residuals(exp(e) @ T, points, measured, twist) - residuals(exp(-e) @ T, points, measured, twist))
            / 2
            / step
            for e in step * np.eye(6)
        ],
        axis=-1,
    )
    W = weights(r, measured)
    assert (W < 1).any() if noise > 1 else (W < 1).mean() < 0.05
    np.testing.assert_allclose(
        found.H, np.einsum("n,nki,nkj->ij", W, J, J), rtol=1e-3, atol=1e-4 * np.abs(found.H).max()
    )
    np.testing.assert_allclose(found.b, np.einsum("n,nki,nk->i", W, J, r), rtol=1e-3, atol=1e-4 * np.abs(found.b).max())


def test_pose_is_found_among_outliers(finder):
    """Four of ten matches are wrong, and the start is off by 5 cm and 3 degrees."""
    rng = np.random.default_rng(2)
    T, still = exp(np.array([0.1, -0.2, 0.15, 0.1, -0.05, 0.2])), np.zeros(6)
    points, measured = measured_points(rng, T, 400, 0.3, still)
    measured["row_time"] = 0.0
    wrong = rng.random(400) < 0.4
    measured["pixel"][wrong] = rng.uniform([0, 0], [320, 240], (wrong.sum(), 2))
    finder.pair(points, np.arange(400), 400)
    start = exp(np.array([0.03, 0.03, -0.03, 0.03, -0.03, 0.03])) @ T
    found = finder.solve(finder.measurements(measured), motion(still), start, DEPTH_SIGMA)
    error = np.linalg.inv(T) @ found.T_camera_reference
    assert np.linalg.norm(error[:3, 3]) < 0.002 and np.abs(error[:3, :3] - np.eye(3)).max() < 0.001
    assert found.matches == 400 and abs(found.inliers - (~wrong).sum()) < 12
    # What is left at the minimum is zero to single precision.
    assert np.abs(np.linalg.solve(found.H, found.b)).max() < 1e-5
    R = found.T_camera_reference[:3, :3]
    assert np.abs(R @ R.T - np.eye(3)).max() < 1e-12


def test_nothing_to_go_on(finder):
    """Without a match the pose stays where it started, and says that it rests on nothing."""
    finder.pair(np.zeros((5, 3), np.float32), np.full(5, -1), 5)
    found = finder.solve(finder.measurements(np.zeros(5, FEATURE)), motion(np.zeros(6)), np.eye(4), DEPTH_SIGMA)
    assert found.matches == found.inliers == 0 and np.array_equal(found.T_camera_reference, np.eye(4))


def random_frame(rng: np.random.Generator, pixels: np.ndarray, descriptors: np.ndarray, z: np.ndarray) -> FeatureFrame:
    """Features at given places, put in order of their cells."""
    columns, rows = CAMERA.width // SETTINGS.cell, CAMERA.height // SETTINGS.cell
    cell = (pixels[:, 1] // SETTINGS.cell * columns + pixels[:, 0] // SETTINGS.cell).astype(int)
    order = np.argsort(cell, kind="stable")
    pixels, z = pixels[order].astype(np.float32), z[order].astype(np.float32)
    points = CAMERA.backproject(pixels[:, 0], pixels[:, 1], z).astype(np.float32)
    return FeatureFrame(
        pixels=pixels,
        octaves=rng.integers(0, 3, len(pixels)).astype(np.int32),
        descriptors=np.ascontiguousarray(descriptors[order]),
        depth=z,
        on_edge=np.zeros(len(pixels), bool),
        points=points,
        starts=np.searchsorted(cell[order], np.arange(columns * rows + 1)).astype(np.int32),
        thin_depth=np.zeros((60, 80), np.float32),
        row_times=np.zeros(len(pixels), np.float32),
    )


def two_frames(count: int) -> tuple[FeatureFrame, FeatureFrame, np.ndarray]:
    """Features of one frame and of another from T_b_a, where they look nearly the same, and others besides."""
    rng = np.random.default_rng(3)
    pixels = rng.uniform([5, 5], [314, 234], (count, 2))
    descriptors, z = rng.integers(0, 256, (count, 32), dtype=np.uint8), rng.uniform(1.0, 3.0, count)
    z[::7] = 0.0
    # Some have a double beside them that wants the same feature.
    doubles = descriptors[:60] ^ np.packbits(rng.random((60, 256)) < 0.03, axis=1)
    pixels, z = np.vstack([pixels, pixels[:60] + 0.5]), np.append(z, z[:60])
    descriptors = np.vstack([descriptors, doubles])
    a = random_frame(rng, pixels, descriptors, z)
    T = exp(np.array([0.02, -0.01, 0.02, 0.01, 0.02, -0.01]))
    x = a.points @ T[:3, :3].T + T[:3, 3]
    known = a.depth > 0
    there = np.column_stack(CAMERA.project(*np.where(known[:, None], x, 1.0).T))
    noisy = a.descriptors ^ np.packbits(rng.random((len(a), 256)) < 0.08, axis=1)
    alone = np.array([not np.any(np.abs(a.pixels[:i] - a.pixels[i]).max(axis=1) < 0.6) for i in range(len(a))])
    kept = known & alone & (there > 2).all(axis=1) & (there[:, 0] < 318) & (there[:, 1] < 238)
    more = rng.uniform([5, 5], [314, 234], (count, 2))
    b = random_frame(
        rng,
        np.vstack([there[kept] + rng.normal(size=(kept.sum(), 2)), more]),
        np.vstack([noisy[kept], rng.integers(0, 256, (count, 32), dtype=np.uint8)]),
        rng.uniform(1.0, 3.0, kept.sum() + count),
    )
    return a, b, T


def reference_matches(a: FeatureFrame, b: FeatureFrame, T: np.ndarray, radius: float, limit: int, ratio: float) -> dict:
    """Feature of b by point of a, by comparing all with all."""
    bids: dict[int, list] = {}
    for i in np.flatnonzero(a.depth > 0):
        x = T[:3, :3] @ a.points[i] + T[:3, 3]
        u, v = CAMERA.project(*x)
        if not (x[2] > 0.1 and 0 <= u <= 319 and 0 <= v <= 239):
            continue
        level = a.octaves[i] + round(np.log(np.linalg.norm(a.points[i]) / np.linalg.norm(x)) / np.log(1.2))
        r = radius * 1.2 ** np.clip(level, 0, SETTINGS.octaves - 1)
        near = (np.hypot(*(b.pixels - [u, v]).T) <= r) & (np.abs(b.octaves - level) <= 2)
        bits = [(int(np.unpackbits(a.descriptors[i] ^ b.descriptors[j]).sum()), j) for j in np.flatnonzero(near)]
        if not bits:
            continue
        best, *rest = sorted(bits)
        if best[0] > limit:
            continue
        if rest and b.octaves[rest[0][1]] == b.octaves[best[1]] and best[0] > ratio * rest[0][0]:
            continue
        bids.setdefault(best[1], []).append((best[0], i))
    assert sum(len(offers) > 1 for offers in bids.values()) > 20
    return {min(offers)[1]: j for j, offers in bids.items()}


def test_matches_are_those_of_comparing_all_with_all(finder):
    """The search by cells misses nothing, and a feature goes to the point that looks most like it."""
    a, b, T = two_frames(400)
    expected = reference_matches(a, b, T, 12.0, 80, 0.85)
    finder.match([(finder.upload(a), np.eye(4))], finder.upload(b), T, radius=12.0, limit=80, ratio=0.85)
    feature = finder._matches.feature.numpy()[: len(a)]
    assert {int(i): int(feature[i]) for i in np.flatnonzero(feature >= 0)} == expected
    assert len(expected) > 200


def test_a_feature_seen_by_two_keyframes_is_one_measurement(finder):
    """Two equal sources give the normal equations, and the counts, of one."""
    a, b, T = two_frames(300)
    mine, target = finder.upload(a), finder.upload(b)
    search = {"radius": 12.0, "limit": 80, "ratio": 0.85}
    found = []
    for sources in (1, 2):
        finder.match([(mine, np.eye(4))] * sources, target, T, **search)
        found.append(finder.evaluate(target.features, target.motion, T, DEPTH_SIGMA))
    one, two = found
    assert one.matches == two.matches > 100 and one.inliers == two.inliers
    np.testing.assert_allclose(two.H, one.H, rtol=1e-5, atol=1e-6 * np.abs(one.H).max())


def test_agreement_of_depth(finder):
    """A wall that the camera steps back from agrees if the step is known, and by 3 of 4 if a quarter is elsewhere."""
    wall = np.full((60, 80), 2.0, np.float32)
    back = np.full((60, 80), 2.1, np.float32)
    T = np.eye(4)
    T[2, 3] = 0.1

    def frame(depth: np.ndarray):
        nothing = random_frame(np.random.default_rng(0), np.zeros((0, 2)), np.zeros((0, 32), np.uint8), np.zeros(0))
        object.__setattr__(nothing, "thin_depth", depth)
        return finder.upload(nothing)

    share, compared = finder.agreement(frame(wall), frame(back), T)
    assert share == 1.0 and 0.8 * 1200 < compared <= 1200
    assert finder.agreement(frame(wall), frame(back), np.eye(4))[0] == 0.0
    back[:30, :40] = 1.0
    share, _ = finder.agreement(frame(wall), frame(back), T)
    assert 0.7 < share < 0.8
    back[:30, :40] = 0.0
    share, fewer = finder.agreement(frame(wall), frame(back), T)
    assert share == 1.0 and fewer < 0.8 * compared
