"""Settings: validation, presets, overrides, yaml."""

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import BaseModel

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


@pytest.mark.parametrize("name", sorted(name for name in PRESETS if name.startswith("paper_")))
def test_paper_presets_hold_what_our_defaults_change(name):
    """The released code: keyframes every 50 frames, even samples, uniform pixels, Adam at a constant rate."""
    config = Config.from_preset(name)
    assert config.keyframes.every == 50 and not config.sampling.jitter
    assert config.tracking.final_rate_factor == 1.0 and not config.sensor_timing
    if name != "paper_imap":  # has settings of its own for the rest
        assert config.tracking.optimizer == "adam"
        assert config.mapping.active_share == 0.0 and config.mapping.first_iterations == 1500


@pytest.mark.parametrize("name", sorted(PRESETS))
def test_terms_of_the_paper_that_the_code_lacks_are_off(name):
    """Every preset, the published ones included, tracks and begins as before they could be turned on."""
    config = Config.from_preset(name)
    assert not config.tracking.coarse_term and config.tracking.filter_by == "depth"
    assert config.grid.middle_start == "noise"


def test_unknown_preset_lists_the_known():
    """The error offers the choices."""
    with pytest.raises(ConfigError, match="replica"):
        Config.from_preset("nonsense")


def test_yaml_round_trip(tmp_path):
    """What is saved is what is loaded."""
    config = Config.from_preset("tum_rgbd", ["keyframes.every=7"])
    config.save(tmp_path / "config.yaml")
    assert Config.load(tmp_path / "config.yaml") == config


def test_given_poses_decide_what_was_left_open():
    """No bundle adjustment, and a start from depth unless it is off; without them all is as it was asked for, but that
    with direct tracking mapping adjusts no poses.
    """
    given = Config.from_preset("default", ["tracking.use_given_poses=true"]).resolved().mapping
    assert (given.bundle_adjustment, given.depth_start) == (False, True)
    for optimizer in ("direct", "adam", "gauss_newton"):
        tracked = Config.from_preset("default", [f"tracking.optimizer={optimizer}"]).resolved().mapping
        assert (tracked.bundle_adjustment, tracked.depth_start) == (optimizer != "direct", False)
    for name in PRESETS:
        for overrides in ([], ["tracking.use_given_poses=true"], ["mapping.depth_start=true"]):
            config = Config.from_preset(name, overrides)
            before = config.model_dump()
            resolved = config.resolved()
            assert resolved.resolved() == resolved and config.model_dump() == before
            assert bool(resolved.mapping.depth_start) is (
                config.mapping.depth_start is not False
                if config.tracking.use_given_poses
                else bool(config.mapping.depth_start)
            )
            changed = [
                name
                for name, value in before["mapping"].items()
                if bool(value) != bool(getattr(resolved.mapping, name))
            ]
            assert set(changed) <= {"bundle_adjustment", "depth_start"}
            followed = {"bundle_adjustment"} if config.tracking.optimizer == "direct" else set()
            assert config.tracking.use_given_poses or set(changed) == followed


def test_what_followed_from_given_poses_ends_with_them():
    """A map that was made with given poses, and is tracked in: bundle adjustment is back, unless it was said not to."""
    given = Config.from_preset("default", ["tracking.use_given_poses=true"]).resolved()
    off = "tracking.use_given_poses=false"
    tracked = given.updated([off]).mapping
    assert tracked.bundle_adjustment and tracked.depth_start is None
    assert not given.updated([off, "mapping.bundle_adjustment=false"]).mapping.bundle_adjustment
    assert not given.updated(["mapping.iterations=9"]).mapping.bundle_adjustment
    kept = Config.from_preset("default", ["mapping.bundle_adjustment=false"]).updated([off])
    assert not kept.mapping.bundle_adjustment


