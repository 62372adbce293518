"""Pixels, samples, and the thresholds that skip work, on a wall in a small map."""

import numpy as np
import pytest
import warp as wp

from tests.kernels.drawn_pixels import pixels_of
from warpslam.camera import Intrinsics
from warpslam.config import GridConfig
from warpslam.field.arrays import Gradients, GridGradient, Thresholds, gradient_buffers
from warpslam.field.decoder_files import load_decoders
from warpslam.field.objectives import mapping_loss
from warpslam.field.passes import render as render_batch
from warpslam.field.ray_batch import RayBatch
from warpslam.poses import vector_from_pose
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.scene_map import SceneMap

CAMERA = Intrinsics(40.0, 42.0, 31.0, 23.5, 64, 48)
RAYS = 300


@pytest.fixture(scope="module")
def images(device):
    """Two images whose pixels tell where they come from."""
    pool = ImagePool(CAMERA, device)
    rng = np.random.default_rng(0)
    stored = []
    for slot in range(2):
        rgb = rng.integers(0, 256, (48, 64, 3)).astype(np.uint8)
        depth = rng.uniform(1.0, 2.0, (48, 64)).astype(np.float32)
        depth[:, ::5] = 0.0
        if slot == 0:
            pool.set(0, rgb, depth)
        else:
            assert pool.bring([pool.add(rgb, depth)]) == [slot]
        stored.append((rgb, depth))
    return pool, stored


@pytest.fixture(scope="module")
def scene_map(device):
    """A map around the origin with random features."""
    scene = SceneMap(
        load_decoders(), GridConfig(middle_std=0.5, fine_std=0.1, color_std=0.3, layout="dense"), device, seed=1
    )
    scene.cover(np.array([-2.0, -2.0, -0.5]), np.array([2.0, 2.0, 2.5]))
    return scene


