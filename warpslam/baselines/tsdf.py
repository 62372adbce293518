"""TSDF fusion at given poses (Curless & Levoy 1996; Newcombe et al. 2011): the classical map, without tracking.

Open3D's voxel block grid does the work: 16^3 voxels a block, blocks allocated along the measured surface only. A voxel
holds a truncated distance (float32), a weight and a colour (uint16 each, three channels): 12 bytes.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import cached_property
from typing import Any

import numpy as np
import trimesh

from warpslam.baselines.base import Baseline
from warpslam.camera import Intrinsics
from warpslam.config import Config
from warpslam.errors import InputError, MeshError, MissingDependencyError
from warpslam.field.rendering import RenderedImage
from warpslam.frames import AdmittedFrame, FrameResult
from warpslam.poses import check_transform
from warpslam.storage.state_file import StateFields, StateFormat
from warpslam.trajectory import Located

BLOCK_VOXELS = 16
BYTES_PER_VOXEL = 12
_ATTRIBUTES = {"tsdf": (np.float32, 1), "weight": (np.uint16, 1), "color": (np.uint16, 3)}
"""Type and channels of what a voxel holds."""
_FIRST_CAPACITY = 2000  # blocks; Open3D allocates more as they are needed


def import_open3d() -> Any:
    """The package open3d.

    Raises:
        MissingDependencyError: It is not installed, or lacks a system library.
    """
    try:
        import open3d
    except (ImportError, OSError) as error:
        raise MissingDependencyError(
            f"--method tsdf needs Open3D, which can't be loaded ({error}). Type: pip install open3d; on "
            "Debian and Ubuntu it needs libraries as well: apt-get install libusb-1.0-0 libgl1 libegl1"
        ) from error
    return open3d


class Tsdf(Baseline):
    """A truncated signed distance field fused from frames with known poses.

    Frames without a pose are skipped. Settings: `TsdfConfig`, and ``grid.max_depth``.
    """

    name = "tsdf"
    form = StateFormat("warpslam-tsdf", 2, "the map of a run with --method tsdf")

    def __init__(
        self, intrinsics: Intrinsics, config: Config | None = None, device: str | None = None, seed: int = 0
    ) -> None:
        """An empty volume.

        Args:
            intrinsics: Camera of all frames.
            config: Settings, `Config()` by default.
            device: "cpu" or "cuda:0"; by default the CPU, as the package's wheels come without CUDA.
            seed: Not used: fusion has no random choice.
        """
        super().__init__(intrinsics, config, device, seed)
        self._o3d = import_open3d()
        self.device = device or "cpu"
        core = self._o3d.core
        try:
            self._device = core.Device(self.device.upper() if ":" in self.device else f"{self.device.upper()}:0")
            self._grid = self._o3d.t.geometry.VoxelBlockGrid(
                ("tsdf", "weight", "color"), (core.float32, core.uint16, core.uint16), ((1,), (1,), (3,)),
                self.config.tsdf.voxel, BLOCK_VOXELS, _FIRST_CAPACITY, self._device,
            )  # fmt: skip
        except RuntimeError as error:
            raise InputError(f"device = {device!r}: Open3D can't use it ({error}); use cpu") from error
        self._camera = core.Tensor(intrinsics.matrix)

    def _step(self, frame: AdmittedFrame) -> FrameResult:
        if frame.given_pose is None:
            return self._skip(replace(frame, fault="no pose is given, and TSDF fusion can't track"))
        start = time.perf_counter()
        for name in ("_surface", "_scene"):
            self.__dict__.pop(name, None)
        image = self._o3d.t.geometry.Image
        depth_image = image(self._tensor(frame.depth))
        rgb_image = image(self._tensor(frame.rgb.astype(np.float32) / 255.0))
        # Open3D wants cameras on the CPU, whatever the device of the volume.
        extrinsic = self._o3d.core.Tensor(np.linalg.inv(frame.given_pose))
        limits = (1.0, self.config.grid.max_depth, self.config.tsdf.truncation_voxels)
        with self._quiet():
            blocks = self._grid.compute_unique_block_coordinates(depth_image, self._camera, extrinsic, *limits)
            self._grid.integrate(blocks, depth_image, rgb_image, self._camera, self._camera, extrinsic, *limits)
        self.history.add(frame.timestamp, Located(frame.given_pose))
        timings = {"mapping": time.perf_counter() - start}
        return FrameResult(frame.index, frame.timestamp, frame.given_pose, timings=timings)

    def finish(self) -> dict[str, float]:
        """Nothing is left to do."""
        return {}

    @property
    def block_count(self) -> int:
        """Blocks that hold something."""
        return int(self._grid.hashmap().size())

    @property
    def map_bytes(self) -> int:
        """Memory of the allocated blocks."""
        return self.block_count * BLOCK_VOXELS**3 * BYTES_PER_VOXEL

    @property
    def flops_per_point(self) -> None:
        """None: the map is looked up."""

    def _mesh(self, voxel: float | None) -> trimesh.Trimesh:
        """Zero crossing of the distance; the mesh has no other resolution than the volume."""
        if voxel is not None and voxel != self.config.tsdf.voxel:
            raise InputError(f"voxel = {voxel}: the volume has {self.config.tsdf.voxel} m; run with --set tsdf.voxel")
        vertices, faces, colors = self._surface
        rgb = np.rint(255.0 * colors).astype(np.uint8)
        return trimesh.Trimesh(vertices, faces, vertex_colors=rgb, process=False)

    def render(self, T_world_camera: np.ndarray, *, depth: np.ndarray | None = None, stride: int = 1) -> RenderedImage:
        """View of the mesh, every ``stride``-th pixel; black with depth 0 where nothing is hit. ``depth`` is not used.

        Rays are cast against the mesh and not with Open3D's cast through the voxels, which returns depths half a voxel
        short, and on its first call an image with holes.

        Raises:
            InputError: The volume is empty, or the pose is no rigid transform.
            MeshError: There is no surface.
        """
        T = check_transform(T_world_camera)
        if self.block_count == 0:
            raise InputError("the volume is empty: step at least one frame with a pose first")
        vertices, faces, colors = self._surface
        camera = self.intrinsics.strided(stride)
        v, u = np.mgrid[: camera.height, : camera.width]
        # Directions have length 1 along the camera's z axis, so that the way to a hit is its z-depth.
        directions = camera.backproject(u, v, 1.0) @ T[:3, :3].T
        rays = np.concatenate([np.broadcast_to(T[:3, 3], directions.shape), directions], axis=-1).astype(np.float32)
        hits = self._scene.cast_rays(self._o3d.core.Tensor(rays))
        z, face, uv = (hits[name].numpy() for name in ("t_hit", "primitive_ids", "primitive_uvs"))
        found = np.isfinite(z)
        corners = colors[faces[face[found]]]
        weights = np.concatenate([1.0 - uv[found].sum(axis=1, keepdims=True), uv[found]], axis=1)
        rgb = np.zeros((*z.shape, 3), np.float32)
        rgb[found] = np.einsum("nk,nkc->nc", weights, corners)
        return RenderedImage(np.where(found, z, np.float32(0.0)), rgb, np.zeros_like(z))

    @cached_property
    def _surface(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Vertices (V, 3) float32 [m], faces (F, 3), and colours in [0, 1] (V, 3) of the volume as it is."""
        min_weight = self.config.tsdf.min_weight
        if self.block_count == 0:
            raise MeshError("the volume is empty: step at least one frame with a pose first")
        with self._quiet():
            # Open3D wants more than its threshold.
            mesh = self._grid.extract_triangle_mesh(min_weight - 0.5).cpu()
        faces = mesh.triangle.indices.numpy() if "indices" in mesh.triangle else np.zeros((0, 3))
        if len(faces) == 0:
            raise MeshError(
                f"no surface in {self.block_count} blocks: fuse more frames or lower tsdf.min_weight (now {min_weight})"
            )
        return mesh.vertex.positions.numpy(), faces, np.clip(mesh.vertex.colors.numpy(), 0.0, 1.0)

    @cached_property
    def _scene(self) -> Any:
        vertices, faces, _ = self._surface
        scene = self._o3d.t.geometry.RaycastingScene()
        core = self._o3d.core
        scene.add_triangles(core.Tensor(vertices), core.Tensor(faces.astype(np.uint32)))
        return scene

    def _state(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        keys, rows = self._active()
        arrays = {name: self._grid.attribute(name)[rows].cpu().numpy() for name in _ATTRIBUTES}
        return {}, {"keys": keys.cpu().numpy(), **arrays}

    def _restore(self, state: StateFields) -> None:
        keys = state.array("keys", np.int32, (None, 3))
        edge = BLOCK_VOXELS
        values = [
            state.array(name, dtype, (len(keys), edge, edge, edge, channels))
            for name, (dtype, channels) in _ATTRIBUTES.items()
        ]
        if len(keys):
            self._grid.hashmap().insert(self._tensor(keys), [self._tensor(array) for array in values])

    def _active(self) -> tuple[Any, Any]:
        """Coordinates of the allocated blocks, and their rows in the attributes."""
        hashmap = self._grid.hashmap()
        rows = hashmap.active_buf_indices().to(self._o3d.core.int64)
        return hashmap.key_tensor()[rows], rows

    def _tensor(self, array: np.ndarray) -> Any:
        return self._o3d.core.Tensor(np.ascontiguousarray(array), device=self._device)

    @contextmanager
    def _quiet(self) -> Iterator[None]:
        """Keep Open3D's lines about buffers that grow out of the output; its errors stay."""
        utility = self._o3d.utility
        with utility.VerbosityContextManager(utility.VerbosityLevel.Error):
            yield
