"""The torch implementation that the benchmark times: it must compute what it is compared with."""

import numpy as np
import pytest
import torch

from tests.kernels.random_scene import CENTER, FOCAL, oracle_rays, random_field, random_rays
from tests.reference import oracle
from tools.benchmarks.torch_slam import Level, TorchSlam
from warpslam.camera import Intrinsics
from warpslam.field.decoders import DecoderWeights


def torch_slam(field: oracle.Field, poses: np.ndarray) -> TorchSlam:
    """The same map, with two small random images."""
    levels, decoders = {}, {}
    for level in ("middle", "fine", "color"):
        grid = field.grids[level]
        features = grid.rows.detach().view(*grid.shape, 32).permute(3, 0, 1, 2)[None].contiguous()
        levels[level] = Level(features, grid.origin, grid.origin + grid.spacing * (torch.tensor(grid.shape) - 1))
        tensors = {name: weight.detach().numpy() for name, weight in field.decoders[level].items()}
        decoders[level] = DecoderWeights(level, 32, tensors)
    rng = np.random.default_rng(0)
    images = [(rng.integers(0, 255, (60, 60, 3)), rng.uniform(0.3, 1.0, (60, 60))) for _ in poses]
    bounds = (field.lo.numpy(), field.hi.numpy())
    return TorchSlam(levels, decoders, bounds, Intrinsics(FOCAL, FOCAL, CENTER, CENTER, 60, 60), images, poses)


@pytest.mark.parametrize("stage", ["middle", "fine", "color"])
def test_renderings_are_those_of_the_oracle(stage):
    """Depth, colour and variance of random rays through a random map."""
    field = random_field(0, dtype=torch.float32)
    rays, column, row = random_rays(0)
    _, origins, directions = oracle_rays(rays, column, row, torch.float32)
    origins, directions = origins.detach(), directions.detach()
    depth, rgb = torch.tensor(rays.depth, dtype=torch.float32), torch.tensor(rays.rgb, dtype=torch.float32)
    found, shown, variance, kept, _ = torch_slam(field, rays.poses)._render(stage, origins, directions, depth, rgb)
    keep = oracle.rays_ending_inside(origins, directions, depth, field.lo, field.hi)
    expected = oracle.render(field, origins[keep], directions[keep], depth[keep], stage)
    assert len(kept) == int(keep.sum()) > 20
    torch.testing.assert_close(found, expected.depth, rtol=1e-4, atol=1e-5)
    torch.testing.assert_close(variance, expected.variance, rtol=1e-3, atol=1e-5)
    if stage == "color":
        torch.testing.assert_close(shown, expected.rgb, rtol=1e-4, atol=1e-5)


def test_iterations_change_what_they_should():
    """A colour iteration moves selected vertices, the colour decoder and the free poses alone."""
    field = random_field(0, dtype=torch.float32)
    rays, _, _ = random_rays(0)
    slam = torch_slam(field, rays.poses)
    torch.manual_seed(0)
    masks = {level: np.arange(grid.rows.shape[0]) % 2 == 0 for level, grid in field.grids.items() if level != "coarse"}
    before = {level: slam.levels[level].features.clone() for level in masks}
    slam.start_mapping(masks, adjust=True)
    slam.map_once("color", 40)
    for level, mask in masks.items():
        moved = (slam.levels[level].features != before[level]).any(dim=1).flatten().numpy()
        assert moved[mask].any() and not moved[~mask].any()
    assert (slam.vectors.detach() != slam.poses).any()
    slam.start_tracking()
    assert np.isfinite([slam.track_once(40) for _ in range(3)]).all()
    assert (slam.vectors.detach() != slam.poses[:1]).any()
