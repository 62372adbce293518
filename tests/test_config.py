"""Settings: validation, presets, overrides, yaml."""

import pytest

from warpslam.config import PRESETS, Config
from warpslam.errors import ConfigError


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_every_preset_is_valid(name):
    """Each preset loads."""
    assert Config.from_preset(name).mapping.pixels > 0


def test_override_wins_over_preset_and_keeps_its_other_values():
    """--set changes one field; scientific notation works."""
    config = Config.from_preset("paper_tum_rgbd", ["tracking.learning_rate=2e-3", "mapping.coarse=false"])
    assert config.tracking.learning_rate == 2e-3
    assert config.tracking.iterations == 200
    assert config.mapping.coarse is False


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("mapping.iterations=0", "mapping.iterations"),
        ("mapping.iteration=3", "mapping.iteration"),
        ("tracking.learning_rate=-1", "tracking.learning_rate"),
        ("mapping.pixels", "expected group.field=value"),
        ("keyframes.policy=sometimes", "keyframes.policy"),
    ],
)
def test_bad_override_is_refused_by_name(override, message):
    """A value out of range, an unknown field or a malformed override names what is wrong."""
    with pytest.raises(ConfigError, match=message):
        Config.from_preset("default", [override])


def test_unknown_preset_lists_the_known():
    """The error offers the choices."""
    with pytest.raises(ConfigError, match="replica"):
        Config.from_preset("nonsense")


def test_yaml_round_trip(tmp_path):
    """What is saved is what is loaded."""
    config = Config.from_preset("tum_rgbd", ["keyframes.every=7"])
    config.save(tmp_path / "config.yaml")
    assert Config.load(tmp_path / "config.yaml") == config


@pytest.mark.parametrize("text", ["- a list", "mapping: {iterations: many}", "mapping: [", "\x00"])
def test_unusable_yaml_is_a_config_error_with_the_file(tmp_path, text):
    """Not a mapping, a wrong type, broken yaml: the file is named."""
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="broken.yaml"):
        Config.load(path)
