"""Equations of motion of the fixed wing: the thesis's coarse model and a better one.

Pure functions of flat arrays; `plants.fixed_wing` is the system around them.
Vectors are in the NED frame of the touch-down point, angles in rad.

Coarse (Leonard 2016, 3.3 and appendix A): constant ground speed, roll and
vertical speed as commanded, equilibrium on the pitch axis,

    V_Z = V_Z^cmd,  φ = φ^cmd,  ψ′ = g/V tan φ,  θ = A/V² − B + arctan(−V_Z/V)

(the printed ψ(k) = ψ(k) + … tan θ … means ψ(k − 1) and the roll φ; the printed
tan(−V_Z/V) is an arctan: it is an angle).

Lagged (what sections 6.4 and 7 ask for): second-order roll and pitch, path
following the pitch with the wing's lag, airspeed held by the throttle, steady
wind and turbulence,

    φ″ = ω_φ² (φ^cmd − φ) − 2 ζ_φ ω_φ φ′ + ω_φ² k_φ v_g/V
    θ″ = ω_θ² (θ^cmd − θ) − 2 ζ_θ ω_θ θ′ + ω_θ² k_θ w_g/V
    θ^cmd = γ^cmd + α(V) + (γ^cmd − γ),   sin γ^cmd = −V_Z^cmd/V,   α(V) = A/V² − B
    γ′ = (θ − α(V) − γ − w_g/V)/τ_γ,   V′ = (V^cmd − V)/τ_V,   ψ′ = g/V tan φ
    v = V (cos γ cos ψ, cos γ sin ψ, −sin γ) + wind + (u, v, 0),   u′ = (u_g − u)/τ_g

Gusts are first-order Gauss–Markov processes with the intensities and lengths
of MIL-F-8785C's low-altitude Dryden model (3.7.3.4): σ_w = 0.1 W₂₀,
σ_u = σ_v = σ_w/(0.177 + 0.000823 h)^0.4, L_w = h, L_u = L_v =
h/(0.177 + 0.000823 h)^1.2, with h in feet; they act in the air mass's axes
turned to the aircraft's heading. A gust along or across does not carry the
aircraft away at once but with the lag τ_g of its drag and side force.

On the ground both roll without slip along their heading, slowed by the brakes
and steered by the nose wheel.
"""

import math

import numpy as np
from numba import njit

from plants.terrain import elevation_at
from systems.runway_frames import GRAVITY
from systems.signals.noise import standard_normals

# entries of the parameter vector
(
    LAGGED,  # 0 coarse, 1 lagged
    SPEED,  # m/s, ground speed (coarse) or airspeed (lagged)
    PITCH_A,  # rad m2/s2
    PITCH_B,  # rad
    GEAR,  # m, from the wheels to the body origin
    ROLL_FREQUENCY,  # rad/s
    ROLL_DAMPING,  # 1
    PITCH_FREQUENCY,  # rad/s
    PITCH_DAMPING,  # 1
    PATH_LAG,  # s
    SPEED_LAG,  # s
    ROLL_GUST,  # 1, roll for a side gust of one airspeed
    PITCH_GUST,  # 1, pitch for a vertical gust of one airspeed
    STEERING_LAG,  # s
    ROLLING,  # m/s2, deceleration of rolling friction
    WIND_N,  # m/s
    WIND_E,  # m/s
    WIND_20,  # m/s, wind at 20 ft of the turbulence's intensity, 0 none
) = range(18)
PARAMETERS = 18

# entries of the memory: what is no output
GUST_U, GUST_V, GUST_W, DRIFT_U, DRIFT_V, PATH_ANGLE, TOUCHDOWN_SINK, SAMPLES = range(8)
MEMORY = 8

_FEET = 0.3048  # m
_GUST_LAG = 3.0  # s, τ_g, m/(ρ V S C_Yβ) of a glider's side force


@njit(cache=True)
def equilibrium_pitch(speed, vertical_speed, pitch_a, pitch_b):
    """Pitch at equilibrium, appendix A (rad); `vertical_speed` positive down (m/s)."""
    return pitch_a / (speed * speed) - pitch_b + math.atan(-vertical_speed / speed)


