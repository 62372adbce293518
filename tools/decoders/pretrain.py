"""Pretrain the decoders on procedural rooms (supplement A.5): `train`, `average`, `quiet`, `evaluate`, `export`.

    python -m tools.decoders.pretrain train --out runs/pretraining --minutes 20
    python -m tools.decoders.pretrain average --out runs/mixed --start first.pth --other second.pth --share 0.35
    python -m tools.decoders.pretrain quiet --out runs/quiet --start runs/mixed/decoders.pth
    python -m tools.decoders.pretrain evaluate --out runs/pretraining --also other=some_decoders.pth
    python -m tools.decoders.pretrain export --out runs/pretraining --to warpslam/data/decoders.safetensors

`train` makes the room samples first, writes checkpoint.pt, decoders.pth, losses.png and log.txt to the folder, and
continues from checkpoint.pt where there is one. It uses a CUDA device if torch finds one, else the CPU.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import torch
from rich.console import Console
from rich.progress import BarColumn, Progress, TextColumn, TimeRemainingColumn

from tools.decoders import evaluation
from tools.decoders.quiet import quiet_fine_decoder
from tools.decoders.room_samples import HELD_OUT_SEED, SampleSizes, load_room, prepare_rooms
from tools.decoders.training import Trainer, TrainingConfig
from warpslam.errors import WarpSlamError
from warpslam.field.decoder_files import DEFAULT_PATH, load_decoders
from warpslam.field.decoders import random_decoders


def main(arguments: list[str] | None = None) -> int:
    """Run one command; returns the exit status."""
    options = _parser().parse_args(arguments)
    torch.set_num_threads(options.threads)
    try:
        return options.run(options)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2


def train(options: argparse.Namespace) -> int:
    """Train, or continue to train, for a number of minutes in all."""
    out: Path = options.out
    out.mkdir(parents=True, exist_ok=True)
    report = _logger(out / "log.txt")
    config = TrainingConfig(**{name: value for name, value in options.set})
    rooms = _rooms(options, range(options.rooms), report)
    start = load_decoders(options.start) if options.start else None
    trainer = Trainer(config, rooms, options.device, start)
    checkpoint = out / "checkpoint.pt"
    if checkpoint.exists():
        trainer.restore(checkpoint)
        report(f"continuing after {trainer.progress.elapsed / 60:.1f} min")
    report(f"device {options.device}, {len(rooms)} rooms, {options.minutes} min, {config}")

    def save(trainer: Trainer) -> None:
        trainer.save(checkpoint)
        trainer.weights().save(out / "decoders.pth")
        _plot(trainer.progress.history, out / "losses.png")

    with Progress(TextColumn("training"), BarColumn(), TimeRemainingColumn(), console=Console(stderr=True)) as bar:
        task = bar.add_task("training", total=60 * options.minutes, completed=trainer.progress.elapsed)

        def follow(message: str) -> None:
            report(message)
            bar.update(task, completed=trainer.progress.elapsed)

        trainer.run(options.minutes, save, follow, max_steps=options.max_steps)
    done = trainer.progress
    report(f"done: {done.encoder_steps} encoder steps, {done.episodes} episodes, {done.mapping_steps} mapping steps")
    return 0


def evaluate(options: argparse.Namespace) -> int:
    """Compare random, trained and other decoders on held-out rooms; writes evaluation.json and evaluation.md."""
    out: Path = options.out
    report = _logger(out / "log.txt")
    candidates = {"random": random_decoders(options.seed), "trained": load_decoders(out / "decoders.pth")}
    for name, path in options.also:
        candidates[name] = load_decoders(path)
    rooms = _rooms(options, range(HELD_OUT_SEED, HELD_OUT_SEED + options.rooms), report)
    budgets = tuple(options.budgets)
    settings = {"rays": options.rays, "factor": options.factor, "scale": options.scale, "device": options.device}
    result = evaluation.compare(candidates, rooms, budgets, **settings)
    if options.free_start:
        others = _rooms(options, range(HELD_OUT_SEED + 100, HELD_OUT_SEED + 102), report)
        for name, weights in list(candidates.items()):
            start = evaluation.free_space_feature(weights, others)
            named = {f"{name}, free-space start": weights}
            result |= evaluation.compare(named, rooms, budgets, start=start, **settings)
    (out / "evaluation.json").write_text(json.dumps(result, indent=1))
    (out / "evaluation.md").write_text(evaluation.table(result) + "\n")
    report(evaluation.table(result))
    return 0


def average(options: argparse.Namespace) -> int:
    """Average each tensor of two files, one of which was trained on from the other; writes decoders.pth."""
    first, second = load_decoders(options.start), load_decoders(options.other)
    levels = {}
    for mine, theirs in zip(first, second, strict=True):
        tensors = {
            name: ((1 - options.share) * array + options.share * theirs.tensors[name]).astype(np.float32)
            for name, array in mine.tensors.items()
        }
        levels[mine.level] = dataclasses.replace(mine, tensors=tensors)
    if options.coarse_from:
        levels["coarse"] = load_decoders(options.coarse_from).coarse
    options.out.mkdir(parents=True, exist_ok=True)
    dataclasses.replace(first, **levels).save(options.out / "decoders.pth")
    return 0


def quiet(options: argparse.Namespace) -> int:
    """Make the fine decoder silent at zero feature, from decoders in a file; writes decoders.pth."""
    options.out.mkdir(parents=True, exist_ok=True)
    report = _logger(options.out / "log.txt")
    rooms = _rooms(options, range(options.rooms), report)
    weights = quiet_fine_decoder(load_decoders(options.start), rooms, options.steps, report, seed=options.seed)
    weights.save(options.out / "decoders.pth")
    return 0


def export(options: argparse.Namespace) -> int:
    """Copy the trained decoders to a file of tensors alone, and read it back."""
    decoders = load_decoders(options.out / "decoders.pth")
    decoders.save(options.to)
    state, again = decoders.state_dict(), load_decoders(options.to).state_dict()
    assert all(np.array_equal(state[name], again[name]) for name in state)
    print(f"{options.to}: {len(state)} tensors, {options.to.stat().st_size} bytes")
    return 0


def _rooms(options: argparse.Namespace, seeds: range, report: Callable[[str], None]) -> list[dict[str, np.ndarray]]:
    start = time.monotonic()
    folder = options.data or options.out / "rooms"
    sizes = SampleSizes() if options.samples is None else SampleSizes(*options.samples)
    # In the order of seeds, whatever the order in which the workers finish: the seed decides what is drawn.
    files = sorted(path for _, path in prepare_rooms(folder, list(seeds), sizes, options.workers))
    report(f"{len(files)} rooms ready after {time.monotonic() - start:.0f} s")
    return [load_room(path) for path in files]


def _logger(path: Path) -> Callable[[str], None]:
    def report(message: str) -> None:
        print(message, flush=True)
        with path.open("a") as file:
            file.write(message + "\n")

    return report


def _plot(history: list[dict[str, float]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(1, 2, figsize=(11, 4))
    levels = ("coarse", "middle", "fine", "color")
    names = {1.0: levels, 2.0: tuple(f"{level}_depth" for level in levels)}
    titles = {1.0: "phase 1: cross entropy [nats], colour L1", 2.0: "phase 2: depth error at a stage's end [m]"}
    for axis, phase in zip(axes, names, strict=True):
        for name in names[phase]:
            rows = [row for row in history if row["phase"] == phase and name in row]
            if rows:
                window = max(1, len(rows) // 40)
                values = np.convolve([row[name] for row in rows], np.full(window, 1 / window), "valid")
                axis.plot([row["elapsed"] / 60 for row in rows][window - 1 :], values, label=name)
        axis.set(title=titles[phase], xlabel="minutes", yscale="log")
        if axis.lines:
            axis.legend()
    figure.tight_layout()
    figure.savefig(path, dpi=90)
    plt.close(figure)


def _setting(text: str) -> tuple[str, float | int]:
    name, _, value = text.partition("=")
    defaults = vars(TrainingConfig())
    if name not in defaults:
        raise argparse.ArgumentTypeError(f"no setting {name!r}; there are {', '.join(defaults)}")
    return name, type(defaults[name])(value)


def _named_file(text: str) -> tuple[str, Path]:
    name, separator, path = text.partition("=")
    if not separator:
        raise argparse.ArgumentTypeError(f"{text!r}: expected NAME=FILE")
    return name, Path(path)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    commands = parser.add_subparsers(required=True)
    shared = argparse.ArgumentParser(add_help=False)
    shared.add_argument("--out", type=Path, required=True, help="folder of the run")
    shared.add_argument("--data", type=Path, help="folder of the room samples (default: OUT/rooms)")
    shared.add_argument("--threads", type=int, default=os.cpu_count() or 1, help="CPU threads of torch")
    shared.add_argument("--workers", type=int, default=os.cpu_count() or 1, help="processes that make room samples")
    shared.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    shared.add_argument(
        "--samples", type=int, nargs=4, metavar="N", help="surface points, labelled points, cameras, rays of a room"
    )
    command = commands.add_parser("train", parents=[shared], help="train or continue")
    command.add_argument("--minutes", type=float, default=20.0, help="training time in all")
    command.add_argument("--rooms", type=int, default=120, help="rooms to train on, seeds 0, 1, ...")
    command.add_argument("--start", type=Path, help="decoders to start from (default: random)")
    command.add_argument("--max-steps", type=int, help="stop after so many steps of this call")
    command.add_argument("--set", type=_setting, action="append", default=[], help="NAME=VALUE of TrainingConfig")
    command.set_defaults(run=train)
    command = commands.add_parser("evaluate", parents=[shared], help="compare decoders on held-out rooms")
    command.add_argument("--also", type=_named_file, action="append", default=[], help="NAME=FILE of other decoders")
    command.add_argument("--rooms", type=int, default=4, help="held-out rooms")
    command.add_argument("--rays", type=int, default=200, help="rays of an iteration")
    command.add_argument("--factor", type=float, default=1.0, help="on learning rates; 5 as on a first frame")
    command.add_argument("--scale", type=float, default=1.0, help="on vertex spacings; 0.5 as for TUM RGB-D")
    command.add_argument(
        "--free-start", action="store_true", help="also start middle features at the mean one of free space"
    )
    command.add_argument("--budgets", type=int, nargs="+", default=[10, 30, 60, 120], help="mapping iterations")
    command.add_argument("--seed", type=int, default=0, help="seed of the random decoders")
    command.set_defaults(run=evaluate)
    command = commands.add_parser("average", parents=[shared], help="average two decoder files")
    command.add_argument("--start", type=Path, required=True, help="one file")
    command.add_argument("--other", type=Path, required=True, help="the other file, of the same widths")
    command.add_argument("--share", type=float, default=0.5, help="of the other file in the average")
    command.add_argument("--coarse-from", type=Path, help="take the coarse decoder from this file")
    command.set_defaults(run=average)
    command = commands.add_parser("quiet", parents=[shared], help="silence the fine decoder at zero feature")
    command.add_argument("--start", type=Path, required=True, help="decoders to start from")
    command.add_argument("--rooms", type=int, default=12, help="training rooms that are mapped for features")
    command.add_argument("--steps", type=int, default=1600, help="Adam steps")
    command.add_argument("--seed", type=int, default=0, help="seed of the draws")
    command.set_defaults(run=quiet)
    command = commands.add_parser("export", parents=[shared], help="write the package's file")
    command.add_argument("--to", type=Path, default=DEFAULT_PATH)
    command.set_defaults(run=export)
    return parser


if __name__ == "__main__":
    sys.exit(main())
