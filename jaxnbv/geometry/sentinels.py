"""Detection of sentinels: values of a depth image, such as 65535 or 2047, that mean "not measured"."""

import warnings

import numpy as np
from jaxtyping import Bool, Real

# A sentinel fills more pixels than `_MIN_ROWS` rows or columns. Even in a noise-free image of a floor, no depth fills
# so many. A sentinel also fills at least `_MIN_COUNT_RATIO` times as many pixels as any value that differs from it by
# at most the fraction `_MAX_DIFFERENCE`.
_MIN_ROWS, _MIN_COUNT_RATIO, _MAX_DIFFERENCE = 2, 20, 0.05
# If the largest relevant depth is unknown, a sentinel must exceed any other value by at least this factor.
_MIN_VALUE_RATIO = 2.0


def sentinel_pixels(image: Real[np.ndarray, "h w"], max_depth: float) -> Bool[np.ndarray, "h w"]:
    """Return, for each pixel, whether it holds a sentinel: a value that means "not measured".

    There are two kinds of sentinels: the largest value of an integer type, and a value above `max_depth` that fills far
    more pixels than any similar value. The second kind gives a `UserWarning`. A value that all measured pixels have is
    not of the second kind, because the image may show a wall.

    - `max_depth`: greatest depth at which a surface matters, in the image's units. If it is infinite (unknown), a
      sentinel of the second kind must be more than twice any other value.
    """
    is_integer = np.issubdtype(image.dtype, np.integer)
    is_largest = image == np.iinfo(image.dtype).max if is_integer else np.zeros(image.shape, bool)
    measured = image[np.isfinite(image) & (image > 0) & ~is_largest]
    if not len(measured):
        return is_largest
    if np.isinf(max_depth):
        others = measured[measured < measured.max()]
        max_depth = _MIN_VALUE_RATIO * others.max(initial=0)
    values, counts = np.unique(measured[measured > max_depth], return_counts=True)
    sentinels = []
    for index in np.flatnonzero((counts > _MIN_ROWS * max(image.shape)) & (counts < len(measured))):
        low, high = np.searchsorted(values, values[index] * np.array([1.0 - _MAX_DIFFERENCE, 1.0 + _MAX_DIFFERENCE]))
        if counts[index] < _MIN_COUNT_RATIO * np.delete(counts[low:high], index - low).max(initial=0):
            continue
        sentinels.append(index)
        warnings.warn(
            f"the depth image has the value {values[index]:g} in {counts[index]} pixels, as no measured surface would: "
            "these pixels count as not measured. Give infinity where a ray met nothing",
            stacklevel=5,
        )
    return is_largest | np.isin(image, values[sentinels])
