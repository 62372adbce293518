"""Meshes of the map (supplement A.4): extraction, forecast, cleaning, files. Importing this imports Warp."""

from warpslam.meshing.extraction import FREE_LOGIT, UNOBSERVED_LOGIT, Field, extract_mesh
from warpslam.meshing.files import check_mesh_path, write_mesh, write_points
from warpslam.meshing.simplification import point_cloud, simplified
from warpslam.scene.mapped_views import ObservedView

__all__ = [
    "FREE_LOGIT",
    "UNOBSERVED_LOGIT",
    "Field",
    "ObservedView",
    "check_mesh_path",
    "extract_mesh",
    "point_cloud",
    "simplified",
    "write_mesh",
    "write_points",
]
