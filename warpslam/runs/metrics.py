"""The figures of a run: content of metrics.json, field by field.

A figure that a run does not have is left out of the file; null stands for a number that can't be told. Both read as
None. ``python -m warpslam.runs.metrics`` prints all fields.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, get_args

from pydantic import BaseModel, ConfigDict, Field

from warpslam.frames import FrameStatus
from warpslam.storage.json_files import Finite, Index, Number, read_as, to_json, write_json

_Corner = Annotated[list[Number], Field(min_length=3, max_length=3)]
_Bounds = Annotated[list[_Corner], Field(min_length=2, max_length=2)]


class _Part(BaseModel):
    # Files of other versions may have more; what they have is kept.
    model_config = ConfigDict(extra="allow")


def _part(kind: type[_Part], description: str) -> Any:
    """A group of figures, empty where the file has none."""
    return Field(default_factory=kind, description=description)


class FrameCounts(_Part):
    """Frames by what became of them."""

    selected: int | None = Field(None, description="frames asked for")
    processed: int | None = Field(None, description="frames that the method was given: OK, LOST and SKIPPED")
    unreadable: int | None = Field(None, description="frames left out: unreadable, or without a pose that is needed")
    OK: int | None = Field(None, description="frames whose pose was found")
    LOST: int | None = Field(None, description="frames whose pose was not found; they changed nothing in the map")
    SKIPPED: int | None = Field(None, description="frames that nothing could be told from")

    @property
    def by_status(self) -> list[tuple[str, int]]:
        """Name and number of each kind that there are any of."""
        names = (*map(str, FrameStatus), "unreadable")
        return [(name, count) for name in names if (count := getattr(self, name))]


class UnusableFrame(_Part):
    """A frame without a result."""

    frame: int = Field(description="number in the sequence")
    status: str = Field(description="unreadable or SKIPPED")
    reason: str = Field("", description="why")


class Seconds(_Part):
    """Wall time."""

    total: Number = Field(None, description="whole run [s]")
    kernel_compile: Number = Field(None, description="of that, compiling and loading kernels [s]")
    run: Number = Field(None, description="the rest [s]")
    frames: Number = Field(None, description="from the first frame to the last [s]")


class InputCheck(_Part):
    """What the checks of the input found; see `warpslam.sequences.checking`."""

    check: str = Field(description="what was looked at")
    severity: str = Field(description="error or warning")
    message: str = Field(description="what is so, and where")
    remedy: str = Field("", description="what to do")


class Checkpoint(_Part):
    """Checkpoints of the run."""

    bytes: int | None = Field(None, description="size of the last one [bytes]")
    every_frames: int | None = Field(None, description="frames between two")


class FoundTiming(_Part):
    """The camera's timing as the run found it, as camera.yaml takes it."""

    depth_delay: Number = Field(None, description="time of depth minus time of colour, beyond their stamps [s]")
    depth_delay_sigma: Number = Field(None, description="its standard deviation [s]")
    readout: Number = Field(None, description="time from the first to the last row [s]")
    readout_sigma: Number = Field(None, description="its standard deviation [s]")
    after_frame: int | None = Field(None, description="it is used after this frame, a number in the sequence")

    @property
    def text(self) -> str:
        """In a line."""
        values = [
            f"{name} {value:.4f} +- {sigma or 0:.4f} s"
            for name, value, sigma in (
                ("depth_delay", self.depth_delay, self.depth_delay_sigma),
                ("readout", self.readout, self.readout_sigma),
            )
            if value is not None
        ]
        return f"{', '.join(values)}, used after frame {self.after_frame}"


class Statistics(_Part):
    """An error over all frames or pairs of frames."""

    rmse: Number = Field(None, description="root of the mean square")
    mean: Number = Field(None, description="mean")
    median: Number = Field(None, description="median")
    std: Number = Field(None, description="population standard deviation")
    min: Number = Field(None, description="smallest")
    max: Number = Field(None, description="largest")


