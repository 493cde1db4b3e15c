"""Coverage by the authors' published code, by hand."""

import jax.numpy as jnp
import numpy as np
import pytest
from published import MeanCoverage

import jaxnbv as nbv
from jaxnbv.acquisition import ImaginedView
from jaxnbv.geometry import NearestPoints


def test_coverage_is_the_mean_over_the_points_of_the_scan():
    up = np.array([[0.0, 0.0, 1.0]])
    context = NearestPoints.of(nbv.PointCloud.from_arrays(np.zeros((1, 3)), up))
    # Squared distances 0.01, 0.04 and 0.09. The fourth row holds no point.
    points = jnp.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0], [0.3, 0.0, 0.0], [9.0, 0.0, 0.0]])
    scan = nbv.PointCloud(points, jnp.tile(up, (4, 1)), jnp.array([True, True, True, False]))
    view = ImaginedView(scan, nbv.Camera(), nbv.look_at((1.0, 0.0, 0.0)))
    assert float(MeanCoverage().score(context, view)) == pytest.approx(0.14 / 3)
    empty = ImaginedView(nbv.PointCloud(points, scan.normals, jnp.zeros(4, bool)), view.camera, view.pose)
    assert float(MeanCoverage().score(context, empty)) == 0.0
