"""The pose of a square marker from its four corners, and what a camera reports of it.

The corners of a square of side s, in the order of OpenCV (clockwise in the
image from the marker's top left), in the pad's frame P (x to the marker's
right, y to its top, z out of the pad):

    (−s, s, 0)/2    (s, s, 0)/2    (s, −s, 0)/2    (−s, −s, 0)/2

A plane seen from afar has two poses that explain its image nearly as well.
Both are kept: IPPE (Collins and Bartoli, "Infinitesimal plane-based pose
estimation", IJCV 2014) gives two starts, Gauss–Newton takes each to its
minimum of the reprojection error.

The attitude that comes with the pose is noisy, and a lateral position that is
turned by it is noisy too (0.3 m at 10 m). So a measurement reports bearing and
range of the pad's centre in C, which hardly depend on that attitude, and the
consumer turns them with the vehicle's: `pad_position_from_marker`.
"""

import math

import numpy as np
from numba import njit

from systems.frames import rotation_matrix
from systems.signals.measurement import MARKER, MARKER_LEVELS, VALID
from systems.vision.pinhole import FX, tangents_of_pixel

_LEVEL = MARKER.index("level")
_BEARING = MARKER.index("bearing_C_x")
_RANGE = MARKER.index("range")
_COVARIANCE = MARKER.index("covariance_xx")
_FIRST = MARKER.index("q_CP_w")
_SECOND = MARKER.index("q_CP_second_w")
_ERROR = MARKER.index("reprojection_error")
_ERROR_SECOND = MARKER.index("reprojection_error_second")
_CORNERS = MARKER.index("corner_0_0_u")

_ITERATIONS = 8  # of Levenberg–Marquardt; two or three suffice below 0.1 px of noise
# rad a step: a longer one could leave the valley of the second pose for that of the first
_LONGEST_TURN = 0.05
LINE_CORRELATION = -0.5  # of the two ends of a line fitted to evenly spaced points


@njit(cache=True)
def _unit_square_homography(quad):
    """The map from (0, 0), (1, 0), (1, 1), (0, 1) to a quadrilateral, shape (3, 3).

    Heckbert, "Fundamentals of texture mapping and image warping", 1989, 2.2.3.
    """
    x0, y0 = quad[0, 0], quad[0, 1]
    x1, y1 = quad[1, 0], quad[1, 1]
    x2, y2 = quad[2, 0], quad[2, 1]
    x3, y3 = quad[3, 0], quad[3, 1]
    dx1, dx2, sx = x1 - x2, x3 - x2, x0 - x1 + x2 - x3
    dy1, dy2, sy = y1 - y2, y3 - y2, y0 - y1 + y2 - y3
    determinant = dx1 * dy2 - dy1 * dx2
    g = (sx * dy2 - sy * dx2) / determinant
    h = (dx1 * sy - dy1 * sx) / determinant
    return np.array(
        [
            [x1 - x0 + g * x1, x3 - x0 + h * x3, x0],
            [y1 - y0 + g * y1, y3 - y0 + h * y3, y0],
            [g, h, 1.0],
        ]
    )


@njit(cache=True)
def _rotation_from_vector(r):
    """The rotation matrix of a rotation vector (Rodrigues), shape (3, 3)."""
    angle = math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2])
    if angle < 1e-12:
        return np.eye(3)
    x, y, z = r[0] / angle, r[1] / angle, r[2] / angle
    c, s = math.cos(angle), math.sin(angle)
    d = 1.0 - c
    return np.array(
        [
            [c + x * x * d, x * y * d - z * s, x * z * d + y * s],
            [y * x * d + z * s, c + y * y * d, y * z * d - x * s],
            [z * x * d - y * s, z * y * d + x * s, c + z * z * d],
        ]
    )


