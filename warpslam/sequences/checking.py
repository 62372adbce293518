"""What can be told about a sequence before anything is computed: what is wrong, where, and what to type.

An "error" can't work, or makes the result meaningless; a "warning" will cost accuracy or frames; "ok" was looked at
and is fine. All thresholds are about rooms: a camera for people, surfaces from a hand's breadth to a hall away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from warpslam.errors import DatasetError, FrameError
from warpslam.frames import exposure_fault, read_images
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.sequences.files import FileSequence
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pairing import frame_number
from warpslam.sequences.pose_convention import CONVENTIONS, EXPECTED, DepthView, agreement, moving_pairs
from warpslam.spread import spread

OK, WARNING, ERROR = "ok", "warning", "error"
MAX_DEPTH = 10.0
"""Depth beyond this does not count by default [m]."""
QUICK_SAMPLES, THOROUGH_SAMPLES = 5, 16
KNOWN_DEPTH_SCALES = (1.0, 256.0, 1000.0, 5000.0, 6553.5, 10000.0)
"""Stored units per metre that are in use."""

_DEPTH_RANGE = (0.25, 8.0)  # median [m] of a plausible room
_MAX_MISSING = 0.6
_MAX_STEP = 0.05  # [m] between two stored depth values
_MIN_FIELD_OF_VIEW, _MAX_FIELD_OF_VIEW = 25.0, 120.0  # [degree]
_MAX_OFF_CENTRE = 0.2  # of the image, principal point
_MAX_JUMP = 0.5  # [m] of the true pose from frame to frame
_MAX_PAUSE = 1.0  # [s]
_PAIR_COUNT = 6  # of frames that poses and depth are compared in
_SURE = 0.85  # agreement of depth and poses beyond which nothing else is tried
_NAMED = 3  # frames or files named in a message


@dataclass(frozen=True)
class Finding:
    """What one check came to."""

    check: str
    """What was looked at."""
    severity: str
    """One of "error", "warning" and "ok"."""
    message: str
    """What is so, and where."""
    remedy: str = ""
    """What to do or type; empty where nothing is wrong."""

    def __str__(self) -> str:
        return f"{self.check}: {self.message}" + (f"; {self.remedy}" if self.remedy else "")


@dataclass(frozen=True)
class CheckReport:
    """All findings about one folder."""

    folder: str
    """What was checked."""
    name: str = ""
    """Of the sequence; empty if it can't be opened."""
    frames: int = 0
    """How many it has."""
    findings: tuple[Finding, ...] = field(default_factory=tuple)

    @property
    def errors(self) -> list[Finding]:
        """Findings that can't work."""
        return [finding for finding in self.findings if finding.severity == ERROR]

    @property
    def warnings(self) -> list[Finding]:
        """Findings that will cost something."""
        return [finding for finding in self.findings if finding.severity == WARNING]

    def to_dict(self) -> dict[str, Any]:
        """Plain values, for JSON."""
        return {**asdict(self), "errors": len(self.errors), "warnings": len(self.warnings)}


@dataclass(frozen=True)
class _Sample:
    index: int
    frame: Frame | None
    fault: str | None  # why it can't be used


def check_folder(
    path: str | Path,
    dataset: str = "auto",
    camera: str | None = None,
    *,
    sample_count: int | None = THOROUGH_SAMPLES,
) -> CheckReport:
    """Open the sequence in a folder and check it.

    Args:
        path: Folder of one sequence.
        dataset: Format, as `warpslam.sequences.open_sequence` takes it.
        camera: Camera, as `open_sequence` takes it.
        sample_count: Frames to read, spread over the sequence; None for all.
    """
    from warpslam.sequences import open_sequence

    try:
        sequence = open_sequence(path, dataset, camera)
    except DatasetError as error:
        return CheckReport(str(path), findings=(Finding("sequence", ERROR, str(error)),))
    findings = check_sequence(sequence, sample_count=sample_count, thorough=True)
    return CheckReport(str(path), sequence.name, len(sequence), tuple(findings))


