"""`jaxnbv demo`: its folder, its stop rules, and its background threads."""

import gc
import json
import re
import subprocess
import sys
import threading
import time
import types
import weakref
from unittest import mock

import pytest
from commands import run_command, run_process, run_without_error

from jaxnbv.cli import play
from jaxnbv.cli.tasks import TASKS
from jaxnbv.planning.loop import Step
from jaxnbv.search.candidates import sphere_candidates
from jaxnbv.viz import Sketches


def check_demo(folder, result, name):
    """Check a demo of two views, and return its folder."""
    assert result.returncode == 0, result.stderr
    out = folder / "runs" / name
    names = {path.name for path in out.iterdir()}
    assert {"episode.json", "view_00.npz", "view_01.npz", "cloud.ply", "report.html"} <= names
    assert "view 2" in result.stdout
    # Probabilities before and after: the likeliest three on a line after each view.
    lines = [line for line in result.stdout.splitlines() if line.count(" %") >= 3]
    assert [line.count("(was ") for line in lines] == [0, 3]
    assert max(map(len, result.stdout.splitlines())) <= 100
    assert "\r" not in result.stdout + result.stderr
    assert str(out.relative_to(folder) / "report.html") in result.stdout
    return out


def test_the_demo_leaves_an_episode_a_rival_and_a_report(tmp_path, monkeypatch):
    """This search needs no samples, and the first view is one of a few. The slow test has the default settings."""
    monkeypatch.setattr("jaxnbv.search.candidates.sphere_candidates", lambda count: sphere_candidates(12))
    result = run_command("demo", "--quick", "--model", "paper", "--search", "random", "--views", "2", cwd=tmp_path)
    out = check_demo(tmp_path, result, "truck-cross-entropy-random-paper-seed2")
    assert re.search(r"(?m)^race     .*[Ff]arthest view", result.stdout), result.stdout
    assert (out / "farthest" / "view_01.npz").exists()
    config = json.loads((out / "episode.json").read_text())["config"]
    assert config["planner"]["search"]["type"].endswith(":RandomView")


@pytest.mark.slow
def test_the_demo_runs_in_its_own_process_and_the_same_command_continues_it(tmp_path):
    options = ("demo", "--quick", "--known", "none")
    name = "truck-cross-entropy-halving-seed2"
    out = check_demo(tmp_path, run_process(*options, "--views", "2", cwd=tmp_path), name)
    before = {path.name: path.read_bytes() for path in out.glob("view_*.npz")}
    run_without_error(*options, "--views", "3", "--until", "never", "--no-report", cwd=tmp_path)
    assert (out / "view_02.npz").exists()
    assert all((out / name).read_bytes() == content for name, content in before.items())


def test_a_rule_ends_it_and_says_what_is_saved(tmp_path):
    """No other candidate is within a travel of 0.1."""
    arguments = ("demo", "--task", "coverage", "--quick", "--views", "3", "--search", "farthest", "--no-report")
    rules = ("--until", "travel=0.1", "--until", "seconds=1e6")
    result = run_without_error(*arguments, *rules, "--out", "mine", cwd=tmp_path)
    assert "enough   after view 1: the next view would cost" in result.stdout
    assert "Views saved: 2 of 3" in result.stdout
    assert len(list((tmp_path / "mine").glob("view_*.npz"))) == 1
    result = run_command(*arguments, "--until", "never", "--out", "mine", cwd=tmp_path)
    assert len(list((tmp_path / "mine").glob("view_*.npz"))) == 3
    assert "enough" not in result.stdout


RACE = """
import sys, threading, types
from jaxnbv.cli import main, play
from jaxnbv.cli.tasks import TASKS

racing = threading.Event()

def simulate(*arguments, each=None, **settings):
    if each is None:
        racing.set()
        threading.Event().wait()
    each(types.SimpleNamespace(view="view 1"))
    assert racing.wait(300)
    raise KeyboardInterrupt

play.simulate, play.ViewPrinter = simulate, lambda planner: print
TASKS["coverage"].until = ("seconds=1e6",)
sys.argv = ["jaxnbv", "demo", "--task", "coverage", "--no-report"]
main()
"""


def test_an_interrupt_ends_the_process_while_a_rival_still_runs(tmp_path):
    """The rival would never end."""
    script = [sys.executable, "-c", RACE]
    result = subprocess.run(script, cwd=tmp_path, capture_output=True, text=True, timeout=600)
    assert result.returncode == 130, result.stderr
    assert "view 1" in result.stdout


class Drawings(Sketches):
    """Sketches that block at the last view."""

    may_end = threading.Event()

    def add(self, step):
        assert step.view < 3 or self.may_end.wait(300)


def test_no_posterior_waits_for_a_rival_or_for_an_earlier_drawing(tmp_path, monkeypatch):
    references = []

    def simulate(*arguments, each=None, **settings):
        episode = types.SimpleNamespace(stop_reason=None, views=())
        if each is None:
            assert Drawings.may_end.wait(300)
            return episode
        for view in (1, 2, 3):
            step = mock.Mock(spec=Step, view=view, posterior={1, 2, 3})
            references.append(weakref.ref(step.posterior))
            each(step)
            del step
        # The thread of a drawing ends after its result is available.
        until = time.monotonic() + 60
        while any(one() for one in references[:2]) and time.monotonic() < until:
            gc.collect()
            time.sleep(0.01)
        references[:] = [one() is not None for one in references]
        Drawings.may_end.set()
        return episode

    monkeypatch.setattr(TASKS["coverage"], "until", ("seconds=1e6",))
    changes = {"simulate": simulate, "ViewPrinter": lambda planner: print, "rival_text": lambda *episodes: "a race"}
    monkeypatch.setattr(play.viz, "Sketches", Drawings)
    monkeypatch.setattr(play.viz, "write_report", lambda *arguments, **settings: "report.html")
    with mock.patch.multiple(play, **changes):
        result = run_without_error("demo", "--task", "coverage", cwd=tmp_path)
    assert "a race" in result.stdout
    assert references == [False, False, True]


@pytest.mark.slow
def test_the_demo_of_a_task_tells_what_was_found(tmp_path):
    setting = ("--task", "parts", "--known", "parts", "--scene", "7", "--quick", "--views", "2", "--search", "farthest")
    result = run_without_error("demo", *setting, cwd=tmp_path)
    assert result.stdout.count("wheel") == 2
    (report,) = tmp_path.rglob("report.html")
    assert "Points predicted of each part" in report.read_text()
