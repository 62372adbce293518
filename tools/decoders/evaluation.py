"""Comparison of decoders: how fast features from scratch explain a held-out room when the decoders are frozen."""

from __future__ import annotations

import numpy as np
import torch

from tools.decoders.mapping import FeatureOptimizer, RayPool, mapping_loss, query_occupancy, render, stage_of
from tools.decoders.networks import OCCUPANCY_GAIN, DecoderSet
from warpslam.field.decoders import Decoders

CAMERA_COUNT = 3
TEST_RAY_COUNT = 300


def fit_room(
    weights: Decoders,
    room: dict[str, np.ndarray],
    iterations: int,
    seed: int,
    *,
    rays: int = 200,
    factor: float = 1.0,
    scale: float = 1.0,
    start: torch.Tensor | None = None,
    device: str = "cpu",
) -> dict[str, float]:
    """Map one room from scratch, three views, and measure on rays and points that were not trained on.

    The colour decoder is trained along in the colour stage, as in a run; the others are frozen. `factor` multiplies all
    learning rates (5 on the first frame of a run), `scale` all vertex spacings; `start` (32,) is added to the initial
    middle features.

    Returns:
        depth_l1_cm: Mean error of the rendered distance [cm].
        bce, iou: Cross entropy [nats] and intersection over union of occupancy at points within 10 cm of the surface.
        free: Share of points in seen free space (more than 10 cm in front of the surface) that are below 0.5.
        color_l1: Mean absolute error of a rendered colour channel, in [0, 1] units.
        residual_rms: Root mean square of the fine decoder's logit where its feature is zero, middle feature as fitted.
    """
    fit = fit_features(
        weights, room, iterations, seed, rays=rays, factor=factor, scale=scale, start=start, device=device
    )
    with torch.no_grad():
        return _measure(*fit, room)


def free_space_feature(weights: Decoders, rooms: list[dict[str, np.ndarray]], iterations: int = 60) -> torch.Tensor:
    """Mean middle feature (32,) of vertices that only samples in front of a surface (by more than 0.3 m) touch."""
    found = []
    for i, room in enumerate(rooms):
        _, pool, features, _ = fit_features(weights, room, iterations, i)
        rows, weight = pool.stencils["middle"]
        solid = ((pool.z > pool.distance[:, None] - 0.3)[..., None] & (weight > 0)).expand_as(rows)
        free = torch.ones(len(features["middle"]), dtype=torch.bool)
        free[rows[solid]] = False
        found.append(features["middle"].detach()[free])
    return torch.cat(found).mean(dim=0)


def fit_features(
    weights: Decoders,
    room: dict[str, np.ndarray],
    iterations: int,
    seed: int = 0,
    *,
    rays: int = 200,
    factor: float = 1.0,
    scale: float = 1.0,
    start: torch.Tensor | None = None,
    device: str = "cpu",
) -> tuple[DecoderSet, RayPool, dict[str, torch.Tensor], torch.Tensor]:
    """Decoders, rays, fitted features, and the indices of rays kept for the test."""
    rng = np.random.default_rng([seed, 5])
    generator = torch.Generator().manual_seed(seed)
    decoders = DecoderSet(weights).to(device)
    for parameter in decoders.parameters():
        parameter.requires_grad_(False)
    color_parameters = list(decoders.color.parameters())
    pool = RayPool(room, rng.choice(len(room["origins"]), CAMERA_COUNT, replace=False), rng, device, scale=scale)
    features = pool.initial_features(generator)
    if start is not None:
        features["middle"].data += start
    optimizer = FeatureOptimizer(features, factor)
    color_adam = torch.optim.Adam(color_parameters, lr=0.005 * factor)
    order = torch.randperm(len(pool), generator=generator).to(device)
    test, train = order[:TEST_RAY_COUNT], order[TEST_RAY_COUNT:]
    for iteration in range(iterations):
        stage = stage_of(iteration, iterations)
        for parameter in color_parameters:
            parameter.requires_grad_(stage == "color")
        pick = train[torch.randint(len(train), (rays,), generator=generator).to(device)]
        mapping_loss(decoders, stage, pool.batch(pick), features)[0].backward()
        optimizer.step(stage)
        if stage == "color":
            color_adam.step()
            color_adam.zero_grad(set_to_none=True)
    return decoders, pool, features, test


