"""Images of the landing pad as a camera takes them: optics, exposure, noise.

The pad is drawn once for each scale, already blurred with a part of the lens's
blur, from the exact integrals of its cells (so that no edge is rounded to a
texel). For a frame the rays of every eighth pixel are cut with the pad's plane,
which takes distortion and perspective along; between them texture coordinates
are interpolated linearly (error below 0.01 px, and none in the mean, for tilts up
to 20 degrees). The rest of the blur is added in the image:

    σ_lens² = σ_texture² + σ_rest²,   σ_texture between 0.48 and 0.68 px

so an edge is sampled nearly without aliasing (0.004 px) and stays where it is. The
smear of the exposure is uniform over the image. Then, per pixel,

    I = clip(255 · light · vignette · reflectance + noise),
    noise ~ N(0, read² + shot · I)

with normals from a bank that is entered at a place drawn for each frame. All
is a pure function of its arguments, by one thread.
"""

import math
from functools import lru_cache

import cv2
import numpy as np
from numba import njit
from scipy.special import erf

from systems.vision.exposure import EXPOSURE, pad_in_camera
from systems.vision.image_noise import STEPS, frame_noise
from systems.vision.nested_marker import CELLS, NestedMarker
from systems.vision.pinhole import CX, CY, FX, HEIGHT, WIDTH, pixel_of_tangents, tangents_of_pixel

LENS_SIGMA = 0.7  # px, lens and the area of a pixel together
VIGNETTE = 0.25  # 1, loss of light in the corners of the image
SHOT_NOISE = 0.008  # grey levels, variance per grey level: a full well of 32 000 electrons
BLACK, GROUND = 0.06, 0.36  # 1, reflectances; the plate's white is 1

_BLOCK = 8  # px, between exact rays
# texel, of the blur drawn into the texture; with less the interpolation between texels would
# ripple, and move edges by hundredths of a pixel
_TEXTURE_SIGMA = 1.2
_EFFECTIVE_SIGMA = math.sqrt(_TEXTURE_SIGMA**2 + 1.0 / 6.0)  # texel, with bilinear interpolation
_FINEST_TEXEL = 5e-5  # m, of scale 0; each further scale is sqrt(2) coarser
_LARGEST_WINDOW = 1536  # texels a side, of a texture finer than the whole plate needs
_LARGEST_TEXTURE = 2048  # texels a side, of the finest texture of the whole plate
_GROUND_TEXEL = 4e-3  # m, of the ground's finest scale; each further one is twice as coarse
_GROUND_SIZE = 1024  # texels a side of a tile
_GROUND_OVERLAP = 64  # texels, the largest extent of a block on the ground
_GROUND_SCALES = 6
_GROUND_CONTRAST = 0.05  # 1, one sigma of the reflectance
_LONGEST_SMEAR = 60.0  # px
# What a block shows, in _draw. The ones with ground come last.
_HAZE, _FINE, _COARSE, _GROUND, _EDGE = range(5)
_HAZE_TEXEL = np.uint32(0xB0B0B0B0)  # grey, above the horizon
# Fixed-point coordinates and packed texels; numba widens mixed integers, hence the types.
_ONE = 65536.0
_U8, _U16 = np.uint32(8), np.uint32(16)
_BYTE, _FULL, _HALF = np.uint32(255), np.uint32(256), np.uint32(32768)
_EVEN_BYTES, _LOW_HALF = np.uint32(0x00FF00FF), np.uint32(0xFFFF)
_SMEAR = EXPOSURE.index("smear_u")
_P_WP = EXPOSURE.index("p_WP_x")
_YAW = EXPOSURE.index("yaw")


def texel(scale: int) -> float:
    """Side of a texel of the pad's texture, m."""
    return _FINEST_TEXEL * 2.0 ** (0.5 * scale)


def _cell_profile(edges: np.ndarray, centres: np.ndarray, sigma: float) -> np.ndarray:
    """How much of each blurred cell is at each place, shape (centres, cells)."""
    step = 0.5 * erf((centres[:, None] - edges[None, :]) / (math.sqrt(2.0) * sigma))
    return step[:, :-1] - step[:, 1:]


def _pack(texture: np.ndarray) -> np.ndarray:
    """Each texel with its right, lower and lower right neighbours in one number, flat uint32."""
    t = np.pad(texture, ((0, 1), (0, 1)), mode="edge").astype(np.uint32)
    packed = t[:-1, :-1] | t[1:, :-1] << 16 | t[:-1, 1:] << 8 | t[1:, 1:] << 24
    return np.ascontiguousarray(packed.ravel())


