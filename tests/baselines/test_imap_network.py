"""The network of iMAP* and its compositing, value and gradient, against a small torch implementation."""

from __future__ import annotations

import numpy as np
import pytest
import warp as wp

from warpslam.baselines.imap_network import Bound, ImapBatch, ImapNetwork, Wanted, imap_shapes, unpack
from warpslam.field.arrays import gradient_buffers
from warpslam.field.objectives import choose_inliers, mapping_loss, tracking_loss
from warpslam.kernels import imap_network as imap
from warpslam.poses import vector_from_pose
from warpslam.runtime.launching import Launcher
from warpslam.synthetic import look_at

torch = pytest.importorskip("torch")

STRATIFIED, IMPORTANCE, EMPTY = 16, 8, 8
EMPTY_WEIGHT, COLOR_WEIGHT = 5e-4, 0.05
RAYS = 11


@pytest.fixture(params=["cpu", "cuda"])
def build(request, monkeypatch) -> str:
    """Both builds of the kernels, run on the CPU."""
    monkeypatch.setattr(imap, "CPU", {"cpu": imap.CPU, "cuda": imap.CUDA}[request.param])
    return request.param


class Case:
    """A few rays into a box of 0.6 network units, one of them without depth."""

    def __init__(self) -> None:
        rng = np.random.default_rng(4)
        self.launcher = Launcher(wp.get_device("cpu"))
        self.network = ImapNetwork.random(1, self.launcher)
        tensors = self.network.tensors()
        for name in tensors:
            if name.endswith("bias"):
                tensors[name] = rng.normal(0, 0.1, tensors[name].shape).astype(np.float32)
        # Densities that matter over distances of some hundredths.
        tensors["output_linear.weight"][3] *= 8.0
        self.network = ImapNetwork(tensors, self.launcher)
        self.bound = Bound(wp.vec3(-0.3, -0.3, -0.3), wp.vec3(0.3, 0.3, 0.3))
        self.batch = ImapBatch(RAYS + 2, STRATIFIED, IMPORTANCE, EMPTY, self.launcher)
        pose = vector_from_pose(look_at([0.1, -0.22, 0.05], [0.0, 0.1, 0.0])) * [1.3, 1.3, 1.3, 1.3, 1, 1, 1]
        self.poses = wp.array(pose[None].astype(np.float32), dtype=float, requires_grad=True)
        self.direction = np.column_stack([rng.uniform(-0.5, 0.5, (RAYS, 2)), np.ones(RAYS)]).astype(np.float32)
        self.depth = rng.uniform(0.2, 0.42, RAYS).astype(np.float32)
        self.depth[3] = 0.0
        self.rgb = rng.uniform(0, 1, (RAYS, 3)).astype(np.float32)
        batch = self.batch
        batch.count = RAYS
        batch.direction_camera[:RAYS].assign(self.direction)
        batch.measured_depth[:RAYS].assign(self.depth)
        batch.measured_rgb[:RAYS].assign(self.rgb)
        batch.set_seeds([5])

    def run(self, loss: str) -> dict[str, np.ndarray]:
        """Loss, images and all gradients from the kernels."""
        batch = self.batch
        gradient = gradient_buffers(imap.WEIGHT_ROWS, batch.device)
        with batch.launcher.tape() as tape:
            batch.cast(self.poses)
            batch.bound_to(self.bound.low, self.bound.high)
            # All rays take part, so that samples outside the bound are covered.
            batch.keep.fill_(1)
            batch.max_depth.fill_(float(self.depth.max()))
            weight = EMPTY_WEIGHT if loss == "mapping" else 0.0
            batch.evaluate(self.network, self.bound, Wanted(True, gradient), tape, empty_weight=weight)
            if loss == "mapping":
                mapping_loss(batch, COLOR_WEIGHT)
                batch.add_empty_loss(weight)
            else:
                choose_inliers(batch, 0.0)
                tracking_loss(batch, 0.5)
        tape.backward(batch.loss)
        result = {"loss": batch.loss.numpy()[0], "depth": batch.depth.numpy()[:RAYS], "rgb": batch.rgb.numpy()[:RAYS]}
        result["variance"] = batch.variance.numpy()[:RAYS]
        result["pose_grad"] = self.poses.grad.numpy()[0].copy()
        result["z"] = batch.z.numpy()[: RAYS * batch.sample_count].reshape(RAYS, -1)
        return result | {f"{name}_grad": array for name, array in unpack(gradient.numpy().sum(axis=0)).items()}

    def oracle(self, loss: str, z: np.ndarray) -> dict[str, np.ndarray]:
        """The same from torch in float64, on the samples ``z`` that the kernels placed."""
        t = {k: torch.tensor(v.astype(np.float64), requires_grad=True) for k, v in self.network.tensors().items()}
        pose = torch.tensor(self.poses.numpy()[0].astype(np.float64), requires_grad=True)
        w, x, y, zq = pose[:4]
        s = 2.0 / (pose[:4] ** 2).sum()
        R = torch.stack([
            1 - s * (y * y + zq * zq), s * (x * y - zq * w), s * (x * zq + y * w),
            s * (x * y + zq * w), 1 - s * (x * x + zq * zq), s * (y * zq - x * w),
            s * (x * zq - y * w), s * (y * zq + x * w), 1 - s * (x * x + y * y),
        ]).reshape(3, 3)  # fmt: skip
        directions = torch.tensor(self.direction.astype(np.float64)) @ R.T

        def field(depths):
            """Points, density and colour at depths along the rays."""
            points = pose[4:] + depths[..., None] * directions[:, None]
            h = torch.sin(points @ t["embedder._B"])
            for k in range(4):
                h = torch.relu(h @ t[f"pts_linears.{k}.weight"].T + t[f"pts_linears.{k}.bias"])
            raw = h @ t["output_linear.weight"].T + t["output_linear.bias"]
            return points, raw[..., 3], raw[..., :3]

        visible = STRATIFIED + IMPORTANCE
        depths = torch.sort(torch.tensor(z[:, :visible].astype(np.float64)), dim=1).values
        points, density, colors = field(depths)
        inside = (points.abs() < 0.3).all(dim=-1)
        density = torch.where(inside, density, torch.full_like(density, 100.0))
        delta = torch.cat([depths[:, 1:] - depths[:, :-1], torch.full((RAYS, 1), 1e10)], dim=1)
        norm = torch.linalg.norm(torch.tensor(self.direction.astype(np.float64)), dim=1)[:, None]
        alpha = 1 - torch.exp(-torch.relu(density) * delta * norm)
        passed = torch.cumprod(torch.cat([torch.ones(RAYS, 1), 1 - alpha + 1e-10], dim=1), dim=1)[:, :-1]
        weights = alpha * passed
        depth, rgb = (weights * depths).sum(1), (weights[..., None] * colors).sum(1)
        variance = (weights * (depths - depth[:, None]) ** 2).sum(1).detach()
        D, target = torch.tensor(self.depth.astype(np.float64)), torch.tensor(self.rgb.astype(np.float64))
        measured = D > 0
        if loss == "mapping":
            value = (D - depth).abs()[measured].sum() + COLOR_WEIGHT * (target - rgb).abs().sum()
            value = value + EMPTY_WEIGHT * field(torch.tensor(z[:, visible:].astype(np.float64)))[1].abs().sum()
        else:
            residual = (D - depth).abs() / torch.sqrt(variance + 1e-10)
            value = residual[measured].sum() + 0.5 * (target - rgb).abs()[measured].sum()
        value.backward()
        result = {"loss": value, "depth": depth, "rgb": rgb, "variance": variance, "pose_grad": pose.grad}
        result |= {f"{name}_grad": tensor.grad for name, tensor in t.items()}
        assert (~inside).any() and inside.float().mean() > 0.5 and (weights.max(dim=1).values < 0.9).any()
        return {name: tensor.detach().numpy() for name, tensor in result.items()}


