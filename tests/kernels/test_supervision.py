"""The direct loss against a torch oracle and finite differences, the rows it lists, and Adam on them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
import warp as wp

from tests.kernels.iteration import field_on_device
from tests.kernels.random_scene import oracle_rays, random_field, random_rays
from tests.kernels.test_against_oracle import check_rows
from tests.kernels.test_finite_differences import check
from tests.reference import oracle
from warpslam.camera import Intrinsics
from warpslam.field.arrays import Gradients, GridGradient, gradient_buffers, struct
from warpslam.field.packing import PackedDecoder
from warpslam.field.ray_batch import RayBatch
from warpslam.field.supervision import place_band, supervise
from warpslam.kernels.decoder.layout import COLOR_WEIGHT_ROWS
from warpslam.kernels.grid import Vec32
from warpslam.kernels.supervision import Band, Target
from warpslam.runtime.launching import Launcher
from warpslam.scene.feature_grid import FeatureGrid
from warpslam.scene.touched_rows import TouchedRows

LEVELS = ("middle", "fine", "color")
TARGET = {
    "slope": 8.0, "front": 0.1, "behind": 0.05, "huber": 0.1, "behind_weight": 0.5, "color_weight": 0.7,
    "color_reach": 0.03, "color_huber": 0.05,
}  # fmt: skip
SAMPLES = 13
SEEDS = (1, 2)


class Run:
    """A batch whose samples lie before, in and behind the band of their pixel."""

    def __init__(self, device, seed: int, *, equal_middle: bool = False) -> None:
        self.field, (self.rays, self.column, self.row) = random_field(seed), random_rays(seed)
        if equal_middle:
            rows = self.field.grids["middle"].rows.detach()
            self.field.grids["middle"].rows = rows[:1].expand_as(rows).contiguous()
        self.device, self.count = device, len(self.rays.depth)
        self.arrays = field_on_device(self.field, device)
        self.batch = batch = RayBatch(self.count, SAMPLES, device)
        batch.count, batch.sample_count = self.count, SAMPLES
        batch.frame.assign(np.asarray(self.rays.frame, np.int32))
        batch.direction_camera.assign(self.rays.direction_camera)
        batch.measured_depth.assign(self.rays.depth)
        batch.measured_rgb.assign(self.rays.rgb)
        self.poses = wp.array(self.rays.poses, dtype=float, device=device, requires_grad=True)
        rng = np.random.default_rng(seed)
        s = np.sort(rng.uniform(-0.3, 0.1, (self.count, SAMPLES)), axis=1)
        s[:, -1] = 0.0
        self.z = (np.maximum(self.rays.depth, 0.5)[:, None] + s).astype(np.float32)
        batch.z.assign(self.z.ravel())
        self.target = struct(Target, **TARGET)
        self.gradients = Gradients(
            {level: self._gradient(level) for level in LEVELS}, True, gradient_buffers(COLOR_WEIGHT_ROWS, device)
        )

    def _gradient(self, level: str) -> GridGradient:
        rows = self.arrays.features[level].shape[0]
        place = wp.array(np.arange(rows), dtype=int, device=self.device)
        return GridGradient(gradient_buffers(rows, self.device), place)

    def backward(self) -> float:
        """All gradients; returns the loss."""
        batch = self.batch
        self.poses.grad.zero_()
        with batch.launcher.tape() as tape:
            batch.cast(self.poses)
            keep = (self.rays.depth > 0).astype(np.int32)
            batch.keep.assign(keep)
            supervise(batch, self.arrays, self.target, self.gradients, tape)
        tape.backward(batch.loss)
        return float(batch.loss.numpy()[0])

    @property
    def s(self) -> np.ndarray:
        """Distance behind the measured surface of each sample [m], float64 (rays, samples)."""
        return self.z.astype(np.float64) - self.rays.depth[:, None]

    def loss(self) -> float:
        """The loss in float64 from logits and colours as the kernels find them."""
        self.backward()
        shape, kept = (self.count, SAMPLES), self.rays.depth > 0
        logit, color = (getattr(self.batch, name).numpy().astype(np.float64) for name in ("logit", "color"))
        values = (logit.reshape(shape), color.reshape(*shape, 3), self.s, self.rays.rgb.astype(np.float64))
        return float(sum(terms(*(torch.tensor(value[kept]) for value in values)).values()))

    def rows(self, level: str) -> np.ndarray:
        return self.gradients.grids[level].buffers.numpy().sum(axis=0)


def huber(e: torch.Tensor, delta: float) -> torch.Tensor:
    return torch.where(e.abs() <= delta, e**2 / (2 * delta), e.abs() - delta / 2)


def terms(logit, color, s, rgb, t=TARGET) -> dict[str, torch.Tensor]:
    """The four sorts of terms, each summed (see `warpslam.kernels.supervision`)."""
    k, f, b, delta = t["slope"], t["front"], t["behind"], t["huber"]
    band = huber(logit - k * s, delta)
    free = huber((logit + k * f).clamp(min=0.0), delta)
    near = s.abs() <= t["color_reach"]
    return {
        "free": free[s < -f].sum(),
        "front": band[(s >= -f) & (s <= 0)].sum(),
        "behind": t["behind_weight"] * band[(s > 0) & (s <= b)].sum(),
        "color": t["color_weight"] * huber(color - rgb[:, None], t["color_huber"])[near].sum(),
    }


@pytest.mark.parametrize("seed", SEEDS)
def test_terms_and_their_derivatives(device, seed):
    """Loss and derivatives by logits and colours, as the kernels have them, are torch's for every sort of term."""
    run = Run(device, seed)
    loss = run.backward()
    shape = (run.count, SAMPLES)
    kept = run.rays.depth > 0
    logit = torch.tensor(run.batch.logit.numpy().reshape(shape)[kept], dtype=torch.float64, requires_grad=True)
    color = torch.tensor(run.batch.color.numpy().reshape(*shape, 3)[kept], dtype=torch.float64, requires_grad=True)
    s = torch.tensor(run.s[kept])
    parts = terms(logit, color, s, torch.tensor(run.rays.rgb[kept], dtype=torch.float64))
    assert all(part > 0 for part in parts.values())
    sum(parts.values()).backward()
    assert loss == pytest.approx(sum(parts.values()).item(), rel=1e-4)
    by_logit = run.batch.logit_grad.numpy().reshape(shape)
    np.testing.assert_allclose(by_logit[kept], logit.grad, atol=2e-3)
    assert not by_logit[~kept].any() and not by_logit[kept][(s > TARGET["behind"]).numpy()].any()
    by_color = run.batch.color_grad.numpy().reshape(*shape, 3)
    np.testing.assert_allclose(by_color[kept], color.grad, atol=2e-3)


