"""Public constructors and functions accept any argument, or say what is wrong with it."""

import subprocess
import sys
from pathlib import Path

import pytest


def run(name, *arguments):
    script = Path(__file__).with_name(name)
    result = subprocess.run([sys.executable, script, *arguments], capture_output=True, text=True)
    assert result.returncode == 0, result.stdout + result.stderr


@pytest.mark.slow
def test_any_argument_works_or_is_refused_by_name():
    run("hostile.py", "25")


def test_earlier_failures_are_refused_by_name():
    run("refused.py")


def test_the_byte_order_of_arrays_does_not_matter():
    run("byte_order.py")