def check_sequence(
    sequence: RgbdSequence,
    frames: Sequence[int] | None = None,
    *,
    sample_count: int | None = QUICK_SAMPLES,
    max_depth: float = MAX_DEPTH,
    poses_matter: bool = True,
    thorough: bool = False,
) -> list[Finding]:
    """Check a sequence that could be opened.

    Args:
        sequence: The sequence.
        frames: Numbers of the frames that will be used; all by default.
        sample_count: Frames to read, spread over them; None for all.
        max_depth: Depth beyond this does not count [m].
        poses_matter: Poses that do not fit the depth are an error, not only a warning.
        thorough: Also ask the file system for every file.
    """
    frames = range(len(sequence)) if frames is None else frames
    count = len(frames) if sample_count is None else min(sample_count, len(frames))
    chosen = [frames[i] for i in spread(len(frames), count)]
    samples = [_sample(sequence, index) for index in chosen]
    findings = [*_check_frames(samples), *_check_files(sequence, frames, thorough), *_check_times(sequence, frames)]
    good = [sample.frame for sample in samples if sample.frame is not None]
    findings += _check_camera(sequence)
    if good:
        findings += [*_check_depth(sequence, good, max_depth), *_check_exposure(good)]
    findings += _check_poses(sequence, frames, poses_matter)
    return findings


def _sample(sequence: RgbdSequence, index: int) -> _Sample:
    try:
        frame = sequence[index]
    except DatasetError as error:
        return _Sample(index, None, str(error))
    try:
        read_images(frame.rgb, frame.depth, sequence.intrinsics, np.inf, colored=False)
    except FrameError as error:
        return _Sample(index, None, f"frame {index}: {error}")
    return _Sample(index, frame, None)


def _check_frames(samples: list[_Sample]) -> Iterator[Finding]:
    faults = [sample.fault for sample in samples if sample.fault is not None]
    if not faults:
        yield Finding("frames", OK, f"{len(samples)} frames read, all usable")
        return
    named = "; ".join(faults[:_NAMED]) + ("; ..." if len(faults) > _NAMED else "")
    if len(faults) == len(samples):
        message = f"none of the {len(samples)} frames looked at can be used: {named}"
        yield Finding("frames", ERROR, message, "fetch the sequence again")
    else:
        message = f"{len(faults)} of the {len(samples)} frames looked at can't be used and will be left out: {named}"
        yield Finding("frames", WARNING, message, "fetch these files again")


def _check_files(sequence: RgbdSequence, frames: Sequence[int], thorough: bool) -> Iterator[Finding]:
    for remark in sequence.remarks:
        yield Finding(remark.check, OK if remark.is_fine else WARNING, remark.message, remark.remedy)
    if not isinstance(sequence, FileSequence):
        return
    numbers = [frame_number(sequence.files(index)[0]) for index in range(len(sequence))]
    known = [number for number in numbers if number is not None]
    steps = np.diff(known)
    # Names with times, as TUM's, differ by anything.
    usual = int(np.median(steps)) if len(steps) else 0
    gaps = np.flatnonzero(steps > usual)
    if len(known) == len(numbers) and 0 < usual < 1000 and 0 < len(gaps) <= 0.2 * len(numbers):
        where = ", ".join(sequence.files(int(gap) + 1)[0].name for gap in gaps[:_NAMED])
        yield Finding(
            "frame numbers", WARNING, f"{len(gaps)} gaps in the file numbers, before {where}",
            "add the missing frames: tracking bridges small motions only",
        )  # fmt: skip
    if thorough:
        bad = [path for index in frames for path in sequence.files(index) if not _holds_something(path)]
        if bad:
            named = ", ".join(str(path) for path in bad[:_NAMED]) + (", ..." if len(bad) > _NAMED else "")
            message = f"{len(bad)} image files are missing or empty: {named}"
            yield Finding("files", WARNING, message, "fetch these files again; their frames will be left out")
        else:
            yield Finding("files", OK, "all image files are there")


def _holds_something(path: Path) -> bool:
    try:
        return path.stat().st_size > 0
    except OSError:
        return False


def _check_times(sequence: RgbdSequence, frames: Sequence[int]) -> Iterator[Finding]:
    times = getattr(sequence, "timestamps", None)
    if times is None:
        return
    times = np.asarray(times, dtype=np.float64)[np.asarray(frames)]
    steps = np.diff(times)
    backward = np.flatnonzero(~(steps > 0))
    if len(backward):
        where = ", ".join(f"frame {frames[int(i) + 1]} ({times[i + 1]:.6f} s)" for i in backward[:_NAMED])
        yield Finding(
            "timestamps", WARNING, f"{len(backward)} times are not after the frame before: {where}",
            "sort the list by time and remove duplicates; such frames will be left out",
        )  # fmt: skip
        return
    longest = int(np.argmax(steps)) if len(steps) else 0
    if len(steps) and steps[longest] > max(_MAX_PAUSE, 5 * float(np.median(steps))):
        message = f"{steps[longest]:.2f} s without an image before frame {frames[longest + 1]}"
        yield Finding("timestamps", WARNING, message, "use --frames to take one side of the pause")
        return
    yield Finding("timestamps", OK, f"in order, {len(times)} from {times[0]:.3f} to {times[-1]:.3f} s")


