"""A bench from its suite to its files: with runs that answer at once, and once with real ones."""

from __future__ import annotations

import csv
import json

import pytest

from tests.report.html_checks import Page
from warpslam import cli
from warpslam.bench.runner import run_bench
from warpslam.bench.suite import read_suite
from warpslam.storage.json_files import read_json


@pytest.fixture
def bench(write_suite, fake_runs, tmp_path):
    """Tracking and colour over two seeds: iMAP fails, and without colour frames are lost."""
    suite = read_suite(str(write_suite(seeds=[0, 1], description="A <test>.")))
    return run_bench(suite, tmp_path / "out", workers=2, command="warpslam bench suite.yaml")


def test_tables(bench):
    """Means and spreads are those of the runs; failed runs and lost frames are in every table."""
    assert not bench.is_complete
    text = (bench.folder / "bench.md").read_text()
    assert "| room | nice-slam | 2.00 ± 1.41 | 2 of 2 | 0 of 20 |" in text
    assert "| room | imap | failed | 0 of 2 | – |" in text
    assert "| room | without colour | 32.00 ± 1.41 | 2 of 2 | 6 of 20 |" in text
    assert "- room, imap, seed 1: failed. depth.png: truncated" in text
    assert "ATE RMSE: nice-slam < imap (– / – cm): not known" in text
    assert "ATE RMSE: with colour < without colour (2.00 / 32.00 cm): yes" in text
    for fact in ("`warpslam bench suite.yaml`", "seeds: 0, 1", "device: cpu", "versions: warpslam 1"):
        assert fact in text
    rows = list(csv.DictReader(open(bench.folder / "tracking.csv", newline="")))
    assert [row["ATE RMSE [cm] mean"] for row in rows] == ["2", ""]
    assert [(row["finished"], row["ATE RMSE [cm] values"]) for row in rows] == [("2", "2"), ("0", "0")]
    content = read_json(bench.folder / "bench.json")
    assert content["runs"] == {"finished": 6, "failed": 2} and content["spec"]["seeds"] == [0, 1]
    assert content["studies"][1]["rows"][1]["figures"]["ate"]["values"] == pytest.approx([31.0, 33.0])
    for study in ("tracking", "color"):
        assert (bench.folder / f"{study}.png").read_bytes().startswith(b"\x89PNG")


def test_page(bench):
    """Whole and well-formed: a section a study, text escaped, links to the runs' own reports and to nothing else."""
    page = Page((bench.folder / "report.html").read_text(encoding="utf-8"))
    assert page.problems == []
    assert list(page.sections) == ["overview", "tracking", "color", "made"]
    assert "A <test>." in page.text and "1 of 1" in page.sections["overview"]
    assert "2.00 ± 1.41" in page.sections["tracking"] and "depth.png: truncated" in page.sections["tracking"]
    assert page.external == [] and len(page.links) == 6
    assert all((bench.folder / link).is_file() for link in page.links)


def test_running_again_does_only_what_is_left(bench, tmp_path):
    """Finished runs stay as they are, failed ones are tried again, and new seeds are added to the tables."""
    runs = bench.folder / "runs"
    before = {job.name: (runs / job.name / "batch.json").read_text() for job in bench.jobs}
    path = tmp_path / "suite.yaml"
    path.write_text(path.read_text().replace("- 1\n", "- 1\n- 2\n"))
    again = run_bench(read_suite(str(path)), bench.folder)
    states = {status.name: status.status for status in again.statuses}
    for name, text in before.items():
        is_kept = (runs / name / "batch.json").read_text() == text
        assert is_kept == ("imap" not in name)
        assert states[name] == ("failed" if "imap" in name else "done before")
    assert "| room | nice-slam | 3.00 ± 2.00 | 3 of 3 | 0 of 30 |" in (bench.folder / "bench.md").read_text()


def test_list_runs_nothing(write_suite, tmp_path, capsys):
    """It says what there is to do."""
    output = tmp_path / "out"
    assert cli.main(["bench", str(write_suite()), "-o", str(output), "--studies", "color", "--list"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines[:2]] == ["color", "color"]
    assert lines[-1] == "2 runs for 2 entries of the tables, 0 of them done"
    assert not output.exists()


def test_mistakes_end_with_a_message(write_suite, tmp_path, capsys):
    """Not with a traceback."""
    assert cli.main(["bench", str(write_suite(seeds=["x"])), "-o", str(tmp_path / "out")]) == 2
    assert "seeds.0" in capsys.readouterr().err


def test_whole_bench(write_suite, tmp_path, capsys):
    """A tiny suite end to end by the command line: a sequence is rendered, a run is made, and all is written."""
    suite = write_suite(
        "tracking_iterations",
        sequences={"room": {"render": {"kind": "room", "frames": 3, "size": [32, 24]}, "preset": "default"}},
        studies={"tracking_iterations": {"variants": ["2"]}},
        set=[
            "tracking.ignore_edge_u=2", "tracking.ignore_edge_v=2", "tracking.pixels=40", "mapping.pixels=60",
            "mapping.first_iterations=10", "mapping.coarse_iterations=2", "mapping.color_refinement=false",
            "mapping.iterations=4", "meshing.voxel=0.1",
        ],
        device="cpu",
    )  # fmt: skip
    output = tmp_path / "out"
    assert cli.main(["bench", str(suite), "-o", str(output)]) == 0
    assert "ATE" in capsys.readouterr().out
    content = json.loads((output / "bench.json").read_text())
    (study,) = content["studies"]
    assert content["runs"] == {"finished": 1} and content["command"].startswith("warpslam bench")
    assert all(row["figures"]["ate"]["mean"] > 0 for row in study["rows"])
    assert (output / "tracking_iterations.png").is_file() and (output / "report.html").is_file()
