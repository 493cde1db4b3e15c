"""Call the command line as a user does."""

import contextlib
import io
import os
import subprocess
import sys
from unittest import mock

from jaxnbv.cli import run_app

TERMINAL = {"COLUMNS": "200", "NO_COLOR": "1"}


def run_process(*arguments: str, cwd) -> subprocess.CompletedProcess:
    command = [sys.executable, "-m", "jaxnbv", *arguments]
    environment = {**os.environ, **TERMINAL}
    return subprocess.run(command, cwd=cwd, env=environment, capture_output=True, text=True, timeout=600)


def run_command(*arguments: str, cwd) -> subprocess.CompletedProcess:
    """The result of `run_process`, without the start of a process. Unexpected errors are raised here."""
    stdout, stderr, code = io.StringIO(), io.StringIO(), 0
    with (
        contextlib.chdir(cwd),
        contextlib.redirect_stdout(stdout),
        contextlib.redirect_stderr(stderr),
        mock.patch.dict(os.environ, TERMINAL),
        mock.patch.object(sys, "argv", ["jaxnbv", *arguments]),
    ):
        try:
            run_app()
        except SystemExit as leaving:
            code = leaving.code or 0
    return subprocess.CompletedProcess(arguments, code, stdout.getvalue(), stderr.getvalue())


def run_without_error(*arguments: str, cwd) -> subprocess.CompletedProcess:
    """The result of `run_command`, without an error."""
    result = run_command(*arguments, cwd=cwd)
    assert result.returncode == 0, result.stderr
    return result
