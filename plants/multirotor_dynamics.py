"""The equations of motion of a multirotor, compiled: no Drake in here.

The state is a flat vector of 13 + N numbers, `q_WB` (4), `p_WB`, `v_WB`,
`w_WB_B` (3 each) and the N rotor speeds (rad/s). The vehicle is a flat vector
of parameters that `plants.vehicles.Vehicle.parameters` packs.

With R = R_WB, the velocity relative to the air u = Rᵀ(v_WB − wind), at rotor i
u_i = u + w × r_i, its speed Ω_i and spin s_i (+1 counter-clockwise from above):

    Ω̇_i   = (Ω_max √c_i − Ω_i) / τ                          rotor lag, command c_i in [0, 1]
    T_i   = k_f Ω_i² G_i − k_z Ω_i u_i,z                     thrust along z_B
    H_i   = −k_d Ω_i (u_i,x, u_i,y, 0)                       rotor drag, at the hub
    M_i   = −s_i k_m Ω_i² z_B                                drag torque
    D     = −½ ρ |u| diag(A) u                               parasitic drag, A = C_d · area
    F_j   = N_j z_W − μ N_j t_j / √(|t_j|² + v_s²)           contact at point j
    N_j   = k δ_j max(0, 1 + d δ̇_j)                          no suction
    q̇     = ½ q ⊗ (0, w)
    v̇     = (R (Σ T_i z_B + H_i + D) + Σ F_j) / m − g z_W
    I ẇ   = Σ r_i × (T_i z_B + H_i) + M_i + Σ r_j × Rᵀ F_j − w × I w

τ is one time constant for speeding up and another for slowing down. G_i is the
ground effect of Cheeseman and Bennett, "The effect of the ground on a
helicopter rotor in forward flight", ARC R&M 3021 (1955), for a rotor of radius
r at height z above the surface, moving at V in its plane, with the induced
velocity v_i² = k_f Ω² / (2 ρ π r²):

    G = 1 / (1 − κ (r / 4z)² / (1 + (V / v_i)²)),       z no less than r/2,

where κ = 1 is their rotor; for whole multirotors κ up to 8.6 has been fitted
(Danjun et al., "Autonomous landing of quadrotor based on ground effect
modelling", Chinese Control Conference 2015).

Rotor drag as in Martin and Salaün, "The true role of accelerometer feedback in
quadrotor control", ICRA 2010; the axial term k_z is the linear loss of thrust
with the advance ratio (Svacha, Mohta, Kumar, "Improving quadrotor trajectory
tracking by compensating for aerodynamic effects", ICUAS 2017). Contact is Hunt
and Crossley's, "Coefficient of restitution interpreted as damping in
vibroimpact" (1975), friction a regularised Coulomb law: standing on a slope
or in wind, the legs creep at v_s times the share of the friction limit in use.
Blade flapping moments, rotor inertia and the battery are not modelled. A vehicle that
stands still on a pad at rest, with stopped rotors, sleeps: static friction holds it.

Contact points stand on the pad where they are inside its square, elsewhere on
the ground at z = 0.
"""

import math

import numpy as np
from numba import njit

from systems.schedule import PLANT_PERIOD

# The layout of the parameter vector: scalars, then 4 numbers a rotor, 3 a contact point.
(
    ROTORS,  # 1, N
    CONTACTS,  # 1, number of contact points
    MASS,  # kg
    INERTIA_X,  # kg m2, principal moments about the axes of B
    INERTIA_Y,
    INERTIA_Z,
    GRAVITY,  # m/s2
    AIR_DENSITY,  # kg/m3
    THRUST_COEFFICIENT,  # N s2/rad2, k_f
    TORQUE_COEFFICIENT,  # N m s2/rad2, k_m
    ROTOR_DRAG,  # N s2/(rad m), k_d
    AXIAL_DRAG,  # N s2/(rad m), k_z
    TIME_CONSTANT_UP,  # s
    TIME_CONSTANT_DOWN,  # s
    MAXIMUM_SPEED,  # rad/s
    ROTOR_RADIUS,  # m
    GROUND_EFFECT,  # 1, κ
    DRAG_AREA_X,  # m2, C_d times area
    DRAG_AREA_Y,
    DRAG_AREA_Z,
    STIFFNESS,  # N/m a contact point
    DISSIPATION,  # s/m
    FRICTION,  # 1
    SLIP_SPEED,  # m/s, v_s
    FIRST_ROTOR,  # from here on x, y, z (m, in B) and spin (±1) of each rotor, then the contacts
) = range(25)

