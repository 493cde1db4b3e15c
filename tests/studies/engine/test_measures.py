"""Numbers from hand-made records: means, errors, intervals and leads, and their tables, charts and verdicts."""

import io
import re

import numpy as np
import pandas as pd
import pytest
from PIL import Image
from toy import ToyStudy

from jaxnbv.checks import InputError
from jaxnbv.studies.engine.chart import LOOKS, chart
from jaxnbv.studies.engine.measures import Claim, Measure
from jaxnbv.studies.engine.results import results, summary, tables, verdicts
from jaxnbv.studies.registry import studies

POINTS, MANY, ODD = ToyStudy.measures


def record(scene, **methods):
    return {"scene": scene, "methods": {name: {"odd": None, "points": points} for name, points in methods.items()}}


RECORDS = [
    record(0, farthest=[1000, 3500, 4000], random=[1000, 2000, 2500]),
    record(1, farthest=[800, 3100, 5000], random=[800, 2600, 3100]),
]
RECORDS[1]["methods"]["random"]["odd"] = 0.5


def measuring(*measures, claims=()):
    return type("Measuring", (ToyStudy,), {"measures": measures, "claims": claims})


def row_of(table, quantity, at, method, group="all"):
    same = (table["group"] == group) & (table["quantity"] == quantity)
    (row,) = table[same & (table["at"] == at) & (table["method"] == method)].to_dict("records")
    return row


def test_rows_are_means_with_errors_intervals_and_leads():
    table = results(RECORDS, ToyStudy)
    assert {*table["group"]} == {"all", "even", "odd"}
    ours, theirs = (row_of(table, "points", 2, method) for method in ("farthest", "random"))
    # Points of 3,500 and 3,100: a standard deviation of 400 / sqrt(2), divided by sqrt(2).
    assert [ours[name] for name in ("mean", "standard_error", "scenes")] == [3300.0, pytest.approx(200.0), 2]
    assert ours["by"] == "view"
    # Two scenes have four resamples, each of one scene twice in a quarter of them.
    assert (ours["low"], ours["high"]) == (3100.0, 3500.0)
    assert (theirs["lead"], theirs["lead_low"], theirs["lead_high"]) == (1000.0, 500.0, 1500.0)
    assert row_of(table, "many", 3, "random")["mean"] == 0.5
    alone = row_of(table, "points", 2, "random", "odd")
    assert (alone["mean"], alone["scenes"], pd.isna(alone["standard_error"])) == (2600.0, 1, True)
    with pytest.raises(InputError, match="no records"):
        results([], ToyStudy)


def test_scenes_without_a_value_are_left_out_of_a_number():
    def gaps(record, method):
        return [1.0, None if record["scene"] == 0 and method == "random" else 2.0 + record["scene"]]

    measures = Measure("gaps", "Gaps", gaps), Measure("none", "None", lambda r, m: [None]), ODD
    table = results(RECORDS, measuring(*measures))
    assert {row_of(table, "gaps", 1, method)["scenes"] for method in ("farthest", "random")} == {2}
    # The comparison uses the one scene that both have.
    two = [row_of(table, "gaps", 2, method) for method in ("farthest", "random")]
    assert [(row["scenes"], row["mean"]) for row in two] == [(1, 3.0)] * 2
    # A method without values has no row.
    assert [*table[(table["quantity"] == "odd") & (table["group"] == "all")]["method"]] == ["random"]
    assert "none" not in {*table["quantity"]}


