"""A run as one call, and which frames settings select."""

from __future__ import annotations

import pytest

from tests.fakes import FakeSequence
from tests.pipeline.test_pipeline import fake_slam  # noqa: F401
from tests.sequences import writers
from tests.sequences.recordings import room, write_own
from warpslam import Observer, run
from warpslam.errors import ConfigError, InputError
from warpslam.pipeline.setup import as_configured, resolve
from warpslam.runs.request import RunRequest
from warpslam.sequences import open_sequence


class Counter(Observer):
    """Counts frames."""

    def __init__(self) -> None:
        self.seen: list[int] = []

    def frame(self, progress) -> None:
        self.seen.append(progress.done)


@pytest.mark.usefixtures("fake_slam")
def test_a_run_over_a_sequence(tmp_path):
    """Frames, overrides and observer reach the run, and its folder is written."""
    observer = Counter()
    result = run(
        FakeSequence(6),
        tmp_path / "run",
        frames=slice(1, 5),
        overrides=["mapping.every=3"],
        observer=observer,
        device="cpu",
    )
    assert result.status == "finished" and observer.seen == [1, 2, 3, 4]
    assert result.folder.read_config().mapping.every == 3 and result.folder.mesh.is_file()
    with pytest.raises(InputError, match="sequence is int: pass an RgbdSequence, or the path"):
        run(3)


def test_a_path_can_be_opened_again(tmp_path, monkeypatch):
    """A run over a path remembers it as it was typed, absolute, and opens it by itself."""
    from warpslam.pipeline import program

    asked = []
    monkeypatch.setattr(
        program, "run_request", lambda request, *rest, **named: asked.append((request, named["sequence"]))
    )
    write_own(tmp_path / "room", room())
    monkeypatch.chdir(tmp_path)
    run("room", preset="thorough")
    ((request, sequence),) = asked
    assert request.source.path == str(tmp_path / "room") and sequence is None and request.preset == "thorough"


def test_the_papers_frames_are_counted_by_themselves(tmp_path):
    """The default preset uses every frame of a TUM folder; the paper's leaves out those without a pose or too close,
    and --frames counts what is left.
    """
    times = [10 + i / 60 for i in range(12)]
    folder = writers.write_tum(tmp_path, times, times, times[:3])
    sequence = open_sequence(folder, camera=writers.CAMERA)
    default = resolve(
        RunRequest(frames=(0, 10, None)),
        sequence,
    )
    assert default.frames == (0, 10, 1) and len(as_configured(sequence, default.config)) == 12
    paper = resolve(RunRequest(preset="paper_tum_rgbd", frames=(0, 10, None)), sequence)
    published = as_configured(sequence, paper.config)
    assert len(published) == 4 and paper.frames == (0, 4, 1)
    assert [round((t - 10) * 60) for t in published.timestamps] == [0, 2, 4, 6]  # poses reach 0.08 s beyond their last
    with pytest.raises(ConfigError, match="selects none of the 4 frames"):
        resolve(RunRequest(preset="paper_tum_rgbd", frames=(5, 10, None)), sequence)
