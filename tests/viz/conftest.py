"""Small pictures for all tests here, and pictures without surfaces for those that do not read them."""

import pytest


@pytest.fixture(scope="module", autouse=True)
def coarse_pictures():
    """Trace surfaces at a quarter of the pixels on each side, since tracing takes most of the time of a picture."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxnbv.viz.render._STILL_SIZE", 160)
        yield


@pytest.fixture(scope="module")
def no_surfaces():
    """Leave out surfaces, which take long and affect neither numbers nor letters."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("jaxnbv.viz.shown_surface.mean_surface", lambda *arguments: None)
        yield
