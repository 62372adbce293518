"""Settings: validated groups with units, presets per dataset, yaml in and out.

Defaults are ours where a description names another value of the paper, and else the published ones for Replica
(released code; paper A.6).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Literal

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from warpslam.config.overrides import merge, parse_override
from warpslam.config.presets import PRESETS
from warpslam.errors import ConfigError, brief
from warpslam.reading import load_yaml, read_text

_LENGTH = re.compile(r"\[(m|m\^2)\]")
_FOLLOW_GIVEN_POSES = ("bundle_adjustment", "depth_start")  # of the mapping group, see `Config.resolved`


class _Group(BaseModel):
    model_config = ConfigDict(extra="forbid", validate_assignment=True, allow_inf_nan=False)


class GridConfig(_Group):
    """Feature grids (Sec. 3.1)."""

    coarse_spacing: float = Field(2.0, gt=0, description="vertex spacing of the coarse level [m]")
    middle_spacing: float = Field(0.32, gt=0, description="vertex spacing of the middle level [m]")
    fine_spacing: float = Field(0.08, gt=0, description="vertex spacing of the fine level [m]; the paper has 0.16")
    color_spacing: float = Field(0.08, gt=0, description="vertex spacing of the colour grid [m]; the paper has 0.16")
    middle_start: Literal["noise", "free"] = Field(
        "noise",
        description="middle features begin as noise (paper), or all as the one vector that the decoder reads as free "
        "space (A.2, which has it for one figure)",
    )
    coarse_std: float = Field(0.01, ge=0, description="standard deviation of the initial coarse features")
    middle_std: float = Field(0.01, ge=0, description="standard deviation of the initial middle features")
    fine_std: float = Field(0.0001, ge=0, description="standard deviation of the initial fine features")
    color_std: float = Field(0.01, ge=0, description="standard deviation of the initial colour features")
    layout: Literal["dense", "blocks"] = Field(
        "blocks",
        description="rows of the middle, fine and colour level: in blocks of 4 x 4 x 4 vertices where something was "
        "seen, so that memory follows that; or one for every vertex of the map's box (paper); same results until the "
        "final refinement with the direct loss",
    )
    margin: float = Field(0.6, gt=0, description="the map reaches this far beyond what was seen [m]")
    max_depth: float = Field(10.0, gt=0, description="measurements beyond this do not count [m]")
    max_gigabytes: float = Field(
        8.0, gt=0, description="refuse to grow the grids and their optimiser state beyond this [GB]"
    )


class SamplingConfig(_Group):
    """Samples along a ray (Sec. 3.2)."""

    stratified: int = Field(32, ge=2, le=256, description="samples between camera and exit")
    surface: int = Field(16, ge=2, le=256, description="samples within 5 % of the measured depth")
    jitter: bool = Field(
        True, description="random position inside each stratum (paper); even spacing (released code) tracks 5 x worse"
    )
    min_weight: float = Field(
        1e-4, ge=0, le=0.01, description="samples that weigh less need no colour (0 = exact): errs below samples x this"
    )
    min_gradient: float = Field(
        3e-5, ge=0, le=0.01, description="smaller derivatives of a ray's depth [m] by a logit are dropped (0 = exact)"
    )
    min_transmittance: float = Field(
        1e-4,
        ge=0,
        le=0.01,
        description="a ray ends where less light is left (0 = exact): its depth errs below this x its largest depth",
    )
    min_occupancy: float = Field(
        0.005, ge=0, le=0.1, description="pictures leave out samples where the map has no more than this (0 = exact)"
    )


class TrackingConfig(_Group):
    """Camera tracking (Sec. 3.3, Eq. 11-12)."""

    optimizer: Literal["direct", "adam", "gauss_newton"] = Field(
        "direct",
        description="direct registration against keyframes; or against renders of the map: Adam on the pose vector "
        "(paper), or Gauss-Newton on the same loss, reweighted",
    )
    pixels: int = Field(300, ge=16, le=100_000, description="rays per iteration")
    iterations: int = Field(6, ge=1, le=10_000, description="iterations per frame")
    learning_rate: float = Field(
        1e-3, gt=0, description="of the translation [m], and of the quaternion times rotation_rate_factor"
    )
    rotation_rate_factor: float = Field(
        1.0, gt=0, description="quaternion rate over translation rate; 0.2 = separate rates of the code"
    )
    final_rate_factor: float = Field(
        0.1, gt=0, le=1, description="learning rate of the last iteration over the first (1 = constant)"
    )
    color_weight: float = Field(0.5, ge=0, description="lambda_pt of Eq. 12")
    ignore_edge_u: int = Field(20, ge=0, description="columns left out on both sides [px]")
    ignore_edge_v: int = Field(20, ge=0, description="rows left out on both sides [px]")
    dynamic_filter: float = Field(
        10.0, ge=0, description="drop rays beyond this multiple of the median residual; 0 = off"
    )
    filter_by: Literal["depth", "loss"] = Field(
        "depth",
        description="the residual that dynamic_filter goes by: depth alone (released code), or the whole loss of "
        "Eq. 12, colour included (paper)",
    )
    median_includes_missing: bool = Field(
        False, description="rays without depth count in the median, as in the released code"
    )
    seen_only: bool = Field(
        True,
        description="only rays count that end where a mapped frame has measured something, for elsewhere the map is a "
        "guess; off = all rays (paper)",
    )
    coarse_term: bool = Field(
        False,
        description="rays that end where no mapped frame has measured anything get the coarse term of Eq. 11 (paper): "
        "the depth that the coarse level forecasts; needs optimizer adam, mapping.loss rendering and mapping.coarse, "
        "with 500 first iterations or more, for before these the coarse level is opaque",
    )
    constant_speed: bool = Field(True, description="start from the last motion instead of the last pose")
    keep_best: Literal["last", "fixed_pixels"] = Field(
        "fixed_pixels",
        description="final pose: the last one, or the best of start, last and mean on one fixed set of pixels",
    )
    use_given_poses: bool = Field(False, description="take T_world_camera as given: no tracking, no bundle adjustment")
    lost_depth_error: float = Field(
        0.15, gt=0, description="mean depth residual of the inliers beyond which tracking is lost [m]"
    )
    lost_inliers: float = Field(0.35, ge=0, le=1, description="share of inliers below which tracking is lost")
    recovery_factor: int = Field(5, ge=1, description="iterations and pixels grow by this when tracking is lost")
    max_step: float = Field(
        0.1, gt=0, description="a longer step a frame [m] is doubted, unless the last ones were nearly as long"
    )
    max_turn: float = Field(10.0, gt=0, description="the same for the turn a frame [degrees]")
    relocalization: bool = Field(True, description="a lost camera is looked for at the keyframes")
    relocalization_keyframes: int = Field(
        5, ge=1, description="keyframes tried a frame, those most like it in coarse grey and depth"
    )
    relocalized_depth_error: float = Field(
        0.05, gt=0, description="a pose found again errs less in depth than this [m], or 1.5 x what was usual before"
    )


class MappingConfig(_Group):
    """Mapping and local bundle adjustment (Sec. 3.3, Eq. 8-10)."""

    enabled: bool = Field(True, description="off: the camera is only tracked in a map that was loaded")
    every: int = Field(5, ge=1, description="map every n-th frame")
    pixels: int = Field(1000, ge=16, le=200_000, description="rays per iteration over all frames of the window")
    active_share: float = Field(
        0.5, ge=0, le=1, description="share of the rays drawn where the map errs in depth; 0 = all uniform (paper)"
    )
    window: int = Field(
        5, ge=1, le=64, description="frames optimised together: selected keyframes, the last one, the current frame"
    )
    selection: Literal["overlap", "global"] = Field(
        "overlap", description="keyframes of the window by overlap or at random"
    )
    first_iterations: int = Field(60, ge=1, description="iterations on the first frame; the paper's code has 1500")
    iterations: int = Field(15, ge=1, description="iterations on later frames; the paper's code has 60")
    middle_share: float = Field(0.4, ge=0, le=1, description="share of iterations after which the fine stage starts")
    fine_share: float = Field(0.6, ge=0, le=1, description="share of iterations after which the colour stage starts")
    middle_rate: float = Field(0.1, gt=0, description="learning rate of middle features in the middle stage")
    geometry_rate: float = Field(
        0.005, gt=0, description="learning rate of middle and fine features in the later stages"
    )
    color_rate: float = Field(0.005, gt=0, description="learning rate of colour features and of the colour decoder")
    coarse_rate: float = Field(0.001, gt=0, description="learning rate of coarse features")
    first_rate_factor: float = Field(
        5.0, gt=0, description="all grid and decoder rates grow by this on the first frame"
    )
    color_weight: float = Field(0.2, ge=0, description="lambda_p of Eq. 10")
    loss: Literal["direct", "rendering"] = Field(
        "direct",
        description="direct: every sample against the measured depth (group supervision), and whole rays in the final "
        "refinement; rendering: depth and colour of whole rays (paper)",
    )
    loss_reduction: Literal["sum", "mean"] = Field(
        "sum", description="of the rendering loss: sums over rays (released code) or means (Eq. 8-9)"
    )
    train_color_decoder: bool = Field(True, description="the colour decoder is optimised with the map")
    moved_margin: float = Field(
        0.0,
        ge=0,
        description="rays of keyframes that the current depth contradicts by this much are left out, for something has "
        "moved [m]; 0 = off (paper)",
    )
    depth_start: bool | None = Field(
        None,
        description="middle features that are seen for the first time start from the measured depth, not as noise "
        "(paper): completer maps, but a tracked camera may drift with it; empty = where poses are given",
    )
    optimize_middle: bool = Field(True, description="off: middle features stay as they began, for ablations (Fig. 9)")
    optimize_fine: bool = Field(True, description="off: fine features stay as they began, for ablations (Fig. 9)")
    frustum_selection: bool = Field(True, description="only vertices in the current frustum change (A.1)")
    frustum_margin: float = Field(0.5, ge=0, description="selected vertices reach this far behind the surface [m]")
    coarse: bool = Field(True, description="optimise the coarse level, which forecasts unseen geometry")
    coarse_iterations: int = Field(60, ge=1, description="iterations of the coarse level per mapping call")
    bundle_adjustment: bool = Field(True, description="refine the window's poses in the colour stage")
    bundle_adjustment_rate: float = Field(
        1e-3, ge=0, description="learning rate of the window's poses; the paper has 0 for Co-Fusion"
    )
    bundle_adjustment_filter: float = Field(
        5.0,
        ge=0,
        description="rays whose depth error exceeds this multiple of the median do not pull on poses, for the map is "
        "not formed there; 0 = all pull (paper)",
    )
    bundle_adjustment_keyframes: int = Field(5, ge=2, description="keyframes needed before poses are refined")
    color_refinement: bool = Field(True, description="refine the whole map after the last frame")
    refinement_rounds: int = Field(
        2,
        ge=1,
        description="rounds of the final refinement; more with the direct loss where keyframes would be left out",
    )
    refinement_iterations: int | None = Field(
        60, ge=1, description="iterations of such a round; empty = as many as `iterations`"
    )

    @property
    def refinement_frames(self) -> int:
        """Frames of a round of the final refinement, the last one included."""
        return 2 * self.window

    @property
    def refined_directly(self) -> int:
        """Iterations of the direct loss in such a round, where that is the loss, beside those of the rendering loss."""
        return round(0.7 * (self.refinement_iterations or self.iterations))

    def rounds_for(self, keyframe_count: int) -> int:
        """Rounds of the final refinement: with the direct loss so many that every keyframe takes part."""
        if self.loss == "rendering":
            return self.refinement_rounds
        return max(self.refinement_rounds, -(-keyframe_count // max(self.refinement_frames - 1, 1)))


class SupervisionConfig(_Group):
    """The direct loss of mapping (``mapping.loss: direct``): a logit of slope x signed distance in a band about the
    measured depth, and below that in front of it.
    """

    slope: float = Field(8.0, gt=0, description="logit by signed distance [1/m]")
    front: float = Field(0.1, gt=0, description="the band begins so far before the measured surface [m]")
    behind: float = Field(0.05, gt=0, description="and ends so far behind it [m]")
    behind_weight: float = Field(0.5, ge=0, le=1, description="weight of samples behind the surface")
    free_samples: int = Field(3, ge=1, le=64, description="samples of a ray before the band")
    edge_samples: int = Field(
        2, ge=0, le=64, description="of these, at the depth of pixels beside it, where that is smaller"
    )
    near_samples: int = Field(3, ge=1, le=64, description="samples of a ray in the band; one more lies at its depth")
    replay_share: float = Field(0.5, ge=0, lt=1, description="share of rays of earlier keyframes that see the same")
    young_updates: int = Field(
        20, ge=1, description="rays are drawn to where a vertex was updated less often than this"
    )
    middle_rate: float = Field(0.05, gt=0, description="learning rate of middle features")
    fine_rate: float = Field(0.02, gt=0, description="learning rate of fine features")
    color_rate: float = Field(0.01, gt=0, description="learning rate of colour features")
    decoder_rate: float = Field(0.003, gt=0, description="learning rate of the colour decoder, where it is trained")
    color_reach: float = Field(
        0.0, ge=0, description="samples get a colour so far from the surface [m]; 0 = that at the measured depth alone"
    )


class DirectConfig(_Group):
    """Direct registration against keyframes (``tracking.optimizer: direct``)."""

    grey_weight: float = Field(2.0, ge=0, description="weight of the photometric residual")
    depth_weight: float = Field(1.0, ge=0, description="weight of the geometric residual")
    grey_floor: float = Field(2.0, gt=0, description="photometric residuals spread by no less [grey values of 255]")
    depth_floor: float = Field(0.02, gt=0, description="geometric residuals spread by no less [sigma of depth]")
    joint: int = Field(3, ge=0, le=4, description="keyframes that a pose is registered to at once; 0 = the nearest")
    joint_iterations: int = Field(3, ge=1, le=20, description="iterations of that")
    map_weight: float = Field(
        0.0, ge=0, description="weight of a frame's points against the surface of the map, beside that of depth"
    )
    window: int = Field(7, ge=0, le=20, description="keyframes refined when one is added; 0 = none")
    window_iterations: int = Field(2, ge=1, le=20, description="iterations of that")
    window_features: bool = Field(
        True,
        description="whether features that these keyframes have in common join their refinement, once the camera's "
        "timing is known",
    )
    keyframe_overlap: float = Field(
        0.75, gt=0, lt=1, description="a frame becomes a keyframe where it shares less with the reference"
    )
    keyframe_step: float = Field(0.12, gt=0, description="or where it is further away, as a share of the mean depth")
    keyframe_turn: float = Field(12.0, gt=0, description="or where it has turned by more [degrees]")
    sure_agreement: float = Field(0.85, ge=0, le=1, description="share of depth that agrees, for a pose beyond doubt")
    sure_correlation: float = Field(0.88, ge=-1, le=1, description="correlation of grey values, for the same")
    sure_cost: float = Field(2.0, gt=1, description="robust cost over its running mean, for the same")
    sure_shift: float = Field(
        10.0, gt=0, description="shift of the image against what constant speed foretold, for the same [px of 80 x 60]"
    )
    lost_agreement: float = Field(0.5, ge=0, le=1, description="share of depth that agrees, for a pose to be believed")
    lost_correlation: float = Field(0.85, ge=-1, le=1, description="correlation of grey values, for the same")
    near_correlation: float = Field(
        0.6, ge=-1, le=1, description="the same where the pose is the one that constant speed foretold"
    )
    lost_view: float = Field(0.15, ge=0, le=1, description="share of the keyframe in view, for the same")
    lost_known: float = Field(0.08, ge=0, le=1, description="share of it where both have depth, for the same")
    timing: Literal["auto", "given"] = Field(
        "auto",
        description="auto: delay of depth and readout time are estimated while the camera moves, where depth has "
        "stamps of its own and the camera tells neither; given: what is not told is none",
    )
    search_span: float = Field(24.0, gt=0, le=60, description="rotations searched, up to this [degrees]")
    search_kept: int = Field(3, ge=1, le=20, description="rotations tried further")
    search_weak: bool = Field(True, description="search along the two motions that depth determines least, too")
    search_steps: int = Field(16, ge=1, le=64, description="steps of a pixel along these, both ways")
    feature_rows: Literal["doubt", "always", "never"] = Field(
        "never",
        description="frames where rows of sparse features join those of the images: those in doubt and those with a "
        "weakly determined direction, all (some 25 ms more a frame), or none",
    )
    relocalization_keyframes: int = Field(60, ge=1, description="latest keyframes that a lost camera is looked for at")


class LoopConfig(_Group):
    """Loops, with direct tracking: known places are recognised, and a pose graph mends what was drifted."""

    enabled: bool = Field(False, description="look for loops at each keyframe; needs the package gtsam")
    candidates: int = Field(1, ge=0, le=20, description="old keyframes that a new one is compared with by its words")
    places: int = Field(4, ge=0, le=20, description="keyframes that a lost camera is looked for at by its words")
    drift: float = Field(
        0.05,
        ge=0,
        description="drift that tracking is believed to be capable of, as a share of the way; a loop that asks for "
        "more is none",
    )
    drift_floor: float = Field(0.2, ge=0, description="and on no way at all [m]")
    turn_drift: float = Field(0.5, ge=0, description="the same as an angle, for a metre of way [degrees]")
    turn_floor: float = Field(5.0, ge=0, description="and on no way at all [degrees]")
    own_part_after: int = Field(
        10,
        ge=0,
        description="frames of a camera switched on in a map, in which it recognises nothing, after which it is mapped "
        "on its own, until a place is recognised; 0 = never",
    )
    remapping: float = Field(
        1.0, gt=0, description="iterations where the map is made anew, as a multiple of those that went into it"
    )


class KeyframeConfig(_Group):
    """Keyframe selection (Sec. 3.4)."""

    policy: Literal["interval", "information_gain"] = Field("interval", description="when a frame becomes a keyframe")
    every: int = Field(20, ge=1, description="interval policy: frames between keyframes; the paper's code has 50")
    known_share: float = Field(
        0.65, gt=0, lt=1, description="information gain: insert when the map explains less than this share of pixels"
    )
    known_error: float = Field(
        0.1, gt=0, description="information gain: a pixel is explained below this relative depth error"
    )
    max_gigabytes: float = Field(
        2.0, gt=0, description="images on the device [GB]; more keyframes than fit are kept compressed in host memory"
    )


class MeshingConfig(_Group):
    """Mesh extraction (A.4)."""

    voxel: float = Field(0.02, gt=0, description="edge of a marching-cubes cell [m]")
    level_set: float = Field(
        0.0,
        description="logit of the surface: 0 = occupancy 1/2 (paper); below that a map of few iterations of the "
        "rendering loss loses less of what was mapped for a short time",
    )
    min_component_area: float = Field(
        0.2, ge=0, description="smaller loose pieces are dropped [m^2], unless measured depth confirms them"
    )


class TsdfConfig(_Group):
    """Baseline: fusion of a truncated signed distance at given poses (``--method tsdf``)."""

    voxel: float = Field(0.02, gt=0, description="edge of a voxel [m]")
    truncation_voxels: float = Field(4.0, ge=1, le=32, description="distances are cut off at this many voxels")
    min_weight: int = Field(2, ge=1, description="frames that a voxel must be in to count in meshes and views")


class ImapConfig(_Group):
    """Baseline: iMAP as the authors of NICE-SLAM re-implemented it (``--method imap``).

    Lengths inside the network and its losses are metres times ``scale``. Image borders, sampling along rays, thresholds
    of a lost track and keyframes are those of the other groups.
    """

    scale: float = Field(0.1, gt=0, description="network units per metre")
    importance: int = Field(12, ge=4, le=64, description="samples drawn where the stratified ones found something")
    empty_samples: int = Field(
        16, ge=4, le=64, description="samples in front of the surface that should be empty; released code 32"
    )
    empty_weight: float = Field(5e-4, ge=0, description="weight of |density| at those samples")
    tracking_rate: float = Field(
        5e-4, gt=0, description="learning rate of the pose in the first iteration; tracking.final_rate_factor applies"
    )
    tracking_pixels: int = Field(150, ge=16, le=100_000, description="rays per tracking iteration; released code 5000")
    tracking_iterations: int = Field(12, ge=1, le=10_000, description="iterations per frame; released code 50")
    mapping_rate: float = Field(
        1e-3, gt=0, description="learning rate of the network, 0.8 times after every 200 steps; released code 2e-4"
    )
    mapping_pixels: int = Field(120, ge=16, le=200_000, description="rays per mapping iteration; released code 5000")
    first_iterations: int = Field(800, ge=1, description="iterations on the first frame; released code 1500")
    rounds: int = Field(3, ge=1, description="rounds of a mapping call, each with its own random window")
    iterations: int = Field(20, ge=1, description="iterations of a round on later frames; released code 100")
    refinement_rounds: int = Field(5, ge=0, description="rounds of 3 x iterations after the last frame")
    color_weight: float = Field(0.05, ge=0, description="weight of colour against depth in mapping")
    level_set: float = Field(10.0, gt=0, description="density of the surface in meshes")


class Config(_Group):
    """All settings of a run."""

    grid: GridConfig = Field(default_factory=GridConfig)
    sampling: SamplingConfig = Field(default_factory=SamplingConfig)
    tracking: TrackingConfig = Field(default_factory=TrackingConfig)
    direct: DirectConfig = Field(default_factory=DirectConfig)
    loops: LoopConfig = Field(default_factory=LoopConfig)
    mapping: MappingConfig = Field(default_factory=MappingConfig)
    supervision: SupervisionConfig = Field(default_factory=SupervisionConfig)
    keyframes: KeyframeConfig = Field(default_factory=KeyframeConfig)
    meshing: MeshingConfig = Field(default_factory=MeshingConfig)
    imap: ImapConfig = Field(default_factory=ImapConfig)
    tsdf: TsdfConfig = Field(default_factory=TsdfConfig)
    schedule: Literal["strict", "overlapped"] = Field(
        "strict",
        description="strict: mapping after tracking, runs repeat to the bit; overlapped: beside it, and the map is at "
        "most one mapping interval behind",
    )
    published_images: bool = Field(
        False, description="frames are resized and cropped as in the paper's code, where a dataset's camera says how"
    )
    sensor_timing: bool = Field(
        True,
        description="depth that is taken before or after colour, and rows that are taken one after the other, are "
        "corrected for where stamps or the camera tell; off = every pixel is taken at once (paper)",
    )
    scene_scale: float = Field(
        1.0,
        ge=1e-3,
        le=1e3,
        description="size of the scene beside that of a room: all settings that are lengths are multiplied by it; 0.1 "
        "suits an object on a table, 5 a hall",
    )
    decoders: str | None = Field(None, description="decoder checkpoint; the package's own when empty")

    @classmethod
    def from_dict(cls, values: dict[str, Any], source: str = "settings") -> Config:
        """Validate a nested dictionary.

        Raises:
            ConfigError: Names each field that does not fit and the accepted range.
        """
        try:
            return cls.model_validate(values)
        except ValidationError as error:
            raise ConfigError(f"{source}: " + "; ".join(map(_fault, error.errors()))) from None

    @classmethod
    def from_preset(cls, name: str = "default", overrides: Sequence[str] | None = None) -> Config:
        """Settings of a preset with ``overrides`` of the form ``group.field=value`` on top.

        Raises:
            ConfigError: Unknown preset, malformed override, or a value out of range.
        """
        if name not in PRESETS:
            raise ConfigError(f"preset {name!r} is unknown; choose one of {', '.join(sorted(PRESETS))}")
        values = _merged({}, PRESETS[name], *map(parse_override, overrides or []))
        return cls.from_dict(values, source="--set" if overrides else f"preset {name}")

    @classmethod
    def from_file(cls, path: str | Path, overrides: Sequence[str] | None = None) -> Config:
        """Settings of a yaml file, such as a run's config.yaml or what ``warpslam info --preset`` prints, with
        ``overrides`` of the form ``group.field=value`` on top. What the file leaves out is at its default.

        Raises:
            ConfigError: The file can't be read, is no yaml mapping, an override is malformed, or a value does not fit.
        """
        return cls.load(path).updated(overrides or [])

    def updated(self, overrides: Sequence[str]) -> Config:
        """These settings with overrides of the form ``group.field=value``.

        What `resolved` derived from given poses does not outlive them: without them it is back at its default, unless
        an override says otherwise.

        Raises:
            ConfigError: Malformed override, or a value out of range.
        """
        changes: dict[str, Any] = {}
        for override in overrides:
            merge(changes, parse_override(override))
        values = self.model_dump()
        tracked = Config.from_dict(_merged(values, changes)).tracking
        if self.tracking.use_given_poses and not tracked.use_given_poses:
            merge(values, {"mapping": {name: MappingConfig.model_fields[name].default for name in _FOLLOW_GIVEN_POSES}})
        elif self.tracking.optimizer == "direct" != tracked.optimizer:
            merge(values, {"mapping": {"bundle_adjustment": MappingConfig.model_fields["bundle_adjustment"].default}})
        return self.from_dict(_merged(values, changes))

    def resolved(self) -> Config:
        """These settings with all that follows from others written out: what a `Slam` runs with.

        Poses that are given stay as they are and can be believed, so there is no bundle adjustment, and new features
        start from the measured depth unless that is off. With direct registration the tracker refines keyframes itself.
        """
        given, mapping = self.tracking.use_given_poses, self.mapping
        derived = {
            "bundle_adjustment": mapping.bundle_adjustment and not given and self.tracking.optimizer != "direct",
            "depth_start": given if mapping.depth_start is None else mapping.depth_start,
        }
        return self.model_copy(update={"mapping": mapping.model_copy(update=derived)})._at_scale()

    def _at_scale(self) -> Config:
        """These settings with every length multiplied by ``scene_scale``, which is then 1."""
        scale = self.scene_scale
        if scale == 1.0:
            return self
        changes: dict[str, Any] = {"scene_scale": 1.0}
        for name, group in ((name, getattr(self, name)) for name in type(self).model_fields):
            if isinstance(group, _Group):
                fields = type(group).model_fields.items()
                units = {field: _LENGTH.search(info.description or "") for field, info in fields}
                powers = {field: 2 if unit[1] == "m^2" else 1 for field, unit in units.items() if unit}
                lengths = {field: getattr(group, field) * scale**power for field, power in powers.items()}
                changes[name] = group.model_copy(update=lengths)
        tracking, imap = changes["tracking"], changes["imap"]
        # The turn of a pose keeps its rate, and the network its units.
        factor = tracking.rotation_rate_factor / scale
        changes["tracking"] = tracking.model_copy(update={"rotation_rate_factor": factor})
        changes["imap"] = imap.model_copy(update={"scale": imap.scale / scale})
        return self.model_copy(update=changes)

    def with_files(self, decoders: str | None = None, poses: str | Path | None = None) -> Config:
        """These settings for a run that is given a decoder checkpoint, or a trajectory whose poses are taken as they
        are; None changes nothing.
        """
        tracking = self.tracking.model_copy(update={"use_given_poses": True}) if poses else self.tracking
        return self.model_copy(update={"decoders": decoders or self.decoders, "tracking": tracking})

    @classmethod
    def load(cls, path: str | Path) -> Config:
        """Read settings from a yaml file.

        Raises:
            ConfigError: The file can't be read, is no yaml mapping, or a value does not fit.
        """
        try:
            values = load_yaml(read_text(path))
        except OSError as error:
            raise ConfigError(f"{path}: can't be read ({error.strerror or error})") from None
        except ValueError as error:
            raise ConfigError(f"{path}: can't be read as yaml: {brief(error)}") from None
        if not isinstance(values, dict):
            raise ConfigError(f"{path}: expected a mapping of groups, found {type(values).__name__}")
        return cls.from_dict(values, source=str(path))

    def save(self, path: str | Path) -> None:
        """Write all settings as yaml; `from_file` reads them."""
        Path(path).write_text(self.to_yaml(), encoding="utf-8")

    def to_yaml(self) -> str:
        """All settings as yaml, group by group."""
        return yaml.safe_dump(self.model_dump(), sort_keys=False)


def _merged(*parts: dict[str, Any]) -> dict[str, Any]:
    values: dict[str, Any] = {}
    for part in parts:
        merge(values, part)
    return values


def _fault(error: Any) -> str:
    """One fault of settings, in words; a name that is nearly one of ours is corrected."""
    name = ".".join(map(str, error["loc"]))
    if error["type"] != "extra_forbidden":
        return f"{name}: {error['msg']} (got {error['input']!r})"
    kinds = {field: info.annotation for field, info in Config.model_fields.items()}
    known = [field for field, kind in kinds.items() if not (isinstance(kind, type) and issubclass(kind, _Group))]
    for field, kind in kinds.items():
        if isinstance(kind, type) and issubclass(kind, _Group):
            known += [f"{field}.{inner}" for inner in kind.model_fields]
    # A name without its group is as common as a slip of the pen.
    near = [option for option in known if option.rsplit(".", 1)[-1] == name.rsplit(".", 1)[-1]]
    near = near or difflib.get_close_matches(name, known, n=1)
    return f"no setting {name}" + (f"; did you mean {' or '.join(near)}?" if near else "")
