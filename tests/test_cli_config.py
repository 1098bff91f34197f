"""`scanweld config` and `scanweld datasets`."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

import scanweld as sw
from scanweld.cli.app import run
from scanweld.datasets.open import FORMATS


class TestConfig:
    def test_what_is_shown_is_read_back_as_the_same_settings(
        self, tmp_path: Path, capsys: pytest.CaptureFixture[str]
    ) -> None:
        assert run(["config", "show", "--set", "tracking.stable_fraction=0.25"]) == 0
        text = capsys.readouterr().out
        shown = sw.from_mapping(sw.SlamConfig, tomllib.loads(text), "shown")
        assert shown == sw.SlamConfig(tracking=sw.TrackingConfig(stable_fraction=0.25))
        assert "# track against this share" in text  # every setting says what it means
        file = tmp_path / "my.toml"
        file.write_text(text, encoding="utf-8")
        assert run(["config", "check", str(file)]) == 0
        assert str(file) in capsys.readouterr().out

    @pytest.mark.parametrize(
        "text", ["[tracking]\nstable_fractoin = 0.1\n", "[tracking]\nstable_fraction = 7\n", "x ="]
    )
    def test_a_faulty_file_is_named(self, text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        file = tmp_path / "my.toml"
        file.write_text(text, encoding="utf-8")
        assert run(["config", "check", str(file)]) == 1
        message = capsys.readouterr().err
        assert message.count("\n") == 1
        assert "my.toml" in message

    def test_check_needs_a_file(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["config", "check"]) == 1
        assert "which file?" in capsys.readouterr().err


class TestDatasets:
    def test_list_names_every_format(self, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["datasets", "list"]) == 0
        lines = capsys.readouterr().out.splitlines()
        assert [line.split()[0] for line in lines] == [row.name for row in FORMATS]

    def test_check_says_what_a_sequence_holds(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        folder = tmp_path / "room"
        sw.render_sequence(folder, sw.RenderConfig(width=80, height=60, frames=3))
        assert run(["datasets", "check", str(folder)]) == 0
        shown = capsys.readouterr().out
        for words in ("room", "frames   3, ", "80x60", "5000 units per metre", "truth    3 poses"):
            assert words in shown

    def test_check_of_what_is_none(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
        assert run(["datasets", "check"]) == 1
        assert "which sequence?" in capsys.readouterr().err
        assert run(["datasets", "check", str(tmp_path)]) == 1
        assert capsys.readouterr().err.count("\n") == 1