@pytest.mark.parametrize("loss", ["mapping", "tracking"])
def test_values_and_gradients_agree_with_torch(build, loss):
    """Depth, colour, variance, loss, and its gradient by the pose, B and every weight, to a thousandth."""
    case = Case()
    found = case.run(loss)
    expected = case.oracle(loss, found["z"])
    for name, array in expected.items():
        scale = np.linalg.norm(array)
        assert scale > 1e-6, name
        assert np.linalg.norm(found[name] - array) < 1e-3 * scale, name


def reference_importance(z: np.ndarray, weights: np.ndarray, count: int) -> np.ndarray:
    """Inverse CDF sampling as NeRF has it, for one ray: 1e-5 on every weight, even steps, right-sided search."""
    bins = 0.5 * (z[1:] + z[:-1])
    pdf = (weights[1:-1] + 1e-5) / (weights[1:-1] + 1e-5).sum()
    cdf = np.concatenate([[0.0], np.cumsum(pdf)])
    u = np.linspace(0.0, 1.0, count)
    index = np.searchsorted(cdf, u, side="right")
    below, above = np.maximum(index - 1, 0), np.minimum(index, len(cdf) - 1)
    width = cdf[above] - cdf[below]
    return bins[below] + (u - cdf[below]) / np.where(width < 1e-5, 1.0, width) * (bins[above] - bins[below])


