"""``warpslam render-room``."""

from __future__ import annotations

import argparse
from typing import Any

from PIL import Image

from warpslam.camera import Intrinsics
from warpslam.cli.common import add_command, add_device_option, quiet_warp
from warpslam.cli.progress import working
from warpslam.synthetic import (
    ALTERATIONS,
    GAP_KINDS,
    SEQUENCE_KINDS,
    altered,
    contact_sheet,
    make_sequence,
    write_sequence,
)

_FOCAL = 250.0 / 320.0
"""Focal length over width: a field of view of 65 degrees."""
_ROOMS = range(8)


def add(commands: Any) -> None:
    """Add the command with its parts."""
    room = commands.add_parser(
        "render-room",
        help="rendered rooms: RGB-D sequences with their truth, and pictures",
        description="Rendered rooms: RGB-D sequences with their truth, and pictures.",
    )
    parts = room.add_subparsers(title="what to render", required=True, metavar="WHAT")

    sequence = add_command(parts, "sequence", _sequence, "an RGB-D sequence with its truth, as a folder")
    sequence.add_argument("-o", "--output", required=True, metavar="DIR", help="folder; must not hold frames yet")
    sequence.add_argument("--kind", choices=SEQUENCE_KINDS, default="room", help="what happens in it (room)")
    sequence.add_argument("--frames", type=int, metavar="N", help="number of frames (by kind: 58 to 220)")
    sequence.add_argument("--size", type=_size, default=(320, 240), metavar="WxH", help="image size [px] (320x240)")
    sequence.add_argument("--seed", type=int, default=0, help="seed of the room, the path and the object (0)")
    sequence.add_argument("--gap", choices=GAP_KINDS, default="black", help="what becomes of lost frames (black)")
    sequence.add_argument(
        "--with",
        dest="alterations",
        choices=tuple(ALTERATIONS),
        nargs="+",
        default=[],
        metavar="WHAT",
        help="what goes wrong, one after another: " + ", ".join(ALTERATIONS),
    )
    add_device_option(sequence)

    sheet = add_command(parts, "sheet", _sheet, "a contact sheet of random rooms, as PNG")
    sheet.add_argument("-o", "--output", default="rooms.png", metavar="FILE", help="picture (rooms.png)")
    sheet.add_argument("--seeds", type=int, nargs="+", default=list(_ROOMS), help="rooms to draw (0 to 7)")
    sheet.add_argument("--views", type=int, default=3, metavar="N", help="colour images of a room (3)")
    add_device_option(sheet)


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.split("x"))
    except ValueError:
        raise argparse.ArgumentTypeError(f"{text!r} is no size like 320x240") from None
    return width, height


def _sequence(options: argparse.Namespace) -> int:
    quiet_warp()
    width, height = options.size
    focal = _FOCAL * width
    camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    with working("rendering frames"):
        made = make_sequence(
            options.kind, options.seed, options.frames, intrinsics=camera, gap=options.gap, device=options.device
        )
        sequence = altered(made, options.alterations)
        write_sequence(sequence, options.output)
    print(f"wrote {len(sequence)} frames; run them with")
    print(f"  warpslam run {options.output} --preset default --gt-mesh {options.output}/mesh.ply")
    return 0


def _sheet(options: argparse.Namespace) -> int:
    quiet_warp()
    with working("rendering rooms"):
        Image.fromarray(contact_sheet(options.seeds, views=options.views, device=options.device)).save(options.output)
    print(f"wrote {options.output}")
    return 0
