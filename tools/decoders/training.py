"""The two training phases and the trainer that runs, saves and resumes them.

Phase 1, encoder (supplement A.5): an encoder turns the surface points of room crops into features; encoder and decoders
are trained together on the occupancy of points. Fine and coarse logits are trained as in the paper: the fine one as a
residual on the middle one, and pushed to zero where its own feature is zero.

Phase 2, mapping: features start from the noise of a fresh map and are optimised on rendered depth and colour exactly
as the mapper does it, and at each step the decoders take a small step on the same loss, plus cross entropy at labelled
points near the surface. Over many short episodes in new rooms, this leaves decoders that features fit quickly (a
first-order method: no gradient flows through the features' own optimisation).
"""

from __future__ import annotations

import json
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from tools.decoders.mapping import FeatureOptimizer, RayPool, mapping_loss, query_occupancy, random_placement
from tools.decoders.networks import OCCUPANCY_GAIN, SPACING, DecoderSet, Lattice, PointEncoder, interpolate
from warpslam.errors import CheckpointError
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import EMBEDDING_SCALE, LEVELS, Decoders, random_decoders

UNET_DEPTH = {"coarse": 1, "middle": 2, "fine": 1, "color": 1}
FEATURE_SCALE = {"coarse": 0.1, "middle": 1.0, "fine": 0.2, "color": 0.2}
"""Size of the encoder's features: what run-time learning rates reach in some tens of steps (0.1 middle, 0.005 fine)."""


@dataclass(frozen=True)
class TrainingConfig:
    """Settings that a resumed run must share."""

    seed: int = 0
    fourier_scale: float = 25.0  # standard deviation of the embedding's frequencies at the start [1/m]
    encoder_share: float = 0.1  # of the training time, for phase 1
    crop_count: int = 3  # crops in a batch of phase 1
    crop_size: float = 2.56  # [m], a multiple of every fine and middle spacing
    cloud_size: int = 2500  # surface points that the encoder sees in a crop
    point_count: int = 3000  # labelled points of a crop, half of them near the surface
    whole_count: int = 2000  # labelled points of a whole room, anywhere in it
    encoder_rate: float = 1e-3  # Adam learning rate of phase 1
    scene_count: int = 12  # rooms that are mapped in one episode of phase 2
    turn_count: int = 2  # of these, how many take a step at a time
    camera_count: int = 2  # views of each
    coarse_share: float = 0.0  # of the rooms of an episode, for the coarse level alone; see README.md
    finer_share: float = 0.25  # of the other rooms, with half the vertex spacing
    first_share: float = 0.2  # of the rooms, at the learning rates of a run's first frame
    ray_count: int = 160  # rays of a room in one step
    longest_mapping: int = 40  # iterations of a room in an episode; the shortest has 10
    longest_first: int = 160  # the same at the learning rates of a first frame
    longest_coarse: int = 500  # the same of the coarse level
    mapping_rate: float = 1e-3  # Adam learning rate of the decoders in phase 2, at its start
    mapping_rate_end: float = 3e-5  # and at its end (cosine)
    label_count: int = 1500  # labelled points of a room in one step
    label_weight: float = 0.3  # of the cross entropy [nats] beside the depth error [m] in phase 2
    coarse_label_weight: float = 2.0  # the same for the coarse level, whose labels reach beyond what is seen
    residual_weight: float = 50.0  # of the squared fine logit where the fine feature is zero
    quiet_band: float = 0.02  # fine logits there up to this cost nothing
    feature_scale: float = 1.0  # on FEATURE_SCALE
    feature_weight: float = 1e-3  # of the squared features of the encoder, before FEATURE_SCALE


@dataclass
class Progress:
    """What has been done so far."""

    elapsed: float = 0.0  # [s] of training, all starts of this run together
    encoder_steps: int = 0
    episodes: int = 0
    mapping_steps: int = 0
    history: list[dict[str, float]] = field(default_factory=list)


