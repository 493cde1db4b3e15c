"""What the paper says, and what differences made by hand say to it."""

import pkgutil
from typing import ClassVar

import pandas as pd
import pytest
from toy import ToyStudy

from jaxnbv.studies.engine.measures import Claim, Measure
from jaxnbv.studies.engine.page import verdicts
from jaxnbv.studies.registry import STUDIES


class Shares(ToyStudy):
    measures: ClassVar[tuple[Measure, ...]] = (
        Measure("right", "Right", lambda record, method: [], percent=True),
        Measure("away", "Away", lambda record, method: [], better="less", digits=1),
    )
    claims: ClassVar[tuple[Claim, ...]] = (
        Claim("More are right.", "right", 2, ("a", "b", "c", "absent")),
        Claim("As near.", "away", 2, ("a", "b", "c"), ahead=False),
        Claim("Later too.", "right", 5, ("a",)),
    )


def row(quantity, baseline, mean, low, high, at=2, group="all"):
    zero = low > 0 or high < 0
    return {"group": group, "quantity": quantity, "at": at, "baseline": baseline} | {
        "mean": mean,
        "low": low,
        "high": high,
        "excludes_zero": zero,
    }


ROWS = [
    row("right", "c", -0.2, -0.3, -0.1),
    row("right", "b", 0.1, -0.05, 0.25),
    row("right", "a", 0.3, 0.2, 0.4),
    row("right", "a", -0.9, -1.0, -0.8, group="odd"),
    row("right", "a", -0.9, -1.0, -0.8, at=3),
    row("away", "a", -2.0, -3.0, -1.0),
    row("away", "b", 1.0, -1.0, 3.0),
    row("away", "c", 2.0, 1.0, 3.0),
    row("away", "other", 2.0, 1.0, 3.0),
]


def test_a_claim_holds_where_the_interval_lies_on_its_side():
    """Less may be better; of all scenes alone; a claim of which nothing tells is left out."""
    right, away = verdicts(Shares, pd.DataFrame(ROWS))
    assert {method: where for method, (where, _) in right.against.items()} == {
        "a": "ahead of",
        "b": "level with",
        "c": "behind",
    }
    assert right.held == 1
    assert right.sentence == (
        "Holds against 1 of 3: ahead of a (+30 [+20, +40]); level with b (+10 [-5, +25]); behind c (-20 [-30, -10])."
    )
    assert {method: where for method, (where, _) in away.against.items()} == {
        "a": "ahead of",
        "b": "level with",
        "c": "behind",
    }
    assert away.held == 2
    assert "ahead of a (-2.0 [-3.0, -1.0])" in away.sentence


@pytest.mark.parametrize("name", STUDIES)
def test_the_claims_of_a_study_name_what_it_has(name):
    study = pkgutil.resolve_name(STUDIES[name].study)
    assert study.claims
    for claim in study.claims:
        assert study.measure(claim.measure).listed
        assert {*claim.than} <= {*study.methods} - {study.reference}


def test_a_method_that_knows_no_shapes_counts_too():
    (right,) = verdicts(Shares, pd.DataFrame([*ROWS[1:3], row("right", "a-screened", -0.2, -0.3, -0.1)]))
    assert list(right.against) == ["a", "a-screened", "b"]
    assert (right.held, len(right.against)) == (1, 3)
