"""Five views of the small episode in a folder, written once."""

import pytest
from small_episode import run


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("runs") / "five"
    return run(folder, views=5), folder