class Trainer:
    """Trains on the samples of rooms; everything that changes is in `state()`."""

    def __init__(
        self,
        config: TrainingConfig,
        rooms: list[dict[str, np.ndarray]],
        device: str = "cpu",
        start: Decoders | None = None,
    ) -> None:
        """Start from these decoders, or from random ones."""
        torch.manual_seed(config.seed)
        self.config, self.rooms, self.device = config, rooms, device
        self.rng = np.random.default_rng(config.seed)
        self.generator = torch.Generator().manual_seed(config.seed)
        self.decoders = DecoderSet(start or _random_start(config)).to(device)
        scale = {level: config.feature_scale * FEATURE_SCALE[level] for level in LEVELS}
        self.encoders = nn.ModuleDict(
            {lv: PointEncoder(SPACING[lv], depth=UNET_DEPTH[lv], scale=scale[lv]) for lv in LEVELS}
        ).to(device)
        parameters = [*self.decoders.parameters(), *self.encoders.parameters()]
        self.encoder_adam = torch.optim.Adam(parameters, lr=config.encoder_rate)
        self.mapping_adam = torch.optim.Adam(self.decoders.parameters(), lr=config.mapping_rate)
        self.progress = Progress()

    def run(
        self,
        minutes: float,
        save: Callable[[Trainer], None],
        report: Callable[[str], None],
        *,
        save_every: float = 30.0,
        max_steps: int | None = None,
    ) -> None:
        """Train until `minutes` have been spent in all, or `max_steps` steps or episodes are done in this call."""
        budget, last, saved_at = 60.0 * minutes, time.monotonic(), self.progress.elapsed
        done = 0
        while self.progress.elapsed < budget and (max_steps is None or done < max_steps):
            share = self.progress.elapsed / budget
            if share < self.config.encoder_share:
                losses = {"phase": 1.0, **self.encoder_step()}
            else:
                part = (share - self.config.encoder_share) / (1.0 - self.config.encoder_share)
                losses = {"phase": 2.0, **self.episode(part)}
            now = time.monotonic()
            self.progress.elapsed += now - last
            last, done = now, done + 1
            self.progress.history.append({"elapsed": self.progress.elapsed, **losses})
            if losses["phase"] == 2.0 or done % 20 == 1:
                report(_line(self.progress, losses))
            if self.progress.elapsed - saved_at > save_every:
                save(self)
                saved_at = self.progress.elapsed
        save(self)

    def encoder_step(self) -> dict[str, float]:
        """One step of phase 1 on a few room crops."""
        crops = [self._draw_crop() for _ in range(self.config.crop_count)]
        batch = {name: torch.cat([crop[name] for crop in crops]) for name in crops[0]}
        scene = {
            name: torch.cat([torch.full((len(crop[name]),), i) for i, crop in enumerate(crops)]).to(self.device)
            for name in ("cloud", "points", "surface", "whole_cloud", "whole_passed", "whole_points")
        }
        # The coarse cells are nearly as large as a crop, so that level works on whole rooms, of which it sees a part.
        losses, sizes = {}, {}
        features: dict[str, Tensor] = {}
        lattices: dict[str, Lattice] = {}
        for level in LEVELS:
            kind = "whole_" if level == "coarse" else ""
            lower = torch.stack([crop[kind + "box"][0] for crop in crops])
            upper = torch.stack([crop[kind + "box"][1] for crop in crops])
            lattices[level] = Lattice.covering(lower, upper, SPACING[level])
            cloud = kind + "cloud"
            features[level] = self.encoders[level](
                batch[cloud], batch[cloud + "_normals"], batch[cloud + "_colors"], scene[cloud], lattices[level]
            )
            sizes[level] = (features[level] / self.encoders[level].scale).square().mean()
        # A map's vertices that no ray has passed hold nothing yet; what lies there is for the coarse decoder to guess.
        rows, weights = lattices["coarse"].stencil(batch["whole_passed"], scene["whole_passed"])
        passed = torch.zeros(len(features["coarse"]), 1, device=self.device)
        passed[rows[weights > 0]] = 1.0
        features["coarse"] = features["coarse"] * passed

        def look_up(level: str, name: str) -> Tensor:
            return interpolate(features[level], lattices[level].stencil(batch[name], scene[name]))

        labels = batch["occupied"]
        losses["coarse"] = _cross_entropy(
            self.decoders.coarse(batch["whole_points"], look_up("coarse", "whole_points")), batch["whole_occupied"]
        )
        middle = look_up("middle", "points")
        logits = self.decoders.middle(batch["points"], middle)
        losses["middle"] = _cross_entropy(logits, labels)
        residual = self.decoders.residual(batch["points"], look_up("fine", "points"), middle)
        losses["fine"] = _cross_entropy(logits.detach() + residual, labels)
        losses["silence"] = self._silence(batch["points"], middle)
        colors = self.decoders.color(batch["surface"], look_up("color", "surface"))
        losses["color"] = (colors - batch["surface_colors"]).abs().mean()
        total = losses["coarse"] + losses["middle"] + losses["fine"] + losses["color"]
        total = total + self.config.residual_weight * losses["silence"]
        total = total + self.config.feature_weight * sum(sizes.values())
        self.encoder_adam.zero_grad(set_to_none=True)
        total.backward()
        nn.utils.clip_grad_norm_([*self.decoders.parameters(), *self.encoders.parameters()], 5.0)
        self.encoder_adam.step()
        self.progress.encoder_steps += 1
        result = {name: float(value.detach()) for name, value in losses.items()}
        accuracy = ((logits + residual).detach() > 0) == (labels > 0.5)
        return result | {"accuracy": float(accuracy.float().mean())}

    def episode(self, part: float) -> dict[str, float]:
        """One episode of phase 2; `part` in [0, 1] is how much of the phase is over."""
        config = self.config
        rate = config.mapping_rate_end + (config.mapping_rate - config.mapping_rate_end) * 0.5 * (
            1.0 + math.cos(math.pi * min(part, 1.0))
        )
        self.mapping_adam.param_groups[0]["lr"] = rate
        waiting = [self._draw_scene() for _ in range(config.scene_count)]
        ends: dict[str, list[float]] = {}
        # Scenes take turns at random, so the decoders move on between two steps of one scene, and can't settle on it
        # together with its features: at run time they are frozen.
        while waiting:
            chosen = self.rng.choice(len(waiting), min(config.turn_count, len(waiting)), replace=False)
            for scene in (waiting[i] for i in chosen):
                position = scene["done"] / scene["iterations"]
                # Geometry has the larger share here than in the mapper: it is what tracking depends on.
                stage = "middle" if position < 0.5 else "fine" if position < 0.8 else "color"
                if scene["coarse"]:
                    stage = "coarse"
                scene["losses"][stage] = self._mapping_step(scene, stage)
                scene["done"] += 1
            nn.utils.clip_grad_norm_(self.decoders.parameters(), 1.0)
            self.mapping_adam.step()
            self.mapping_adam.zero_grad(set_to_none=True)
            self.progress.mapping_steps += 1
            for scene in waiting:
                if scene["done"] == scene["iterations"]:
                    for stage, losses in scene["losses"].items():
                        for name, value in losses.items():
                            ends.setdefault(f"{stage}_{name}", []).append(value)
            waiting = [scene for scene in waiting if scene["done"] < scene["iterations"]]
        self.progress.episodes += 1
        return {name: float(np.mean(values)) for name, values in ends.items()}

    def state(self) -> dict[str, Any]:
        """Everything a later `restore` needs, as tensors and plain values."""
        return {
            "decoder_state_dict": {k: torch.from_numpy(v) for k, v in self.decoders.weights().state_dict().items()},
            "encoder_state": self.encoders.state_dict(),
            "encoder_adam": self.encoder_adam.state_dict(),
            "mapping_adam": self.mapping_adam.state_dict(),
            "config": asdict(self.config),
            "progress": asdict(self.progress),
            "numpy_rng": json.dumps(self.rng.bit_generator.state),
            "torch_rng": self.generator.get_state(),
        }

    def save(self, path: Path) -> None:
        """Write the state; a kill while writing leaves the former file."""
        temporary = path.with_suffix(".tmp")
        torch.save(self.state(), temporary)
        temporary.replace(path)

    def restore(self, path: Path) -> None:
        """Continue from a file that `save` wrote; its settings must be the present ones."""
        state = torch.load(path, map_location="cpu", weights_only=True)
        if state["config"] != asdict(self.config):
            changed = [k for k, v in asdict(self.config).items() if state["config"].get(k) != v]
            raise CheckpointError(f"{path}: was trained with other settings ({', '.join(changed)}). Use a new folder.")
        weights = load_decoders(path)
        for decoder, saved in zip((getattr(self.decoders, level) for level in LEVELS), weights, strict=True):
            for parameter, array in zip(decoder.values, saved.tensors.values(), strict=True):
                parameter.data.copy_(torch.from_numpy(array))
        self.encoders.load_state_dict(state["encoder_state"])
        self.encoder_adam.load_state_dict(state["encoder_adam"])
        self.mapping_adam.load_state_dict(state["mapping_adam"])
        self.progress = Progress(**state["progress"])
        self.rng.bit_generator.state = json.loads(state["numpy_rng"])
        self.generator.set_state(state["torch_rng"])

    def weights(self) -> Decoders:
        """Present decoders."""
        return self.decoders.weights()

    def _silence(self, points: Tensor, middle: Tensor) -> Tensor:
        """Mean square of what the fine logit exceeds the quiet band by where the fine feature is zero.

        For real middle features and for noise of up to 3 x them. The band leaves the decoder free to answer small
        features: without it, a weight that silences the last points also slows the fine level down.
        """
        draws = torch.rand(2, len(points), 1, generator=self.generator).to(self.device)
        noise = torch.randn(middle.shape, generator=self.generator).to(self.device)
        noise = middle.detach().std() * (0.3 + 2.7 * draws[0]) * noise
        shifted = middle.detach() + torch.where(draws[1] < 0.5, torch.zeros_like(noise), noise)
        mixed = torch.where(draws[1] < 0.75, shifted, noise)
        residual = self.decoders.residual(points, torch.zeros_like(middle), mixed)
        return F.relu(residual.abs() - self.config.quiet_band).square().mean()

    def _mapping_step(self, scene: dict[str, Any], stage: str) -> dict[str, float]:
        pool: RayPool = scene["pool"]
        features = scene["features"]
        pick = torch.randint(len(pool), (self.config.ray_count,), generator=self.generator).to(self.device)
        batch = pool.batch(pick)
        loss, depth = mapping_loss(self.decoders, stage, batch, features)
        # Labels reach the decoders alone: at run time, features see nothing but images.
        frozen = {level: table.detach() for level, table in features.items()}
        some = torch.randint(len(scene["points"]), (self.config.label_count,), generator=self.generator).to(self.device)
        stencils = {level: (rows[some], weights[some]) for level, (rows, weights) in scene["stencils"].items()}
        points = scene["points"][some]
        logits = query_occupancy(self.decoders, stage, points, frozen, stencils)
        labels = _cross_entropy(logits, scene["occupied"][some])
        weight = self.config.coarse_label_weight if stage == "coarse" else self.config.label_weight
        total = loss + weight * labels
        if stage in ("fine", "color"):
            middle = interpolate(frozen["middle"], stencils["middle"])
            total = total + self.config.residual_weight * self._silence(points, middle)
        (total / self.config.turn_count).backward()
        # Adam does not see the scale of a gradient, so the features step as they do on the sum over rays.
        scene["optimizer"].step(stage)
        return {"depth": float(depth.detach()), "bce": float(labels.detach())}

    def _draw_scene(self) -> dict[str, Any]:
        while True:
            room = self.rooms[self.rng.integers(len(self.rooms))]
            coarse = self.rng.random() < self.config.coarse_share
            most = min(6, len(room["origins"]))
            camera_count = self.rng.integers(1, most + 1) if coarse else self.config.camera_count
            cameras = self.rng.choice(len(room["origins"]), camera_count, replace=False)
            scale = 0.5 if not coarse and self.rng.random() < self.config.finer_share else 1.0
            pool = RayPool(room, cameras, self.rng, self.device, scale=scale, coarse=coarse)
            # The coarse level is for what lies anywhere in the room; the first half of the points is near surfaces.
            index = self.rng.integers(len(room["points"]) // 2 if coarse else 0, len(room["points"]), 30_000)
            rotation, shift = pool.rotation.astype(np.float32), pool.shift.astype(np.float32)
            points = torch.as_tensor(room["points"][index] @ rotation.T + shift, device=self.device)
            stencils, known = pool.locate(points)
            if known.sum() >= 500:
                break
        features = pool.initial_features(self.generator)
        # The first frame of a run is mapped with five times the learning rates, which is where the coarse level, whose
        # rates are small, gets most of what it holds. Its iterations are cheap, and a run has many.
        first = not coarse and self.rng.random() < self.config.first_share
        factor = 5.0 if coarse or first else 1.0
        config = self.config
        longest = config.longest_coarse if coarse else config.longest_first if first else config.longest_mapping
        return {
            "coarse": coarse,
            "iterations": int(self.rng.integers(10, longest + 1)),
            "done": 0,
            "losses": {},
            "pool": pool,
            "features": features,
            "optimizer": FeatureOptimizer(features, factor),
            "points": points[known],
            "occupied": torch.as_tensor(room["occupied"][index], device=self.device)[known].float(),
            "stencils": {level: (rows[known], weights[known]) for level, (rows, weights) in stencils.items()},
        }

    def _draw_crop(self) -> dict[str, Tensor]:
        """A box around a surface point of a placed room with the points in it, and what some views show of the room."""
        config, rng = self.config, self.rng
        room = self.rooms[rng.integers(len(self.rooms))]
        rotation, shift = random_placement(rng)

        def place(points: np.ndarray) -> np.ndarray:
            return points @ rotation.T + shift

        surface, points = place(room["surface"]), place(room["points"])
        normals = room["normals"] @ rotation.T
        size = config.crop_size
        low = np.round((surface[rng.integers(len(surface))] - size / 2) / SPACING["middle"]) * SPACING["middle"]
        inside = np.flatnonzero(((surface > low) & (surface < low + size)).all(axis=1))
        labelled = np.flatnonzero(((points > low) & (points < low + size)).all(axis=1))
        half = len(room["points"]) // 2
        near, uniform = labelled[labelled < half], labelled[labelled >= half]
        if not len(uniform):
            uniform = near
        cloud = rng.choice(inside, config.cloud_size)
        shown = rng.choice(inside, config.point_count // 2)
        chosen = np.concatenate(
            [rng.choice(near, config.point_count // 2), rng.choice(uniform, config.point_count // 2)]
        )
        whole = half + rng.choice(len(points) - half, config.whole_count)
        views = rng.choice(len(room["origins"]), rng.integers(1, len(room["origins"]) // 3 + 1), replace=False)
        seen = np.argwhere(room["distances"][views] > 0)
        camera, ray = seen[rng.integers(0, len(seen), config.cloud_size)].T
        ray = (views[camera], ray)
        path = room["directions"][ray] * room["distances"][ray][:, None]
        passed = room["origins"][ray[0]] + rng.random((8, len(path), 1)) * path
        arrays = {
            "cloud": surface[cloud] + rng.normal(0.0, 0.005, (len(cloud), 3)),
            "cloud_normals": normals[cloud],
            "cloud_colors": room["colors"][cloud],
            "points": points[chosen],
            "occupied": room["occupied"][chosen],
            "surface": surface[shown],
            "surface_colors": room["colors"][shown],
            "box": np.stack([low, low + size]) + np.array([[1e-4], [-1e-4]]),
            "whole_cloud": place(room["origins"][ray[0]] + path),
            "whole_cloud_normals": room["ray_normals"][ray] @ rotation.T,
            "whole_cloud_colors": room["ray_colors"][ray],
            "whole_passed": place(passed.reshape(-1, 3)),
            "whole_points": points[whole],
            "whole_occupied": room["occupied"][whole],
            "whole_box": np.stack([points.min(axis=0), points.max(axis=0)]),
        }
        return {name: torch.as_tensor(a.astype(np.float32), device=self.device) for name, a in arrays.items()}


def _random_start(config: TrainingConfig) -> Decoders:
    decoders = random_decoders(config.seed)
    for weights in decoders:
        if "embedder._B" in weights.tensors:
            weights.tensors["embedder._B"] *= config.fourier_scale / EMBEDDING_SCALE
    return decoders


def _cross_entropy(logits: Tensor, labels: Tensor) -> Tensor:
    return F.binary_cross_entropy_with_logits(OCCUPANCY_GAIN * logits, labels)


def _line(progress: Progress, losses: dict[str, float]) -> str:
    values = ", ".join(f"{k} {v:.3f}" for k, v in losses.items() if k != "phase")
    count = progress.encoder_steps if losses["phase"] == 1.0 else progress.episodes
    return f"{progress.elapsed / 60:5.1f} min, phase {int(losses['phase'])}, {count}: {values}"
