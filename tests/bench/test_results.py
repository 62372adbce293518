"""Figures over seeds and sequences, against values worked out by hand."""

from __future__ import annotations

import math

import pytest

from warpslam.bench.results import Outcome, Row, StudyResult, Summary, published_row, to_dict
from warpslam.bench.studies import METRICS, STUDIES
from warpslam.storage.json_files import to_json

ATE, FLOPS = METRICS["ate"], METRICS["flops"]
COLOR = STUDIES["color"]
WITH, WITHOUT = COLOR.variants


def outcomes(*ates: float | str | None) -> tuple[Outcome, ...]:
    """Runs with these errors [cm]; text is how one failed, None a finished one without the figure."""
    return tuple(
        Outcome(f"run{seed}", seed, ate, "why")
        if isinstance(ate, str)
        else Outcome(f"run{seed}", seed, "finished", frames=10, lost=seed, figures={} if ate is None else {"ate": ate})
        for seed, ate in enumerate(ates)
    )


def test_mean_and_sample_standard_deviation():
    """1, 2 and 6 have mean 3 and variance (4 + 1 + 9) / 2 = 7; one value has no spread, none has no mean."""
    summary = Summary.of([1.0, 2.0, 6.0])
    assert summary.mean == 3.0 and summary.std == pytest.approx(math.sqrt(7))
    assert summary.text(2) == "3.00 ± 2.65"
    assert Summary.of([4.0]) == Summary(4.0, None, (4.0,)) and Summary.of([4.0]).text(1) == "4.0"
    assert Summary.of([]).text(1) == "–"


def test_failed_runs_are_said_and_not_averaged():
    """The mean is that of the runs that have the figure, and the cell says how many those are."""
    row = Row("room", WITH, outcomes(1.0, "crashed", 3.0))
    assert row.summary(ATE).values == (1.0, 3.0)
    assert row.cell(ATE) == "2.00 ± 1.41 (2 of 3)" and (row.finished, row.lost) == ("2 of 3", "2 of 20")
    assert Row("room", WITH, outcomes("crashed", "crashed")).cell(ATE) == "crashed"
    assert Row("room", WITH, outcomes("crashed", "failed")).cell(ATE) == "failed"
    assert Row("room", WITH, outcomes(None, 2.0)).cell(ATE) == "2.00 (1 of 2)"
    assert Row("room", WITH, outcomes(None)).cell(ATE) == "–"


def test_figures_that_are_known_without_a_run():
    """They stand in place of the run's, but not where nothing ran."""
    two = STUDIES["levels"].variant("2")
    assert Row("room", two, outcomes(1.0)).cell(FLOPS) == "61.64"
    assert Row("room", two, outcomes("failed")).cell(FLOPS) == "failed"


def result(**rows: tuple[tuple, tuple]) -> StudyResult:
    """Of the colour study: sequence = (with, without)."""
    made = [
        Row(name, variant, outcomes(*ates))
        for name, pair in rows.items()
        for variant, ates in zip(COLOR.variants, pair, strict=True)
    ]
    return StudyResult(COLOR, tuple(made))


def test_directions():
    """Means over sequences of means over seeds decide; a difference within a spread is called so."""
    (yes,) = result(a=((1.0, 1.2), (3.0, 3.4)), b=((2.0, 2.2), (4.0, 4.4))).directions()
    assert (yes.holds, yes.is_clear, yes.verdict) == (True, True, "yes")
    assert yes.better == pytest.approx(1.6) and yes.worse == pytest.approx(3.7)
    assert yes.text == "ATE RMSE: with colour < without colour (1.60 / 3.70 cm)"
    (unclear,) = result(a=((1.0, 3.0), (1.5, 3.5))).directions()
    assert (unclear.holds, unclear.verdict) == (True, "yes (within the spread)")
    (no,) = result(a=((3.0,), (1.0,))).directions()
    assert (no.holds, no.is_clear, no.verdict) == (False, None, "no")


def test_directions_without_figures():
    """A failed side leaves the sequence out, and says so; without any sequence nothing is claimed."""
    (partly,) = result(a=((1.0,), (2.0,)), b=((1.0,), ("failed",))).directions()
    assert partly.verdict == "yes (without b; some runs failed)" and (partly.better, partly.worse) == (1.0, 2.0)
    (none,) = result(a=((1.0,), ("failed",))).directions()
    assert none.holds is None and none.verdict.startswith("not known")


def test_exact_values():
    """What must be exactly zero is not nearly zero."""
    study = STUDIES["frustum"]
    for value, holds in ((0.0, True), (1e-12, False)):
        runs = (Outcome("run", 0, "finished", figures={"outside": value}),)
        assert StudyResult(study, (Row("room", study.variant("on"), runs),)).directions()[0].holds is holds


def test_published_figures_only_where_declared():
    """A sequence that declares nothing has none; one that does has what the table of the paper has."""
    assert published_row(None, "levels", "3") == {}
    assert published_row("replica/room0", "levels", "3")["accuracy"] == 2.78
    assert published_row("replica/room1", "levels", "3") == {}
    assert published_row("scannet/0000", "color", "without colour") == {"ate": "failed"}


def test_json_has_every_value():
    """Values of single runs, their summary, and the verdicts."""
    content = to_dict(result(a=((1.0, 3.0), (4.0, "failed"))))
    assert content["rows"][0]["figures"]["ate"] == {"mean": 2.0, "std": pytest.approx(2**0.5), "values": (1.0, 3.0)}
    assert [run["status"] for run in content["rows"][1]["runs"]] == ["finished", "failed"]
    assert content["directions"][0]["holds"] is True
    assert to_json(content)
