"""What a camera must remember of one exposure: a flat vector from which its image follows.

The pose of camera and pad is taken at the middle of the exposure. An image is a
pure function of this vector and the frame's number, so it need not be kept.
"""

import math

import numpy as np
from numba import njit

from systems.frames import quaternion_from_rotation_vector, quaternion_multiply, rotation_matrix
from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import BODY_STATE, PAD_STATE, Layout, vector
from systems.vision.pinhole import FX, FY, is_in_image, pixel_of_tangents

EXPOSURE = Layout(
    "Exposure",
    (
        *vector("q_WC", "wxyz"),
        *vector("p_WC"),  # m
        *vector("p_WP"),  # m, the pad's centre
        "yaw",  # rad, of the pad
        *vector("smear", "uv"),  # px, way of the pad's image during the exposure
    ),
)
_P_WC = EXPOSURE.index("p_WC_x")
_P_WP = EXPOSURE.index("p_WP_x")
_YAW = EXPOSURE.index("yaw")
_SMEAR = EXPOSURE.index("smear_u")
SMEAR = slice(_SMEAR, _SMEAR + 2)  # both components in an exposure

_BODY_POSITION = BODY_STATE.index("p_WB_x")
_BODY_VELOCITY = BODY_STATE.index("v_WB_x")
_BODY_RATE = BODY_STATE.index("w_WB_B_x")
_PAD_VELOCITY = PAD_STATE.index("v_WP_x")
_PAD_YAW = PAD_STATE.index("yaw")
_PAD_YAW_RATE = PAD_STATE.index("yaw_rate")

_DUE = 1e-6  # of a frame's period, by which a frame may be early
_SMALLEST_DEPTH = 0.01  # m; nearer than the lens can be there is nothing to see


def is_due(time: float, frame_rate: float) -> bool:
    """Whether a camera that looks at its clock on every tick takes a frame at `time` (s).

    It does when a multiple of 1 / frame_rate has passed since it last looked,
    so a rate that does not fit the grid is kept on average. The first is at 0.
    """
    due = math.floor(time * frame_rate + _DUE)
    return due > math.floor((time - CLOCK_PERIOD) * frame_rate + _DUE)


@njit(cache=True)
def quaternion_of_mount(X_BC):
    """The attitude q_BC, w first, of a camera that hangs by X_BC and looks roughly down.

    Valid for rotations by 60 to 300 degrees: w may vanish, the largest of x, y, z must not.
    """
    x = 1.0 + X_BC[0, 0] - X_BC[1, 1] - X_BC[2, 2]
    y = 1.0 - X_BC[0, 0] + X_BC[1, 1] - X_BC[2, 2]
    if x >= y:
        q = np.array([X_BC[2, 1] - X_BC[1, 2], x, X_BC[0, 1] + X_BC[1, 0], X_BC[0, 2] + X_BC[2, 0]])
    else:
        q = np.array([X_BC[0, 2] - X_BC[2, 0], X_BC[0, 1] + X_BC[1, 0], y, X_BC[1, 2] + X_BC[2, 1]])
    return q / np.sqrt(np.sum(q * q))


@njit(cache=True)
def expose(body, pad, X_BC, camera, exposure_time, exposure):
    """The exposure that ends now, from the states of body and pad now.

    Both are carried back by half the exposure time at constant velocity. The
    smear is that of the pad's centre or, where that is out of the image, of the
    point of the pad's plane on the optical axis.

    Parameters
    ----------
    body, pad : arrays of the layouts BODY_STATE and PAD_STATE
    X_BC : array of shape (3, 4)
        The camera's mount.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    exposure_time : float
        s.
    exposure : array of shape (EXPOSURE.size,)
        Overwritten.
    """
    back = -0.5 * exposure_time
    w_B = body[_BODY_RATE : _BODY_RATE + 3]
    v_WB = body[_BODY_VELOCITY : _BODY_VELOCITY + 3]
    q_WB = quaternion_multiply(body[:4], quaternion_from_rotation_vector(back * w_B))
    R_WB = rotation_matrix(q_WB)
    q_WC = quaternion_multiply(q_WB, quaternion_of_mount(X_BC))
    exposure[:4] = q_WC
    arm = np.array([X_BC[0, 3], X_BC[1, 3], X_BC[2, 3]])
    exposure[_P_WC : _P_WC + 3] = (
        body[_BODY_POSITION : _BODY_POSITION + 3] + back * v_WB + R_WB @ arm
    )
    v_WP = pad[_PAD_VELOCITY : _PAD_VELOCITY + 3]
    exposure[_P_WP : _P_WP + 3] = pad[:3] + back * v_WP
    exposure[_YAW] = pad[_PAD_YAW] + back * pad[_PAD_YAW_RATE]

    R_CW = rotation_matrix(q_WC).T
    p_C = R_CW @ (exposure[_P_WP : _P_WP + 3] - exposure[_P_WC : _P_WC + 3])
    exposure[_SMEAR] = 0.0
    exposure[_SMEAR + 1] = 0.0
    seen = False
    if p_C[2] > _SMALLEST_DEPTH:
        u, v = pixel_of_tangents(camera, p_C[0] / p_C[2], p_C[1] / p_C[2])
        seen = is_in_image(camera, u, v, 0.0)
    if not seen:
        # The axis meets the plane with normal n = z_W through p_C at depth n·p_C / n_z.
        n = R_CW[:, 2]
        if abs(n[2]) < 1e-3:
            return
        depth = (n[0] * p_C[0] + n[1] * p_C[1] + n[2] * p_C[2]) / n[2]
        if depth <= _SMALLEST_DEPTH:
            return
        p_C = np.array([0.0, 0.0, depth])
    arm_rate = np.array(
        [
            w_B[1] * arm[2] - w_B[2] * arm[1],
            w_B[2] * arm[0] - w_B[0] * arm[2],
            w_B[0] * arm[1] - w_B[1] * arm[0],
        ]
    )
    R_CB = R_CW @ R_WB
    v_C = R_CW @ (v_WP - v_WB) - R_CB @ arm_rate
    w_C = R_CB @ w_B
    x, y = p_C[0] / p_C[2], p_C[1] / p_C[2]
    rate_x = v_C[0] - (w_C[1] * p_C[2] - w_C[2] * p_C[1])
    rate_y = v_C[1] - (w_C[2] * p_C[0] - w_C[0] * p_C[2])
    rate_z = v_C[2] - (w_C[0] * p_C[1] - w_C[1] * p_C[0])
    exposure[_SMEAR] = camera[FX] * exposure_time * (rate_x - x * rate_z) / p_C[2]
    exposure[_SMEAR + 1] = camera[FY] * exposure_time * (rate_y - y * rate_z) / p_C[2]


@njit(cache=True)
def pad_in_camera(exposure):
    """The pad's attitude R_CP (3, 3) and centre p_CP (3,), m, at the middle of the exposure."""
    R_CW = rotation_matrix(exposure[:4]).T
    c, s = np.cos(exposure[_YAW]), np.sin(exposure[_YAW])
    R_WP = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    p_CP = R_CW @ (exposure[_P_WP : _P_WP + 3] - exposure[_P_WC : _P_WC + 3])
    return np.ascontiguousarray(R_CW) @ R_WP, p_CP
