"""The wind at a point, compiled: steady wind with shear, Dryden turbulence, scheduled gusts.

All from MIL-F-8785C (1980), sections 3.7.2 to 3.7.3, low-altitude model, with h
the height (ft, 10 to 1000), V the airspeed and W20 the wind speed at 20 ft:

    L_w = h,    L_u = L_v = h / (0.177 + 0.000823 h)^1.2            scale lengths
    σ_w = 0.1 W20,    σ_u = σ_v = σ_w / (0.177 + 0.000823 h)^0.4    intensities
    Φ_u(Ω) = σ_u² (2 L_u/π) / (1 + (L_u Ω)²)
    Φ_v(Ω) = σ_v² (L_v/π) (1 + 3 (L_v Ω)²) / (1 + (L_v Ω)²)²        and Φ_w alike

With τ = L/V these are the outputs of linear systems driven by white noise ν of
unit intensity,

    u/σ = x,                      ẋ  = −x/τ + √(2/τ) ν
    v/σ = √3 x₁ + (1 − √3) x₂,    ẋ₁ = −x₁/τ + ν/√τ,   ẋ₂ = (x₁ − x₂)/τ

which are stepped exactly for constant τ: with a = Δt/τ,

    x ← e^−a x + √(1 − e^−2a) n
    (x₁, x₂) ← e^−a (x₁, x₂ + a x₁) + chol(Q) n,    Q = ∫₀ᵃ e^−2s [[1, s], [s, s²]] ds

The states have unit scale, so a change of height or speed changes neither
their past nor their distribution. u is along the steady wind, w up.
"""

import math

import numpy as np
from numba import njit

from systems.signals.noise import standard_normals

REFERENCE_HEIGHT = 6.096  # m, 20 ft
_FOOT = 0.3048  # m
_LOWEST = 10.0  # ft, limits of the low-altitude model
_HIGHEST = 1000.0  # ft
_SLOWEST = 0.1  # m/s, airspeed below which the turbulence stands still anyway

# The layout of the parameter vector: scalars, then start, duration and vector of each gust.
(
    STEADY_SPEED,  # m/s at the reference height
    DIRECTION,  # rad, where the wind blows to
    SHEAR,  # 0 none, 1 power law, 2 logarithmic
    EXPONENT,  # 1, of the power law
    ROUGHNESS,  # m, of the logarithmic law
    TURBULENCE_SPEED,  # m/s, W20 of the turbulence
    GUSTS,  # number of scheduled gusts
    FIRST_GUST,
) = range(8)
GUST_SIZE = 5
# The layout of the state: x of u, x₁ and x₂ of v and of w, the number of samples drawn.
STATE_SIZE = 6


@njit(cache=True)
def scales(height):
    """Scale lengths (m) L_u = L_v and L_w, and σ_u = σ_v as a multiple of σ_w, at a height (m)."""
    h = min(max(height / _FOOT, _LOWEST), _HIGHEST)
    base = 0.177 + 0.000823 * h
    return h / base**1.2 * _FOOT, h * _FOOT, base**-0.4


@njit(cache=True)
def steady_speed(height, parameters):
    """The speed of the steady wind at a height (m), m/s."""
    p = parameters
    if p[SHEAR] == 1.0:
        return p[STEADY_SPEED] * (max(height, 0.0) / REFERENCE_HEIGHT) ** p[EXPONENT]
    if p[SHEAR] == 2.0:
        z0 = p[ROUGHNESS]
        return p[STEADY_SPEED] * math.log(max(height, z0) / z0) / math.log(REFERENCE_HEIGHT / z0)
    return p[STEADY_SPEED]


