"""The oracle against the numbers recorded from the authors' implementation, and against hand-worked cases."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from tests.reference import oracle
from tests.reference.golden import GoldenScene

DTYPES = (torch.float64, torch.float32)


@pytest.fixture(scope="module", autouse=True)
def _one_thread():
    """The arrays are small: more threads only cost time."""
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


@pytest.fixture
def scene(golden) -> GoldenScene:
    """The recorded scene."""
    return GoldenScene.load(golden)


def relative_error(value, expected) -> float:
    """||value - expected|| / ||expected||."""
    value = np.asarray(value.detach() if torch.is_tensor(value) else value, dtype=np.float64)
    expected = np.asarray(expected, dtype=np.float64)
    assert value.shape == expected.shape
    return float(np.linalg.norm(value - expected) / np.linalg.norm(expected))


def render_scene(scene: GoldenScene, stage: str, dtype: torch.dtype):
    """Field, pose and rendering of the recorded rays; the pose requires gradients."""
    field = scene.field(dtype)
    pose = torch.tensor(scene.pose, dtype=dtype, requires_grad=True)
    rays = oracle.rays_from_pose(
        pose, torch.tensor(scene.column), torch.tensor(scene.row), scene.fx, scene.fy, scene.cx, scene.cy
    )
    return field, pose, rays, oracle.render(field, *rays, torch.tensor(scene.depth, dtype=dtype), stage)


def test_golden_has_the_cases_that_matter(scene):
    """The recording has missing depth, points outside the box, rejected rays and a quaternion not of unit length."""
    assert (scene.depth == 0).sum() == 8
    assert (scene.renderings["color"].raw[..., 3] == 100).any()
    assert 0 < scene.tracking.keep.sum() < (scene.depth > 0).sum()
    assert abs(np.linalg.norm(scene.pose[:4]) - 1) > 1e-3


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_field_at_points(scene, dtype):
    """Interpolated features, embedding and the field of each stage agree with the authors'."""
    field = scene.field(dtype)
    points = torch.tensor(scene.points, dtype=dtype)
    for level, expected in scene.point_features.items():
        assert relative_error(oracle.lookup(field.grids[level], points), expected) < 1e-5
    assert relative_error(oracle.embed(points, field.decoders["middle"]["embedder._B"]), scene.point_embedding) < 1e-5
    inside = oracle.inside(points, field.lo, field.hi)
    assert 0 < inside.sum() < len(points)
    for stage in oracle.STAGES:
        value = oracle.query(field, points, stage)
        assert relative_error(value[inside], scene.point_values[stage][inside.numpy()]) < 1e-5
        assert (value[~inside, 3] == 100).all()
        assert (scene.point_values[stage][~inside.numpy(), 3] == 100).all()
        # Outside the box the colour keeps the value of the clamped lookup.
        np.testing.assert_allclose(value[:, :3].detach(), scene.point_values[stage][:, :3], atol=1e-4)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("stage", oracle.STAGES)
