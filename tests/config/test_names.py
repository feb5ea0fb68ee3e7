"""Names in run files: renamed keys, sections of other problems, and unknown names with the nearest known one."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from icrl_dist.config import former_names, plugins
from icrl_dist.config import run as config
from icrl_dist.config.run import ConfigError, make_run, override, run_type

PROBLEMS, METHODS = plugins.names("problems"), plugins.names("methods")
SECTIONS = {plugins.find("problems", name).section for name in PROBLEMS}


def refusal(text: str) -> str:
    with pytest.raises(ConfigError) as caught:
        config.parse(text, "mine.toml")
    message = str(caught.value)
    assert message.startswith("mine.toml: ") and "\n" not in message
    return message


@pytest.mark.parametrize(("old", "new"), former_names.RENAMED.items())
def test_a_renamed_key_is_refused_with_its_new_name(old: str, new: str) -> None:
    section, _, key = old.partition(".")
    text = f"[{section}]\n{key or 'rounds'} = 1"
    assert refusal(text) == f"mine.toml: {old} is now called {new}: rename it"
    with pytest.raises(ConfigError, match=f"--set: {old} is now called {new}: rename it"):
        override(make_run(), [f"{section}.{key or 'rounds'}=1"], "--set")


@pytest.mark.parametrize(("old", "new"), former_names.RENAMED.items())
def test_the_new_name_of_a_renamed_key_exists(old: str, new: str) -> None:
    sections: dict[str, Any] = {item.name: item.default_factory for item in dataclasses.fields(run_type(None))}
    section, _, key = new.partition(".")
    assert section in sections
    if key:
        assert key in {item.name for item in dataclasses.fields(sections[section])}
    former, _, former_key = old.partition(".")
    assert former not in sections or former_key not in {item.name for item in dataclasses.fields(sections[former])}


@pytest.mark.parametrize("problem", PROBLEMS)
def test_a_section_of_another_problem_is_refused(problem: str) -> None:
    own = plugins.find("problems", problem).section
    assert own in {item.name for item in dataclasses.fields(run_type(problem))}
    for section in SECTIONS - {own}:
        owners = [name for name in PROBLEMS if plugins.find("problems", name).section == section]
        owner = owners[0] + (f" and {len(owners) - 1} other problems" if len(owners) > 1 else "")
        message = f"section [{section}]: problem = '{problem}' has no such section, it belongs to {owner}; leave it out"
        assert refusal(f'problem = "{problem}"\n[{section}]\nhorizon = 3') == f"mine.toml: {message}"
        with pytest.raises(ConfigError) as caught:
            override(make_run(problem), [f"{section}.horizon=3"], "--set")
        assert str(caught.value) == f"--set: {message}"
        assert not hasattr(make_run(problem), section)


@pytest.mark.parametrize("name", PROBLEMS)
def test_an_unknown_problem_is_refused_with_the_nearest(name: str) -> None:
    for wrong in (f"{name}x", f"{name[:3]}{name[4:]}"):
        message = refusal(f'problem = "{wrong}"')
        assert message.startswith(f"mine.toml: problem = '{wrong}'; did you mean '{name}'?")
        assert all(known in message for known in PROBLEMS)


@pytest.mark.parametrize("name", METHODS)
def test_an_unknown_method_is_refused_with_the_nearest(name: str) -> None:
    message = refusal(f'method = "{name}x"')
    assert message.startswith(f"mine.toml: method = '{name}x'; did you mean '{name}'?")
    assert all(known in message for known in METHODS)


def test_a_name_that_resembles_none_is_refused_with_all_of_them() -> None:
    message = refusal('problem = "qqqqqq"')
    assert "did you mean" not in message and all(known in message for known in PROBLEMS)