@njit(cache=True)
def second_order_noise(a):
    """The lower Cholesky factor of Q(a): l11, l21, l22."""
    if a < 1e-2:  # the closed forms cancel; these series are exact to 1e-11
        q11 = a * (1.0 - a * (1.0 - a * (2.0 / 3.0 - a / 3.0)))
        q12 = a * a * (0.5 - a * (2.0 / 3.0 - a * (0.5 - a * 4.0 / 15.0)))
        q22 = a**3 * (1.0 / 3.0 - a * (0.5 - a * (0.4 - a * 2.0 / 9.0)))
    else:
        e = math.exp(-2.0 * a)
        q11 = 0.5 * (1.0 - e)
        q12 = 0.25 * (1.0 - (1.0 + 2.0 * a) * e) if e > 0.0 else 0.25
        q22 = 0.25 * (1.0 - (1.0 + 2.0 * a + 2.0 * a * a) * e) if e > 0.0 else 0.25
    l11 = math.sqrt(q11)
    l21 = q12 / l11
    return l11, l21, math.sqrt(max(q22 - l21 * l21, 0.0))


@njit(cache=True)
def advance_turbulence(state, a_u, a_w, noise):
    """Step the five turbulence states by a_u (of u and v) and a_w time constants, in place."""
    decay = math.exp(-a_u)
    state[0] = decay * state[0] + math.sqrt(-math.expm1(-2.0 * a_u)) * noise[0]
    l11, l21, l22 = second_order_noise(a_u)
    carry = decay * a_u if decay > 0.0 else 0.0
    state[2] = decay * state[2] + carry * state[1] + l21 * noise[1] + l22 * noise[2]
    state[1] = decay * state[1] + l11 * noise[1]
    decay = math.exp(-a_w)
    l11, l21, l22 = second_order_noise(a_w)
    carry = decay * a_w if decay > 0.0 else 0.0
    state[4] = decay * state[4] + carry * state[3] + l21 * noise[3] + l22 * noise[4]
    state[3] = decay * state[3] + l11 * noise[3]


@njit(cache=True)
def update(wind, state, height, v_WB, time, period, key, parameters):
    """Step the wind to `time`: writes `wind` (3,) in W and `state` (6,).

    Parameters
    ----------
    height : float
        Of the vehicle over the ground, m.
    v_WB : (3,) array
        Velocity of the vehicle, m/s in W.
    time : float
        The time that the wind is for, s.
    period : float
        Since the last step, s. The first step draws the turbulence from its
        stationary distribution.
    key : np.uint64
        The stream of noise.
    parameters : array
        From `WindConfig.parameters`.
    """
    p = parameters
    c, s = math.cos(p[DIRECTION]), math.sin(p[DIRECTION])
    speed = steady_speed(height, p)
    along = speed
    across = 0.0
    up = 0.0
    if p[TURBULENCE_SPEED] > 0.0:
        length_u, length_w, ratio = scales(height)
        vx, vy, vz = v_WB[0] - speed * c, v_WB[1] - speed * s, v_WB[2]
        airspeed = max(math.sqrt(vx * vx + vy * vy + vz * vz), _SLOWEST)
        first = state[5] == 0.0
        a_u = np.inf if first else period * airspeed / length_u
        a_w = np.inf if first else period * airspeed / length_w
        advance_turbulence(state, a_u, a_w, standard_normals(key, int(state[5]), 5))
        sigma_w = 0.1 * p[TURBULENCE_SPEED]
        sigma_u = sigma_w * ratio
        root3 = math.sqrt(3.0)
        along += sigma_u * state[0]
        across = sigma_u * (root3 * state[1] + (1.0 - root3) * state[2])
        up = sigma_w * (root3 * state[3] + (1.0 - root3) * state[4])
    state[5] += 1.0
    wind[0] = c * along - s * across
    wind[1] = s * along + c * across
    wind[2] = up
    for i in range(int(p[GUSTS])):
        k = FIRST_GUST + GUST_SIZE * i
        phase = (time - p[k]) / p[k + 1]
        if 0.0 < phase < 1.0:
            share = 0.5 * (1.0 - math.cos(2.0 * math.pi * phase))
            for j in range(3):
                wind[j] += share * p[k + 2 + j]
