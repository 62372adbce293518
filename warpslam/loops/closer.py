"""Loops: a new keyframe that shows a known place, and what follows for all poses.

Each keyframe is compared with old ones that it may show the place of: those that it should see by the poses as they
are, and those that share most of its words. A pair that passes all gates (`warpslam.loops.verification`) becomes an
edge of the pose graph, and the graph is solved where the edge says something new. A wrong loop is worse than none, so
one that asks for more drift than tracking may have collected on the way between is refused, too.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np

from warpslam.config import Config, LoopConfig
from warpslam.loops.graph import LEAST_WEIGHT, Edge, PoseGraph, edges_from_arrays, edges_to_arrays, import_gtsam
from warpslam.loops.retrieval import PlaceIndex, Words
from warpslam.loops.verification import FeatureCache, Gate, Verdict, Verifier
from warpslam.mapping.remapping import MOVED, MadePoses, Remapping, moved_views
from warpslam.poses import inverse, motion_between, orthonormalized
from warpslam.scene.image_pool import ImagePool
from warpslam.scene.mapped_views import SeenDepth
from warpslam.tracking.direct.second import Picture
from warpslam.tracking.direct.tracker import UNTOLD, DirectTracker
from warpslam.trajectory import FrameHistory

GAP = 10
"""Keyframes before one that tracking itself registers it to."""
WINDOW_SPAN = 2 * GAP
"""Keyframes of a window that are further from each other by number are of two visits."""
NEARBY, NEXT_TO = 5, 2
"""Keyframes around a member of a loop that it joins; around one that is compared, whose comparison would say the same.
"""
NEAR = 2.0, 60.0
"""Poses of such keyframes are no further apart [m], [degrees]."""
STAND_OUT = 1.4
"""Words that a known place shares, over the median of all keyframes: 1.0 to 1.5 where the best one is another place,
1.5 to 6 where it is the same (a walk through a house).
"""
LEAST_OVERLAP = 0.3
"""Share of a keyframe that another one must see for both to be compared without a word in common."""
NEWS = 12.6
"""Squared Mahalanobis distance from which a loop is news, and the graph is solved: 95 % of errors are smaller."""
JOINED = 0.1, 3.0
"""Loops between two parts that say the same of how they lie differ by less [m], [degrees]."""
LEAST_MOVE = 0.001
"""Keyframes that move further count as moved [m]."""


@dataclass(frozen=True)
class Closed:
    """What a keyframe's loops came to."""

    moved: int
    """Keyframes that moved by more than `LEAST_MOVE`."""
    largest: float
    """Distance that one moved at most [m]."""


@dataclass
class LoopFigures:
    """What became of all candidates so far."""

    keyframes: int = 0
    """That were looked at."""
    candidates: int = 0
    """Pairs that were compared."""
    geometry: int = 0
    """Of them, those that passed the gate of geometry, or came from the poses themselves."""
    registration: int = 0
    """Of these, those that registration confirmed both ways."""
    depth: int = 0
    """Of these, those where neither measured what the other saw empty."""
    unique: int = 0
    """Of these, those that look like nowhere else."""
    plausible: int = 0
    """Of these, those that tracking may have drifted by."""
    switched_off: int = 0
    """Of these, loops that the pose graph gives no weight."""
    solved: int = 0
    """Times that the graph was solved."""
    moved_keyframes: int = 0
    """Keyframes that moved, summed over these."""
    largest_move_m: float = 0.0
    """Of one keyframe at once [m]."""
    joined: int = 0
    """Times that two parts were joined."""
    remapped: int = 0
    """Times that a part of the map was made anew."""
    remapped_keyframes: int = 0
    """Keyframes that it was made of, summed over these."""

    @classmethod
    def of(cls, values: Mapping[str, float]) -> LoopFigures:
        """From `LoopState.figures`.

        Raises:
            KeyError: One is missing.
        """
        kinds: dict[str, Any] = {one.name: float if one.type == "float" else int for one in fields(cls)}
        return cls(**{name: kind(values[name]) for name, kind in kinds.items()})

    def count(self, verdict: Verdict) -> None:
        """A candidate and what became of it."""
        order = [Gate.GEOMETRY, Gate.REGISTRATION, Gate.DEPTH, Gate.UNIQUE, Gate.PLAUSIBLE, Gate.PASSED]
        self.candidates += 1
        for gate in order[: order.index(verdict.gate)]:
            name = str(gate)
            setattr(self, name, getattr(self, name) + 1)