def _check_camera(sequence: RgbdSequence) -> Iterator[Finding]:
    camera = sequence.intrinsics
    text = f"fx {camera.fx:g} fy {camera.fy:g} cx {camera.cx:g} cy {camera.cy:g}, {camera.width} x {camera.height}"
    remedy = f"give the camera of these images: --camera {_camera_text(sequence)} with the right numbers"
    across = np.degrees(2 * np.arctan(camera.width / (2 * camera.fx)))
    off = max(abs(camera.cx / camera.width - 0.5), abs(camera.cy / camera.height - 0.5))
    if off >= 0.45:
        twice = abs(camera.cx / camera.width - 1) < 0.1 and abs(camera.cy / camera.height - 1) < 0.1
        why = " (they look like those of an image twice as large)" if twice else ""
        yield Finding("camera", ERROR, f"the principal point is not well inside the image: {text}{why}", remedy)
    elif off > _MAX_OFF_CENTRE:
        yield Finding("camera", WARNING, f"the principal point is far from the middle of the image: {text}", remedy)
    elif not _MIN_FIELD_OF_VIEW < across < _MAX_FIELD_OF_VIEW:
        yield Finding("camera", WARNING, f"a field of view of {across:.0f} degrees is unusual: {text}", remedy)
    elif not 0.8 < camera.fx / camera.fy < 1.25:
        yield Finding("camera", WARNING, f"fx and fy differ by more than a quarter: {text}", remedy)
    else:
        yield Finding("camera", OK, f"{text}, {across:.0f} degrees across")


def _camera_text(sequence: RgbdSequence, depth_scale: float | None = None) -> str:
    """The stored camera as ``--camera`` takes it."""
    if not isinstance(sequence, ImageSequence):
        return "FX,FY,CX,CY,WIDTH,HEIGHT,DEPTH_SCALE"
    k = sequence.calibration.stored
    numbers = (k.fx, k.fy, k.cx, k.cy, k.width, k.height, depth_scale or sequence.calibration.depth_scale)
    return ",".join(f"{number:g}" for number in numbers)


def _check_depth(sequence: RgbdSequence, frames: list[Frame], max_depth: float) -> Iterator[Finding]:
    depth = np.concatenate([frame.depth[::4, ::4].ravel() for frame in frames])
    missing = 1.0 - np.count_nonzero(depth > 0) / len(depth)
    values = depth[depth > 0]
    median = float(np.median(values)) if len(values) else 0.0
    beyond = float(np.mean(values > max_depth)) if len(values) else 1.0
    scale = sequence.calibration.depth_scale if isinstance(sequence, ImageSequence) else None
    if beyond > 0.9 or not _DEPTH_RANGE[0] < median < _DEPTH_RANGE[1]:
        remedy = "check the unit of depth"
        fitting = [] if scale is None else [
            known for known in KNOWN_DEPTH_SCALES if _DEPTH_RANGE[0] < median * scale / known < _DEPTH_RANGE[1]
        ]  # fmt: skip
        if fitting:
            options = " or ".join(f"{known:g}" for known in fitting)
            remedy = f"a depth_scale of {options} would suit a room: --camera {_camera_text(sequence, fitting[0])}"
        unit = "" if scale is None else f" with {scale:g} stored units per metre"
        severity = ERROR if beyond > 0.9 else WARNING
        message = f"median depth is {median:.3g} m{unit}, {beyond:.0%} lies beyond {max_depth:g} m"
        yield Finding("depth scale", severity, message, remedy)
    else:
        yield Finding("depth scale", OK, f"median depth {median:.2f} m, {beyond:.0%} beyond {max_depth:g} m")
    levels = np.unique(values[values <= max_depth])
    # Of values that are close to each other in depth; a hole between two walls says nothing.
    step = float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0
    if step > _MAX_STEP or (len(levels) <= 256 and len(values) > 20 * 256 and step > 0.01):
        message = f"depth comes in steps of {100 * step:.1f} cm ({len(levels)} different values)"
        yield Finding("depth steps", WARNING, message, "store depth with 16 bits, for example in millimetres")
    if scale is not None and len(values):
        saturated = float(np.mean(np.isclose(values * scale, 65535.0, rtol=1e-6)))
        if saturated > 0.01:
            message = f"{saturated:.0%} of depth has the largest stored value, 65535, which is no measurement"
            yield Finding("depth values", WARNING, message, "store 0 where depth is missing")
    severity = WARNING if missing > _MAX_MISSING else OK
    remedy = "keep nearer to surfaces, or avoid glass and sunlight" if missing > _MAX_MISSING else ""
    yield Finding("missing depth", severity, f"{missing:.0%} of the pixels have no depth", remedy)


