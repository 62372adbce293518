"""The camera by direct registration against keyframes: which starts, which keyframes, and when a pose is believed.

A frame is registered to the reference keyframe from where constant speed foretells it. If the outcome is beyond doubt,
that is all; if not, the exhaustive search goes over rotations of the smallest images, over the motions that depth
leaves open and over zero motion, then to the frame before, then to older keyframes. An accepted pose is registered to
the keyframes of largest overlap at once. A frame that sees much else becomes a keyframe, and those around it are
refined together (`warpslam.tracking.direct.window`); frames hang on their keyframe and follow it.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Protocol

import numpy as np
import warp as wp

from warpslam.camera import NO_MOTION, FrameMotion, Intrinsics, TimingChange
from warpslam.config import DirectConfig
from warpslam.field.arrays import FieldArrays
from warpslam.frames import AdmittedFrame
from warpslam.kernels.direct import equations as eq
from warpslam.kernels.direct import points, registration
from warpslam.poses import inverse, motion_between, motion_of, orthonormalized, twist_of
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.keyframes import Keyframe
from warpslam.tracking.direct.aliases import difference_elsewhere
from warpslam.tracking.direct.joint_rows import (
    LINEARIZATIONS,
    SAME_STEP,
    WEAK_SIGMA,
    feature_rows,
    is_elsewhere,
    is_far,
    pair_rows,
    weakest_sigma,
)
from warpslam.tracking.direct.map_rows import MapRows
from warpslam.tracking.direct.measures import Measures
from warpslam.tracking.direct.pyramid import PyramidPlan, records
from warpslam.tracking.direct.registrar import MOST_NEAR, Floors, Registrar, new_tasks
from warpslam.tracking.direct.second import Picture, SecondWitness
from warpslam.tracking.direct.window import PairRows, Pose, refine_window
from warpslam.tracking.features.witness import Witness
from warpslam.trajectory import TWIST_STEPS, FrameHistory, Located

RECENT = 4
"""Rows of images for frames that are no keyframes (yet)."""
CACHED = 24
"""Rows of images of keyframes; those of others are built anew when they are wanted."""
MIN_OVERLAP = 0.35
"""Of a keyframe in the joint registration."""
NEAR_KEYFRAMES = MOST_NEAR
"""Keyframes, the nearest by pose, whose overlap is looked at."""
DEGREE = 0.02
"""Metres that a degree counts for when keyframes are ordered by nearness."""
BRIDGE = 5
"""Frames without a pose over which constant speed is still believed."""
MAX_GAP = 10
"""Frames after which a camera that was lost may be anywhere."""
MAX_MOTION = 0.3, 30.0
"""A frame [m], [degrees]; more is believed where the last steps were nearly as long."""
FOUND_AGREEMENT, FOUND_CORRELATION, FOUND_KNOWN = 0.75, 0.9, 0.25
"""What a place found again must reach."""
BACK_CORRELATION, FOUND_BACK_CORRELATION = 0.5, 0.8
"""Of grey values, looked at from the frame, for any pose and for that of a place found again: less than the other way,
since it is on small images, where thin lines are lost (0.55 at least on right poses of seven sequences).
"""
PLAIN, PLAIN_BACK_CORRELATION = 2.0, 0.35
"""Where constant speed foretold a pose and grey values fit it to this multiple of their noise, there is little that
could correlate: a camera over a plain floor has 0.45.
"""
CONFIRMATIONS = 3
"""Frames that must follow before a place found again is believed."""
UNIQUE = 1.5
"""Another place that costs less than this multiple of the best is as likely."""
TELLING = 0.7
"""What a frame must differ from itself elsewhere, as a mean robust cost; a plain tiled wall has 0.2 to 0.6, one with
pictures on it 0.9 and more.
"""
WITNESS_KEYFRAMES = 3
"""Keyframes whose features a frame is matched with."""
DIFFERENT_STEP, DIFFERENT_TURN = 0.03, 1.5
"""Two answers that are further apart [m], [degrees] contradict each other."""
DECISIVE = 0.7
"""Another pose than the one foretold must cost less than this multiple of what that one costs."""
NEAR_SHIFT = 2.0
"""What moves less against what was foretold [px of the middle level] need not look as much alike."""
SHIFT_PRICE = 0.02
"""Growth of the cost of a pose by each pixel that it is away from what was foretold."""
VARIANCE_FACTOR, DISAGREEMENT = 50.0, 4.0
"""Of the covariance: what the normal matrix says times the first, and the second times what keyframes disagree by. On
eleven rendered sequences 98 % of true errors lie within two sigma, 91 % on the worst; 93 and 88 % on two of a Kinect.
"""
MAX_SIGMA = 0.05
"""Standard deviation [m] beyond which a direction is left open, as the normal matrix alone has it."""
LEAST_COST = 0.5
"""A registration that costs less needs no comparison with others."""
SEARCH_WIDE, SEARCH_DEEP = 6, 3
"""Starts refined at the middle level, and of these at the largest."""
UNTOLD = np.diag([1e-4] * 3 + [1e-4] * 3)
"""Covariance (6, 6) of a frame against its keyframe where it was not kept: 1 cm, half a degree."""
GIVEN = np.zeros((6, 6))
"""Covariance of poses that are given."""
SCRATCH = 0
"""Row of points that hold no keyframe's."""


@dataclass(frozen=True)
class Attempt:
    """A frame registered to a keyframe."""

    keyframe: int
    """Its number."""
    T_frame_keyframe: np.ndarray
    """float64 (4, 4)."""
    exposure: np.ndarray
    """Gain and bias (2,)."""
    cost: float
    """Mean robust cost, by which attempts are compared."""
    measures: Measures
    """At the level where poses are judged."""
    grey_scale: float
    """Spread of the photometric residuals [grey values]."""
    depth_scale: float
    """Spread of the geometric residuals at the largest level [sigma of depth]."""
    ok: bool = True
    back: Measures | None = None
    """The keyframe in the frame's points, the other way round."""
    moved: float = 0.0
    """How far the image moved from the start [px of the middle level]."""


_Start = tuple[float, np.ndarray, np.ndarray]
"""Cost, T_frame_keyframe (4, 4), and exposure (2,) of a start."""


@dataclass(frozen=True)
class _Anchor:
    """The keyframe that a frame hangs on."""

    keyframe: int
    T_keyframe_frame: np.ndarray


@dataclass(frozen=True)
class Followed:
    """A frame registered to all keyframes of large overlap."""

    attempt: Attempt
    """Its registration to the reference."""
    T_frame_reference: np.ndarray
    """float64 (4, 4)."""
    seen: Measures
    """How well it fits the reference at the largest level."""
    depth_error: float
    """Spread of depth against the reference [m]."""
    covariance: np.ndarray
    """Of the pose, as a twist (v, w) in the frame's axes [m, rad], float64 (6, 6), from the normal matrix."""

    @property
    def whole_covariance(self) -> np.ndarray:
        """The same with what the residuals of a pair can't tell, such as a sensor's bias: it shows where several
        keyframes say something else than one.
        """
        apart = twist_of(orthonormalized(self.attempt.T_frame_keyframe @ inverse(self.T_frame_reference)))
        return self.covariance + DISAGREEMENT**2 * np.outer(apart, apart)


@dataclass(frozen=True)
class _Found:
    """A place that was found after a loss and is not confirmed yet."""

    pose: np.ndarray
    motion: np.ndarray
    """Since the frame before."""
    count: int
    """Frames that agree."""

    @property
    def starts(self) -> list[np.ndarray]:
        """Where the camera may be in the next frame."""
        return [self.pose @ self.motion, self.pose]