@dataclass(frozen=True, eq=False)
class LoopState:
    """All that the next keyframe depends on beside keyframes and images."""

    arrays: dict[str, np.ndarray]
    """Edges: "tracked", "loop" and "bridge", then "_pairs", "_transforms", "_covariances"; and of `MadePoses`,
    "made_frames" and "made_poses".
    """
    seen: int
    """Keyframes that were looked at."""
    figures: dict[str, float]
    """`LoopFigures`, by name."""


class LoopCloser:
    """Finds loops among the keyframes of a tracker and mends its poses.

    Args:
        tracker: Whose keyframes they are; it tells what it registers, and asks where a lost camera may be.
        images: Where theirs are kept.
        config: Settings.

    Raises:
        ConfigError: GTSAM is not installed.
    """

    def __init__(self, tracker: DirectTracker, images: ImagePool, config: LoopConfig) -> None:
        import_gtsam()
        self.tracker, self.config = tracker, config
        self.graph = PoseGraph()
        self.index = PlaceIndex()
        self.features = FeatureCache(tracker, images)
        self.verifier = Verifier(tracker, self.features)
        self.figures = LoopFigures()
        self.made = MadePoses()
        self.seconds = 0.0
        """Spent since the start, or since the last resume."""
        self.remapping_seconds = 0.0
        """The same, of mapping anew."""
        self.log: list[dict[str, Any]] = []
        """Candidates and what became of them, since the start or the last resume."""
        tracker.hooks = self

    # -- what tracking tells and asks ----------------------------------------------------------------------------

    def link(self, i: int, j: int, T_i_j: np.ndarray, covariance: np.ndarray) -> None:
        """Two keyframes were registered to each other; far ones are a loop's business."""
        if abs(i - j) <= GAP or not self._is_joined(max(i, j)):
            self.graph.track(i, j, T_i_j, covariance)

    def refined(self, window: Sequence[int]) -> None:
        """Among neighbours, what tracking has come to is all that is known of them. Where it has come back to a place,
        the way there is believed as it was, else the gap that the window closed would be taken for motion.
        """
        if max(window) - min(window) <= WINDOW_SPAN:
            keyframes = self.tracker.keyframes
            self.graph.settle(set(window), lambda number: keyframes[number].pose)

    def serves_again(self, old: int, reference: int) -> bool:
        """Not where tracking has come back to it by a way that no loop closes yet."""
        return abs(old - reference) <= GAP or self._holds_near(old, reference)

    def places(self, picture: Picture) -> list[int]:
        """Keyframes that share most words with a frame."""
        return self.index.likeliest(Words.of(self.features.of_picture(picture).descriptors), self.config.places)

    @property
    def has_new(self) -> bool:
        """Whether there are keyframes that were not looked at."""
        return len(self.index) < len(self.tracker.keyframes)

    # -- loops ---------------------------------------------------------------------------------------------------

    def look(self, history: FrameHistory) -> Closed | None:
        """Compare the keyframes that are new since the last call; what that changed, None if nothing."""
        start, closed = time.perf_counter(), None
        keyframes = self.tracker.keyframes
        self.made.note_new(keyframes)
        for number in range(len(self.index), len(keyframes)):
            words = self._take_up_one(number)
            self.figures.keyframes += 1
            news = [
                (other, number) for other in self._candidates(number, words) if self._compare(other, number, history)
            ]
            if news:
                closed = self._solve(news, history) or closed
        self.seconds += time.perf_counter() - start
        return closed

    def _candidates(self, number: int, words: Words) -> list[int]:
        """Old keyframes that one may show the place of."""
        before = number - GAP
        if before <= 0:
            return []
        near = {k: share for k, share in self.tracker.overlap.items() if k < before and self._is_expected(k, number)}
        expected = sorted(near, key=lambda k: -near[k])[:1]
        alike = self.index.likeliest(words, self.config.candidates, before, least=STAND_OUT)
        parts = self.graph.parts(len(self.tracker.keyframes))  # later ones, too: edges lead to them already
        others = parts[:before] != parts[number]
        if others.any():  # of other parts, too: nothing tells which of their places are near
            alike += self.index.likeliest(words, self.config.candidates, before, least=STAND_OUT, among=others)
        found: list[int] = []
        for k in [*expected, *alike]:
            if not self.graph.are_linked(k, number) and all(abs(k - other) > NEXT_TO for other in found):
                found.append(k)
        return found

    def _is_expected(self, old: int, new: int) -> bool:
        """Whether two keyframes see the same by the poses that they have."""
        keyframes = self.tracker.keyframes
        step, turn = motion_between(keyframes[old].pose, keyframes[new].pose)
        return bool(self.tracker.overlap.get(old, 0.0) > LEAST_OVERLAP and step < NEAR[0] and turn < NEAR[1])

    def _compare(self, old: int, new: int, history: FrameHistory) -> bool:
        """Whether a pair is a loop that says something new."""
        poses = self.tracker.keyframes
        expected = inverse(poses[old].pose) @ poses[new].pose
        verdict = self.verifier.by_features(old, new)
        if verdict.T_a_b is None and self._is_expected(old, new):
            verdict = Verdict(Gate.PASSED, T_a_b=expected)
        if verdict.T_a_b is not None:
            verdict = self.verifier.by_images(old, new, verdict.T_a_b)
        if verdict.gate is Gate.PASSED and verdict.T_a_b is not None:
            why = self._why_implausible(old, new, verdict.T_a_b, expected)
            verdict = Verdict(Gate.PLAUSIBLE, why, verdict.T_a_b) if why else verdict
        self.figures.count(verdict)
        frames = poses[old].index, poses[new].index
        self.log.append({"frames": frames, "gate": str(verdict.gate), "why": verdict.why, "T": verdict.T_a_b})
        if verdict.gate is not Gate.PASSED or verdict.T_a_b is None or verdict.covariance is None:
            return False
        if not np.isfinite(self.graph.way(new, len(poses))[old]):
            self.graph.bridge(old, new, verdict.T_a_b, verdict.covariance)
            return self._join(old, new, history)
        self.graph.close(old, new, verdict.T_a_b, verdict.covariance)
        edge = self.graph.loops[old, new]
        return edge.squared_error(poses[old].pose, poses[new].pose) > NEWS

    def _join(self, old: int, new: int, history: FrameHistory) -> bool:
        """Join the parts of two keyframes if another loop between them says the same: the later part goes to where the
        loop has it. Whether it did.
        """
        keyframes = self.tracker.keyframes
        parts = self.graph.parts(len(keyframes))
        moved, held = sorted((new, old), key=lambda k: -int(parts[k]))

        def moves(pair: tuple[int, int], edge: Edge) -> np.ndarray | None:
            """What takes the later part to where a loop has it, (4, 4)."""
            T = edge.T_i_j
            if [parts[k] for k in pair] == [parts[moved], parts[held]]:
                pair, T = (pair[1], pair[0]), inverse(T)
            if [parts[k] for k in pair] != [parts[held], parts[moved]]:
                return None
            return orthonormalized(keyframes[pair[0]].pose @ T @ inverse(keyframes[pair[1]].pose))

        own = min(old, new), max(old, new)
        T_new_old = moves(own, self.graph.bridges[own])
        assert T_new_old is not None
        agreed = [own]
        for pair, edge in self.graph.bridges.items():
            T = moves(pair, edge)
            if pair == own or T is None:
                continue
            step, turn = motion_between(T @ keyframes[moved].pose, T_new_old @ keyframes[moved].pose)
            if step < JOINED[0] and turn < JOINED[1]:
                agreed.append(pair)
        if len(agreed) < 2:
            return False
        later = np.flatnonzero(parts == parts[moved]).tolist()
        self.tracker.move_keyframes({k: orthonormalized(T_new_old @ keyframes[k].pose) for k in later}, history)
        for pair in agreed:
            self.graph.loops[pair] = self.graph.bridges.pop(pair)
        self.figures.joined += 1
        return True

    def _why_implausible(self, old: int, new: int, T_a_b: np.ndarray, expected: np.ndarray) -> str:
        """Whether tracking would have to have drifted too far; empty if not."""
        way = float(self.graph.way(new, len(self.tracker.keyframes))[old])
        step, turn = motion_between(expected, T_a_b)
        config = self.config
        if not np.isfinite(way):
            return ""
        if step > config.drift_floor + config.drift * way or turn > config.turn_floor + config.turn_drift * way:
            return f"tracking would have drifted by {step:.2f} m and {turn:.1f} degrees on a way of {way:.1f} m"
        return ""

    def _solve(self, news: Sequence[tuple[int, int]], history: FrameHistory) -> Closed | None:
        """Poses that fit all edges; loops that the others contradict are taken out, and if they are all that is new,
        everything stays where it is.
        """
        keyframes = self.tracker.keyframes
        before = np.array([keyframe.pose for keyframe in keyframes])
        solution = self.graph.solve(before, self.tracker.fixed)
        for pair, weight in solution.weights.items():
            if weight < LEAST_WEIGHT:
                del self.graph.loops[pair]
                self.figures.switched_off += 1
        if all(solution.weights[pair] < LEAST_WEIGHT for pair in news):
            return None
        poses = {k: pose for k, pose in enumerate(solution.poses) if k >= self.tracker.fixed}
        self.tracker.move_keyframes(poses, history)
        steps = np.linalg.norm(solution.poses[:, :3, 3] - before[:, :3, 3], axis=1)
        closed = Closed(int((steps > LEAST_MOVE).sum()), float(steps.max()))
        figures = self.figures
        figures.solved += 1
        figures.moved_keyframes += closed.moved
        figures.largest_move_m = max(figures.largest_move_m, closed.largest)
        return closed

    def remapping(self, seen: Sequence[SeenDepth], history: FrameHistory, config: Config) -> Remapping | None:
        """What must be mapped anew, given what mapped frames saw; None if nothing. It counts as done from now on."""
        least = MOVED * config.grid.fine_spacing
        poses = [history.pose(one.index) for one in seen]
        moved = moved_views(self.made, seen, poses, least)
        if not moved:
            return None
        keyframes, tracker = self.tracker.keyframes, self.tracker
        shifts = [self.made.shift(one.index, one.pose, tracker.mean_depth(k)) for k, one in enumerate(keyframes)]
        for view in moved:
            self.made.note(view.index, view.after)
        for one, shift in zip(keyframes, shifts, strict=True):
            if shift > least:
                self.made.note(one.index, one.pose)
        iterations = round(config.loops.remapping * config.mapping.iterations)
        number = self.figures.remapped
        self.figures.remapped += 1
        return Remapping(tracker.camera, moved, np.array(shifts), least, max(iterations, 1), number)

    def note_remapped(self, keyframes: int, seconds: float) -> None:
        """What `remapping` returned is done."""
        self.figures.remapped_keyframes += keyframes
        self.remapping_seconds += seconds

    def _holds_near(self, i: int, j: int) -> bool:
        """Whether a loop joins the surroundings of two keyframes."""
        low, high = min(i, j), max(i, j)
        return any(abs(a - low) <= NEARBY and abs(b - high) <= NEARBY for a, b in self.graph.loops)

    def _is_joined(self, number: int) -> bool:
        return any(number in pair for pair in self.graph.tracked)

    def take_up(self) -> None:
        """Keyframes that come from a file which knows of no loops: they lie to each other as they do."""
        keyframes = self.tracker.keyframes
        self.made.note_new(keyframes)
        for number in range(len(self.index), len(keyframes)):
            self._take_up_one(number)
            if number:
                T = inverse(keyframes[number - 1].pose) @ keyframes[number].pose
                self.graph.track(number - 1, number, T, UNTOLD)

    def _take_up_one(self, number: int) -> Words:
        words = Words.of(self.features.of(number).descriptors)
        self.index.add(words)
        return words

    # -- told and saved ------------------------------------------------------------------------------------------

    @property
    def edges(self) -> list[tuple[int, int]]:
        """Loops that hold: the frames of their two keyframes."""
        frames = [keyframe.index for keyframe in self.tracker.keyframes]
        return [(frames[i], frames[j]) for i, j in self.graph.loops]

    def account(self) -> dict[str, Any]:
        """Figures for metrics.json."""
        count = len(self.tracker.keyframes)
        apart = int((self.graph.parts(count) > 0).sum()) if count else 0
        return {
            **vars(self.figures),
            "apart_keyframes": apart,
            "edges": [list(pair) for pair in self.edges],
            "seconds": self.seconds,
            "remapping_seconds": self.remapping_seconds,
        }

    def state(self) -> LoopState:
        """All of it as arrays."""
        arrays: dict[str, np.ndarray] = {}
        for kind, edges in self._edges:
            arrays |= {f"{kind}_{name}": array for name, array in edges_to_arrays(edges).items()}
        arrays |= {f"made_{name}": array for name, array in self.made.arrays().items()}
        return LoopState(arrays, len(self.index), dict(vars(self.figures)))

    @property
    def _edges(self) -> tuple[tuple[str, dict[tuple[int, int], Edge]], ...]:
        graph = self.graph
        return ("tracked", graph.tracked), ("loop", graph.loops), ("bridge", graph.bridges)

    def restore(self, state: LoopState) -> None:
        """Go on from what `state` returned; keyframes and images are restored already."""
        names = "pairs", "transforms", "covariances"
        for kind, edges in self._edges:
            edges.update(edges_from_arrays(*(state.arrays[f"{kind}_{name}"] for name in names)))
        for number in range(state.seen):
            self._take_up_one(number)
        self.made.restore(state.arrays["made_frames"], state.arrays["made_poses"])
        self.figures = LoopFigures.of(state.figures)
