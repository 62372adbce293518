"""Torch form of the decoders, lattices, and the point cloud encoder (paper Sec. 3.1, supplement A.5).

Features live on the vertices of world-aligned lattices (vertex k at k * spacing), as in the map at run time, and are
looked up trilinearly. A feature table has shape (rows, 32); the rows of a scene are ordered x slowest, z fastest.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from warpslam.field.decoders import BLOCK_COUNT, FEATURE_SIZE, LEVELS, SKIP_BLOCK, Decoders, DecoderWeights

SPACING = {"coarse": 2.0, "middle": 0.32, "fine": 0.16, "color": 0.16}
OCCUPANCY_GAIN = 10.0
"""Occupancy is sigmoid(10 * logit) at run time, so training applies the cross entropy to 10 * logit as well."""


class LevelDecoder(nn.Module):
    """One decoder; parameter names are those of the checkpoints."""

    def __init__(self, weights: DecoderWeights) -> None:
        """Start from NumPy weights of any hidden width."""
        super().__init__()
        self.level, self.hidden = weights.level, weights.hidden
        self.names = list(weights.tensors)
        self.values = nn.ParameterList([nn.Parameter(torch.tensor(a)) for a in weights.tensors.values()])

    def weights(self) -> DecoderWeights:
        """Copy of the present weights as NumPy arrays."""
        arrays = [value.detach().cpu().float().numpy().copy() for value in self.values]
        return DecoderWeights(self.level, self.hidden, dict(zip(self.names, arrays, strict=True)))

    def forward(self, points: Tensor, features: Tensor) -> Tensor:
        """Outputs at points [m], (N, 3), with features (N, 32 or 64) -> (N,) logits or (N, 3) colours."""
        t = dict(zip(self.names, self.values, strict=True))
        entry = features if self.level == "coarse" else torch.sin(points @ t["embedder._B"])
        h = entry
        for k in range(BLOCK_COUNT):
            if k == SKIP_BLOCK:
                h = torch.cat([entry, h], dim=1)
            h = F.relu(F.linear(h, t[f"pts_linears.{k}.weight"], t[f"pts_linears.{k}.bias"]))
            if self.level != "coarse":
                h = h + F.linear(features, t[f"fc_c.{k}.weight"], t[f"fc_c.{k}.bias"])
        out = F.linear(h, t["output_linear.weight"], t["output_linear.bias"])
        return out[:, :3] if self.level == "color" else out[:, 0]


class DecoderSet(nn.Module):
    """The four decoders."""

    def __init__(self, decoders: Decoders) -> None:
        """Start from NumPy weights."""
        super().__init__()
        self.coarse, self.middle, self.fine, self.color = (LevelDecoder(w) for w in decoders)

    def weights(self) -> Decoders:
        """Copy of the present weights."""
        return Decoders(*(getattr(self, level).weights() for level in LEVELS))

    def residual(self, points: Tensor, fine: Tensor, middle: Tensor) -> Tensor:
        """Fine decoder output (N,); the middle feature enters without gradient (Eq. 3)."""
        return self.fine(points, torch.cat([fine, middle.detach()], dim=1))


@dataclass(frozen=True)
class Lattice:
    """Vertex lattices of several scenes, all of one shape.

    Attributes:
        spacing: Distance between vertices [m].
        first: Index of the first vertex of each scene, (S, 3) int64.
        shape: Vertices along x, y, z.
    """

    spacing: float
    first: Tensor
    shape: tuple[int, int, int]

    @classmethod
    def covering(cls, lower: Tensor, upper: Tensor, spacing: float) -> Lattice:
        """Smallest lattices around the boxes lower, upper (S, 3) [m], with at least one cell along each axis."""
        first = torch.floor(lower / spacing).long()
        last = torch.maximum(torch.ceil(upper / spacing).long(), first + 1)
        x, y, z = (last - first + 1).amax(dim=0).tolist()
        return cls(spacing, first, (x, y, z))

    @property
    def row_count(self) -> int:
        """Rows of the feature table of all scenes."""
        x, y, z = self.shape
        return self.first.shape[0] * x * y * z

    def rows(self, index: Tensor, scene: Tensor) -> Tensor:
        """Row of the vertex with world index (..., 3), relative to nothing, of scene (...); outside is clamped."""
        limit = torch.tensor(self.shape, device=index.device) - 1
        x, y, z = torch.minimum((index - self.first[scene]).clamp_min(0), limit).unbind(-1)
        return ((scene * self.shape[0] + x) * self.shape[1] + y) * self.shape[2] + z

    def stencil(self, points: Tensor, scene: Tensor) -> tuple[Tensor, Tensor]:
        """Rows (N, 8) int64 and trilinear weights (N, 8) for points (N, 3) [m] of scenes (N,)."""
        u = points / self.spacing
        base = torch.floor(u).long()
        t = u - base
        rows, weights = [], []
        for corner in range(8):
            bits = torch.tensor([corner >> 2 & 1, corner >> 1 & 1, corner & 1], device=points.device)
            rows.append(self.rows(base + bits, scene))
            weights.append(torch.where(bits.bool(), t, 1.0 - t).prod(dim=1))
        return torch.stack(rows, dim=1), torch.stack(weights, dim=1)


def interpolate(features: Tensor, stencil: tuple[Tensor, Tensor]) -> Tensor:
    """Trilinear lookup: features (rows, 32), stencil of N points -> (N, 32)."""
    rows, weights = stencil
    return F.embedding_bag(rows, features, per_sample_weights=weights, mode="sum")


class PointEncoder(nn.Module):
    """Point cloud -> feature table: local PointNet with max pooling in cells, mean onto vertices, 3-D U-Net.

    A point belongs to its nearest vertex, and enters by its offset from it, so the encoder knows no absolute position.
    Its normal and colour enter, too: only the decoders are kept, and a crop alone can't tell the two sides of a wall.
    """

    def __init__(self, spacing: float, width: int = 32, depth: int = 2, scale: float = 1.0) -> None:
        """Build for one level.

        Args:
            spacing: Vertex distance of the level [m].
            width: Channels of the PointNet and of the first U-Net stage.
            depth: Number of halvings in the U-Net.
            scale: Factor on the features, so that the size the decoders see is one that run-time steps can reach.
        """
        super().__init__()
        self.spacing, self.scale = spacing, scale
        self.enter = nn.Linear(9, width)
        self.blocks = nn.ModuleList(
            nn.Sequential(nn.ReLU(), nn.Linear(2 * width, width), nn.ReLU(), nn.Linear(width, width)) for _ in range(3)
        )
        self.leave = nn.Linear(width, FEATURE_SIZE)
        self.unet = UNet(FEATURE_SIZE, depth)

    def forward(self, points: Tensor, normals: Tensor, colors: Tensor, scene: Tensor, lattice: Lattice) -> Tensor:
        """Surface points (N, 3) [m], normals, colours (N, 3), scene (N,) -> features (rows, 32)."""
        nearest = torch.round(points / self.spacing).long()
        rows = lattice.rows(nearest, scene)
        h = self.enter(torch.cat([points / self.spacing - nearest, normals, colors - 0.5], dim=1))
        for block in self.blocks:
            pooled = h.new_full((lattice.row_count, h.shape[1]), -torch.inf)
            pooled = pooled.scatter_reduce(0, rows[:, None].expand_as(h), h, "amax")
            h = h + block(torch.cat([h, pooled[rows]], dim=1))
        h = self.leave(h)
        sums = h.new_zeros(lattice.row_count, FEATURE_SIZE).index_add(0, rows, h)
        counts = h.new_zeros(lattice.row_count, 1).index_add(0, rows, torch.ones_like(h[:, :1]))
        grid = (sums / counts.clamp_min(1.0)).view(lattice.first.shape[0], *lattice.shape, FEATURE_SIZE)
        return self.scale * self.unet(grid.permute(0, 4, 1, 2, 3)).permute(0, 2, 3, 4, 1).reshape(-1, FEATURE_SIZE)


class UNet(nn.Module):
    """3-D U-Net for any grid size: (S, C, x, y, z) -> (S, C, x, y, z)."""

    def __init__(self, channels: int, depth: int) -> None:
        """Channels double at each of `depth` halvings, up to 64."""
        super().__init__()
        widths = [min(channels * 2**i, 64) for i in range(depth + 1)]
        self.down = nn.ModuleList(_convolutions(channels if i == 0 else widths[i - 1], w) for i, w in enumerate(widths))
        self.up = nn.ModuleList(_convolutions(widths[i + 1] + widths[i], widths[i]) for i in range(depth))
        self.leave = nn.Conv3d(widths[0], channels, 1)

    def forward(self, x: Tensor) -> Tensor:
        """Filter a grid."""
        skips = []
        for i, stage in enumerate(self.down):
            x = stage(x if i == 0 else F.avg_pool3d(x, 2, ceil_mode=True))
            skips.append(x)
        for i in reversed(range(len(self.up))):
            x = F.interpolate(x, size=skips[i].shape[2:], mode="nearest")
            x = self.up[i](torch.cat([skips[i], x], dim=1))
        return self.leave(x)


def _convolutions(channels_in: int, channels_out: int) -> nn.Sequential:
    return nn.Sequential(
        nn.Conv3d(channels_in, channels_out, 3, padding=1),
        nn.GroupNorm(8, channels_out),
        nn.ReLU(),
        nn.Conv3d(channels_out, channels_out, 3, padding=1),
        nn.GroupNorm(8, channels_out),
        nn.ReLU(),
    )
