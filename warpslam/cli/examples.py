"""What stands at the end of each help: commands as one types them."""

from __future__ import annotations

EXAMPLES: dict[str, tuple[str, ...]] = {
    "run": (
        "warpslam run scans/kitchen",
        "warpslam run recording.bag --topics /camera/color/image_raw,/camera/depth/image_rect_raw",
        "warpslam run scans/kitchen --preset live --view",
        "warpslam run scans/kitchen --frames 0:500:2 --set mapping.every=2 -o runs/mine",
        "warpslam run --resume runs/mine",
    ),
    "live": ("warpslam live realsense --view", "warpslam live record3d --max-frames 500 -o runs/desk"),
    "demo": ("warpslam demo", "warpslam demo --device cpu --view"),
    "batch": (
        "warpslam batch scans/kitchen scans/hall --workers 4 -o out",
        "warpslam batch --manifest list.yaml -o out",
    ),
    "bench": ("warpslam bench quick -o bench", "warpslam bench suite.yaml --data scans --list"),
    "check": (
        "warpslam check scans/kitchen",
        "warpslam check scans/kitchen --poses poses.txt --all",
        "warpslam check runs/kitchen/latest",
    ),
    "eval": (
        "warpslam eval runs/kitchen/latest",
        "warpslam eval runs/room/latest --gt-mesh mesh.ply --protocol all --views 20 --json",
    ),
    "report": ("warpslam report runs/kitchen/latest", "warpslam report runs/a runs/b -o both.html"),
    "view": ("warpslam view runs/kitchen/latest", "warpslam view runs/kitchen/latest --at 0.0.0.0:8080"),
    "render": (
        "warpslam render runs/kitchen/latest --frame 120",
        "warpslam render runs/kitchen/latest --path orbit --size 1280x720 -o film.mp4",
        "warpslam render runs/kitchen/latest --path poses.txt -o views.npz",
    ),
    "mesh": (
        "warpslam mesh runs/kitchen/latest --voxel 0.01 -o fine.glb",
        "warpslam mesh runs/kitchen/latest --faces 50000 --texture -o small.glb",
    ),
    "export": (
        "warpslam export runs/kitchen/latest euroc -o poses.csv",
        "warpslam export runs/kitchen/latest transforms -o scene",
    ),
    "calibrate-time": ("warpslam calibrate-time scans/kitchen", "warpslam calibrate-time scans/kitchen --write"),
    "profile": ("warpslam profile demo --trace trace.json", "warpslam profile scans/kitchen --frames 0:20"),
    "sequence": (
        "warpslam render-room sequence -o room",
        "warpslam render-room sequence --kind corridor --with kinect hand -o corridor",
    ),
    "sheet": ("warpslam render-room sheet -o rooms.png",),
    "warmup": ("warpslam warmup", "warpslam warmup --device sm_90"),
    "info": ("warpslam info", "warpslam info --preset replica", "warpslam info --settings"),
    "completion": ('eval "$(warpslam completion bash)"', "warpslam completion fish"),
}
"""By command."""


def epilog(command: str) -> str | None:
    """The end of a command's help; None where it has no examples."""
    lines = EXAMPLES.get(command)
    return None if lines is None else "examples:\n" + "\n".join(f"  {line}" for line in lines)
