"""Sentinels: values of a depth image that stand for "not measured", such as 65535, 10000 or 2047."""

import warnings

import numpy as np
from jaxtyping import Bool, Real

# A sentinel fills more pixels than this many rows or columns, which a noise-free image of a floor does not. It fills
# this many times as many pixels as any value within this share of it.
_ROWS, _ABOVE, _NEAR = 2, 20, 0.05
# If the sensor's reach is unknown, a sentinel is at least this many times any other value.
_BEYOND = 2.0


def sentinel_pixels(image: Real[np.ndarray, "h w"], reach: float) -> Bool[np.ndarray, "h w"]:
    """Whether each pixel holds a sentinel, a value that a sensor writes where it measured nothing.

    A sentinel is the largest value of an integer type, or a value beyond the reach that fills far more pixels than any
    value near it (with a `UserWarning`). If all pixels hold the same value, it is no sentinel, since it may be a wall.

    - `image`: depths in any units.
    - `reach`: the largest depth that matters, in the image's units; infinite if unknown. A sentinel is then at least
      twice any other value.
    """
    is_integer = np.issubdtype(image.dtype, np.integer)
    largest = image == np.iinfo(image.dtype).max if is_integer else np.zeros(image.shape, bool)
    measured = image[np.isfinite(image) & (image > 0) & ~largest]
    if not len(measured):
        return largest
    if np.isinf(reach):
        others = measured[measured < measured.max()]
        reach = _BEYOND * others.max(initial=0)
    values, counts = np.unique(measured[measured > reach], return_counts=True)
    sentinels = []
    for index in np.flatnonzero((counts > _ROWS * max(image.shape)) & (counts < len(measured))):
        low, high = np.searchsorted(values, values[index] * np.array([1.0 - _NEAR, 1.0 + _NEAR]))
        if counts[index] < _ABOVE * np.delete(counts[low:high], index - low).max(initial=0):
            continue
        sentinels.append(index)
        warnings.warn(
            f"the depth image has the value {values[index]:g} in {counts[index]} pixels, as no measured surface would: "
            "these pixels count as not measured. Give infinity where a ray met nothing",
            stacklevel=5,
        )
    return largest | np.isin(image, values[sentinels])