def draw(images, device, scene_map, *, jitter: bool, seed: int = 5) -> RayBatch:
    batch = RayBatch(RAYS, 48, device)
    window = wp.array([0, 1], dtype=int, device=device)
    poses = wp.array(np.stack([vector_from_pose(np.eye(4))] * 2), dtype=float, device=device, requires_grad=True)
    batch.set_seeds([seed])
    batch.draw(images[0].arrays, window, RAYS // 2, CAMERA, edges=(3, 2))
    batch.cast(poses)
    batch.bound(scene_map.arrays())
    batch.place_samples(32, 16, jitter=jitter)
    return batch


def test_pixels_carry_the_images_values(images, device, scene_map):
    """Depth and colour of a ray are those of its pixel; the border is left out; both frames get their share."""
    batch = draw(images, device, scene_map, jitter=False)
    u, v = pixels_of(batch, CAMERA)
    assert u.min() >= 3 and u.max() < 61 and v.min() >= 2 and v.max() < 46
    frame = batch.frame.numpy()
    assert (np.bincount(frame) == RAYS // 2).all()
    for f, (rgb, depth) in enumerate(images[1]):
        mine = frame == f
        np.testing.assert_allclose(batch.measured_depth.numpy()[mine], depth[v[mine], u[mine]], atol=2e-5)
        np.testing.assert_allclose(batch.measured_rgb.numpy()[mine], rgb[v[mine], u[mine]] / 255.0, atol=1e-6)


def test_pixels_depend_on_the_seed_alone(images, device, scene_map):
    """The same seed draws the same pixels, another seed others."""
    a, b, c = (draw(images, device, scene_map, jitter=True, seed=s) for s in (5, 5, 6))
    np.testing.assert_array_equal(a.direction_camera.numpy(), b.direction_camera.numpy())
    np.testing.assert_array_equal(a.z.numpy(), b.z.numpy())
    assert not np.array_equal(a.direction_camera.numpy(), c.direction_camera.numpy())


def test_jittered_samples_stay_in_their_strata(images, device, scene_map):
    """Ascending, one in each stratum, and spread over it: neither even nor the same for all rays."""
    even, random = (draw(images, device, scene_map, jitter=j) for j in (False, True))
    keep = (even.keep.numpy() != 0) & (even.measured_depth.numpy() > 0)
    z_even, z = (batch.z.numpy().reshape(RAYS, 48)[keep] for batch in (even, random))
    assert keep.sum() > 50
    assert (np.diff(z, axis=1) >= 0).all()
    depth = even.measured_depth.numpy()[keep][:, None]
    near_surface = (z >= 0.95 * depth * (1 - 1e-6)) & (z <= 1.05 * depth * (1 + 1e-6))
    assert (near_surface.sum(axis=1) >= 16).all()
    np.testing.assert_allclose(z[:, 0], z_even[:, 0], atol=0.05)
    # The largest gap of two uniform strata is twice the even spacing.
    assert np.diff(z, axis=1).max() < 2.01 * np.diff(z_even, axis=1).max()
    assert np.abs(z - z_even).mean() > 0.005


def render(batch: RayBatch, scene_map: SceneMap, *thresholds: float):
    """Colour, depth, ray gradient and colour-grid gradient of a mapping loss with some thresholds."""
    arrays = scene_map.arrays()
    rows = scene_map.grids["color"].row_count
    grid = GridGradient(gradient_buffers(rows, batch.device), wp.array(np.arange(rows), dtype=int, device=batch.device))
    for array in (batch.origin.grad, batch.direction.grad):
        array.zero_()
    with batch.launcher.tape() as tape:
        gradients = Gradients({"color": grid}, points=True)
        render_batch(batch, arrays, "color", gradients, tape, thresholds=Thresholds(*thresholds))
        mapping_loss(batch, 0.2)
    tape.backward(batch.loss)
    parts = batch.rgb, batch.depth, batch.direction.grad
    return *(part.numpy().copy() for part in parts), grid.buffers.numpy().sum(axis=0)


def test_skipped_samples_keep_the_stated_bounds(images, device, scene_map):
    """Colour errs by less than samples x threshold, depth not at all, gradients little; zero thresholds are exact."""
    batch = draw(images, device, scene_map, jitter=True)
    exact = render(batch, scene_map, 0.0, 0.0)
    again = render(batch, scene_map, 0.0, 0.0)
    for a, b in zip(exact[:2], again[:2], strict=True):
        np.testing.assert_array_equal(a, b)
    min_weight = 1e-3
    rgb, depth, direction, rows = render(batch, scene_map, min_weight, 3e-5)
    brightest = np.abs(batch.color.numpy()).max()
    assert np.abs(rgb - exact[0]).max() <= 48 * min_weight * max(brightest, 1.0)
    assert np.abs(rgb - exact[0]).max() > 0, "nothing was skipped: the test looks at nothing"
    np.testing.assert_array_equal(depth, exact[1])
    for skipped, full in ((direction, exact[2]), (rows, exact[3])):
        assert np.linalg.norm(skipped - full) < 0.02 * np.linalg.norm(full)


def test_rays_that_end_early_keep_the_stated_bounds(images, device, scene_map):
    """Depth and colour err by less than what is left of the light allows; gradients hardly change; work is saved."""
    batch = draw(images, device, scene_map, jitter=True)
    exact = render(batch, scene_map, 0.0, 0.0)
    kept = batch.keep.numpy() != 0
    all_weights = batch.weight.numpy().reshape(RAYS, 48)[kept]
    color = batch.color.numpy().reshape(RAYS, 48, 3)[kept]
    least = 0.05
    rgb, depth, direction, rows = render(batch, scene_map, 0.0, 0.0, least)
    weights = batch.weight.numpy().reshape(RAYS, 48)[kept]
    if batch.kernels.by_sample:
        # All samples are worked on at once: nothing is left out.
        np.testing.assert_array_equal(weights, all_weights)
        return
    left_out = (weights == 0) & (all_weights > 0)
    assert left_out.sum() > 0.02 * left_out.size, "no ray ended: the test looks at nothing"
    np.testing.assert_array_equal(weights[~left_out], all_weights[~left_out])
    assert (all_weights * left_out).sum(axis=1).max() < least
    farthest = batch.z.numpy().reshape(RAYS, 48)[kept].max(axis=1)
    assert (np.abs(depth - exact[1])[kept] <= least * farthest).all()
    assert (np.abs(rgb - exact[0])[kept] <= least * np.abs(color).max()).all()
    for short, full in ((direction, exact[2]), (rows, exact[3])):
        assert np.linalg.norm(short - full) < 0.05 * np.linalg.norm(full)


def test_gradients_without_a_tape_are_refused(images, device, scene_map):
    """An adjoint that nobody records would be a silent zero."""
    batch = draw(images, device, scene_map, jitter=False)
    with pytest.raises(ValueError, match="tape"):
        render_batch(batch, scene_map.arrays(), "color", Gradients(points=True))