def test_tables_show_shares_errors_and_leads():
    table = results(RECORDS, ToyStudy)
    text = summary(table, ToyStudy)
    # A star moves no digit out of its column.
    signs = [[match.start() for match in re.finditer(r"\+-", line)] for line in text.splitlines() if " +- " in line]
    assert signs[-2] == signs[-1]
    lines = [" ".join(line.split()) for line in text.splitlines()]
    assert "Points of a ball: 2 scenes" in lines
    assert "farthest 900.0 +- 100.0* 3300.0 +- 200.0* 4500.0 +- 500.0*" in lines
    assert "random 900.0 +- 100.0* 2300.0 +- 300.0 2800.0 +- 300.0" in lines
    # The first view is the same for all, and has no row.
    assert "random +1000.0 [+500.0, +1500.0]* +1700.0 [+1500.0, +1900.0]*" in lines
    assert "random 0 [0, 0]* 0 [0, 0] 50 [0, 100]" in lines
    assert "random +100 [+100, +100]* +50 [+0, +100]" in lines
    assert "nan" not in " ".join(lines)


def test_less_can_be_better():
    less = measuring(POINTS._replace(lower_is_better=True))
    cells = dict(tables(results(RECORDS, less), less))["Points, by view"]
    assert [cells.loc[method, 3].endswith("*") for method in ("farthest", "random")] == [False, True]


@pytest.mark.parametrize("scenes", [1, 2])
def test_the_chart_shows_every_method(scenes):
    image = np.asarray(Image.open(io.BytesIO(chart(results(RECORDS[:scenes], ToyStudy), ToyStudy))).convert("RGB"))
    for colour in ([0x00, 0x72, 0xB2], [0x7A, 0x84, 0x94]):
        assert (np.abs(image.astype(int) - colour).sum(axis=-1) < 6).sum() > 200


def test_each_main_method_has_a_look_of_its_own():
    assert {entry.load().reference for entry in studies().values()} <= LOOKS.keys()


COLUMNS = ["quantity", "method", "lead", "lead_low", "lead_high", "at", "group"]
ROWS = [
    ("right", "a", 0.3, 0.2, 0.4, 2, "all"),
    ("right", "b", 0.1, -0.05, 0.25, 2, "all"),
    ("right", "c", -0.2, -0.3, -0.1, 2, "all"),
    ("right", "a", -0.9, -1.0, -0.8, 2, "odd"),
    ("right", "a", -0.9, -1.0, -0.8, 3, "all"),
    ("away", "a", -2.0, -3.0, -1.0, 2, "all"),
    ("away", "b", 1.0, -1.0, 3.0, 2, "all"),
    ("away", "c-screened", 2.0, 1.0, 3.0, 2, "all"),
    ("away", "other", 2.0, 1.0, 3.0, 2, "all"),
]


def test_a_claim_holds_where_the_interval_lies_on_its_side():
    """Less may be better. A claim may be about all scenes only. Methods without known shapes count too. Claims without
    data are left out."""
    said = measuring(
        Measure("right", "Right", lambda record, method: [], unit="%"),
        Measure("away", "Away", lambda record, method: [], lower_is_better=True, digits=1),
        claims=(
            Claim("More are right.", "right", 2, ("a", "b", "c", "absent")),
            Claim("As near.", "away", 2, ("a", "b", "c"), must_be_better=False),
            Claim("Later too.", "right", 5, ("a",)),
        ),
    )
    right, away = verdicts(pd.DataFrame(ROWS, columns=COLUMNS), said)
    assert (right.num_held, right.num_methods) == (1, 3)
    assert right.sentence == (
        "Holds against 1 of 3: ahead of a (+30 [+20, +40]); level with b (+10 [-5, +25]); behind c (-20 [-30, -10])."
    )
    assert (away.num_held, away.num_methods) == (2, 3)
    assert "ahead of a (-2.0 [-3.0, -1.0])" in away.sentence
    assert "behind c-screened (+2.0 [+1.0, +3.0])" in away.sentence


@pytest.mark.parametrize("name", studies())
def test_the_claims_of_a_study_name_what_it_has(name):
    study = studies()[name].load()
    assert study.claims
    for claim in study.claims:
        assert claim.measure in {measure.name for measure in study.measures}
        assert {*claim.others} <= {*study.methods, *study.extra_methods} - {study.reference}