def _plate_texels(pad: NestedMarker, scale: int) -> int:
    """Texels a side that cover the plate and a little ground."""
    return 2 * math.ceil(0.5 * pad.plate_side / texel(scale) + 4.0)


@lru_cache(maxsize=64)
def pad_texture(pad: NestedMarker, scale: int) -> np.ndarray:
    """The pad's reflectance (255 is the plate's white), top row at the largest y, uint8.

    The texture is square and centred on the pad; it covers the plate and a
    little ground, or the middle of the plate where that would be too large.
    """
    size = texel(scale)
    count = _plate_texels(pad, scale)
    if count > _LARGEST_TEXTURE:
        count = _LARGEST_WINDOW
    centres = (np.arange(count) - 0.5 * (count - 1)) * size
    sigma = _TEXTURE_SIGMA * size
    plate = _cell_profile(np.array([-0.5, 0.5]) * pad.plate_side, centres, sigma)
    image = GROUND + (1.0 - GROUND) * (plate @ plate.T)
    for level, side in enumerate(pad.sides):
        profile = _cell_profile(np.linspace(-0.5, 0.5, CELLS + 1) * side, centres, sigma)
        # The pattern's top row is at the largest y, as the texture's.
        image += (BLACK - 1.0) * (profile @ (1.0 - pad.cells(level)) @ profile.T)
    return np.clip(np.rint(255.0 * image), 0, 255).astype(np.uint8)


@lru_cache(maxsize=64)
def _packed_pad_texture(pad: NestedMarker, scale: int) -> np.ndarray:
    return _pack(pad_texture(pad, scale))


@lru_cache(maxsize=1)
def ground_tiles() -> list[np.ndarray]:
    """Reflectance of the ground at falling resolution, uint8 tiles that repeat.

    Noise with a spectrum of 1/f^1.2 around the mean reflectance of the ground,
    like worn concrete or short grass from above.
    """
    rng = np.random.Generator(np.random.PCG64(1))  # the ground is the same in all runs
    frequency = np.hypot(
        np.fft.fftfreq(_GROUND_SIZE)[:, None], np.fft.rfftfreq(_GROUND_SIZE)[None, :]
    )
    frequency[0, 0] = 1.0
    spectrum = np.fft.rfft2(rng.standard_normal((_GROUND_SIZE, _GROUND_SIZE))) / frequency**1.2
    spectrum[0, 0] = 0.0
    field = np.fft.irfft2(spectrum)
    tile = np.clip(255.0 * (GROUND + _GROUND_CONTRAST * field / field.std()), 0, 255)
    tiles = []
    for _ in range(_GROUND_SCALES):
        # Coarser tiles are the finer one averaged, laid side by side.
        repeat = _GROUND_SIZE // tile.shape[0]
        tiles.append(np.tile(np.rint(tile).astype(np.uint8), (repeat, repeat)))
        tile = 0.25 * (tile[::2, ::2] + tile[1::2, ::2] + tile[::2, 1::2] + tile[1::2, 1::2])
    return tiles


@lru_cache(maxsize=_GROUND_SCALES)
def _packed_ground(scale: int) -> np.ndarray:
    # A block may reach over the end of a tile: repeat its beginning.
    return _pack(np.pad(ground_tiles()[scale], (0, _GROUND_OVERLAP), mode="wrap"))


@njit(cache=True)
def _node_rays(camera):
    """Tangents of the rays at the corners of the blocks, shape (rows, columns, 2)."""
    rows = (int(camera[HEIGHT]) + _BLOCK - 1) // _BLOCK + 1
    columns = (int(camera[WIDTH]) + _BLOCK - 1) // _BLOCK + 1
    rays = np.empty((rows, columns, 2))
    for i in range(rows):
        for j in range(columns):
            x, y = tangents_of_pixel(camera, float(_BLOCK * j), float(_BLOCK * i))
            rays[i, j, 0] = x
            rays[i, j, 1] = y
    return rays