@pytest.mark.parametrize("seed", SEEDS)
def test_gradients(device, seed):
    """Rows of all levels, weights of the colour decoder and both poses get the gradient that torch finds."""
    run = Run(device, seed)
    run.backward()
    poses, origins, directions = oracle_rays(run.rays, run.column, run.row, torch.float64)
    kept = torch.tensor(run.rays.depth > 0)
    z = torch.tensor(run.z.astype(np.float64))[kept]
    points = origins[kept][:, None] + z[..., None] * directions[kept][:, None]
    raw = oracle.field_values(run.field, points.reshape(-1, 3), "color").reshape(*z.shape, 4)
    rgb = torch.tensor(run.rays.rgb, dtype=torch.float64)[kept]
    sum(terms(raw[..., 3], raw[..., :3], torch.tensor(run.s)[kept], rgb).values()).backward()
    for level in LEVELS:
        check_rows(run.rows(level), run.field.grids[level].rows.grad, level)
    check_rows(run.poses.grad.numpy(), poses.grad, "poses")
    packed = run.arrays.decoders["color"]
    named = PackedDecoder(packed.unpack(), device)
    named.weights = wp.array(run.gradients.color_weights.numpy().sum(axis=0), dtype=Vec32, device=device)
    for name, weight in named.unpack().tensors.items():
        if not name.startswith("output"):
            expected = run.field.decoders["color"][name].grad
            check_rows(weight.reshape(len(weight), -1), expected.reshape(len(weight), -1), name)


@pytest.mark.parametrize("level", ["fine", "color"])
def test_rows_by_finite_differences(device, level):
    """The change of the loss when features change, without any other implementation of the field."""
    run = Run(device, 5, equal_middle=True)
    run.backward()
    features = run.arrays.features[level]
    check(features.numpy(), run.rows(level), features.assign, run.loss, step=0.02)


