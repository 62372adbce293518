"""``warpslam info``: what is installed, and the settings shown and explained."""

from __future__ import annotations

import json

import pytest

from warpslam import cli
from warpslam.config import PRESETS, Config
from warpslam.config.description import settings
from warpslam.runtime.environment import torch_build


def test_the_build_of_torch_is_told(capsys):
    """Version and what it was built for, as text and as JSON."""
    build = torch_build()
    assert cli.main(["info"]) == 0
    (line,) = (line for line in capsys.readouterr().out.splitlines() if line.startswith("torch "))
    assert build.target in line and "GB on disk" in line
    assert cli.main(["info", "--json"]) == 0
    facts = json.loads(capsys.readouterr().out)
    assert facts["torch_build"] == {"target": build.target, "bytes": build.bytes}
    assert facts["presets"] == list(PRESETS) and facts["packages"]["torch"] in line


@pytest.mark.parametrize("preset", PRESETS)
def test_a_preset_is_printed_as_a_file_that_gives_it(preset, capsys, tmp_path):
    """What is printed is a settings file with the values of the preset."""
    assert cli.main(["info", "--preset", preset]) == 0
    path = tmp_path / "settings.yaml"
    path.write_text(capsys.readouterr().out)
    assert Config.from_file(path) == Config.from_preset(preset)
    assert cli.main(["info", "--preset", preset, "--json"]) == 0
    assert Config.from_dict(json.loads(capsys.readouterr().out)) == Config.from_preset(preset)


def test_an_unknown_preset_is_an_error(capsys):
    """One line with the choices, exit code 2."""
    assert cli.main(["info", "--preset", "nonsense"]) == 2
    assert "choose one of" in capsys.readouterr().err


def test_every_setting_is_explained_within_80_columns(capsys, monkeypatch):
    """Each field with a meaning, under its group, and no line is cut or wider than the terminal."""
    monkeypatch.setenv("COLUMNS", "80")
    assert cli.main(["info", "--settings"]) == 0
    out = capsys.readouterr().out
    assert max(map(len, out.splitlines())) <= 80 and "\N{HORIZONTAL ELLIPSIS}" not in out
    words = " ".join(out.replace("\N{NO-BREAK SPACE}", " ").split())
    for setting in settings():
        assert setting.meaning, f"{setting.name} has no meaning"
        group, _, name = setting.name.rpartition(".")
        assert f"\n{name} " in out and f"\n{group}" in out
    assert "window 5 frames optimised together" in words
    assert "optimizer direct direct registration" in words and "(1 to 64)" in words
    assert "(direct or adam or gauss_newton)" in words


def test_settings_as_json(capsys):
    """All settings by the name that --set takes, with unit, range, choices and default."""
    assert cli.main(["info", "--settings", "--json"]) == 0
    rows = {row["name"]: row for row in json.loads(capsys.readouterr().out)}
    dump = Config().model_dump()
    names = [f"{g}.{n}" for g, v in dump.items() if isinstance(v, dict) for n in v]
    assert set(rows) == {*names, "schedule", "published_images", "sensor_timing", "scene_scale", "decoders"}
    for name in names:
        group, field = name.split(".")
        assert rows[name]["default"] == dump[group][field]
    assert rows["grid.fine_spacing"]["unit"] == "m" and rows["grid.fine_spacing"]["range"] == "above 0"
    assert rows["mapping.window"]["range"] == "1 to 64" and rows["mapping.window"]["unit"] == ""
    assert rows["keyframes.known_share"]["range"] == "above 0, below 1"
    assert rows["schedule"]["choices"] == ["strict", "overlapped"]
