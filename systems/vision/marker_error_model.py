"""What the detector makes of a marker's corners, without an image: an error model.

The model speaks of the sides of the marker, because `corner_lines` fits those.
Its inputs are what an image shows: the shortest side s of the marker (px), the
smear m of the exposure (px; m_n along a side's normal), the light L at the marker
(1 is full scale), and the noise of the pixels. The blur of an edge is

    σ_e² = σ_lens² + m_n² / 12

A side is shifted along its outward normal by a bias and by noise at its ends:

    bias  = BIAS + SIZE_BIAS σ_e exp(−s / (SIZE_BIAS_SCALE σ_e)) + b_sat
    b_sat = κ(z) √((SATURATION σ_lens)² + (SATURATION_SMEAR m_n)² / 12),
            Φ(z) = (1 / L − ρ) / (1 − ρ)           for L > 1, else 0
    σ²    = (FLOOR σ_e)² + NOISE² σ_e n² / (ΔI² min(s, s₀))
            + (SIZE_NOISE σ_e exp(−s / (SIZE_NOISE_SCALE σ_e)))² + (TWIST b_sat)²
    τ     = COMMON b_sat

The second term of the bias is that of the neighbouring edges that enter the
window of a small marker; κ(z) is the centroid of a Gaussian edge that is cut off
at full scale, at z, where white grows into black. σ is the noise of the two ends, whose
correlation is that of a fitted line, −1/2; τ moves all sides of a marker alike. n is
the noise of the pixels, ΔI the step from black to white, ρ the reflectance of black, and s₀
the side from which on the detector takes no more profiles.

A marker wholly in the image is found with the probability

    p = logit⁻¹(SIDE_SLOPE ln(s / SIDE_50)) · logit⁻¹(DIM_SLOPE ln(L / DIM_50))
        · logit⁻¹(BRIGHT_SLOPE ln(BRIGHT_50 / L))

with medians that depend on the smear. All constants are fitted by
`python -m benchmarks.fit_marker_error_model`, which renders, detects and
prints them; a test holds model and pixels together.
"""

import math

import numpy as np
from numba import njit

from systems.signals.measurement import MARKER_LEVELS
from systems.signals.noise import standard_normal, uniform
from systems.vision.corner_lines import END, NOISE_FLOOR, PROFILES
from systems.vision.exposure import EXPOSURE, pad_in_camera
from systems.vision.nested_marker import SMALLEST_BORDER
from systems.vision.pinhole import CX, CY, is_in_image, pixel_of_tangents
from systems.vision.planar_pose import LINE_CORRELATION, corner_shifts, write_detection
from systems.vision.rendering import BLACK, LENS_SIGMA, SHOT_NOISE, VIGNETTE

# Fitted: python -m benchmarks.fit_marker_error_model
BIAS = -0.001823  # px
SIZE_BIAS, SIZE_BIAS_SCALE = 5.703, 4.171
FLOOR, NOISE = 0.006464, 7.031
SIZE_NOISE, SIZE_NOISE_SCALE = 2.124, 5.885
SATURATION, SATURATION_SMEAR = 1.109, 1.223
COMMON, TWIST = 0.09781, 0.05116
SIDE_SLOPE, DIM_SLOPE, BRIGHT_SLOPE = 7.361, 10.67, 5.054
SMEAR = np.array([0.0, 2.0, 4.0, 8.0, 12.0, 16.0])  # px, where the medians below stand
SIDE_50 = np.array([14.04, 16.08, 20.28, 33.23, 64.86, 93.95])  # px
DIM_50 = np.array([0.1057, 0.1203, 0.1481, 0.2422, 0.3611, 0.5204])  # 1
BRIGHT_50 = np.array([4.506, 3.652, 3.505, 3.516, 3.654, 2.557])  # 1

LARGEST_SIDE = PROFILES[-1] / (1.0 - 2.0 * END)  # px, s₀

_SMEAR = EXPOSURE.index("smear_u")
_SMALLEST_DEPTH = 0.01  # m
_SQRT2 = math.sqrt(2.0)
_SQRT2PI = math.sqrt(2.0 * math.pi)


@njit(cache=True)
def _normal_quantile(p):
    """Φ⁻¹(p) by Newton's method."""
    z = 0.0
    for _ in range(20):
        density = math.exp(-0.5 * z * z) / _SQRT2PI
        step = (0.5 * (1.0 + math.erf(z / _SQRT2)) - p) / density
        z -= max(-1.0, min(1.0, step))
        if abs(step) < 1e-9:
            break
    return z


