"""The paper's field, renderer, losses and masks in plain torch: what the kernels are compared with.

Every function is a direct transcription of one formula, differentiable by autograd, in the dtype of its inputs (float32
or float64). Nothing here is fast. Nothing here is shared with the package, so an error can't hide in both.

Conventions: lengths in metres; camera axes x right, y down, z forward; a pose is the 7-vector (qw, qx, qy, qz, tx, ty,
tz) of ``T_world_camera`` whose quaternion need not have unit length; the ray parameter is z-depth. The feature row of
lattice vertex (ix, iy, iz) is ``(ix * ny + iy) * nz + iz``. Decoder weights are named as in the authors' checkpoints.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import torch
import torch.nn.functional as F
from torch import Tensor

LEVELS = ("coarse", "middle", "fine", "color")
STAGES = LEVELS
BLOCK_COUNT = 5
SKIP_AFTER = 2
STRATIFIED_COUNT = 32
SURFACE_COUNT = 16
OUTSIDE_LOGIT = 100.0


@dataclass
class Grid:
    """One level of features on a regular lattice.

    ``origin``, ``spacing``: (3,) [m]; ``shape``: vertex counts (nx, ny, nz); ``rows``: features, (nx * ny * nz, 32).
    """

    origin: Tensor
    spacing: Tensor
    shape: tuple[int, int, int]
    rows: Tensor


@dataclass
class Field:
    """The map: scene box ``lo``, ``hi`` (3,) [m], a `Grid` per level, and a dict of named weights per level."""

    lo: Tensor
    hi: Tensor
    grids: dict[str, Grid]
    decoders: dict[str, dict[str, Tensor]]

    def to(self, dtype: torch.dtype) -> Field:
        """Detached copy in ``dtype``."""

        def cast(tensor: Tensor) -> Tensor:
            return tensor.detach().to(dtype).clone()

        grids = {k: Grid(cast(g.origin), cast(g.spacing), g.shape, cast(g.rows)) for k, g in self.grids.items()}
        decoders = {k: {name: cast(w) for name, w in d.items()} for k, d in self.decoders.items()}
        return Field(cast(self.lo), cast(self.hi), grids, decoders)


@dataclass
class Rendering:
    """Result of `render` for N rays with S samples.

    ``depth``, ``variance`` (N,) [m, m^2]; ``rgb`` (N, 3); ``z`` [m], ``weights``, ``alpha`` (N, S); ``raw`` (N, S, 4):
    red, green, blue and occupancy logit.
    """

    depth: Tensor
    variance: Tensor
    rgb: Tensor
    z: Tensor
    weights: Tensor
    alpha: Tensor
    raw: Tensor


# ---- poses and rays


def rotation_from_quaternion(q: Tensor) -> Tensor:
    """Rotation matrix (3, 3) of ``q`` = (w, x, y, z) of any length; the gradient includes that of 2 / |q|^2."""
    w, x, y, z = q
    s = 2.0 / (q * q).sum()
    return torch.stack(
        [
            torch.stack([1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)]),
            torch.stack([s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)]),
            torch.stack([s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)]),
        ]
    )


def rays_from_pose(
    pose: Tensor, i: Tensor, j: Tensor, fx: float, fy: float, cx: float, cy: float
) -> tuple[Tensor, Tensor]:
    """Origins and directions (N, 3) of pixels in column ``i``, row ``j``. Directions are not normalised: z_camera is 1.

    In OpenGL axes (y up, z backwards) the same ray has camera direction ((i-cx)/fx, -(j-cy)/fy, -1). Second and third
    axis are negated there, and so are columns 1 and 2 of the rotation (`golden.opencv_pose`): the ray is the same.
    """
    i, j = i.to(pose.dtype), j.to(pose.dtype)
    dir_camera = torch.stack([(i - cx) / fx, (j - cy) / fy, torch.ones_like(i)], dim=-1)
    R = rotation_from_quaternion(pose[:4])
    directions = dir_camera @ R.T
    return pose[4:].expand_as(directions), directions


def exit_distance(origins: Tensor, directions: Tensor, lo: Tensor, hi: Tensor) -> Tensor:
    """Ray parameter (N,) at which each ray leaves the scene box."""
    t = torch.stack([(lo - origins) / directions, (hi - origins) / directions])
    return t.amax(dim=0).amin(dim=-1)


def rays_ending_inside(origins: Tensor, directions: Tensor, depth: Tensor, lo: Tensor, hi: Tensor) -> Tensor:
    """Pre-filter of tracker and mapper: True where the measured surface lies in the box (always, for depth 0)."""
    return exit_distance(origins, directions, lo, hi) >= depth


def sample_depths(origins: Tensor, directions: Tensor, depth: Tensor | None, lo: Tensor, hi: Tensor) -> Tensor:
    """Sorted sample positions z (N, 48), or (N, 32) without sensor depth. No gradient flows through them.

    The far plane depends on the largest depth of the batch, so the samples of a ray depend on its batch mates.
    """
    origins, directions = origins.detach(), directions.detach()
    dtype = origins.dtype
    s = torch.linspace(0, 1, STRATIFIED_COUNT, dtype=dtype)
    far = exit_distance(origins, directions, lo, hi)[:, None] + 0.01
    if depth is None:
        near = torch.full_like(far, 0.01)
        return near * (1 - s) + far * s
    depth = depth.detach().to(dtype)[:, None]
    depth_max = depth.max()
    near = 0.01 * depth
    far = torch.minimum(far.clamp(min=0), 1.2 * depth_max)
    stratified = near * (1 - s) + far * s
    s = torch.linspace(0, 1, SURFACE_COUNT, dtype=dtype)
    near_surface = 0.95 * depth * (1 - s) + 1.05 * depth * s
    unknown_surface = (0.001 * (1 - s) + depth_max * s).expand_as(near_surface)
    surface = torch.where(depth > 0, near_surface, unknown_surface)
    return torch.cat([stratified, surface], dim=-1).sort(dim=-1).values


# ---- the field


def lookup(grid: Grid, points: Tensor) -> Tensor:
    """Trilinear interpolation of features (N, 32) at ``points`` (N, 3), clamped to the lattice.

    The gradient with respect to a clamped coordinate (on or beyond the outermost vertices) is zero.
    """
    last = torch.tensor(grid.shape, dtype=points.dtype) - 1
    u = (points - grid.origin) / grid.spacing
    u = torch.where((u > 0) & (u < last), u, u.detach().clamp(min=torch.zeros_like(last), max=last))
    cell = torch.minimum(u.detach().floor(), last - 1).clamp(min=0)
    t = u - cell
    cell = cell.long()
    nx, ny, nz = grid.shape
    out = torch.zeros(len(points), grid.rows.shape[1], dtype=grid.rows.dtype)
    for dx in (0, 1):
        for dy in (0, 1):
            for dz in (0, 1):
                weight = 1.0
                for axis, corner in enumerate((dx, dy, dz)):
                    weight = weight * (t[:, axis] if corner else 1 - t[:, axis])
                ix = (cell[:, 0] + dx).clamp(max=nx - 1)
                iy = (cell[:, 1] + dy).clamp(max=ny - 1)
                iz = (cell[:, 2] + dz).clamp(max=nz - 1)
                out = out + weight[:, None] * grid.rows[(ix * ny + iy) * nz + iz]
    return out


def embed(points: Tensor, B: Tensor) -> Tensor:
    """Fourier features sin(p B), (N, 93); sine only, world coordinates in metres, not normalised."""
    return torch.sin(points @ B)


def decode(weights: dict[str, Tensor], points: Tensor, features: Tensor) -> Tensor:
    """Decoder output (N, out). Weights that hold an embedding belong to middle, fine or color, others to coarse."""
    has_embedding = "embedder._B" in weights
    first = embed(points, weights["embedder._B"]) if has_embedding else features
    h = first
    for k in range(BLOCK_COUNT):
        h = F.relu(F.linear(h, weights[f"pts_linears.{k}.weight"], weights[f"pts_linears.{k}.bias"]))
        if has_embedding:
            h = h + F.linear(features, weights[f"fc_c.{k}.weight"], weights[f"fc_c.{k}.bias"])
        if k == SKIP_AFTER:
            h = torch.cat([first, h], dim=-1)
    return F.linear(h, weights["output_linear.weight"], weights["output_linear.bias"])


def inside(points: Tensor, lo: Tensor, hi: Tensor) -> Tensor:
    """True (N,) where a point lies strictly inside the scene box."""
    return ((points > lo) & (points < hi)).all(dim=-1)


def field_values(field_: Field, points: Tensor, stage: str) -> Tensor:
    """Red, green, blue and occupancy logit (N, 4) of ``stage`` at ``points`` (N, 3), without the inside test.

    The middle feature that enters the fine decoder is a constant: no gradient to its rows, none to the point.
    """

    def features(level: str) -> Tensor:
        return lookup(field_.grids[level], points)

    if stage == "coarse":
        logit = decode(field_.decoders["coarse"], points, features("coarse"))
    else:
        middle = features("middle")
        logit = decode(field_.decoders["middle"], points, middle)
        if stage != "middle":
            both = torch.cat([features("fine"), middle.detach()], dim=-1)
            logit = logit + decode(field_.decoders["fine"], points, both)
    if stage == "color":
        rgb = decode(field_.decoders["color"], points, features("color"))[:, :3]
    else:
        rgb = torch.zeros(len(points), 3, dtype=points.dtype)
    return torch.cat([rgb, logit], dim=-1)


def query(field_: Field, points: Tensor, stage: str) -> Tensor:
    """`field_values` with the logit of points outside the scene box replaced by 100 (opaque)."""
    raw = field_values(field_, points, stage)
    logit = torch.where(inside(points, field_.lo, field_.hi), raw[:, 3], torch.full_like(raw[:, 3], OUTSIDE_LOGIT))
    return torch.cat([raw[:, :3], logit[:, None]], dim=-1)


# ---- rendering and losses


def composite(raw: Tensor, z: Tensor) -> Rendering:
    """Depth, variance and colour (Eq. 6-7) of rays with sample values ``raw`` (N, S, 4) at ``z`` (N, S)."""
    alpha = torch.sigmoid(10 * raw[..., 3])
    passed = torch.cumprod(1 - alpha + 1e-10, dim=-1)
    transmittance = torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=-1)
    weights = alpha * transmittance
    depth = (weights * z).sum(dim=-1)
    variance = (weights * (z - depth[:, None]) ** 2).sum(dim=-1)
    rgb = (weights[..., None] * raw[..., :3]).sum(dim=-2)
    return Rendering(depth, variance, rgb, z, weights, alpha, raw)


def render(field_: Field, origins: Tensor, directions: Tensor, depth: Tensor | None, stage: str) -> Rendering:
    """Render rays (N, 3); sensor ``depth`` (N,) guides the samples, except in the coarse stage, which never uses it."""
    z = sample_depths(origins, directions, None if stage == "coarse" else depth, field_.lo, field_.hi)
    points = origins[:, None] + z[..., None] * directions[:, None]
    raw = query(field_, points.reshape(-1, 3), stage).reshape(*z.shape, 4)
    return composite(raw, z)


def mapping_loss(rendering: Rendering, depth: Tensor, rgb: Tensor, stage: str, color_weight: float = 0.2) -> Tensor:
    """Eq. 8-10 as sums: |D - D^| over rays with depth, plus, in the color stage, |I - I^| over all rays."""
    loss = (depth - rendering.depth).abs()[depth > 0].sum()
    if stage == "color":
        loss = loss + color_weight * (rgb - rendering.rgb).abs().sum()
    return loss


@dataclass
class TrackingLoss:
    """``loss`` (), per-ray ``residual`` (N,) and ``keep`` (N,) bool: the rays that count."""

    loss: Tensor
    residual: Tensor
    keep: Tensor = field(repr=False)


def tracking_loss(
    rendering: Rendering,
    depth: Tensor,
    rgb: Tensor,
    color_weight: float = 0.5,
    filter_factor: float = 10.0,
    median_over_valid: bool = False,
    filter_by_loss: bool = False,
) -> TrackingLoss:
    """Eq. 11-12 as sums, with the variance held constant.

    The authors' filter goes by the depth residual; ``filter_by_loss`` has it go by the ray's whole loss (Sec. 3.3).

    The authors take the (lower) median over all rays, also those without depth; ``median_over_valid`` leaves these out.
    A ``filter_factor`` of 0 keeps every ray with depth.
    """
    residual = (depth - rendering.depth).abs() / torch.sqrt(rendering.variance.detach() + 1e-10)
    valid = depth > 0
    keep = valid
    if filter_factor > 0:
        value = residual.detach()
        if filter_by_loss:
            value = value + color_weight * (rgb - rendering.rgb).abs().sum(dim=1).detach()
        judged = value[valid] if median_over_valid else value
        keep = valid & (value < filter_factor * judged.median())
    loss = residual[keep].sum() + color_weight * (rgb - rendering.rgb).abs()[keep].sum()
    return TrackingLoss(loss, residual, keep)


def adam_step(
    parameter: Tensor,
    gradient: Tensor,
    first: Tensor,
    second: Tensor,
    step: int,
    rate: float | Tensor,
    beta1: float = 0.9,
    beta2: float = 0.999,
    epsilon: float = 1e-8,
) -> tuple[Tensor, Tensor, Tensor]:
    """Adam update number ``step`` (from 1): new parameter, first and second moment."""
    first = beta1 * first + (1 - beta1) * gradient
    second = beta2 * second + (1 - beta2) * gradient**2
    first_hat, second_hat = first / (1 - beta1**step), second / (1 - beta2**step)
    return parameter - rate * first_hat / (second_hat.sqrt() + epsilon), first, second


# ---- what a camera can see


def project(
    points: Tensor, T_world_camera: Tensor, fx: float, fy: float, cx: float, cy: float, epsilon: float = 1e-5
) -> tuple[Tensor, Tensor, Tensor]:
    """Column u, row v [px] and depth [m] of world ``points`` (N, 3); the authors take ``epsilon`` off the depth."""
    R, t = T_world_camera[:3, :3], T_world_camera[:3, 3]
    x, y, z = ((points - t) @ R).unbind(dim=-1)
    depth = z - epsilon
    return (fx * x + cx * z) / depth, (fy * y + cy * z) / depth, depth


def bilinear(image: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Value of ``image`` (H, W) at columns ``u``, rows ``v`` (N,); pixels outside the image count as 0."""
    height, width = image.shape
    u0, v0 = u.floor(), v.floor()
    out = torch.zeros_like(u)
    for du in (0, 1):
        for dv in (0, 1):
            column, row = u0 + du, v0 + dv
            weight = (1 - (u - column).abs()) * (1 - (v - row).abs())
            known = (column >= 0) & (column < width) & (row >= 0) & (row < height)
            value = image[row.clamp(0, height - 1).long(), column.clamp(0, width - 1).long()]
            out = out + torch.where(known, weight * value, torch.zeros_like(out))
    return out


