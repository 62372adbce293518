"""Run folders that somebody has altered: whatever lies there is read, or is one typed error that names the file."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest

from tools.attacks.values import mutated_bytes, mutated_json
from warpslam.errors import DatasetError
from warpslam.report import accounts, sections
from warpslam.report.data import RunData
from warpslam.runs.folder import RunFolder
from warpslam.runs.panels import Panel, load_panels, save_panels

TEXTS = ("metrics", "timing", "frame_records", "source", "config", "trajectory", "ground_truth")
SECTIONS = (
    sections.run_header, sections.figures_section, sections.trajectory_section, sections.error_section,
    sections.keyframes_section, accounts.timing_section, accounts.memory_section, accounts.frames_section,
    accounts.settings_section, accounts.versions_section,
)  # fmt: skip
"""All that shows no image."""


def report_on(folder: RunFolder) -> None:
    """Everything that is read, in words and charts."""
    run = RunData.gather(folder)
    for section in SECTIONS:
        section(run)


@pytest.mark.parametrize("name", TEXTS)
def test_what_is_no_text_is_one_error(make_run: Callable[..., RunFolder], name: str):
    """A byte that UTF-8 does not know, at any place of any file of text."""
    folder = make_run()
    path: Path = getattr(folder, name)
    data = path.read_bytes()
    for at in np.linspace(0, len(data), 7).astype(int):
        path.write_bytes(data[:at] + b"\xc5" + data[at:])
        with pytest.raises(DatasetError, match=rf"{path.name}.*UTF-8") as raised:
            report_on(folder)
        assert "0xc5" in str(raised.value)


@pytest.mark.parametrize("name", ["metrics", "timing", "frame_records", "source"])
def test_wrong_values_are_read_or_one_error(make_run: Callable[..., RunFolder], name: str):
    """Parts of the JSON replaced by what does not belong there, or left out: hundreds of files."""
    folder = make_run()
    path: Path = getattr(folder, name)
    value = json.loads(path.read_bytes())
    outcomes = {"read": 0, "refused": 0}
    for seed in range(400):
        path.write_text(json.dumps(mutated_json(value, np.random.default_rng(seed))))
        try:
            report_on(folder)
            outcomes["read"] += 1
        except DatasetError as error:
            assert path.name in str(error), f"seed {seed}"
            outcomes["refused"] += 1
    assert all(outcomes.values()), outcomes


def test_missing_times_and_numbers_that_are_lists_are_named(make_run: Callable[..., RunFolder]):
    """The message has the field; what early versions left out is read."""
    folder = make_run()
    timing = json.loads(folder.timing.read_bytes())
    for wrong, field in (
        ({"frames": [{"tracking": 1.0}]}, "frames.0.index"),
        ({"frames": [{"index": 0, "tracking": [1.0]}]}, "frames.0.tracking"),
        ({"phases": {"tracking": {"seconds": "long"}}}, "phases.tracking.seconds"),
        ({"phases": {"tracking": 3}}, "phases.tracking"),
        ({"stages_seconds": [1, 2]}, "stages_seconds"),
    ):
        folder.timing.write_text(json.dumps({**timing, **wrong}))
        with pytest.raises(DatasetError, match=rf"timing\.json: {field}: "):
            RunData.gather(folder)
    folder.timing.write_text(json.dumps({"phases": {"tracking": {}}}))
    report_on(folder)


@pytest.fixture
def panels(tmp_path: Path) -> Path:
    """Images of two frames."""
    rng = np.random.default_rng(0)
    shape = (12, 16)
    images = (
        rng.integers(0, 255, (*shape, 3), np.uint8),
        rng.random(shape),
        rng.random((*shape, 3)),
        rng.random(shape),
    )
    path = tmp_path / "panels.npz"
    save_panels(path, [Panel(0, *images), Panel(3, *images)])
    assert [panel.index for panel in load_panels(path)] == [0, 3]
    return path


def test_archives_damaged_anywhere_are_read_or_one_error(panels: Path):
    """Every byte changed, and cuts, holes and foreign parts: streams that do not inflate among them."""
    data = panels.read_bytes()

    def damaged() -> Iterator[bytes]:
        for at in range(len(data)):
            yield data[:at] + bytes([data[at] ^ 0x55]) + data[at + 1 :]
        for seed in range(300):
            yield mutated_bytes(data, np.random.default_rng(seed))

    for content in damaged():
        panels.write_bytes(content)
        try:
            load_panels(panels)
        except DatasetError as error:
            assert str(panels) in str(error)


@pytest.mark.parametrize("name", ["index", "rgb", "depth", "rendered_rgb", "rendered_depth"])
def test_arrays_of_other_types_and_shapes_are_one_error(panels: Path, name: str):
    """What an archive holds must fit together; what is no archive, or unfolds into gigabytes, is refused as well."""
    with np.load(panels) as file:
        arrays = dict(file)
    array = arrays[name]
    for wrong in (array.astype(np.float32), array[:1], array[None], array.reshape(1, -1), None):
        changed = {key: array for key, array in arrays.items() if key != name}
        np.savez(panels, **changed, **({} if wrong is None else {name: wrong}))
        with pytest.raises(DatasetError, match=r"panels\.npz"):
            load_panels(panels)
    with open(panels, "wb") as file:
        np.save(file, arrays[name])
    with pytest.raises(DatasetError, match=r"panels\.npz"):
        load_panels(panels)
    np.savez_compressed(panels, **{**arrays, "more": np.zeros(1 << 25)})
    with pytest.raises(DatasetError, match="256 MB, expected at most|expected at most 256"):
        load_panels(panels)
