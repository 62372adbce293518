"""Features of a frame: which are chosen, what depth they have, and when that was measured."""

from __future__ import annotations

from dataclasses import fields

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.tracking.features.detection import SensorTiming, depth_at, detect, retimed
from warpslam.tracking.features.settings import FeatureSettings

CAMERA = Intrinsics(260.0, 255.0, 158.0, 121.0, 320, 240)
SETTINGS = FeatureSettings()


def blocks(seed: int = 0, height: int = 240, width: int = 320) -> np.ndarray:
    """Random grey rectangles, which have corners."""
    rng = np.random.default_rng(seed)
    image = np.full((height, width), 128, np.uint8)
    for _ in range(400):
        y, x = rng.integers(0, height - 10), rng.integers(0, width - 10)
        image[y : y + rng.integers(4, 30), x : x + rng.integers(4, 30)] = rng.integers(0, 256)
    return image


def test_the_same_images_give_the_same_features():
    """To the byte, so that a keyframe's are rebuilt from its images."""
    image, depth = blocks(), np.full((240, 320), 2.0, np.float32)
    a, b = (detect(image.copy(), depth.copy(), CAMERA) for _ in range(2))
    assert len(a) > 200
    for field in fields(a):
        x, y = getattr(a, field.name), getattr(b, field.name)
        assert x.dtype == y.dtype and x.tobytes() == y.tobytes(), field.name


def test_features_are_spread_and_in_order_of_cells():
    """No cell has more than three, and ``starts`` says where each begins."""
    frame = detect(blocks(), np.full((240, 320), 2.0, np.float32), CAMERA)
    cell = frame.pixels[:, 1] // 20 * 16 + frame.pixels[:, 0] // 20
    assert np.all(np.diff(cell) >= 0)
    counts = np.diff(frame.starts)
    assert len(counts) == 16 * 12 and frame.starts[0] == 0 and frame.starts[-1] == len(frame)
    assert np.array_equal(counts, np.bincount(cell.astype(int), minlength=192))
    assert counts.max() == 3 and np.count_nonzero(counts) > 80
    assert np.allclose(frame.points[:, 2], 2.0) and not frame.on_edge.any()
    u, v = CAMERA.project(*frame.points.T)
    np.testing.assert_allclose(np.column_stack([u, v]), frame.pixels, atol=1e-3)


def test_half_the_size_gives_the_same_places():
    """A corner of an image of 640 lies where it is although it is detected at 320: half a pixel would be a bias."""
    camera = Intrinsics(520.0, 510.0, 316.5, 242.5, 640, 480)
    small = blocks()
    large = np.repeat(np.repeat(small, 2, axis=0), 2, axis=1)
    depth = np.full((480, 640), 2.0, np.float32)
    # All that is found: cells of 20 px are other cells at half the size.
    every = FeatureSettings(per_cell=1000)
    features, expected = detect(large, depth, camera, every), detect(small, depth[::2, ::2], CAMERA, every)
    a, b = (np.lexsort((*frame.pixels.T, frame.octaves)) for frame in (features, expected))
    np.testing.assert_allclose(features.pixels[a], 2 * expected.pixels[b] + 0.5, atol=1e-4)
    assert len(features) > 400 and np.array_equal(features.descriptors[a], expected.descriptors[b])


def test_an_image_without_corners():
    """No feature is no error."""
    frame = detect(np.zeros((240, 320), np.uint8), np.zeros((240, 320), np.float32), CAMERA)
    assert len(frame) == 0 and frame.descriptors.shape == (0, 32) and not frame.starts.any()


