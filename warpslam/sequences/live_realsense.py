"""A RealSense camera, through pyrealsense2; depth is registered to colour by its SDK."""

from __future__ import annotations

import numpy as np

from warpslam.camera import Intrinsics
from warpslam.errors import DatasetError, MissingDependencyError
from warpslam.sequences.live import LiveCamera, LiveImages


class RealSenseCamera(LiveCamera):
    """The first RealSense that is plugged in.

    Args:
        size: Width and height of both images [px].
        rate: Images a second.

    Raises:
        MissingDependencyError: pyrealsense2 is not installed.
        DatasetError: There is no camera, or not with these images.
    """

    def __init__(self, size: tuple[int, int] = (640, 480), rate: int = 30) -> None:
        try:
            import pyrealsense2 as rs
        except ImportError as error:
            raise MissingDependencyError("a RealSense needs pyrealsense2; type: pip install pyrealsense2") from error
        self._pipeline, config = rs.pipeline(), rs.config()
        config.enable_stream(rs.stream.depth, *size, rs.format.z16, rate)
        config.enable_stream(rs.stream.color, *size, rs.format.rgb8, rate)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise DatasetError(
                f"no RealSense with {size[0]} x {size[1]} at {rate} Hz ({error}); plug it into USB 3"
            ) from error
        self._align = rs.align(rs.stream.color)
        self._unit = float(profile.get_device().first_depth_sensor().get_depth_scale())
        k = profile.get_stream(rs.stream.color).as_video_stream_profile().get_intrinsics()
        self.intrinsics = Intrinsics(k.fx, k.fy, k.ppx, k.ppy, k.width, k.height)

    def read(self) -> LiveImages | None:
        """The next pair of images."""
        frames = self._align.process(self._pipeline.wait_for_frames())
        color, depth = frames.get_color_frame(), frames.get_depth_frame()
        # Its buffers are used again; times are in milliseconds.
        rgb = np.array(np.asanyarray(color.get_data()), dtype=np.uint8)
        metres = np.asanyarray(depth.get_data()).astype(np.float32) * np.float32(self._unit)
        return LiveImages(rgb, metres, float(color.get_timestamp()) * 1e-3)

    def close(self) -> None:
        """Stop the streams."""
        self._pipeline.stop()