@njit(cache=True)
def quaternion_from_matrix(R):
    """The unit quaternion, w first and w >= 0, of a rotation matrix, shape (4,)."""
    q = np.array(
        [
            1.0 + R[0, 0] + R[1, 1] + R[2, 2],
            1.0 + R[0, 0] - R[1, 1] - R[2, 2],
            1.0 - R[0, 0] + R[1, 1] - R[2, 2],
            1.0 - R[0, 0] - R[1, 1] + R[2, 2],
        ]
    )
    largest = np.argmax(q)
    if largest == 0:
        q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1]
    elif largest == 1:
        q[0], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 1] + R[1, 0], R[0, 2] + R[2, 0]
    elif largest == 2:
        q[0], q[1], q[3] = R[0, 2] - R[2, 0], R[0, 1] + R[1, 0], R[1, 2] + R[2, 1]
    else:
        q[0], q[1], q[2] = R[1, 0] - R[0, 1], R[0, 2] + R[2, 0], R[1, 2] + R[2, 1]
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        norm = -norm
    return q / norm


@njit(cache=True)
def solve_positive_definite(M, rhs):
    """Solve M X = rhs in place by Cholesky; M (n, n) and rhs (n, m) are overwritten."""
    n, m = rhs.shape
    for j in range(n):
        for k in range(j):
            M[j, j] -= M[j, k] * M[j, k]
        M[j, j] = math.sqrt(M[j, j])
        for i in range(j + 1, n):
            for k in range(j):
                M[i, j] -= M[i, k] * M[j, k]
            M[i, j] /= M[j, j]
    for c in range(m):
        for i in range(n):
            for k in range(i):
                rhs[i, c] -= M[i, k] * rhs[k, c]
            rhs[i, c] /= M[i, i]
        for i in range(n - 1, -1, -1):
            for k in range(i + 1, n):
                rhs[i, c] -= M[k, i] * rhs[k, c]
            rhs[i, c] /= M[i, i]


@njit(cache=True)
def _corner_in_camera(R, p, side, corner):
    x = -0.5 * side if corner == 0 or corner == 3 else 0.5 * side
    y = 0.5 * side if corner < 2 else -0.5 * side
    return (
        x * R[0, 0] + y * R[0, 1],
        x * R[1, 0] + y * R[1, 1],
        x * R[2, 0] + y * R[2, 1],
    )


