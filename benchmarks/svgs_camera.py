"""What the SVGS camera is worth: `python -m benchmarks.svgs_camera [GLINT_FRAMES]`.

Prints the error of its pose beside the Cramér-Rao bound over height, how often it is right and
wrong among glints of the beacon's colour, published against robust, and what a frame costs.
"""

import sys
import time
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from pydrake.systems.framework import Context

from plants.svgs_beacons import BEACON_NAMES, BEACONS
from systems.frames import (
    quaternion_from_rotation_vector,
    quaternion_from_yaw,
    quaternion_multiply,
    rotation_matrix,
)
from systems.schedule import CLOCK_PERIOD
from systems.sensors.svgs_camera import FRAME_GAIN, SvgsCamera, SvgsCameraConfig
from systems.signals.measurement import BODY_STATE, SVGS
from systems.vision.exposure import SMEAR
from systems.vision.pinhole import pixel_of_tangents
from systems.vision.planar_pose import quaternion_from_matrix
from systems.vision.svgs_blobs import (
    BLOOM,
    BLOOM_SIGMA,
    FULL_SCALE,
    MAXIMUM_SPOTS,
    READ_NOISE,
    SHOT_NOISE,
    SPOT_DISC,
    SPOT_PEAK,
    SPOT_RED,
    SPOT_SIGMA,
    SPOT_SIZE,
    SPOT_U,
    SPOT_V,
    background,
    project_lamps,
)
from systems.vision.svgs_pose import cramer_rao

Fidelity = Literal["pixels", "geometric"]
VARIANTS: tuple[Literal["published", "robust"], ...] = ("published", "robust")
HEIGHTS = (10.0, 20.0, 50.0, 85.0, 100.0, 150.0, 200.0)  # m
GLINTS = (0, 1, 4, 8, 12)
FRAMES = 200  # a height
GLINT_FRAMES = 400  # a number of glints and a variant
GLINT_HEIGHT = 150.0  # m, where only the long-range beacon is in view
_RIGHT = 2.0  # px: all four blobs used are LEDs of the beacon

_BLOB = SVGS.index("led_0_u")
_P = SVGS.slice("p_CT")


@dataclass
class Frames:
    """What became of the frames of one flight.

    Attributes
    ----------
    errors : list of arrays of shape (3,)
        m in C, of the right poses.
    bounds : list of arrays of shape (3,)
        m, one sigma by the Cramér-Rao bound, of the same poses.
    right, wrong, count : int
        Poses on LEDs, poses on other blobs, frames.
    costs : list of float
        s of CPU, each frame.
    beacons : array of shape (3,)
        How often each beacon was used.
    """

    errors: list = field(default_factory=list)
    bounds: list = field(default_factory=list)
    right: int = 0
    wrong: int = 0
    count: int = 0
    costs: list = field(default_factory=list)
    beacons: np.ndarray = field(default_factory=lambda: np.zeros(BEACONS, int))


def body_in_wind(time_s: float, height: float, phase: np.ndarray) -> np.ndarray:
    """A vehicle that sways by 2.5 degrees and up to 2 m over the beacons: a BODY_STATE."""
    tilt = 0.045 * np.array([np.sin(0.9 * time_s + phase[0]), np.sin(1.1 * time_s + phase[1]), 0.0])
    heading = quaternion_from_yaw(0.3 * np.sin(0.1 * time_s + phase[2]))
    body = BODY_STATE.zeros()
    body[:4] = quaternion_multiply(heading, quaternion_from_rotation_vector(tilt))
    over = np.array([-1.7, 0.0]) if height <= 20.0 else np.array([-3.2, -1.5])
    sway = np.array([np.sin(0.3 * time_s + phase[3]), np.cos(0.3 * time_s + phase[4])])
    body[BODY_STATE.slice("p_WB")] = [*(over + min(2.0, 0.1 * height) * sway), height]
    rate = [0.041 * np.cos(0.9 * time_s + phase[0]), 0.05 * np.cos(1.1 * time_s + phase[1]), 0.0]
    body[BODY_STATE.slice("w_WB_B")] = rate
    return body


