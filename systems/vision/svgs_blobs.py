"""LEDs as the SVGS camera sees them: from lamps to spots, to an image, to blobs of mass and area.

A lamp at range r has an image whose peak falls with r², until its disc is resolved:

    peak = LEVEL · gain · (visible_range / r)² · vignette / (1 + a²/2σ²),    a = f · radius / r
    I(d) = peak · [(1 − h) exp(−max(d − a, 0)²/2σ²) + h exp(−max(d − a, 0)²/2s²)]

with the lens's blur σ and a weak, wide bloom (h, s). The motion during the exposure draws each
spot out along the smear. Channels clip at full scale. `gain` is the exposure time as a fraction
of the longest, set by the auto exposure from the number of saturated pixels.

A blob is a set of neighbouring pixels brighter than the background, bright enough at its peak:

    mass M = Σ I_i, area A = Σ 1        ("High-altitude precision landing by SVGS", Eqs. 2, 3)

with I the brightest channel above the background. Its colour is that of its unsaturated pixels.

The ground is drawn as an even background with noise: exposed for LEDs it is dark.
"""

import math

import cv2
import numpy as np
from numba import njit

from systems.frames import rotation_matrix
from systems.signals.noise import standard_normal, uniform
from systems.vision.image_noise import BANK_SIZE, STEPS, noise_bank
from systems.vision.pinhole import CX, CY, FX, HEIGHT, WIDTH, pixel_of_tangents

LEVEL = 60.0  # grey levels above the background at which a lamp just counts as an LED
SEED_LEVEL = 40.0  # grey levels, least peak of a blob
EDGE_LEVEL = 12.0  # grey levels, of the pixels that belong to it; 8 sigma of the read noise
SPOT_SIGMA = 0.8  # px, of the lens, the image being scaled down to 800 x 800
BLOOM, BLOOM_SIGMA = 0.002, 4.0  # part of the peak, px: scattered light of a phone's lens
VIGNETTE = 0.25  # loss of light in the corners
READ_NOISE = 1.5  # grey levels
SHOT_NOISE = 0.02  # grey levels, variance per grey level: a full well of 13 000 electrons
BLACK = 8.0  # grey levels
AMBIENT = 24.0  # grey levels of sunlit ground at the longest exposure
FULL_SCALE = 255.0
MAXIMUM_SPOTS = 64
MAXIMUM_BLOBS = 48
COLOUR_MATCH = 0.96  # cosine of the angle between colours that count as the same
MERGE = 0.92  # of the sum of two spots' radii, below which their blobs are one

# Columns of the array of spots
(SPOT_U, SPOT_V, SPOT_PEAK, SPOT_DISC, SPOT_RED, SPOT_GREEN, SPOT_BLUE, SPOT_LAMP) = range(8)
SPOT_SIZE = 8
# Columns of the array of blobs; colour is the index of the beacon or -1
BLOB_U, BLOB_V, BLOB_MASS, BLOB_AREA, BLOB_COLOUR, BLOB_PEAK = range(6)
BLOB_SIZE = 6

# Auto exposure: aim at this many saturated pixels, in steps of a factor √2
_FEW_SATURATED, _MANY_SATURATED = 400, 1200
_GAIN_STEP = math.sqrt(2.0)
LOWEST_GAIN = 1.0 / 512.0

# Indices of the layout EXPOSURE as the compiled functions read them; a test holds them to it.
_P_WC, _P_WP, _YAW = 4, 7, 10
_SMALLEST_DEPTH = 0.05  # m
_BORDER = 2  # px; a blob nearer to the edge of the image is cut and not used
# Centroid noise without an image, fitted to the images; see `tests/…/test_svgs_blobs.py`
CENTROID_FLOOR = 0.018  # px, pixels of finite size
CENTROID_PEAK_NOISE = 3.2  # px grey levels, over the peak
_SMEAR_AREA, _SMEAR_ONSET = 2.0, 2.9  # 1, px: how smear widens a blob


