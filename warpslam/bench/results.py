"""What a bench came to: figures of every run, mean and spread over seeds, and whether they go the expected way."""

from __future__ import annotations

import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from warpslam.batch.jobs import Job
from warpslam.batch.status import FINISHED, INTERRUPTED, SKIPPED, JobStatus
from warpslam.bench.studies import METRICS, Expectation, Metric, Study, Variant
from warpslam.bench.suite import Suite, published_figures
from warpslam.runs.folder import RunFolder


@dataclass(frozen=True)
class Outcome:
    """One run as one study sees it."""

    run: str
    """Its folder's name."""

    seed: int
    status: str
    """As in `warpslam.batch.status.JobStatus`; "finished" also if it was done before."""

    message: str = ""
    """Why it did not finish, or why a figure of it is missing."""

    lost: int = 0
    """Frames without a pose."""

    frames: int = 0
    """Frames that were selected."""

    figures: Mapping[str, float] = field(default_factory=dict)
    """By key of `warpslam.bench.studies.METRICS`."""

    protocol: str | None = None
    """Culling protocol of its reconstruction figures."""

    curve: Sequence[Sequence[float]] | None = None
    """Of the study's probe."""

    @property
    def is_finished(self) -> bool:
        """Whether it has its results."""
        return self.status == FINISHED


@dataclass(frozen=True)
class Summary:
    """A figure over seeds."""

    mean: float | None
    """None without any value."""

    std: float | None
    """Sample standard deviation; None of fewer than two values."""

    values: tuple[float, ...]
    """Of the runs that have one."""

    @classmethod
    def of(cls, values: Iterable[float]) -> Summary:
        """Mean and sample standard deviation."""
        known = tuple(values)
        return cls(
            statistics.fmean(known) if known else None, statistics.stdev(known) if len(known) > 1 else None, known
        )

    def text(self, digits: int) -> str:
        """Mean, with the spread if there is one; a dash without any value."""
        if self.mean is None:
            return "–"
        return f"{self.mean:.{digits}f}" + ("" if self.std is None else f" ± {self.std:.{digits}f}")


@dataclass(frozen=True)
class Row:
    """A variant on a sequence: its runs, one a seed, and what the paper has of it where the data is the same."""

    sequence: str
    variant: Variant
    outcomes: tuple[Outcome, ...]
    published: Mapping[str, float | str] = field(default_factory=dict)

    def summary(self, metric: Metric) -> Summary:
        """Over the runs that finished and have the figure."""
        known = self.variant.figures.get(metric.key)
        finished = [outcome for outcome in self.outcomes if outcome.is_finished]
        if known is not None:
            return Summary.of([known] * bool(finished))
        return Summary.of(outcome.figures[metric.key] for outcome in finished if metric.key in outcome.figures)

    def cell(self, metric: Metric) -> str:
        """The figure as text; says so where runs failed or have no figure."""
        summary, count = self.summary(metric), len(self.outcomes)
        if not any(outcome.is_finished for outcome in self.outcomes):
            return self.outcomes[0].status if len({outcome.status for outcome in self.outcomes}) == 1 else "failed"
        missing = metric.key not in self.variant.figures and len(summary.values) < count
        if summary.mean is None:
            return "–"
        return summary.text(metric.digits) + (f" ({len(summary.values)} of {count})" if missing else "")

    @property
    def finished(self) -> str:
        """How many runs finished."""
        return f"{sum(outcome.is_finished for outcome in self.outcomes)} of {len(self.outcomes)}"

    @property
    def lost(self) -> str:
        """Lost frames of all runs that finished."""
        done = [outcome for outcome in self.outcomes if outcome.is_finished]
        return f"{sum(o.lost for o in done)} of {sum(o.frames for o in done)}" if done else "–"

    @property
    def protocol(self) -> str | None:
        """Culling protocol of the reconstruction figures; None without any."""
        known = sorted({outcome.protocol for outcome in self.outcomes if outcome.protocol})
        return ", ".join(known) or None


@dataclass(frozen=True)
class Direction:
    """Whether an expectation holds."""

    expectation: Expectation
    holds: bool | None
    """None if nothing can be said."""

    better: float | None = None
    """Mean over the sequences on which both sides have the figure."""

    worse: float | None = None
    """The same of the other side."""

    is_clear: bool | None = None
    """Whether the difference exceeds both spreads over seeds on every sequence; None where no spread is known."""

    reason: str = ""
    """Why nothing can be said, or what to bear in mind."""

    @property
    def text(self) -> str:
        """What was expected, with the figures."""
        metric = METRICS[self.expectation.metric]
        unit = f" {metric.unit}" if metric.unit else ""
        better = "–" if self.better is None else f"{self.better:.{metric.digits}f}"
        if self.expectation.worse is None:
            return f"{metric.title}: {self.expectation.better} exactly {self.expectation.value:g} ({better}{unit})"
        worse = "–" if self.worse is None else f"{self.worse:.{metric.digits}f}"
        sign = "<" if metric.lower_is_better else ">"
        return f"{metric.title}: {self.expectation.better} {sign} {self.expectation.worse} ({better} / {worse}{unit})"

    @property
    def verdict(self) -> str:
        """Yes, no, or not known, and within what."""
        if self.holds is None:
            return f"not known: {self.reason}"
        verdict = "yes" if self.holds else "no"
        notes = [self.reason] if self.reason else []
        if self.is_clear is False:
            notes.insert(0, "within the spread")
        return f"{verdict} ({'; '.join(notes)})" if notes else verdict


