"""From the occupancy field to a coloured triangle mesh (supplement A.4): marching cubes over what was observed.

The lattice is metric and anchored at the world origin: point (i, j, k) lies at (i, j, k) * voxel. It is visited block
by block, so memory follows the block and the mesh, not the scene. Every quantity at a lattice point depends on that
point alone and every vertex is named by its lattice edge, therefore the mesh does not depend on the size of the blocks,
and vertices of neighbouring blocks merge exactly, without a distance threshold.

Lattice points are, by what the views say (`warpslam.meshing.views`),
    seen        observed by a view: the fine logit
    forecast    not observed, but in reach of a view: the coarse logit + 0.2, where a forecast is asked for
    unseen      the rest: `UNOBSERVED_LOGIT`, the paper's "zero occupancy"
A cell is meshed only if none of its 8 corners is unseen, so the border of what is known makes no surface; it belongs to
the forecast if one of its corners does.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
import trimesh
import warp as wp

from warpslam.camera import is_number
from warpslam.errors import InputError, MeshError
from warpslam.meshing.cleaning import Hull, face_vectors, keep_faces, piece_areas, vertex_normals
from warpslam.meshing.marching_cubes import Surface, all_corners, touched_points
from warpslam.meshing.views import Evidence
from warpslam.runtime.environment import free_gigabytes
from warpslam.runtime.phases import phase
from warpslam.scene.mapped_views import ObservedView

UNOBSERVED_LOGIT = -100.0
# What an observed point farther than the band from every surface holds: free, without asking the field.
FREE_LOGIT = -1.0
FORECAST_BIAS = 0.2
FORECAST_COLOR = (0, 255, 255, 255)
# A forecast goes no farther than what was seen goes around it.
_HULL_SCALE = 1.02
# Margins behind a surface: what faces the camera deeper than the first is a map's untrained inside, not a surface; the
# forecast's first surface behind a seen one lies at least as deep as the second. Both in multiples of behind_surface.
_FACING_MARGIN = 0.5
_SHADOW_MARGIN = 2.0
# A small piece stays where a view measured a surface this close [m] to at least this share of its area.
_MEASURED_DISTANCE = 0.04
_MEASURED_SHARE = 0.5

_SEEN, _FORECAST = 0, 1
_BLOCK_CELLS = 64
_QUERY_CHUNK = 131072
_MAX_BLOCKS = 100_000  # of _BLOCK_CELLS cubed cells each: an hour or so
_MIN_FREE = 0.25  # [GB]


class Field(Protocol):
    """What the mesher asks of a scene."""

    @property
    def bounds(self) -> tuple[Any, Any]:
        """Corners (lo (3,), hi (3,)) [m] of the region in which the field is defined."""

    def query_occupancy(self, points: np.ndarray, level: str = "fine") -> np.ndarray:
        """Occupancy logits (N,) float32 of world points (N, 3) float32 [m]; above 0 is occupied."""

    def query_color(self, points: np.ndarray) -> np.ndarray:
        """Colours (N, 3) float32 in [0, 1] of world points (N, 3) float32 [m]."""


@phase("meshing")
def extract_mesh(
    scene: Field,
    views: Sequence[ObservedView],
    *,
    voxel: float = 0.02,
    level_set: float = 0.0,
    min_component_area: float = 0.2,
    behind_surface: float = 0.1,
    band: float | None = 0.15,
    cull_back_faces: bool = True,
    forecast: bool = False,
    block_cells: int = _BLOCK_CELLS,
    device: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> trimesh.Trimesh:
    """Mesh of the observed part of the occupancy field, with colours and vertex normals (supplement A.4).

    Args:
        scene: Field to mesh.
        views: Depth images that say what was seen, usually the keyframes; a fraction of the resolution is enough.
        voxel: Lattice spacing [m].
        level_set: Logit of the surface; above is occupied.
        min_component_area: Connected pieces with less area [m^2] are dropped, unless views measured a surface within
            4 cm of half of it: what is seen through a lattice comes in small pieces, but so do floating artefacts.
        behind_surface: Points up to this far behind a measured surface [m] count as observed; at least two voxels are
            used.
        band: The field is asked only at points this close to a measured surface [m] (at least two voxels); other
            observed points are taken as free. None asks it at every observed point, which also shows floating
            artefacts.
        cull_back_faces: Drop faces that no observing view sees from the front: a map is untrained a few centimetres
            behind a surface and may turn free again there, which would make a second, inner shell.
        forecast: Add the surface that the coarse level suggests where nothing was seen, in cyan, as far as views reach
            and inside the convex hull of what they saw. The seen part of the mesh is the same as without.
        block_cells: Cells a block has along each axis. Trades memory for overhead; the mesh does not depend on it.
        device: Warp device of the seen test; None is Warp's default.
        progress: Called with (blocks done, blocks).

    Returns:
        A mesh in world metres whose normals point to free space; vertex colours are uint8 RGBA, and
        ``metadata["forecast_faces"]`` counts the faces of the forecast, which come last.

    Raises:
        MeshError: There is nothing to mesh, or the field is not finite.
        InputError: A bad argument.
    """
    _check_arguments(voxel, level_set, min_component_area, behind_surface, band, block_cells)
    behind = max(behind_surface, 2.0 * voxel)
    evidence = Evidence(views, behind, np.inf if band is None else max(band, 2.0 * voxel), device)
    lo, hi = _lattice_range(scene, evidence, voxel)
    surface = Surface(lo, hi, voxel)
    hull = Hull(evidence.cloud, _HULL_SCALE) if forecast else None
    found = _Found()
    blocks = list(_blocks(lo, hi, block_cells, evidence, hull, voxel))
    for done, block in enumerate(blocks):
        _mesh_block(scene, block, evidence, surface, voxel, level_set, found)
        free = free_gigabytes(wp.get_device("cpu")) if done % 16 == 15 else None
        if free is not None and free < _MIN_FREE:
            raise InputError(
                f"voxel = {voxel:g} m: memory runs out ({free:.2f} GB left) after {done + 1} of {len(blocks)} blocks: "
                "use a larger one"
            )
        if progress is not None:
            progress(done + 1, len(blocks))
    if found.observed_count == 0:
        raise MeshError(
            f"no lattice point was observed: the views and the scene bounds {_text(scene.bounds)} do not overlap, or "
            f"voxel = {voxel} m is larger than what was seen; check the poses and the depth scale"
        )
    vertices, faces, group = surface.merged()
    seen = faces[group == _SEEN]
    if len(seen) == 0:
        raise MeshError(
            f"no surface: {found.observed_count} lattice points were observed and the logits asked for lie in "
            f"[{found.least:.3g}, {found.most:.3g}], which does not cross level_set = {level_set} "
            "between observed neighbours; map more frames, use a smaller voxel, or change level_set"
        )
    if cull_back_faces:
        seen = _front_faces(vertices, seen, evidence)
    seen = seen[_is_surface(vertices, seen, evidence, min_component_area, voxel)]
    extra = faces[group == _FORECAST]
    if hull is not None and len(extra):
        extra = extra[hull.contains(vertices)[extra].any(axis=1) & ~_in_shadow(vertices, extra, evidence)]
        areas, _ = piece_areas(vertices, np.concatenate([seen, extra]))
        extra = extra[areas[len(seen) :] >= min_component_area]
    return _finished(scene, vertices, seen, extra)


@dataclass(frozen=True)
class _Block:
    """Part of the lattice."""

    start: np.ndarray
    """First index (3,)."""
    shape: tuple[int, int, int]
    """Points along each axis."""
    visible: np.ndarray
    """Views that may have observed some of it."""
    in_reach: np.ndarray | None
    """Views that it may be in reach of; None without a forecast."""


@dataclass
class _Found:
    """What the errors report."""

    observed_count: int = 0
    """Points that were observed."""
    least: float = np.inf
    """Smallest logit of those asked for."""
    most: float = -np.inf
    """Largest of them."""


def _mesh_block(
    scene: Field,
    block: _Block,
    evidence: Evidence,
    surface: Surface,
    voxel: float,
    level_set: float,
    found: _Found,
) -> None:
    """Add the triangles of a block to the surface."""
    start, shape = block.start, block.shape
    observed, near = evidence.classify(start, shape, block.visible, voxel)
    found.observed_count += int(np.count_nonzero(observed))
    cells = all_corners(observed)
    touched = touched_points(cells, shape)
    ahead = None
    if block.in_reach is not None:
        ahead = evidence.reached(start, shape, block.in_reach, voxel) & ~observed
        forecast_cells = all_corners(observed | ahead) & ~cells
        of_forecast = touched_points(forecast_cells, shape)
        touched |= of_forecast
    wanted = touched & observed & near
    logits = np.where(observed, np.float32(FREE_LOGIT + level_set), np.float32(UNOBSERVED_LOGIT))
    if wanted.any():
        points = ((np.argwhere(wanted) + start) * voxel).astype(np.float32)
        values = _query_occupancy(scene, points, "fine")
        found.least, found.most = min(found.least, float(values.min())), max(found.most, float(values.max()))
        logits[wanted] = values
        surface.add_block(logits, cells, start, level_set, _SEEN)
    if ahead is not None and (ahead & of_forecast).any():
        wanted = ahead & of_forecast
        points = ((np.argwhere(wanted) + start) * voxel).astype(np.float32)
        # The bias is on the paper's level set, 0: what moves the seen surface leaves the forecast where it is.
        logits[wanted] = _query_occupancy(scene, points, "coarse") + np.float32(FORECAST_BIAS + level_set)
        surface.add_block(logits, forecast_cells, start, level_set, _FORECAST)


@dataclass(frozen=True)
class BlockMesh:
    """The surface in a box of the lattice."""

    vertices: np.ndarray
    """Shape (V, 3) [m]."""
    faces: np.ndarray
    """Indices of vertices, shape (F, 3); normals point to free space."""
    colors: np.ndarray
    """RGBA of the vertices, uint8 (V, 4)."""


def mesh_of_block(
    scene: Field, evidence: Evidence, low: np.ndarray, high: np.ndarray, voxel: float, level_set: float
) -> BlockMesh | None:
    """The part of the surface in one block, without anything that `extract_mesh` decides by the whole.

    Args:
        scene: Field to mesh.
        evidence: What was seen.
        low: First lattice index (3,) int64.
        high: Last one.
        voxel: Lattice spacing [m].
        level_set: Logit of the surface.

    Returns:
        None where there is no surface, or it was seen from behind only.

    Raises:
        MeshError: The field is not finite.
    """
    visible = evidence.visible(low * voxel, high * voxel)
    if not len(visible):
        return None
    surface, x, y, z = Surface(low, high, voxel), *(int(n) for n in high - low + 1)
    _mesh_block(scene, _Block(low, (x, y, z), visible, None), evidence, surface, voxel, level_set, _Found())
    vertices, faces, _ = surface.merged()
    if not len(faces):
        return None
    normals = vertex_normals(vertices, faces)
    facing = evidence.facing(vertices, normals, -_FACING_MARGIN * evidence.behind)[faces].any(axis=1)
    if not facing.any():
        return None
    vertices, faces = keep_faces(vertices, faces, facing)
    return BlockMesh(vertices, faces, _query_colors(scene, vertices))


def _front_faces(vertices: np.ndarray, faces: np.ndarray, evidence: Evidence) -> np.ndarray:
    """The faces that some view sees from the front; raises `MeshError` if there is none."""
    # Half the margin: across a rounded solid, views see some of the far inside within the whole of it.
    normals = vertex_normals(vertices, faces)
    facing = evidence.facing(vertices, normals, -_FACING_MARGIN * evidence.behind)[faces].any(axis=1)
    if not facing.any():
        raise MeshError(
            f"all {len(faces)} faces were seen from behind only, so the field is inside out where it was observed; "
            "check the poses and the depth scale, or pass cull_back_faces=False to look at the faces"
        )
    return faces[facing]


def _is_surface(
    vertices: np.ndarray, faces: np.ndarray, evidence: Evidence, min_area: float, voxel: float
) -> np.ndarray:
    """Faces of pieces that are large or measured, bool (F,); raises `MeshError` if there is none."""
    centers, normals = vertices[faces].mean(axis=1), face_vectors(vertices, faces)
    distance = max(_MEASURED_DISTANCE, voxel)
    area, measured = piece_areas(vertices, faces, evidence.facing(centers, normals, -distance, distance))
    kept = (area >= min_area) | (measured >= _MEASURED_SHARE * area)
    if not kept.any():
        raise MeshError(
            f"no surface is left: the largest connected piece has {area.max():.3g} m^2, less than min_component_area "
            f"= {min_area} m^2, and no view measured a surface where the pieces are; map more frames or lower "
            "min_component_area"
        )
    return kept


def _in_shadow(vertices: np.ndarray, faces: np.ndarray, evidence: Evidence) -> np.ndarray:
    """Forecast faces close behind a seen surface that look at it, bool (F,).

    The fine level is untrained there and may be free; next to it, the forecast's solid would become a second wall.
    """
    centers, normals = vertices[faces].mean(axis=1), face_vectors(vertices, faces)
    return evidence.facing(centers, normals, -_SHADOW_MARGIN * evidence.behind, -_FACING_MARGIN * evidence.behind)


def _finished(scene: Field, vertices: np.ndarray, seen: np.ndarray, extra: np.ndarray) -> trimesh.Trimesh:
    """The mesh of the seen and the forecast faces, coloured."""
    of_seen = np.zeros(len(vertices), dtype=bool)
    of_seen[seen] = True
    faces = np.concatenate([seen, extra])
    used = np.unique(faces)
    of_seen = of_seen[used]
    vertices, faces = keep_faces(vertices, faces, np.ones(len(faces), dtype=bool))
    colors = np.tile(np.array(FORECAST_COLOR, dtype=np.uint8), (len(vertices), 1))
    colors[of_seen] = _query_colors(scene, vertices[of_seen])
    return trimesh.Trimesh(
        vertices=vertices,
        faces=faces,
        vertex_normals=vertex_normals(vertices, faces),
        vertex_colors=colors,
        process=False,
        metadata={"forecast_faces": len(extra)},
    )


def _lattice_range(scene: Field, evidence: Evidence, voxel: float) -> tuple[np.ndarray, np.ndarray]:
    """First and last lattice index (3,) int64 inside both the scene's bounds and the reach of the views."""
    scene_lo, scene_hi = (np.asarray(corner, dtype=np.float64) for corner in scene.bounds)
    if scene_lo.shape != (3,) or scene_hi.shape != (3,) or np.isnan([scene_lo, scene_hi]).any():
        raise MeshError(f"scene.bounds = {_text(scene.bounds)} must be two points of three numbers [m]")
    low, high = np.maximum(scene_lo, evidence.lo), np.minimum(scene_hi, evidence.hi)
    blocks = np.prod(np.maximum(high - low, 0.0) / (voxel * _BLOCK_CELLS) + 1.0)  # before anything becomes an integer
    if not blocks <= _MAX_BLOCKS:
        raise InputError(
            f"voxel = {voxel:g} m cuts {_text(np.maximum(high - low, 0.0))} m into {blocks * _BLOCK_CELLS**3:.2g} "
            f"cells, more than {_MAX_BLOCKS * _BLOCK_CELLS**3:.2g}: use a larger one"
        )
    lo, hi = np.ceil(low / voxel).astype(np.int64), np.floor(high / voxel).astype(np.int64)
    if (hi <= lo).any():
        raise MeshError(
            f"no lattice point was observed: the scene bounds {_text(scene.bounds)} hold no cell of {voxel} m within "
            f"the reach of the views {_text((evidence.lo, evidence.hi))}; check the poses and the depth scale"
        )
    return lo, hi