@njit(cache=True)
def project_lamps(exposure, lamps, gain, camera, spots):
    """Where lamps appear in the image.

    Parameters
    ----------
    exposure : array of the layout EXPOSURE
    lamps : array of shape (n, LAMP_SIZE)
        See `plants.svgs_beacons`; the columns are x, y, z in P, colour, visible range, radius.
    gain : float
        Exposure time as a fraction of the longest.
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    spots : array of shape (MAXIMUM_SPOTS, SPOT_SIZE)
        Overwritten.

    Returns
    -------
    int
        Number of spots that can be told from the background.
    """
    R_CW = rotation_matrix(exposure[:4]).T
    c, s = math.cos(exposure[_YAW]), math.sin(exposure[_YAW])
    corner = camera[CX] ** 2 + camera[CY] ** 2
    count = 0
    for i in range(lamps.shape[0]):
        x, y, z = lamps[i, 0], lamps[i, 1], lamps[i, 2]
        dx = exposure[_P_WP] + c * x - s * y - exposure[_P_WC]
        dy = exposure[_P_WP + 1] + s * x + c * y - exposure[_P_WC + 1]
        dz = exposure[_P_WP + 2] + z - exposure[_P_WC + 2]
        z_C = R_CW[2, 0] * dx + R_CW[2, 1] * dy + R_CW[2, 2] * dz
        if z_C < _SMALLEST_DEPTH or count == MAXIMUM_SPOTS:
            continue
        x_C = R_CW[0, 0] * dx + R_CW[0, 1] * dy + R_CW[0, 2] * dz
        y_C = R_CW[1, 0] * dx + R_CW[1, 1] * dy + R_CW[1, 2] * dz
        u, v = pixel_of_tangents(camera, x_C / z_C, y_C / z_C)
        if u < -20.0 or v < -20.0 or u > camera[WIDTH] + 20.0 or v > camera[HEIGHT] + 20.0:
            continue
        r2 = dx * dx + dy * dy + dz * dz
        disc = camera[FX] * lamps[i, 7] / math.sqrt(r2)
        vignette = 1.0 - VIGNETTE * ((u - camera[CX]) ** 2 + (v - camera[CY]) ** 2) / corner
        peak = LEVEL * gain * lamps[i, 6] ** 2 / r2 * vignette
        peak /= 1.0 + disc * disc / (2.0 * SPOT_SIGMA * SPOT_SIGMA)
        if peak < EDGE_LEVEL:
            continue
        spots[count, SPOT_U] = u
        spots[count, SPOT_V] = v
        spots[count, SPOT_PEAK] = peak
        spots[count, SPOT_DISC] = disc
        spots[count, SPOT_RED] = lamps[i, 3]
        spots[count, SPOT_GREEN] = lamps[i, 4]
        spots[count, SPOT_BLUE] = lamps[i, 5]
        spots[count, SPOT_LAMP] = i
        count += 1
    return count


@njit(cache=True)
def add_glints(spots, count, glints, colour, camera, key, frame):
    """Add spots at random places of the image, as bright as the LEDs there are.

    Parameters
    ----------
    spots, count
        From `project_lamps`; spots are added.
    glints : int
        How many.
    colour : array of shape (3,)
    camera, key, frame
        Places and brightness are drawn for each frame anew.

    Returns
    -------
    int
        The new number of spots.
    """
    bright, n = 0.0, 0
    for i in range(count):
        same = abs(spots[i, SPOT_RED] - colour[0]) + abs(spots[i, SPOT_GREEN] - colour[1])
        if same < 1e-6:
            bright += math.log(spots[i, SPOT_PEAK])
            n += 1
    typical = math.exp(bright / n) if n > 0 else 4.0 * LEVEL
    disc = 0.0
    for i in range(count):
        disc = max(disc, spots[i, SPOT_DISC])
    for g in range(glints):
        if count == MAXIMUM_SPOTS:
            break
        spots[count, SPOT_U] = uniform(key, frame, 4 * g) * (camera[WIDTH] - 1.0)
        spots[count, SPOT_V] = uniform(key, frame, 4 * g + 1) * (camera[HEIGHT] - 1.0)
        spots[count, SPOT_PEAK] = typical * 2.0 ** (2.0 * uniform(key, frame, 4 * g + 2) - 1.0)
        spots[count, SPOT_DISC] = disc * uniform(key, frame, 4 * g + 3)
        for c in range(3):
            spots[count, SPOT_RED + c] = colour[c]
        spots[count, SPOT_LAMP] = -1.0
        count += 1
    return count


@njit(cache=True)
def background(gain):
    """The grey level of the ground at an exposure."""
    return BLACK + AMBIENT * gain


@njit(cache=True)
def _reach(peak, disc):
    """How far from its centre a spot is still half a grey level bright, px."""
    core = SPOT_SIGMA * math.sqrt(2.0 * math.log(max(2.0 * peak, 1.0)))
    wide = BLOOM_SIGMA * math.sqrt(2.0 * math.log(max(2.0 * BLOOM * peak, 1.0)))
    return disc + max(core, wide)