def test_poses_by_finite_differences(device):
    """The change of the loss when the cameras move, at fixed depths of the samples."""
    run = Run(device, 5, equal_middle=True)
    run.backward()
    gradient = run.poses.grad.numpy().copy()
    check(run.poses.numpy(), gradient, run.poses.assign, run.loss, step=5e-5)


def test_places_of_samples(device):
    """Strata before the band and in it, one at the depth, and two beside an outline; none without depth."""
    camera = Intrinsics(60.0, 60.0, 31.5, 23.5, 64, 48)
    depth = np.full((48, 64), 40000, np.uint16)
    depth[:, 32:] = 20000
    depth[:8] = 0
    batch = RayBatch(2000, SAMPLES, device)
    images = (
        wp.zeros((1, 48, 64, 3), dtype=wp.uint8, device=device),
        wp.array(depth[None], dtype=wp.uint16, device=device),
        wp.array([1e-4], dtype=float, device=device),
    )
    window = wp.zeros(1, dtype=int, device=device)
    batch.draw(images, window, 2000, camera)
    batch.keep.fill_(1)
    lengths = {"front": 0.1, "behind": 0.05, "radius": 5.0, "edge_front": 0.06, "edge_behind": 0.1}
    place_band(batch, struct(Band, free=4, edge=2, near=8, **lengths), images, window, camera)
    measured, keep = batch.measured_depth.numpy(), batch.keep.numpy() != 0
    assert np.array_equal(keep, measured > 0) and 0 < keep.sum() < 2000
    z = batch.z.numpy().reshape(2000, SAMPLES)[keep]
    measured = measured[keep][:, None]
    np.testing.assert_array_equal(z[:, -1:], measured)
    near = (z[:, 4:12] - measured + 0.1) / 0.15 * 8
    assert (np.floor(near + 1e-3) >= np.arange(8)).all() and (near <= np.arange(1, 9) + 1e-3).all()
    free = z[:, :4]
    assert (free >= 0.05 * measured - 1e-6).all() and (free <= measured - 0.1 + 1e-6).all()
    u = batch.direction_camera.numpy()[keep][:, 0] * 60 + 31.5
    beside = np.abs(free[:, :2] - 2.0) < 0.1
    is_far = measured[:, 0] > 3
    assert beside[is_far & (u > 29.5)].mean() > 0.3
    strata = 0.05 * measured + (measured - 0.1 - 0.05 * measured) / 4 * np.arange(3)
    assert (free[is_far & (u < 20)][:, :2] <= strata[is_far & (u < 20)][:, 1:] + 1e-4).all()


def listed(run: Run) -> tuple[dict[str, TouchedRows], dict[str, np.ndarray]]:
    """Optimisers after an adjoint, and the gradient of each level by row, spread out from the places."""
    optimizers, spread = {}, {}
    for level in LEVELS:
        grid = FeatureGrid(level, 0.3, 0.0, 0, run.device)
        grid.shape = tuple(int(n) for n in run.arrays.lattices[level].shape)
        optimizers[level] = TouchedRows(run.batch.launcher, grid, 8 * run.count * SAMPLES)
        run.gradients.grids[level] = optimizers[level].wanted()
    run.backward()
    for level, optimizer in optimizers.items():
        count = int(optimizer.touched.count.numpy()[0])
        rows = optimizer.touched.rows.numpy()[:count]
        assert len(set(rows)) == count > 0
        np.testing.assert_array_equal(optimizer.touched.place.numpy()[rows], np.arange(count))
        spread[level] = np.zeros((grid_rows(run, level), 32), np.float32)
        spread[level][rows] = optimizer._gradient.numpy().sum(axis=0)[:count]
    return optimizers, spread


def grid_rows(run: Run, level: str) -> int:
    return run.arrays.features[level].shape[0]


def test_gradients_of_listed_rows(device):
    """Listed once each, side by side, the rows have the same gradients as in buffers of all rows."""
    dense = Run(device, 1)
    dense.backward()
    _, spread = listed(Run(device, 1))
    for level in LEVELS:
        np.testing.assert_allclose(spread[level], dense.rows(level), rtol=1e-4, atol=1e-6)
        assert not spread[level].any(axis=1).all()


