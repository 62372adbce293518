"""Several runs on one page."""

from __future__ import annotations

import re

import pytest

from tests.fakes import FakeSequence
from tests.report.html_checks import Page
from warpslam.errors import ConfigError
from warpslam.report import write_comparison
from warpslam.report.comparison import run_names
from warpslam.report.data import RunData
from warpslam.storage.json_files import read_json, write_json


def test_comparison_of_runs(make_run, tmp_path):
    """A row, bars and a picture a run; the best of each figure stands out, missing ones are a dash."""
    good, bad, blind = (
        make_run("good"), make_run("bad", mesh_fails=True),
        make_run("blind", sequence=FakeSequence(8, no_truth=tuple(range(8)))),
    )  # fmt: skip
    metrics = read_json(bad.metrics)
    metrics["ate_m"]["aligned"]["rmse"] = 0.5
    write_json(bad.metrics, metrics)
    text = write_comparison(tmp_path / "all.html", [good, bad, blind]).read_text(encoding="utf-8")
    page = Page(text)
    assert page.problems == [] and list(page.sections) == ["table", "bars", "meshes", "runs"]
    assert page.links == ["good/report.html", "bad/report.html", "blind/report.html"] and page.external == []
    best = 100 * read_json(good.metrics)["ate_m"]["aligned"]["rmse"]
    assert f"<strong>{best:.2f} cm</strong>" in text and "<strong>50.00 cm</strong>" not in text
    assert "50.00 cm" in page.sections["bars"] and "–" in page.sections["table"]
    assert page.tags.count("img") == 2 and "no mesh" in page.sections["meshes"]
    widths = [float(width) for width in re.findall(r'class="piece c\d" style="width:([\d.]+)%"', text)]
    assert max(widths) == 100 and min(widths) >= 0
    assert page.sections["runs"].count("warpslam run somewhere") == 3


def test_names_tell_runs_apart(make_run):
    """The last part of the folder, or as many as it takes; one folder twice is numbered."""
    first, second = (RunData.gather(make_run(name)) for name in ("a/run", "b/run"))
    assert run_names([first]) == ["run"]
    assert run_names([first, second]) == ["a/run", "b/run"]
    assert run_names([first, first]) == ["run (1)", "run (2)"]


def test_comparison_of_hopeless_runs(make_run, tmp_path):
    """Runs without any figure are compared all the same."""
    runs = [make_run("a", interrupt_at=0), make_run("b", fail_at=0)]
    page = Page(write_comparison(tmp_path / "none.html", runs).read_text(encoding="utf-8"))
    assert page.problems == []
    assert "It failed: RuntimeError: out of memory" in page.sections["runs"] and "failed" in page.sections["table"]
    assert "No run has: ATE RMSE" in page.sections["table"]


def test_unwritable_page(make_run, tmp_path):
    """A place that can't be written to is named."""
    with pytest.raises(ConfigError, match="gone"):
        write_comparison(tmp_path / "gone" / "page.html", [make_run()])


def test_no_best_over_different_frames(make_run, tmp_path):
    """Runs over other frames are shown side by side, and none is called the best."""
    text = write_comparison(
        tmp_path / "all.html", [make_run("long"), make_run("short", sequence=FakeSequence(6))]
    ).read_text(encoding="utf-8")
    assert "went over different frames" in text and "<td><strong>" not in text
