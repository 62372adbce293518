"""Record3D (iPhone): .r3d files, and the same unpacked: metadata, rgbd/0.jpg, rgbd/0.depth, rgbd/0.conf."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError, MissingDependencyError, brief
from warpslam.poses import pose_from_vector
from warpslam.reading import ARCHIVE_ERRORS, MEGABYTE, check_regular, read_bytes
from warpslam.sequences.base import Remark
from warpslam.sequences.calibration import find_calibration
from warpslam.sequences.files import typed_name
from warpslam.sequences.image_files import FILE_LIMIT, check_image_size, decode_image
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pairing import COMPLETE
from warpslam.sequences.pose_convention import OPENCV, OPENGL
from warpslam.sequences.recorder_files import from_matrix

_LZFSE_OVERHEAD = 4096  # [bytes]


class Record3dSequence(ImageSequence):
    """A recording of Record3D; depth is float metres, what has the lowest confidence is left out."""

    def __init__(self, path: Path, camera: str | None = None) -> None:
        self.path = path
        names, self._read = _source(path)
        try:
            metadata = json.loads(self._read("metadata" if "metadata" in names else "metadata.json"))
            K = np.array(metadata["K"], dtype=np.float64).reshape(3, 3).T
            size, rate = (int(metadata["w"]), int(metadata["h"])), float(metadata.get("fps") or 60.0)
            self._depth_size = (int(metadata.get("dw") or 192), int(metadata.get("dh") or 256))
            poses = [_pose(row) for row in metadata.get("poses", [])]
        except (OSError, ValueError, KeyError, TypeError, RecursionError, AttributeError) as error:
            raise DatasetError(
                f"{path}: can't be read as Record3D: its metadata has no K, w, h ({brief(repr(error))})"
            ) from error
        numbers = sorted(
            int(Path(n).stem) for n in names if n.startswith("rgbd/") and n.endswith(".jpg") and Path(n).stem.isdigit()
        )
        self._numbers = [number for number in numbers if f"rgbd/{number}.depth" in names]
        self._has_confidence = all(f"rgbd/{number}.conf" in names for number in self._numbers)
        remarks = []
        if len(self._numbers) < len(numbers):
            text = f"{len(numbers) - len(self._numbers)} of {len(numbers)} frames have no depth"
            remarks.append(Remark("association", text, COMPLETE))
        has_poses = bool(self._numbers) and len(poses) > max(self._numbers)
        times = np.asarray(metadata.get("frameTimestamps") or [], dtype=np.float64)
        indices = np.array(self._numbers, dtype=int)
        known = has_poses and len(times) > max(self._numbers) and bool((np.diff(times) > 0).all())
        super().__init__(
            typed_name(path),
            find_calibration(path, camera, None) if camera else from_matrix(K, size, f"metadata of {path}", 1.0),
            len(self._numbers),
            poses=np.array(poses)[indices] if has_poses else None,
            timestamps=times[indices] if known else indices / rate,
            remarks=remarks,
            same_view=True,
            conventions=(OPENGL, OPENCV),
        )

    def labels(self, index: int) -> tuple[str, str]:
        """Names of both images inside the recording."""
        number = self._numbers[index]
        return f"{self.path}: rgbd/{number}.jpg", f"{self.path}: rgbd/{number}.depth"

    def _stored_rgb(self, index: int) -> np.ndarray:
        import cv2

        data, label = self._read(f"rgbd/{self._numbers[index]}.jpg"), self.labels(index)[0]
        image = decode_image(data, cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION, label, self._check_color_size)
        if image is None:
            raise DatasetError(f"{label} is damaged; export the recording again")
        return np.ascontiguousarray(image[..., ::-1])

    def _stored_depth(self, index: int) -> np.ndarray:
        number, label = self._numbers[index], self.labels(index)[1]
        depth = self._unpacked(f"rgbd/{number}.depth", np.dtype("<f4"), label)
        if self._has_confidence:
            confidence = self._unpacked(f"rgbd/{number}.conf", np.dtype(np.uint8), label)
            depth = np.where(confidence > 0, depth, np.float32(0))
        return self.metres(depth)

    def _unpacked(self, name: str, dtype: np.dtype, label: str) -> np.ndarray:
        """An image that was compressed with LZFSE; upright or lying, as the colour images are."""
        try:
            import lzfse
        except ImportError as error:
            raise MissingDependencyError(
                f"{label}: Record3D needs the package lzfse; type: pip install lzfse"
            ) from error
        try:
            width, height = self._depth_size
            check_image_size(label, width, height)
            packed = self._read(name)
            # The package unpacks all there is; what is packed takes hardly more than what is not.
            if len(packed) > width * height * dtype.itemsize + _LZFSE_OVERHEAD:
                raise DatasetError(f"{label} has {len(packed)} bytes, more than {width} x {height} pixels take")
            data = np.frombuffer(lzfse.decompress(packed), dtype)
            return data.reshape(height, width)
        except Exception as error:  # noqa: BLE001  (lzfse.error is no public class in all versions)
            if isinstance(error, DatasetError):
                raise
            raise DatasetError(f"{label} is damaged ({brief(error)}); export the recording again") from error


def _source(path: Path) -> tuple[set[str], Callable[[str], bytes]]:
    """Names of the files of a recording, and what reads one of them."""
    if path.is_dir():
        names = {
            file.relative_to(path).as_posix() for file in (*path.glob("*"), *path.glob("rgbd/*")) if file.is_file()
        }

        def read_file(name: str) -> bytes:
            try:
                return read_bytes(path / name, FILE_LIMIT)
            except OSError as error:
                raise DatasetError(f"{path / name}: can't be read ({error.strerror})") from error

        return names, read_file
    try:
        check_regular(path)
        archive: Any = zipfile.ZipFile(path)
    except ARCHIVE_ERRORS as error:
        raise DatasetError(
            f"{path}: can't be read as .r3d, which is a zip archive ({error}); export it again"
        ) from error

    def read_member(name: str) -> bytes:
        try:
            size = archive.getinfo(name).file_size  # it unpacks no more, whatever is in it
            if size > FILE_LIMIT:
                raise DatasetError(
                    f"{path}: {name} has {size / MEGABYTE:.0f} MB, expected at most {FILE_LIMIT // MEGABYTE}"
                )
            return archive.read(name)
        except ARCHIVE_ERRORS as error:
            raise DatasetError(f"{path}: {name} is damaged or missing ({error}); export it again") from error

    return set(archive.namelist()), read_member


def _pose(row: list[float]) -> np.ndarray:
    qx, qy, qz, qw, *t = (float(value) for value in row)
    return pose_from_vector(np.array([qw, qx, qy, qz, *t]))
