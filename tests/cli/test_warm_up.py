"""`jaxnbv warm-up` compiles the programs of a session."""

import re

import pytest
from commands import run_without_error


@pytest.mark.slow
def test_warm_up_compiles_for_a_camera(tmp_path):
    camera = ["--intrinsics", "40", "40", "32", "24", "--size", "48", "64"]
    result = run_without_error("warm-up", *camera, cwd=tmp_path)
    assert re.search(r"[1-9]\d+ programs in \d+ s, kept in ", result.stdout)
