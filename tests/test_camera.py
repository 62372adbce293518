"""The pinhole camera: there and back, and what becomes of it when the image changes."""

from __future__ import annotations

import numpy as np
import pytest

from warpslam.camera import Intrinsics, SensorTiming, is_number
from warpslam.errors import ConfigError

CAMERA = Intrinsics(500.0, 480.0, 310.0, 245.0, 640, 480)


def test_project_undoes_backproject():
    """Pixels of any number of axes come back; the point has the depth as its z, and the camera matrix agrees."""
    rng = np.random.default_rng(0)
    u, v, z = rng.uniform(0, 640, (3, 4)), rng.uniform(0, 480, (3, 4)), rng.uniform(0.3, 9, (3, 4))
    points = CAMERA.backproject(u, v, z)
    assert points.shape == (3, 4, 3) and points.dtype == np.float64
    np.testing.assert_array_equal(points[..., 2], z)
    np.testing.assert_allclose(CAMERA.project(*np.moveaxis(points, -1, 0)), (u, v), atol=1e-9)
    np.testing.assert_allclose(points @ CAMERA.matrix.T, np.stack([u * z, v * z, z], axis=-1), rtol=1e-12)


def test_rays_are_points_at_one_metre():
    """One depth for all pixels."""
    u, v = np.array([310, 810]), np.array([245, 245])
    np.testing.assert_array_equal(CAMERA.backproject(u, v, 1.0), [[0, 0, 1], [1, 0, 1]])


def test_a_point_keeps_its_pixel_when_the_image_changes():
    """Scaled, strided and cropped cameras see it where the changed image has it."""
    point = (0.3, -0.2, 2.0)
    u, v = CAMERA.project(*point)
    np.testing.assert_allclose(CAMERA.scaled(320, 240).project(*point), (u / 2, v / 2))
    np.testing.assert_allclose(CAMERA.strided(4).project(*point), (u / 4, v / 4))
    np.testing.assert_allclose(CAMERA.cropped(10).project(*point), (u - 10, v - 10))


@pytest.mark.parametrize(("name", "value"), [("fx", 0), ("fy", -1), ("width", 0), ("cx", np.nan), ("fx", np.inf)])
def test_a_camera_that_can_not_be_is_refused(name, value):
    """The field and its value are named."""
    with pytest.raises(ConfigError, match=rf"camera\.{name} = {value}"):
        Intrinsics(**{**vars(CAMERA), name: value})


@pytest.mark.parametrize("value", [10**30, -(10**30), 10**400, "x", None, True, 1j, np.zeros(3), [1.0]])
def test_what_is_no_number_is_refused(value):
    """By the fields of a camera and of its timing alike, with an error of ours; whole numbers may be of any length."""
    assert not is_number(value) or abs(value) == 10**30
    for name in ("fx", "cy", "width"):
        with pytest.raises(ConfigError, match=rf"camera\.{name}"):
            Intrinsics(**{**vars(CAMERA), name: value})
    for name in ("depth_delay", "readout"):
        with pytest.raises(ConfigError, match=rf"camera\.{name}"):
            SensorTiming(**{name: value})


def test_sensor_timing_adds_its_delay_to_the_stamps():
    """tau is the difference of the stamps plus the constant; without a stamp of depth the constant alone."""
    timing = SensorTiming(depth_delay=-0.02, readout=0.026)
    assert timing.depth_offset(10.0, 9.99) == pytest.approx(-0.03)
    assert timing.depth_offset(10.0, None) == -0.02
    assert SensorTiming().depth_offset(10.0, None) == 0.0


@pytest.mark.parametrize(
    ("name", "value"),
    [("depth_delay", 0.21), ("depth_delay", -0.21), ("depth_delay", np.nan), ("readout", -1e-3), ("readout", 0.3)],
)
def test_sensor_timing_out_of_range(name, value):
    """A delay or readout that no camera has, is refused by name."""
    with pytest.raises(ConfigError, match=f"camera.{name}"):
        SensorTiming(**{name: value})