BODY_SIZE = 13  # q_WB, p_WB, v_WB, w_WB_B
STEP = PLANT_PERIOD  # s, 10 ms, the step that `step` makes
# RK4's stability limit is 2.78/h. In flight the fastest rate is the rotors' (80 1/s). In contact it
# is friction's, μ N / (v_s m) with the legs' lever arms: some 3 000 1/s at rest and several times
# that in a hard touchdown, so h = 0.25 ms (limit 11 000 1/s).
FLIGHT_SUBSTEPS = 2
CONTACT_SUBSTEPS = 32
_NEAR = 0.01  # m, legs closer to a surface than this plus two steps of travel count as in contact
# Slower than this, with stopped rotors on a pad at rest and its weight on its legs, it sleeps.
_REST_SPEED = 1e-3  # m/s and rad/s
_STOPPED = 1.0  # rad/s, of a rotor
_WEIGHT_TOLERANCE = 0.01  # 1
AIRSPEED_SOFTENING = 1e-12  # (m/s)2, keeps |u| differentiable at rest


@njit(cache=True, error_model="numpy", inline="always")
def _surface_height(dx, dy, cosine, sine, half, height):
    """The height of the surface at (dx, dy) from the pad's centre, and whether that is the pad."""
    if abs(cosine * dx + sine * dy) < half and abs(cosine * dy - sine * dx) < half:
        return height, True
    return 0.0, False


