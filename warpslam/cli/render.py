"""``warpslam render``."""

from __future__ import annotations

import argparse
from typing import Any

from warpslam.cli.common import add_command, add_device_option, quiet_warp
from warpslam.cli.progress import working


def add(commands: Any) -> None:
    """Add the command."""
    text = "a frame beside what the map renders at its pose, or the mesh along a path as a film"
    render = add_command(commands, "render", _render, text)
    render.add_argument("run", metavar="RUN", help="run folder")
    what = render.add_mutually_exclusive_group(required=True)
    what.add_argument("--frame", type=int, metavar="N", help="number of the frame in its sequence")
    what.add_argument(
        "--path", metavar="PATH", help="orbit, trajectory, or a file of poses: views of the mesh along it"
    )
    render.add_argument("--size", type=_size, default=(1280, 720), metavar="WxH", help="of these views (1280x720)")
    render.add_argument("--fov", type=float, default=60.0, metavar="DEGREES", help="field of view across (60)")
    render.add_argument("--views", type=int, default=240, metavar="N", help="views of an orbit (240)")
    render.add_argument("--rate", type=float, default=30.0, metavar="HZ", help="images a second of a film (30)")
    add_device_option(render)
    render.add_argument(
        "-o", "--output", metavar="FILE",
        help="of a frame: PNG file (RUN/render_N.png); of a path: .mp4, .avi, .npz, or a folder for colour, depth and "
        "mask as PNG (RUN/film.mp4)",
    )  # fmt: skip


def _size(text: str) -> tuple[int, int]:
    try:
        width, height = (int(part) for part in text.lower().split("x"))
    except ValueError as error:
        raise argparse.ArgumentTypeError(f"{text!r} is not WIDTHxHEIGHT, for example 1280x720") from error
    return width, height


def _render(options: argparse.Namespace) -> int:
    from warpslam.runs.folder import RunFolder

    quiet_warp()
    folder = RunFolder.open(options.run)
    if options.frame is not None:
        from warpslam.pipeline.finished import render_frame

        with working("rendering the map"):
            path = render_frame(folder, options.frame, options.output, options.device)
        print(path)
        return 0
    from warpslam.pipeline.film import render_film

    with working("rendering views") as progress:
        path, count = render_film(
            folder,
            options.path,
            options.output,
            size=options.size,
            field_of_view=options.fov,
            frame_count=options.views,
            rate=options.rate,
            device=options.device,
            progress=progress,
        )
    print(f"{path}: {count} views")
    return 0
