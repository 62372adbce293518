"""Methods by name, and what each can do."""

from __future__ import annotations

import inspect

import pytest

from warpslam.errors import ConfigError
from warpslam.pipeline.methods import METHODS, Method, _class_of, check_method, has_checkpoints


@pytest.mark.parametrize("name", METHODS)
def test_every_method_has_all_that_a_run_calls(name):
    """Each member of the protocol is there, and takes the arguments that the protocol names."""
    method = _class_of(name)
    for member, asked in vars(Method).items():
        if not inspect.isfunction(asked) or member.startswith("_"):
            continue
        parameters = inspect.signature(getattr(method, member)).parameters
        assert set(inspect.signature(asked).parameters) <= set(parameters), f"{name}.{member}"
    assert isinstance(method.has_checkpoints, bool)


def test_checkpoints_are_a_matter_of_the_method():
    """What a class says of itself; an unknown name is refused with the known ones."""
    assert [has_checkpoints(name) for name in METHODS] == [True, False, False]
    for ask in (has_checkpoints, check_method):
        with pytest.raises(ConfigError, match="'orb' is unknown; choose one of nice-slam, imap, tsdf"):
            ask("orb")
