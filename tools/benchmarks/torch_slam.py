"""One tracking or mapping iteration in plain torch, built as the original is: what the kernels are timed against.

Dense grids read by `grid_sample`, decoders of `nn.Linear`, autograd for everything, `torch.optim.Adam` on a copy of the
selected vertices that is written into the grid before every rendering, pixels drawn by `randint`. Formulas as in the
paper and the released code; the same rays, samples, grids and weights as the kernels would use.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpslam.camera import Intrinsics
from warpslam.field.decoders import BLOCK_COUNT, EMBEDDING_SIZE, FEATURE_SIZE, SKIP_BLOCK, DecoderWeights

RATES = {
    "middle": {"middle": 0.1},
    "fine": {"middle": 0.005, "fine": 0.005},
    "color": {"middle": 0.005, "fine": 0.005, "color": 0.005},
}
STRATIFIED, SURFACE = 32, 16


class Mlp(nn.Module):
    """One decoder with coordinates."""

    def __init__(self, weights: DecoderWeights) -> None:
        """Copy NumPy weights."""
        super().__init__()
        inputs = 2 * FEATURE_SIZE if weights.level == "fine" else FEATURE_SIZE
        width = weights.hidden
        self.B = nn.Parameter(torch.tensor(weights.tensors["embedder._B"]))
        sizes = [EMBEDDING_SIZE] + [width + (EMBEDDING_SIZE if k == SKIP_BLOCK else 0) for k in range(1, BLOCK_COUNT)]
        self.blocks = nn.ModuleList(nn.Linear(size, width) for size in sizes)
        self.features = nn.ModuleList(nn.Linear(inputs, width) for _ in range(BLOCK_COUNT))
        self.last = nn.Linear(width, 4 if weights.level == "color" else 1)
        named = {"output_linear": self.last}
        named |= {f"pts_linears.{k}": block for k, block in enumerate(self.blocks)}
        named |= {f"fc_c.{k}": layer for k, layer in enumerate(self.features)}
        for name, layer in named.items():
            layer.weight.data = torch.tensor(weights.tensors[f"{name}.weight"])
            layer.bias.data = torch.tensor(weights.tensors[f"{name}.bias"])

    def forward(self, points: Tensor, features: Tensor) -> Tensor:
        """Points (N, 3) and features (N, 32 or 64) -> (N, 1 or 4)."""
        embedded = torch.sin(points @ self.B)
        h = embedded
        for k, (block, layer) in enumerate(zip(self.blocks, self.features, strict=True)):
            if k == SKIP_BLOCK:
                h = torch.cat([embedded, h], dim=-1)
            h = F.relu(block(h)) + layer(features)
        return self.last(h)


@dataclass
class Level:
    """A grid as `grid_sample` wants it: features (1, 32, nx, ny, nz), first and last vertex (3,) [m]."""

    features: Tensor
    low: Tensor
    high: Tensor

    def look_up(self, points: Tensor) -> Tensor:
        """Features (N, 32) at points (N, 3)."""
        u = 2.0 * (points - self.low) / (self.high - self.low) - 1.0
        place = u[None, None, None, :, [2, 1, 0]]
        found = F.grid_sample(self.features, place, align_corners=True, padding_mode="border")
        return found[0, :, 0, 0].T


class TorchSlam:
    """State of one mapping or tracking problem, and its iterations."""

    def __init__(
        self,
        levels: dict[str, Level],
        decoders: dict[str, DecoderWeights],
        bounds: tuple[np.ndarray, np.ndarray],
        camera: Intrinsics,
        images: list[tuple[np.ndarray, np.ndarray]],
        poses: np.ndarray,
    ) -> None:
        """`images`: rgb uint8 (H, W, 3) and depth (H, W) [m] of each frame; `poses`: pose vectors (frames, 7)."""
        self.levels, self.camera = levels, camera
        self.decoders = {level: Mlp(weights) for level, weights in decoders.items() if level != "coarse"}
        self.low, self.high = (torch.tensor(corner, dtype=torch.float32) for corner in bounds)
        self.rgb = [torch.tensor(rgb, dtype=torch.float32) / 255.0 for rgb, _ in images]
        self.depth = [torch.tensor(depth, dtype=torch.float32) for _, depth in images]
        self.poses = torch.tensor(poses, dtype=torch.float32)

    def start_mapping(self, masks: dict[str, np.ndarray], *, adjust: bool = False) -> None:
        """Begin a mapping call: `masks` bool (rows,) by level; with `adjust`, poses but the first are optimised."""
        self.masks = {
            level: torch.tensor(mask).view(self.levels[level].features.shape[2:]) for level, mask in masks.items()
        }
        self.chosen = {
            level: nn.Parameter(self.levels[level].features[:, :, mask].clone()) for level, mask in self.masks.items()
        }
        self.vectors = nn.Parameter(self.poses.clone(), requires_grad=adjust)
        groups = [{"params": [table], "name": level, "lr": 0.0} for level, table in self.chosen.items()]
        groups.append({"params": list(self.decoders["color"].parameters()), "name": "decoder", "lr": 0.0})
        if adjust:
            groups.append({"params": [self.vectors], "name": "poses", "lr": 0.0})
        self.adam = torch.optim.Adam(groups)

    def map_once(self, stage: str, pixels: int, *, factor: float = 1.0) -> float:
        """One mapping iteration; returns the loss."""
        for level, mask in self.masks.items():
            features = self.levels[level].features.clone()
            features[:, :, mask] = self.chosen[level]
            self.levels[level].features = features
        rates = RATES[stage] | ({"decoder": 0.005, "poses": 1e-3} if stage == "color" else {})
        for group in self.adam.param_groups:
            group["lr"] = factor * rates.get(group["name"], 0.0)
        self.adam.zero_grad()
        per_frame = max(pixels // len(self.rgb), 1)
        parts = [self._rays(i, per_frame, self.vectors[i]) for i in range(len(self.rgb))]
        origins, directions, depth, rgb = (torch.cat(column) for column in zip(*parts, strict=True))
        found_depth, found_rgb, _, depth, rgb = self._render(stage, origins, directions, depth, rgb)
        known = depth > 0
        loss = (depth - found_depth).abs()[known].sum()
        if stage == "color":
            loss = loss + 0.2 * (rgb - found_rgb).abs().sum()
        loss.backward()
        self.adam.step()
        for level, mask in self.masks.items():
            features = self.levels[level].features.detach()
            features[:, :, mask] = self.chosen[level].detach()
            self.levels[level].features = features
        return float(loss.detach())

    def start_tracking(self) -> None:
        """Begin to track frame 0 of the images."""
        self.vectors = nn.Parameter(self.poses[:1].clone())
        self.adam = torch.optim.Adam([self.vectors], lr=1e-3)

    def track_once(self, pixels: int) -> float:
        """One tracking iteration; returns the loss."""
        self.adam.zero_grad()
        origins, directions, depth, rgb = self._rays(0, pixels, self.vectors[0])
        found_depth, found_rgb, variance, depth, rgb = self._render("color", origins, directions, depth, rgb)
        residual = (depth - found_depth).abs() / torch.sqrt(variance.detach() + 1e-10)
        kept = (residual < 10 * residual.median()) & (depth > 0)
        loss = residual[kept].sum() + 0.5 * (rgb - found_rgb).abs()[kept].sum()
        loss.backward()
        self.adam.step()
        return float(loss.detach())

    def _rays(self, frame: int, count: int, vector: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        camera = self.camera
        index = torch.randint(camera.width * camera.height, (count,))
        i, j = index % camera.width, index // camera.width
        across = torch.stack([(i - camera.cx) / camera.fx, (j - camera.cy) / camera.fy, torch.ones(count)], dim=-1)
        directions = across.float() @ _rotation(vector[:4]).T
        depth = self.depth[frame].reshape(-1)[index]
        return vector[4:].expand_as(directions), directions, depth, self.rgb[frame].reshape(-1, 3)[index]

    def _render(self, stage: str, origins: Tensor, directions: Tensor, depth: Tensor, rgb: Tensor) -> tuple:
        with torch.no_grad():
            t = torch.stack([(self.low - origins) / directions, (self.high - origins) / directions])
            leave = t.amax(dim=0).amin(dim=-1)
            kept = leave >= depth
        origins, directions, depth, rgb = origins[kept], directions[kept], depth[kept], rgb[kept]
        with torch.no_grad():
            far = torch.minimum((leave[kept] + 0.01).clamp(min=0), 1.2 * depth.max())[:, None]
            s = torch.linspace(0, 1, STRATIFIED)
            stratified = 0.01 * depth[:, None] * (1 - s) + far * s
            s = torch.linspace(0, 1, SURFACE)
            near = depth[:, None] * (0.95 + 0.1 * s)
            unknown = 0.001 * (1 - s) + depth.max() * s
            near = torch.where(depth[:, None] > 0, near, unknown)
            z = torch.cat([stratified, near], dim=-1).sort(dim=-1).values
        points = (origins[:, None] + directions[:, None] * z[..., None]).reshape(-1, 3)
        logits, colors = self._field(stage, points)
        alpha = torch.sigmoid(10 * logits).view(z.shape)
        passed = torch.cumprod(torch.cat([torch.ones_like(alpha[:, :1]), 1 - alpha + 1e-10], dim=-1), dim=-1)[:, :-1]
        weights = alpha * passed
        found = (weights * z).sum(dim=-1)
        variance = (weights * (z - found[:, None]) ** 2).sum(dim=-1)
        shown = (weights[..., None] * colors.view(*z.shape, 3)).sum(dim=1) if colors is not None else rgb
        return found, shown, variance, depth, rgb

    def _field(self, stage: str, points: Tensor) -> tuple[Tensor, Tensor | None]:
        middle = self.levels["middle"].look_up(points)
        logits = self.decoders["middle"](points, middle)[:, 0]
        colors = None
        if stage != "middle":
            both = torch.cat([self.levels["fine"].look_up(points), middle.detach()], dim=-1)
            logits = logits + self.decoders["fine"](points, both)[:, 0]
        if stage == "color":
            colors = self.decoders["color"](points, self.levels["color"].look_up(points))[:, :3]
        inside = ((points > self.low) & (points < self.high)).all(dim=-1)
        return torch.where(inside, logits, torch.full_like(logits, 100.0)), colors


def _rotation(q: Tensor) -> Tensor:
    w, x, y, z = q
    s = 2.0 / (q * q).sum()
    rows = [
        torch.stack([1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)]),
        torch.stack([s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)]),
        torch.stack([s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)]),
    ]
    return torch.stack(rows)
