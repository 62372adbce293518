"""What can be told about a sequence before anything is computed: what is wrong, where, and what to type.

An "error" can't work, or makes the result meaningless; a "warning" will cost accuracy or frames; "ok" was looked at
and is fine. All thresholds are about rooms: a camera for people, surfaces from a hand's breadth to a hall away.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from warpslam.errors import DatasetError, FrameError, MissingDependencyError
from warpslam.frames import exposure_fault, read_images
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.sequences.files import FileSequence
from warpslam.sequences.findings import ERROR as ERROR
from warpslam.sequences.findings import OK as OK
from warpslam.sequences.findings import WARNING as WARNING
from warpslam.sequences.findings import CheckReport as CheckReport
from warpslam.sequences.findings import Finding as Finding
from warpslam.sequences.images import ImageSequence
from warpslam.sequences.pairing import frame_number
from warpslam.sequences.pose_checks import KNOWN_DEPTH_SCALES, PoseFit, camera_text, check_poses
from warpslam.sequences.structure_checks import check_registration, check_structure
from warpslam.spread import spread

MAX_DEPTH = 10.0
"""Depth beyond this does not count by default [m]."""
QUICK_SAMPLES, THOROUGH_SAMPLES = 5, 16

_DEPTH_RANGE = (0.25, 8.0)  # median [m] of a plausible room
_MAX_MISSING = 0.6
_MAX_STEP = 0.05  # [m] between two stored depth values
_MIN_FIELD_OF_VIEW, _MAX_FIELD_OF_VIEW = 25.0, 120.0  # [degree]
_MAX_OFF_CENTRE = 0.2  # of the image, principal point
_MAX_PAUSE = 1.0  # [s]
_SMALL = 0.5  # [m]: what is smaller shows nothing to a grid of 16 cm
_USUAL_EXTENT, _USUAL_DEPTH = 1.6, 3.2  # [m] of what the settings are made for
_MIN_LEVELS = 50  # points, or values of depth, that say something
_NAMED = 3  # frames or files named in a message


@dataclass(frozen=True)
class _Sample:
    index: int
    frame: Frame | None
    fault: str | None  # why it can't be used


def check_folder(
    path: str | Path,
    dataset: str = "auto",
    camera: str | None = None,
    topics: str | None = None,
    *,
    sample_count: int | None = THOROUGH_SAMPLES,
    max_depth: float = MAX_DEPTH,
    read_poses: Callable[[RgbdSequence], tuple[np.ndarray, Path]] | None = None,
) -> CheckReport:
    """Open the sequence in a folder and check it.

    Args:
        path: Folder of one sequence.
        dataset: Format, as `warpslam.sequences.open_sequence` takes it.
        camera: Camera, as `open_sequence` takes it.
        topics: Topics of a bag, as `open_sequence` takes them.
        sample_count: Frames to read, spread over the sequence; None for all.
        max_depth: Depth beyond this does not count [m].
        read_poses: Poses (N, 4, 4) that a run over the sequence would be given, and the file that they are from.
    """
    from warpslam.sequences import open_sequence

    try:
        sequence = open_sequence(path, dataset, camera, topics)
        poses, file = (None, None) if read_poses is None else read_poses(sequence)
    except (DatasetError, MissingDependencyError) as error:
        return CheckReport(str(path), findings=(Finding("sequence", ERROR, str(error)),))
    findings = check_sequence(
        sequence,
        sample_count=sample_count,
        thorough=True,
        max_depth=max_depth,
        given_poses=poses,
        given_path=file,
    )
    return CheckReport(str(path), sequence.name, len(sequence), tuple(findings))


def check_sequence(
    sequence: RgbdSequence,
    frames: Sequence[int] | None = None,
    *,
    sample_count: int | None = QUICK_SAMPLES,
    max_depth: float = MAX_DEPTH,
    poses_matter: bool = True,
    thorough: bool = False,
    given_poses: np.ndarray | None = None,
    given_path: Path | None = None,
) -> list[Finding]:
    """Check a sequence that could be opened.

    Args:
        sequence: The sequence.
        frames: Numbers of the frames that will be used; all by default.
        sample_count: Frames to read, spread over them; None for all.
        max_depth: Depth beyond this does not count [m].
        poses_matter: Poses that do not fit the depth are an error, not only a warning.
        thorough: Also ask the file system for every file.
        given_poses: Poses of these frames, (N, 4, 4), NaN where unknown, that take the place of the sequence's own.
        given_path: The file that they are from.
    """
    frames = range(len(sequence)) if frames is None else frames
    count = len(frames) if sample_count is None else min(sample_count, len(frames))
    chosen = [frames[i] for i in spread(len(frames), count)]
    samples = [_sample(sequence, index) for index in chosen]
    findings = [*_check_frames(samples), *_check_files(sequence, frames, thorough), *_check_times(sequence, frames)]
    good = [sample.frame for sample in samples if sample.frame is not None]
    fit = PoseFit.of(sequence, frames)
    given = None if given_poses is None else PoseFit.of(sequence, frames, given_poses, given_path)
    findings += _check_camera(sequence)
    if good:
        findings += [*_check_depth(sequence, good, max_depth, given or fit), *_check_exposure(good)]
        findings += [*check_registration(good), *check_structure(sequence, good)]
    if given is None or fit.poses is not None:
        findings += check_poses(sequence, frames, fit, poses_matter)
    if given is not None:
        findings += check_poses(sequence, frames, given, poses_matter=True)
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
    remedy = f"give the camera of these images: --camera {camera_text(sequence)} with the right numbers"
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


def _check_depth(sequence: RgbdSequence, frames: list[Frame], max_depth: float, fit: PoseFit) -> Iterator[Finding]:
    depth = np.concatenate([frame.depth[::4, ::4].ravel() for frame in frames])
    missing = 1.0 - np.count_nonzero(depth > 0) / len(depth)
    values = depth[depth > 0]
    scale = sequence.calibration.depth_scale if isinstance(sequence, ImageSequence) else None
    yield _check_scale(sequence, frames, values, max_depth, fit)
    levels = np.unique(values[values <= max_depth])
    # Of values that are close to each other in depth; a hole between two walls says nothing.
    step = float(np.median(np.diff(levels))) if len(levels) > 1 else 0.0
    if step > _MAX_STEP or (len(levels) <= 256 and len(values) > 20 * 256 and step > 0.01):
        message = f"depth comes in steps of {100 * step:.1f} cm ({len(levels)} different values)"
        yield Finding("depth steps", WARNING, message, "store depth with 16 bits, for example in millimetres")
    if scale is not None and len(values):
        stored = values * scale
        saturated = float(np.mean(np.isclose(stored, 65535.0, rtol=1e-6)))
        if saturated > 0.01:
            message = f"{saturated:.0%} of depth has the largest stored value, 65535, which is no measurement"
            yield Finding("depth values", WARNING, message, "store 0 where depth is missing")
    severity = WARNING if missing > _MAX_MISSING else OK
    remedy = "keep nearer to surfaces, or avoid glass and sunlight" if missing > _MAX_MISSING else ""
    yield Finding("missing depth", severity, f"{missing:.0%} of the pixels have no depth", remedy)


def _check_scale(
    sequence: RgbdSequence, frames: list[Frame], values: np.ndarray, max_depth: float, fit: PoseFit
) -> Finding:
    """Whether depth is in the unit it is said to be in, and the scene of a size that the settings suit."""
    median = float(np.median(values)) if len(values) else 0.0
    beyond = float(np.mean(values > max_depth)) if len(values) else 1.0
    scale = sequence.calibration.depth_scale if isinstance(sequence, ImageSequence) else None
    size = max_depth / MAX_DEPTH  # that the settings are made for, beside a room
    nearest, farthest = (size * limit for limit in _DEPTH_RANGE)
    text = f"median depth is {median:.3g} m"
    if scale is not None and len(values) and _is_rotated(values * scale):
        message = "every stored depth is a multiple of 8: its bits are rotated, as SUN3D's are"
        return Finding("depth scale", ERROR, message, f"type --camera {camera_text(sequence, 8 * scale)}")
    extent = _extent(sequence, frames)
    if beyond <= 0.5 and nearest < median < farthest and not 0 < extent < _SMALL * size:
        return Finding("depth scale", OK, f"median depth {median:.2f} m, {beyond:.0%} beyond {max_depth:g} m")
    wanted = _round(extent / _USUAL_EXTENT if 0 < extent < _SMALL * size else median / _USUAL_DEPTH)
    as_large = f"--set scene_scale={wanted:g} makes grids and limits of that size"
    if 0 < extent < _SMALL * size and median < farthest and (fit.confirms or median > _DEPTH_RANGE[0]):
        message = f"what is measured is {100 * extent:.0f} cm across: small for grids of a room"
        return Finding("depth scale", WARNING, message, as_large)
    severity = ERROR if beyond > 0.9 else WARNING
    message = f"{text}, {beyond:.0%} lies beyond {max_depth:g} m"
    if fit.confirms:
        return Finding("depth scale", severity, f"{message}; the poses confirm the unit", as_large)
    fitting = [] if scale is None else [
        known for known in KNOWN_DEPTH_SCALES if _DEPTH_RANGE[0] < median * scale / known < _DEPTH_RANGE[1]
    ]  # fmt: skip
    if scale is not None:
        message = f"{text} with {scale:g} stored units per metre, {beyond:.0%} lies beyond {max_depth:g} m"
    if not fitting:
        return Finding(
            "depth scale", severity, message, f"check the unit of depth; if the scene is as large, {as_large}"
        )
    options = " or ".join(f"{known:g}" for known in fitting)
    remedy = f"a depth_scale of {options} would suit a room: --camera {camera_text(sequence, fitting[0])}; "
    return Finding("depth scale", severity, message, remedy + f"if the scene is as large as that, {as_large}")


def _is_rotated(stored: np.ndarray) -> bool:
    """Whether 16-bit values (N,) have their low three bits at 0 all over: SUN3D rotates millimetres left by three."""
    whole = np.rint(stored)
    if np.abs(stored - whole).max() > 1e-2 or whole.max() > 65535 or len(np.unique(whole)) < _MIN_LEVELS:
        return False
    return bool((whole % 8 == 0).all())


def _extent(sequence: RgbdSequence, frames: list[Frame]) -> float:
    """Largest side of the box around what a frame measures [m], outliers left out; the median over frames."""
    sizes = []
    for frame in frames:
        v, u = (4 * index for index in np.nonzero(frame.depth[::4, ::4]))
        if len(u) >= _MIN_LEVELS:
            points = sequence.intrinsics.backproject(u, v, frame.depth[v, u])
            sizes.append(float(np.ptp(np.percentile(points, (2, 98), axis=0), axis=0).max()))
    return float(np.median(sizes)) if sizes else 0.0


def _round(factor: float) -> float:
    """The nearest of 1, 1.5, 2, 3, 4, 5, 6, 8 times a power of ten."""
    if factor <= 0:
        return 1.0
    power = 10.0 ** np.floor(np.log10(factor))
    steps = np.array([1, 1.5, 2, 3, 4, 5, 6, 8, 10])
    return float(f"{power * steps[np.argmin(np.abs(np.log(steps * power / factor)))]:.3g}")


def _check_exposure(frames: list[Frame]) -> Iterator[Finding]:
    faults = Counter(fault.split(" (")[0] for frame in frames if (fault := exposure_fault(frame.rgb)) is not None)
    for fault, count in faults.items():
        severity = ERROR if count == len(frames) else WARNING
        message = f"{fault} in {count} of the {len(frames)} frames looked at"
        yield Finding("colour", severity, message, "such frames are left out; light the scene, or fix the exposure")
    if not faults:
        yield Finding("colour", OK, "no image is black or over-exposed")