@njit(cache=True)
def infinitesimal_plane_poses(tangents, side):
    """The two poses of IPPE, unrefined.

    Parameters
    ----------
    tangents : array of shape (4, 2)
        x/z and y/z of the corners in C.
    side : float
        m.

    Returns
    -------
    R : array of shape (2, 3, 3)
        The attitudes R_CP.
    p : array of shape (2, 3)
        The positions p_CP, m.
    """
    H = _unit_square_homography(tangents)
    # In P: a = x/side + 1/2, b = 1/2 - y/side; the origin maps to `centre`.
    scale = 0.5 * H[2, 0] + 0.5 * H[2, 1] + 1.0
    cx = (0.5 * H[0, 0] + 0.5 * H[0, 1] + H[0, 2]) / scale
    cy = (0.5 * H[1, 0] + 0.5 * H[1, 1] + H[1, 2]) / scale
    k = 1.0 / (scale * side)
    j00 = (H[0, 0] - H[2, 0] * cx) * k
    j01 = -(H[0, 1] - H[2, 1] * cx) * k
    j10 = (H[1, 0] - H[2, 0] * cy) * k
    j11 = -(H[1, 1] - H[2, 1] * cy) * k

    # R_v turns z to the ray of the centre.
    norm = math.sqrt(cx * cx + cy * cy + 1.0)
    vx, vy, vz = cx / norm, cy / norm, 1.0 / norm
    f = 1.0 / (1.0 + vz)
    R_v = np.array(
        [
            [1.0 - vx * vx * f, -vx * vy * f, vx],
            [-vx * vy * f, 1.0 - vy * vy * f, vy],
            [-vx, -vy, vz],
        ]
    )
    b00 = R_v[0, 0] - cx * R_v[2, 0]
    b01 = R_v[0, 1] - cx * R_v[2, 1]
    b10 = R_v[1, 0] - cy * R_v[2, 0]
    b11 = R_v[1, 1] - cy * R_v[2, 1]
    determinant = b00 * b11 - b01 * b10
    a00 = (b11 * j00 - b01 * j10) / determinant
    a01 = (b11 * j01 - b01 * j11) / determinant
    a10 = (b00 * j10 - b10 * j00) / determinant
    a11 = (b00 * j11 - b10 * j01) / determinant

    # The larger singular value of A is the inverse distance along the ray.
    trace = a00 * a00 + a01 * a01 + a10 * a10 + a11 * a11
    area = a00 * a11 - a01 * a10
    root = math.sqrt(max(trace * trace - 4.0 * area * area, 0.0))
    gamma = math.sqrt(0.5 * (trace + root))
    r00, r01, r10, r11 = a00 / gamma, a01 / gamma, a10 / gamma, a11 / gamma
    r20 = math.sqrt(max(1.0 - r00 * r00 - r10 * r10, 0.0))
    r21 = math.sqrt(max(1.0 - r01 * r01 - r11 * r11, 0.0))
    if r00 * r01 + r10 * r11 > 0.0:
        r21 = -r21

    R = np.empty((2, 3, 3))
    p = np.empty((2, 3))
    local = np.empty((3, 3))
    for solution in range(2):
        sign = 1.0 if solution == 0 else -1.0
        x = np.array([r00, r10, sign * r20])
        y = np.array([r01, r11, sign * r21])
        local[:, 0] = x
        local[:, 1] = y
        local[0, 2] = x[1] * y[2] - x[2] * y[1]
        local[1, 2] = x[2] * y[0] - x[0] * y[2]
        local[2, 2] = x[0] * y[1] - x[1] * y[0]
        for i in range(3):
            for j in range(3):
                R[solution, i, j] = (
                    R_v[i, 0] * local[0, j] + R_v[i, 1] * local[1, j] + R_v[i, 2] * local[2, j]
                )
        _translation(R[solution], tangents, side, p[solution])
    return R, p


@njit(cache=True)
def _translation(R, tangents, side, p):
    """The least-squares position for a given attitude: (q + p)_xy = tangents (q + p)_z."""
    sx = sy = sxx = bx = by = bz = 0.0
    for corner in range(4):
        qx, qy, qz = _corner_in_camera(R, p, side, corner)
        x, y = tangents[corner, 0], tangents[corner, 1]
        ex, ey = x * qz - qx, y * qz - qy
        sx += x
        sy += y
        sxx += x * x + y * y
        bx += ex
        by += ey
        bz -= x * ex + y * ey
    # [4 0 -sx; 0 4 -sy; -sx -sy sxx] p = [bx by bz]
    p[2] = (bz + 0.25 * (sx * bx + sy * by)) / (sxx - 0.25 * (sx * sx + sy * sy))
    p[0] = 0.25 * (bx + sx * p[2])
    p[1] = 0.25 * (by + sy * p[2])


@njit(cache=True)
def _linearise(R, p, tangents, side, residual, jacobian):
    """Residuals (8,) and their derivative (8, 6) by a turn about C's axes and by p_CP."""
    total = 0.0
    for corner in range(4):
        qx, qy, qz = _corner_in_camera(R, p, side, corner)
        w = 1.0 / (qz + p[2])
        x, y = (qx + p[0]) * w, (qy + p[1]) * w
        i = 2 * corner
        residual[i] = tangents[corner, 0] - x
        residual[i + 1] = tangents[corner, 1] - y
        total += residual[i] * residual[i] + residual[i + 1] * residual[i + 1]
        # d(q)/d(turn) = turn x q
        jacobian[i, 0] = -x * w * qy
        jacobian[i, 1] = w * qz + x * w * qx
        jacobian[i, 2] = -w * qy
        jacobian[i, 3] = w
        jacobian[i, 4] = 0.0
        jacobian[i, 5] = -x * w
        jacobian[i + 1, 0] = -w * qz - y * w * qy
        jacobian[i + 1, 1] = y * w * qx
        jacobian[i + 1, 2] = w * qx
        jacobian[i + 1, 3] = 0.0
        jacobian[i + 1, 4] = w
        jacobian[i + 1, 5] = -y * w
    return total