def test_importance_samples_follow_the_weights():
    """They are those of the inverse CDF over the stratified samples' weights, and the order sorts all of them."""
    case = Case()
    z = case.run("tracking")["z"].astype(np.float64)
    batch = case.batch
    stratified = z[:, :STRATIFIED]
    density = batch.density.numpy()[: z.size].reshape(z.shape)[:, :STRATIFIED].astype(np.float64)
    origin, direction = (a.numpy()[:RAYS].astype(np.float64) for a in (batch.origin, batch.direction))
    points = origin[:, None] + stratified[..., None] * direction[:, None]
    density = np.where((np.abs(points) < 0.3).all(axis=-1), density, 100.0)
    delta = np.concatenate([np.diff(stratified, axis=1), np.full((RAYS, 1), 1e10)], axis=1)
    alpha = 1 - np.exp(-np.maximum(density, 0) * delta * np.linalg.norm(direction, axis=1)[:, None])
    passed = np.cumprod(np.concatenate([np.ones((RAYS, 1)), 1 - alpha + 1e-10], axis=1), axis=1)[:, :-1]
    visible = STRATIFIED + IMPORTANCE
    for ray in range(RAYS):
        expected = reference_importance(stratified[ray], (alpha * passed)[ray], IMPORTANCE)
        np.testing.assert_allclose(z[ray, STRATIFIED:visible], expected, atol=2e-4 * stratified[ray].max())
    order = batch.order.numpy()[: z.size].reshape(z.shape)[:, :visible]
    sorted_z = batch.z.numpy()[order]
    assert (np.diff(sorted_z, axis=1) >= 0).all()
    assert (np.sort(order, axis=1) == np.arange(visible) + z.shape[1] * np.arange(RAYS)[:, None]).all()


def test_empty_samples_stay_in_front_of_the_surface():
    """One in each of the strata of [0, 0.85 D], and all at the camera where there is no depth."""
    case = Case()
    z = case.run("mapping")["z"][:, -EMPTY:]
    edges = 0.85 * case.depth[:, None] * np.arange(EMPTY + 1) / EMPTY
    assert (z >= edges[:, :-1] - 1e-6).all() and (z <= edges[:, 1:] + 1e-6).all()
    assert len(np.unique(np.round(z[0] / edges[0, 1] % 1, 4))) > EMPTY // 2


def test_rays_that_are_not_kept_have_no_part():
    """They render nothing and add nothing to the loss or its gradient."""
    case = Case()
    batch, gradient = case.batch, gradient_buffers(imap.WEIGHT_ROWS, wp.get_device("cpu"))
    with batch.launcher.tape() as tape:
        batch.cast(case.poses)
        batch.bound_to(case.bound.low, case.bound.high)
        batch.keep.zero_()
        batch.evaluate(case.network, case.bound, Wanted(True, gradient), tape, empty_weight=EMPTY_WEIGHT)
        mapping_loss(batch, COLOR_WEIGHT)
        batch.add_empty_loss(EMPTY_WEIGHT)
    tape.backward(batch.loss)
    assert batch.loss.numpy()[0] == 0 and not batch.depth.numpy()[:RAYS].any()
    assert not gradient.numpy().any() and not case.poses.grad.numpy().any()


def test_packing_keeps_every_weight():
    """What is packed comes back unchanged, with the architecture's shapes; random networks repeat by seed."""
    launcher = Launcher(wp.get_device("cpu"))
    tensors = ImapNetwork.random(3, launcher).tensors()
    assert {name: array.shape for name, array in tensors.items()} == imap_shapes()
    again = ImapNetwork(tensors, launcher).tensors()
    other = ImapNetwork.random(4, launcher).tensors()
    for name, array in tensors.items():
        np.testing.assert_array_equal(again[name], array, err_msg=name)
        assert name.endswith("bias") or not np.array_equal(other[name], array)
    assert tensors["embedder._B"].std() == pytest.approx(25.0, rel=0.15)
