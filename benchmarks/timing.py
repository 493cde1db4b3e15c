"""The clock of the benchmarks."""

import time

import jax


def least_time(function, repeats: int = 3) -> float:
    """Least wall time of some runs in seconds, after one run that compiles."""
    jax.block_until_ready(function())
    times = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        times.append(time.perf_counter() - start)
    return min(times)