def test_rendering(scene, stage, dtype):
    """Rays, samples, weights, depth, variance and colour of the recorded pixels agree with the authors'."""
    _, _, (origins, directions), rendering = render_scene(scene, stage, dtype)
    expected = scene.renderings[stage]
    assert relative_error(origins, scene.origins) < 1e-6
    assert relative_error(directions, scene.directions) < 1e-6
    for name in ("z", "raw", "weights", "depth"):
        assert relative_error(getattr(rendering, name), getattr(expected, name)) < 1e-5, name
    assert relative_error(rendering.variance, expected.variance) < 1e-4
    if stage == "color":
        assert relative_error(rendering.rgb, expected.rgb) < 1e-5
    else:
        assert not rendering.rgb.any()


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("stage", oracle.STAGES)
def test_mapping_gradients(scene, stage, dtype):
    """Loss and gradients with respect to feature rows, colour decoder and pose agree; everything else gets none."""
    field, pose, _, rendering = render_scene(scene, stage, dtype)
    expected = scene.mapping[stage]
    depth, rgb = torch.tensor(scene.depth, dtype=dtype), torch.tensor(scene.rgb, dtype=dtype)
    loss = oracle.mapping_loss(rendering, depth, rgb, stage)
    loss.backward()
    assert loss.item() == pytest.approx(expected.loss, rel=1e-6)
    assert {level for level, grid in field.grids.items() if grid.rows.grad is not None} == set(expected.rows)
    for level, gradient in expected.rows.items():
        assert relative_error(field.grids[level].rows.grad, gradient) < 5e-5, level
    got = {name for name, weight in field.decoders["color"].items() if weight.grad is not None}
    assert got == set(expected.color_decoder)
    for name, gradient in expected.color_decoder.items():
        assert relative_error(field.decoders["color"][name].grad, gradient) < 5e-5, name
    if expected.pose is not None:
        assert relative_error(pose.grad, expected.pose) < 5e-5


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
def test_tracking(scene, dtype):
    """Residuals, dynamic filter, loss, pose gradient and the pose after one Adam step agree with the authors'."""
    _, pose, _, rendering = render_scene(scene, "color", dtype)
    expected = scene.tracking
    depth, rgb = torch.tensor(scene.depth, dtype=dtype), torch.tensor(scene.rgb, dtype=dtype)
    tracking = oracle.tracking_loss(rendering, depth, rgb)
    tracking.loss.backward()
    assert np.array_equal(tracking.keep, expected.keep)
    # Only kept rays: where one opaque sample takes all the weight, the variance that divides is rounding error.
    assert relative_error(tracking.residual[tracking.keep], expected.residual[expected.keep]) < 1e-3
    assert tracking.loss.item() == pytest.approx(expected.loss, rel=1e-4)
    assert relative_error(pose.grad, expected.gradient) < 5e-5
    zero = torch.zeros(7, dtype=dtype)
    after, _, _ = oracle.adam_step(pose.detach(), pose.grad, zero, zero, 1, expected.learning_rate)
    np.testing.assert_allclose(after, expected.pose_after_adam, atol=2e-7)


def test_converting_a_pose_commutes_with_adam(golden):
    """The converted pose is the same camera, and the converted step is Adam's for the converted gradient."""
    T_flip = np.diag([1.0, -1.0, -1.0])
    scene = GoldenScene.load(golden)
    raw = torch.tensor(golden["cam7"], dtype=torch.float64)
    R_gl = oracle.rotation_from_quaternion(raw[:4]).numpy()
    R_cv = oracle.rotation_from_quaternion(torch.tensor(scene.pose[:4], dtype=torch.float64)).numpy()
    np.testing.assert_allclose(R_cv, R_gl @ T_flip, atol=1e-12)
    step = scene.tracking.pose_after_adam - scene.pose
    np.testing.assert_allclose(step, -scene.tracking.learning_rate * np.sign(scene.tracking.gradient), atol=1e-7)


@pytest.mark.parametrize("dtype", DTYPES, ids=str)
@pytest.mark.parametrize("level", ("middle", "fine"))
def test_frustum_mask(scene, level, dtype):
    """The lattice vertices selected for optimisation are the authors', vertex for vertex."""
    mask = oracle.frustum_mask(
        torch.tensor(scene.lattices[level].positions, dtype=dtype),
        torch.tensor(scene.frustum_pose, dtype=dtype),
        torch.tensor(scene.depth_image, dtype=dtype),
        scene.fx,
        scene.fy,
        scene.cx,
        scene.cy,
    )
    assert np.array_equal(mask, scene.frustum[level])
    assert scene.frustum[level].sum() == {"middle": 537, "fine": 5323}[level]


def test_frustum_replaces_missing_depth():
    """A vertex behind a hole in the depth image counts as in front of the farthest surface that any vertex sees."""
    image = torch.full((40, 40), 2.0, dtype=torch.float64)
    image[:, 20:] = 0.0
    points = torch.tensor([[-0.5, 0, 2.4], [-0.5, 0, 2.6], [0.5, 0, 2.4], [0.5, 0, 2.6], [0, 0, -0.4]]).double()
    mask = oracle.frustum_mask(points, torch.eye(4).double(), image, 30.0, 30.0, 19.5, 19.5)
    assert mask.tolist() == [True, False, True, False, True]


def test_adam_step_is_torch_adam():
    """Five steps of the oracle's Adam equal those of torch.optim.Adam."""
    generator = torch.Generator().manual_seed(1)
    parameter = torch.randn(7, generator=generator, dtype=torch.float64)
    reference = parameter.clone().requires_grad_()
    optimizer = torch.optim.Adam([reference], lr=0.01)
    first = second = torch.zeros_like(parameter)
    for step in range(1, 6):
        gradient = torch.randn(7, generator=generator, dtype=torch.float64)
        reference.grad = gradient.clone()
        optimizer.step()
        parameter, first, second = oracle.adam_step(parameter, gradient, first, second, step, 0.01)
    torch.testing.assert_close(parameter, reference.detach())


