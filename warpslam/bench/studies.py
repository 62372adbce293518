"""The studies: what is varied, which figures are shown, and which way they should go.

Numbers of tables and figures are the paper's (NICE-SLAM, CVPR 2022), letters those of its supplement.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from warpslam.field.complexity import field_flops
from warpslam.runs.request import DEFAULT_METHOD


@dataclass(frozen=True)
class Metric:
    """A figure of a run."""

    key: str
    """Name in files."""

    title: str
    unit: str
    digits: int = 2
    """After the point."""

    lower_is_better: bool = True
    is_reconstruction: bool = False
    """Holds under a culling protocol, and needs the true surface."""

    @property
    def heading(self) -> str:
        """Title and unit."""
        return f"{self.title} [{self.unit}]" if self.unit else self.title


METRICS = {
    metric.key: metric
    for metric in (
        Metric("accuracy", "accuracy", "cm", is_reconstruction=True),
        Metric("completion", "completion", "cm", is_reconstruction=True),
        Metric("ratio", "within 5 cm", "%", 1, lower_is_better=False, is_reconstruction=True),
        Metric("depth_l1", "depth L1", "cm", is_reconstruction=True),
        Metric("memory", "map", "MB"),
        Metric("ate", "ATE RMSE", "cm"),
        Metric("flops", "FLOPs a point", "1e3"),
        Metric("tracking", "tracking", "ms/frame", 0),
        Metric("mapping", "mapping", "ms/call", 0),
        Metric("after_gap", "error after the gap", "cm"),
        Metric("lost_after_gap", "lost after the gap", "%", 0),
        Metric("view_depth", "depth L1 of the view", "cm"),
        Metric("outside", "largest change outside the frustum", "", 6),
    )
}
"""Figures by their key."""


@dataclass(frozen=True)
class Variant:
    """One thing that a study compares."""

    name: str
    """As shown."""

    overrides: tuple[str, ...] = ()
    """Settings ``group.field=value``."""

    method: str = DEFAULT_METHOD
    """Of `warpslam.pipeline.methods.METHODS`."""

    position: float | None = None
    """Where a curve over the variants has it."""

    figures: Mapping[str, float] = field(default_factory=dict)
    """What is known without a run and takes the place of the run's figure."""


@dataclass(frozen=True)
class Expectation:
    """The way figures should go: ``better`` is better than ``worse`` in ``metric``, or exactly ``value``."""

    metric: str
    better: str
    worse: str | None = None
    value: float | None = None


@dataclass(frozen=True)
class Study:
    """A comparison of variants on the same sequences."""

    name: str
    """In suites and file names."""

    title: str
    """As shown."""

    source: str
    """Where the paper has it."""

    text: str
    """What is compared and how."""

    variants: tuple[Variant, ...]
    metrics: tuple[Metric, ...]
    expectations: tuple[Expectation, ...] = ()
    given_poses: bool = False
    """The true poses are given; otherwise the camera is tracked."""

    by_rendering: bool = False
    """What is compared concerns tracking against renders of the map: NICE-SLAM tracks so, by Gauss-Newton where the
    settings say direct.
    """

    probe: str | None = None
    """Measured besides the runs, see `warpslam.bench.probes`."""

    axis: str | None = None
    """What `Variant.position` is, of a study that is drawn as curves."""

    @property
    def needs_truth_mesh(self) -> bool:
        """Whether a figure compares surfaces."""
        return any(metric.is_reconstruction for metric in self.metrics)

    def variant(self, name: str) -> Variant:
        """The variant of that name."""
        return next(variant for variant in self.variants if variant.name == name)


def _metrics(*keys: str) -> tuple[Metric, ...]:
    return tuple(METRICS[key] for key in keys)


def _better(better: str, worse: str, *metrics: str) -> tuple[Expectation, ...]:
    return tuple(Expectation(metric, better, worse) for metric in metrics)


_SURFACE = ("accuracy", "completion", "ratio", "depth_l1")
_NICE, _IMAP, _TSDF = Variant("nice-slam"), Variant("imap", method="imap"), Variant("tsdf", method="tsdf")
# Table 4: "the same number of pixel samples". The paper leaves open how many iterations, so they are the same as well.
_SAME_WORK = (
    "tracking.optimizer=adam", "tracking.pixels=200", "tracking.iterations=10", "mapping.pixels=1000",
    "mapping.iterations=60", "imap.tracking_pixels=200", "imap.tracking_iterations=10", "imap.mapping_pixels=1000",
    "imap.rounds=3", "imap.iterations=20", "mapping.first_iterations=60", "imap.first_iterations=60",
    "mapping.color_refinement=false", "imap.refinement_rounds=0",
)  # fmt: skip
_FLOPS = field_flops()
_ONLY_LOW, _ONLY_HIGH = ("mapping.optimize_fine=false", "grid.fine_std=0"), ("mapping.optimize_middle=false",)
_MAPPING_ITERATIONS = (15, 30, 60, 120, 240)


def _mapping_iterations(name: str, count: int) -> Variant:
    return Variant(name, (f"mapping.iterations={count}",), position=count)