@njit(cache=True)
def _cut_rays(rays, R, p, exact, on_pad):
    """Where the rays meet the pad's plane, in P (m), for linear interpolation between them.

    The chord of a curve lies h² f″ / 12 beside it in the mean. Each place is moved
    by that, so that interpolation displaces no edge. NaN above the horizon.
    """
    # With M = [R_x R_y p] a point (x, y) of the plane is seen along M (x, y, 1): invert M.
    ax, ay, az = R[0, 0], R[1, 0], R[2, 0]
    bx, by, bz = R[0, 1], R[1, 1], R[2, 1]
    cx, cy, cz = p[0], p[1], p[2]
    # Rows of the adjugate, up to the common determinant.
    i00, i01, i02 = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
    i10, i11, i12 = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
    i20, i21, i22 = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
    # The last row is the pad's normal in C; it points to the camera, against the ray.
    for i in range(rays.shape[0]):
        for j in range(rays.shape[1]):
            x, y = rays[i, j, 0], rays[i, j, 1]
            w = i20 * x + i21 * y + i22
            if w > -1e-2:
                exact[i, j, 0] = np.nan
                exact[i, j, 1] = np.nan
            else:
                exact[i, j, 0] = (i00 * x + i01 * y + i02) / w
                exact[i, j, 1] = (i10 * x + i11 * y + i12) / w
    rows, columns = rays.shape[0], rays.shape[1]
    for i in range(rows):
        a = min(max(i, 1), rows - 2)
        for j in range(columns):
            b = min(max(j, 1), columns - 2)
            for k in range(2):
                curvature = (
                    exact[a - 1, j, k]
                    - 2.0 * exact[a, j, k]
                    + exact[a + 1, j, k]
                    + exact[i, b - 1, k]
                    - 2.0 * exact[i, b, k]
                    + exact[i, b + 1, k]
                )
                on_pad[i, j, k] = exact[i, j, k] - curvature / 12.0


