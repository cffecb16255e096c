"""Infrared beacons as an IR-LOCK (Pixy) camera sees them, and the blobs it reports.

A source is a lamp that looks up. Its image is a flat disc, the lamp itself,
with a Gaussian skirt, the lens; its peak falls with the square of the range r
and with the cosine of the angle θ from the lamp's axis:

    peak = threshold · strength · (maximum_range / r)² · cos θ
    I(d) = peak · exp(−max(d − a, 0)² / 2σ²),    a = f · lamp_radius / r

So a lamp of strength 1 just reaches the threshold at `maximum_range`, if a
pixel's centre happens to lie at its own. The image is linear up to full scale.
The Pixy compares pixels with a threshold, joins neighbours to blobs and
reports up to five, the largest first, each by its bounding box in whole pixels.
"""

import math

import numpy as np
from numba import njit

from systems.frames import rotation_matrix
from systems.signals.measurement import INFRARED, INFRARED_BLOBS, VALID
from systems.signals.noise import standard_normal
from systems.vision.exposure import EXPOSURE
from systems.vision.image_noise import STEPS, frame_noise
from systems.vision.pinhole import FX, HEIGHT, WIDTH, pixel_of_tangents, tangents_of_pixel
from systems.vision.planar_pose import with_covariance

THRESHOLD = 64.0  # grey levels
SPOT_SIGMA = 0.8  # px, of the lens
CENTROID_NOISE = 0.05  # px, one sigma, of the centroid of a clean blob (facts of the detector)
MAXIMUM_SPOTS = 16  # sources that one image shows

_P_WC = EXPOSURE.index("p_WC_x")
_P_WP = EXPOSURE.index("p_WP_x")
_YAW = EXPOSURE.index("yaw")
_COUNT = INFRARED.index("count")
_BLOB = INFRARED.index("blob_0_x")
_SMALLEST_DEPTH = 0.01  # m
_FULL_SCALE = 255.0


@njit(cache=True)
def project_spots(exposure, beacon, false_beacons, lamp_radius, maximum_range, camera, spots):
    """Where the lamps appear in the image.

    Parameters
    ----------
    exposure : array of the layout EXPOSURE
    beacon : array of shape (3,)
        Position of the beacon in the pad's frame P, m.
    false_beacons : array of shape (n, 4)
        Position of other lamps in W (m) and strength relative to the beacon (1).
    lamp_radius, maximum_range : float
        m.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    spots : array of shape (MAXIMUM_SPOTS, 4)
        Overwritten: u, v (px), peak (grey levels), radius of the disc (px).

    Returns
    -------
    int
        Number of spots that reach the threshold.
    """
    R_CW = rotation_matrix(exposure[:4]).T
    p_WC = exposure[_P_WC : _P_WC + 3]
    c, s = math.cos(exposure[_YAW]), math.sin(exposure[_YAW])
    count = 0
    for i in range(-1, false_beacons.shape[0]):
        if i < 0:
            strength = 1.0
            d_W = np.array(
                [
                    exposure[_P_WP] + c * beacon[0] - s * beacon[1] - p_WC[0],
                    exposure[_P_WP + 1] + s * beacon[0] + c * beacon[1] - p_WC[1],
                    exposure[_P_WP + 2] + beacon[2] - p_WC[2],
                ]
            )
        else:
            strength = false_beacons[i, 3]
            d_W = false_beacons[i, :3] - p_WC
        p_C = R_CW @ d_W
        if p_C[2] < _SMALLEST_DEPTH or d_W[2] >= 0.0 or count == MAXIMUM_SPOTS:
            continue
        r2 = d_W[0] * d_W[0] + d_W[1] * d_W[1] + d_W[2] * d_W[2]
        r = math.sqrt(r2)
        peak = THRESHOLD * strength * maximum_range * maximum_range / r2 * (-d_W[2] / r)
        if peak < THRESHOLD:
            continue
        u, v = pixel_of_tangents(camera, p_C[0] / p_C[2], p_C[1] / p_C[2])
        spots[count, 0] = u
        spots[count, 1] = v
        spots[count, 2] = peak
        spots[count, 3] = camera[FX] * lamp_radius / r
        count += 1
    return count


