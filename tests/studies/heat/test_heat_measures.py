"""What the heat study measures, from records made by hand."""

import pytest

from jaxnbv.studies.engine.results import results
from jaxnbv.studies.heat.study import HeatStudy


def made_run(distances, temperatures, values=(0.5, 0.0)):
    """Estimates among warmed points are a tenth nearer, and as warm."""
    estimates = {
        name: {"distances": [distance - less for distance in distances], "temperatures": list(temperatures)}
        for name, less in (("all", 0.0), ("reached", 0.1))
    }
    steps = [{"value": value, "seconds": 10.0 + 2.0 * index} for index, value in enumerate(values)]
    return {"steps": steps, "estimates": estimates}


def record(scene, **methods):
    return {"scene": scene, "truth": {"temperature": 0.1}, "methods": methods}


RECORDS = [
    record(
        0,
        heat=made_run((1.0, 0.4, 0.2), (0.9, 0.2, 0.0)),
        random=made_run((1.0, 0.8, 0.6), (0.9, 0.3, 0.2), (0.7, 0.2)),
    ),
    record(
        1,
        heat=made_run((1.4, 0.6, 0.4), (0.7, 0.4, 0.1), (0.3, 0.1)),
        random=made_run((1.4, 1.0, 0.6), (0.7, 0.3, 0.2), (0.7, 0.2)),
    ),
]


def test_measures_are_of_the_estimates():
    rows = results(RECORDS, HeatStudy).set_index(["quantity", "method", "at"]).sort_index()
    row = rows.loc["distance, all", "heat", 2]
    # Of 0.4 and 0.6: a standard deviation of 0.1414, over the root of two.
    assert (row["mean"], row["standard_error"], row["scenes"]) == (pytest.approx(0.5), pytest.approx(0.1), 2)
    assert rows.loc[("distance, reached", "heat", 2), "mean"] == pytest.approx(0.4)
    # Temperatures of 0 and 0.1 in place of 0.1: an error is an error above or below.
    assert rows.loc[("error, all", "heat", 3), "mean"] == pytest.approx(0.05)
    assert rows.loc[("error, all", "random", 1), "mean"] == pytest.approx(0.7)
    # Both scenes differ by -0.4, so any resample does; at the third view by -0.4 and -0.2.
    lead = ["lead", "lead_low", "lead_high"]
    assert [*rows.loc[("distance, all", "random", 2), lead]] == pytest.approx([-0.4] * 3)
    assert [*rows.loc[("distance, reached", "random", 3), lead]] == pytest.approx([-0.3, -0.4, -0.2])
    # Steps without a view of any value are counted where cold is sought.
    assert [*rows.loc["saturated"].index] == [("heat", 2), ("heat", 3)]
    assert [*rows.loc["saturated"]["mean"]] == [0.0, 0.5]
    assert rows.loc[("seconds", "heat", "median"), "mean"] == 12.0
