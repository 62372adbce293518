"""From suites to jobs: their settings, stable names, and runs that studies share."""

from __future__ import annotations

from pathlib import Path

import pytest

from warpslam.bench.jobs import expand, render_missing, unique_jobs
from warpslam.bench.suite import read_suite
from warpslam.errors import ConfigError
from warpslam.storage.json_files import read_json


def test_settings_of_a_job(write_suite, tmp_path):
    """Later ones win: suite, sequence, study, variant; given poses and true surface only where a study needs them."""
    path = write_suite(
        set=["mapping.iterations=1", "mapping.every=3", "mapping.pixels=99"],
        sequences={
            "hall": {
                "path": "hall", "frames": "0:9", "set": ["mapping.every=4"], "truth_mesh": "hall.ply", "poses": "p.txt",
            }
        },
        studies={"mapping_iterations": {"variants": ["30"], "set": ["mapping.pixels=88"]}, "tracking": None},
        seeds=[7],
        device="cpu",
    )  # fmt: skip
    suite = read_suite(str(path))
    tracked, imap, given = (entry.job.request for entry in expand(suite, tmp_path))
    assert given.overrides == ("mapping.every=4", "mapping.iterations=30", "mapping.pixels=88")
    assert (given.poses, given.truth_mesh) == (str(tmp_path / "p.txt"), str(tmp_path / "hall.ply"))
    assert (given.frames, given.seed, given.device) == ((0, 9, None), 7, "cpu")
    assert tracked.overrides == ("mapping.every=4", "mapping.iterations=1", "mapping.pixels=99")
    assert (tracked.poses, tracked.truth_mesh, tracked.method) == (None, None, "nice-slam")
    assert imap.method == "imap"


def test_names_and_hashes_are_stable(write_suite, tmp_path):
    """The same suite gives the same jobs again, whichever other studies are made; other settings give other names."""
    suite = read_suite(str(write_suite("tracking", "color", "levels", seeds=[0, 3])))
    jobs = unique_jobs(expand(suite, tmp_path))
    assert jobs == unique_jobs(expand(suite, tmp_path))
    assert [job.settings_hash for job in unique_jobs(expand(suite, tmp_path, ["levels"]))] == [
        job.settings_hash for job in jobs if "tracking.use_given_poses=true" in job.request.overrides
    ]
    assert len({job.name for job in jobs}) == len(jobs)
    assert {"room-nice-slam-4821d7cf-seed3", "room-nice-slam-32c6019c-seed3"} < {job.name for job in jobs}


def test_studies_of_tracking_by_rendering_track_so(write_suite, tmp_path):
    """By Gauss-Newton where the settings say direct; a preset that says Adam, given poses and iMAP stay as they are."""
    for preset, expected in (("default", ("tracking.optimizer=gauss_newton",)), ("paper_replica", ())):
        sequences = {"room": {"path": "data/room", "preset": preset}}
        studies = ("tracking", "color", "tracking_iterations", "frame_loss", "dynamic", "levels")
        for entry in expand(read_suite(str(write_suite(*studies, sequences=sequences))), tmp_path):
            chosen = tuple(one for one in entry.job.request.overrides if one.startswith("tracking.optimizer"))
            is_of_rendering = entry.study.name not in ("tracking", "levels") and entry.variant.method == "nice-slam"
            assert chosen == (expected if is_of_rendering else ())


def test_studies_share_runs(write_suite, tmp_path):
    """What is the same run is made once, with the true surface if any study needs it."""
    entries = expand(read_suite(str(write_suite("reconstruction", "levels", "hierarchy", "frustum"))), tmp_path)
    shared = {(e.study.name, e.variant.name): e.job for e in entries}
    plain = shared["reconstruction", "nice-slam"]
    assert plain == shared["levels", "3"] == shared["hierarchy", "both"] == shared["frustum", "on"]
    assert shared["levels", "2"] == shared["hierarchy", "only low"] != plain
    assert (len(entries), len(unique_jobs(entries))) == (11, 7)


def test_unknown_study(write_suite, tmp_path):
    """Those of the suite are named."""
    with pytest.raises(ConfigError, match=r"'cost'.*tracking, color"):
        expand(read_suite(str(write_suite())), tmp_path, ["cost"])


def test_sequences_are_rendered_once(write_suite, tmp_path):
    """With their true surface; again only if what is to be rendered is another thing, or is not complete."""
    sequences = {"room": {"render": {"kind": "room", "frames": 2, "size": [24, 18]}}}
    suite = read_suite(str(write_suite("levels", sequences=sequences)))
    entries = expand(suite, tmp_path)
    (folder,) = render_missing(suite, tmp_path, entries)
    job = entries[0].job
    assert Path(job.request.source.path) == folder and Path(job.request.truth_mesh).is_file()
    assert read_json(folder / "rendering.json")["size"] == [24, 18]
    assert render_missing(suite, tmp_path, entries) == []
    (folder / "rendering.json").unlink()
    assert render_missing(suite, tmp_path, entries) == [folder]
    sequences["room"]["render"]["seed"] = 1
    other = expand(read_suite(str(write_suite("levels", sequences=sequences))), tmp_path)
    elsewhere = {"source": None, "truth_mesh": None}
    assert other[0].job.asking(**elsewhere) == job.asking(**elsewhere)
    assert other[0].job.request.source != job.request.source