def frustum_mask(
    points: Tensor, T_world_camera: Tensor, depth_image: Tensor, fx: float, fy: float, cx: float, cy: float
) -> Tensor:
    """True (N,) for lattice vertices that may change.

    These are the ones in view and at most 0.5 m behind the surface, and all within 0.5 m of the camera.
    Where the depth image says 0 the largest depth looked up by any vertex counts.
    """
    height, width = depth_image.shape
    u, v, depth = project(points, T_world_camera, fx, fy, cx, cy)
    surface = bilinear(depth_image, u, v)
    surface = torch.where(surface == 0, surface.max(), surface)
    visible = (u > 0) & (u < width) & (v > 0) & (v < height) & (depth >= 0) & (depth <= surface + 0.5)
    near = (points - T_world_camera[:3, 3]).norm(dim=-1) < 0.5
    return visible | near


def overlap_fraction(
    origins: Tensor,
    directions: Tensor,
    depth: Tensor,
    T_world_keyframe: Tensor,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    width: int,
    height: int,
    border: int = 20,
    point_count: int = 16,
) -> Tensor:
    """Share () of points on the current frame's rays, z from 0.8 D to D + 0.5 m, that project into a keyframe's image.

    Points within ``border`` pixels of the edge of the ``width`` x ``height`` image do not count.
    """
    s = torch.linspace(0, 1, point_count, dtype=origins.dtype)
    z = 0.8 * depth[:, None] * (1 - s) + (depth[:, None] + 0.5) * s
    points = (origins[:, None] + z[..., None] * directions[:, None]).reshape(-1, 3)
    u, v, depth_keyframe = project(points, T_world_keyframe, fx, fy, cx, cy)
    seen = (u > border) & (u < width - border) & (v > border) & (v < height - border) & (depth_keyframe > 0)
    return seen.to(origins.dtype).mean()
