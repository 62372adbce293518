"""Run-time use of decoders in miniature: features of one scene optimised on rendered depth and colour (Eq. 6-10).

Both the second training phase and the comparison of decoders run this: the schedule, learning rates and losses are
those of the mapper (middle, fine, then colour stage), so decoders are trained and judged on what they are for.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from tools.decoders.networks import OCCUPANCY_GAIN, SPACING, DecoderSet, Lattice, interpolate
from warpslam.field.decoders import FEATURE_SIZE

STAGES = ("middle", "fine", "color")
LEARNING_RATES = {
    "coarse": {"coarse": 0.001},
    "middle": {"middle": 0.1},
    "fine": {"middle": 0.005, "fine": 0.005},
    "color": {"middle": 0.005, "fine": 0.005, "color": 0.005},
}
INITIAL_SPREAD = {"coarse": 0.01, "middle": 0.01, "fine": 0.0001, "color": 0.01}
COLOR_WEIGHT = 0.2
STRATIFIED_COUNT, SURFACE_COUNT = 32, 16

Stencil = tuple[Tensor, Tensor]


def stage_of(iteration: int, iterations: int) -> str:
    """Stage of a mapping iteration: 40 % middle, 20 % fine, 40 % colour, boundaries inclusive as in the reference."""
    if iteration <= int(0.4 * iterations):
        return "middle"
    return "fine" if iteration <= int(0.6 * iterations) else "color"


def random_placement(rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray]:
    """Rotation (3, 3) and shift (3,) [m] of a room in the world.

    A yaw, and in half of the cases a free rotation on top: where a run starts from the identity pose, the axes of the
    world are those of the first camera. The shift of +-5 m keeps decoders from learning a place.
    """
    yaw = rng.uniform(-np.pi, np.pi)
    rotation = np.array([[np.cos(yaw), -np.sin(yaw), 0.0], [np.sin(yaw), np.cos(yaw), 0.0], [0.0, 0.0, 1.0]])
    if rng.random() < 0.5:
        q, r = np.linalg.qr(rng.normal(size=(3, 3)))
        q *= np.sign(np.diag(r))
        q[:, 0] *= np.linalg.det(q)
        rotation = q @ rotation
    return rotation, rng.uniform(-5.0, 5.0, 3)


@dataclass(frozen=True)
class Batch:
    """Some rays: sample positions (P, S, 3) [m], distances (P, S), stencils per level, true distance and colour."""

    points: Tensor
    z: Tensor
    stencils: dict[str, Stencil]
    distance: Tensor
    color: Tensor


class RayPool:
    """Rays of a few cameras of one placed room, sampled as the mapper samples them, on a table of touched vertices."""

    def __init__(
        self,
        room: dict[str, np.ndarray],
        cameras: np.ndarray,
        rng: np.random.Generator,
        device: str,
        *,
        scale: float = 1.0,
        coarse: bool = False,
    ) -> None:
        """Place the room at random and take all rays of the cameras (indices).

        `scale` multiplies the vertex spacings; with `coarse`, the coarse level and its samples are made instead of the
        others, which that level's stage does not need. That level has all vertices of the room: features that no ray
        reaches keep their initial noise, as in a map, and the decoder has to guess from those around.
        """
        rotation, shift = random_placement(rng)
        directions = room["directions"][cameras].reshape(-1, 3)
        origins = np.repeat(room["origins"][cameras], room["directions"].shape[1], axis=0)
        distance = room["distances"][cameras].reshape(-1)
        seen = distance > 0
        self.rotation, self.shift, self.device = rotation, shift, device
        self.origins = self._tensor(origins[seen] @ rotation.T + shift)
        self.directions = self._tensor(directions[seen] @ rotation.T)
        self.distance = self._tensor(distance[seen])
        self.color = self._tensor(room["ray_colors"][cameras].reshape(-1, 3)[seen])
        noise = torch.Generator().manual_seed(int(rng.integers(2**31)))
        if coarse:
            box = torch.stack([self._tensor(placed) for placed in _box_of(room["points"] @ rotation.T + shift)])
            exits = exit_distances(self.origins, self.directions, box)
            self.z = sample_unguided(exits, noise)
        else:
            self.z = sample_distances(self.distance, noise)
        self.points = self.origins[:, None] + self.directions[:, None] * self.z[..., None]
        self.lattices, self.touched, self.stencils = {}, {}, {}
        flat = self.points.reshape(-1, 3)
        covered = torch.cat([flat, box]) if coarse else flat
        for level in ("coarse",) if coarse else ("middle", "fine"):
            spacing = SPACING[level] * scale
            lattice = Lattice.covering(covered.amin(0, keepdim=True), covered.amax(0, keepdim=True), spacing)
            rows, weights = self._stencil(lattice, flat)
            self.lattices[level] = lattice
            if coarse:
                self.touched[level], compact = torch.arange(lattice.row_count, device=device), rows
            else:
                self.touched[level], compact = torch.unique(rows, return_inverse=True)
            self.stencils[level] = (compact.view(*self.z.shape, 8), weights.view(*self.z.shape, 8))

    def __len__(self) -> int:
        """Number of rays."""
        return len(self.distance)

    def batch(self, index: Tensor) -> Batch:
        """The rays with these indices."""
        stencils = {
            level: (rows[index].flatten(0, 1), weights[index].flatten(0, 1))
            for level, (rows, weights) in self.stencils.items()
        }
        return Batch(self.points[index], self.z[index], stencils, self.distance[index], self.color[index])

    def locate(self, points: Tensor) -> tuple[dict[str, Stencil], Tensor]:
        """Stencils of other world points (N, 3), and which of them (N,) lie among touched vertices alone."""
        stencils, known = {}, torch.ones(len(points), dtype=torch.bool, device=points.device)
        for level, lattice in self.lattices.items():
            rows, weights = self._stencil(lattice, points)
            compact = torch.searchsorted(self.touched[level], rows).clamp_max(len(self.touched[level]) - 1)
            known &= (self.touched[level][compact] == rows).all(dim=1)
            stencils[level] = (compact, weights)
        return stencils, known

    def initial_features(self, generator: torch.Generator) -> dict[str, Tensor]:
        """Feature tables as a fresh map has them."""
        count = {level: len(rows) for level, rows in self.touched.items()}
        if "fine" in count:
            count["color"] = count["fine"]
        return {
            level: (INITIAL_SPREAD[level] * torch.randn(rows, FEATURE_SIZE, generator=generator))
            .to(self.device)
            .requires_grad_()
            for level, rows in count.items()
        }

    def _tensor(self, array: np.ndarray) -> Tensor:
        return torch.as_tensor(np.ascontiguousarray(array, dtype=np.float32), device=self.device)

    def _stencil(self, lattice: Lattice, points: Tensor) -> Stencil:
        return lattice.stencil(points, torch.zeros(len(points), dtype=torch.long, device=points.device))


def sample_distances(distance: Tensor, generator: torch.Generator) -> Tensor:
    """Sorted sample distances (P, 48) [m], random in their strata: 32 up to 1.2 x the largest depth, 16 within 5 %."""
    first = 0.01 * distance[:, None]
    stratified = first + (1.2 * distance.max() - first) * _strata(len(distance), STRATIFIED_COUNT, generator).to(first)
    surface = distance[:, None] * (0.95 + 0.1 * _strata(len(distance), SURFACE_COUNT, generator).to(first))
    return torch.cat([stratified, surface], dim=1).sort(dim=1).values


def sample_unguided(exits: Tensor, generator: torch.Generator) -> Tensor:
    """Sample distances (P, 32) [m] of the coarse stage, not told the depth, up to where rays leave the map."""
    return 0.01 + exits[:, None] * _strata(len(exits), STRATIFIED_COUNT, generator).to(exits)


def exit_distances(origins: Tensor, directions: Tensor, box: Tensor) -> Tensor:
    """Distances (P,) [m] at which rays (P, 3) from inside a box (2, 3) leave it."""
    return ((box[:, None] - origins) / directions).amax(dim=0).amin(dim=1)


def _box_of(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return points.min(axis=0), points.max(axis=0)


def _strata(rays: int, count: int, generator: torch.Generator) -> Tensor:
    return (torch.arange(count) + torch.rand(rays, count, generator=generator)) / count


def query_occupancy(decoders: DecoderSet, stage: str, points: Tensor, features: dict, stencils: dict) -> Tensor:
    """Occupancy logits (N,) at world points (N, 3): coarse, or middle plus, from the fine stage on, fine (Eq. 1-4)."""
    if stage == "coarse":
        return decoders.coarse(points, interpolate(features["coarse"], stencils["coarse"]))
    middle = interpolate(features["middle"], stencils["middle"])
    logits = decoders.middle(points, middle)
    if stage == "middle":
        return logits
    return logits + decoders.residual(points, interpolate(features["fine"], stencils["fine"]), middle)


def ray_weights(logits: Tensor) -> Tensor:
    """Compositing weights (P, S) of logits (P, S) (Sec. 3.2)."""
    alpha = torch.sigmoid(OCCUPANCY_GAIN * logits)
    passed = torch.cumprod(1.0 - alpha + 1e-10, dim=1)
    return alpha * torch.cat([torch.ones_like(passed[:, :1]), passed[:, :-1]], dim=1)


def render(decoders: DecoderSet, stage: str, batch: Batch, features: dict) -> tuple[Tensor, Tensor | None]:
    """Distance (P,) [m] and, in the colour stage, colour (P, 3) of rays (Eq. 6)."""
    points = batch.points.flatten(0, 1)
    weights = ray_weights(query_occupancy(decoders, stage, points, features, batch.stencils).view(batch.z.shape))
    distance = (weights * batch.z).sum(dim=1)
    if stage != "color":
        return distance, None
    colors = decoders.color(points, interpolate(features["color"], batch.stencils["fine"])).view(*batch.z.shape, 3)
    return distance, (weights[..., None] * colors).sum(dim=1)


def mapping_loss(decoders: DecoderSet, stage: str, batch: Batch, features: dict) -> tuple[Tensor, Tensor]:
    """Mean loss per ray (Eq. 8-10) and its depth part [m]."""
    distance, color = render(decoders, stage, batch, features)
    depth_loss = (distance - batch.distance).abs().mean()
    if color is None:
        return depth_loss, depth_loss
    return depth_loss + COLOR_WEIGHT * (color - batch.color).abs().sum(dim=1).mean(), depth_loss


class FeatureOptimizer:
    """Adam on the feature tables with the stage's learning rates; a level without gradient stands still."""

    def __init__(self, features: dict[str, Tensor], factor: float = 1.0) -> None:
        """Optimise these tables, all learning rates times a factor (5 on the first frame of a run)."""
        self.features, self.factor = features, factor
        self.adam = torch.optim.Adam(
            [{"params": [table], "name": level, "lr": 0.0} for level, table in features.items()]
        )

    def step(self, stage: str) -> None:
        """One step, then forget the gradients."""
        for group in self.adam.param_groups:
            group["lr"] = self.factor * LEARNING_RATES[stage].get(group["name"], 0.0)
        self.adam.step()
        self.adam.zero_grad(set_to_none=True)
