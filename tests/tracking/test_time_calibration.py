"""Delay and readout from images alone: the search for a minimum, and the cost of a room that was taken row by row."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
import warp as wp

from tests.kernels.swept_room import SweptRoom
from warpslam import cli
from warpslam.camera import FrameMotion, Intrinsics, SensorTiming
from warpslam.errors import DatasetError
from warpslam.poses import motion_of
from warpslam.sequences import open_sequence
from warpslam.sequences.base import Frame, RgbdSequence
from warpslam.tracking.time_calibration import AlignmentCost, find_timing

CAMERA = Intrinsics(140.0, 140.0, 79.5, 59.5, 160, 120)
TRUE = SensorTiming(-0.017, 0.024)
FRAMES = 36


def bowl(readout: float, delay: float, rise: tuple[float, float] = (0.1, 0.1), tilt: float = 0.0, scale=0.01):
    """A cost whose lowest value, 0.5, lies at a timing, and that rises by ``rise`` at a distance of ``scale`` [s]."""

    def cost(timing: SensorTiming) -> float:
        x, y = (timing.readout - readout) / scale, (timing.depth_delay - delay) / scale
        return 0.5 + rise[0] * x * x + rise[1] * y * y + tilt * x * y

    return cost


@pytest.mark.parametrize("true", [(0.026, -0.020), (0.013, 0.033), (0.0, 0.0), (0.037, -0.055), (0.003, -0.007)])
def test_minimum_between_the_nodes_is_found(true):
    """Wherever it lies, and however the two lean on one another; few hypotheses are tried."""
    tried = []
    estimate = find_timing(bowl(*true, tilt=0.08), report=tried.append)
    assert (estimate.readout.seconds, estimate.depth_delay.seconds) == pytest.approx(true, abs=1e-5)
    assert estimate.readout.is_determined and estimate.depth_delay.is_determined
    assert estimate.timing == SensorTiming(true[1], true[0])
    assert estimate.uncorrected >= estimate.cost >= 0.5
    assert tried == list(range(1, len(tried) + 1)) and len(tried) < 100


def test_flatness_is_that_of_the_cost():
    """0.5 % of 0.5 is reached at a distance of 10 ms where the cost rises by 0.005 there; tilt makes it flatter."""
    estimate = find_timing(bowl(0.02, -0.02, rise=(0.005, 0.02)))
    assert estimate.readout.spread == pytest.approx(0.010, rel=1e-3)
    assert estimate.depth_delay.spread == pytest.approx(0.005, rel=1e-3)
    assert find_timing(bowl(0.02, -0.02, (0.005, 0.02), tilt=0.01)).readout.spread > 0.0101


def test_what_is_flat_is_not_determined():
    """A cost that does not care of the delay: it stays as it was, and the readout is the one that fits it."""
    cost = bowl(0.02, 0.01, rise=(0.1, 1e-4), tilt=2e-3)
    estimate = find_timing(cost, SensorTiming(-0.015, 0.0))
    assert not estimate.depth_delay.is_determined and estimate.readout.is_determined
    fits = 0.02 - 2e-3 * (-0.015 - 0.01) / (2 * 0.1)
    assert estimate.readout.seconds == pytest.approx(fits, abs=1e-5)
    assert estimate.timing == SensorTiming(-0.015, round(fits, 3))
    nothing = find_timing(lambda timing: 0.5, SensorTiming(0.004, 0.03))
    assert nothing.timing == SensorTiming(0.004, 0.03)
    assert not nothing.readout.is_determined and not nothing.depth_delay.is_determined


def test_minimum_out_of_reach_is_not_determined():
    """A cost that falls towards a delay beyond the grid."""
    estimate = find_timing(bowl(0.02, -0.15))
    assert estimate.depth_delay.at_edge and not estimate.depth_delay.is_determined


class SweptSequence(RgbdSequence):
    """A camera that swings through a room, with a delay and a rolling shutter; ``speed`` scales its motion.

    Its noise is a Kinect's after images of 640 x 480 were halved twice.
    """

    name = "swept"
    intrinsics = CAMERA

    def __init__(
        self, timing: SensorTiming = TRUE, speed: float = 1.0, *, stamped: float = 0.0, grain: float = 0.0
    ) -> None:
        self.true, self.speed, self.stamped, self.room = timing, speed, stamped, SweptRoom(grain=grain)
        rng = np.random.default_rng(0)
        self._waves = rng.uniform(2.0, 5.0, 6), rng.uniform(0.0, 6.3, 6), np.array([0.1, 0.1, 0.1, 0.12, 0.15, 0.12])

    def __len__(self) -> int:
        return FRAMES

    def pose(self, time: float) -> np.ndarray:
        """T_world_camera (4, 4)."""
        rates, phases, sizes = self._waves
        return motion_of(self.speed * sizes * np.sin(rates * time + phases))

    def __getitem__(self, index: int) -> Frame:
        if not 0 <= index < FRAMES:
            raise IndexError(index)
        time, dt = index / 30, 1e-4
        pose = self.pose(time)
        step = np.linalg.inv(self.pose(time - dt)) @ self.pose(time + dt)
        twist = np.r_[step[:3, 3], step[2, 1], step[0, 2], step[1, 0]] / (2 * dt)
        offset = self.true.depth_delay + self.stamped
        rgb, depth = self.room.take(CAMERA, pose, FrameMotion(tuple(twist), offset, self.true.readout))
        noise = np.random.default_rng(index)
        rgb = np.clip(rgb + noise.normal(0.0, 2.0, rgb.shape), 0, 255).astype(np.uint8)
        depth += 0.25 * (0.0012 + 0.0019 * (depth - 0.4) ** 2) * noise.normal(size=depth.shape).astype(np.float32)
        return Frame(index, time, rgb, depth, pose, time + self.stamped if self.stamped else None)


@pytest.mark.parametrize("stamped", [0.0, 0.009])
def test_timing_of_a_camera_in_a_room(stamped):
    """Found to 3 ms, beyond what the stamps say; at the truth the cost is well below that without correction."""
    cost = AlignmentCost(SweptSequence(stamped=stamped), range(FRAMES), wp.get_device("cpu"))
    assert len(cost.pairs) >= 25
    assert cost(TRUE) < 0.9 * cost(SensorTiming())
    estimate = find_timing(cost)
    assert estimate.depth_delay.is_determined and estimate.readout.is_determined
    assert estimate.depth_delay.seconds == pytest.approx(TRUE.depth_delay, abs=0.003)
    assert estimate.readout.seconds == pytest.approx(TRUE.readout, abs=0.003)


def test_global_shutter_without_delay_is_found_to_be_one():
    """Nothing to correct: 0 and 0, to 3 ms."""
    estimate = find_timing(AlignmentCost(SweptSequence(SensorTiming()), range(FRAMES), wp.get_device("cpu")))
    assert abs(estimate.depth_delay.seconds) < 0.003 and estimate.readout.seconds < 0.003


def test_sharp_texture_does_not_draw_away_from_nothing():
    """Where nothing is to be corrected, a texture of cells as wide as a pixel doesn't favour what moves points off it.
    (Compared without blur, the cost at nothing is half as high again as 10 ms away.)
    """
    cost = AlignmentCost(SweptSequence(SensorTiming(), grain=30.0), range(FRAMES), wp.get_device("cpu"))
    assert cost(SensorTiming()) < 1.2 * min(cost(SensorTiming(delay, 0.0)) for delay in (-0.01, 0.01))


def test_a_camera_that_stands_still_tells_nothing():
    """Neither is determined."""
    still = SweptSequence(speed=0.0)
    estimate = find_timing(AlignmentCost(still, range(FRAMES), wp.get_device("cpu")), SensorTiming(-0.01, 0.0))
    assert not estimate.depth_delay.is_determined and not estimate.readout.is_determined
    assert estimate.timing == SensorTiming(-0.01, 0.0)


def test_too_few_frames_are_refused():
    """The error says how many pairs there are, and how many are needed."""
    with pytest.raises(DatasetError, match="only 4 of 4 pairs.*8 are needed"):
        AlignmentCost(SweptSequence(), range(10), wp.get_device("cpu"))
    with pytest.raises(DatasetError, match="only 0 of 0"):
        AlignmentCost(SweptSequence(), range(3), wp.get_device("cpu"))


@pytest.fixture(scope="module")
def recording(tmp_path_factory):
    """The same camera as a folder of TUM's layout, with stamps of depth."""
    folder = tmp_path_factory.mktemp("swept")
    lines: dict[str, list[str]] = {"rgb": [], "depth": []}
    for frame in SweptSequence(stamped=0.009):
        units = np.rint(5000 * frame.depth).astype(np.uint16)
        for kind, image, time in (
            ("rgb", frame.rgb[..., ::-1], 100 + frame.timestamp), ("depth", units, 100 + frame.depth_timestamp)
        ):  # fmt: skip
            (folder / kind).mkdir(exist_ok=True)
            cv2.imwrite(str(folder / kind / f"{time:.6f}.png"), image)
            lines[kind].append(f"{time:.6f} {kind}/{time:.6f}.png\n")
    for kind, entries in lines.items():
        (folder / f"{kind}.txt").write_text("".join(entries))
    return folder


def test_command_prints_and_writes_the_camera(recording, capsys):
    """What is printed can be pasted into camera.yaml; --write does it, and the sequence then has the timing."""
    camera = ["--camera", "140,140,79.5,59.5,160,120,5000"]
    assert cli.main(["calibrate-time", str(recording), "--device", "cpu", "--write", *camera]) == 0
    out = capsys.readouterr().out
    assert "with stamps of depth" in out and "raise the cost by 1 %" in out and "written to" in out
    sequence = open_sequence(recording)
    assert sequence.intrinsics == CAMERA
    assert sequence.timing.depth_delay == pytest.approx(TRUE.depth_delay, abs=0.004)
    assert sequence.timing.readout == pytest.approx(TRUE.readout, abs=0.004)
    assert f"depth_delay: {sequence.timing.depth_delay:g}\nreadout: {sequence.timing.readout:g}" in out
    assert cli.main(["calibrate-time", str(recording), "--device", "cpu", "--frames", "0:8"]) == 2
    assert "pairs of frames" in capsys.readouterr().err
