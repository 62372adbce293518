"""The account of a run: what it counts, and that files give it back."""

from __future__ import annotations

import json
import time

import numpy as np
import pytest

from tools.attacks.values import mutated_json
from warpslam.frames import FrameResult
from warpslam.runs.record import RunRecord
from warpslam.storage.json_files import to_json


def pose(x: float) -> np.ndarray:
    T = np.eye(4)
    T[0, 3] = x
    return T


def made() -> RunRecord:
    """Frames 2 to 4 of a sequence, of which 3 can't be read and 4 is skipped, without a true pose."""
    record = RunRecord(position=3, first_index=7, digests={2: "ab"})
    record.add(2, pose(1), FrameResult(7, 0.1, pose(1.5), losses={"tracking": 0.5}, timings={"tracking": 0.25}))
    record.leave_out(3, "truncated")
    unknown = np.full((4, 4), np.nan)
    record.add(4, unknown, FrameResult(8, 0.3, pose(1.5), "SKIPPED", inliers=0.0, message="black"))
    record.seconds["reading"] = 2.0
    return record


def test_counts_losses_and_truth():
    """By status; NaN where a frame has no value."""
    record = made()
    assert record.counts == {"processed": 2, "unreadable": 1, "OK": 1, "LOST": 0, "SKIPPED": 1}
    assert record.usable == [0] and record.has_truth and not RunRecord().has_truth
    np.testing.assert_array_equal(record.losses["tracking"], [0.5, np.nan])
    assert RunRecord().truth.shape == (0, 4, 4)


def test_a_checkpoint_gives_all_of_it_back():
    """Header and arrays, after a trip through JSON."""
    record = made()
    header, arrays = record.to_state()
    again = RunRecord.from_state(json.loads(json.dumps(header)), dict(arrays))
    for name in ("frame_indices", "left_out", "seconds", "first_index", "position", "digests", "counts"):
        assert getattr(again, name) == getattr(record, name), name
    np.testing.assert_array_equal(again.truth, record.truth)
    for one, other in zip(again.results, record.results, strict=True):
        np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)
        assert one.losses == other.losses and one.timings == other.timings and one.message == other.message
    header["frame_indices"].pop()
    with pytest.raises(ValueError, match="different lengths"):
        RunRecord.from_state(header, dict(arrays))


def test_any_header_is_a_record_or_a_value_error():
    """Parts replaced by what does not belong there, or left out; what is accepted has the kinds that it promises."""
    header, arrays = made().to_state()
    header, outcomes = json.loads(json.dumps(header)), {"read": 0, "refused": 0}
    for seed in range(1000):
        try:
            record = RunRecord.from_state(mutated_json(header, np.random.default_rng(seed)), dict(arrays))
        except ValueError:
            outcomes["refused"] += 1
            continue
        outcomes["read"] += 1
        assert record.counts["processed"] == 2 and json.dumps(record.to_state()[0]) and record.losses is not None
        assert all(type(index) is int for index in (*record.frame_indices, *record.digests, record.position))
    assert all(outcomes.values()), outcomes


def test_frames_outside_of_the_sequence_are_named():
    """The frames of each list; those within are no error."""
    record = made()
    record.check_frames(5)
    for name, index, count in (("frame_indices", 4, 4), ("digests", 9, 5), ("left_out", 7, 5)):
        other = made()
        if name == "digests":
            other.digests[index] = "ab"
        elif name == "left_out":
            other.leave_out(index, "")
        with pytest.raises(ValueError, match=f"{name}: frame {index} is none of the {count}"):
            other.check_frames(count)


@pytest.mark.parametrize(
    "damage",
    [
        lambda header, arrays: header.update(position=2), lambda header, arrays: header.pop("seconds"),
        lambda header, arrays: header["results"][0].update(sensor_timing={"readout": 1.0}),
        lambda header, arrays: header["results"][0].update(status="FINE"),
        lambda header, arrays: header["results"][0].update(covariance=[[1.0]]),
        lambda header, arrays: arrays.update(run_poses=3 * arrays["run_poses"]),
        lambda header, arrays: arrays.update(run_poses=arrays["run_poses"].reshape(-1, 16)),
        lambda header, arrays: arrays.update(run_truth_poses=arrays["run_truth_poses"].astype(np.int64)),
        lambda header, arrays: arrays.update(run_truth_poses=1e300 * arrays["run_truth_poses"]),
    ],
)  # fmt: skip
def test_a_record_that_can_not_be_is_refused(damage):
    """Values that contradict one another, or that nothing could be computed from."""
    header, arrays = made().to_state()
    header, arrays = json.loads(json.dumps(header)), dict(arrays)
    RunRecord.from_state(header, dict(arrays))
    damage(header, arrays)
    with pytest.raises(ValueError):
        RunRecord.from_state(header, arrays)


def test_frames_json_gives_back_what_became_of_the_frames():
    """Unknown numbers are null in the file and NaN again; the number of frames must be that of the poses."""
    record = made()
    record.results[0].losses["mapping"] = float("nan")
    content = json.loads(to_json(record.to_rows()))
    again = RunRecord.from_rows(content, np.array([pose(1.5)] * 2), None)
    assert again.frame_indices == [2, 4] and again.left_out == record.left_out and again.counts == record.counts
    assert [result.message for result in again.results] == ["", "black"]
    assert np.isnan(again.losses["mapping"]).all() and again.losses["tracking"][0] == 0.5 and not again.has_truth
    with pytest.raises(ValueError):
        RunRecord.from_rows(content, np.eye(4)[None], None)
    for row in content["frames"]:
        del row["depth_error"]  # as in files of early runs
    assert np.isnan(RunRecord.from_rows(content, np.array([pose(1.5)] * 2), None).results[0].depth_error)


def test_the_clock_counts_what_is_still_going_on():
    """A stage under way is in the time so far; once it is over the two agree."""
    record = made()
    with record.clock("frames"), record.clock("reading"):
        time.sleep(0.01)
        so_far = record.seconds_so_far()
        assert so_far["frames"] >= 0.01 and so_far["reading"] >= 2.01 and record.seconds["reading"] == 2.0
    assert record.seconds["reading"] >= so_far["reading"] and record.seconds_so_far() == record.seconds
