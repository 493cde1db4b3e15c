"""OpenCV's lens model in NumPy, from its page on calibration (calib3d, "Detailed Description")."""

import numpy as np


def distort(places: np.ndarray, coefficients) -> np.ndarray:
    """Image of places (x, y) of the plane z = 1 in that plane, an array (..., 2).

    - `coefficients`: k1, k2, p1, p2[, k3[, k4, k5, k6]].
    """
    k1, k2, p1, p2, k3, k4, k5, k6 = np.pad(np.asarray(coefficients, float), (0, 8 - len(coefficients)))
    x, y = places[..., 0], places[..., 1]
    r2 = x * x + y * y
    radial = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=-1,
    )


def undistort(places: np.ndarray, coefficients) -> np.ndarray:
    """The inverse of `distort`, by fixed-point iteration. Fails unless the result maps back to within 1e-9."""
    ideal = places.copy()
    for _ in range(200):
        ideal = ideal + places - distort(ideal, coefficients)
    np.testing.assert_allclose(distort(ideal, coefficients), places, atol=1e-9)
    return ideal
