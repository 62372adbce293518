"""Numbers recorded from the authors' implementation, converted once to warpslam's conventions.

What the file holds and how it differs from ours:

- Camera axes are OpenGL's (y up, z backwards); ours are OpenCV's. ``T_cv = T_gl diag(1, -1, -1, 1)``. That is a half
  turn about x applied first, so ``q_cv = q_gl * (0, 1, 0, 0) = (-x, w, z, -y)``: a signed permutation of (w, x, y, z).
  Gradients with respect to the quaternion transform alike, and so does an Adam step, which treats every component on
  its own and is odd in the gradient.
- Grids are (1, 32, nz, ny, nx); ours are rows (nx * ny * nz, 32) in C order of (ix, iy, iz).
- The quaternion of the recorded pose is not of unit length.
- Frustum masks are bit-packed in C order of (ix, iy, iz), most significant bit first.
- Frustum masks belong to ``c2w``; everything else to the perturbed pose ``cam7``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from tests.reference.oracle import LEVELS, STAGES, Field, Grid

COARSE_ENLARGEMENT = 2.0
DEPTH_SCALE = 6553.5
LEARNING_RATE = 0.001


def opencv_pose(cam7: np.ndarray) -> np.ndarray:
    """Pose vector, or gradient with respect to one, (7,), from OpenGL to OpenCV camera axes; keeps the dtype."""
    w, x, y, z, *t = cam7
    return np.array([-x, w, z, -y, *t], dtype=cam7.dtype)


def rows_from_grid(grid: np.ndarray) -> np.ndarray:
    """Feature rows (nx * ny * nz, 32) of a recorded grid (1, 32, nz, ny, nx)."""
    return np.ascontiguousarray(grid[0].transpose(3, 2, 1, 0)).reshape(-1, grid.shape[1])


@dataclass(frozen=True)
class Lattice:
    """Vertex positions of a level: ``origin`` + index * ``spacing``, (3,) float64 [m]; ``shape`` (nx, ny, nz)."""

    origin: np.ndarray
    spacing: np.ndarray
    shape: tuple[int, int, int]

    @property
    def positions(self) -> np.ndarray:
        """World positions (nx * ny * nz, 3), float64 [m], in row order."""
        index = np.stack(np.meshgrid(*(np.arange(n) for n in self.shape), indexing="ij"), axis=-1).reshape(-1, 3)
        return self.origin + index * self.spacing


@dataclass(frozen=True)
class GoldenRendering:
    """Rendering of one stage.

    ``depth``, ``variance`` (N,); ``rgb`` (N, 3); ``z``, ``weights`` (N, S); ``raw`` (N, S, 4).
    """

    depth: np.ndarray
    variance: np.ndarray
    rgb: np.ndarray
    z: np.ndarray
    weights: np.ndarray
    raw: np.ndarray


@dataclass(frozen=True)
class GoldenMapping:
    """Mapping loss of one stage and its gradients.

    ``rows``: gradient of the feature rows (row_count, 32), by level, only of the levels that have one;
    ``color_decoder``: by weight name, empty except in the color stage; ``pose``: (7,) in OpenCV axes, None in the
    coarse stage.
    """

    loss: float
    rows: dict[str, np.ndarray]
    color_decoder: dict[str, np.ndarray]
    pose: np.ndarray | None


@dataclass(frozen=True)
class GoldenTracking:
    """Tracking ``loss``, ``residual`` (N,), ``keep`` (N,) bool, ``gradient`` (7,), pose after one Adam step (7,)."""

    loss: float
    residual: np.ndarray
    keep: np.ndarray
    gradient: np.ndarray
    pose_after_adam: np.ndarray
    learning_rate: float


@dataclass(frozen=True)
class GoldenScene:
    """The recorded scene in warpslam's conventions: 64 rays of one frame of a synthetic room, random weights.

    Pixels ``column``, ``row`` (64,) int64; ``depth`` (64,) float32 [m], 0 = missing; ``rgb`` (64, 3) float32 in [0, 1];
    ``pose`` (7,) float32; ``origins``, ``directions`` (64, 3) float32, world;
    ``lo``, ``hi`` (3,) float64, scene box [m]. Feature ``rows`` (row_count, 32)
    and ``decoders`` (by level, then by weight name) are float32.
    ``points`` (200, 3) float64 and ``point_values`` (200, 4) by stage are samples of the field itself, outside points
    included; ``point_features`` (200, 32) of the coarse and middle level and ``point_embedding`` (200, 93) of the
    middle level belong to them.
    ``frustum_pose`` (4, 4), ``depth_image`` (H, W) float32 [m] and ``frustum`` masks (row_count,) bool go together.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int
    lo: np.ndarray
    hi: np.ndarray
    lattices: dict[str, Lattice]
    rows: dict[str, np.ndarray]
    decoders: dict[str, dict[str, np.ndarray]]
    column: np.ndarray
    row: np.ndarray
    depth: np.ndarray
    rgb: np.ndarray
    pose: np.ndarray
    origins: np.ndarray
    directions: np.ndarray
    points: np.ndarray
    point_values: dict[str, np.ndarray]
    point_features: dict[str, np.ndarray]
    point_embedding: np.ndarray
    renderings: dict[str, GoldenRendering]
    mapping: dict[str, GoldenMapping]
    tracking: GoldenTracking
    frustum_pose: np.ndarray
    depth_image: np.ndarray
    frustum: dict[str, np.ndarray] = field(repr=False)

    @classmethod
    def load(cls, golden: np.lib.npyio.NpzFile | str | Path) -> GoldenScene:
        """Convert the recorded file, given open or by path."""
        g = golden if hasattr(golden, "files") else np.load(golden)
        g = {name: g[name] for name in g.files}
        height, width, fx, fy, cx, cy = (float(v) for v in g["intrinsics"])
        lo, hi = g["bound"].T.copy()

        def lattice(level: str) -> Lattice:
            enlargement = COARSE_ENLARGEMENT if level == "coarse" else 1.0
            shape = g[f"grid/grid_{level}"].shape[:1:-1]
            spacing = (hi - lo) * enlargement / (np.array(shape) - 1)
            return Lattice(lo * enlargement, spacing, tuple(int(n) for n in shape))

        def decoder(level: str) -> dict[str, np.ndarray]:
            prefix = f"dec/{level}_decoder."
            return {name[len(prefix) :]: g[name] for name in g if name.startswith(prefix)}

        def rendering(stage: str) -> GoldenRendering:
            keys = ("depth", "var", "rgb", "z", "w", "raw")
            return GoldenRendering(*(g[f"render/{stage}/{key}"] for key in keys))

        def mapping(stage: str) -> GoldenMapping:
            prefix = f"map/{stage}/grad_"
            rows = {k: rows_from_grid(g[f"{prefix}grid_{k}"]) for k in LEVELS if f"{prefix}grid_{k}" in g}
            weights = {name[len(prefix + "dec/") :]: g[name] for name in g if name.startswith(prefix + "dec/")}
            pose = opencv_pose(g[f"{prefix}cam7"]) if f"{prefix}cam7" in g else None
            return GoldenMapping(float(g[f"map/{stage}/loss"]), rows, weights, pose)

        def mask(level: str) -> np.ndarray:
            count = int(np.prod(g[f"frustum/grid_{level}_shape_xyz"]))
            return np.unpackbits(g[f"frustum/grid_{level}"])[:count].astype(bool)

        tracking = GoldenTracking(
            loss=float(g["track/loss"]),
            residual=g["track/resid"],
            keep=g["track/keep"],
            gradient=opencv_pose(g["track/grad_cam7"]),
            pose_after_adam=opencv_pose(g["track/cam7_after_adam"]),
            learning_rate=LEARNING_RATE,
        )
        return cls(
            fx=fx,
            fy=fy,
            cx=cx,
            cy=cy,
            width=int(width),
            height=int(height),
            lo=lo,
            hi=hi,
            lattices={level: lattice(level) for level in LEVELS},
            rows={level: rows_from_grid(g[f"grid/grid_{level}"]) for level in LEVELS},
            decoders={level: decoder(level) for level in LEVELS},
            column=g["pix_i"],
            row=g["pix_j"],
            depth=g["D"],
            rgb=g["I"].astype(np.float32),
            pose=opencv_pose(g["cam7"]),
            origins=g["rays_o"],
            directions=g["rays_d"],
            points=g["pts"],
            point_values={stage: g[f"query/{stage}"] for stage in STAGES},
            point_features={level: g[f"feat_{level}"] for level in ("coarse", "middle")},
            point_embedding=g["embed_middle"],
            renderings={stage: rendering(stage) for stage in STAGES},
            mapping={stage: mapping(stage) for stage in STAGES},
            tracking=tracking,
            frustum_pose=g["c2w"].astype(np.float64) @ np.diag([1.0, -1.0, -1.0, 1.0]),
            depth_image=(g["depth20_u16"] / DEPTH_SCALE).astype(np.float32),
            frustum={level: mask(level) for level in ("middle", "fine")},
        )

    def field(self, dtype: torch.dtype = torch.float64) -> Field:
        """A fresh copy of the map for the oracle; feature rows and colour decoder weights require gradients."""

        def tensor(array: np.ndarray) -> torch.Tensor:
            return torch.tensor(array, dtype=dtype)

        grids = {
            level: Grid(tensor(lattice.origin), tensor(lattice.spacing), lattice.shape, tensor(self.rows[level]))
            for level, lattice in self.lattices.items()
        }
        decoders = {level: {name: tensor(w) for name, w in d.items()} for level, d in self.decoders.items()}
        for variable in [*(grid.rows for grid in grids.values()), *decoders["color"].values()]:
            variable.requires_grad_()
        return Field(tensor(self.lo), tensor(self.hi), grids, decoders)