@njit(cache=True)
def turbulence(height, wind_20):
    """σ_u, σ_w (m/s) and L_u, L_w (m) of MIL-F-8785C at a height (m) below 1000 ft."""
    h = min(max(height / _FEET, 10.0), 1000.0)
    sigma_w = 0.1 * wind_20
    shape = 0.177 + 0.000823 * h
    return sigma_w / shape**0.4, sigma_w, h / shape**1.2 * _FEET, h * _FEET


@njit(cache=True)
def _gust(memory, height, airspeed, wind_20, dt, key):
    sigma_u, sigma_w, length_u, length_w = turbulence(height, wind_20)
    normals = standard_normals(key, int(memory[SAMPLES]), 3)
    decay_u = math.exp(-airspeed * dt / length_u)
    decay_w = math.exp(-airspeed * dt / length_w)
    spread_u = sigma_u * math.sqrt(1.0 - decay_u * decay_u)
    memory[GUST_U] = decay_u * memory[GUST_U] + spread_u * normals[0]
    memory[GUST_V] = decay_u * memory[GUST_V] + spread_u * normals[1]
    memory[GUST_W] = (
        decay_w * memory[GUST_W] + sigma_w * math.sqrt(1.0 - decay_w * decay_w) * normals[2]
    )
    memory[SAMPLES] += 1.0


@njit(cache=True)
def _fly_coarse(state, command, parameters, dt):
    V = parameters[SPEED]
    state[11] = (command[0] - state[8]) / dt
    state[8] = command[0]
    state[9] = GRAVITY / V * math.tan(state[8])
    state[6] += state[9] * dt
    state[3] = V * math.cos(state[6])
    state[4] = V * math.sin(state[6])
    state[5] = command[1]
    pitch = equilibrium_pitch(V, state[5], parameters[PITCH_A], parameters[PITCH_B])
    state[10] = (pitch - state[7]) / dt
    state[7] = pitch
    state[12] = V
    state[0] += state[3] * dt
    state[1] += state[4] * dt
    state[2] += state[5] * dt


@njit(cache=True)
def _fly_lagged(state, memory, command, parameters, dt, key):
    V = state[12]
    if parameters[WIND_20] > 0.0:
        _gust(memory, state[13], V, parameters[WIND_20], dt, key)
        memory[DRIFT_U] += (memory[GUST_U] - memory[DRIFT_U]) / _GUST_LAG * dt
        memory[DRIFT_V] += (memory[GUST_V] - memory[DRIFT_V]) / _GUST_LAG * dt
    gust_angle = memory[GUST_W] / V
    w = parameters[ROLL_FREQUENCY]
    acceleration = (
        w * w * (command[0] - state[8] + parameters[ROLL_GUST] * memory[GUST_V] / V)
        - 2.0 * parameters[ROLL_DAMPING] * w * state[11]
    )
    state[11] += acceleration * dt
    state[8] += state[11] * dt

    alpha = parameters[PITCH_A] / (V * V) - parameters[PITCH_B]
    path = memory[PATH_ANGLE]
    path_command = math.asin(min(max(-command[1] / V, -0.3), 0.3))
    pitch_command = 2.0 * path_command - path + alpha
    w = parameters[PITCH_FREQUENCY]
    acceleration = (
        w * w * (pitch_command - state[7] + parameters[PITCH_GUST] * gust_angle)
        - 2.0 * parameters[PITCH_DAMPING] * w * state[10]
    )
    state[10] += acceleration * dt
    state[7] += state[10] * dt
    path += (state[7] - alpha - path - gust_angle) / parameters[PATH_LAG] * dt
    memory[PATH_ANGLE] = path

    state[12] += (parameters[SPEED] - V) / parameters[SPEED_LAG] * dt
    state[9] = GRAVITY / V * math.tan(state[8])
    state[6] += state[9] * dt
    V = state[12]
    c, s = math.cos(state[6]), math.sin(state[6])
    u, v = V * math.cos(path) + memory[DRIFT_U], memory[DRIFT_V]
    state[3] = u * c - v * s + parameters[WIND_N]
    state[4] = u * s + v * c + parameters[WIND_E]
    state[5] = -V * math.sin(path)
    state[0] += state[3] * dt
    state[1] += state[4] * dt
    state[2] += state[5] * dt


