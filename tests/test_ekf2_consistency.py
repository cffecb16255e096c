"""EKF2 knows its own errors, if the sensors are as its parameters say: 16 simulated flights."""

import numpy as np
import pytest
from scipy.stats import chi2

from benchmarks.ekf2_consistency import GROUPS, SOURCES, fly
from runs.simulated_log import MATCHED

SEEDS = 16
# The means over time are tested, whose errors are correlated over seconds: this many flights'
# worth of independent values a flight, few enough to be on the safe side (flights last 40 s
# after alignment; velocities forget in a few seconds, biases hardly at all).
INDEPENDENT = {"velocity": 4, "position": 4}
QUANTILES = (0.0005, 0.9995)  # seven tests, so that one in 150 sound filters fails


@pytest.fixture(scope="module")
def flights():
    return [fly(MATCHED, seed) for seed in range(SEEDS)]


@pytest.mark.parametrize("group", GROUPS)
def test_estimation_errors_are_as_large_as_their_covariance(flights, group):
    column = list(GROUPS).index(group)
    states = GROUPS[group].stop - GROUPS[group].start
    mean = np.mean([flight.nees[:, column] for flight in flights])
    samples = states * SEEDS * INDEPENDENT.get(group, 1)
    low, high = chi2.ppf(QUANTILES, samples) / samples
    assert low < mean / states < high


@pytest.mark.parametrize("source", SOURCES)
def test_innovations_are_as_large_as_their_variance(flights, source):
    total, count = np.sum([flight.nis[SOURCES.index(source)] for flight in flights], axis=0)
    low, high = chi2.ppf(QUANTILES, count) / count
    assert count > 1000
    # over 200 flights the variances are right to 1.5 %, see docs/ekf2.md
    assert low - 0.03 < total / count < high + 0.03