class AbsoluteErrors(_Part):
    """Absolute trajectory error (ATE) [m]."""

    aligned: Statistics = _part(Statistics, "after rigid alignment (Horn, no scale) [m]")
    unaligned: Statistics = _part(Statistics, "in the world of the first pose [m]")
    frames_without_truth: int | None = Field(None, description="frames left out, for want of a true pose")


class RelativeErrors(_Part):
    """Relative pose error (RPE)."""

    delta_frames: int | None = Field(None, description="frames between the two of a pair")
    translation_m: Statistics = _part(Statistics, "translation [m]")
    rotation_deg: Statistics = _part(Statistics, "rotation [deg]")


class MapSize(_Part):
    """What the map takes."""

    bytes: int | None = Field(None, description="map itself, without optimiser state and images [bytes]")
    flops_per_point: int | None = Field(None, description="operations to evaluate a point; null if it is looked up")


class Level(_Part):
    """A feature grid."""

    spacing_m: Number = Field(None, description="edge of a cell [m]")
    shape: list[int] = Field(default_factory=list, description="vertices along x, y and z")
    bytes: int = Field(0, description="features [bytes]")


class Keyframes(_Part):
    """Keyframes and what they have in common."""

    frames: list[Index] = Field(default_factory=list, description="number of each among the processed frames")
    overlaps: list[tuple[Index, Index, Finite]] = Field(
        default_factory=list, description="pairs of positions in that list, and the share of their views in common"
    )


class Loops(_Part):
    """Places that were recognised, and what followed."""

    keyframes: int = Field(0, description="keyframes that were compared with older ones")
    candidates: int = Field(0, description="pairs of keyframes that were compared")
    geometry: int = Field(0, description="of them, pairs that one pose fits the features of, or the poses themselves")
    registration: int = Field(0, description="of these, pairs that registration confirms both ways")
    depth: int = Field(0, description="of these, pairs of which neither measured what the other saw empty")
    unique: int = Field(0, description="of these, pairs that look like nowhere else")
    plausible: int = Field(0, description="of these, loops: tracking may have drifted by what they say")
    switched_off: int = Field(0, description="of these, loops that all others contradict")
    solved: int = Field(0, description="times that poses were mended")
    moved_keyframes: int = Field(0, description="keyframes that moved, summed over these")
    largest_move_m: Number = Field(None, description="of one keyframe at once [m]")
    joined: int = Field(0, description="times that parts which nothing else joins were joined")
    apart_keyframes: int = Field(0, description="keyframes of parts that nothing joins to the first one")
    remapped: int = Field(0, description="times that a part of the map was made anew")
    remapped_keyframes: int = Field(0, description="keyframes that it was made of, summed over these")
    edges: list[tuple[Index, Index]] = Field(default_factory=list, description="loops: frames among those processed")
    seconds: Number = Field(None, description="spent, since the start or the last resume [s]")
    remapping_seconds: Number = Field(None, description="spent on making the map anew, likewise [s]")

    @property
    def text(self) -> str:
        """In a line."""
        passed = ", ".join(
            f"{getattr(self, gate)} passed {gate}" for gate in ("geometry", "registration", "depth", "unique")
        )
        apart = f"; {self.apart_keyframes} keyframes lie apart" if self.apart_keyframes else ""
        joined = f"; parts joined {self.joined} times" if self.joined else ""
        return (
            f"{self.candidates} pairs of keyframes compared; {passed}; {len(self.edges)} loops hold; poses mended "
            f"{self.solved} times, {self.moved_keyframes} keyframes moved, by up to "
            f"{100 * (self.largest_move_m or 0):.1f} cm; {self.seconds or 0:.1f} s; made anew {self.remapped} times of "
            f"{self.remapped_keyframes} keyframes, {self.remapping_seconds or 0:.1f} s{joined}{apart}"
        )


class Memory(_Part):
    """State that makes the map."""

    grid_bytes: int | None = Field(None, description="features of the grids [bytes]")
    keyframe_bytes: int | None = Field(None, description="compact images of keyframes [bytes]")
    seen_bytes: int | None = Field(None, description="what mapped frames saw, for the mesh [bytes]")
    state_bytes: int | None = Field(None, description="sum of the three [bytes]")
    image_slot_bytes: int | None = Field(None, description="images on the device, which come and go [bytes]")
    state_bytes_per_observed_m3: Number = Field(None, description="state per observed volume [bytes/m^3]")


