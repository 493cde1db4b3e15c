"""Whatever is given to a public constructor or function, it works or says what was wrong."""

import subprocess
import sys
from pathlib import Path


def test_any_argument_works_or_is_refused_by_name():
    script = Path(__file__).with_name("hostile.py")
    run = subprocess.run([sys.executable, script, "25"], capture_output=True, text=True)
    assert run.returncode == 0, run.stdout + run.stderr
