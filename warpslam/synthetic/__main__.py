"""``python -m warpslam.synthetic``: pictures of random rooms, and RGB-D sequences with exact ground truth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Iterable

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import InputError, WarpSlamError
from warpslam.synthetic.export import SEQUENCE_KINDS, make_sequence, write_sequence
from warpslam.synthetic.gap import GAP_KINDS
from warpslam.synthetic.sequence import DEFAULT_INTRINSICS, SyntheticSequence


def main(arguments: list[str] | None = None) -> int:
    """Parse the command line and write what it asks for; returns the exit code."""
    options = _parser().parse_args(arguments)
    try:
        options.command(options)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m warpslam.synthetic", description=__doc__)
    commands = parser.add_subparsers(title="commands", required=True, metavar="COMMAND")
    shared = {"formatter_class": argparse.ArgumentDefaultsHelpFormatter}

    sheet = commands.add_parser("sheet", help="a contact sheet of random rooms", **shared)
    sheet.set_defaults(command=_sheet)
    sheet.add_argument("--seeds", type=int, nargs="+", default=list(range(8)), help="rooms to draw")
    sheet.add_argument("--views", type=int, default=3, help="colour images per room")
    sheet.add_argument("--out", default="rooms.png", help="picture to write")

    sequence = commands.add_parser("sequence", help="an RGB-D sequence with its truth, as a folder", **shared)
    sequence.set_defaults(command=_sequence)
    sequence.add_argument("--kind", choices=SEQUENCE_KINDS, default="room", help="what happens in it")
    sequence.add_argument("--out", required=True, help="folder to write; must not hold frames yet")
    sequence.add_argument("--frames", type=int, help="number of frames (120, moving 100, gap 220)")
    sequence.add_argument("--size", type=_size, default=(320, 240), metavar="WxH", help="image size [px]")
    sequence.add_argument("--seed", type=int, default=0, help="seed of the room, the path and the object")
    sequence.add_argument("--gap", choices=GAP_KINDS, default="black", help="what becomes of lost frames")
    sequence.add_argument("--device", help="Warp device that renders")
    return parser


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size like 320x240") from None
    return width, height


def _sheet(options: argparse.Namespace) -> None:
    from PIL import Image

    Image.fromarray(contact_sheet(options.seeds, views=options.views)).save(options.out)
    print(f"wrote {options.out}")


def _sequence(options: argparse.Namespace) -> None:
    width, height = options.size
    # The field of view of the default camera, 65 degrees, at any size.
    focal = 250.0 * width / 320.0
    camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    sequence = make_sequence(
        options.kind, options.seed, options.frames, intrinsics=camera, gap=options.gap, device=options.device
    )
    write_sequence(sequence, options.out)
    print(f"wrote {len(sequence)} frames; run them with")
    print(f"  warpslam run {options.out} --preset default --truth-mesh {options.out}/mesh.ply")


if __name__ == "__main__":
    sys.exit(main())


def contact_sheet(
    seeds: Iterable[int],
    *,
    views: int = 3,
    intrinsics: Intrinsics = DEFAULT_INTRINSICS,
    depth_range: float = 6.0,
    device: str | None = None,
) -> np.ndarray:
    """One row per room: ``views`` colour images spread over its path, and the last one's depth.

    Args:
        seeds: Room seeds.
        views: Colour images per room.
        intrinsics: Camera.
        depth_range: Depth shown white [m]; missing depth is red.
        device: Warp device, None = Warp's default one.

    Returns:
        RGB image, uint8, shape (rooms * H, (views + 1) * W, 3).
    """
    rows = []
    for seed in seeds:
        sequence = SyntheticSequence(seed, 480, intrinsics=intrinsics, device=device)
        frames = [sequence[480 * view // views] for view in range(views)]
        depth = frames[-1].depth
        gray = np.repeat(np.clip(255 * depth / depth_range, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        gray[depth == 0] = (255, 0, 0)
        rows.append(np.concatenate([*[frame.rgb for frame in frames], gray], axis=1))
    if not rows:
        raise InputError("contact_sheet needs at least one seed")
    return np.concatenate(rows)