@njit(cache=True)
def _normal_matrix(jacobian, M):
    for i in range(6):
        for j in range(i + 1):
            total = 0.0
            for k in range(8):
                total += jacobian[k, i] * jacobian[k, j]
            M[i, j] = total
            M[j, i] = total


@njit(cache=True)
def refine_pose(R, p, tangents, side):
    """Take a pose to its minimum of the reprojection error (Levenberg–Marquardt).

    Parameters
    ----------
    R, p : arrays of shape (3, 3) and (3,)
        R_CP and p_CP (m), overwritten.
    tangents : array of shape (4, 2)
    side : float
        m.

    Returns
    -------
    float
        Root mean square distance of the corners, in tangents.
    """
    residual = np.empty(8)
    jacobian = np.empty((8, 6))
    M = np.empty((6, 6))
    step = np.empty((6, 1))
    total = _linearise(R, p, tangents, side, residual, jacobian)
    damping = 1e-6
    for _ in range(_ITERATIONS):
        _normal_matrix(jacobian, M)
        for i in range(6):
            M[i, i] *= 1.0 + damping
            # A square seen square on hardly shows its tilt: keep M definite.
            M[i, i] += 1e-14
            gradient = 0.0
            for k in range(8):
                gradient += jacobian[k, i] * residual[k]
            step[i, 0] = gradient
        solve_positive_definite(M, step)
        turn = math.sqrt(step[0, 0] ** 2 + step[1, 0] ** 2 + step[2, 0] ** 2)
        step *= min(1.0, _LONGEST_TURN / max(turn, 1e-12))
        R_new = _rotation_from_vector(step[:3, 0]) @ R
        p_new = p + step[3:, 0]
        if p_new[2] <= 0.0:
            break
        total_new = _linearise(R_new, p_new, tangents, side, residual, jacobian)
        if total_new > total:
            damping *= 100.0
            _linearise(R, p, tangents, side, residual, jacobian)
            continue
        improvement = total - total_new
        R[:] = R_new
        p[:] = p_new
        total = total_new
        damping *= 0.1
        if improvement <= 1e-4 * total:
            break
    return math.sqrt(0.25 * total)


@njit(cache=True)
def corner_shifts(corners, line_shifts):
    """How the corners move when the ends of the sides move, shape (4, 2) in px.

    Side k runs from corner k to corner k + 1; where two sides meet, the corner
    goes to the intersection of the moved lines.

    Parameters
    ----------
    corners : array of shape (4, 2)
        px.
    line_shifts : array of shape (4, 2)
        Shift of both ends of each side along its outward normal, px.
    """
    normals = np.empty((4, 2))
    for k in range(4):
        dx = corners[(k + 1) % 4, 0] - corners[k, 0]
        dy = corners[(k + 1) % 4, 1] - corners[k, 1]
        length = math.sqrt(dx * dx + dy * dy)
        # Clockwise in an image whose y points down: outward is to the left of the way.
        normals[k, 0] = dy / length
        normals[k, 1] = -dx / length
    shifts = np.empty((4, 2))
    for k in range(4):
        before = (k + 3) % 4
        ax, ay, a = normals[before, 0], normals[before, 1], line_shifts[before, 1]
        bx, by, b = normals[k, 0], normals[k, 1], line_shifts[k, 0]
        determinant = ax * by - ay * bx
        shifts[k, 0] = (a * by - b * ay) / determinant
        shifts[k, 1] = (b * ax - a * bx) / determinant
    return shifts


