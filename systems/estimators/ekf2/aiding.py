"""Which sources aid the filter now, and the estimators of their biases.

A source that is not the reference of its axis gets a one-state filter for its
bias: a random walk, observed by measurement − state, gated at 3 sigma. If the
innovations keep one sign, its noise is multiplied until they do not.
"""

from systems.estimators.ekf2 import layout as at
from systems.estimators.ekf2.compiled import kernel
from systems.estimators.ekf2.geometry import FLOAT_EPSILON, limit, sign

_BIAS_GATE = 3.0
_BIAS_TAU = 10.0  # s, of the monitor of the innovations
_BIAS_BOOST = 1e3
_BIAS_OFFSET_RATIO = 0.2


@kernel
def horizontal_position_sources(x):
    """How many sources aid the horizontal position."""
    return x[at.GNSS_POS] + x[at.EV_POS]


@kernel
def horizontal_velocity_sources(x):
    """How many sources aid the horizontal velocity."""
    return x[at.GNSS_VEL] + x[at.EV_VEL]


@kernel
def horizontal_sources(x):
    """How many sources aid the horizontal state."""
    return horizontal_position_sources(x) + horizontal_velocity_sources(x)


@kernel
def height_sources(x):
    """How many sources aid the vertical position."""
    return x[at.GPS_HGT] + x[at.BARO_HGT] + x[at.RNG_HGT] + x[at.EV_HGT]


@kernel
def vertical_velocity_sources(x):
    """How many sources aid the vertical velocity."""
    return x[at.GNSS_VEL] + x[at.EV_VEL]


@kernel
def north_east_aiding(x):
    """Whether a source with a known north aids the filter, so that heading is observable."""
    return bool(
        x[at.GNSS_POS]
        or x[at.GNSS_VEL]
        or (x[at.EV_POS] and x[at.EV_PREVIOUS_POSITION_FRAME] == at.FRAME_NED)
        or (x[at.EV_VEL] and x[at.EV_PREVIOUS_VELOCITY_FRAME] == at.FRAME_NED)
    )


@kernel
def reset_bias(x, bias):
    """Start a bias estimator from a bias of zero that is certain."""
    x[bias + at.B_BIAS] = 0.0
    x[bias + at.B_VARIANCE] = 0.0
    x[bias + at.B_LPF] = 0.0
    x[bias + at.B_SINCE_NEGATIVE] = 0.0
    x[bias + at.B_SINCE_POSITIVE] = 0.0


@kernel
def _constrain_bias(x, bias):
    x[bias + at.B_VARIANCE] = limit(x[bias + at.B_VARIANCE], 1e-8, x[bias + at.B_MAXIMUM])


@kernel
def predict_bias(x, bias, dt):
    """Let the variance of a bias grow over a step (s)."""
    growth = x[bias + at.B_DENSITY] * dt
    if (
        abs(x[bias + at.B_LPF]) > _BIAS_OFFSET_RATIO
        or x[bias + at.B_SINCE_POSITIVE] > _BIAS_TAU
        or x[bias + at.B_SINCE_NEGATIVE] > _BIAS_TAU
    ):
        growth *= _BIAS_BOOST
    x[bias + at.B_VARIANCE] += growth
    _constrain_bias(x, bias)
    if dt > FLOAT_EPSILON and abs(x[bias + at.B_DT] - dt) > 0.001:
        x[bias + at.B_ALPHA] = dt / (_BIAS_TAU + dt)
        x[bias + at.B_DT] = dt


@kernel
def fuse_bias(x, bias, measurement, variance, noise_density, noise):
    """Fuse an observation of a bias.

    Parameters
    ----------
    bias : int
        Where the estimator stands.
    measurement, variance : float
        Measurement of the sensor minus the filter's state, and its variance.
    noise_density, noise : float
        The random walk of the bias (m/s/√Hz) and the largest sigma (m) it may reach.
    """
    x[bias + at.B_MAXIMUM] = max(1e-4, noise * noise)
    x[bias + at.B_DENSITY] = noise_density * noise_density
    innovation_variance = x[bias + at.B_VARIANCE] + max(1e-4, variance)
    innovation = measurement - x[bias + at.B_BIAS]
    ratio = innovation * innovation / (_BIAS_GATE * _BIAS_GATE * innovation_variance)
    if ratio < 1.0:
        gain = x[bias + at.B_VARIANCE] / innovation_variance
        x[bias + at.B_BIAS] += gain * innovation
        x[bias + at.B_VARIANCE] -= gain * x[bias + at.B_VARIANCE]
        _constrain_bias(x, bias)
    x[bias + at.B_REPORTED] = x[bias + at.B_BIAS]
    signed = limit(sign(innovation) * ratio, -1.0, 1.0)
    x[bias + at.B_LPF] += x[bias + at.B_ALPHA] * (signed - x[bias + at.B_LPF])
    if innovation > 0.0:
        x[bias + at.B_SINCE_POSITIVE] = 0.0
        x[bias + at.B_SINCE_NEGATIVE] += x[bias + at.B_DT]
    else:
        x[bias + at.B_SINCE_NEGATIVE] = 0.0
        x[bias + at.B_SINCE_POSITIVE] += x[bias + at.B_DT]


@kernel
def predict_height_bias(x, bias, source):
    """Let the bias of a height source grow while it is fused and not the reference."""
    if x[at.HEIGHT_REFERENCE] != source and x[bias + at.B_ACTIVE]:
        predict_bias(x, bias, x[at.DT_AVERAGE])


@kernel
def fuse_height_bias(x, bias, source, measurement, variance, noise_density, noise):
    """As `fuse_bias`, while the height source is fused and not the reference."""
    if x[at.HEIGHT_REFERENCE] != source and x[bias + at.B_ACTIVE]:
        fuse_bias(x, bias, measurement, variance, noise_density, noise)
    else:
        x[bias + at.B_MAXIMUM] = max(1e-4, noise * noise)
        x[bias + at.B_DENSITY] = noise_density * noise_density