@njit(cache=True)
def saturation_shift(light):
    """Where the detector sees a saturated edge: κ, in units of the edge's blur, at most 0.

    The detector drops slopes below a part f of the steepest one, so that the
    weight of a place x is φ(x) − f φ(x_p) from where it is positive to the cut z:

        κ = ∫ x w dx / ∫ w dx,   x_p = min(z, 0)
    """
    if light <= 1.0:
        return 0.0
    z = _normal_quantile(max((1.0 / light - BLACK) / (1.0 - BLACK), 0.01))
    steepest = min(z, 0.0)
    floor = NOISE_FLOOR * math.exp(-0.5 * steepest * steepest) / _SQRT2PI
    low = -math.sqrt(steepest * steepest - 2.0 * math.log(NOISE_FLOOR))
    high = min(z, -low)
    moment = (
        math.exp(-0.5 * low * low) - math.exp(-0.5 * high * high)
    ) / _SQRT2PI - 0.5 * floor * (high * high - low * low)
    weight = 0.5 * (math.erf(high / _SQRT2) - math.erf(low / _SQRT2)) - floor * (high - low)
    return moment / weight


@njit(cache=True)
def side_statistics(side, smear, light, read_noise):
    """How the detector misplaces a side of a marker.

    Parameters
    ----------
    side : float
        Shortest side of the marker, px.
    smear : float
        Along the normal of this side, px.
    light : float
        Level of the plate's white at the marker, 1 is full scale.
    read_noise : float
        One sigma, grey levels of 255.

    Returns
    -------
    bias, sigma, tau : floats
        px: mean outward shift, one sigma of the ends, one sigma of what all sides share.
    """
    spread2 = smear * smear / 12.0
    blur = math.sqrt(LENS_SIGMA * LENS_SIGMA + spread2)
    saturation = saturation_shift(light) * math.sqrt(
        (SATURATION * LENS_SIGMA) ** 2 + SATURATION_SMEAR**2 * spread2
    )
    bias = BIAS + SIZE_BIAS * blur * math.exp(-side / (SIZE_BIAS_SCALE * blur)) + saturation
    step = 255.0 * max(min(light, 1.0) - BLACK * light, 1e-3)
    pixel_variance = read_noise * read_noise + 1.0 / 12.0 + 0.5 * SHOT_NOISE * step
    crowding = SIZE_NOISE * blur * math.exp(-side / (SIZE_NOISE_SCALE * blur))
    variance = (
        (FLOOR * blur) ** 2
        + NOISE * NOISE * blur * pixel_variance / (step * step * min(side, LARGEST_SIDE))
        + crowding * crowding
        + (TWIST * saturation) ** 2
    )
    return bias, math.sqrt(variance), -COMMON * saturation


@njit(cache=True)
def _interpolate(smear, values):
    last = SMEAR.size - 1
    if smear >= SMEAR[last]:
        return values[last]
    i = 0
    while smear >= SMEAR[i + 1]:
        i += 1
    t = (smear - SMEAR[i]) / (SMEAR[i + 1] - SMEAR[i])
    return values[i] + t * (values[i + 1] - values[i])


@njit(cache=True)
def _logistic(x):
    return 1.0 / (1.0 + math.exp(-max(-50.0, min(50.0, x))))


@njit(cache=True)
def detection_probability(side, smear, light):
    """Probability that a marker wholly in the image is found; parameters as in the module."""
    # Beyond the table the smallest readable marker grows with the smear.
    stretch = max(1.0, smear / SMEAR[SMEAR.size - 1])
    return (
        _logistic(SIDE_SLOPE * math.log(side / (_interpolate(smear, SIDE_50) * stretch)))
        * _logistic(DIM_SLOPE * math.log(light / (_interpolate(smear, DIM_50) * stretch)))
        * _logistic(BRIGHT_SLOPE * math.log(_interpolate(smear, BRIGHT_50) / light))
    )


@njit(cache=True)
def shortest_side(corners):
    """The shortest side (px) of a quadrilateral, shape (4, 2)."""
    shortest = math.inf
    for k in range(4):
        dx = corners[(k + 1) % 4, 0] - corners[k, 0]
        dy = corners[(k + 1) % 4, 1] - corners[k, 1]
        shortest = min(shortest, math.sqrt(dx * dx + dy * dy))
    return shortest


@njit(cache=True)
def local_light(camera, corners, light):
    """The light at a marker, less than in the middle of the image by the vignette."""
    u = v = 0.0
    for k in range(4):
        u += 0.25 * corners[k, 0] - 0.25 * camera[CX]
        v += 0.25 * corners[k, 1] - 0.25 * camera[CY]
    r2 = (u * u + v * v) / (camera[CX] * camera[CX] + camera[CY] * camera[CY])
    return light * (1.0 - VIGNETTE * min(r2, 1.0))