@njit(cache=True, error_model="numpy")
def _place_blocks(
    on_pad, row, half_fine, half_coarse, plate, ground_texel, anchor, kind, u, v, gu, gv
):
    """Decide what each block of one row of blocks shows and where in its texture it lies.

    Parameters
    ----------
    on_pad : array of shape (rows + 1, columns + 1, 2)
        From `_cut_rays`.
    row : int
    half_fine, half_coarse : float
        Half the extents of the pad's textures, m.
    plate : array of shape (2, 2)
        Texel (m) and middle (texels) of the fine and the coarse texture.
    ground_texel : float
        m.
    anchor : array of shape (3,)
        The pad's x, y (m) and yaw (rad) in W, where the ground's pattern is fixed.
    kind : uint8 array of shape (columns,)
        Overwritten.
    u, v : arrays of shape (columns, 4)
        Overwritten: the blocks' nodes in texels, left to right, then top to bottom.
    gu, gv : arrays of shape (columns, 4)
        Overwritten where a block shows ground: the same in the ground's tile.
    """
    tile = _GROUND_SIZE * ground_texel
    cos_yaw, sin_yaw = math.cos(anchor[2]), math.sin(anchor[2])
    for j in range(kind.size):
        low_x = low_y = np.inf
        high_x = high_y = -np.inf
        for k in range(4):
            x = on_pad[row + k // 2, j + k % 2, 0]
            y = on_pad[row + k // 2, j + k % 2, 1]
            u[j, k], v[j, k] = x, y
            low_x, high_x = min(low_x, x), max(high_x, x)
            low_y, high_y = min(low_y, y), max(high_y, y)
        extent = max(high_x - low_x, high_y - low_y)
        total = u[j, 0] + u[j, 1] + u[j, 2] + u[j, 3]
        reach = max(max(-low_x, high_x), max(-low_y, high_y))
        if not (abs(total) < np.inf and extent < 0.7 * _GROUND_OVERLAP * ground_texel):
            kind[j] = _HAZE
            continue
        if reach <= half_fine:
            kind[j] = _FINE
        elif reach <= half_coarse:
            kind[j] = _COARSE
        elif max(max(low_x, -high_x), max(low_y, -high_y)) > half_coarse:
            kind[j] = _GROUND
        else:
            kind[j] = _EDGE
        if kind[j] >= _GROUND:
            low_u = low_v = np.inf
            for k in range(4):
                gu[j, k] = anchor[0] + cos_yaw * u[j, k] - sin_yaw * v[j, k]
                gv[j, k] = anchor[1] + sin_yaw * u[j, k] + cos_yaw * v[j, k]
                low_u, low_v = min(low_u, gu[j, k]), min(low_v, gv[j, k])
            # The tile in which the block begins; it may end in the overlap.
            tile_u, tile_v = math.floor(low_u / tile) * tile, math.floor(low_v / tile) * tile
            for k in range(4):
                gu[j, k] = (gu[j, k] - tile_u) / ground_texel
                gv[j, k] = (gv[j, k] - tile_v) / ground_texel
        if kind[j] == _GROUND:
            u[j] = gu[j]
            v[j] = gv[j]
        else:
            size, middle = plate[0 if kind[j] == _FINE else 1]
            for k in range(4):
                u[j, k] = middle + u[j, k] / size
                v[j, k] = middle - v[j, k] / size


@njit(cache=True, error_model="numpy")
def _fetch_block(texture, size, x0, u, v, texels):
    """The packed texels of one row of a block, from fixed-point coordinates."""
    for x in range(_BLOCK):
        i = np.uint64(x0 + x)
        texels[i] = texture[np.uint64((v[i] >> _U16) * np.uint32(size) + (u[i] >> _U16))]


@njit(cache=True, error_model="numpy")
def _interpolate(texels, u, v, out):
    """Bilinear interpolation of packed texels, two of the four in each half of a word."""
    for x in range(out.size):
        w = texels[x]
        fu, fv = (u[x] >> _U8) & _BYTE, (v[x] >> _U8) & _BYTE
        left = np.uint32((w & _EVEN_BYTES) * np.uint32(_FULL - fu))
        right = np.uint32(((w >> _U8) & _EVEN_BYTES) * fu)
        pair = np.uint32(left + right)
        top = np.uint32(np.uint32(pair & _LOW_HALF) * np.uint32(_FULL - fv))
        bottom = np.uint32(np.uint32(pair >> _U16) * fv)
        out[x] = np.uint8(np.uint32(np.uint32(top + bottom) + _HALF) >> _U16)


@njit(cache=True, error_model="numpy")
def _draw(
    on_pad, fine, fine_size, fine_texel, coarse, coarse_size, coarse_texel, ground, ground_texel,
    anchor, image,
):  # fmt: skip
    """Fill the image from the packed textures of pad and ground.

    Work goes by rows of pixels: fixed-point texture coordinates (16 bits of
    fraction), then the packed texels, then the interpolation.
    """
    width = image.shape[1]
    columns = width // _BLOCK
    step = 1.0 / _BLOCK
    ground_size = _GROUND_SIZE + _GROUND_OVERLAP
    half_fine = (0.5 * fine_size - 2.0) * fine_texel
    half_coarse = (0.5 * coarse_size - 2.0) * coarse_texel
    plate = np.array([[fine_texel, 0.5 * (fine_size - 1)], [coarse_texel, 0.5 * (coarse_size - 1)]])
    last = coarse_size - 2.0
    kind = np.empty(columns, np.uint8)
    nodes = np.empty((4, columns, 4))
    u, v, gu, gv = nodes[0], nodes[1], nodes[2], nodes[3]
    row_u = np.empty(width, np.uint32)
    row_v = np.empty(width, np.uint32)
    texels = np.empty(width, np.uint32)
    for y in range(image.shape[0]):
        row = y % _BLOCK
        if row == 0:
            _place_blocks(
                on_pad, y // _BLOCK, half_fine, half_coarse, plate, ground_texel, anchor,
                kind, u, v, gu, gv,
            )  # fmt: skip
        b = row * step
        for j in range(columns):
            x0 = j * _BLOCK
            if kind[j] == _HAZE:
                row_u[x0 : x0 + _BLOCK] = 0
                row_v[x0 : x0 + _BLOCK] = 0
                texels[x0 : x0 + _BLOCK] = _HAZE_TEXEL
                continue
            lu = u[j, 0] + b * (u[j, 2] - u[j, 0])
            lv = v[j, 0] + b * (v[j, 2] - v[j, 0])
            du = (u[j, 1] + b * (u[j, 3] - u[j, 1]) - lu) * step
            dv = (v[j, 1] + b * (v[j, 3] - v[j, 1]) - lv) * step
            u0, v0 = np.int32(lu * _ONE), np.int32(lv * _ONE)
            iu, iv = np.int32(du * _ONE), np.int32(dv * _ONE)
            for x in range(_BLOCK):
                row_u[np.uint64(x0 + x)] = np.uint32(u0 + np.int32(x) * iu)
                row_v[np.uint64(x0 + x)] = np.uint32(v0 + np.int32(x) * iv)
            if kind[j] == _FINE:
                _fetch_block(fine, fine_size, x0, row_u, row_v, texels)
            elif kind[j] == _COARSE:
                _fetch_block(coarse, coarse_size, x0, row_u, row_v, texels)
            elif kind[j] == _GROUND:
                _fetch_block(ground, ground_size, x0, row_u, row_v, texels)
            else:
                # The edge of the plate runs through the block: decide by pixel.
                glu = gu[j, 0] + b * (gu[j, 2] - gu[j, 0])
                glv = gv[j, 0] + b * (gv[j, 2] - gv[j, 0])
                gdu = (gu[j, 1] + b * (gu[j, 3] - gu[j, 1]) - glu) * step
                gdv = (gv[j, 1] + b * (gv[j, 3] - gv[j, 1]) - glv) * step
                for x in range(_BLOCK):
                    pu, pv = lu + x * du, lv + x * dv
                    if 0.0 <= pu < last and 0.0 <= pv < last:
                        texels[x0 + x] = coarse[int(pv) * coarse_size + int(pu)]
                    else:
                        pu, pv = glu + x * gdu, glv + x * gdv
                        texels[x0 + x] = ground[int(pv) * ground_size + int(pu)]
                    row_u[x0 + x] = np.uint32(pu * _ONE)
                    row_v[x0 + x] = np.uint32(pv * _ONE)
        _interpolate(texels, row_u, row_v, image[y])


@njit(cache=True, error_model="numpy")
def _smear(padded, border, smear_u, smear_v, out):
    """Mean of the image along the smear; `padded` has `border` px more on each side."""
    height, width = out.shape
    length = math.sqrt(smear_u * smear_u + smear_v * smear_v)
    # Weights of whole-pixel shifts: points along the way, each shared by four pixels.
    side = 2 * border + 1
    weights = np.zeros((side, side), np.float32)
    points = 2 * math.ceil(length) + 1
    for i in range(points):
        s = (i + 0.5) / points - 0.5
        x, y = border + s * smear_u, border + s * smear_v
        ix, iy = int(x), int(y)
        fx, fy = x - ix, y - iy
        weights[iy, ix] += (1.0 - fx) * (1.0 - fy) / points
        weights[iy, ix + 1] += fx * (1.0 - fy) / points
        weights[iy + 1, ix] += (1.0 - fx) * fy / points
        weights[iy + 1, ix + 1] += fx * fy / points
    total = np.empty(width, np.float32)
    for y in range(height):
        total[:] = np.float32(0.5)
        for iy in range(side):
            for ix in range(side):
                weight = weights[iy, ix]
                if weight > np.float32(0.0):
                    source = padded[y + iy, ix : ix + width]
                    for x in range(width):
                        total[x] += weight * np.float32(source[x])
        line = out[y]
        for x in range(width):
            line[x] = np.uint8(total[x])


@njit(cache=True, error_model="numpy")
def _digitise(image, gain, noise, read_variance, shot, out):
    """Light and vignette, noise, saturation."""
    half, zero, top = np.float32(0.5), np.float32(0.0), np.float32(255.0)
    read = np.float32(read_variance / (STEPS * STEPS))
    shots = np.float32(shot / (STEPS * STEPS))
    width = out.shape[1]
    for y in range(out.shape[0]):
        source, gains, normals, line = image[y], gain[y], noise[y], out[y]
        for x in range(width):
            signal = gains[x] * np.float32(source[x])
            value = signal + np.float32(normals[x]) * math.sqrt(read + shots * signal) + half
            line[x] = np.uint8(min(max(value, zero), top))


class PadRenderer:
    """Renders what one camera sees of one pad.

    Parameters
    ----------
    pad : NestedMarker
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    light : float
        Level of the plate's white in the middle of the image, 1 is full scale.
    read_noise : float
        One sigma, grey levels of 255.
    key : np.uint64
        Of the noise, from `systems.signals.noise.stream_key`.
    """

    def __init__(
        self,
        pad: NestedMarker,
        camera: np.ndarray,
        light: float,
        read_noise: float,
        key: np.uint64,
    ):
        self._pad = pad
        self._camera = camera
        self._read_noise = read_noise
        self._key = key
        self._rays = _node_rays(camera)
        self._exact, self._on_pad = np.empty_like(self._rays), np.empty_like(self._rays)
        rows, columns = self._rays.shape[0] - 1, self._rays.shape[1] - 1
        self._drawn = np.empty((_BLOCK * rows, _BLOCK * columns), np.uint8)
        width, height = int(camera[WIDTH]), int(camera[HEIGHT])
        r2 = (np.arange(width)[None, :] - camera[CX]) ** 2 + (
            np.arange(height)[:, None] - camera[CY]
        ) ** 2
        corner = camera[CX] ** 2 + camera[CY] ** 2
        self._gain = (light * (1.0 - VIGNETTE * r2 / corner)).astype(np.float32)

    def render(self, exposure: np.ndarray, frame: int) -> np.ndarray:
        """The image of an exposure, uint8 of shape (height, width).

        Parameters
        ----------
        exposure : array of the layout EXPOSURE
        frame : int
            Number of the frame, for its noise.
        """
        camera = self._camera
        R, p = pad_in_camera(exposure)
        _cut_rays(self._rays, R, p, self._exact, self._on_pad)
        # The depth along the axis at the pad's centre, or where the axis meets its plane.
        u, v = pixel_of_tangents(camera, p[0] / max(p[2], 1e-3), p[1] / max(p[2], 1e-3))
        depth = p[2]
        if not (0.0 <= u < camera[WIDTH] and 0.0 <= v < camera[HEIGHT]):
            depth = R[:, 2] @ p / min(R[2, 2], -1e-2)
        pixel = max(depth, 1e-3) / camera[FX]  # m
        largest_texel = 0.97 * LENS_SIGMA / _EFFECTIVE_SIGMA * pixel
        scale = max(0, math.floor(2.0 * math.log2(largest_texel / _FINEST_TEXEL)))
        whole = scale
        while _plate_texels(self._pad, whole) > _LARGEST_TEXTURE:
            whole += 1
        fine, coarse = _packed_pad_texture(self._pad, scale), _packed_pad_texture(self._pad, whole)
        ground_scale = math.ceil(math.log2(max(pixel / _GROUND_TEXEL, 1e-3)))
        ground_scale = min(max(ground_scale, 0), _GROUND_SCALES - 1)
        anchor = np.array([exposure[_P_WP], exposure[_P_WP + 1], exposure[_YAW]])
        _draw(
            self._on_pad,
            fine,
            math.isqrt(fine.size),
            texel(scale),
            coarse,
            math.isqrt(coarse.size),
            texel(whole),
            _packed_ground(ground_scale),
            _GROUND_TEXEL * 2.0**ground_scale,
            anchor,
            self._drawn,
        )
        image = self._blur(
            max(LENS_SIGMA**2 - (_EFFECTIVE_SIGMA * texel(scale) / pixel) ** 2, 0.0),
            exposure[_SMEAR],
            exposure[_SMEAR + 1],
        )
        out = np.empty(self._gain.shape, np.uint8)
        noise = frame_noise(self._key, frame, *out.shape)
        _digitise(image, self._gain, noise, self._read_noise**2, SHOT_NOISE, out)
        return out

    def _blur(self, variance: float, smear_u: float, smear_v: float) -> np.ndarray:
        """The drawn image with the rest of the lens's blur and the smear."""
        image = self._drawn
        length = math.hypot(smear_u, smear_v)
        if length > _LONGEST_SMEAR:
            smear_u, smear_v = (s * _LONGEST_SMEAR / length for s in (smear_u, smear_v))
            length = _LONGEST_SMEAR
        variance_u = variance_v = variance
        if length > 1.0:
            border = math.ceil(0.5 * length) + 1
            padded = cv2.copyMakeBorder(image, border, border, border, border, cv2.BORDER_REPLICATE)
            image = np.empty_like(self._drawn)
            _smear(padded, border, smear_u, smear_v, image)
        else:
            # A short way and a Gaussian of its variance look the same.
            variance_u += smear_u**2 / 12.0
            variance_v += smear_v**2 / 12.0
        # Three taps have any variance up to 1/2 exactly.
        return cv2.sepFilter2D(
            image,
            -1,
            np.array([0.5 * variance_u, 1.0 - variance_u, 0.5 * variance_u]),
            np.array([0.5 * variance_v, 1.0 - variance_v, 0.5 * variance_v]),
            borderType=cv2.BORDER_REPLICATE,
        )
