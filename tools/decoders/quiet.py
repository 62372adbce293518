"""A fine decoder that says nothing where its feature is zero (supplement A.5), made from one that says a little.

The penalty of the training phases pulls against what the fine level is for. This regression does not: with F the fine
decoder as trained, a copy of it learns

    F'(p, f, m) = F(p, f, m) - F(p, 0, m)

at positions, fine and middle features as maps of training rooms have them. The target is zero at f = 0 whatever the
middle feature m, and elsewhere the same function of f as before.
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from tools.decoders.evaluation import fit_features
from tools.decoders.networks import DecoderSet, interpolate
from warpslam.field.decoders import Decoders

BATCH = 4096
REACH = 8.0
"""Positions of vertex features that are drawn apart from where they were fitted [m]."""


def quiet_fine_decoder(
    weights: Decoders,
    rooms: list[dict[str, np.ndarray]],
    steps: int,
    report: Callable[[str], None],
    *,
    seed: int = 0,
    rate: float = 1e-3,
) -> Decoders:
    """The decoders with a fine decoder that is silent at zero feature.

    Args:
        weights: As trained.
        rooms: Samples of training rooms, in which maps are made to draw features from.
        steps: Adam steps, with a cosine from ``rate`` to a hundredth of it.
        report: Called with a line now and then.
        seed: Of all draws.
        rate: Learning rate at the start.
    """
    decoders = DecoderSet(weights)
    for parameter in decoders.parameters():
        parameter.requires_grad_(False)
    along, vertices = _features_of_maps(weights, rooms)
    report(f"{len(along[0])} samples along rays, {len(vertices)} vertices of {len(rooms)} maps")
    quiet = copy.deepcopy(decoders.fine)
    for parameter in quiet.parameters():
        parameter.requires_grad_(True)
    adam = torch.optim.Adam(quiet.parameters(), lr=rate)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(adam, steps, rate / 100)
    generator = torch.Generator().manual_seed(seed)
    for step in range(steps):
        points, fine, middle = _draw(along, vertices, generator)
        silent = torch.cat([torch.zeros_like(fine), middle], dim=1)
        both = torch.cat([fine, middle], dim=1)
        with torch.no_grad():
            wanted = decoders.fine(points, both) - decoders.fine(points, silent)
        spoken = (quiet(points, both) - wanted).square().mean()
        rest = quiet(points, silent).square().mean()
        adam.zero_grad(set_to_none=True)
        (spoken + rest).backward()
        adam.step()
        schedule.step()
        if step % max(steps // 20, 1) == 0 or step + 1 == steps:
            errors = [float(part.detach()) ** 0.5 for part in (spoken, rest)]
            report("step {}: difference {:.4f}, at zero feature {:.4f}".format(step, *errors))
    return dataclasses.replace(weights, fine=quiet.weights())


def _features_of_maps(
    weights: Decoders, rooms: list[dict[str, np.ndarray]]
) -> tuple[tuple[Tensor, Tensor, Tensor], Tensor]:
    """Positions, fine and middle features at samples along rays, and middle features of vertices that were moved."""
    parts, vertices = [], []
    for i, room in enumerate(rooms):
        factor, iterations, scale = ((5.0, 200, 1.0), (1.0, 60, 1.0), (5.0, 100, 0.5))[i % 3]
        _, pool, features, _ = fit_features(weights, room, iterations, 1000 + i, factor=factor, scale=scale)
        with torch.no_grad():
            flat = pool.points.flatten(0, 1)
            looked_up = [
                interpolate(features[level], tuple(part.flatten(0, 1) for part in pool.stencils[level]))
                for level in ("fine", "middle")
            ]
            keep = torch.randperm(len(flat), generator=torch.Generator().manual_seed(i))[:60_000]
            parts.append((flat[keep], *(part[keep] for part in looked_up)))
            vertices.append(features["middle"][features["middle"].abs().amax(dim=1) > 0.1].detach())
    points, fine, middle = (torch.cat(column) for column in zip(*parts, strict=True))
    return (points, fine, middle), torch.cat(vertices)


def _draw(
    along: tuple[Tensor, Tensor, Tensor], vertices: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor, Tensor]:
    """A batch: half as it lies along rays, half with the middle feature of any vertex anywhere."""
    pick = torch.randint(len(along[0]), (BATCH,), generator=generator)
    points, fine, middle = (column[pick] for column in along)
    half = BATCH // 2
    other = vertices[torch.randint(len(vertices), (half,), generator=generator)]
    anywhere = REACH * (2.0 * torch.rand(half, 3, generator=generator) - 1.0)
    scale = 1.5 * torch.rand(BATCH, 1, generator=generator)
    return torch.cat([points[:half], anywhere]), scale * fine, torch.cat([middle[:half], other])