def led_pixels(camera: SvgsCamera, exposure: np.ndarray, beacon: int) -> np.ndarray:
    """Where the LEDs of a beacon are in the image, px, shape (4, 2)."""
    leds = camera.config.beacons.beacons()[beacon].led_positions_in_pad()
    p_C = (leds - exposure[4:7]) @ rotation_matrix(exposure[:4])
    return np.array([pixel_of_tangents(camera.camera, x / z, y / z) for x, y, z in p_C])


def centroid_bound(spot: np.ndarray, smear: np.ndarray, gain: float) -> np.ndarray:
    """The Cramér-Rao bound of where a spot is: one sigma of u and v, px, shape (2,).

    Each pixel of each colour tells of it as far as its light changes with it, against read noise,
    shot noise and the rounding to whole grey levels; a saturated pixel tells nothing.

    Parameters
    ----------
    spot : array of shape (SPOT_SIZE,)
        See `systems.vision.svgs_blobs.project_lamps`.
    smear : array of shape (2,)
        px, the way of the image during the exposure.
    gain : float
        Exposure time as a fraction of the longest.
    """
    peak, disc = spot[SPOT_PEAK], spot[SPOT_DISC]
    reach = int(np.ceil(disc + 4.0 * BLOOM_SIGMA + 0.5 * np.abs(smear).max()))
    grid = np.arange(-reach, reach + 1.0)

    def light(u: float, v: float) -> np.ndarray:
        total = np.zeros((grid.size, grid.size))
        parts = np.linspace(-0.5, 0.5, 9)
        for part in parts:
            du = grid[np.newaxis, :] - (u + part * smear[0])
            dv = grid[:, np.newaxis] - (v + part * smear[1])
            d = np.maximum(np.hypot(du, dv) - disc, 0.0)
            total += (1.0 - BLOOM) * np.exp(-0.5 * (d / SPOT_SIGMA) ** 2)
            total += BLOOM * np.exp(-0.5 * (d / BLOOM_SIGMA) ** 2)
        return peak / parts.size * total

    u, v = spot[SPOT_U] % 1.0, spot[SPOT_V] % 1.0
    h = 1e-3  # px
    slopes = np.stack(
        [
            (light(u + h, v) - light(u - h, v)) / (2.0 * h),
            (light(u, v + h) - light(u, v - h)) / (2.0 * h),
        ]
    )
    information = np.zeros((2, 2))
    for colour in spot[SPOT_RED : SPOT_RED + 3]:
        signal = colour * light(u, v)
        variance = READ_NOISE**2 + SHOT_NOISE * signal + 1.0 / 12.0
        weight = np.where(background(gain) + signal < FULL_SCALE, colour**2 / variance, 0.0)
        information += np.einsum("iyx,jyx,yx->ij", slopes, slopes, weight)
    return np.sqrt(np.diag(np.linalg.inv(information)))


def step(camera: SvgsCamera, context: Context, body: np.ndarray) -> float:
    """One frame; returns its cost, s of CPU."""
    camera.GetInputPort("body").FixValue(context, body)
    values = camera.AllocateDiscreteVariables()
    values.SetFrom(context.get_discrete_state())
    begin = time.process_time()
    camera._update(context, values)
    cost = time.process_time() - begin
    context.SetDiscreteState(values)
    return cost


