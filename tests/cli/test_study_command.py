"""`jaxnbv study`: its help, its options and its output."""

from pathlib import Path

import pytest
import typer
from commands import run_command, run_without_error

from jaxnbv.cli import app
from jaxnbv.studies.registry import studies


def test_an_option_for_several_folders_takes_all_words_up_to_the_next():
    words = ["--join", "a", "b", "--quick", "--join", "c", "--workers", "2"]
    values = typer.main.get_command(app).commands["study"].commands["pyramid"].make_context("pyramid", words).params
    assert values["join"] == [Path("a"), Path("b"), Path("c")]
    assert (values["quick"], values["workers"]) == (True, 2)


def test_the_help_of_studies_is_an_overview_and_that_of_a_study_has_its_options_alone(tmp_path):
    overview = run_command("study", "--help", cwd=tmp_path).stdout
    lines = {words[1]: line for line in overview.splitlines() if len(words := line.split()) > 2}
    assert all(lines[name].rstrip("│ ").endswith("?") for name in studies())
    assert "--scenes" not in overview
    assert len(overview.splitlines()) < 35
    own = {name: run_command("study", name, "--help", cwd=tmp_path).stdout for name in ("pyramid", "recorded")}
    assert all("--capacity" in text for text in own.values())
    assert ["--framing" in text for text in own.values()] == [True, False]
    assert ["--depth-scale" in text for text in own.values()] == [False, True]


@pytest.mark.slow
def test_the_study_writes_tables_and_figures_and_continues(tmp_path):
    arguments = ("study", "pyramid", "--quick", "--views", "2", "--framing", "whole", "--out", "mine")
    some = ("--methods", "farthest,oracle")
    result = run_without_error(*arguments, *some, "--scenes", "1", cwd=tmp_path)
    assert "not the full study" in result.stdout
    folder = tmp_path / "mine" / "whole"
    first = (folder / "scene_0000.json").read_bytes()
    assert {"results.csv", "chart.png", "scene_0000.png"} <= {path.name for path in folder.iterdir()}
    result = run_without_error(*arguments, *some, "--scenes", "2", cwd=tmp_path)
    assert (folder / "scene_0000.json").read_bytes() == first
    assert (folder / "scene_0001.json").exists()
    result = run_command(*arguments, "--methods", "farthest,best", cwd=tmp_path)
    assert result.returncode == 2
    assert "best" in result.stderr


@pytest.mark.slow
@pytest.mark.parametrize("name", ["heat", "reconstruction"])
def test_each_study_writes_tables_figures_and_pictures(name, tmp_path):
    sizes = ("--quick", "--scenes", "1", "--views", "2", "--methods", "farthest,random")
    result = run_without_error("study", name, *sizes, "--out", "it", cwd=tmp_path)
    assert "not the full study" in result.stdout
    written = {path.name for path in (tmp_path / "it").iterdir()}
    assert {"study.json", "scene_0000.json", "results.csv", "chart.png", "scene_0000.png"} <= written
