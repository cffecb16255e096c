"""Fit the marker camera's error model to rendered images.

Run `python -m benchmarks.fit_marker_error_model`.
Renders and detects markers of random size, tilt, place, smear and light, then
finds the constants of `systems.vision.marker_error_model` by maximum
likelihood and prints them, ready to be put there. Takes a few minutes.
"""

import argparse
from dataclasses import dataclass

import cv2
import numpy as np
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from systems.signals.measurement import MARKER_LEVELS
from systems.signals.noise import stream_key
from systems.vision import marker_error_model as model
from systems.vision.exposure import EXPOSURE, SMEAR, pad_in_camera
from systems.vision.nested_marker import NestedMarker, NestedMarkerDetector
from systems.vision.pinhole import FX, HEIGHT, WIDTH, pinhole_camera, tangents_of_pixel
from systems.vision.rendering import BLACK, LENS_SIGMA, SHOT_NOISE, PadRenderer

PAD = NestedMarker((16, 45, 59), (0.8, 0.16, 0.032), 1.2)
CAMERA = pinhole_camera(640, 480, 530.0, (-0.05, 0.01, 0.0, 0.0))
READ_NOISE = 1.2  # grey levels
_LIGHTS = np.geomspace(0.09, 3.5, 25)
_LARGEST_TILT = np.deg2rad(25.0)
_BORDER = 5.0  # px


@dataclass
class Observation:
    """One marker wholly in one image, and what became of it."""

    side: float  # px, the shortest
    smear: float  # px
    light: float  # at the marker
    found: bool
    across: np.ndarray  # (4,) px, smear along each side's normal
    shifts: np.ndarray  # (4, 2) px, outward shift of both ends of each side; NaN if not found


def random_exposure(
    rng: np.random.Generator, level: int, side: float, smear: float
) -> tuple[np.ndarray, np.ndarray]:
    """An exposure that shows a level wholly with sides of about `side` px, and its corners."""
    depth = PAD.sides[level] * CAMERA[FX] / side
    corners = np.empty((4, 2))
    while True:
        axis, tilt = rng.uniform(0.0, 2.0 * np.pi), _LARGEST_TILT * np.sqrt(rng.uniform())
        R_WC = (
            Rotation.from_euler("x", np.pi)
            * Rotation.from_rotvec(tilt * np.array([np.cos(axis), np.sin(axis), 0.0]))
            * Rotation.from_euler("z", rng.uniform(-np.pi, np.pi))
        )
        u, v = rng.uniform(_BORDER, [CAMERA[WIDTH] - _BORDER, CAMERA[HEIGHT] - _BORDER])
        p_CP = depth * np.array([*tangents_of_pixel(CAMERA, u, v), 1.0])
        direction = rng.uniform(0.0, 2.0 * np.pi)
        exposure = EXPOSURE.zeros()
        exposure[EXPOSURE.slice("q_WC")] = np.roll(R_WC.as_quat(), 1)
        exposure[EXPOSURE.slice("p_WC")] = -R_WC.apply(p_CP)
        exposure[SMEAR] = smear * np.array([np.cos(direction), np.sin(direction)])
        R, p = pad_in_camera(exposure)
        inside = model.project_corners(R, p, PAD.sides[level], CAMERA, corners) and np.all(
            (corners > _BORDER) & (corners < CAMERA[[WIDTH, HEIGHT]] - 1.0 - _BORDER)
        )
        if inside:
            return exposure, corners


