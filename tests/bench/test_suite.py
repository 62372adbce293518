"""Suite files: what they may say, and what is said about those that can't be used."""

from __future__ import annotations

from pathlib import Path

import pytest

from warpslam.bench.jobs import expand, unique_jobs
from warpslam.bench.studies import STUDIES
from warpslam.bench.suite import SHIPPED, published_figures, read_suite
from warpslam.config import Config
from warpslam.errors import ConfigError

ROOM = {"path": "room"}


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"seedz": [1]}, ["seedz", "Extra inputs"]),
        ({"seeds": []}, ["seeds", "at least 1"]),
        ({"sequences": {"room": {}}}, ["sequences.room", "either path", "or render"]),
        ({"sequences": {"room": {**ROOM, "render": {"kind": "room"}}}}, ["sequences.room", "either path"]),
        ({"sequences": {"room": {"render": {"kind": "maze"}}}}, ["sequences.room.render.kind", "'maze'"]),
        ({"sequences": {"room": {**ROOM, "frames": "all"}}}, ["sequences.room", "'all' is not A:B"]),
        ({"sequences": {"room": {**ROOM, "preset": "fast"}}}, ["sequences.room", "'fast'", "replica"]),
        ({"sequences": {"room": {**ROOM, "set": ["mapping.speed=1"]}}}, ["sequences.room", "mapping.speed"]),
        ({"sequences": {"room": {**ROOM, "published": "mars"}}}, ["sequences.room", "replica/room0"]),
        ({"studies": {"depth": None}}, ["studies.depth", "no such study", "frame_loss"]),
        ({"studies": {"color": {"sequences": ["hall"]}}}, ["studies.color.sequences", "'hall'", "room"]),
        ({"studies": {"color": {"variants": ["grey"]}}}, ["studies.color.variants", "'grey'", "without colour"]),
        ({"studies": {"color": {"set": ["mapping.every=0"]}}}, ["studies.color", "mapping.every", "got 0"]),
    ],
)
def test_errors_name_file_and_field(write_suite, fields, words):
    """Every mistake is told with the file, the field and what would do."""
    with pytest.raises(ConfigError) as caught:
        read_suite(str(write_suite(**fields)))
    for word in ["suite.yaml", *words]:
        assert word in str(caught.value)


def test_files_that_can_not_be_read(tmp_path):
    """Neither a missing file nor one that is no yaml gets a traceback; the suites that come along are named."""
    with pytest.raises(ConfigError, match=r"nowhere.*quick"):
        read_suite("nowhere")
    bad = tmp_path / "bad.yaml"
    bad.write_text("sequences: [")
    with pytest.raises(ConfigError, match=r"bad\.yaml.*yaml"):
        read_suite(str(bad))


def test_paths_are_relative_to_the_file_or_to_the_data(write_suite, tmp_path):
    """Without a folder for the data the file's own counts; of several, the first that has it, or else the first."""
    path = write_suite()
    (tmp_path / "b" / "room").mkdir(parents=True)
    both = read_suite(str(path), tmp_path / "a", tmp_path / "b")
    assert both.resolve("room") == str(tmp_path / "b" / "room")
    assert both.resolve("hall") == str(tmp_path / "a" / "hall")
    assert read_suite(str(path)).resolve("data/room") == str(tmp_path / "data" / "room")
    assert read_suite(str(path), tmp_path / "other").resolve("room") == str(tmp_path / "other" / "room")


def test_shipped_suites_make_every_study():
    """They can be read, render what they use, and leave no study out."""
    for name in SHIPPED:
        suite = read_suite(name)
        assert [study.name for study, _ in suite.studies()] == list(STUDIES)
        assert all(sequence.render is not None for sequence in suite.spec.sequences.values())


def test_suites_of_the_repository():
    """The one for real data can be read, and its runs are as few as its head says."""
    suite = read_suite(str(Path(__file__).parents[2] / "tools" / "suites" / "real.yaml"))
    assert [study.name for study, _ in suite.studies()] == list(STUDIES)
    assert len(unique_jobs(expand(suite, Path("out")))) <= 44


def test_studies_fit_the_settings_and_the_paper():
    """Every variant is a valid setting, names are unique, and published figures belong to variants and figures."""
    for study in STUDIES.values():
        names = [variant.name for variant in study.variants]
        assert len(set(names)) == len(names)
        for variant in study.variants:
            Config.from_preset("default", list(variant.overrides))
        for expectation in study.expectations:
            assert {expectation.better, expectation.worse or expectation.better} <= set(names)
            assert expectation.metric in {metric.key for metric in study.metrics}
    for studies in published_figures().values():
        for study, variants in studies.items():
            keys = {metric.key for metric in STUDIES[study].metrics}
            for variant, figures in variants.items():
                assert STUDIES[study].variant(variant) and set(figures) <= keys
