"""What decoders are worth at run time: the same sequence mapped with each of several decoder files.

    python -m tools.decoders.compare views random ours third=FILE --sequence house
    python -m tools.decoders.compare first random ours third=FILE --sequence house
    python -m tools.decoders.compare residual ours --sequence house
    python -m tools.decoders.compare forecast random ours --picture forecast.png

`views`: depth error of views that were never mapped; `first`: iterations that the first frame needs; `residual`: the
fine logit where the fine feature is zero; `forecast`: occupancy beyond what was seen, from the coarse level.

A decoder is `random` (as the reference initialises them), `ours` (the package's file) or NAME=FILE. Poses are given,
all decoders but the colour one are frozen, everything else is as in a run. Synthetic rooms are ones that no training
has seen.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import cv2
import numpy as np
import torch
import trimesh
import warp as wp
from scipy.ndimage import distance_transform_edt
from warp.geometry import IsoSurfaceMarchingCubes

from tools.benchmarks.views import view_errors
from tools.decoders.networks import LevelDecoder
from tools.decoders.room_samples import HELD_OUT_SEED
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import WarpSlamError
from warpslam.evaluation import visible_points
from warpslam.field.decoder_files import load_decoders
from warpslam.field.decoders import Decoders, random_decoders
from warpslam.sequences import RgbdSequence, open_sequence
from warpslam.slam import Slam
from warpslam.synthetic import MeshRenderer, SyntheticSequence, look_at

CAMERA = Intrinsics(fx=250.0, fy=250.0, cx=159.5, cy=119.5, width=320, height=240)
FORECAST_OFFSET = 0.2  # added to the coarse logit where it forecasts (released code)
SEEN, SHELL = 0.05, 1.0  # [m] tolerance of "seen", depth of the shell beyond it
STRIDE = 4  # every fourth pixel of a view is rendered
FIRST_BUDGETS = (15, 25, 40, 60, 90, 130, 200, 300, 450, 700, 1000, 1500, 2250)


def main(arguments: list[str] | None = None) -> int:
    """Run one comparison; returns the exit status."""
    options = _parser().parse_args(arguments)
    try:
        options.run(options, dict(options.decoders))
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def compare_views(options: argparse.Namespace, decoders: dict[str, Decoders]) -> None:
    """Map every 20th frame; render others by the map alone and with samples guided by the true depth."""
    sequence = open_sequence(options.sequence)
    mapped, held_back = range(0, len(sequence), options.step), range(options.step // 2, len(sequence), options.step)
    print(f"{len(mapped)} mapped frames, {len(held_back)} views; depth L1 [cm]: guided mean, alone mean, alone median")
    print("| iterations | " + " | ".join(decoders) + " |")
    for budget in options.budgets:
        cells = []
        for weights in decoders.values():
            slam = _map_frames(sequence, mapped, weights, [*options.set, f"mapping.iterations={budget}"])
            rows = [_view_errors(slam, sequence, index) for index in held_back]
            cells.append(", ".join(f"{value:.2f}" for value in np.mean(rows, axis=0)))
        print(f"| {budget} | " + " | ".join(cells) + " |", flush=True)


def compare_first_frame(options: argparse.Namespace, decoders: dict[str, Decoders]) -> None:
    """Least number of first-frame iterations (of a fixed list) that renders that frame within both bounds."""
    if options.sequence:
        sequences = {str(options.sequence): open_sequence(options.sequence)}
    else:
        sequences = {f"room {i}": SyntheticSequence(HELD_OUT_SEED + i, 2, intrinsics=CAMERA) for i in range(2)}
    print(
        "iterations until depth L1 < 3 cm and PSNR > 22 dB (depth [cm] and PSNR [dB] there, or with the least depth L1)"
    )
    for place, sequence in sequences.items():
        for name, weights in decoders.items():
            tried = []
            for budget in FIRST_BUDGETS:
                overrides = [*options.set, f"mapping.first_iterations={budget}", "mapping.coarse=false"]
                slam = _map_frames(sequence, range(1), weights, overrides, finish=False)
                depth, _, quality = view_errors(slam, sequence[0], STRIDE, guided=True)
                tried.append((budget, depth, quality))
                if tried[-1][1] < 3.0 and tried[-1][2] > 22.0:
                    break
            budget, depth, psnr = tried[-1] if tried[-1][1] < 3.0 else min(tried, key=lambda row: row[1])
            met = depth < 3.0 and psnr > 22.0
            print(f"{place}: {name}: {budget if met else f'not within {FIRST_BUDGETS[-1]}'} ({depth:.2f}, {psnr:.1f})")
            for row in tried:
                print("    {:5d}: {:6.2f} cm {:5.1f} dB".format(*row), flush=True)


def measure_residual(options: argparse.Namespace, decoders: dict[str, Decoders]) -> None:
    """Distribution of the fine logit where its own feature is zero, with middle features of a mapped sequence."""
    sequence = open_sequence(options.sequence)
    for name, weights in decoders.items():
        slam = _map_frames(sequence, range(0, len(sequence), options.step), weights, options.set)
        features = torch.from_numpy(slam.scene.grids["middle"].features.numpy().reshape(-1, 32))
        moved = features[features.abs().amax(dim=1) > 0.1]
        rng = np.random.default_rng(0)
        low, high = slam.scene.bounds
        points = torch.from_numpy(rng.uniform(low, high, (200_000, 3)).astype(np.float32))
        # Between vertices a feature is a mean of eight neighbours; rows of one corner are the wider spread.
        drawn = moved[torch.from_numpy(rng.integers(0, len(moved), len(points)))]
        with torch.no_grad():
            logits = LevelDecoder(weights.fine)(points, torch.cat([torch.zeros_like(drawn), drawn], dim=1)).abs()
        share = float((logits <= 0.05).float().mean())
        print(
            f"{name}: |residual| <= 0.05 for {100 * share:.2f} % of {len(points)} points, 99 %: "
            f"{float(torch.quantile(logits, 0.99)):.3f}, worst {float(logits.max()):.3f}; {len(moved)} middle features",
            flush=True,
        )


def compare_forecasts(options: argparse.Namespace, decoders: dict[str, Decoders]) -> None:
    """Intersection over union of occupancy in the unobserved shell around what a short walk saw."""
    print(f"IoU of occupancy at most {SHELL} m beyond what was seen: at the forecast level, at level 0; share occupied")
    results: dict[str, list] = {name: [] for name in decoders}
    for i in range(options.rooms):
        sequence = SyntheticSequence(HELD_OUT_SEED + i, 60, intrinsics=CAMERA)
        frames = range(0, 60, 12)
        points, seen, shape = _observed(sequence, frames)
        distance = distance_transform_edt(~seen.reshape(shape), sampling=0.1).ravel()
        shell = ~seen & (distance <= SHELL)
        truth = sequence.room.occupancy(points[shell])
        for name, weights in decoders.items():
            slam = _map_frames(sequence, frames, weights, options.set)
            logits = slam.scene.query_occupancy(points[shell].astype(np.float32), level="coarse")
            row = [_iou(logits + FORECAST_OFFSET > 0, truth), _iou(logits > 0, truth), truth.mean()]
            results[name].append(row)
            print(f"room {i}: {name}: " + ", ".join(f"{value:.3f}" for value in row), flush=True)
            if options.picture and i == 0:
                path = options.picture.with_stem(f"{options.picture.stem}_{name}")
                cv2.imwrite(str(path), _picture(slam, sequence, points, shell, shape)[..., ::-1])
    for name, rows in results.items():
        print(f"mean: {name}: " + ", ".join(f"{value:.3f}" for value in np.mean(rows, axis=0)))


def _map_frames(
    sequence: RgbdSequence, frames: range, weights: Decoders, overrides: list[str], *, finish: bool = True
) -> Slam:
    fixed = ["tracking.use_given_poses=true", "mapping.every=1", "mapping.bundle_adjustment=false", "keyframes.every=2"]
    config = Config.from_preset("rendering", [*fixed, *overrides])
    slam = Slam(sequence.intrinsics, config, decoders=weights)
    for index in frames:
        frame = sequence[index]
        slam.step(frame.rgb, frame.depth, T_world_camera=frame.T_world_camera)
    if finish:
        slam.finish()
    return slam


def _view_errors(slam: Slam, sequence: RgbdSequence, index: int) -> list[float]:
    """Depth L1 [cm]: mean with guided samples, mean and median by the map alone."""
    frame = sequence[index]
    alone = view_errors(slam, frame, STRIDE, guided=False)
    return [view_errors(slam, frame, STRIDE, guided=True)[0], *alone[:2]]


def _iou(found: np.ndarray, truth: np.ndarray) -> float:
    return float((found & truth).sum() / max((found | truth).sum(), 1))


def _observed(sequence: SyntheticSequence, frames: range) -> tuple[np.ndarray, np.ndarray, tuple[int, ...]]:
    """Centres (N, 3) of 10 cm voxels of the room, which of them some frame saw (N,), and their lattice's shape."""
    low, high = sequence.room.bounds
    axes = [np.arange(a + 0.05, b, 0.1) for a, b in zip(low, high, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    poses = np.stack([sequence[index].T_world_camera for index in frames])
    depths = (sequence[index].depth for index in frames)
    seen = visible_points(points, poses, sequence.intrinsics, depths, tolerance=SEEN)
    return points, seen, tuple(len(axis) for axis in axes)


def _picture(slam: Slam, sequence: SyntheticSequence, points: np.ndarray, shell: np.ndarray, shape) -> np.ndarray:
    """The room from above without its ceiling: seen surface in its colours, forecast surface in cyan."""
    seen = slam.mesh(0.04)
    logits = np.full(len(points), -1.0, np.float32)
    logits[shell] = slam.scene.query_occupancy(points[shell].astype(np.float32), level="coarse") + FORECAST_OFFSET
    low, high = points.min(axis=0), points.max(axis=0)
    vertices, faces = IsoSurfaceMarchingCubes.extract_surface_marching_cubes(
        wp.array(np.ascontiguousarray(logits.reshape(shape)), dtype=float),
        0.0,
        domain_bounds_lower_corner=wp.vec3(*low),
        domain_bounds_upper_corner=wp.vec3(*high),
    )
    parts = [seen]
    if len(faces):
        cyan = trimesh.Trimesh(vertices.numpy(), faces.numpy().reshape(-1, 3), process=False)
        cyan.visual.vertex_colors = np.tile(np.array([0, 255, 255, 255], np.uint8), (len(cyan.vertices), 1))
        parts.append(cyan)
    ceiling = sequence.room.interior_bounds[1, 2] - 0.3
    for part in parts:
        part.update_faces(part.triangles_center[:, 2] < ceiling)
    middle = sequence.room.bounds.mean(axis=0)
    eye = middle + np.array([0.5, -0.6, 1.6]) * np.ptp(sequence.room.bounds, axis=0).max()
    renderer = MeshRenderer(trimesh.Scene(parts), Intrinsics(700.0, 700.0, 399.5, 299.5, 800, 600))
    image, depth = renderer.render(look_at(eye, middle))
    image[depth == 0] = 255
    return image


def _decoders(text: str) -> tuple[str, Decoders]:
    if text == "random":
        return text, random_decoders(0)
    if text == "ours":
        return text, load_decoders()
    name, separator, path = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r}: expected random, ours or NAME=FILE")
    try:
        return name, load_decoders(path)
    except WarpSlamError as error:
        raise argparse.ArgumentTypeError(str(error)) from None


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)

    def command(name: str, run) -> argparse.ArgumentParser:
        part = commands.add_parser(name, help=run.__doc__)
        part.add_argument("decoders", type=_decoders, nargs="+", help="random, ours, NAME=FILE")
        part.add_argument("--set", nargs="+", default=[], help="settings of a run, group.field=value")
        part.set_defaults(run=run)
        return part

    for name, run in (("views", compare_views), ("residual", measure_residual)):
        part = command(name, run)
        part.add_argument("--sequence", type=Path, required=True, help="sequence folder with true poses")
        part.add_argument("--step", type=int, default=20, help="map every n-th frame, render those between")
    commands.choices["views"].add_argument("--budgets", type=int, nargs="+", default=[15, 30, 60, 120])
    part = command("first", compare_first_frame)
    part.add_argument("--sequence", type=Path, help="sequence folder with true poses (default: two rooms)")
    part = command("forecast", compare_forecasts)
    part.add_argument("--rooms", type=int, default=4, help="rooms")
    part.add_argument("--picture", type=Path, help="PNG of the first room, one a decoder")
    return parser


if __name__ == "__main__":
    sys.exit(main())