@dataclass(frozen=True)
class StudyResult:
    """A study with all that was measured; ``metrics`` are those that some run has."""

    study: Study
    rows: tuple[Row, ...]

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Figures that at least one row has; all of them if none has any."""
        known = tuple(m for m in self.study.metrics if any(row.summary(m).mean is not None for row in self.rows))
        return known or self.study.metrics

    @property
    def sequences(self) -> list[str]:
        """Names, in order."""
        return list(dict.fromkeys(row.sequence for row in self.rows))

    @property
    def variants(self) -> list[Variant]:
        """Those that were made, in order."""
        return [variant for variant in self.study.variants if any(row.variant is variant for row in self.rows)]

    def row(self, sequence: str, variant: str) -> Row | None:
        """A row by its names."""
        return next((r for r in self.rows if (r.sequence, r.variant.name) == (sequence, variant)), None)

    def directions(self) -> list[Direction]:
        """The study's expectations; those about variants that were not made are left out."""
        made = {row.variant.name for row in self.rows}
        return [
            self._direction(expectation)
            for expectation in self.study.expectations
            if {expectation.better, expectation.worse or expectation.better} <= made
        ]

    def _direction(self, expectation: Expectation) -> Direction:
        metric = METRICS[expectation.metric]
        sides = [expectation.better, expectation.worse or expectation.better]
        pairs: list[tuple[Summary, Summary]] = []
        means: list[tuple[float, float]] = []
        left_out = []
        for sequence in self.sequences:
            rows = [self.row(sequence, name) for name in sides]
            first, second = (Summary.of(()) if row is None else row.summary(metric) for row in rows)
            if first.mean is None or second.mean is None:
                left_out.append(sequence)
            else:
                pairs.append((first, second))
                means.append((first.mean, second.mean))
        if not pairs:
            return Direction(expectation, None, reason="no sequence has the figure of both sides")
        better, worse = (statistics.fmean(side) for side in zip(*means, strict=True))
        notes = [f"without {', '.join(left_out)}"] if left_out else []
        if any(not outcome.is_finished for row in self.rows if row.variant.name in sides for outcome in row.outcomes):
            notes.append("some runs failed")
        reason = "; ".join(notes)
        if expectation.worse is None:
            return Direction(expectation, better == expectation.value, better, reason=reason)
        holds = better < worse if metric.lower_is_better else better > worse
        spreads = [_spread(first, second) for first, second in pairs]
        known = [(abs(a - b), s) for (a, b), s in zip(means, spreads, strict=True) if s is not None]
        is_clear = all(gap > spread for gap, spread in known) if known else None
        return Direction(expectation, holds, better, worse, is_clear, reason)


def _spread(first: Summary, second: Summary) -> float | None:
    """The larger of two standard deviations; None if one is not known."""
    return None if first.std is None or second.std is None else max(first.std, second.std)


def published_row(key: str | None, study: str, variant: str) -> Mapping[str, float | str]:
    """What the paper prints of a variant on a sequence; empty if ``key`` is None or it has nothing."""
    return {} if key is None else published_figures()[key].get(study, {}).get(variant, {})


def to_dict(result: StudyResult) -> dict[str, Any]:
    """For JSON: every run's figures, their summaries, and the directions."""
    study = result.study
    return {
        "name": study.name,
        "title": study.title,
        "source": study.source,
        "text": study.text,
        "metrics": [
            {"key": m.key, "title": m.title, "unit": m.unit, "lower_is_better": m.lower_is_better}
            for m in study.metrics
        ],
        "rows": [
            {
                "sequence": row.sequence,
                "variant": row.variant.name,
                "method": row.variant.method,
                "overrides": list(row.variant.overrides),
                "protocol": row.protocol,
                "published": dict(row.published),
                "figures": {m.key: vars(row.summary(m)) for m in study.metrics},
                "runs": [vars(outcome) for outcome in row.outcomes],
            }
            for row in result.rows
        ],
        "directions": [
            {
                "metric": d.expectation.metric, "better": d.expectation.better, "worse": d.expectation.worse,
                "value": d.expectation.value, "better_mean": d.better, "worse_mean": d.worse, "holds": d.holds,
                "is_clear": d.is_clear, "text": d.text, "verdict": d.verdict,
            }
            for d in result.directions()
        ],
    }  # fmt: skip


RUNS = "runs"
"""Folder of the bench that holds a run folder for each job."""


@dataclass(frozen=True)
class Bench:
    """A bench that was run, as far as it came."""

    suite: Suite
    """What was run."""

    folder: Path
    """Where its files and runs are."""

    command: str | None
    """How it was started, if by the command line."""

    jobs: tuple[Job, ...]
    """Its runs."""

    statuses: tuple[JobStatus, ...]
    """How they ended."""

    results: tuple[StudyResult, ...]
    """By study."""

    def run_folder(self, run: str) -> RunFolder:
        """Folder of one of its runs."""
        return RunFolder(self.folder / RUNS / run)

    @property
    def is_interrupted(self) -> bool:
        """Whether ctrl-C ended it early."""
        return any(status.status == INTERRUPTED for status in self.statuses)

    @property
    def is_complete(self) -> bool:
        """Whether every run has its results."""
        return all(status.status in (FINISHED, SKIPPED) for status in self.statuses)