@dataclass(frozen=True)
class _Before:
    """The last frame that was OK, as it may yet become a keyframe."""

    index: int
    rgb: np.ndarray
    depth: np.ndarray
    kept: tuple[np.ndarray, np.ndarray, float] | None
    """Its images as the pool held them; None where they are on a GPU."""

    @property
    def picture(self) -> Picture:
        """The frame as it comes back from a file."""
        found = Picture(self.rgb, self.depth) if self.kept is None else Picture.of(*self.kept)
        return replace(found, index=self.index)


@dataclass(frozen=True)
class DirectState:
    """All that the next frame depends on beside poses and images, for N frames."""

    anchors: np.ndarray
    """Keyframe that a frame hangs on, -1 = none, int64 (N,)."""
    relative: np.ndarray
    """T_keyframe_frame, float64 (N, 4, 4)."""
    overlap: np.ndarray
    """Share of each keyframe that the last frame sees, float64 (keyframes,); -1 = not looked at."""
    reference: int
    """Keyframe that frames are registered to."""
    before: int
    """The last frame that was OK, -1 = none."""
    found: np.ndarray
    """A place that is not confirmed yet: its pose and the motion there, float64 (2, 4, 4)."""
    confirmed: int
    """Frames that agree with it; 0 = there is no such place."""
    motion: np.ndarray
    """How the camera moved while it took the last frame, as `FrameMotion.to_array` has it, float64 (8,)."""
    depth_sigma: float
    """What the second witness has learnt of depth [1/m]."""
    typical: tuple[float, float]
    """Running means of the photometric scale and of the cost; infinite = none yet."""

    def arrays(self) -> dict[str, np.ndarray]:
        """Those that are arrays, by name."""
        return {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray)}


