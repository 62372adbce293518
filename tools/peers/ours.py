"""warpslam as the peers are run: tracking alone, and the same fusion as theirs at its poses."""

from __future__ import annotations

from tools.peers.recording import Account, Recording, fuse
from warpslam.config import Config
from warpslam.frames import FrameStatus
from warpslam.slam import Slam


def tracking(recording: Recording, account: Account, mesh: bool) -> None:
    """Poses as they are in the end, without a map; frames that are not OK are lost and are not fused."""
    sequence = recording.sequence
    with account.timed("setup"):
        config = Config.from_preset(sequence.preset, ["mapping.enabled=false"])
        slam = Slam(sequence.intrinsics, config, "cpu", timing=sequence.timing)
    with account.timed("tracking"):
        for number in range(len(recording)):
            frame = recording[number]
            slam.step(frame.rgb, frame.depth, frame.timestamp, depth_timestamp=frame.depth_timestamp)
        slam.finish()
    trajectory = slam.trajectory
    for pose, status in zip(trajectory.poses, trajectory.status, strict=True):
        account.add(pose, status is FrameStatus.OK)
    if mesh:
        with account.timed("mesh"):
            poses = account.world_poses()
            poses[account.lost] = float("nan")
            fuse(recording, poses, account.out / "mesh.ply")
