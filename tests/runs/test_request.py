"""What a run is asked for: settings from their several sources, JSON and back, and what counts as a difference."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest

from warpslam.config import Config
from warpslam.errors import ConfigError
from warpslam.runs.folder import RunFolder
from warpslam.runs.request import RunRequest, SequenceFacts, Source, parse_slice
from warpslam.storage.json_files import write_json

OVERRIDES = ("mapping.window=3",)


def test_settings_come_from_a_preset_or_a_config():
    """The request's preset before the sequence's, a config before both, and single settings and files on top."""
    assert RunRequest().settings("thorough") == Config.from_preset("thorough")
    assert RunRequest(preset="replica").settings("thorough") == Config.from_preset("replica")
    base = Config.from_preset("thorough", ["mapping.iterations=7"])
    request = RunRequest(config=base, overrides=OVERRIDES, decoders="d.pth", poses="p.tum")
    settings = request.settings("replica")
    assert (settings.mapping.iterations, settings.mapping.every, settings.mapping.window) == (7, 1, 3)
    assert settings.decoders == "d.pth" and settings.tracking.use_given_poses
    assert base.mapping.window != 3, "the request's own stays as it is"
    with pytest.raises(ConfigError, match="do not go together"):
        RunRequest(config=base, preset="replica").settings("default")


def test_resolving_leaves_nothing_open_and_repeats():
    """All that is left to say is said by the config, the frames and the device; resolving once more changes nothing."""
    request = RunRequest(Source("/x"), preset="replica", overrides=OVERRIDES, decoders="d.pth")
    resolved = request.resolved("default", range(2, 9, 3), "cpu")
    assert (resolved.preset, resolved.overrides, resolved.decoders) == (None, (), None)
    assert (resolved.frames, resolved.device) == ((2, 9, 3), "cpu")
    assert resolved.config == Config.from_preset("replica", list(OVERRIDES)).with_files("d.pth").resolved()
    assert resolved.resolved("scannet", range(2, 9, 3), "cpu") == resolved


def test_json_and_back():
    """A request survives a trip through JSON, open or resolved; an unknown field is refused."""
    request = RunRequest(Source("/x", "icl", "1,1,1,1,2,2,1000"), (0, None, 2), preset="replica", overrides=OVERRIDES)
    for one in (RunRequest(), request, request.resolved("default", range(3), "cpu")):
        assert RunRequest.from_dict(json.loads(json.dumps(one.to_dict()))) == one
    for wrong in ({"speed": 3}, {"frames": [1]}, {"source": {"path": [3]}}, {"overrides": 5}, {"config": "fast"}):
        with pytest.raises(ValueError, match="path" if "source" in wrong else next(iter(wrong))):
            RunRequest.from_dict({**request.to_dict(), **wrong})


def test_facts_of_a_sequence_are_of_their_kinds():
    """As a checkpoint has them."""
    facts = {"sequence": "a", "frame_count": 3, "intrinsics": {}, "timing": {}}
    assert SequenceFacts.from_dict(facts) == SequenceFacts("a", 3, {}, {})
    for wrong in ({"frame_count": "many"}, {"intrinsics": []}, {"sequence": None}, {"more": 1}):
        with pytest.raises(ValueError, match=next(iter(wrong))):
            SequenceFacts.from_dict({**facts, **wrong})


def test_differences_name_both_values():
    """What changes a result is told with its name; memory, checkpoints and the surface to compare with are free."""
    request = RunRequest(Source("/x")).resolved("default", range(9), "cpu")
    free = replace(
        request, checkpoint_every=5, truth_mesh="m.ply", config=request.config.updated(["grid.max_gigabytes=9"])
    )
    assert request.differences(free) == []
    other = replace(request, seed=4, method="tsdf", config=request.config.updated(["tracking.pixels=33"]))
    lines = request.differences(other)
    assert lines[0].startswith("config.tracking.pixels is 33, was ")
    assert lines[1:] == ["method is 'tsdf', was 'nice-slam'", "seed is 4, was 0"]


def test_the_built_in_sequence_has_a_name(tmp_path):
    """It is a dataset of its own; files of early runs, which know it by its missing folder, mean it as well."""
    folder = RunFolder(tmp_path)
    folder.write_source(Source.demo("warpslam demo"))
    assert folder.read_source() == Source.demo("warpslam demo") and folder.read_source().is_demo
    write_json(folder.source, {"path": None, "dataset": "auto", "camera": None, "command": None})
    assert folder.read_source().is_demo and not Source("demo").is_demo


@pytest.mark.parametrize(
    ("text", "parts"), [("0:200", (0, 200, None)), ("::2", (None, None, 2)), ("5:", (5, None, None))]
)
def test_slices(text, parts):
    """A:B:STEP with any part left out."""
    assert parse_slice(text) == parts