@njit(cache=True)
def black_level(noise):
    """The grey level of darkness, high enough that noise of sigma `noise` is not clipped."""
    return 4.0 * noise


@njit(cache=True)
def _draw_spots(spots, count, dark, noise_step, noise, image):
    height, width = image.shape
    light = np.zeros((height, width), np.float32)
    for i in range(count):
        u, v, peak, disc = spots[i, 0], spots[i, 1], spots[i, 2], spots[i, 3]
        # The skirt is drawn down to half a grey level.
        reach = disc + SPOT_SIGMA * math.sqrt(2.0 * math.log(2.0 * peak))
        for y in range(max(0, math.ceil(v - reach)), min(height, math.floor(v + reach) + 1)):
            for x in range(max(0, math.ceil(u - reach)), min(width, math.floor(u + reach) + 1)):
                d = max(math.sqrt((x - u) ** 2 + (y - v) ** 2) - disc, 0.0)
                light[y, x] += peak * math.exp(-0.5 * (d / SPOT_SIGMA) ** 2)
    base, step = np.float32(dark + 0.5), np.float32(noise_step)
    zero, top = np.float32(0.0), np.float32(_FULL_SCALE)
    for y in range(height):
        for x in range(width):
            value = base + light[y, x] + step * np.float32(noise[y, x])
            image[y, x] = np.uint8(max(zero, min(top, value)))


def render_spots(
    spots: np.ndarray, count: int, camera: np.ndarray, noise: float, key: np.uint64, frame: int
) -> np.ndarray:
    """The infrared image, uint8 of shape (height, width).

    Parameters
    ----------
    spots, count
        From `project_spots`.
    camera : array of shape (10,)
    noise : float
        Grey levels, one sigma.
    key : np.uint64
    frame : int
        Of the noise, see `systems.vision.image_noise`.
    """
    image = np.empty((int(camera[HEIGHT]), int(camera[WIDTH])), np.uint8)
    normals = frame_noise(key, frame, *image.shape)
    _draw_spots(spots, count, black_level(noise), noise / STEPS, normals, image)
    return image


@njit(cache=True)
def _insert(blobs, count, u, v, area):
    """Insert a blob into the list sorted by falling area; returns its new length."""
    place = count
    while place > 0 and blobs[place - 1, 2] < area:
        place -= 1
    if place == INFRARED_BLOBS:
        return count
    count = min(count + 1, INFRARED_BLOBS)
    for i in range(count - 1, place, -1):
        blobs[i] = blobs[i - 1]
    blobs[place, 0] = u
    blobs[place, 1] = v
    blobs[place, 2] = area
    return count