@njit(cache=True, error_model="numpy")
def derivatives(x, commands, wind, pad, time, contact, parameters, dx):
    """The time derivative of the state, its specific force and its contact force.

    Parameters
    ----------
    x : (>= 13 + N,) array
        The state; entries after the first 13 + N are not read.
    commands : (N,) array
        Normalised thrust of each rotor, clipped to 0..1 (NaN is 0).
    wind : (3,) array
        Velocity of the air, m/s in W.
    pad : (9,) array
        `PAD_STATE`, where it was `time` seconds ago.
    time : float
        Since the step began, s.
    contact : bool
        Whether contact forces are looked for.
    parameters : array
        From `Vehicle.parameters`.
    dx : (17 + N,) array
        Written: the derivative of the state, then the specific force in B
        (m/s2, three numbers) and the sum of the normal forces (N).
    """
    p = parameters
    n = int(p[ROTORS])
    qw, qx, qy, qz = x[0], x[1], x[2], x[3]
    wx, wy, wz = x[10], x[11], x[12]

    # From the pad's centre as it is now; beside its square (none without a pad) is the ground.
    half = 0.5 * pad[8]
    from_pad_x = x[4] - (pad[0] + time * pad[4])
    from_pad_y = x[5] - (pad[1] + time * pad[5])
    pad_height = pad[2] + time * pad[6]
    cosine, sine = 1.0, 0.0
    if half > 0.0:
        yaw = pad[3] + time * pad[7]
        cosine, sine = math.cos(yaw), math.sin(yaw)

    r00 = 1.0 - 2.0 * (qy * qy + qz * qz)
    r01 = 2.0 * (qx * qy - qw * qz)
    r02 = 2.0 * (qx * qz + qw * qy)
    r10 = 2.0 * (qx * qy + qw * qz)
    r11 = 1.0 - 2.0 * (qx * qx + qz * qz)
    r12 = 2.0 * (qy * qz - qw * qx)
    r20 = 2.0 * (qx * qz - qw * qy)
    r21 = 2.0 * (qy * qz + qw * qx)
    r22 = 1.0 - 2.0 * (qx * qx + qy * qy)

    # Velocity relative to the air, in B, and the parasitic drag.
    ax, ay, az = x[7] - wind[0], x[8] - wind[1], x[9] - wind[2]
    ux = r00 * ax + r10 * ay + r20 * az
    uy = r01 * ax + r11 * ay + r21 * az
    uz = r02 * ax + r12 * ay + r22 * az
    density = p[AIR_DENSITY]
    drag = -0.5 * density * math.sqrt(ux * ux + uy * uy + uz * uz + AIRSPEED_SOFTENING)
    fx = drag * p[DRAG_AREA_X] * ux
    fy = drag * p[DRAG_AREA_Y] * uy
    fz = drag * p[DRAG_AREA_Z] * uz
    mx = my = mz = 0.0

    radius = p[ROTOR_RADIUS]
    ground_effect = p[GROUND_EFFECT]
    disc = 2.0 * density * math.pi * radius * radius
    for i in range(n):
        k = FIRST_ROTOR + 4 * i
        rx, ry, rz, spin = p[k], p[k + 1], p[k + 2], p[k + 3]
        speed = x[BODY_SIZE + i]
        command = commands[i]
        if not command > 0.0:
            command = 0.0
        elif command > 1.0:
            command = 1.0
        error = p[MAXIMUM_SPEED] * math.sqrt(command) - speed
        lag = p[TIME_CONSTANT_UP] if error > 0.0 else p[TIME_CONSTANT_DOWN]
        dx[BODY_SIZE + i] = error / lag
        if speed == 0.0:  # no thrust, no drag
            continue

        vx = ux + wy * rz - wz * ry
        vy = uy + wz * rx - wx * rz
        vz = uz + wx * ry - wy * rx
        static_thrust = p[THRUST_COEFFICIENT] * speed * speed
        thrust = static_thrust
        if ground_effect > 0.0:
            surface, _ = _surface_height(
                from_pad_x + r00 * rx + r01 * ry + r02 * rz,
                from_pad_y + r10 * rx + r11 * ry + r12 * rz,
                cosine,
                sine,
                half,
                pad_height,
            )
            height = x[6] + r20 * rx + r21 * ry + r22 * rz - surface
            height = max(height, 0.5 * radius)
            ratio = 0.25 * radius / height
            induced = static_thrust / disc
            share = induced / (induced + vx * vx + vy * vy + AIRSPEED_SOFTENING)
            thrust /= 1.0 - ground_effect * ratio * ratio * share
        thrust -= p[AXIAL_DRAG] * speed * vz
        hx = -p[ROTOR_DRAG] * speed * vx
        hy = -p[ROTOR_DRAG] * speed * vy
        fx += hx
        fy += hy
        fz += thrust
        mx += ry * thrust - rz * hy
        my += rz * hx - rx * thrust
        mz += rx * hy - ry * hx - spin * p[TORQUE_COEFFICIENT] * speed * speed

    normal_sum = 0.0
    if contact:
        first = FIRST_ROTOR + 4 * n
        for j in range(int(p[CONTACTS])):
            k = first + 3 * j
            rx, ry, rz = p[k], p[k + 1], p[k + 2]
            lx = r00 * rx + r01 * ry + r02 * rz
            ly = r10 * rx + r11 * ry + r12 * rz
            lz = r20 * rx + r21 * ry + r22 * rz
            gap_x, gap_y = from_pad_x + lx, from_pad_y + ly
            surface, on_pad = _surface_height(gap_x, gap_y, cosine, sine, half, pad_height)
            depth = surface - (x[6] + lz)
            if depth <= 0.0:
                continue
            # Velocity of the point: v + R (w × r), less the pad's there.
            cx, cy, cz = wy * rz - wz * ry, wz * rx - wx * rz, wx * ry - wy * rx
            vx = x[7] + r00 * cx + r01 * cy + r02 * cz
            vy = x[8] + r10 * cx + r11 * cy + r12 * cz
            vz = x[9] + r20 * cx + r21 * cy + r22 * cz
            if on_pad:
                vx -= pad[4] - pad[7] * gap_y
                vy -= pad[5] + pad[7] * gap_x
                vz -= pad[6]
            normal = p[STIFFNESS] * depth * max(0.0, 1.0 - p[DISSIPATION] * vz)
            slip = math.sqrt(vx * vx + vy * vy + p[SLIP_SPEED] * p[SLIP_SPEED])
            gx = -p[FRICTION] * normal * vx / slip
            gy = -p[FRICTION] * normal * vy / slip
            bx = r00 * gx + r10 * gy + r20 * normal
            by = r01 * gx + r11 * gy + r21 * normal
            bz = r02 * gx + r12 * gy + r22 * normal
            fx += bx
            fy += by
            fz += bz
            mx += ry * bz - rz * by
            my += rz * bx - rx * bz
            mz += rx * by - ry * bx
            normal_sum += normal

    fx /= p[MASS]
    fy /= p[MASS]
    fz /= p[MASS]
    ix, iy, iz = p[INERTIA_X], p[INERTIA_Y], p[INERTIA_Z]
    dx[0] = 0.5 * (-qx * wx - qy * wy - qz * wz)
    dx[1] = 0.5 * (qw * wx + qy * wz - qz * wy)
    dx[2] = 0.5 * (qw * wy + qz * wx - qx * wz)
    dx[3] = 0.5 * (qw * wz + qx * wy - qy * wx)
    dx[4] = x[7]
    dx[5] = x[8]
    dx[6] = x[9]
    dx[7] = r00 * fx + r01 * fy + r02 * fz
    dx[8] = r10 * fx + r11 * fy + r12 * fz
    dx[9] = r20 * fx + r21 * fy + r22 * fz - p[GRAVITY]
    dx[10] = (mx - (iz - iy) * wy * wz) / ix
    dx[11] = (my - (ix - iz) * wz * wx) / iy
    dx[12] = (mz - (iy - ix) * wx * wy) / iz
    k = BODY_SIZE + n
    dx[k] = fx
    dx[k + 1] = fy
    dx[k + 2] = fz
    dx[k + 3] = normal_sum