def test_lookup_gradient_stops_at_the_border():
    """Beyond the outermost vertices the feature is constant, so a point gets no gradient along that axis."""
    rows = torch.arange(27, dtype=torch.float64)[:, None].expand(27, 32)
    grid = oracle.Grid(torch.zeros(3).double(), torch.ones(3).double(), (3, 3, 3), rows)
    points = torch.tensor([[0.25, 0.5, 1.75], [-0.5, 0.5, 2.5]], dtype=torch.float64, requires_grad=True)
    value = oracle.lookup(grid, points)[:, 0]
    value.sum().backward()
    assert value.tolist() == [9 * 0.25 + 3 * 0.5 + 1.75, 3 * 0.5 + 2.0]
    assert points.grad.tolist() == [[9.0, 3.0, 1.0], [0.0, 3.0, 0.0]]


def test_composite_by_hand():
    """Two half-opaque samples at 1 m and 3 m weigh 1/2 and 1/4."""
    raw = torch.tensor([[[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0]]], dtype=torch.float64)
    rendering = oracle.composite(raw, torch.tensor([[1.0, 3.0]], dtype=torch.float64))
    assert rendering.weights[0].tolist() == pytest.approx([0.5, 0.25])
    assert float(rendering.depth) == pytest.approx(1.25)
    assert float(rendering.variance) == pytest.approx(0.5 * 0.25**2 + 0.25 * 1.75**2)
    assert rendering.rgb[0].tolist() == pytest.approx([0.5, 0.25, 0.0])


def test_samples_of_rays_by_hand():
    """Near and far planes, surface samples and samples of a ray without depth, for two rays down a 10 m corridor."""
    lo, hi = torch.tensor([-5.0, -5.0, -5.0]).double(), torch.tensor([5.0, 5.0, 10.0]).double()
    origins = torch.zeros(2, 3, dtype=torch.float64)
    directions = torch.tensor([[0.0, 0.0, 1.0], [0.1, 0.0, 1.0]]).double()
    z = oracle.sample_depths(origins, directions, torch.tensor([2.0, 0.0]).double(), lo, hi)
    assert z.shape == (2, 48)
    assert z[0, 0] == pytest.approx(0.02) and z[0, -1] == pytest.approx(2.4)
    assert ((z[0] >= 1.9 - 1e-12) & (z[0] <= 2.1 + 1e-12)).sum() >= 16
    assert z[1, 0] == 0.0 and z[1, 1] == pytest.approx(0.001) and z[1, -1] == pytest.approx(2.4)
    assert (z.diff(dim=-1) >= 0).all()
    blind = oracle.sample_depths(origins, directions, None, lo, hi)
    assert blind.shape == (2, 32)
    assert blind[0, 0] == pytest.approx(0.01) and blind[0, -1] == pytest.approx(10.01)


def test_rays_ending_outside_are_filtered():
    """A surface measured beyond the box is dropped; a ray without depth stays."""
    lo, hi = -torch.ones(3).double(), torch.ones(3).double()
    origins = torch.zeros(3, 3, dtype=torch.float64)
    directions = torch.tensor([[0.1, 0.0, 1.0]]).double().expand(3, 3)
    depth = torch.tensor([0.9, 1.005, 0.0]).double()
    assert oracle.rays_ending_inside(origins, directions, depth, lo, hi).tolist() == [True, False, True]


def test_overlap_fraction():
    """A keyframe at the same pose sees every point; one that looks away sees none; one moved sideways sees some."""
    camera = dict(fx=50.0, fy=50.0, cx=49.5, cy=49.5)
    i, j = torch.tensor([30, 45, 49, 60]), torch.tensor([40, 45, 49, 70])
    pose = torch.tensor([1.0, 0, 0, 0, 0, 0, 0], dtype=torch.float64)
    rays = oracle.rays_from_pose(pose, i, j, **camera)
    depth = torch.full((4,), 2.0, dtype=torch.float64)

    def fraction(T):
        return float(oracle.overlap_fraction(*rays, depth, T, **camera, width=100, height=100))

    assert fraction(torch.eye(4).double()) == 1.0
    assert fraction(torch.diag(torch.tensor([-1.0, 1.0, -1.0, 1.0])).double()) == 0.0
    moved = torch.eye(4).double()
    moved[0, 3] = 1.0
    assert 0.0 < fraction(moved) < 1.0