def test_settings_of_a_file_with_overrides(tmp_path):
    """Overrides win over the file, which wins over the defaults; a file may name a single field."""
    path = tmp_path / "mine.yaml"
    path.write_text("mapping: {iterations: 7, pixels: 500}\n")
    config = Config.from_file(path, ["mapping.pixels=600"])
    assert (config.mapping.iterations, config.mapping.pixels) == (7, 600)
    assert config.tracking == Config().tracking
    config.save(tmp_path / "all.yaml")
    assert Config.from_file(tmp_path / "all.yaml") == config
    for text, message in (
        ("", "mine.yaml: expected a mapping"),
        ("mapping: {n: 1}", "mine.yaml: no setting mapping.n"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=message):
            Config.from_file(path)
    path.write_text("mapping: {iterations: 7}")
    with pytest.raises(ConfigError, match="mapping.pixels"):
        Config.from_file(path, ["mapping.pixels=-1"])


@pytest.mark.parametrize("text", ["- a list", "mapping: {iterations: many}", "mapping: [", "\x00"])
def test_unusable_yaml_is_a_config_error_with_the_file(tmp_path, text):
    """Not a mapping, a wrong type, broken yaml: the file is named."""
    path = tmp_path / "broken.yaml"
    path.write_text(text)
    with pytest.raises(ConfigError, match="broken.yaml"):
        Config.load(path)


# The same examples on every machine, however busy it is.
seeded = settings(deadline=None, derandomize=True)
GROUPS = [name for name, value in Config() if isinstance(value, BaseModel)]
FIELDS = [f"{group}.{name}" for group in GROUPS for name in type(getattr(Config(), group)).model_fields]
anything = st.one_of(
    st.none(), st.booleans(), st.integers(), st.floats(), st.text(max_size=6), st.lists(st.integers(), max_size=2)
)


def numbers(config):
    return [v for group in config.model_dump().values() if isinstance(group, dict) for v in group.values()]


@seeded
@given(st.lists(st.tuples(st.sampled_from(FIELDS), anything), max_size=4))
def test_any_setting_is_taken_or_refused_by_name(tmp_path_factory, changes):
    """A value of any kind gives finite settings that survive a file, or an error that names the field."""
    values: dict = {}
    for field, value in changes:
        group, name = field.split(".")
        values.setdefault(group, {})[name] = value
    try:
        config = Config.from_dict(values)
    except ConfigError as error:
        assert any(field in str(error) for field, _ in changes)
        return
    assert all(abs(value) < float("inf") for value in numbers(config) if isinstance(value, float))
    path = tmp_path_factory.mktemp("config") / "config.yaml"
    config.save(path)
    assert Config.load(path) == config


@seeded
@given(st.one_of(
    st.text(max_size=30),
    st.builds("{}={}".format, st.sampled_from([*FIELDS, "x", "mapping", "."]), st.text(max_size=12)),
))  # fmt: skip
def test_any_override_is_taken_or_refused(text):
    """Whatever stands behind --set."""
    try:
        assert isinstance(Config.from_preset("default", [text]), Config)
    except ConfigError:
        pass


@seeded
@given(st.one_of(st.binary(max_size=60), st.recursive(anything, lambda inner: st.dictionaries(
    st.sampled_from([*GROUPS, "iterations", "decoders"]), inner, max_size=3), max_leaves=6,
).map(lambda value: yaml.safe_dump(value).encode())))  # fmt: skip
def test_any_file_is_settings_or_refused(tmp_path_factory, data):
    """Binary rubbish and well-formed yaml of any shape."""
    path = tmp_path_factory.mktemp("config") / "config.yaml"
    path.write_bytes(data)
    try:
        assert isinstance(Config.load(path), Config)
    except ConfigError as error:
        assert "config.yaml" in str(error)


@pytest.mark.parametrize("value", [".nan", ".inf", "-.inf", "1e999"])
@pytest.mark.parametrize("field", ["meshing.level_set", "grid.max_depth", "tracking.learning_rate"])
def test_settings_are_finite(field, value):
    """NaN and infinity are no settings."""
    with pytest.raises(ConfigError, match=field):
        Config.from_preset("default", [f"{field}={value}"])


@pytest.mark.parametrize("text", ["9" * 5000, "[" * 3000, "{a: 2020-99-99}", "!!python/object/apply:os.abort []"])
def test_yaml_that_breaks_the_parser(tmp_path, text):
    """Errors that the yaml package lets through are settings errors too."""
    (tmp_path / "broken.yaml").write_text(text)
    with pytest.raises(ConfigError, match="broken.yaml"):
        Config.load(tmp_path / "broken.yaml")
    with pytest.raises(ConfigError):
        Config.from_preset("default", [f"mapping.pixels={text}"])


@pytest.mark.parametrize(
    ("override", "pattern"),
    [
        ("mapping.iteration=30", "no setting mapping.iteration; did you mean mapping.iterations"),
        ("max_depth=30", "no setting max_depth; did you mean grid.max_depth"),
        ("scene_scales=30", "no setting scene_scales; did you mean scene_scale"),
        ("xyzzy=30", "no setting xyzzy$"),
    ],
)
def test_a_slip_of_the_pen_is_corrected(override, pattern):
    """The name that was most likely meant, in our words."""
    with pytest.raises(ConfigError, match=pattern):
        Config.from_preset("default", [override])


def test_scene_scale_multiplies_every_length():
    """Once, squares of lengths twice; turns and shares stay, and what a run writes down has it in effect."""
    config = Config.from_preset("default", ["scene_scale=0.5", "mapping.moved_margin=0.2"])
    plain, scaled = Config.from_preset("default", ["mapping.moved_margin=0.2"]).resolved(), config.resolved()
    assert scaled.scene_scale == 1.0 and scaled.resolved() == scaled
    for group, name in (
        ("grid", "fine_spacing"), ("grid", "margin"), ("grid", "max_depth"), ("tracking", "lost_depth_error"),
        ("tracking", "max_step"), ("mapping", "moved_margin"), ("mapping", "frustum_margin"), ("meshing", "voxel"),
        ("tsdf", "voxel"),
    ):  # fmt: skip
        assert getattr(getattr(scaled, group), name) == 0.5 * getattr(getattr(plain, group), name), name
    assert scaled.meshing.min_component_area == 0.25 * plain.meshing.min_component_area
    assert scaled.tracking.max_turn == plain.tracking.max_turn
    rates = [c.tracking.learning_rate * c.tracking.rotation_rate_factor for c in (scaled, plain)]
    assert rates[0] == pytest.approx(rates[1])
    with pytest.raises(ConfigError, match="scene_scale"):
        Config.from_preset("default", ["scene_scale=0"])