@njit(cache=True, error_model="numpy")
def near_surface(body, pad, parameters):
    """Whether a contact point may touch the ground or the pad within a step."""
    p = parameters
    surface = max(0.0, pad[2]) if pad[8] > 0.0 else 0.0
    travel = 2.0 * STEP * (abs(body[9]) + abs(pad[6]))
    limit = surface + _NEAR + travel - body[6]
    r20 = 2.0 * (body[1] * body[3] - body[0] * body[2])
    r21 = 2.0 * (body[2] * body[3] + body[0] * body[1])
    r22 = 1.0 - 2.0 * (body[1] * body[1] + body[2] * body[2])
    first = FIRST_ROTOR + 4 * int(p[ROTORS])
    for j in range(int(p[CONTACTS])):
        k = first + 3 * j
        if r20 * p[k] + r21 * p[k + 1] + r22 * p[k + 2] < limit:
            return True
    return False


@njit(cache=True, error_model="numpy")
def at_rest(body, rotor_speeds, commands, pad, parameters):
    """Whether the vehicle stands still with stopped rotors, and nothing asks it to move."""
    p = parameters
    for i in range(rotor_speeds.shape[0]):
        if commands[i] > 0.0 or rotor_speeds[i] > _STOPPED:
            return False
    for i in range(4, 8):
        if pad[i] != 0.0:
            return False
    for i in range(7, 13):
        if abs(body[i]) > _REST_SPEED:
            return False
    weight = p[MASS] * p[GRAVITY]
    return abs(body[16] - weight) < _WEIGHT_TOLERANCE * weight


@njit(cache=True, error_model="numpy")
def integrate(body, rotor_speeds, commands, wind, pad, parameters, duration, substeps, contact):
    """Advance `body` and `rotor_speeds` in place by `duration` with RK4 in `substeps` steps.

    Parameters
    ----------
    body : (17,) array
        `BODY_STATE`; the specific force and the contact force become the
        means over `duration`.
    rotor_speeds : (N,) array
        rad/s.
    commands, wind, pad, contact, parameters
        As in `derivatives`; commands and wind are held, the pad moves on.
    duration : float
        s.
    substeps : int
        Number of RK4 steps.
    """
    n = rotor_speeds.shape[0]
    size = BODY_SIZE + n
    total = size + 4
    work = np.zeros((6, total))
    x, y, k1, k2, k3, k4 = work[0], work[1], work[2], work[3], work[4], work[5]
    for i in range(BODY_SIZE):
        x[i] = body[i]
    for i in range(n):
        x[BODY_SIZE + i] = rotor_speeds[i]
    h = duration / substeps
    for step_number in range(substeps):
        t = step_number * h
        derivatives(x, commands, wind, pad, t, contact, parameters, k1)
        for i in range(size):
            y[i] = x[i] + 0.5 * h * k1[i]
        derivatives(y, commands, wind, pad, t + 0.5 * h, contact, parameters, k2)
        for i in range(size):
            y[i] = x[i] + 0.5 * h * k2[i]
        derivatives(y, commands, wind, pad, t + 0.5 * h, contact, parameters, k3)
        for i in range(size):
            y[i] = x[i] + h * k3[i]
        derivatives(y, commands, wind, pad, t + h, contact, parameters, k4)
        for i in range(total):
            x[i] += h / 6.0 * (k1[i] + 2.0 * (k2[i] + k3[i]) + k4[i])
        scale = 1.0 / math.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
        for i in range(4):
            x[i] *= scale
    for i in range(BODY_SIZE):
        body[i] = x[i]
    for i in range(n):
        rotor_speeds[i] = x[BODY_SIZE + i]
    for i in range(4):
        body[BODY_SIZE + i] = x[size + i] / duration


@njit(cache=True, error_model="numpy")
def step(body, rotor_speeds, commands, wind, pad, parameters):
    """Advance `body` (17,) and `rotor_speeds` (N,) in place by one plant step of 10 ms.

    RK4 in 2 sub-steps in flight and in 32 where a contact point may touch; a
    vehicle that is `at_rest` stays where it is. Parameters as in `integrate`.
    """
    if at_rest(body, rotor_speeds, commands, pad, parameters):
        body[7:13] = 0.0
        rotor_speeds[:] = 0.0
        return
    contact = near_surface(body, pad, parameters)
    substeps = CONTACT_SUBSTEPS if contact else FLIGHT_SUBSTEPS
    integrate(body, rotor_speeds, commands, wind, pad, parameters, STEP, substeps, contact)