@njit(cache=True)
def _position_covariance(R, p, tangents, side, corners, focal_length, end_noise):
    """Covariance of p_CP (3, 3) for a noise of `end_noise` px at the ends of the sides."""
    residual = np.empty(8)
    jacobian = np.empty((8, 6))
    _linearise(R, p, tangents, side, residual, jacobian)
    M = np.empty((6, 6))
    _normal_matrix(jacobian, M)
    for i in range(6):
        M[i, i] *= 1.0 + 1e-9
    gain = np.ascontiguousarray(jacobian.T)  # becomes M^-1 J', shape (6, 8)
    solve_positive_definite(M, gain)
    # Columns of `ends`: the position's answer to a unit shift of each end of each side.
    ends = np.zeros((3, 4, 2))
    unit = np.zeros((4, 2))
    for k in range(4):
        for end in range(2):
            unit[k, end] = 1.0
            shifts = corner_shifts(corners, unit)
            unit[k, end] = 0.0
            for i in range(3):
                for corner in range(4):
                    ends[i, k, end] += (
                        gain[3 + i, 2 * corner] * shifts[corner, 0]
                        + gain[3 + i, 2 * corner + 1] * shifts[corner, 1]
                    )
    covariance = np.zeros((3, 3))
    scale = (end_noise / focal_length) ** 2
    for i in range(3):
        for j in range(3):
            for k in range(4):
                a0, a1 = ends[i, k, 0], ends[i, k, 1]
                b0, b1 = ends[j, k, 0], ends[j, k, 1]
                covariance[i, j] += scale * (
                    a0 * b0 + a1 * b1 + LINE_CORRELATION * (a0 * b1 + a1 * b0)
                )
    return covariance


@njit(cache=True)
def write_pose(corners, side, camera, end_noise, scale_error, measurement):
    """Write bearing, range, covariance and both attitudes into a MARKER measurement.

    Parameters
    ----------
    corners : array of shape (4, 2)
        Of the level that the pose is taken from, px.
    side : float
        m.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    end_noise : float
        One sigma of each end of a fitted side along its normal, px, correlated as a line's are.
    scale_error : float
        One sigma of an error of the range that all four sides share, relative.
    measurement : array of shape (MARKER.size,)
        The pose's entries are overwritten.

    Returns
    -------
    bool
        False, and nothing is written, if the corners are not the front of a square.
    """
    tangents = np.empty((4, 2))
    for corner in range(4):
        x, y = tangents_of_pixel(camera, corners[corner, 0], corners[corner, 1])
        tangents[corner, 0] = x
        tangents[corner, 1] = y
    R, p = infinitesimal_plane_poses(tangents, side)
    if not (p[0, 2] > 0.0 and p[1, 2] > 0.0):
        return False
    error_0 = refine_pose(R[0], p[0], tangents, side)
    error_1 = refine_pose(R[1], p[1], tangents, side)
    best, error, error_second = 0, error_0, error_1
    if error_1 < error_0:
        best, error, error_second = 1, error_1, error_0

    normal = R[best][:, 2]
    if normal[0] * p[best, 0] + normal[1] * p[best, 1] + normal[2] * p[best, 2] >= 0.0:
        return False
    focal_length = camera[FX]
    C = _position_covariance(R[best], p[best], tangents, side, corners, focal_length, end_noise)
    distance = math.sqrt(p[best, 0] ** 2 + p[best, 1] ** 2 + p[best, 2] ** 2)
    b = p[best] / distance
    # d(bearing) = (I - b b') dp / range, d(range) = b' dp
    T = np.empty((3, 3))
    for j in range(3):
        for i in range(2):
            T[i, j] = ((1.0 if i == j else 0.0) - b[i] * b[j]) / distance
        T[2, j] = b[j]
    C = T @ C @ T.T
    measurement[_BEARING : _BEARING + 3] = b
    measurement[_RANGE] = distance
    measurement[_COVARIANCE] = C[0, 0]
    measurement[_COVARIANCE + 1] = C[0, 1]
    measurement[_COVARIANCE + 2] = C[1, 1]
    measurement[_COVARIANCE + 3] = C[0, 2]
    measurement[_COVARIANCE + 4] = C[1, 2]
    measurement[_COVARIANCE + 5] = C[2, 2] + (scale_error * distance) ** 2
    measurement[_FIRST : _FIRST + 4] = quaternion_from_matrix(R[best])
    measurement[_SECOND : _SECOND + 4] = quaternion_from_matrix(R[1 - best])
    measurement[_ERROR] = error * focal_length
    measurement[_ERROR_SECOND] = error_second * focal_length
    return True