def _blocks(
    lo: np.ndarray, hi: np.ndarray, block_cells: int, evidence: Evidence, hull: Hull | None, voxel: float
) -> Iterator[_Block]:
    """Blocks that some view may have observed or, within the hull if there is one, reached. Faces are shared."""
    for i in range(int(lo[0]), int(hi[0]), block_cells):
        for j in range(int(lo[1]), int(hi[1]), block_cells):
            for k in range(int(lo[2]), int(hi[2]), block_cells):
                start = np.array([i, j, k], dtype=np.int64)
                end = np.minimum(start + block_cells, hi)
                box = start * voxel, end * voxel
                visible, in_reach = evidence.visible(*box), None
                if hull is not None and not hull.misses_box(*box):
                    in_reach = evidence.visible(*box, in_reach=True)
                if len(visible) or (in_reach is not None and len(in_reach)):
                    x, y, z = (int(n) for n in end - start + 1)
                    yield _Block(start, (x, y, z), visible, in_reach)


def _query_occupancy(scene: Field, points: np.ndarray, level: str) -> np.ndarray:
    """Logits (N,) float32 at points (N, 3); raises `MeshError` where the field is not finite."""
    parts = [points[n : n + _QUERY_CHUNK] for n in range(0, len(points), _QUERY_CHUNK)]
    logits = np.concatenate([np.asarray(scene.query_occupancy(part, level=level), dtype=np.float32) for part in parts])
    if logits.shape != (len(points),):
        raise MeshError(f"scene.query_occupancy returned shape {logits.shape} for {len(points)} points, expected (N,)")
    _check_finite(logits, points, "query_occupancy", "occupancy logits")
    return logits


