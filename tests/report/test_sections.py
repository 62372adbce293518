"""The report of a run: every section, whatever the run has or lacks."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tests.fakes import FakeSequence
from tests.report.html_checks import Page
from warpslam.errors import ConfigError, DatasetError, MeshError
from warpslam.report import write_report
from warpslam.report.accounts import stage_seconds
from warpslam.report.data import RunData, axis_name, upright_axes
from warpslam.runs.folder import RunFolder
from warpslam.storage.json_files import read_json, write_json

SECTIONS = (
    "figures", "trajectory", "error", "images", "mesh", "keyframes", "timing", "memory", "frames", "settings",
    "versions", "files",
)  # fmt: skip


def report_of(folder: RunFolder) -> Page:
    page = Page(write_report(folder).read_text(encoding="utf-8"))
    assert page.problems == [] and page.external == []
    assert tuple(page.sections) == SECTIONS
    assert all(len(text) > 10 for text in page.sections.values())
    return page


def test_a_run_leaves_a_report(make_run):
    """The pipeline writes report.html by itself, whole, and needing nothing from elsewhere."""
    folder = make_run()
    page = Page(folder.report.read_text(encoding="utf-8"))
    assert page.problems == [] and page.external == [] and tuple(page.sections) == SECTIONS


def test_figures_of_a_whole_run(make_run):
    """Each section shows its figures, and nothing is called missing."""
    folder = make_run()
    metrics = read_json(folder.metrics)
    page = report_of(folder)
    ate = 100 * metrics["ate_m"]["aligned"]["rmse"]
    assert f"{ate:.2f} cm" in page.sections["figures"] and f"{ate:.3f} cm" in page.sections["trajectory"]
    assert "100 % within 5 cm" in page.sections["figures"] and "8 OK" in page.sections["figures"]
    assert f"RMSE {ate:.2f} cm" in page.sections["error"] and "loss per ray" in page.sections["error"]
    assert "Frame 2" in page.sections["images"] and "depth L1 3.00 cm" in page.sections["images"]
    assert page.tags.count("img") == 24 and page.tags.count("image") == 4
    assert "4 vertices · 2 faces" in page.sections["mesh"] and "From above" in page.sections["mesh"]
    assert "3 keyframes; 2 pairs" in page.sections["keyframes"] and "80.0 % in common" in page.sections["keyframes"]
    assert "mapping" in page.sections["timing"] and "12.5 m³" in page.sections["memory"]
    assert "0.32 m" in page.sections["memory"] and "4 × 5 × 6" in page.sections["memory"]
    assert "Every frame was tracked." in page.sections["frames"]
    assert "warpslam run somewhere --seed 0" in page.sections["settings"] and "window: 5" in page.sections["settings"]
    assert "torch" in page.sections["versions"]
    assert 'class="missing"' not in folder.report.read_text()


def test_loops_are_drawn_and_counted(make_run):
    """A line between the two keyframes of a loop, and what became of all candidates."""
    folder = make_run()
    assert "Loops:" not in report_of(folder).sections["keyframes"]
    figures = {"candidates": 7, "geometry": 3, "registration": 2, "depth": 1, "unique": 1, "plausible": 1, "solved": 1}
    loops = {**figures, "edges": [[0, 4]], "moved_keyframes": 3, "largest_move_m": 0.042, "seconds": 1.5}
    write_json(folder.metrics, read_json(folder.metrics) | {"loops": loops})
    shown = report_of(folder).sections["keyframes"]
    assert "loop: frames 0 and 4 show one place" in shown
    assert "7 pairs of keyframes compared; 3 passed geometry" in shown and "1 loops hold" in shown
    assert "3 keyframes moved, by up to 4.2 cm; 1.5 s" in shown


def test_without_ground_truth(make_run):
    """No truth is said plainly; the path and the losses are still drawn."""
    page = report_of(make_run(sequence=FakeSequence(6, no_truth=tuple(range(6)))))
    assert "no ground truth" in page.sections["figures"] and "no ground truth" in page.sections["trajectory"]
    assert "no ground truth" in page.sections["error"] and "loss per ray" in page.sections["error"]
    assert "6 of 6 frames" in page.text


def test_partial_truth_and_lost_and_unreadable_frames(make_run):
    """Frames without truth are counted; lost and unreadable ones are listed with their reasons."""
    page = report_of(make_run(sequence=FakeSequence(8, unreadable=(6,), no_truth=(2,)), lost_at=3))
    assert "1 frames have no truth" in page.sections["error"]
    assert "frame000006.jpg is truncated" in page.sections["frames"]
    assert "1 LOST" in page.sections["frames"] and "1 unreadable" in page.sections["frames"]
    assert "frame 3: LOST" in page.sections["trajectory"] and "frame 3: LOST" in page.sections["error"]


def test_without_a_mesh(make_run):
    """The reason why there is no mesh stands where it would be."""
    page = report_of(make_run(mesh_fails=True))
    assert "the map has no surface" in page.sections["mesh"] and "the map has no surface" in page.sections["figures"]


def test_failed_run(make_run):
    """A run that failed has a report that says why, with what there was until then."""
    folder = make_run(fail_at=2)
    assert folder.report.is_file()
    page = report_of(folder)
    assert "The run failed. RuntimeError: out of memory" in page.text
    assert "no images of its map" in page.sections["images"] and "There is no mesh" in page.sections["mesh"]
    assert "2 of 8 frames" in page.text


def test_run_without_a_single_frame(make_run):
    """Interrupted before anything was done: every section says so."""
    page = report_of(make_run(interrupt_at=0))
    for section in ("trajectory", "error"):
        assert "stopped before its first frame" in page.sections[section]
    assert "interrupted" in page.text and "No frame was processed" in page.sections["frames"]


def test_run_of_an_earlier_version(make_run):
    """A folder without the newer files makes a report that says what was not recorded."""
    folder = make_run()
    for path in (folder.frame_records, folder.panel_images, folder.config, folder.timing, folder.source):
        path.unlink()
    metrics = read_json(folder.metrics)
    write_json(folder.metrics, {name: metrics[name] for name in ("sequence", "status", "frames", "ate_m", "mesh")})
    page = report_of(folder)
    for section in ("images", "keyframes", "timing", "memory", "settings", "versions", "error"):
        assert "no" in page.sections[section], section


def test_names_from_outside_are_escaped(make_run):
    """A name or message that looks like markup stays text, in the page and in the script's data."""
    evil = '</script><img src=x onerror="alert(1)">&'
    sequence = FakeSequence(8)
    sequence.name = evil
    folder = make_run(sequence=sequence, lost_at=3)
    frames = read_json(folder.frame_records)
    frames["frames"][3].update(message=evil, status=evil)
    frames["left_out"] = [{"index": 9, "message": evil}]
    write_json(folder.frame_records, frames)
    folder.write_source(type(folder.read_source())(evil, command=evil))
    folder.config.write_text(evil)
    page = report_of(folder)
    assert page.text.count(evil) >= 6
    data = json.loads(page.scripts[-2])
    assert evil in data["text"][3] and len(data["text"]) == len(data["path"]) == len(data["time"]) == 8