STUDIES = {
    study.name: study
    for study in (
        Study(
            "reconstruction",
            "Reconstruction",
            "Tables 1 and C",
            "Meshes against the true surface, poses given, and the memory of the map.",
            (_NICE, _IMAP, _TSDF),
            _metrics(*_SURFACE, "memory"),
            _better("nice-slam", "imap", *_SURFACE),
            given_poses=True,
        ),
        Study(
            "tracking",
            "Camera tracking",
            "Tables 2 and 3",
            "Error of the trajectory after rigid alignment.",
            (_NICE, _IMAP),
            _metrics("ate"),
            _better("nice-slam", "imap", "ate"),
        ),
        Study(
            "cost",
            "Cost",
            "Table 4",
            "Operations of a query, and time of a frame's tracking and of a mapping call. Both methods take 200 pixels "
            "and 10 iterations of Adam to track and 1000 pixels and 60 iterations to map; NICE-SLAM's mapping includes "
            "its coarse level. The first frame, which is mapped briefly, does not count.",
            (Variant("nice-slam", _SAME_WORK), Variant("imap", _SAME_WORK, "imap")),
            _metrics("flops", "tracking", "mapping"),
            _better("nice-slam", "imap", "flops", "tracking", "mapping"),
        ),
        Study(
            "color",
            "Colour",
            "Table 5",
            "Tracking and mapping with and without their colour terms.",
            (Variant("with colour"), Variant("without colour", ("mapping.color_weight=0", "tracking.color_weight=0"))),
            _metrics("ate"),
            _better("with colour", "without colour", "ate"),
            by_rendering=True,
        ),
        Study(
            "levels",
            "Levels of the grid",
            "Table A",
            "Poses given. With 2 levels the fine features stay at zero, and FLOPs are those of the decoders that are "
            "left. A fourth level would need a decoder that was trained for it, which there is none of: in its place "
            "stands a fine level of half the spacing, at the cost of three levels.",
            (
                Variant("2", _ONLY_LOW, figures={"flops": (_FLOPS["middle"] + _FLOPS["color"]) / 1e3}),
                Variant("3"),
                Variant("3, fine grid halved", ("grid.fine_spacing=0.08",)),
            ),
            _metrics("flops", "depth_l1", "accuracy", "completion", "ratio"),
            (*_better("2", "3", "flops"), *_better("3", "2", "accuracy", "ratio")),
            given_poses=True,
        ),
        Study(
            "mapping_iterations",
            "Mapping iterations",
            "Table B",
            "Poses given; iterations of a mapping call.",
            tuple(_mapping_iterations(str(count), count) for count in _MAPPING_ITERATIONS),
            _metrics("depth_l1", "accuracy", "completion", "ratio"),
            (*_better("60", "15", "depth_l1", "completion", "ratio"), *_better("240", "60", "depth_l1", "completion")),
            given_poses=True,
            axis="iterations a mapping call",
        ),
        Study(
            "mapping_iterations_tracked",
            "Mapping iterations and the trajectory",
            "Fig. C",
            "The camera is tracked; iterations of a mapping call.",
            tuple(_mapping_iterations(str(count), count) for count in _MAPPING_ITERATIONS),
            _metrics("ate"),
            _better("60", "15", "ate"),
            by_rendering=True,
            axis="iterations a mapping call",
        ),
        Study(
            "tracking_iterations",
            "Tracking iterations",
            "Fig. C",
            "Iterations of a frame's tracking against renders, with the optimiser of the settings.",
            tuple(Variant(str(n), (f"tracking.iterations={n}",), position=n) for n in (2, 4, 6, 12, 24)),
            _metrics("ate"),
            _better("6", "2", "ate"),
            by_rendering=True,
            axis="iterations a frame",
        ),
        Study(
            "hierarchy",
            "Hierarchy",
            "Fig. 9",
            "Whole maps at given poses, and the first frame alone: how the depth of its view approaches the measured "
            "one over the iterations. Only low: fine features stay at zero. Only high: middle features stay at their "
            "random initial values.",
            (Variant("both"), Variant("only low", _ONLY_LOW), Variant("only high", _ONLY_HIGH)),
            _metrics("view_depth", "accuracy", "completion", "depth_l1"),
            (
                *_better("both", "only low", "view_depth", "depth_l1"),
                *_better("both", "only high", "view_depth", "depth_l1"),
            ),
            given_poses=True,
            probe="convergence",
        ),
        Study(
            "frustum",
            "Frustum selection",
            "Fig. D",
            "Mapping with and without the rule that only vertices in the current frustum change. Besides the surface: "
            "the largest change that mapping calls after the first one made to a middle, fine or colour feature "
            "outside the frustum of their frame.",
            (Variant("on"), Variant("off", ("mapping.frustum_selection=false",))),
            _metrics("outside", *_SURFACE),
            (Expectation("outside", "on", value=0.0), *_better("on", "off", "outside", "accuracy", "depth_l1")),
            given_poses=True,
            probe="outside",
        ),
        Study(
            "frame_loss",
            "Frame loss",
            "B.1, Fig. B",
            "The longest stretch without a usable frame is the gap. The trajectory is put where its last frame before "
            "the gap agrees with the truth; the error is that of the frames after it, lost ones included.",
            (_NICE, Variant("no relocalisation", ("tracking.relocalization=false",)), _IMAP),
            _metrics("after_gap", "lost_after_gap"),
            (
                *_better("nice-slam", "imap", "after_gap"),
                *_better("nice-slam", "no relocalisation", "after_gap"),
            ),
            by_rendering=True,
        ),
        Study(
            "dynamic",
            "Moving objects",
            "Fig. 7",
            "An object moves through the view. In tracking, the filter leaves out pixels whose residual is far above "
            "the median (the paper's); in mapping, rays of keyframes that the current depth contradicts (ours).",
            (
                Variant("filter on", ("mapping.moved_margin=0.1",)),
                Variant("in tracking alone", ("mapping.moved_margin=0",)),
                Variant("filter off", ("tracking.dynamic_filter=0", "mapping.moved_margin=0")),
                _IMAP,
            ),
            _metrics("ate"),
            (*_better("filter on", "filter off", "ate"), *_better("filter on", "imap", "ate")),
            by_rendering=True,
        ),
    )
}
"""All studies by name, in the order in which they are shown."""