def fly(config: SvgsCameraConfig, height: float, frames: int, seed: int = 1) -> Frames:
    """Frames of a swaying vehicle at one height."""
    camera = SvgsCamera(config, seed)
    context = camera.CreateDefaultContext()
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 5)
    result = Frames()
    now = 0.0
    for _ in range(frames):
        context.SetTime(now)
        result.costs.append(step(camera, context, body_in_wind(now, height, phase)))
        result.count += 1
        measurement = context.get_discrete_state(0).value()
        exposure = context.get_discrete_state(1).value()
        due = context.get_discrete_state(2).value()[0]
        now = np.ceil(due / CLOCK_PERIOD - 1e-9) * CLOCK_PERIOD
        view = SVGS(measurement)
        if not view.valid:
            continue
        beacon = int(view.beacon)
        result.beacons[beacon] += 1
        used = measurement[_BLOB : _BLOB + 8].reshape(4, 2)
        if np.abs(used - led_pixels(camera, exposure, beacon)).max() > _RIGHT:
            result.wrong += 1
            continue
        result.right += 1
        R_WC = rotation_matrix(exposure[:4])
        placement = config.beacons.placements()[beacon]
        true = R_WC.T @ (placement[:3] - exposure[4:7])
        R_CT = R_WC.T @ rotation_matrix(quaternion_from_yaw(placement[3]))
        result.errors.append(measurement[_P] - true)
        gain = context.get_discrete_state(2).value()[FRAME_GAIN]
        spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
        count = project_lamps(exposure, camera._lamps, gain, camera.camera, spots)
        pixels = led_pixels(camera, exposure, beacon)
        apart = np.linalg.norm(spots[np.newaxis, :count, :2] - pixels[:, np.newaxis], axis=2)
        of_led = spots[np.argmin(apart, axis=1)]
        noise = np.array([centroid_bound(spot, exposure[SMEAR], gain) for spot in of_led])
        pose = np.concatenate([true, quaternion_from_matrix(R_CT)])
        leds = config.beacons.beacons()[beacon].led_positions()
        bound = cramer_rao(leds, pose, noise.ravel() / config.focal_length)
        result.bounds.append(np.sqrt(np.diag(bound)[:3]))
    return result


def accuracy_table(fidelity: Fidelity = "pixels", frames: int = FRAMES) -> list[str]:
    """Rows of text: error of the pose over height, beside the bound at the centroids' noise."""
    rows = [
        f"{'height':>7} {'beacon':>7} {'poses':>6} {'lateral':>9} {'bound':>9} "
        f"{'range':>9} {'bound':>9} {'range':>8}",
        f"{'m':>7} {'':>7} {'%':>6} {'mm rms':>9} {'mm':>9} {'mm rms':>9} {'mm':>9} {'%':>8}",
    ]
    for height in HEIGHTS:
        flown = fly(SvgsCameraConfig(fidelity=fidelity), height, frames)
        error = np.sqrt(np.mean(np.square(flown.errors), axis=0))
        bound = np.sqrt(np.mean(np.square(flown.bounds), axis=0))
        rows.append(
            f"{height:7.0f} {BEACON_NAMES[int(np.argmax(flown.beacons))]:>7} "
            f"{100.0 * flown.right / flown.count:6.1f} "
            f"{1e3 * np.hypot(*error[:2]):9.2f} {1e3 * np.hypot(*bound[:2]):9.2f} "
            f"{1e3 * error[2]:9.2f} {1e3 * bound[2]:9.2f} {100.0 * error[2] / height:8.3f}"
        )
    return rows


def glint_table(fidelity: Fidelity = "geometric", frames: int = GLINT_FRAMES) -> list[str]:
    """Rows of text: right and wrong poses over the number of glints of the beacon's colour."""
    rows = [f"{'glints':>7} {'variant':>10} {'right %':>8} {'wrong %':>8} {'none %':>8}"]
    for glints in GLINTS:
        for variant in VARIANTS:
            config = SvgsCameraConfig(
                fidelity=fidelity, variant=variant, random_glints=glints, glint_beacon="long"
            )
            flown = fly(config, GLINT_HEIGHT, frames)
            right, wrong = 100.0 * flown.right / frames, 100.0 * flown.wrong / frames
            rows.append(
                f"{glints:7d} {variant:>10} {right:8.1f} {wrong:8.1f} {100.0 - right - wrong:8.1f}"
            )
    return rows


def frame_cost(frames: int = FRAMES) -> float:
    """Median CPU time (s) of a frame in pixels with four LEDs in view: render, detect, solve."""
    flown = fly(SvgsCameraConfig(fidelity="pixels"), GLINT_HEIGHT, frames)
    return float(np.median(flown.costs))


def main(glint_frames: int = GLINT_FRAMES) -> None:
    """Print the tables."""
    print("SVGS camera, pixels: error of the pose beside the Cramér-Rao bound")
    print("\n".join(accuracy_table()))
    print(f"\nSVGS camera at {GLINT_HEIGHT:.0f} m among glints of the beacon's colour")
    print("\n".join(glint_table(frames=glint_frames)))
    print(f"\nA frame in pixels, 4 LEDs in view: {1e3 * frame_cost():.2f} ms of CPU, median")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