def side_shifts(true: np.ndarray, found: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Outward normals (4, 2) of the sides and how far their ends were shifted (4, 2), px."""
    along = np.roll(true, -1, axis=0) - true
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    normals = np.column_stack([along[:, 1], -along[:, 0]])
    errors = found - true
    ends = np.stack([errors, np.roll(errors, -1, axis=0)], axis=1)
    return normals, np.einsum("kei,ki->ke", ends, normals)


def observe(
    rng: np.random.Generator,
    renderers: dict[float, PadRenderer],
    detector: NestedMarkerDetector,
    side: float,
    smear: float,
    light: float,
    frame: int,
) -> Observation:
    """Render one marker and look for it."""
    levels = [level for level in range(MARKER_LEVELS) if level > 0 or side > 15.0]
    level = int(rng.choice(levels))
    exposure, true = random_exposure(rng, level, side, smear)
    if light not in renderers:
        key = stream_key(0, "fit_marker_error_model")
        renderers[light] = PadRenderer(PAD, CAMERA, light, READ_NOISE, key)
    found = np.empty((MARKER_LEVELS, 4, 2))
    detector.detect(renderers[light].render(exposure, frame), found)
    normals, shifts = side_shifts(true, found[level])
    return Observation(
        side=model.shortest_side(true),
        smear=smear,
        light=model.local_light(CAMERA, true, light),
        # What lies far off was read by chance and is not this marker.
        found=bool(np.nanmax(np.abs(shifts), initial=0.0) < 5.0 and not np.isnan(shifts).any()),
        across=normals @ exposure[SMEAR],
        shifts=shifts,
    )


def observations(count: int, seed: int) -> list[Observation]:
    """`count` markers at each smear of the model's table."""
    rng = np.random.Generator(np.random.PCG64(seed))
    renderers: dict[float, PadRenderer] = {}
    detector = NestedMarkerDetector(PAD, CAMERA)
    result = []
    for smear in model.SMEAR:
        for frame in range(count):
            side = float(np.exp(rng.uniform(np.log(9.0), np.log(320.0))))
            plain = rng.uniform() < 0.5
            light = float(
                rng.choice(_LIGHTS[(_LIGHTS > 0.35) & (_LIGHTS < 0.95)] if plain else _LIGHTS)
            )
            result.append(observe(rng, renderers, detector, side, smear, light, frame))
    return result


def fit_probability(data: list[Observation]) -> dict[str, np.ndarray]:
    """Slopes and medians of the probability of detection."""
    side, smear, light = (
        np.array([getattr(o, name) for o in data]) for name in ("side", "smear", "light")
    )
    found = np.array([o.found for o in data])
    node = np.searchsorted(model.SMEAR, smear)
    count = model.SMEAR.size

    def split(x: np.ndarray) -> tuple[np.ndarray, ...]:
        return np.exp(x[:3]), *np.exp(x[3:]).reshape(3, count)

    def cost(x: np.ndarray) -> float:
        slopes, sides, dim, bright = split(x)
        p = 1.0
        for slope, ratio in zip(
            slopes, (side / sides[node], light / dim[node], bright[node] / light), strict=True
        ):
            p = p / (1.0 + ratio**-slope)
        p = np.clip(p, 1e-4, 1.0 - 1e-3)  # a few are lost for reasons outside of the model
        prior = np.sum((x - start) ** 2) * 0.05  # holds medians that the data do not reach
        return -float(np.sum(np.log(np.where(found, p, 1.0 - p)))) + prior

    start = np.log(
        np.concatenate(
            [
                [model.SIDE_SLOPE, model.DIM_SLOPE, model.BRIGHT_SLOPE],
                model.SIDE_50,
                model.DIM_50,
                model.BRIGHT_50,
            ]
        )
    )
    slopes, sides, dim, bright = split(minimize(cost, start, method="L-BFGS-B").x)
    return {
        "SIDE_SLOPE, DIM_SLOPE, BRIGHT_SLOPE": slopes,
        "SIDE_50": sides,
        "DIM_50": dim,
        "BRIGHT_50": bright,
    }


def fit_sides(data: list[Observation]) -> dict[str, np.ndarray]:
    """Bias and noise of the sides: first without saturation, then what saturation adds."""
    data = [o for o in data if o.found]
    side = np.repeat([o.side for o in data], 4)
    light = np.repeat([o.light for o in data], 4)
    across = np.concatenate([o.across for o in data])
    shifts = np.concatenate([o.shifts for o in data])
    blur = np.sqrt(LENS_SIGMA**2 + across**2 / 12.0)
    kappa = np.array([model.saturation_shift(value) for value in light])
    step = 255.0 * (np.minimum(light, 1.0) - BLACK * light)
    profiles = np.minimum(side, model.LARGEST_SIDE)
    noise = blur * (READ_NOISE**2 + 1.0 / 12.0 + 0.5 * SHOT_NOISE * step) / (step**2 * profiles)
    mean = shifts.mean(axis=1)
    half_difference = 0.5 * (shifts[:, 0] - shifts[:, 1])

    def cost(plain: np.ndarray, saturated: np.ndarray, used: np.ndarray) -> float:
        a, b, floor, n, c, d = np.exp(plain[1:])
        k, m, common, twist = np.exp(saturated)
        saturation = kappa * np.sqrt((k * LENS_SIGMA) ** 2 + m**2 * across**2 / 12.0)
        bias = plain[0] + a * blur * np.exp(-side / (b * blur)) + saturation
        crowding = c * blur * np.exp(-side / (d * blur))
        variance = (floor * blur) ** 2 + n**2 * noise + crowding**2 + (twist * saturation) ** 2
        of_mean = variance * 0.5 * (1.0 + model.LINE_CORRELATION) + (common * saturation) ** 2
        of_difference = variance * 0.5 * (1.0 - model.LINE_CORRELATION)
        total = 0.0
        for error, var in ((mean - bias, of_mean), (half_difference, of_difference)):
            # Student's t with 5 degrees of freedom: a stray side does not rule the fit.
            terms = 0.5 * np.log(var) + 3.0 * np.log1p(error**2 / (3.0 * var))
            total += float(np.sum(terms[used]))
        return total

    plain = np.array(
        [
            model.BIAS,
            *np.log([model.SIZE_BIAS, model.SIZE_BIAS_SCALE, model.FLOOR, model.NOISE]),
            *np.log([model.SIZE_NOISE, model.SIZE_NOISE_SCALE]),
        ]
    )
    saturated = np.log([model.SATURATION, model.SATURATION_SMEAR, model.COMMON, model.TWIST])
    plain = minimize(lambda x: cost(x, saturated, light <= 1.0), plain, method="Nelder-Mead",
                     options={"maxiter": 3000, "adaptive": True}).x  # fmt: skip
    saturated = minimize(lambda x: cost(plain, x, light > 1.0), saturated, method="Nelder-Mead").x
    return {
        "BIAS": plain[:1],
        "SIZE_BIAS, SIZE_BIAS_SCALE": np.exp(plain[1:3]),
        "FLOOR, NOISE": np.exp(plain[3:5]),
        "SIZE_NOISE, SIZE_NOISE_SCALE": np.exp(plain[5:7]),
        "SATURATION, SATURATION_SMEAR": np.exp(saturated[:2]),
        "COMMON, TWIST": np.exp(saturated[2:]),
    }


def main() -> None:
    """Fit and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--count", type=int, default=900, help="markers for each smear")
    parser.add_argument("--seed", type=int, default=1)
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    data = observations(arguments.count, arguments.seed)
    found = sum(o.found for o in data)
    print(f"# {len(data)} markers, {found} found")
    for name, values in (fit_sides(data) | fit_probability(data)).items():
        numbers = ", ".join(f"{value:.4g}" for value in values)
        print(f"{name} = np.array([{numbers}])" if name.endswith("50") else f"{name} = {numbers}")


if __name__ == "__main__":
    main()