@njit(cache=True)
def _roll_on_ground(state, command, parameters, elevation, dt):
    speed = math.hypot(state[3], state[4])
    if speed > 0.0:
        speed = max(speed - (max(command[2], 0.0) + parameters[ROLLING]) * dt, 0.0)
    lag = math.exp(-dt / parameters[STEERING_LAG])
    wanted = command[3] if speed > 0.5 else 0.0
    state[9] = lag * state[9] + (1.0 - lag) * wanted
    state[6] += state[9] * dt
    level = math.exp(-dt / 0.5)  # the gear levels the wings and lowers the nose in half a second
    state[7] *= level
    state[8] *= level
    state[10] = 0.0
    state[11] = 0.0
    state[3] = speed * math.cos(state[6])
    state[4] = speed * math.sin(state[6])
    state[5] = 0.0
    state[12] = math.hypot(state[3] - parameters[WIND_N], state[4] - parameters[WIND_E])
    state[0] += state[3] * dt
    state[1] += state[4] * dt
    state[2] = -(elevation + parameters[GEAR])


@njit(cache=True)
def advance(state, memory, command, parameters, terrain, geometry, key, dt):
    """Move the aircraft by one step, in place.

    Parameters
    ----------
    state : array, shape (15,)
        Layout `FIXED_WING_STATE`.
    memory : array, shape (MEMORY,)
        Gusts, path angle, sink rate at touchdown, samples drawn.
    command : array, shape (4,)
        Layout `FIXED_WING_COMMAND`.
    parameters : array, shape (PARAMETERS,)
    terrain, geometry : arrays
        Of a `TerrainGrid`.
    key : np.uint64
        Of the turbulence's noise stream.
    dt : float
        s.
    """
    if state[14] > 0.0:
        elevation = elevation_at(terrain, geometry, state[0], state[1])
        _roll_on_ground(state, command, parameters, elevation, dt)
    elif parameters[LAGGED] > 0.0:
        _fly_lagged(state, memory, command, parameters, dt, key)
    else:
        _fly_coarse(state, command, parameters, dt)
    state[13] = -state[2] - elevation_at(terrain, geometry, state[0], state[1])
    if state[14] == 0.0 and state[13] <= parameters[GEAR]:
        state[14] = 1.0
        memory[TOUCHDOWN_SINK] = state[5]
        state[2] -= parameters[GEAR] - state[13]
        state[13] = parameters[GEAR]


@njit(cache=True)
def trimmed_state(p_n, yaw, vertical_speed, parameters, terrain, geometry):
    """An aircraft at equilibrium on a straight path: its state and memory.

    Parameters
    ----------
    p_n : array, shape (3,)
        m.
    yaw : float
        Heading of the ground track, rad; with wind the nose turns into it.
    vertical_speed : float
        m/s, positive down.
    parameters, terrain, geometry : arrays
        As in `advance`.

    Returns
    -------
    tuple of arrays, shapes (15,) and (MEMORY,)
    """
    state, memory = np.zeros(15), np.zeros(MEMORY)
    V = parameters[SPEED]
    lagged = parameters[LAGGED] > 0.0
    crab = 0.0
    if lagged:
        across = -math.sin(yaw) * parameters[WIND_N] + math.cos(yaw) * parameters[WIND_E]
        crab = -math.asin(min(max(across / V, -0.9), 0.9))
    state[:3] = p_n
    state[6] = yaw + crab
    if lagged:
        path = math.asin(-vertical_speed / V)
        memory[PATH_ANGLE] = path
        state[7] = path + parameters[PITCH_A] / (V * V) - parameters[PITCH_B]
        state[3] = V * math.cos(path) * math.cos(state[6]) + parameters[WIND_N]
        state[4] = V * math.cos(path) * math.sin(state[6]) + parameters[WIND_E]
    else:
        state[7] = equilibrium_pitch(V, vertical_speed, parameters[PITCH_A], parameters[PITCH_B])
        state[3] = V * math.cos(state[6])
        state[4] = V * math.sin(state[6])
    state[5] = vertical_speed
    state[12] = V
    state[13] = -p_n[2] - elevation_at(terrain, geometry, p_n[0], p_n[1])
    return state, memory