@njit(cache=True)
def _draw_spots(spots, count, smear_u, smear_v, noise, start, planes):
    """Add spots and their shot noise to the image, clipped at full scale."""
    height, width = planes.shape[1], planes.shape[2]
    length = math.sqrt(smear_u * smear_u + smear_v * smear_v)
    steps = 1 + int(length / 0.5)
    for i in range(count):
        u, v, peak, disc = (
            spots[i, SPOT_U],
            spots[i, SPOT_V],
            spots[i, SPOT_PEAK],
            spots[i, SPOT_DISC],
        )
        reach = _reach(peak, disc)
        along_u, along_v = reach + 0.5 * abs(smear_u), reach + 0.5 * abs(smear_v)
        blooms = 2.0 * BLOOM * peak > 1.0
        for y in range(max(0, math.ceil(v - along_v)), min(height, math.floor(v + along_v) + 1)):
            for x in range(max(0, math.ceil(u - along_u)), min(width, math.floor(u + along_u) + 1)):
                light = 0.0
                for k in range(steps):
                    part = (k + 0.5) / steps - 0.5
                    du, dv = x - u - part * smear_u, y - v - part * smear_v
                    d = max(math.sqrt(du * du + dv * dv) - disc, 0.0)
                    light += (1.0 - BLOOM) * math.exp(-0.5 * (d / SPOT_SIGMA) ** 2)
                    if blooms:
                        light += BLOOM * math.exp(-0.5 * (d / BLOOM_SIGMA) ** 2)
                light *= peak / steps
                for c in range(3):
                    signal = light * spots[i, SPOT_RED + c]
                    if signal < 0.5:
                        continue
                    # Three planes need more normals than the bank has: it wraps around.
                    place = (start + (c * height + y) * width + x) & (BANK_SIZE - 1)
                    shot = math.sqrt(SHOT_NOISE * signal) * noise[place] / STEPS
                    value = planes[c, y, x] + signal + shot
                    planes[c, y, x] = np.uint8(min(max(value + 0.5, 0.0), FULL_SCALE))


def render_spots(
    spots: np.ndarray,
    count: int,
    smear: np.ndarray,
    gain: float,
    camera: np.ndarray,
    key: np.uint64,
    frame: int,
) -> np.ndarray:
    """The image, uint8 of shape (3, height, width): red, green, blue.

    Parameters
    ----------
    spots, count
        From `project_lamps`.
    smear : array of shape (2,)
        px, the way of the image during the exposure.
    gain : float
        Exposure time as a fraction of the longest.
    camera : array of shape (10,)
    key : np.uint64
    frame : int
        Of the noise.
    """
    height, width = int(camera[HEIGHT]), int(camera[WIDTH])
    size = height * width
    bank = noise_bank()
    planes = np.empty((3, height, width), np.uint8)
    # Grey level of each possible normal: the noise of a plane is one look into a table.
    levels = background(gain) + READ_NOISE / STEPS * np.arange(256).astype(np.uint8).view(np.int8)
    table = np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    for channel in range(3):
        start = int(uniform(key, frame, channel) * (BANK_SIZE - size))
        normals = bank[start : start + size].view(np.uint8).reshape(height, width)
        cv2.LUT(normals, table, dst=planes[channel])
    start = int(uniform(key, frame, 3) * BANK_SIZE)
    _draw_spots(spots, count, smear[0], smear[1], bank, start, planes)
    return planes


@njit(cache=True)
def _collect(brightest, mask, seeds, planes, dark, colours, blobs):
    """Flood the pixels of `mask` from each seed; see `detect_blobs`."""
    height, width = brightest.shape
    stack = np.empty(4 * height + 4 * width, np.int32)
    count = 0
    saturated = 0
    for s in range(seeds.shape[0]):
        x0, y0 = seeds[s, 0], seeds[s, 1]
        if mask[y0, x0] == 0:
            continue
        mask[y0, x0] = 0
        stack[0] = y0 * width + x0
        depth = 1
        mass = sum_u = sum_v = peak = 0.0
        area = 0
        left, right, top, bottom = x0, x0, y0, y0
        colour = np.zeros(3)
        clipped = np.zeros(3)
        while depth > 0:
            depth -= 1
            y, x = stack[depth] // width, stack[depth] % width
            level = float(brightest[y, x])
            light = level - dark
            mass += light
            sum_u += light * x
            sum_v += light * y
            area += 1
            peak = max(peak, light)
            left, right = min(left, x), max(right, x)
            top, bottom = min(top, y), max(bottom, y)
            if level < FULL_SCALE:
                for c in range(3):
                    colour[c] += planes[c, y, x] - dark
            else:
                saturated += 1
                for c in range(3):
                    clipped[c] += planes[c, y, x] - dark
            for ny in range(max(0, y - 1), min(height, y + 2)):
                for nx in range(max(0, x - 1), min(width, x + 2)):
                    if mask[ny, nx] != 0 and depth < stack.size:
                        mask[ny, nx] = 0
                        stack[depth] = ny * width + nx
                        depth += 1
        if count == MAXIMUM_BLOBS:
            continue
        if left < _BORDER or top < _BORDER:
            continue
        if right >= width - _BORDER or bottom >= height - _BORDER:
            continue
        if colour[0] + colour[1] + colour[2] <= 0.0:
            colour = clipped
        blobs[count, BLOB_U] = sum_u / mass
        blobs[count, BLOB_V] = sum_v / mass
        blobs[count, BLOB_MASS] = mass
        blobs[count, BLOB_AREA] = area
        blobs[count, BLOB_COLOUR] = colour_index(colour, colours)
        blobs[count, BLOB_PEAK] = peak
        count += 1
    return count, saturated