@njit(cache=True)
def write_detection(corners, sides, camera, end_noise, scale_error, measurement):
    """Write what was detected into a MARKER measurement; its header stays but for `valid`.

    The pose is taken from the largest level detected: an error of the corners
    weighs on the range in inverse proportion to the side, so the five times
    smaller next level would add next to nothing.

    Parameters
    ----------
    corners : array of shape (MARKER_LEVELS, 4, 2)
        px, NaN where a level was not detected.
    sides : array of shape (MARKER_LEVELS,)
        m, the largest first.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    end_noise, scale_error : arrays of shape (MARKER_LEVELS,)
        As in `write_pose`, by level.
    measurement : array of shape (MARKER.size,)
        Overwritten.
    """
    measurement[_LEVEL:] = 0.0
    measurement[VALID] = 0.0
    for level in range(MARKER_LEVELS):
        for corner in range(4):
            i = _CORNERS + 8 * level + 2 * corner
            measurement[i] = corners[level, corner, 0]
            measurement[i + 1] = corners[level, corner, 1]
    for level in range(MARKER_LEVELS):
        if not math.isnan(corners[level, 0, 0]) and write_pose(
            corners[level],
            sides[level],
            camera,
            end_noise[level],
            scale_error[level],
            measurement,
        ):
            measurement[_LEVEL] = level
            measurement[VALID] = 1.0
            return


@njit(cache=True)
def pad_position_from_marker(measurement, q_WB, X_BC):
    """Where the pad's centre lies, from a valid MARKER measurement and the vehicle's attitude.

        p_BP_W = R_WB (p_BC + R_BC range bearing_C)

    Parameters
    ----------
    measurement : array of shape (MARKER.size,)
    q_WB : array of shape (4,)
        The vehicle's attitude at the measurement's time of validity, w first.
    X_BC : array of shape (3, 4)
        The camera's mount, see `systems.vision.pinhole.camera_mount`.

    Returns
    -------
    array of shape (9,)
        p_BP_W (m), then its covariance xx, xy, yy, xz, yz, zz (m²) from the
        measurement alone: the uncertainty of q_WB comes on top.
    """
    R_WB = rotation_matrix(q_WB)
    r = measurement[_RANGE]
    bx, by, bz = measurement[_BEARING], measurement[_BEARING + 1], measurement[_BEARING + 2]
    # Columns: d(p_CP) by bearing x, bearing y and range; b stays a unit vector.
    J_C = np.array([[r, 0.0, bx], [0.0, r, by], [-r * bx / bz, -r * by / bz, bz]])
    R_BC = np.ascontiguousarray(X_BC[:, :3])
    R_WC = R_WB @ R_BC
    p_CP = np.array([r * bx, r * by, r * bz])
    p = R_WC @ p_CP + R_WB @ np.ascontiguousarray(X_BC[:, 3])
    return with_covariance(p, R_WC @ J_C, measurement[_COVARIANCE : _COVARIANCE + 6])


@njit(cache=True)
def with_covariance(p, J, c):
    """Append a covariance to a position.

    Parameters
    ----------
    p : array of shape (3,)
    J : array of shape (3, 3)
        Derivative of p by three parameters.
    c : array of shape (6,)
        Covariance of the parameters, 00, 01, 11, 02, 12, 22.

    Returns
    -------
    array of shape (9,)
        p, then xx, xy, yy, xz, yz, zz of J C J'.
    """
    C = np.array([[c[0], c[1], c[3]], [c[1], c[2], c[4]], [c[3], c[4], c[5]]])
    V = J @ C @ J.T
    return np.array([p[0], p[1], p[2], V[0, 0], V[0, 1], V[1, 1], V[0, 2], V[1, 2], V[2, 2]])