class Hooks(Protocol):
    """What closing of loops hears of tracking, and tells it."""

    def link(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        """Two keyframes were registered to each other: T_i_j (4, 4), uncertain by exp(e) on its right, e = (v, w);
        covariance (6, 6).
        """

    def refined(self, window: Sequence[int]) -> None:
        """Keyframes were refined together, and `link` was told of their pairs."""

    def serves_again(self, old: int, reference: int) -> bool:
        """Whether a keyframe that is seen again may become the reference after another, or a new one is wanted."""

    def places(self, picture: Picture) -> list[int]:
        """Keyframes that a frame of which nothing is known may be at, the likeliest first."""


class DirectTracker:
    """Finds the pose of the frame in slot 0 of the image pool, and makes keyframes.

    Args:
        camera: Camera of all frames.
        config: Settings.
        max_depth: Depth beyond this is not used [m].
        device: Where it computes.
        keyframes: The list that keyframes are added to.
        images: Where their images are kept.
    """

    def __init__(
        self,
        camera: Intrinsics,
        config: DirectConfig,
        max_depth: float,
        device: wp.Device,
        keyframes: list[Keyframe],
        images: ImagePool,
        readout: float = 0.0,
    ) -> None:
        self.camera, self.config, self.device = camera, config, device
        self.keyframes, self.images, self.readout = keyframes, images, readout
        self.plan = PyramidPlan.of(camera)
        floors = Floors(config.grey_floor, config.depth_floor)
        self.registrar = Registrar(self.plan, RECENT + CACHED, max_depth, floors, device)
        self._row_of: OrderedDict[int, int] = OrderedDict()  # by frame, the one used longest ago first
        self._anchors: list[_Anchor | None] = []
        self._motions: dict[int, FrameMotion] = {}  # of the latest frames
        self._smallest: list[np.ndarray] = []
        self._mean_depth: list[float] = []
        self._overlap: dict[int, float] = {}  # with the last frame, by keyframe
        self._reference = 0
        self._typical_scale = np.inf
        self._typical_cost = np.inf
        self._before: _Before | None = None
        self._found: _Found | None = None
        self._foretold: np.ndarray | None = None  # by constant speed, for this frame
        self._field: FieldArrays | None = None  # the map, for this frame
        self._map_rows: MapRows | None = None
        self._rivals: list[Attempt] = []
        self._rotations = rotation_grid(config.search_span)
        self._second = SecondWitness(camera, device, max_depth, keyframes, images)
        self.is_timing_open = False
        """Whether the camera's timing is being estimated: depth of features, at a wrong time, would disturb that."""
        self.fixed = 0
        """Keyframes, the first ones, whose poses stay as they are: those of a map that is only looked at."""
        self.counts = {"sure": 0, "searched": 0}
        self.hooks: Hooks | None = None

    # -- what Slam asks ------------------------------------------------------------------------------------------

    def place(self, frame: AdmittedFrame, pose: np.ndarray, *, is_apart: bool = False) -> None:
        """A frame whose pose is given; it becomes a keyframe. ``is_apart``: it says nothing of how the frame lies to
        others.
        """
        self._build_missing()
        self._load(frame)
        self._set_motion(frame.index, FrameMotion(depth_offset=frame.depth_offset, readout=self.readout))
        self._add_keyframe(frame.index, pose, self.images.keep_current())
        if self._reference > 0 and not is_apart:
            before = self._reference - 1
            self._link(before, self._reference, inverse(self.keyframes[before].pose) @ pose, GIVEN)
        self._note(frame)

    def locate(self, frame: AdmittedFrame, history: FrameHistory, field: FieldArrays | None = None) -> Located:
        """Pose of the frame, which comes after the frames of ``history``; ``field``: the map, where its surface is to
        join in (`DirectConfig.map_weight`).
        """
        self._build_missing()
        self._field = field if self.config.map_weight > 0 else None
        row = self._load(frame)
        self._foretell_motion(frame, history)
        if not self.keyframes:
            why = "it is not known where the camera starts: there is no keyframe to compare with"
            return self._lost(row, None, why, history)
        if history.was_known:
            self._found = None
        elif history.last_known is None and not self._has_kept_before:
            self._before = None  # the pose was forgotten: nothing tells where that frame is from here
        found = self._found
        starts = history.starts(constant_speed=True, bridge=BRIDGE) if found is None else found.starts
        self._foretold, self._rivals = starts[0] if len(starts) > 1 else None, []
        best: Attempt | None = None
        done: Followed | None = None
        if history.was_known or found is not None:
            done = self._follow(row, self._reference, starts[0], frame, history)
            if self._is_sure(done.attempt):
                self.counts["sure"] += 1
            else:
                best, done = done.attempt, None
        if done is None:
            self.counts["searched"] += 1
            best = self._look_everywhere(row, frame, history, starts, best)
            if best is None or not self._is_good(best):
                self._found = None
                self._keep_before(history)
                return self._lost(row, best, _why_lost(best), history)
            pose = self._pose_of(best)
            self._overlap = self._overlaps_at(row, pose)
            done = self._follow(row, best.keyframe, pose, frame, history, best)
        pose = orthonormalized(self.keyframes[done.attempt.keyframe].pose @ inverse(done.T_frame_reference))
        why = self._why_doubted(done)
        if not why and best is not None and self._foretold is not None and self._is_untold(row, pose):
            why = "it is not where constant speed foretold it, and other places look alike from there"
        if why:
            self._found = None
            self._keep_before(history)
            return self._lost(row, done.attempt, why, history)
        self._reference = done.attempt.keyframe
        if not history.was_known:
            why = self._confirm(row, pose, done.attempt, history)
            if why:
                return replace(self._located(pose, done, history), why_lost=why, after_loss=False)
        return self._accept(row, frame, pose, done, history)

    def _accept(
        self, row: int, frame: AdmittedFrame, pose: np.ndarray, done: Followed, history: FrameHistory
    ) -> Located:
        """Hang a frame whose pose is believed on its keyframe, and make it one if it should be."""
        attempt = done.attempt
        reference = self.keyframes[attempt.keyframe]
        self._typical_scale = _running(self._typical_scale, attempt.grey_scale)
        self._typical_cost = _running(self._typical_cost, attempt.cost)
        anchor = self._anchors[frame.index] = _Anchor(attempt.keyframe, inverse(reference.pose) @ pose)
        self._note_motion(frame, pose, history)
        anchor = self._anchors[frame.index] or anchor
        pose = reference.pose @ anchor.T_keyframe_frame
        self._note(frame)
        if self._is_new(pose, done):
            old = self._revisited(row, pose, attempt.keyframe)
            if old is not None:
                self._reference = old
            else:
                self._add_keyframe(frame.index, pose, self.images.keep_current())
                self._link(attempt.keyframe, self._reference, anchor.T_keyframe_frame, done.whole_covariance)
                self._refine(history)
                pose = self.keyframes[-1].pose.copy()
        return self._located(pose, done, history)

    def _lost(self, row: int, best: Attempt | None, why: str, history: FrameHistory) -> Located:
        """A frame whose pose is not known; ``best``: the best that was found, if anything was."""
        return Located(
            history.last_pose,
            why,
            inliers=0.0 if best is None else best.measures.agreement,
            depth_error=np.inf if best is None else self._depth_error(row, best),
            correlation=None if best is None else best.measures.correlation,
        )

    def _located(self, pose: np.ndarray, done: Followed, history: FrameHistory) -> Located:
        measures = done.attempt.measures
        is_bridged = self._foretold is not None and self._found is None and done.attempt.moved < NEAR_SHIFT
        return Located(
            pose,
            after_loss=not history.was_known and not is_bridged,
            inliers=measures.agreement,
            depth_error=done.depth_error,
            loss=done.attempt.cost,
            correlation=measures.correlation,
            covariance=done.whole_covariance,
            reference=self.keyframes[done.attempt.keyframe].index,
        )

    def _confirm(self, row: int, pose: np.ndarray, attempt: Attempt, history: FrameHistory) -> str:
        """Why a pose that was found after a loss can't be believed yet; empty if it can.

        One that is near where the camera was lost a moment ago needs no more than any other. Elsewhere the place must
        look as it did, both ways, and the frames that follow must go on from there.
        """
        last = history.last_known
        gap = MAX_GAP + 1 if last is None else len(history) - last
        is_near = self._foretold is not None and attempt.moved < NEAR_SHIFT
        if not is_near and self._has_rival(row, pose, attempt):
            self._found = None
            return "two places look alike from here"
        if gap <= MAX_GAP and not history.is_jump(pose, *MAX_MOTION):
            return ""
        m, back = attempt.measures, attempt.back
        alike = back is None or (
            min(m.agreement, back.agreement) > FOUND_AGREEMENT and back.correlation > FOUND_BACK_CORRELATION
        )
        usual = attempt.grey_scale < 2.0 * max(self._typical_scale, 4.0)
        if not (alike and usual and m.correlation > FOUND_CORRELATION and m.known > FOUND_KNOWN):
            self._found = None
            return f"a place was found that may be another one: {_why_lost(attempt)}"
        before, count = (None, 0) if self._found is None else (self._found.pose, self._found.count)
        count += 1
        if count > CONFIRMATIONS:
            self._found = None
            return ""
        motion = np.eye(4) if before is None else inverse(before) @ pose
        self._found = _Found(pose, motion, count)
        return f"found again, to be confirmed by the frames that follow ({count} of {CONFIRMATIONS})"

    def _why_doubted(self, done: Followed) -> str:
        """What speaks against a pose that fits; empty if nothing does."""
        back, sigma = done.attempt.back, weakest_sigma(done.covariance)
        if back is not None and back.agreement < self.config.lost_agreement:
            return f"looked at from the frame, only {back.agreement:.0%} of the keyframe's depth agrees"
        is_plain = done.attempt.grey_scale < PLAIN * self.config.grey_floor and self._is_near(done.attempt)
        least = PLAIN_BACK_CORRELATION if is_plain else BACK_CORRELATION
        if back is not None and back.correlation < least:
            return f"looked at from the frame, grey values of the keyframe correlate by only {back.correlation:.2f}"
        if not sigma < MAX_SIGMA:
            return f"a direction is left open: the position is uncertain by {sigma:.2f} m"
        return ""

    def _has_rival(self, row: int, pose: np.ndarray, attempt: Attempt) -> bool:
        """Whether the frame may be at another place as well."""
        for other in self._rivals:
            is_alike = other.measures.agreement > FOUND_AGREEMENT and other.cost < UNIQUE * attempt.cost
            if is_alike and is_elsewhere(pose, self._pose_of(other)):
                return True
        return self._is_untold(row, pose)

    def _is_untold(self, row: int, pose: np.ndarray) -> bool:
        """Whether a frame does not tell where it is, and did not go on as it did, no period of the surface further."""
        if self._foretold is not None and motion_between(self._foretold, pose)[0] < SAME_STEP:
            return False
        return self.difference_elsewhere(row) < TELLING

    # -- registration --------------------------------------------------------------------------------------------

    @property
    def judged(self) -> int:
        """The level where poses are judged."""
        return min(1, self.plan.top)

    def _task(self, count: int = 1) -> Any:
        tasks = new_tasks(count)
        tasks["grey"], tasks["depth"] = self.config.grey_weight, self.config.depth_weight
        return tasks

    def _follow(
        self,
        row: int,
        reference: int,
        start: np.ndarray,
        frame: AdmittedFrame,
        history: FrameHistory,
        best: Attempt | None = None,
    ) -> Followed:
        """Register to the reference from a pose, then to all keyframes of large overlap, and look back.

        best: What the pose comes from: only the largest level is left to do.
        """
        W = self.keyframes[reference].pose
        task = self._task()
        task["keyframe"], task["row"], task["top"], task["low"] = self._points_of(reference), row, self.plan.middle, 0
        task["cost_level"] = 0
        task["T"] = inverse(start) @ W
        if best is not None:
            task["top"], task["exposure"], task["T"] = 0, best.exposure, best.T_frame_keyframe
        wanted = [k for k, share in sorted(self._overlap.items(), key=lambda item: -item[1]) if share > MIN_OVERLAP]
        joined = [reference, *[k for k in wanted if k != reference]][: max(self.config.joint, 1)]
        joint = records(registration.Joint)
        joint["row"], joint["count"], joint["level"] = row, len(joined), 0
        joint["keyframes"][0, : len(joined)] = [self._points_of(k) for k in joined]
        joint["iterations"] = self.config.joint_iterations if self.config.joint > 0 else 0
        joint["grey"], joint["depth"] = self.config.grey_weight, self.config.depth_weight
        self._ask_motion(joint, frame, history, W)
        near = self._nearest(start)
        found = self.registrar.follow(
            task,
            joint,
            self._to_reference(reference, joined),
            [self._points_of(k) for k in near],
            self._to_reference(reference, near),
            self._pair_back(reference),
            more=None if self._field is None else self._rows_of_map(self._field, W),
        )
        self._overlap = dict(zip(near, found.shares.tolist(), strict=True))
        result, last = found.result, found.joined
        if self._wants_features(last, best):
            last = self._join_features(last, joint, joined, frame, history)
        attempt = replace(self._attempt(reference, result), moved=self._shift(row, task[0]["T"], result["T"]))
        if best is not None:
            attempt = replace(
                attempt, cost=best.cost, measures=best.measures, grey_scale=best.grey_scale, moved=best.moved
            )
        T, T_joint, back = np.asarray(result["T"], np.float64), np.asarray(last["T"], np.float64), found.back
        if is_elsewhere(T_joint, T):
            pair = self._pair_back(reference)
            T_joint, pair["T"] = T, inverse(T)
            back = self.registrar.pairs(self.plan.middle, pair, self.config.grey_weight, self.config.depth_weight)[0]
        return Followed(
            replace(attempt, back=Measures.of(back["counts"])),
            T_joint,
            Measures.of(result["record_0"]),
            self._depth_error(row, attempt),
            covariance_of(np.asarray(last["H"], np.float64)),
        )

    def _rows_of_map(self, field: FieldArrays, T_world_reference: np.ndarray) -> Callable[[wp.array, wp.array], None]:
        """What writes the rows of the frame's points against the surface of the map."""
        map_rows = self._map_rows = self._map_rows or MapRows(self.registrar, 0, self.config.map_weight)

        def add(pose: wp.array, rows: wp.array) -> None:
            map_rows.add(field, pose, T_world_reference, SCRATCH, rows, 0)

        return add

    def _to_reference(self, reference: int, keyframes: Sequence[int]) -> np.ndarray:
        """From the axes of keyframes to those of the reference, (n, 4, 4)."""
        return inverse(self.keyframes[reference].pose) @ np.array([self.keyframes[k].pose for k in keyframes])

    def _pair_back(self, keyframe: int) -> Any:
        """A keyframe in the points of a frame; the pose is left to fill in."""
        pair = records(registration.Pair)
        pair["keyframe"], pair["row"], pair["exposure"] = SCRATCH, self._row(self.keyframes[keyframe]), (1.0, 0.0)
        return pair

    def _wants_features(self, last: np.ndarray, best: Attempt | None) -> bool:
        """Whether features' rows should join those of the images, which came to ``last``."""
        when = self.config.feature_rows
        if when != "doubt" or not last["ok"]:
            return when == "always" and bool(last["ok"])
        return best is not None or weakest_sigma(covariance_of(np.asarray(last["H"], np.float64))) > WEAK_SIGMA

    def _join_features(
        self, last: np.ndarray, joint: Any, joined: Sequence[int], frame: AdmittedFrame, history: FrameHistory
    ) -> np.ndarray:
        """The joint registration with ``joined`` once more, with rows of features: its `registration.Result`."""
        reference, first = joined[0], int(joint["others"][0])
        W = self.keyframes[reference].pose
        pose = W @ inverse(np.asarray(last["T"], np.float64))
        picture = replace(self._picture(frame), motion=self._motion_at(pose, frame, history))
        features = self._second.rows(picture, pose, self._likely(reference))
        for _ in range(LINEARIZATIONS):
            T = orthonormalized(np.asarray(last["T"], np.float64))
            others = None if features is None else feature_rows(features, W, T)
            if others is None:
                break
            joint["others"] = first + len(others)
            self.registrar.put_rows(others, first)
            last = self.registrar.join_again(joint, self._to_reference(reference, joined))
            if not is_far(T, np.asarray(last["T"], np.float64)):
                break
        return last

    def _motion_at(self, pose: np.ndarray, frame: AdmittedFrame, history: FrameHistory) -> FrameMotion:
        """How the camera moved while it took a frame that is at ``pose``."""
        motion, earlier = self._motions[frame.index], history.earlier(TWIST_STEPS - 1)
        if (motion.depth_offset == 0.0 and motion.readout == 0.0) or earlier is None:
            return motion
        elapsed = frame.timestamp - history.timestamp(earlier)
        if elapsed <= 0:
            return motion
        return motion.with_twist(twist_of(inverse(history.pose(earlier)) @ pose) / elapsed)

    def _likely(self, reference: int) -> list[int]:
        """Keyframes whose features a frame is matched with."""
        likely = sorted(self._overlap.items(), key=lambda item: -item[1])
        return list(dict.fromkeys([reference, *(k for k, _ in likely)]))[:WITNESS_KEYFRAMES]

    def _shift(self, row: int, a: np.ndarray, b: np.ndarray) -> float:
        """How far two transforms put points apart, about [px of the middle level]."""
        step, turn = motion_between(np.asarray(a, np.float64), np.asarray(b, np.float64))
        focal = float(self.plan.levels[self.plan.middle]["fx"])
        return float(focal * (step / self.registrar.mean_depth(row) + np.radians(turn)))

    def _attempt(self, keyframe: int, result: np.ndarray) -> Attempt:
        record = result["record_1"] if self.judged == 1 else result["record_0"]
        # Thin lines are lost on small images, and on large ones what is a little blurred does not fit.
        measures, finest = Measures.of(record), Measures.of(result["record_0"])
        return Attempt(
            keyframe,
            np.asarray(result["T"], np.float64),
            np.asarray(result["exposure"], np.float64),
            float(result["end_cost"]),
            replace(measures, correlation=max(measures.correlation, finest.correlation)),
            float(record[eq.GREY_SCALE]),
            float(result["record_0"][eq.DEPTH_SCALE]),
            bool(result["ok"]) and bool(np.isfinite(result["T"]).all()),
        )

    def _depth_error(self, row: int, attempt: Attempt) -> float:
        """Spread of depth against the keyframe [m]."""
        return attempt.depth_scale * float(eq.depth_sigma(self.registrar.mean_depth(row)))

    def _is_sure(self, attempt: Attempt) -> bool:
        """Whether nothing needs to be searched for."""
        m, config = attempt.measures, self.config
        limit = max(6.0, 2.0 * self._typical_scale)
        return (
            attempt.ok
            and self._foretold is not None
            and m.agreement > config.sure_agreement
            and m.correlation > config.sure_correlation
            and m.view > 0.4
            and m.known > 0.2
            and attempt.grey_scale < limit
            and attempt.cost < self._usual_cost
            and attempt.moved < config.sure_shift
        )

    @property
    def _usual_cost(self) -> float:
        """What a right pose costs at most, as a rule."""
        return max(self.config.sure_cost * self._typical_cost, LEAST_COST)

    def _is_good(self, attempt: Attempt) -> bool:
        """Whether the pose can be believed."""
        m, config = attempt.measures, self.config
        return (
            attempt.ok
            and m.agreement > config.lost_agreement
            and m.correlation > (config.near_correlation if self._is_near(attempt) else config.lost_correlation)
            and m.view > config.lost_view
            and m.known > config.lost_known
        )

    def _is_near(self, attempt: Attempt) -> bool:
        """Whether the camera went on as it did, as far as depth tells: it need not look as much alike."""
        agrees = attempt.measures.agreement > self.config.sure_agreement
        return self._foretold is not None and attempt.moved < NEAR_SHIFT and agrees

    # -- search --------------------------------------------------------------------------------------------------

    def _look_everywhere(
        self,
        row: int,
        frame: AdmittedFrame,
        history: FrameHistory,
        starts: Sequence[np.ndarray],
        best: Attempt | None,
    ) -> Attempt | None:
        """At the reference, at the frame before, at older keyframes, until a pose is believed."""
        picture = self._picture(frame)
        if history.last_known is not None or self._found is not None:
            # The frame before is at no place that is not confirmed yet.
            poses = [*starts, *(self._turned(row, starts) if self._found is None else [])]
            foretold = self._foretold
            found = self._search(row, self._reference, poses, foretold)
            is_near = foretold is not None and best is not None and best.moved < NEAR_SHIFT
            if best is None or not self._is_good(best) or not is_near:
                best = _better(best, found, by_cost=True)
            elif found is not None and self._is_good(found) and found.cost < DECISIVE * best.cost:
                best = found
            if best is not None and self._is_good(best) and best.cost < self._usual_cost:
                return best
            witness = self._ask(picture, history, starts[0])
            best = self._judge(row, best, witness)
            if best is not None and self._is_good(best):
                return best
            before = self._before
            if history.was_known and before is not None and before.index != self._reference_frame:
                self._keep_before(history)
                best = _better(best, self._search(row, self._reference, poses, foretold))
                best = self._judge(row, best, witness)
                if best is not None and self._is_good(best):
                    return best
        return _better(best, self._relocalize(row, picture))

    def _picture(self, frame: AdmittedFrame) -> Picture:
        """The frame as it comes back from a file."""
        motion = self._motions[frame.index]
        if not self.device.is_cpu:
            return Picture(frame.rgb, frame.depth, frame.index, motion)
        return replace(Picture.of(*self.images.current()), index=frame.index, motion=motion)

    def _ask(self, picture: Picture, history: FrameHistory, foretold: np.ndarray) -> Witness | None:
        """What features say, if the frame follows one whose pose is known."""
        before = self._before
        if before is None or not history.was_known:
            return None
        keyframes = self._likely(self._reference)
        earlier = replace(before.picture, motion=self._motions.get(before.index, NO_MOTION))
        return self._second.locate(picture, earlier, history.last_pose, foretold, keyframes)

    def _judge(self, row: int, best: Attempt | None, witness: Witness | None) -> Attempt | None:
        """Where features say something else, a third measure decides: which of both answers the images fit better."""
        if witness is None:
            return best
        if best is not None:
            step, turn = motion_between(self._pose_of(best), witness.T_world_camera)
            if step < DIFFERENT_STEP and turn < DIFFERENT_TURN:
                return best
        task = self._task()
        task["keyframe"], task["row"], task["cost_level"] = self._points_of(self._reference), row, 0
        task["top"] = self.judged
        task["T"] = inverse(witness.T_world_camera) @ self.keyframes[self._reference].pose
        other = self._attempt(self._reference, self.registrar.register(task)[0])
        other = replace(other, moved=self._shift(row, task[0]["T"], other.T_frame_keyframe))
        if best is None or not self._is_good(best):
            return _better(best, other if other.ok else None)
        return other if other.ok and self._is_good(other) and other.cost < best.cost else best

    def _turned(self, row: int, starts: Sequence[np.ndarray]) -> list[np.ndarray]:
        """Starts whose rotation was found on the smallest images of the frame before."""
        before = self._row_before()
        if before is None or not starts:
            return []
        rotations = self._best_rotations(before, row)
        last = starts[-1]
        shift = inverse(last) @ starts[0]
        poses = []
        for R in rotations:
            turn = np.eye(4)
            turn[:3, :3] = R.T
            poses.append(last @ turn)
            if len(starts) > 1:
                turn = turn.copy()
                turn[:3, 3] = shift[:3, 3]
                poses.append(last @ turn)
        return poses

    def _best_rotations(self, before: int, row: int) -> list[np.ndarray]:
        """Rotations from one frame into another that fit best and differ by more than 5 degrees."""
        (scores,) = self.registrar.rotations(self.registrar.smallest(before)[None], row, self._rotations)
        found: list[np.ndarray] = []
        for n in np.argsort(scores, kind="stable")[:40]:
            R = self._rotations[n]
            if all(np.trace(R.T @ other) < 1.0 + 2.0 * np.cos(np.radians(5.0)) for other in found):
                found.append(R)
            if len(found) == self.config.search_kept:
                break
        return found

    def _search(
        self,
        row: int,
        keyframe: int,
        poses: Sequence[np.ndarray],
        foretold: np.ndarray | None,
    ) -> Attempt | None:
        """The cheapest of many starts: each as it is and after the smallest levels, the best three refined.

        foretold: Pose that counts as likely: where all looks alike, the nearest to it is chosen.
        """
        W, points_row = self.keyframes[keyframe].pose, self._points_of(keyframe)
        top, middle = self.plan.top, self.plan.middle
        tasks = self._task(2 * len(poses))
        tasks["keyframe"], tasks["row"], tasks["cost_level"] = points_row, row, middle
        tasks["low"], tasks["iterations"] = max(top - 1, 0), 6
        tasks["top"] = np.repeat([top, max(top - 1, 0)], len(poses))
        tasks["T"] = np.tile(inverse(np.asarray(poses)) @ W, (2, 1, 1))
        results = self.registrar.register(tasks)
        tried = [(float(r["start_cost"]), t["T"], np.array([1.0, 0.0])) for t, r in zip(tasks, results, strict=True)]
        tried += [(float(r["end_cost"]), r["T"], r["exposure"]) for r in results if r["ok"]]
        tried.sort(key=lambda one: one[0])
        if self.config.search_weak:
            tried += self._weak_starts(row, points_row, [tasks[0]["T"], tried[0][1]])
            tried.sort(key=lambda one: one[0])
        chosen = _apart([one for one in tried if np.isfinite(one[1]).all()], SEARCH_WIDE)
        tasks = self._refinements(row, points_row, chosen)
        tasks["top"], tasks["low"], tasks["cost_level"] = middle, middle, middle
        refined = [(float(r["end_cost"]), r["T"], r["exposure"]) for r in self.registrar.register(tasks) if r["ok"]]
        chosen = _apart(sorted(refined, key=lambda one: one[0]), SEARCH_DEEP)
        tasks = self._refinements(row, points_row, chosen)
        tasks["top"], tasks["low"], tasks["cost_level"] = min(self.judged, middle), 0, 0
        best: Attempt | None = None
        for result in self.registrar.register(tasks) if len(tasks) else ():
            found = self._attempt(keyframe, result)
            if foretold is not None:
                moved = self._shift(row, inverse(foretold) @ W, result["T"])
                found = replace(found, moved=moved, cost=found.cost * (1.0 + SHIFT_PRICE * moved))
            if found.ok:
                self._rivals.append(found)
                best = _better(best, found, by_cost=True)
        return best

    def _refinements(self, row: int, points_row: int, chosen: Sequence[_Start]) -> Any:
        tasks = self._task(len(chosen))
        tasks["keyframe"], tasks["row"] = points_row, row
        for task, (_, T, exposure) in zip(tasks, chosen, strict=True):
            task["T"], task["exposure"] = T, exposure
        return tasks

    def _weak_starts(self, row: int, points_row: int, transforms: Sequence[np.ndarray]) -> list[_Start]:
        """Poses along the two motions that depth determines least: a corridor's length, a wall's plane."""
        middle = self.plan.middle
        tasks = self._task(len(transforms))
        tasks["keyframe"], tasks["row"], tasks["top"], tasks["low"] = points_row, row, middle, middle
        tasks["grey"], tasks["iterations"] = 0.0, -1
        tasks["T"] = np.asarray(transforms)
        z = self.registrar.mean_depth(row)
        D = np.diag([z, z, z, 1.0, 1.0, 1.0])
        step = 1.0 / float(self.plan.levels[middle]["fx"])
        steps = [n for n in range(-self.config.search_steps, self.config.search_steps + 1) if n]
        moves = []
        for result in self.registrar.register(tasks):
            _, axes = np.linalg.eigh(D @ np.asarray(result["H"], np.float64) @ D)
            T = np.asarray(result["T"], np.float64)
            moves += [motion_of(D @ axes[:, axis] * (n * step)) @ T for axis in range(2) for n in steps]
        tasks = self._task(len(moves))
        tasks["keyframe"], tasks["row"], tasks["cost_level"] = points_row, row, middle
        tasks["top"], tasks["low"], tasks["iterations"] = middle, middle, -2
        tasks["T"] = np.asarray(moves)
        costs = self.registrar.register(tasks)["start_cost"]
        found: list[_Start] = []
        for n in np.argsort(costs, kind="stable"):
            T = moves[n]
            motions = [motion_between(other[1], T) for other in found]
            if all(shift > 2.5 * step * z or turn > 3.0 for shift, turn in motions):
                found.append((float(costs[n]), T, np.array([1.0, 0.0])))
            if len(found) == 6:
                break
        return found

    def _relocalize(self, row: int, picture: Picture) -> Attempt | None:
        """At the keyframes whose smallest image fits best under some rotation; nowhere if two places are as likely."""
        first = max(0, len(self.keyframes) - self.config.relocalization_keyframes)
        numbers = list(range(first, len(self.keyframes)))
        scores = self.registrar.rotations(np.array([self._smallest[k] for k in numbers]), row, self._rotations)
        found: list[Attempt] = []
        order = np.argsort(scores.min(axis=1), kind="stable")
        places = [] if self.hooks is None else self.hooks.places(picture)
        places = list(dict.fromkeys([*places, *(numbers[n] for n in order[:WITNESS_KEYFRAMES])]))
        witness = self._second.relocalize(picture, places)
        if witness is not None:
            near = self._nearest(witness.T_world_camera)
            overlap = self._overlaps_at(row, witness.T_world_camera)
            keyframe = max(near, key=lambda k: overlap[k])
            attempt = self._search(row, keyframe, [witness.T_world_camera], None)
            if attempt is not None:
                found.append(replace(attempt, moved=np.inf))
        for n in order[:4]:
            keyframe = numbers[n]
            turn = np.eye(4)
            turn[:3, :3] = self._rotations[scores[n].argmin()].T
            attempt = self._search(row, keyframe, [self.keyframes[keyframe].pose @ turn], None)
            if attempt is not None:
                found.append(replace(attempt, moved=np.inf))
        best = max(found, key=lambda attempt: attempt.measures.worth, default=None)
        if best is None or not self._is_good(best):
            return best
        place = self._pose_of(best)
        for other in found:
            is_rival = is_elsewhere(place, self._pose_of(other))
            if is_rival and self._is_good(other) and other.cost < UNIQUE * best.cost:
                return replace(best, ok=False)
        return best

    # -- keyframes -----------------------------------------------------------------------------------------------

    def _is_new(self, pose: np.ndarray, done: Followed) -> bool:
        """Whether a frame sees so much else that it should be a keyframe."""
        config, k = self.config, done.attempt.keyframe
        step, turn = motion_between(self.keyframes[k].pose, pose)
        return (
            done.seen.view * done.seen.agreement < config.keyframe_overlap
            or step > config.keyframe_step * self._mean_depth[k]
            or turn > config.keyframe_turn
        )

    def _revisited(self, row: int, pose: np.ndarray, reference: int) -> int | None:
        """An old keyframe that sees enough of the frame to serve again."""
        config = self.config
        best = max(self._overlap.items(), key=lambda item: item[1], default=None)
        if best is None or best[1] <= config.keyframe_overlap or best[0] == reference:
            return None
        if self.hooks is not None and not self.hooks.serves_again(best[0], reference):
            return None
        step, turn = motion_between(self.keyframes[best[0]].pose, pose)
        far = 0.8 * config.keyframe_step * self.registrar.mean_depth(row)
        return best[0] if step < far and turn < 0.8 * config.keyframe_turn else None

    def _add_keyframe(self, index: int, pose: np.ndarray, image: int) -> None:
        """Make a frame whose pyramid is built a keyframe, and the reference; ``image``: its number in the pool."""
        number = len(self.keyframes)
        motion = self._motions.get(index, NO_MOTION)
        self.keyframes.append(Keyframe(index, image, orthonormalized(pose), motion))
        self._take_up(number)
        self._anchors[index] = _Anchor(number, np.eye(4))
        self._overlap[number] = 1.0
        self._reference = number

    def _take_up(self, number: int) -> None:
        """Choose the points of a keyframe."""
        row = self._row(self.keyframes[number])
        self.registrar.select(row, self._points_of(number))
        self._smallest.append(self.registrar.smallest(row))
        self._mean_depth.append(self.registrar.mean_depth(row))

    def _build_missing(self) -> None:
        """Take up keyframes that came from elsewhere: a file, or frames whose poses were given."""
        for number in range(len(self._smallest), len(self.keyframes)):
            self._take_up(number)

    def _keep_before(self, history: FrameHistory) -> None:
        """The last frame that was OK becomes a keyframe: it is what a lost camera is nearest to."""
        before = self._before
        if before is None or self._row_before() is None or self._has_kept_before:
            return
        image = self.images.add(before.rgb, before.depth) if before.kept is None else self.images.add_kept(*before.kept)
        anchor = self._anchors[before.index]
        self._add_keyframe(before.index, history.pose(before.index), image)
        if anchor is not None:
            self._link(anchor.keyframe, self._reference, anchor.T_keyframe_frame, UNTOLD)

    @property
    def _has_kept_before(self) -> bool:
        """Whether the last frame that was OK is a keyframe already."""
        return self._before is not None and any(one.index == self._before.index for one in self.keyframes)

    def _row_before(self) -> int | None:
        """Where the images of the last frame that was OK are; None if they are gone."""
        if self._before is None:
            return None
        index = self._before.index
        if index in self._row_of:
            return self._row_of[index]
        return next((self._row(one) for one in reversed(self.keyframes) if one.index == index), None)

    def _refine(self, history: FrameHistory) -> None:
        """Refine the keyframes around the newest, and move the frames that hang on them."""
        if self.config.window < 2 or len(self.keyframes) < 3:
            return
        newest = len(self.keyframes) - 1
        near = self._ranked(newest)
        active = list(dict.fromkeys([newest, *near]))[: self.config.window]
        active += [k for k in range(newest - 1, -1, -1) if k not in active][: self.config.window - len(active)]
        active.sort()
        members = [
            Pose(self._points_of(k), self._row(self.keyframes[k]), self.keyframes[k].pose, k < self.fixed)
            for k in active
        ]
        refined = refine_window(
            self.registrar,
            members,
            self.judged,
            self.config.grey_weight,
            self.config.depth_weight,
            self.config.window_iterations,
            self._features_between(active) if self.config.window_features and not self.is_timing_open else None,
        )
        self.move_keyframes(dict(zip(active, refined.poses, strict=True)), history)
        for (i, j), H in refined.information.items():
            self._link(active[i], active[j], inverse(refined.poses[i]) @ refined.poses[j], covariance_of(H))
        if self.hooks is not None:
            self.hooks.refined(active)

    def _link(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        if self.hooks is not None:
            self.hooks.link(i, j, T_i_j, covariance)

    def _features_between(self, members: Sequence[int]) -> Callable[[int, int, np.ndarray], PairRows | None]:
        """Rows of the features that two of some keyframes have in common."""

        def between(i: int, j: int, T: np.ndarray) -> PairRows | None:
            found = self._second.between(members[i], members[j], T)
            return None if found is None else pair_rows(found, T)

        return between

    def _ranked(self, number: int) -> list[int]:
        """Keyframes that overlap one, most first."""
        pose = self.keyframes[number].pose
        shares = self._overlaps_at(self._row(self.keyframes[number]), pose)
        return [k for k, share in sorted(shares.items(), key=lambda item: -item[1]) if share > 0.2]

    def _overlaps_at(self, row: int, pose: np.ndarray) -> dict[int, float]:
        near = self._nearest(pose)
        transforms = inverse(pose) @ np.array([self.keyframes[k].pose for k in near])
        shares = self.registrar.overlap(row, [self._points_of(k) for k in near], transforms)
        return dict(zip(near, shares.tolist(), strict=True))

    def _nearest(self, pose: np.ndarray) -> list[int]:
        """Keyframes nearest to a pose, in their order."""
        poses = np.array([keyframe.pose for keyframe in self.keyframes])
        if len(poses) <= NEAR_KEYFRAMES:
            return list(range(len(poses)))
        step, turn = motion_between(poses, np.broadcast_to(pose, poses.shape)).T
        return sorted(np.argsort(step + DEGREE * turn, kind="stable")[:NEAR_KEYFRAMES].tolist())

    # -- what is asked of it from outside ------------------------------------------------------------------------

    @property
    def overlap(self) -> dict[int, float]:
        """Share of the points of a keyframe that the last frame sees, by keyframe."""
        return self._overlap

    def move_keyframes(self, poses: Mapping[int, np.ndarray], history: FrameHistory) -> None:
        """Keyframes go to other poses (4, 4), and the frames that hang on them with them."""
        moved = {k for k, pose in poses.items() if not np.array_equal(pose, self.keyframes[k].pose)}
        for k in moved:
            self.keyframes[k].pose = poses[k]
        for index, anchor in enumerate(self._anchors):
            if anchor is not None and anchor.keyframe in moved and index < len(history):
                history.correct(index, self.keyframes[anchor.keyframe].pose @ anchor.T_keyframe_frame)

    def keyframe_row(self, number: int) -> int:
        """Row of a keyframe's images, built if they are gone; it holds until `CACHED` others were asked for."""
        return self._row(self.keyframes[number])

    def difference_elsewhere(self, row: int) -> float:
        """How much images differ from themselves at another place, see `aliases.difference_elsewhere`; below `TELLING`
        they do not tell where they are.
        """
        weights = self.config.grey_weight, self.config.depth_weight
        return difference_elsewhere(self.registrar, row, SCRATCH, weights, SAME_STEP)

    @property
    def is_confirming(self) -> bool:
        """Whether a place was found that is not believed yet."""
        return self._found is not None

    def mean_depth(self, number: int) -> float:
        """Of what a keyframe sees [m]."""
        return self._mean_depth[number]

    def row_of(self, index: int) -> int | None:
        """Where the images of a frame are; None if they are gone."""
        return self._row_of.get(index)

    def points_of(self, keyframe: int) -> int:
        """Row of a keyframe's points."""
        return self._points_of(keyframe)

    def retime(self, change: TimingChange, twists: Mapping[int, np.ndarray], first: int = 0) -> None:
        """The camera sees otherwise than was believed: its keyframes and the last frames are corrected for it.

        change: By which delay and readout grow. twists: Of keyframes where they are known, by frame. first: The first
        frame that it took.
        """
        self.readout += change.readout
        for index, motion in list(self._motions.items()):
            if index in self._row_of:
                self._set_motion(index, motion.retimed(change))
        for number, keyframe in enumerate(self.keyframes):
            if keyframe.index >= first:
                keyframe.motion = keyframe.motion.retimed(change)
                self._correct_keyframe(number, twists.get(keyframe.index, np.array(keyframe.motion.twist)))

    # -- frames --------------------------------------------------------------------------------------------------

    @property
    def _reference_frame(self) -> int:
        return self.keyframes[self._reference].index

    def _points_of(self, keyframe: int) -> int:
        return keyframe + 1

    def _pose_of(self, attempt: Attempt) -> np.ndarray:
        return self.keyframes[attempt.keyframe].pose @ inverse(attempt.T_frame_keyframe)

    def _load(self, frame: AdmittedFrame) -> int:
        row = self._take_row(frame.index)
        rgb, depth, scale = self.images.arrays
        self.registrar.load(row, rgb[0], depth[0], scale[:1])
        while len(self._anchors) <= frame.index:
            self._anchors.append(None)
        return row

    def _row(self, keyframe: Keyframe) -> int:
        """Where the images of a keyframe are."""
        row = self._row_of.get(keyframe.index)
        if row is not None:
            self._row_of.move_to_end(keyframe.index)
            return row
        row = self._upload(keyframe.index, *self.images.kept(keyframe.image).unpack(self.camera))
        self._set_motion(keyframe.index, keyframe.motion)
        return row

    def _upload(self, index: int, rgb: np.ndarray, units: np.ndarray, scale: float) -> int:
        """Build the pyramid of an image that is kept."""
        row, device = self._take_row(index), self.device
        self.registrar.load(
            row,
            wp.array(rgb, dtype=wp.uint8, device=device),
            wp.array(units, dtype=wp.uint16, device=device),
            wp.array([scale], dtype=float, device=device),
        )
        return row

    def _take_row(self, index: int) -> int:
        if index in self._row_of:
            return self._row_of[index]
        if len(self._row_of) < self.registrar.rows:
            row = len(self._row_of)
        else:
            row = self._row_of.popitem(last=False)[1]
        self._row_of[index] = row
        return row

    def _note(self, frame: AdmittedFrame) -> None:
        kept = self.images.current() if self.device.is_cpu else None
        self._before = _Before(frame.index, frame.rgb if kept else frame.rgb.copy(), frame.depth, kept)

    # -- saved ---------------------------------------------------------------------------------------------------

    def state(self) -> DirectState:
        """All of it as arrays."""
        found = self._found
        anchors = [-1 if anchor is None else anchor.keyframe for anchor in self._anchors]
        relative = [np.eye(4) if anchor is None else anchor.T_keyframe_frame for anchor in self._anchors]
        return DirectState(
            anchors=np.array(anchors, np.int64),
            relative=np.array(relative, np.float64).reshape(-1, 4, 4),
            overlap=np.array([self._overlap.get(k, -1.0) for k in range(len(self.keyframes))], np.float64),
            reference=self._reference,
            before=-1 if self._before is None else self._before.index,
            found=np.tile(np.eye(4), (2, 1, 1)) if found is None else np.stack([found.pose, found.motion]),
            confirmed=0 if found is None else found.count,
            motion=self.motion.to_array(),
            depth_sigma=self._second.depth_sigma,
            typical=(self._typical_scale, self._typical_cost),
        )

    def restore(self, state: DirectState, current: int | None) -> None:
        """Go on from what `state` returned; keyframes and images are restored already, ``current`` is in slot 0."""
        pairs = zip(state.anchors.tolist(), state.relative, strict=True)
        self._anchors = [None if k < 0 else _Anchor(k, T.copy()) for k, T in pairs]
        self._overlap = {k: share for k, share in enumerate(state.overlap.tolist()) if share >= 0}
        self._reference = state.reference
        if state.confirmed:
            self._found = _Found(state.found[0].copy(), state.found[1].copy(), state.confirmed)
        self._second.depth_sigma = state.depth_sigma
        self._typical_scale, self._typical_cost = state.typical
        self._build_missing()  # first, lest it displace the frame before
        motion = FrameMotion.from_array(state.motion)
        if current is not None:
            self._motions[current] = motion
        if state.before < 0:
            return
        keyframe = next((one for one in reversed(self.keyframes) if one.index == state.before), None)
        if state.before == current:
            rgb, units, scale = self.images.current()
            self._upload(state.before, rgb, units, scale)
            self._set_motion(state.before, motion)
        elif keyframe is not None:
            rgb, units, scale = self.images.kept(keyframe.image).unpack(self.camera)
        else:
            return
        depth = units.astype(np.float32) * np.float32(scale)
        self._before = _Before(state.before, rgb, depth, (rgb, units, scale))

    # -- motion within a frame -----------------------------------------------------------------------------------

    @property
    def motion(self) -> FrameMotion:
        """How the camera moved while it took the last frame, as far as is known by now."""
        return self._motions[max(self._motions)] if self._motions else NO_MOTION

    def _set_motion(self, index: int, motion: FrameMotion) -> None:
        """How the camera moved while it took a frame whose images are loaded."""
        self._motions[index] = motion
        while len(self._motions) > RECENT:
            del self._motions[min(self._motions)]
        struct = records(points.Motion)
        twist = np.array(motion.twist)
        struct["to_depth"] = motion_of(-motion.depth_offset * twist)
        struct["velocity"], struct["spin"] = motion.readout * twist[:3], motion.readout * twist[3:]
        struct["moves"] = not motion.is_none
        self.registrar.set_motion(self._row_of[index], struct)

    def _foretell_motion(self, frame: AdmittedFrame, history: FrameHistory) -> None:
        """The camera moves during this frame as it did between the last ones."""
        motion = FrameMotion(depth_offset=frame.depth_offset, readout=self.readout)
        self._set_motion(frame.index, motion.with_twist(history.twist()))

    def _ask_motion(self, joint: Any, frame: AdmittedFrame, history: FrameHistory, W: np.ndarray) -> None:
        """Have the joint registration correct the motion by the pose that it begins with."""
        earlier = history.earlier(TWIST_STEPS - 1)
        if (frame.depth_offset == 0.0 and self.readout == 0.0) or earlier is None:
            return
        joint["T_earlier_reference"] = inverse(history.pose(earlier)) @ W
        joint["elapsed"] = max(frame.timestamp - history.timestamp(earlier), 0.0)
        joint["delay"], joint["readout"] = frame.depth_offset, self.readout

    def _note_motion(self, frame: AdmittedFrame, pose: np.ndarray, history: FrameHistory) -> None:
        """The motion during a frame that was located, and during the keyframe before it, now seen from both sides."""
        earlier = history.earlier(TWIST_STEPS - 1)
        motion = self._motions[frame.index]
        if (motion.depth_offset == 0.0 and motion.readout == 0.0) or earlier is None:
            return
        elapsed = frame.timestamp - history.timestamp(earlier)
        if elapsed <= 0:
            return
        twist = twist_of(inverse(history.pose(earlier)) @ pose) / elapsed
        self._set_motion(frame.index, motion.with_twist(twist))
        last = self.keyframes[-1]
        if earlier != frame.index - TWIST_STEPS:
            return
        if len(self.keyframes) == 1 and last.index == earlier and not history.follows(earlier):
            self._begin_again(frame, twist, history)
        elif last.index == frame.index - 1:
            self._correct_keyframe(len(self.keyframes) - 1, twist)

    def _correct_keyframe(self, number: int, twist: np.ndarray) -> None:
        """Choose a keyframe's points anew for another motion."""
        keyframe = self.keyframes[number]
        keyframe.motion = keyframe.motion.with_twist(twist)
        row = self._row(keyframe)
        self._set_motion(keyframe.index, keyframe.motion)
        self.registrar.select(row, self._points_of(number))

    def _begin_again(self, frame: AdmittedFrame, twist: np.ndarray, history: FrameHistory) -> None:
        """The first keyframe gets its motion from the two frames after it, and these are registered once more."""
        self._correct_keyframe(0, twist)
        W = self.keyframes[0].pose
        for index in range(self.keyframes[0].index + 1, frame.index + 1):
            anchor = self._anchors[index]
            if index not in self._row_of or index not in self._motions or anchor is None or anchor.keyframe != 0:
                continue
            self._set_motion(index, self._motions[index].with_twist(twist))
            task = self._task()
            task["keyframe"], task["row"], task["top"] = self._points_of(0), self._row_of[index], self.judged
            task["T"] = inverse(anchor.T_keyframe_frame)
            result = self.registrar.register(task)[0]
            if result["ok"]:
                T = orthonormalized(inverse(np.asarray(result["T"], np.float64)))
                self._anchors[index] = _Anchor(0, T)
                if index < len(history):
                    history.correct(index, W @ T)


def _apart(starts: Sequence[_Start], count: int) -> list[_Start]:
    """The first of some starts, without those that another one is next to."""
    chosen: list[_Start] = []
    for one in starts:
        motions = [motion_between(other[1].astype(np.float64), one[1].astype(np.float64)) for other in chosen]
        if all(step >= 0.015 or turn >= 0.7 for step, turn in motions):
            chosen.append(one)
        if len(chosen) == count:
            break
    return chosen


def _better(a: Attempt | None, b: Attempt | None, *, by_cost: bool = False) -> Attempt | None:
    if a is None or b is None:
        return a if b is None else b
    if by_cost:
        return b if b.cost < a.cost else a
    return b if b.measures.worth > a.measures.worth else a


def _running(mean: float, value: float) -> float:
    return value if not np.isfinite(mean) else 0.9 * mean + 0.1 * value


def covariance_of(H: np.ndarray) -> np.ndarray:
    """Covariance (6, 6) of a pose, as a twist (v, w) [m, rad], from its normal matrix.

    Residuals of one image err together, by far more than their number suggests: `VARIANCE_FACTOR` takes up what the
    true errors are beyond what the matrix says.
    """
    H = np.where(np.isfinite(H), H, 0.0)
    return VARIANCE_FACTOR * np.linalg.inv(0.5 * (H + H.T) + np.diag([1e-2] * 3 + [1e-2] * 3))


def _why_lost(best: Attempt | None) -> str:
    if best is None:
        return "no registration to a keyframe came to an end"
    m = best.measures
    return (
        f"{m.agreement:.0%} of the depth agrees with the best keyframe, grey values correlate by {m.correlation:.2f}, "
        f"{m.view:.0%} of it is in view"
    )


def rotation_grid(span: float) -> np.ndarray:
    """Rotations (n, 3, 3): pitch and yaw every 3 degrees up to ``span``, roll -8, 0 and 8 degrees."""
    angles = np.radians(np.arange(-span, span + 0.1, 3.0))
    return np.array(
        [
            motion_of(np.array([0.0, 0.0, 0.0, pitch, yaw, roll]))[:3, :3]
            for roll in np.radians([-8.0, 0.0, 8.0])
            for pitch in angles
            for yaw in angles
        ]
    )