@njit(cache=True)
def project_corners(R, p, side, camera, corners):
    """Project the corners (px) of a marker of `side` m at R_CP, p_CP; False if behind the lens."""
    for corner in range(4):
        x = (-0.5 if corner == 0 or corner == 3 else 0.5) * side
        y = (0.5 if corner < 2 else -0.5) * side
        depth = x * R[2, 0] + y * R[2, 1] + p[2]
        if depth <= _SMALLEST_DEPTH:
            return False
        u, v = pixel_of_tangents(
            camera,
            (x * R[0, 0] + y * R[0, 1] + p[0]) / depth,
            (x * R[1, 0] + y * R[1, 1] + p[1]) / depth,
        )
        corners[corner, 0] = u
        corners[corner, 1] = v
    return True


@njit(cache=True)
def sample_corners(exposure, sides, camera, light, read_noise, key, frame, corners):
    """The corners of the levels as the detector would find them.

    Parameters
    ----------
    exposure : array of the layout EXPOSURE
    sides : array of shape (MARKER_LEVELS,)
        m, 0 where there is no such level.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    light : float
        Level of the plate's white in the middle of the image, 1 is full scale.
    read_noise : float
        One sigma, grey levels of 255.
    key, frame
        Of the noise.
    corners : array of shape (MARKER_LEVELS, 4, 2)
        px, overwritten; NaN where a level is not found.
    """
    corners[:] = np.nan
    R, p = pad_in_camera(exposure)
    # The camera sees the front of the pad only.
    if R[0, 2] * p[0] + R[1, 2] * p[1] + R[2, 2] * p[2] >= 0.0:
        return
    smear_u, smear_v = exposure[_SMEAR], exposure[_SMEAR + 1]
    smear = math.sqrt(smear_u * smear_u + smear_v * smear_v)
    true = np.empty((4, 2))
    shifts = np.empty((4, 2))
    other_end = math.sqrt(1.0 - LINE_CORRELATION * LINE_CORRELATION)
    for level in range(MARKER_LEVELS):
        if sides[level] <= 0.0 or not project_corners(R, p, sides[level], camera, true):
            continue
        inside = True
        for corner in range(4):
            inside = inside and is_in_image(
                camera, true[corner, 0], true[corner, 1], SMALLEST_BORDER
            )
        size = shortest_side(true)
        light_here = local_light(camera, true, light)
        lane = 10 * level
        if not inside or (
            uniform(key, frame, lane) > detection_probability(size, smear, light_here)
        ):
            continue
        common = standard_normal(key, frame, lane + 1)
        for k in range(4):
            dx = true[(k + 1) % 4, 0] - true[k, 0]
            dy = true[(k + 1) % 4, 1] - true[k, 1]
            across = (smear_u * dy - smear_v * dx) / math.sqrt(dx * dx + dy * dy)
            bias, sigma, tau = side_statistics(size, across, light_here, read_noise)
            first = standard_normal(key, frame, lane + 2 + 2 * k)
            second = standard_normal(key, frame, lane + 3 + 2 * k)
            whole = bias + tau * common
            shifts[k, 0] = whole + sigma * first
            shifts[k, 1] = whole + sigma * (LINE_CORRELATION * first + other_end * second)
        corners[level] = true + corner_shifts(true, shifts)


@njit(cache=True)
def write_marker_detection(corners, exposure, sides, camera, light, read_noise, measurement):
    """Write found corners into a MARKER measurement, its covariance by the error model.

    Parameters
    ----------
    corners : array of shape (MARKER_LEVELS, 4, 2)
        px, NaN where a level was not found.
    exposure, sides, camera, light, read_noise
        As in `sample_corners`.
    measurement : array of shape (MARKER.size,)
        Overwritten but for the header.
    """
    noise = np.zeros(MARKER_LEVELS)
    scale = np.zeros(MARKER_LEVELS)
    smear = math.sqrt(exposure[_SMEAR] ** 2 + exposure[_SMEAR + 1] ** 2)
    for level in range(MARKER_LEVELS):
        if not math.isnan(corners[level, 0, 0]):
            size = shortest_side(corners[level])
            # A mean direction: half of the smear's square is across a side.
            bias, sigma, tau = side_statistics(
                size, smear / _SQRT2, local_light(camera, corners[level], light), read_noise
            )
            noise[level] = sigma
            # Sides that are all drawn inwards make the range too long.
            scale[level] = 2.0 * math.sqrt(bias * bias + tau * tau) / size
    write_detection(corners, sides, camera, noise, scale, measurement)


@njit(cache=True)
def write_geometric_detection(exposure, sides, camera, light, read_noise, key, frame, measurement):
    """Write what the detector would find into a MARKER measurement, without an image.

    Parameters as in `sample_corners` and `write_marker_detection`.
    """
    corners = np.empty((MARKER_LEVELS, 4, 2))
    sample_corners(exposure, sides, camera, light, read_noise, key, frame, corners)
    write_marker_detection(corners, exposure, sides, camera, light, read_noise, measurement)