def _measure(decoders: DecoderSet, pool: RayPool, features: dict, test: torch.Tensor, room: dict) -> dict:
    batch = pool.batch(test)
    distance, color = render(decoders, "color", batch, features)
    # Points behind and in front of the surfaces the test rays hit; labels come from the room, not from the ray.
    surface = pool.origins[test] + pool.directions[test] * batch.distance[:, None]
    world = torch.as_tensor(room["points"] @ pool.rotation.T.astype(np.float32) + pool.shift.astype(np.float32))
    world = world.to(surface.device)
    gap = torch.cdist(world, surface).amin(dim=1)
    near = gap < 0.1
    points, labels = world[near], torch.as_tensor(room["occupied"], device=world.device)[near]
    stencils, known = pool.locate(points)
    logits = query_occupancy(decoders, "fine", points, features, stencils)[known]
    labels = labels[known]
    occupied = logits > 0
    union = (occupied | labels).sum().clamp_min(1)
    in_front = batch.z < batch.distance[:, None] - 0.1
    ray_logits = query_occupancy(decoders, "fine", batch.points.flatten(0, 1), features, batch.stencils)
    flat = batch.points.flatten(0, 1)
    middle = torch.nn.functional.embedding_bag(
        batch.stencils["middle"][0], features["middle"], per_sample_weights=batch.stencils["middle"][1], mode="sum"
    )
    silent = decoders.residual(flat, torch.zeros_like(middle), middle)
    return {
        "depth_l1_cm": 100 * float((distance - batch.distance).abs().mean()),
        "bce": float(torch.nn.functional.binary_cross_entropy_with_logits(OCCUPANCY_GAIN * logits, labels.float())),
        "iou": float((occupied & labels).sum() / union),
        "free": float((ray_logits.view(batch.z.shape)[in_front] < 0).float().mean()),
        "color_l1": float((color - batch.color).abs().mean()),
        "residual_rms": float(silent.square().mean().sqrt()),
    }


def compare(
    candidates: dict[str, Decoders],
    rooms: list[dict[str, np.ndarray]],
    budgets: tuple[int, ...] = (10, 30, 60, 120),
    *,
    rays: int = 200,
    factor: float = 1.0,
    scale: float = 1.0,
    start: torch.Tensor | None = None,
    device: str = "cpu",
) -> dict[str, dict[str, dict[str, float]]]:
    """Mean over rooms of `fit_room`, by candidate and iteration budget; every candidate sees the same rays."""
    result: dict[str, dict[str, dict[str, float]]] = {}
    for name, weights in candidates.items():
        result[name] = {}
        for budget in budgets:
            fits = [
                fit_room(weights, room, budget, i, rays=rays, factor=factor, scale=scale, start=start, device=device)
                for i, room in enumerate(rooms)
            ]
            result[name][str(budget)] = {key: float(np.mean([fit[key] for fit in fits])) for key in fits[0]}
    return result


def table(result: dict[str, dict[str, dict[str, float]]]) -> str:
    """The comparison as a Markdown table."""
    columns = ("depth_l1_cm", "bce", "iou", "free", "color_l1", "residual_rms")
    lines = ["| decoders | iterations | " + " | ".join(columns) + " |", "|---" * (len(columns) + 2) + "|"]
    for name, budgets in result.items():
        for budget, values in budgets.items():
            lines.append(f"| {name} | {budget} | " + " | ".join(f"{values[c]:.3f}" for c in columns) + " |")
    return "\n".join(lines)