def test_damaged_files_are_named(make_run):
    """A file that is not what it should be is a typed error with its name, and the old report stays."""
    folder = make_run()
    before = folder.report.read_bytes()
    for path, content, error in (
        (folder.panel_images, b"no zip", DatasetError),
        (folder.frame_records, b'{"frames": [{"index": 0}]}', DatasetError),
        (folder.mesh, b"ply\n", MeshError),
    ):
        kept = path.read_bytes()
        path.write_bytes(content)
        with pytest.raises(error, match=path.name):
            write_report(folder)
        path.write_bytes(kept)
    assert folder.report.read_bytes() == before
    with pytest.raises(ConfigError, match="choose another file"):
        write_report(folder, folder.path / "no" / "such" / "folder.html")


def test_a_report_that_fails_does_not_fail_the_run(make_run, monkeypatch):
    """The run's results count; the log says what stood in the way."""

    def refuse(folder):
        raise ConfigError("the disk is full")

    monkeypatch.setattr("warpslam.pipeline.run.write_report", refuse)
    folder = make_run()
    assert read_json(folder.metrics)["status"] == "finished" and not folder.report.exists()
    assert "no report: the disk is full" in folder.log.read_text()


def test_a_report_that_breaks_does_not_hide_why_the_run_failed(make_run, monkeypatch):
    """After a failure the run's own error comes through; after a good run a defect of the report does."""

    def break_(folder):
        raise ZeroDivisionError

    monkeypatch.setattr("warpslam.pipeline.run.write_report", break_)
    folder = make_run(fail_at=2)
    assert read_json(folder.metrics)["error"] == "RuntimeError: out of memory"
    assert "ZeroDivisionError" in folder.log.read_text()
    with pytest.raises(ZeroDivisionError):
        make_run("good")


def test_stages_make_up_the_total(make_run):
    """Containers such as frames and setup are not counted twice."""
    folder = make_run()
    timing = {
        "phases": {"tracking": {"seconds": 3.0, "calls": 3, "mean_seconds": 1.0}},
        "stages_seconds": {
            "kernel_compile": 1.0, "setup": 1.5, "reading": 0.5, "frames": 4.0, "finish": 2.0, "finish_mapping": 1.9,
            "meshing": 1.0, "total": 10.0,
        },
        "frames": [],
    }  # fmt: skip
    write_json(folder.timing, timing)
    stages = dict(stage_seconds(RunData.gather(folder)))
    expected = {"tracking": 3, "finish": 2, "other": 2, "kernel compile": 1, "meshing": 1, "setup": 0.5, "reading": 0.5}
    assert stages == pytest.approx(expected) and sum(stages.values()) == pytest.approx(10)


@pytest.mark.parametrize("up", [np.eye(3)[1], -np.eye(3)[1], np.eye(3)[2], -np.eye(3)[2], np.eye(3)[0]])
def test_the_view_from_above_is_never_mirrored(up):
    """Right, away and up form a right-handed frame whose up is the cameras'."""
    T = np.eye(4)
    forward = np.roll(np.abs(up), 1)
    T[:3, :3] = np.stack([np.cross(-up, forward), -up, forward], axis=1)
    right, away, above = upright_axes(T[None])
    np.testing.assert_allclose(np.cross(right, away), above)
    np.testing.assert_allclose(above, up)
    assert axis_name(-np.eye(3)[2]) == "−z" and axis_name(np.eye(3)[0]) == "x"
