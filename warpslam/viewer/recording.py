"""A run as a recording for Rerun: a world, in it a camera, in that its images, over frames and time."""

from __future__ import annotations

import logging
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from warpslam.errors import MissingDependencyError, OutputError, WarpSlamError
from warpslam.evaluation import load_mesh
from warpslam.frames import FrameStatus
from warpslam.pipeline.observer import Observer
from warpslam.poses import vector_from_pose
from warpslam.viewer.loops import LOOP_COLOR, loop_lines, loops_of

if TYPE_CHECKING:
    from warpslam.camera import Intrinsics
    from warpslam.pipeline.methods import Method
    from warpslam.runs.record import Progress, RunResult
    from warpslam.sequences.base import Frame, RgbdSequence

log = logging.getLogger(__name__)

_WIDTH = 320  # [px], of images at most
_JPEG_QUALITY = 85
_COLORS = {FrameStatus.OK: (46, 134, 222), FrameStatus.LOST: (214, 48, 49), FrameStatus.SKIPPED: (225, 160, 20)}


class RerunRecording(Observer):
    """Writes what a run comes to into an ``.rrd`` file, which `rerun FILE` shows.

    ``world/camera`` is the pose, ``world/camera/image`` and ``world/camera/depth`` what it saw (at most 320 px wide),
    ``world/trajectory`` the path, ``world/keyframes`` theirs, ``world/loops`` a line between the two keyframes of each
    loop, ``world/mesh`` the mesh in the end; ``tracking/...`` are figures by frame. Timelines: ``frame`` (number in the
    sequence) and ``time``.

    Args:
        path: File to write.

    Raises:
        MissingDependencyError: rerun-sdk is not installed.
        OutputError: The file can't be written.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._rerun = _rerun()
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            self.path.open("wb").close()
        except OSError as error:
            raise OutputError(f"{self.path}: can't be written ({error.strerror}); choose another file") from error
        self._stream = self._rerun.RecordingStream("warpslam")
        self._stream.save(str(self.path))
        self._method: Any = None
        self._loops = np.zeros((0, 2, 3), np.float32)

    def begin(self, name: str) -> None:
        """The recording has the name of the sequence."""
        self._stream.send_recording_name(name)

    def ready(self, method: Method, sequence: RgbdSequence) -> None:
        """The cameras of the images: those of the sequence, at the size that is recorded."""
        self._method = method
        camera = sequence.intrinsics
        self._stride = -(-camera.width // _WIDTH)
        self._log_camera("world/camera/image", camera.strided(self._stride))
        self._log_camera("world/camera/depth", camera.strided(self._stride))

    def frame(self, progress: Progress) -> None:
        """Record a frame."""
        rr, stream, result, frame = self._rerun, self._stream, progress.result, progress.frame
        stream.set_time("frame", sequence=result.index if frame is None else frame.index)
        stream.set_time("time", duration=result.timestamp)
        vector = vector_from_pose(result.T_world_camera)
        quaternion = rr.Quaternion(xyzw=[*vector[1:4], vector[0]])
        stream.log("world/camera", rr.Transform3D(translation=vector[4:], quaternion=quaternion))
        if frame is not None:
            self._log_images(frame)
        trajectory = self._method.trajectory
        known = np.array([status == FrameStatus.OK for status in trajectory.status], dtype=bool)
        path = trajectory.poses[:, :3, 3][known]
        stream.log("world/trajectory", rr.LineStrips3D([path], colors=[_COLORS[FrameStatus.OK]]))
        keyframes = [keyframe.index for keyframe in getattr(self._method, "keyframes", [])]
        if keyframes:
            stream.log("world/keyframes", rr.Points3D(trajectory.poses[keyframes][:, :3, 3], radii=0.01))
        loops = loop_lines(loops_of(self._method), trajectory.poses[:, :3, 3])
        if not np.array_equal(loops, self._loops):
            self._loops = loops
            stream.log("world/loops", rr.LineStrips3D(loops, colors=[LOOP_COLOR]))
        stream.log("tracking/inliers", rr.Scalars(result.inliers))
        stream.log("tracking/frames_per_second", rr.Scalars(progress.fps))
        if progress.ate_rmse is not None:
            stream.log("tracking/ate_rmse_m", rr.Scalars(progress.ate_rmse))
        level = "INFO" if result.status == FrameStatus.OK else "WARN"
        stream.log("status", rr.TextLog(f"{result.status} {result.message}".strip(), level=level))

    def done(self, result: RunResult) -> None:
        """Record the mesh, which belongs to all frames."""
        if result.folder.mesh.is_file():
            try:
                mesh = load_mesh(result.folder.mesh)
            except WarpSlamError as error:
                log.warning("%s has no mesh: %s", self.path, error)
            else:
                colors = mesh.visual.vertex_colors
                archetype = self._rerun.Mesh3D(
                    vertex_positions=mesh.vertices, triangle_indices=mesh.faces, vertex_colors=colors
                )
                self._stream.log("world/mesh", archetype, static=True)
        self.close()

    def close(self) -> None:
        """Write what is still in memory."""
        self._stream.flush()
        self._stream.disconnect()

    def _log_camera(self, entity: str, camera: Intrinsics) -> None:
        rr = self._rerun
        pinhole = rr.Pinhole(
            image_from_camera=camera.matrix, width=camera.width, height=camera.height, camera_xyz=rr.ViewCoordinates.RDF
        )
        self._stream.log(entity, pinhole, static=True)

    def _log_images(self, frame: Frame) -> None:
        rr, stride = self._rerun, self._stride
        rgb = np.ascontiguousarray(frame.rgb[::stride, ::stride])
        self._stream.log("world/camera/image", rr.Image(rgb).compress(jpeg_quality=_JPEG_QUALITY))
        depth = np.nan_to_num(np.asarray(frame.depth, np.float32)[::stride, ::stride], posinf=0, neginf=0)
        millimetres = np.clip(np.rint(1000 * depth), 0, 65535).astype(np.uint16)
        self._stream.log("world/camera/depth", rr.DepthImage(millimetres, meter=1000.0))


def _rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise MissingDependencyError("--record needs the package rerun-sdk; type: pip install rerun-sdk") from error
    return rerun
