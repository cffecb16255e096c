import math
from collections import Counter

import numpy as np
import pytest
from pydantic import TypeAdapter, ValidationError
from scipy import stats

from studies.sampling import Distribution, hashed, hashed_uniform

DRAWS = [hashed_uniform("sampling", index) for index in range(4000)]


def law(**fields):
    return TypeAdapter(Distribution).validate_python(fields)


def draw(**fields) -> list:
    distribution = law(**fields)
    return [distribution.quantile(u) for u in DRAWS]


def test_hashed_draws_are_uniform_and_uncorrelated():
    assert stats.kstest(DRAWS, "uniform").pvalue > 0.01
    assert abs(stats.pearsonr(DRAWS[:-1], DRAWS[1:]).statistic) < 3.0 / math.sqrt(len(DRAWS))


def test_hashing_is_the_same_for_ever():
    assert hashed("study", 7) == 3424377910511067
    assert 0 <= hashed("study", 7) < 2**53


@pytest.mark.parametrize(
    ("fields", "reference"),
    [
        ({"kind": "uniform", "low": -2, "high": 6}, stats.uniform(-2, 8)),
        ({"kind": "normal", "mean": 3, "sigma": 0.5}, stats.norm(3, 0.5)),
        (
            {"kind": "normal", "mean": 0, "sigma": 2, "low": -1, "high": 3},
            stats.truncnorm(-0.5, 1.5, 0, 2),
        ),
        ({"kind": "log_uniform", "low": 0.01, "high": 10}, stats.loguniform(0.01, 10)),
    ],
)
def test_continuous_laws_have_scipys_quantiles(fields, reference):
    values = draw(**fields)
    np.testing.assert_allclose(values, reference.ppf(DRAWS), rtol=1e-9, atol=1e-12)


def test_integers_and_choices_come_as_often_as_they_should():
    counts = Counter(draw(kind="uniform_integer", low=2, high=5))
    assert sorted(counts) == [2, 3, 4, 5]
    assert stats.chisquare(list(counts.values())).pvalue > 0.01
    counts = Counter(draw(kind="choice", values=["a", "b", "c"], weights=[1, 0, 3]))
    assert set(counts) == {"a", "c"}
    assert stats.binomtest(counts["c"], len(DRAWS), 0.75).pvalue > 0.01
    assert law(kind="choice", values=[[0, 1], [2, 3]]).quantile(0.9) == [2, 3]


@pytest.mark.parametrize(
    ("fields", "expected"),
    [
        ({"kind": "normal", "mean": 0, "sigma": 0}, "greater than 0"),
        ({"kind": "normal", "mean": 0, "sigma": 1, "low": 100}, "leave nothing"),
        ({"kind": "log_uniform", "low": 0, "high": 1}, "greater than 0"),
        ({"kind": "choice", "values": []}, "at least 1 item"),
        ({"kind": "choice", "values": [1], "weights": [1, 2]}, "one weight for each"),
        ({"kind": "choice", "values": [1], "weights": [0]}, "weight above 0"),
        ({"kind": "uniform", "low": math.nan, "high": 1}, "finite"),
    ],
)
def test_a_law_without_meaning_is_refused(fields, expected):
    with pytest.raises(ValidationError, match=expected):
        law(**fields)