class Mesh(_Part):
    """The mesh that was written."""

    vertices: int | None = Field(None, description="number of vertices")
    faces: int | None = Field(None, description="number of triangles")
    area_m2: Number = Field(None, description="surface [m^2]")
    error: str | None = Field(None, description="why there is none")


class VirtualViews(_Part):
    """Cameras from which reconstruction and true surface are looked at."""

    used: int | None = Field(None, description="views that count")
    drawn: int | None = Field(None, description="views that were tried")
    missed_share: Number = Field(None, description="pixels of the true surface without a reconstruction, 0..1")
    depth_l1_misses_as_zero_m: Number = Field(None, description="depth L1 with depth 0 at those pixels [m]")


class Reconstruction(_Part):
    """The mesh against the true surface; see `warpslam.evaluation.reconstruction`."""

    protocol: str | None = Field(None, description="culling protocol: which surface counts")
    accuracy_m: Number = Field(None, description="mean distance from the mesh to the true surface [m]")
    completion_m: Number = Field(None, description="mean distance from the true surface to the mesh [m]")
    accuracy_ratio_5cm: Number = Field(None, description="share of the mesh within 5 cm of the true surface, 0..1")
    completion_ratio_5cm: Number = Field(None, description="share of the true surface within 5 cm of the mesh, 0..1")
    f_score_5cm: Number = Field(None, description="harmonic mean of the two shares, 0..1")
    normal_consistency: Number = Field(None, description="mean |n . n'| of nearest points, 0..1")
    samples: int | None = Field(None, description="points drawn on the smaller of the two samples")
    T_truth_mesh: list[list[Number]] | None = Field(None, description="alignment that was applied to the mesh, 4 x 4")
    depth_l1_m: Number = Field(None, description="mean difference of depth on virtual views [m]")
    virtual_views: VirtualViews = _part(VirtualViews, "those views")
    error: str | None = Field(None, description="why there are no figures")


class Rendering(_Part):
    """Renderings of the map at estimated poses against what the camera saw."""

    frames: list[int] = Field(default_factory=list, description="numbers of the frames in the sequence")
    depth_l1_m: Number = Field(None, description="mean |rendered - measured depth| [m]")
    psnr_db: Number = Field(None, description="peak signal-to-noise ratio of the colour [dB]")
    ssim: Number = Field(None, description="structural similarity of the colour, at most 1; null for tiny images")


class Errors(_Part):
    """How far a run is from the truth."""

    ate_m: AbsoluteErrors = _part(AbsoluteErrors, "absolute trajectory error")
    rpe: RelativeErrors = _part(RelativeErrors, "relative pose error")
    reconstruction: Reconstruction = _part(Reconstruction, "mesh against the true surface")
    rendering: Rendering = _part(Rendering, "renderings against the input")

    def has(self, name: str) -> bool:
        """Whether the file has a field of that name."""
        return name in self.model_fields_set

    def fill(self, values: dict[str, Any]) -> None:
        """Set fields, as if they had been read from a file."""
        read = type(self).model_validate_json(to_json(values))
        for name in read.model_fields_set:
            setattr(self, name, getattr(read, name))