@njit(cache=True)
def colour_index(colour, colours):
    """Which of `colours` (n, 3) a colour (3,) is, -1 if none is near."""
    best, index = COLOUR_MATCH, -1
    norm = math.sqrt(colour[0] ** 2 + colour[1] ** 2 + colour[2] ** 2)
    for i in range(colours.shape[0]):
        dot = own = 0.0
        for c in range(3):
            dot += colour[c] * colours[i, c]
            own += colours[i, c] ** 2
        cosine = dot / max(norm * math.sqrt(own), 1e-9)
        if cosine > best:
            best, index = cosine, i
    return index


def detect_blobs(planes: np.ndarray, colours: np.ndarray, blobs: np.ndarray) -> tuple[int, int]:
    """Find the blobs of an image.

    Parameters
    ----------
    planes : uint8 array of shape (3, height, width)
        Red, green, blue.
    colours : array of shape (n, 3)
        The colours to be told apart.
    blobs : array of shape (MAXIMUM_BLOBS, BLOB_SIZE)
        Overwritten: centroid (px), mass (grey levels), area (px), index of the colour or -1,
        peak (grey levels), from the top of the image. Blobs cut by the border are left out.

    Returns
    -------
    tuple of int
        Number of blobs; number of saturated pixels in them and others.
    """
    brightest = cv2.max(cv2.max(planes[0], planes[1]), planes[2])
    dark = float(np.median(brightest[::23, ::23]))
    _, mask = cv2.threshold(brightest, math.ceil(dark + EDGE_LEVEL) - 1, 255, cv2.THRESH_BINARY)
    _, bright = cv2.threshold(brightest, math.ceil(dark + SEED_LEVEL) - 1, 255, cv2.THRESH_BINARY)
    found = cv2.findNonZero(bright)
    if found is None:
        return 0, 0
    return _collect(brightest, mask, found.reshape(-1, 2), planes, dark, colours, blobs)


@njit(cache=True)
def _radius(peak, disc, level):
    """Radius of the disc of a spot that is brighter than `level`, px."""
    if peak <= level:
        return 0.0
    return disc + SPOT_SIGMA * math.sqrt(2.0 * math.log(peak / level))


@njit(cache=True)
def _edge(peak, disc):
    """Radius of the disc of a spot that belongs to its blob, px; the bloom widens bright ones."""
    radius = _radius(peak, disc, EDGE_LEVEL)
    while radius > 0.0:
        bloom = BLOOM * peak * math.exp(-0.5 * ((radius - disc) / BLOOM_SIGMA) ** 2)
        core = peak * math.exp(-0.5 * ((radius - disc) / SPOT_SIGMA) ** 2)
        if core + bloom <= EDGE_LEVEL + 1.0:
            break
        radius += 0.1
    return radius


@njit(cache=True)
def _clipped_light(peak, disc, radius, top):
    """The light (grey levels) of a spot within `radius`, clipped at `top`."""
    light, step = 0.0, 0.25
    for i in range(int(radius / step) + 1):
        rho = (i + 0.5) * step
        level = peak * math.exp(-0.5 * (max(rho - disc, 0.0) / SPOT_SIGMA) ** 2)
        light += min(level, top) * 2.0 * math.pi * rho * step
    return light


@njit(cache=True)
def centroid_noise(peak):
    """One sigma of a blob's centroid along each axis (px): the model fitted to the images.

    `peak` is in grey levels above the background, before the clipping.
    """
    return math.hypot(CENTROID_FLOOR, CENTROID_PEAK_NOISE / min(peak, FULL_SCALE))