@njit(cache=True)
def detect_blobs(image, level, quantised, blobs):
    """Find the blobs of an infrared image.

    Parameters
    ----------
    image : uint8 array of shape (height, width)
    level : float
        Grey levels at or above which a pixel belongs to a blob.
    quantised : bool
        Report the middle of the bounding box in whole pixels, as the Pixy
        does; otherwise the centroid weighted with the grey levels.
    blobs : array of shape (INFRARED_BLOBS, 3)
        Overwritten: u, v (px), area (px), the largest first.

    Returns
    -------
    int
        Number of blobs, at most INFRARED_BLOBS.
    """
    height, width = image.shape
    limit = np.uint8(min(math.ceil(level), _FULL_SCALE))
    seen = np.zeros((height, width), np.bool_)
    stack = np.empty(height * width, np.int32)
    count = 0
    for y0 in range(height):
        for x0 in range(width):
            if image[y0, x0] < limit or seen[y0, x0]:
                continue
            left, right, top, bottom = x0, x0, y0, y0
            weight = sum_u = sum_v = 0.0
            area = 0
            seen[y0, x0] = True
            stack[0] = y0 * width + x0
            depth = 1
            while depth > 0:
                depth -= 1
                y, x = stack[depth] // width, stack[depth] % width
                area += 1
                g = float(image[y, x])
                weight += g
                sum_u += g * x
                sum_v += g * y
                left, right = min(left, x), max(right, x)
                top, bottom = min(top, y), max(bottom, y)
                for ny in range(max(0, y - 1), min(height, y + 2)):
                    for nx in range(max(0, x - 1), min(width, x + 2)):
                        if image[ny, nx] >= limit and not seen[ny, nx]:
                            seen[ny, nx] = True
                            stack[depth] = ny * width + nx
                            depth += 1
            if quantised:
                u, v = float((left + right) // 2), float((top + bottom) // 2)
            else:
                u, v = sum_u / weight, sum_v / weight
            count = _insert(blobs, count, u, v, float(area))
    return count


@njit(cache=True)
def sample_blobs(spots, count, camera, quantised, key, frame, blobs):
    """The blobs that `detect_blobs` would find, from the spots and without an image.

    The pixels of a spot above the threshold are counted row by row; spots that
    touch become one blob.

    Parameters
    ----------
    spots, count
        From `project_spots`.
    camera, quantised, blobs
        As in `detect_blobs`.
    key, frame
        Of the noise.
    """
    height, width = int(camera[HEIGHT]), int(camera[WIDTH])
    boxes = np.empty((MAXIMUM_SPOTS, 7))  # left, right, top, bottom, area, sum u, sum v
    n = 0
    for i in range(count):
        u, v, peak, disc = spots[i, 0], spots[i, 1], spots[i, 2], spots[i, 3]
        rho = disc + SPOT_SIGMA * math.sqrt(2.0 * math.log(peak / THRESHOLD))
        left, right, area = width, -1, 0
        top, bottom = height, -1
        sum_u = sum_v = 0.0
        for y in range(max(0, math.ceil(v - rho)), min(height, math.floor(v + rho) + 1)):
            half = math.sqrt(max(rho * rho - (y - v) ** 2, 0.0))
            first, last = max(0, math.ceil(u - half)), min(width - 1, math.floor(u + half))
            if first > last:
                continue
            left, right = min(left, first), max(right, last)
            top, bottom = min(top, y), max(bottom, y)
            area += last - first + 1
            sum_u += 0.5 * (first + last) * (last - first + 1)
            sum_v += y * (last - first + 1)
        if area == 0:
            continue
        # A spot in full view is centred better than its pixels, which only weigh 0 or 1.
        if u - rho > 0.0 and v - rho > 0.0 and u + rho < width - 1 and v + rho < height - 1:
            sum_u, sum_v = area * u, area * v
        merged = -1
        for j in range(n):
            apart = (
                left > boxes[j, 1] + 1
                or right < boxes[j, 0] - 1
                or top > boxes[j, 3] + 1
                or bottom < boxes[j, 2] - 1
            )
            if not apart:
                merged = j
        if merged < 0:
            merged = n
            n += 1
            boxes[merged, 0], boxes[merged, 1] = left, right
            boxes[merged, 2], boxes[merged, 3] = top, bottom
            boxes[merged, 4:] = 0.0
        boxes[merged, 0], boxes[merged, 1] = (
            min(boxes[merged, 0], left),
            max(boxes[merged, 1], right),
        )
        boxes[merged, 2], boxes[merged, 3] = (
            min(boxes[merged, 2], top),
            max(boxes[merged, 3], bottom),
        )
        boxes[merged, 4] += area
        boxes[merged, 5] += sum_u
        boxes[merged, 6] += sum_v
    found = 0
    for j in range(n):
        area = boxes[j, 4]
        if quantised:
            u = float(int(boxes[j, 0] + boxes[j, 1]) // 2)
            v = float(int(boxes[j, 2] + boxes[j, 3]) // 2)
        else:
            u = boxes[j, 5] / area + CENTROID_NOISE * standard_normal(key, frame, 2 + 2 * j)
            v = boxes[j, 6] / area + CENTROID_NOISE * standard_normal(key, frame, 3 + 2 * j)
        found = _insert(blobs, found, u, v, area)
    return found


@njit(cache=True)
def write_blobs(blobs, count, camera, measurement):
    """Write blobs into an INFRARED measurement; its header stays but for `valid`."""
    measurement[_COUNT:] = 0.0
    measurement[VALID] = 1.0 if count > 0 else 0.0
    measurement[_COUNT] = count
    for i in range(count):
        x, y = tangents_of_pixel(camera, blobs[i, 0], blobs[i, 1])
        measurement[_BLOB + 3 * i] = x
        measurement[_BLOB + 3 * i + 1] = y
        measurement[_BLOB + 3 * i + 2] = blobs[i, 2]


@njit(cache=True)
def write_geometric_blobs(
    exposure,
    beacon,
    false_beacons,
    lamp_radius,
    maximum_range,
    camera,
    quantised,
    key,
    frame,
    measurement,
):
    """Write what the camera would report into an INFRARED measurement, without an image.

    Parameters as in `project_spots`, `sample_blobs` and `write_blobs`.
    """
    spots = np.empty((MAXIMUM_SPOTS, 4))
    blobs = np.empty((INFRARED_BLOBS, 3))
    count = project_spots(
        exposure, beacon, false_beacons, lamp_radius, maximum_range, camera, spots
    )
    count = sample_blobs(spots, count, camera, quantised, key, frame, blobs)
    write_blobs(blobs, count, camera, measurement)


@njit(cache=True)
def pad_position_from_infrared(
    measurement, q_WB, height, X_BC, blob=0, angle_noise=1.5e-3, height_noise=0.1
):
    """Where a blob's lamp lies, from its direction, the vehicle's attitude and its height.

        d_W = R_WB R_BC (x, y, 1)
        p_BP_W = R_WB p_BC + s d_W,    s so that p_BP_W.z = −height

    Parameters
    ----------
    measurement : array of shape (INFRARED.size,)
    q_WB : array of shape (4,)
        The vehicle's attitude at the measurement's time of validity, w first.
    height : float
        Of the body's origin above the lamp, m.
    X_BC : array of shape (3, 4)
        The camera's mount, see `systems.vision.pinhole.camera_mount`.
    blob : int
        Which blob, 0 the largest.
    angle_noise : float
        One sigma of the tangents; half a pixel of the IR-LOCK is 1.5e-3.
    height_noise : float
        One sigma of the height, m.

    Returns
    -------
    array of shape (9,)
        p_BP_W (m), then its covariance xx, xy, yy, xz, yz, zz (m²), without the
        uncertainty of q_WB. NaN if the ray does not go down.
    """
    R_WB = rotation_matrix(q_WB)
    R_WC = R_WB @ np.ascontiguousarray(X_BC[:, :3])
    arm = R_WB @ np.ascontiguousarray(X_BC[:, 3])
    x, y = measurement[_BLOB + 3 * blob], measurement[_BLOB + 3 * blob + 1]
    d = R_WC @ np.array([x, y, 1.0])
    if d[2] >= -1e-6:
        return np.full(9, np.nan)
    s = -(height + arm[2]) / d[2]
    # p = arm + s d, with ds/dx = -s R_WC[2, 0] / d_z and ds/dheight = -1 / d_z
    J = np.empty((3, 3))
    for i in range(3):
        J[i, 0] = s * (R_WC[i, 0] - d[i] * R_WC[2, 0] / d[2])
        J[i, 1] = s * (R_WC[i, 1] - d[i] * R_WC[2, 1] / d[2])
        J[i, 2] = -d[i] / d[2]
    c = np.array([angle_noise**2, 0.0, angle_noise**2, 0.0, 0.0, height_noise**2])
    return with_covariance(arm + s * d, J, c)