class RunMetrics(Errors):
    """Content of metrics.json."""

    warpslam: str | None = Field(None, description="version of warpslam")
    sequence: str | None = Field(None, description="name of the sequence")
    method: str | None = Field(None, description="what ran; see --method")
    poses: str | None = Field(None, description="file of the poses that were given; null for none")
    status: str | None = Field(None, description="finished, interrupted (ctrl-C) or failed")
    device: str | None = Field(None, description="Warp device")
    seed: int | None = Field(None, description="seed of every random choice")
    frames: FrameCounts = _part(FrameCounts, "frames by what became of them")
    unusable_frames: list[UnusableFrame] = Field(default_factory=list, description="frames without a result, and why")
    seconds: Seconds = _part(Seconds, "wall time")
    compiled_kernels: list[str] = Field(default_factory=list, description="kernel modules that had to be compiled")
    fps: Number = Field(None, description="processed frames per second of seconds.frames")
    peak_memory_mib: Number = Field(None, description="the most memory that the process has held [MiB]")
    started: str | None = Field(None, description="time of the start, with its time zone")
    versions: dict[str, str | None] = Field(default_factory=dict, description="packages; null for one not installed")
    platform: str | None = Field(None, description="operating system")
    processors: int | None = Field(None, description="processors of the machine")
    started_anew: str | None = Field(None, description="why a checkpoint was of no use")
    resumed_after: int | None = Field(None, description="frames that were taken over from a checkpoint")
    input_checks: list[InputCheck] = Field(default_factory=list, description="what the checks of the input found")
    checkpoint: Checkpoint = _part(Checkpoint, "checkpoints of the run")
    found_timing: FoundTiming = _part(FoundTiming, "timing of the camera, where it was estimated")
    map: MapSize = _part(MapSize, "what the map takes")
    levels: dict[str, Level] = Field(default_factory=dict, description="feature grids by level")
    bounds_m: _Bounds | None = Field(None, description="lower and upper corner of the grids [m]")
    observed_volume_m3: Number = Field(None, description="cells that depth rays of mapped frames crossed [m^3]")
    keyframes: Keyframes = _part(Keyframes, "keyframes")
    loops: Loops = _part(Loops, "places that were recognised; left out where none were looked for")
    memory: Memory = _part(Memory, "state that makes the map")
    mesh: Mesh = _part(Mesh, "mesh that was written")
    error: str | None = Field(None, description="what ended a run that failed")

    @classmethod
    def read(cls, path: Path) -> RunMetrics:
        """Read metrics.json, of other versions as well.

        Raises:
            DatasetError: The file can't be read, or a field is not of its kind.
        """
        return read_as(path, cls)

    def write(self, path: Path) -> None:
        """Write metrics.json.

        Raises:
            OSError: The file can't be written.
        """
        write_json(path, self.to_dict())

    def to_dict(self) -> dict[str, Any]:
        """The figures that the run has, in the order of `FILE_ORDER`."""
        values = self.model_dump(exclude_unset=True)
        return {name: values.pop(name) for name in FILE_ORDER if name in values} | values


class ComparedFrames(_Part):
    """Frames of a run that was compared with a trajectory."""

    estimated: int = Field(0, description="poses of the run")
    compared: int = Field(0, description="of those, poses that have a partner in the true trajectory")


class EvaluationMetrics(Errors):
    """What `warpslam eval` computes from the files of a run."""

    frames: ComparedFrames = _part(ComparedFrames, "frames that were compared")
    reconstruction_by_protocol: dict[str, Reconstruction] = Field(
        default_factory=dict, description="the same figures for each of several culling protocols"
    )


_ERRORS = ("ate_m", "rpe", "reconstruction", "rendering")
_OWN = [name for name in RunMetrics.model_fields if name not in _ERRORS]
_AT_MAP, _AT_END = _OWN.index("map"), _OWN.index("error")
FILE_ORDER = (*_OWN[:_AT_MAP], "ate_m", "rpe", *_OWN[_AT_MAP:_AT_END], "reconstruction", "rendering", "error")
"""Fields of metrics.json in the order in which a run comes by them."""


def field_table() -> Iterator[tuple[str, str]]:
    """Path and meaning of every field of metrics.json, such as ("ate_m.aligned.rmse", ...)."""
    for name in FILE_ORDER:
        yield from _rows(name, RunMetrics.model_fields[name])


def _rows(path: str, field: Any) -> Iterator[tuple[str, str]]:
    yield path, field.description
    for kind in (field.annotation, *get_args(field.annotation)):
        if isinstance(kind, type) and issubclass(kind, _Part):
            separator = "." if kind is field.annotation else ".*."
            for name, inner in kind.model_fields.items():
                yield from _rows(f"{path}{separator}{name}", inner)


if __name__ == "__main__":
    for path, meaning in field_table():
        print(f"{path:45} {meaning}")
