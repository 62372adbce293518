"""metrics.json as a model: what is written, what is read, and that every field says what it is."""

from __future__ import annotations

import json

import numpy as np
import pytest

from warpslam.errors import DatasetError
from warpslam.runs.metrics import FILE_ORDER, RunMetrics, field_table
from warpslam.storage.json_files import read_json, write_json


def test_only_what_a_run_has_is_written(tmp_path):
    """Absent figures are left out, unknown numbers are null, NumPy values are plain; reading gives the same again."""
    metrics = RunMetrics()
    metrics.fill({"mesh": {"faces": np.int64(3), "area_m2": float("nan")}, "fps": None, "bounds_m": np.eye(2, 3)})
    metrics.error = "it broke"
    metrics.write(tmp_path / "metrics.json")
    expected = {
        "fps": None, "bounds_m": [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]], "mesh": {"faces": 3, "area_m2": None},
        "error": "it broke",
    }  # fmt: skip
    assert read_json(tmp_path / "metrics.json") == expected
    assert list(read_json(tmp_path / "metrics.json")) == list(expected)
    again = RunMetrics.read(tmp_path / "metrics.json")
    assert again.to_dict() == expected and again.has("mesh") and not again.has("ate_m")
    assert again.ate_m.aligned.rmse is None, "a figure that is not there reads as None"


def test_files_of_other_versions_are_read(tmp_path):
    """Fields that this version does not know are kept, at every level."""
    content = {"status": "finished", "speed": [1], "ate_m": {"aligned": {"rmse": 0.5, "mode": 0.1}}}
    write_json(tmp_path / "metrics.json", content)
    metrics = RunMetrics.read(tmp_path / "metrics.json")
    assert metrics.ate_m.aligned.rmse == 0.5 and json.loads(json.dumps(metrics.to_dict())) == content


@pytest.mark.parametrize(
    ("content", "field"), [({"ate_m": {"aligned": {"rmse": "far"}}}, "ate_m.aligned.rmse"), ({"frames": 3}, "frames")]
)
def test_fields_that_do_not_fit_are_named(tmp_path, content, field):
    """The message has the file and the field."""
    write_json(tmp_path / "metrics.json", content)
    with pytest.raises(DatasetError, match=rf"metrics\.json: {field}: "):
        RunMetrics.read(tmp_path / "metrics.json")


def test_every_field_is_documented():
    """The table has each field of the file once, with a text."""
    table = dict(field_table())
    assert set(FILE_ORDER) == set(RunMetrics.model_fields) <= set(table) and len(FILE_ORDER) == len(set(FILE_ORDER))
    assert all(table.values()) and "[bytes]" in table["map.bytes"] and "unusable_frames.*.reason" in table