def _query_colors(scene: Field, vertices: np.ndarray) -> np.ndarray:
    """Colours (V, 4) uint8 RGBA at the vertices; raises `MeshError` where the field is not finite."""
    points = vertices.astype(np.float32)
    parts = [points[n : n + _QUERY_CHUNK] for n in range(0, len(points), _QUERY_CHUNK)]
    colors = np.concatenate([np.asarray(scene.query_color(part), dtype=np.float32) for part in parts])
    if colors.shape != (len(points), 3):
        raise MeshError(f"scene.query_color returned shape {colors.shape} for {len(points)} points, expected (N, 3)")
    _check_finite(colors, points, "query_color", "colours")
    rgb = np.rint(np.clip(colors, 0.0, 1.0) * 255.0).astype(np.uint8)
    return np.concatenate([rgb, np.full((len(rgb), 1), 255, dtype=np.uint8)], axis=1)


def _check_finite(values: np.ndarray, points: np.ndarray, method: str, name: str) -> None:
    bad = ~np.isfinite(values.reshape(len(points), -1)).all(axis=1)
    if bad.any():
        where = points[np.argmax(bad)]
        raise MeshError(
            f"scene.{method} returned NaN or infinite {name} at {bad.sum()} of {len(points)} points, first at "
            f"{_text(where)} m: the map is damaged; mesh an earlier checkpoint or run again with lower learning rates"
        )


def _check_arguments(
    voxel: float, level_set: float, min_area: float, behind: float, band: float | None, block_cells: int
) -> None:
    for name, value, low_ok in (
        ("voxel", voxel, False),
        ("min_component_area", min_area, True),
        ("behind_surface", behind, True),
        ("band", 1.0 if band is None else band, False),
    ):
        if not is_number(value) or value < 0 or (value == 0 and not low_ok):
            raise InputError(f"{name} = {value!r} must be a finite number {'of at least' if low_ok else 'above'} 0")
    if not is_number(level_set):
        raise InputError(f"level_set = {level_set!r} must be a finite number")
    if not is_number(block_cells) or block_cells != int(block_cells) or block_cells < 1:
        raise InputError(f"block_cells = {block_cells!r} must be a whole number of at least 1")


def _text(values: Any) -> str:
    return np.array2string(np.asarray(values, dtype=np.float64), precision=3, separator=", ").replace("\n", "")
