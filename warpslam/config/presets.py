"""Settings by name: one preset a dataset, ours and the published ones."""

from __future__ import annotations

from typing import Any

# "paper_*" hold the released configurations (rotation_rate_factor 0.2 = "separate rates") with the paper's optimiser.
# The others are ours: direct tracking and the direct loss; BENCHMARK.md has what they reach.
_RENDERING: dict[str, Any] = {
    "loss": "rendering", "iterations": 60, "refinement_rounds": 5, "refinement_iterations": None,
}  # fmt: skip
_PAPER_SAMPLING: dict[str, Any] = {"jitter": False, "min_occupancy": 0.0}
_PAPER: dict[str, Any] = {"optimizer": "adam", "final_rate_factor": 1.0, "seen_only": False}


def _paper(tracking: dict[str, Any] | None = None, **groups: Any) -> dict[str, Any]:
    mapping = {
        **_RENDERING, "first_iterations": 1500, "active_share": 0.0, "depth_start": False,
        "bundle_adjustment_filter": 0.0,
        **groups.pop("mapping", {}),
    }  # fmt: skip
    return {
        "sampling": _PAPER_SAMPLING,
        "tracking": {**_PAPER, **(tracking or {})},
        "mapping": mapping,
        "keyframes": {"every": 50},
        "sensor_timing": False,
        "published_images": True,
        "grid": _PAPER_GRID,
        **groups,
    }


_PAPER_GRID = {"fine_spacing": 0.16, "color_spacing": 0.16, "layout": "dense"}
_BY_RENDERING: dict[str, Any] = {
    "grid": _PAPER_GRID,
    "mapping": {**_RENDERING, "first_iterations": 500},
    "meshing": {"level_set": -0.1},
}
_TUM_GRID = {"middle_spacing": 0.16, "fine_spacing": 0.08, "color_spacing": 0.08, "layout": "dense"}
PRESETS: dict[str, dict[str, Any]] = {
    "default": {},
    "live": {"mapping": {"every": 1, "iterations": 3}},
    "thorough": {"mapping": {"every": 1, "refinement_rounds": 6}},
    "rendering": _BY_RENDERING,
    "replica": {"tracking": {"ignore_edge_u": 100, "ignore_edge_v": 100}},
    "scannet": {},
    "apartment": {},
    "own": {},
    "seven_scenes": {},
    "cofusion": {"mapping": {"bundle_adjustment_rate": 0.0, "moved_margin": 0.1}},
    "icl": {},
    "tum_rgbd": {},
    "paper_replica": _paper({"pixels": 200, "iterations": 10, "ignore_edge_u": 100, "ignore_edge_v": 100}),
    "paper_scannet": _paper(
        {"learning_rate": 5e-4, "pixels": 1000, "iterations": 50}, mapping={"pixels": 5000, "window": 10}
    ),
    "paper_apartment": _paper(
        {"learning_rate": 3e-3, "pixels": 200, "iterations": 50}, mapping={"pixels": 5000, "window": 10}
    ),
    "paper_tum_rgbd": _paper(
        {"learning_rate": 1e-2, "rotation_rate_factor": 0.2, "pixels": 5000, "iterations": 200},
        mapping={"every": 1, "pixels": 5000, "window": 10},
        grid=_TUM_GRID,
    ),
    "paper_imap": {
        **_BY_RENDERING,
        "sensor_timing": False,
        "published_images": True,
        "sampling": _PAPER_SAMPLING,
        "keyframes": {"every": 50},
        "tracking": {"final_rate_factor": 1.0},
        "imap": {
            "tracking_pixels": 5000,
            "tracking_iterations": 50,
            "mapping_pixels": 5000,
            "mapping_rate": 2e-4,
            "empty_samples": 32,
            "first_iterations": 1500,
            "iterations": 100,
        },
    },
    "paper_cofusion": _paper(
        {"rotation_rate_factor": 0.2, "pixels": 200, "iterations": 10}, mapping={"bundle_adjustment_rate": 0.0}
    ),
}