@njit(cache=True)
def _widening(smear):
    """How much a smear (px) lowers a spot's peak: that of a Gaussian drawn out evenly."""
    if smear < 0.01:
        return 1.0
    part = math.erf(smear / (2.0 * math.sqrt(2.0) * SPOT_SIGMA))
    return smear / (SPOT_SIGMA * math.sqrt(2.0 * math.pi) * part)


@njit(cache=True)
def sample_blobs(spots, count, smear_u, smear_v, gain, camera, colours, key, frame, blobs):
    """The blobs that `detect_blobs` would find, from the spots and without an image.

    Spots that touch become one blob, of mixed colour; a spot's peak falls with its smear.

    Parameters
    ----------
    spots, count
        From `project_lamps`.
    smear_u, smear_v : float
        px.
    gain : float
        Exposure time as a fraction of the longest.
    camera, colours, blobs
        As in `detect_blobs`.
    key, frame
        Of the noise.

    Returns
    -------
    tuple of int
        As from `detect_blobs`.
    """
    length = math.sqrt(smear_u * smear_u + smear_v * smear_v)
    wide = _widening(length)
    spread = _SMEAR_AREA * length * length / (length + _SMEAR_ONSET)
    group = np.arange(count)
    for i in range(count):
        for j in range(i):
            apart = math.hypot(
                spots[i, SPOT_U] - spots[j, SPOT_U], spots[i, SPOT_V] - spots[j, SPOT_V]
            )
            touch = _edge(spots[i, SPOT_PEAK], spots[i, SPOT_DISC])
            touch += _edge(spots[j, SPOT_PEAK], spots[j, SPOT_DISC])
            if apart < MERGE * touch + 0.5 * length:
                old, new = group[i], group[j]
                for k in range(count):
                    if group[k] == old:
                        group[k] = new
    found, saturated = 0, 0
    top = FULL_SCALE - background(gain)
    for g in range(count):
        mass = sum_u = sum_v = area = peak = brightest = reach = 0.0
        colour = np.zeros(3)
        for i in range(count):
            if group[i] != g:
                continue
            disc = spots[i, SPOT_DISC]
            bright = max(spots[i, SPOT_RED], spots[i, SPOT_GREEN], spots[i, SPOT_BLUE])
            own = spots[i, SPOT_PEAK] * bright / wide
            radius = _edge(own, disc)
            flat = _radius(own, disc, top)
            saturated += int(math.pi * flat * flat + flat * spread)
            light = _clipped_light(own, disc, radius, top) * wide
            mass += light
            area += math.pi * radius * radius + radius * spread
            sum_u += light * spots[i, SPOT_U]
            sum_v += light * spots[i, SPOT_V]
            # The brightest pixel lies up to half a pixel from the middle of a small spot.
            du = abs(spots[i, SPOT_U] - round(spots[i, SPOT_U]))
            dv = abs(spots[i, SPOT_V] - round(spots[i, SPOT_V]))
            miss = max(math.hypot(du, dv) - disc, 0.0) / (SPOT_SIGMA * wide)
            peak = max(peak, min(own * math.exp(-0.5 * miss * miss), top))
            brightest = max(brightest, own)
            reach = max(reach, radius + 0.5 * length)
            for c in range(3):
                colour[c] += light * spots[i, SPOT_RED + c] / bright
        if mass == 0.0 or peak < SEED_LEVEL or found == MAXIMUM_BLOBS:
            continue
        u, v = sum_u / mass, sum_v / mass
        cut_u = u - reach < _BORDER or u + reach > camera[WIDTH] - 1.0 - _BORDER
        cut_v = v - reach < _BORDER or v + reach > camera[HEIGHT] - 1.0 - _BORDER
        if cut_u or cut_v:
            continue
        sigma = centroid_noise(brightest)
        blobs[found, BLOB_U] = u + sigma * standard_normal(key, frame, 16 + 2 * g)
        blobs[found, BLOB_V] = v + sigma * standard_normal(key, frame, 17 + 2 * g)
        blobs[found, BLOB_MASS] = mass
        blobs[found, BLOB_AREA] = area
        blobs[found, BLOB_COLOUR] = colour_index(colour, colours)
        blobs[found, BLOB_PEAK] = peak
        found += 1
    return found, saturated


@njit(cache=True)
def next_gain(gain, saturated):
    """The exposure of the next frame: a step shorter, longer or the same.

    Parameters
    ----------
    gain : float
        Of this frame.
    saturated : int
        Number of its saturated pixels.
    """
    if saturated > _MANY_SATURATED:
        return max(gain / _GAIN_STEP, LOWEST_GAIN)
    if saturated < _FEW_SATURATED:
        return min(gain * _GAIN_STEP, 1.0)
    return gain
