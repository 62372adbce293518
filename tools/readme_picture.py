"""The strip on the first screen of README.md: a frame of a run, the map rendered at its pose, and the mesh from above.

    python -m tools.readme_picture runs/room room --frame 40 --eye 5.6,1.0,3.6 --target 1.6,5.2,0.8 --out strip.jpg

The mesh is seen from ``--eye`` towards ``--target``, in the sequence's world, whose z is up. Faces that turn away from
there are left out, so that a room is looked into from outside.
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

import numpy as np
import trimesh
from PIL import Image

from warpslam import Intrinsics, Slam, open_sequence
from warpslam.errors import WarpSlamError
from warpslam.synthetic import MeshRenderer, load_mesh, look_at

HEIGHT = 360  # [px] of the strip
GAP = 8  # [px] between its pictures
SUPERSAMPLING = 3
FIELD_OF_VIEW = 50.0  # [deg] of the view of the mesh, across
BACKGROUND = 255


def main(arguments: list[str] | None = None) -> int:
    """Write the strip; returns the exit status."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("run", type=Path, help="run folder")
    parser.add_argument("sequence", help="sequence folder that the run was made from")
    parser.add_argument("--frame", type=int, required=True, help="number of the frame in its sequence")
    parser.add_argument("--eye", type=_point, required=True, metavar="X,Y,Z", help="where the mesh is seen from [m]")
    parser.add_argument("--target", type=_point, required=True, metavar="X,Y,Z", help="what is looked at [m]")
    parser.add_argument("--out", default="strip.jpg", help="picture to write")
    options = parser.parse_args(arguments)
    try:
        frame = open_sequence(options.sequence)[options.frame]
        slam = Slam.load(options.run / "map.safetensors")
        times = slam.trajectory.timestamps
        pose = slam.trajectory.poses[int(np.abs(times - frame.timestamp).argmin())]
        rendered = slam.render(pose, depth=frame.depth)
        mesh = mesh_view(load_mesh(options.run / "mesh.ply"), options.eye, options.target)
    except WarpSlamError as error:
        print(f"error: {error}", file=sys.stderr)
        return 2
    rendering = np.rint(np.clip(rendered.rgb, 0, 1) * 255).astype(np.uint8)
    pictures = [Image.fromarray(picture) for picture in (frame.rgb, rendering, mesh)]
    strip(pictures).save(options.out, quality=88)
    print(f"wrote {options.out}")
    return 0


def mesh_view(mesh: trimesh.Trimesh, eye: np.ndarray, target: np.ndarray) -> np.ndarray:
    """The mesh from ``eye`` (3,), without the faces that turn away from there: uint8, (HEIGHT, 4/3 HEIGHT, 3)."""
    toward = np.einsum("ij,ij->i", mesh.face_normals, eye - mesh.triangles_center) > 0
    mesh = mesh.submesh([toward], append=True)
    width, height = SUPERSAMPLING * HEIGHT * 4 // 3, SUPERSAMPLING * HEIGHT
    focal = width / 2 / np.tan(np.radians(FIELD_OF_VIEW) / 2)
    camera = Intrinsics(focal, focal, (width - 1) / 2, (height - 1) / 2, width, height)
    rgb, depth = MeshRenderer(mesh, camera, max_depth=100.0).render(look_at(eye, target))
    image = np.where(depth[..., None] > 0, rgb, BACKGROUND).astype(np.float32)
    blocks = (HEIGHT, SUPERSAMPLING, HEIGHT * 4 // 3, SUPERSAMPLING, 3)
    return np.rint(image.reshape(blocks).mean(axis=(1, 3))).astype(np.uint8)


def strip(pictures: list[Image.Image]) -> Image.Image:
    """Pictures side by side, all ``HEIGHT`` high."""
    scaled = [p.resize((round(p.width * HEIGHT / p.height), HEIGHT), Image.Resampling.LANCZOS) for p in pictures]
    width = sum(p.width for p in scaled) + GAP * (len(scaled) - 1)
    result = Image.new("RGB", (width, HEIGHT), (BACKGROUND,) * 3)
    left = 0
    for picture in scaled:
        result.paste(picture, (left, 0))
        left += picture.width + GAP
    return result


def _point(text: str) -> np.ndarray:
    values = np.array([float(value) for value in text.split(",")])
    if values.shape != (3,):
        raise argparse.ArgumentTypeError(f"{text!r} is no point like 1,2,3")
    return values


if __name__ == "__main__":
    sys.exit(main())