def test_depth_beneath_pixels():
    """The pixel's own, else the upper median of its neighbours, as a plain loop finds them; steps are told."""
    rng = np.random.default_rng(0)
    depth = rng.uniform(0.5, 9.0, (20, 30)).astype(np.float32)
    depth[rng.random(depth.shape) < 0.6] = 0.0
    depth[:, 15:] = np.where(depth[:, 15:] > 0, 2.0 + 0.01 * rng.random((20, 15)), 0.0)
    pixels = rng.uniform([-3, -3], [32, 22], (400, 2)).astype(np.float32)
    found, on_edge = depth_at(depth, pixels, 8.0)
    for (x, y), z, edge in zip(pixels, found, on_edge, strict=True):
        u, v = int(np.floor(x + 0.5)), int(np.floor(y + 0.5))
        window = [depth[b, a] for b in range(v - 1, v + 2) for a in range(u - 1, u + 2) if 0 <= a < 30 and 0 <= b < 20]
        near = sorted(d for d in window if d > 0)
        own = depth[v, u] if 0 <= u < 30 and 0 <= v < 20 else 0.0
        expected = own if own > 0 else near[len(near) // 2] if near else 0.0
        expected = expected if expected <= 8.0 else 0.0
        assert z == np.float32(expected)
        step = bool(near) and near[-1] - near[0] > 0.02 + 0.03 * near[len(near) // 2]
        assert edge == (step and expected > 0)
    assert on_edge.any() and (found == 0).any() and (~on_edge & (found > 0)).any()


def plane_depth(T_world_camera: np.ndarray) -> np.ndarray:
    """Depth image of the plane z = 2 + 0.5 x of the world."""
    v, u = np.mgrid[0:240, 0:320].astype(float)
    rays = CAMERA.backproject(u, v, 1.0) @ T_world_camera[:3, :3].T
    o, n = T_world_camera[:3, 3], np.array([-0.5, 0.0, 1.0])
    return ((2.0 - n @ o) / (rays @ n)).astype(np.float32)


def test_depth_of_another_time_is_brought_to_the_features():
    """Before a slanting wall, with depth 50 ms late and the camera moving, points come to lie on the wall."""
    twist = np.array([0.4, 0.2, -0.3, 0.1, 0.4, 0.2])
    later = np.eye(4)
    angle = 0.05 * twist[3:]
    W = np.array([[0, -angle[2], angle[1]], [angle[2], 0, -angle[0]], [-angle[1], angle[0], 0]])
    later[:3, :3], later[:3, 3] = np.eye(3) + W + W @ W / 2, 0.05 * twist[:3]
    depth = plane_depth(later)
    frame = detect(blocks(), depth, CAMERA)

    def off(points: np.ndarray) -> float:
        known = points[:, 2] > 0
        assert known.mean() > 0.9
        distance = (points[known, 2] - 2.0 - 0.5 * points[known, 0]) / np.sqrt(1.25)
        return float(np.sqrt((distance**2).mean()))

    corrected = retimed(frame, depth, CAMERA, SETTINGS, SensorTiming(depth_delay=0.05), twist)
    assert off(frame.points) > 0.02 and off(corrected.points) < 0.003
    assert not corrected.row_times.any()


def test_rows_of_a_rolling_shutter():
    """A point that row r sees is brought to the middle row by the camera's motion between the two."""
    twist, depth = np.array([0.4, 0.2, -0.3, 0.1, 0.4, 0.2]), np.full((240, 320), 2.0, np.float32)
    frame = detect(blocks(), depth, CAMERA)
    rolled = retimed(frame, depth, CAMERA, SETTINGS, SensorTiming(readout=0.03), twist)
    dt = (frame.pixels[:, 1] / 240 - 0.5) * 0.03
    np.testing.assert_allclose(rolled.row_times, dt, atol=1e-7)
    expected = frame.points + dt[:, None] * (twist[:3] + np.cross(twist[3:], frame.points))
    np.testing.assert_allclose(rolled.points, expected, atol=1e-5)
    assert np.abs(rolled.points - frame.points).max() > 0.01
    still = retimed(frame, depth, CAMERA, SETTINGS, SensorTiming(0.02, 0.03), np.zeros(6))
    np.testing.assert_allclose(still.points, frame.points, atol=1e-5)