def test_adam_counts_the_steps_of_each_row(device):
    """Three updates of changing rows are torch's Adam, each row at its own step; others keep value and moments."""
    rng = np.random.default_rng(0)
    grid = FeatureGrid("fine", 1.0, 0.1, 0, device)
    grid.cover(np.zeros(3), np.full(3, 2.0))
    optimizer = TouchedRows(Launcher(device), grid, 64)
    rows = grid.row_count
    x = grid.features.numpy().astype(np.float64)
    first, second, steps = np.zeros_like(x), np.zeros_like(x), np.zeros(rows, int)
    for chosen in ([1, 4, 7], [4], [4, 9]):
        gradient = rng.normal(size=(optimizer._gradient.shape[0], len(chosen), 32)).astype(np.float32)
        optimizer.touched.count.assign([len(chosen)])
        optimizer.touched.rows[: len(chosen)].assign(np.array(chosen, np.int32))
        buffers = np.zeros((*optimizer._gradient.shape, 32), np.float32)
        buffers[:, : len(chosen)] = gradient
        optimizer._gradient.assign(buffers)
        optimizer.update(grid.features, 0.05)
        g = gradient.sum(axis=0)
        steps[chosen] += 1
        first[chosen] = 0.9 * first[chosen] + 0.1 * g
        second[chosen] = 0.99 * second[chosen] + 0.01 * g**2
        t = steps[chosen][:, None]
        x[chosen] -= 0.05 * (first[chosen] / (1 - 0.9**t)) / (np.sqrt(second[chosen] / (1 - 0.99**t)) + 1e-6)
        assert not optimizer._gradient.numpy().any() and (optimizer.touched.place.numpy() == -1).all()
    np.testing.assert_allclose(grid.features.numpy(), x, atol=2e-5)
    np.testing.assert_array_equal(optimizer.updates.numpy(), steps)
    np.testing.assert_array_equal(optimizer.changed_rows().numpy(), [1, 4, 7, 9])


def test_a_gradient_that_is_not_finite_is_left_out(device):
    """The row keeps its value, and it is told."""
    grid = FeatureGrid("fine", 1.0, 0.1, 0, device)
    grid.cover(np.zeros(3), np.full(3, 2.0))
    before = grid.features.numpy().copy()
    optimizer = TouchedRows(Launcher(device), grid, 64)
    optimizer.touched.count.assign([1])
    buffers = np.zeros((*optimizer._gradient.shape, 32), np.float32)
    buffers[0, 0, 3] = np.nan
    optimizer._gradient.assign(buffers)
    optimizer.update(grid.features, 0.05)
    np.testing.assert_array_equal(grid.features.numpy(), before)
    assert optimizer.has_rejected and not optimizer.updates.numpy().any()


def test_state_of_rows_grows_with_the_grid(device):
    """What was updated keeps moments and count where its vertex goes; and comes back from its state."""
    grid = FeatureGrid("fine", 1.0, 0.1, 0, device)
    grid.cover(np.zeros(3), np.full(3, 2.0))
    optimizer = TouchedRows(Launcher(device), grid, 64)
    updates = np.zeros((3, 3, 3), np.int32)
    updates[1, 2, 0], updates[2, 2, 2] = 5, 7
    moments = np.random.default_rng(0).normal(size=(27, 2, 32)).astype(np.float32)
    optimizer.updates.assign(updates.ravel())
    optimizer.moments.assign(moments)
    grid.cover(np.array([-1.0, 0.0, -2.0]), np.full(3, 3.0))
    optimizer.fit(grid)
    moved = optimizer.updates.numpy().reshape(grid.shape)
    assert moved[2, 2, 2] == 5 and moved[3, 2, 4] == 7 and moved.sum() == 12
    row = np.ravel_multi_index((2, 2, 2), grid.shape)
    np.testing.assert_array_equal(optimizer.moments.numpy()[row], moments[1 * 9 + 2 * 3 + 0])
    other = TouchedRows(Launcher(device), grid, 64)
    other.restore(optimizer.state())
    np.testing.assert_array_equal(other.updates.numpy(), optimizer.updates.numpy())
    np.testing.assert_array_equal(other.moments.numpy(), optimizer.moments.numpy())
