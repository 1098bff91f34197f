"""Configuration: nested dataclasses to TOML and back, and errors that name the key."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from scanweld.config import (
    check_ranges,
    from_mapping,
    load_toml,
    merge,
    parse_override,
    section,
    setting,
    to_toml,
)
from scanweld.errors import ConfigError


@dataclass(frozen=True, slots=True, kw_only=True)
class Tracking:
    stable_fraction: float = setting(1.0, "share of the stable surfels used", low=0, high=1)
    max_iterations: int = setting(10, "iterations a level", low=1)

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Config:
    name: str = setting("run", "what it is called")
    fast: bool = setting(False, "skip the slow part")
    max_depth_m: float = setting(float("inf"), "farthest depth [m]", low=0)
    tracking: Tracking = section(Tracking, "frame to model")

    def __post_init__(self) -> None:
        check_ranges(self)


@dataclass(frozen=True, slots=True, kw_only=True)
class Twice:
    a: Tracking = section(Tracking, "one")
    b: Tracking = section(Tracking, "another")


@pytest.mark.parametrize(
    ("values", "advice"),
    [
        ({"stable_fraction": 1}, "did you mean 'tracking.stable_fraction'?"),  # of another section
        ({"tracking": {"max_depth": 1}}, "did you mean 'max_depth_m'?"),
        ({"tracking": {"stable": 1}}, "did you mean 'tracking.stable_fraction'?"),
        ({"trackin": {"stable": 1}}, "did you mean 'tracking'?"),
        ({"tracking": {"zzz": 1}}, "known keys: max_iterations, stable_fraction"),
    ],
)
def test_a_key_is_looked_for_in_all_sections(values: dict[str, object], advice: str) -> None:
    with pytest.raises(ConfigError) as caught:
        from_mapping(Config, values)
    assert str(caught.value).endswith(advice)


def test_several_keys_of_one_name_are_all_named() -> None:
    with pytest.raises(ConfigError, match=r"did you mean 'a\.max_iterations' or 'b\.max_iterations'\?"):
        from_mapping(Twice, {"max_iterations": 3})


def test_absent_keys_keep_their_defaults() -> None:
    assert from_mapping(Config, {}) == Config()
    assert from_mapping(Config, {"tracking": {"max_iterations": 3}}) == Config(tracking=Tracking(max_iterations=3))


def test_a_misspelt_nested_key_names_the_nearest() -> None:
    """Golden 5."""
    with pytest.raises(
        ConfigError,
        match=r"a[.]toml: unknown key 'tracking[.]stable_fracton'; did you mean 'tracking[.]stable_fraction'",
    ):
        from_mapping(Config, {"tracking": {"stable_fracton": 0.1}}, where="a.toml")
    with pytest.raises(ConfigError, match="unknown key 'zzz'; known keys: fast, max_depth_m, name, tracking"):
        from_mapping(Config, {"zzz": 1})


@pytest.mark.parametrize(
    ("values", "words"),
    [
        (
            {"tracking": {"max_iterations": 0}},
            r"tracking[.]max_iterations = 0: expected a value from 1 to inf",
        ),
        ({"tracking": {"stable_fraction": 1.5}}, "from 0 to 1"),
        ({"tracking": {"stable_fraction": float("nan")}}, "from 0 to 1"),
        ({"tracking": {"max_iterations": 2.5}}, "expected int, got 2.5"),
        ({"tracking": {"max_iterations": True}}, "expected int, got True"),
        ({"tracking": 3}, "'tracking' is a section"),
        ({"fast": 1}, "expected bool, got 1"),
        ({"name": 1}, "expected str, got 1"),
        ({"max_depth_m": "far"}, "expected float, got 'far'"),
    ],
)
def test_wrong_values_name_their_key(values: dict[str, object], words: str) -> None:
    with pytest.raises(ConfigError, match=words):
        from_mapping(Config, values)


def test_whole_numbers_serve_as_floats() -> None:
    value = from_mapping(Config, {"max_depth_m": 4}).max_depth_m
    assert value == 4.0
    assert isinstance(value, float)


@given(
    st.text(max_size=30),
    st.booleans(),
    st.floats(0, allow_infinity=True),
    st.floats(0, 1),
    st.integers(1, 10**9),
)
def test_toml_round_trip(name: str, fast: bool, depth: float, fraction: float, iterations: int) -> None:
    """Written and read, every value is the same to the bit, strings with quotes and line breaks too."""
    config = Config(
        name=name,
        fast=fast,
        max_depth_m=depth,
        tracking=Tracking(stable_fraction=fraction, max_iterations=iterations),
    )
    import tomllib

    assert from_mapping(Config, tomllib.loads(to_toml(config))) == config


def test_toml_documents_every_key() -> None:
    text = to_toml(Config())
    for words in (
        "# share of the stable surfels used\nstable_fraction = 1.0",
        "[tracking]",
        "max_depth_m = inf",
        'name = "run"',
    ):
        assert words in text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("tracking.stable_fraction=0.1", {"tracking": {"stable_fraction": 0.1}}),
        ("fast=true", {"fast": True}),
        ("name=kitchen", {"name": "kitchen"}),
        ('name="a=b"', {"name": "a=b"}),
        ("max_depth_m = 5", {"max_depth_m": 5}),
        ("a.b.c=[1, 2]", {"a": {"b": {"c": [1, 2]}}}),
    ],
)
def test_overrides(text: str, expected: dict[str, object]) -> None:
    assert parse_override(text) == expected


@pytest.mark.parametrize("text", ["", "fast", "=1"])
def test_an_override_without_key_or_value(text: str) -> None:
    with pytest.raises(ConfigError, match="expected key=value"):
        parse_override(text)


def test_merge_goes_section_by_section_and_changes_nothing() -> None:
    base = {"a": 1, "s": {"x": 1, "y": 2}}
    extra = {"s": {"y": 3}, "b": 4}
    assert merge(base, extra) == {"a": 1, "b": 4, "s": {"x": 1, "y": 3}}
    assert base == {"a": 1, "s": {"x": 1, "y": 2}}
    assert extra == {"s": {"y": 3}, "b": 4}


def test_defaults_then_file_then_override(tmp_path: Path) -> None:
    (tmp_path / "c.toml").write_text("fast = true\n[tracking]\nmax_iterations = 5\nstable_fraction = 0.5\n")
    values = merge(load_toml(tmp_path / "c.toml"), parse_override("tracking.max_iterations=7"))
    expected = replace(Config(), fast=True, tracking=Tracking(max_iterations=7, stable_fraction=0.5))
    assert from_mapping(Config, values) == expected


@pytest.mark.parametrize("content", [b"a = ", b"\xff\xfe", b"a = 1\na = 2\n"])
def test_files_that_are_no_toml(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "c.toml").write_bytes(content)
    with pytest.raises(ConfigError, match=r"c[.]toml: not a readable TOML file"):
        load_toml(tmp_path / "c.toml")
    with pytest.raises(ConfigError, match="no such file"):
        load_toml(tmp_path / "none.toml")
