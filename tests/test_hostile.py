"""Public constructors and functions accept any argument, or say what is wrong with it."""

import subprocess
import sys
from pathlib import Path

import pytest


@pytest.mark.parametrize(
    "program",
    [
        ("refused.py",),
        pytest.param(("hostile.py", "25"), marks=pytest.mark.slow),
        pytest.param(("byte_order.py",), marks=pytest.mark.slow),
    ],
    ids=lambda program: program[0],
)
def test_arguments_work_or_are_refused_by_name(program):
    script, *arguments = program
    command = [sys.executable, Path(__file__).with_name(script), *arguments]
    result = subprocess.run(command, capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr
