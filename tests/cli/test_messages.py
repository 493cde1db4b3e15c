"""Errors and warnings of commands, and commands of other packages."""

import os
import warnings

import pytest
import trimesh
from commands import run_command, run_process


def test_equal_warnings_are_printed_once_with_their_number(tmp_path, monkeypatch):
    def run_episode(*arguments, **settings):
        for place in ("here", "there", "here", "here"):
            warnings.warn(f"the mesh is {place}", stacklevel=2)
            # Libraries do this, and then Python's own filter prints every warning again.
            with warnings.catch_warnings():
                warnings.simplefilter("always")

    monkeypatch.setattr("jaxnbv.cli.play.run_episode", run_episode)
    with warnings.catch_warnings():
        warnings.simplefilter("default")
        result = run_command("demo", "--task", "coverage", cwd=tmp_path)
    lines = [line for line in result.stderr.splitlines() if "the mesh is" in line]
    assert lines == [
        "warning: the mesh is here",
        "warning: the mesh is there",
        "warning, 3 times in all: the mesh is here",
    ]


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("run", "absent.obj"), ("absent.obj",)),
        (("demo", "--task", "coverage", "--views", "0"), ("0 views", "at least one")),
        (("demo", "--task", "coverage", "--first", "1", "2"), ("--first", "3 arguments")),
        (("demo", "--task", "coverage", "--first", "0", "0", "0"), ("target",)),
        (("demo", "--task", "coverage", "--first", "0", "0", "9", "--noise", "-1"), ("-1", "negative")),
        (("demo", "--task", "coverage", "--first", "0.55", "-0.84", "0"), ("(0.55, -0.84, 0.0)", "inside")),
        (("run", "ball.obj", "--first", "0.3", "-1", "0.2"), ("(0.3, -1.0, 0.2)", "inside the object", "outside")),
        (("demo", "--task", "coverage", "--first", "0", "0", "1e30"), ("position", "1.e+30")),
        (("demo", "--scene", "99999999999999"), ("--scene", "2147483647")),
        (("run", "flat.obj"), ("flat.obj", "area")),
        (("run", "broken.glb"), ("broken.glb", "cannot read")),
        (("demo", "--task", "coverage", "--out", "flat.obj"), ("flat.obj", "File exists")),
        (("demo", "--task", "coverage", "--until", "surely=3"), ("'surely=3'", "sure", "never")),
        (("demo", "--task", "coverage", "--until", "sure"), ("'sure'", "a number")),
        (("demo", "--task", "coverage", "--until", "sure=0.9"), ("NewSurface", "classifier")),
        (("demo", "--vews", "3"), ("--vews", "--views")),
        (("demo", "--search", "halvng"), ("halvng", "discrete", "Did you mean 'halving'?")),
        (("demo", "--model", "paper", "--known", "truck"), ("--known truck", "no known shapes", "--model screened")),
        (("study", "pyramyd"), ("pyramyd", "Did you mean 'pyramid'?")),
        (("study", "recorded"), ("FOLDER",)),
        (("study", "recorded", "occupied", "--candidates", "9"), ("--candidates 9", "frames of the recording")),
        (("study", "pyramid", "--quick", "--settings", "paper"), ("--quick and --settings paper",)),
        (("demo", "--task", "coverage", "--out", "occupied"), ("occupied", "other files")),
        (("run", "ball.obj", "--task", "parts"), ("--category",)),
        (("run", "ball.obj", "--task", "parts", "--category", "teapot"), ("teapot", "mug")),
        (("run", "ball.obj", "--task", "parts", "--category", "knife"), ("knife", "--network")),
        (("run", "ball.obj", "--task", "heat", "--search", "gradient-2dof"), ("ColdestPoint", "DiscreteSearch")),
        (("run", "ball.obj", "--source", "1", "0", "0"), ("--source", "heat")),
        (("run", "ball.obj", "--task", "cross-entropy"), ("cross-entropy", "--network")),
        (("study", "parts", "--methods", "best"), ("best", "gradient-2dof")),
        (("study", "parts", "--method", "broken_module:it"), ("broken_module:it", "ZeroDivisionError")),
        (("study", "parts", "--method", "leaving:it"), ("leaving:it", "SystemExit")),
        (("study", "parts", "--method", "halved:it"), ("halved:it", "SyntaxError")),
        (("study", "parts", "--method", ".mine:it"), (".mine:it", "cannot be found")),
        (("study", "reconstruction", "--meshes", "occupied"), ("occupied", "no mesh")),
        (("study", "pyramid", "--quick", "--cluster", "here"), ("here", "dask scheduler")),
        (("study", "pyramid", "--quick", "--join", "occupied", "lost"), ("occupied", "no records of this study")),
    ],
)
def test_bad_input_is_one_line_that_names_the_value_and_the_remedy(arguments, words, tmp_path):
    for name, text in {"broken_module": "1 / 0", "leaving": "import sys\nsys.exit(5)", "halved": "def ("}.items():
        (tmp_path / f"{name}.py").write_text(text)
    (tmp_path / "flat.obj").write_text("v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n")
    (tmp_path / "broken.glb").write_bytes(b"glTF and no more")
    trimesh.creation.icosphere(2).export(tmp_path / "ball.obj")
    (tmp_path / "occupied").mkdir()
    (tmp_path / "occupied" / "thesis.tex").write_text("mine")
    result = run_command(*arguments, cwd=tmp_path)
    assert result.returncode == 2
    assert "Traceback" not in result.stderr
    assert all(word in result.stderr for word in words), result.stderr


def test_a_device_that_is_not_there_is_named(tmp_path, monkeypatch):
    monkeypatch.setenv("JAX_PLATFORMS", "rocm")
    result = run_process("demo", cwd=tmp_path)
    assert result.returncode == 2
    assert result.stderr.startswith("error: JAX_PLATFORMS is 'rocm', but JAX finds no such device here")


def test_a_command_of_another_package_stands_beside_ours(tmp_path, monkeypatch):
    """A command that cannot be imported, or has the name of ours, does not affect the others."""
    (tmp_path / "toy.py").write_text(
        'def greet(who: str = "you") -> None:\n    """Greets."""\n    print("hello", who)\n'
    )
    (tmp_path / "toy_broken.py").write_text("1 / 0")
    folder = tmp_path / "toy-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: toy\nVersion: 1.0\n")
    points = "greet = toy:greet\nview = toy:greet\nbreak = toy_broken:it\n"
    (folder / "entry_points.txt").write_text(f"[jaxnbv.commands]\n{points}")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=os.pathsep)
    result = run_process("--help", cwd=tmp_path)
    assert result.returncode == 0, result.stderr
    assert "Greets." in result.stdout
    assert "Look at a run or a session in the browser" in result.stdout
    (line,) = result.stderr.splitlines()
    assert line.startswith("warning: toy has no command break (ZeroDivisionError")
    assert run_process("greet", "--who", "me", cwd=tmp_path).stdout == "hello me\n"