def _check_exposure(frames: list[Frame]) -> Iterator[Finding]:
    faults = Counter(fault.split(" (")[0] for frame in frames if (fault := exposure_fault(frame.rgb)) is not None)
    for fault, count in faults.items():
        severity = ERROR if count == len(frames) else WARNING
        message = f"{fault} in {count} of the {len(frames)} frames looked at"
        yield Finding("colour", severity, message, "such frames are left out; light the scene, or fix the exposure")
    if not faults:
        yield Finding("colour", OK, "no image is black or over-exposed")


def _check_poses(sequence: RgbdSequence, frames: Sequence[int], poses_matter: bool) -> Iterator[Finding]:
    truth = sequence.ground_truth()
    if truth is None:
        yield Finding("poses", OK, "no ground truth: no trajectory error will be given")
        return
    truth = truth[np.asarray(frames)]
    known = np.isfinite(truth).all(axis=(1, 2))
    if not known.all():
        message = f"{np.count_nonzero(~known)} of {len(known)} frames have no pose"
        yield Finding("poses", WARNING if poses_matter else OK, message)
    jumps = np.linalg.norm(np.diff(truth[:, :3, 3], axis=0), axis=1)
    stride = getattr(frames, "step", 1)
    large = np.flatnonzero(jumps > _MAX_JUMP * stride)
    if len(large):
        where = ", ".join(f"frame {frames[int(i) + 1]} ({jumps[i]:.2f} m)" for i in large[:_NAMED])
        message = f"{len(large)} poses jump from one frame to the next: {where}"
        yield Finding("poses", WARNING, message, "check that poses belong to these frames and are in metres")
    yield _check_convention(sequence, frames, truth, poses_matter)


def _check_convention(sequence: RgbdSequence, frames: Sequence[int], truth: np.ndarray, poses_matter: bool) -> Finding:
    pairs: list[tuple[DepthView, DepthView]] = []
    for i, j in moving_pairs(truth, 2 * _PAIR_COUNT):
        if len(pairs) == _PAIR_COUNT:
            break
        try:
            depths = [sequence[frames[k]].depth for k in (i, j)]
        except DatasetError:
            continue  # reported with the frames
        pairs.append((DepthView(depths[0], truth[i]), DepthView(depths[1], truth[j])))
    if not pairs:
        return Finding("pose convention", OK, "the camera moves too little, or its frames can't be read, to tell")
    camera = sequence.intrinsics
    scores = {name: agreement(pairs, camera, name) for name in CONVENTIONS}
    best, given = max(scores, key=lambda name: scores[name]), scores[EXPECTED]
    bad = ERROR if poses_matter else WARNING
    if scores[best] > 0.5 and scores[best] > given + 0.15:
        steps = []
        if best.startswith("world"):
            steps.append("T = numpy.linalg.inv(T)")
        if best.endswith("OpenGL axes"):
            steps.append("T[:, 1:3] *= -1")
        message = f"poses are read as {EXPECTED}, which {given:.0%} of the depth agrees with; as {best} it is "
        message += f"{scores[best]:.0%}"
        return Finding("pose convention", bad, message, "convert each 4x4 matrix T: " + "; ".join(steps))
    if given < _SURE and isinstance(sequence, ImageSequence):
        # Every scale fits a little where the camera only turns, so another one has to fit clearly better.
        scale = sequence.calibration.depth_scale
        others = [known for known in KNOWN_DEPTH_SCALES if known != scale]
        fits = {known: agreement(pairs, camera, depth_factor=scale / known) for known in others}
        better = max(others, key=lambda known: fits[known])
        if fits[better] > 0.5 and fits[better] > given + 0.15:
            message = f"with depth_scale {scale:g} {given:.0%} of the depth agrees with the poses, with {better:g} "
            message += f"{fits[better]:.0%}"
            return Finding("depth scale", bad, message, f"type --camera {_camera_text(sequence, better)}")
    if given > 0.5:
        return Finding("pose convention", OK, f"{given:.0%} of the depth agrees with the poses, as {EXPECTED}")
    message = f"only {given:.0%} of the depth agrees with the poses, and no other convention fits"
    return Finding("pose convention", WARNING, message, "check that poses, camera and frames are of one recording")
