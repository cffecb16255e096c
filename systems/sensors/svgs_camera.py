"""The SVGS camera: a phone that finds the pose of LED beacons, six to fifteen times a second."""

import math
from typing import Annotated, Any, Literal

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues

from plants.svgs_beacons import SvgsBeaconsConfig
from systems.configuration import (
    Finite,
    NonNegative,
    Positive,
    Probability,
    Seconds,
    Vector3,
    configuration,
)
from systems.frames import rotation_matrix
from systems.schedule import CLOCK_PERIOD
from systems.sensors.pad_camera import PadCamera
from systems.signals.measurement import SVGS, no_measurement
from systems.signals.noise import standard_normal, stream_key, uniform
from systems.vision import svgs_selection as selection
from systems.vision.exposure import SMEAR
from systems.vision.pinhole import camera_mount, pinhole_camera
from systems.vision.svgs_blobs import (
    BLOB_SIZE,
    MAXIMUM_BLOBS,
    MAXIMUM_SPOTS,
    SPOT_SIZE,
    add_glints,
    detect_blobs,
    next_gain,
    project_lamps,
    render_spots,
    sample_blobs,
)

_BLOB_COUNT = SVGS.index("blob_count")
# The host's own state: when the next frame begins, exposures of the next and of the last frame.
_NEXT_FRAME, _GAIN, FRAME_GAIN = range(3)
_TRACK = slice(3, 3 + selection.TRACK.size)
_LAST = slice(_TRACK.stop, _TRACK.stop + 24)
_HOST_SIZE = _LAST.stop
_TICK = 1e-9  # s, by which a frame may be early


@configuration
class SvgsCameraConfig:
    """A phone under the vehicle: Samsung Galaxy S8, frames scaled to 800x800 (paper, 2.5.1)."""

    # Sample the blobs from an error model fitted to the images, or render and detect
    fidelity: Literal["pixels", "geometric"] = "geometric"
    # Blob selection as published, or the one that never guesses
    variant: Literal["published", "robust"] = "robust"
    width: Annotated[int, Field(ge=16, le=1024)] = 800  # px
    height: Annotated[int, Field(ge=16, le=1024)] = 800  # px
    focal_length: Positive = 604.0  # px, 67 deg of view
    distortion: Annotated[list[Finite], Field(min_length=4, max_length=4)] = Field(
        default_factory=lambda: [0.0, 0.0, 0.0, 0.0]  # k1, k2, p1, p2; a phone corrects its lens
    )
    # SVGS paper, section 2.4: about 6 to 15 Hz, depending on the number of blobs
    shortest_period: Positive = 1.0 / 15.0  # s, with four blobs or fewer
    longest_period: Positive = 1.0 / 6.0  # s
    period_per_blob: Seconds = 0.007  # s, each further blob; 18 blobs take the longest
    jitter: Probability = 0.1  # of a period, uniform to both sides: Android's scheduling
    longest_exposure: Seconds = 0.008  # s; the auto exposure shortens it
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    yaw: Finite = 0.0  # rad, turn of the camera about z_B; at 0 the image's top is the body's front
    beacons: SvgsBeaconsConfig = Field(default_factory=SvgsBeaconsConfig)
    # False blobs of a beacon's colour at random places, in each frame anew
    random_glints: Annotated[int, Field(ge=0, le=32)] = 0
    glint_beacon: Literal["short", "medium", "long"] = "long"  # whose colour they have
    # The direction of gravity by the phone's own sensors, used by the robust variant
    gravity_bias: NonNegative = 0.005  # rad, one sigma an axis, constant in a run
    gravity_noise: NonNegative = 0.005  # rad, one sigma an axis, white
    # px, one sigma of a centroid for the reported covariance: `svgs_blobs.centroid_noise` between
    # a clear LED and one at the end of its range
    pixel_noise: Positive = 0.04
    gate: Positive = 0.35  # px rms, robust variant: largest residual of the four LEDs
    # Published variant: blobs of a colour for which permutations are allocated, and the largest
    # deviation of a ratio of distances; neither figure is published
    blob_bound: Annotated[int, Field(ge=4, le=MAXIMUM_BLOBS)] = 16
    geometry_tolerance: Positive = 0.2

    def options(self) -> np.ndarray:
        """The options of `svgs_selection.select`."""
        options = np.zeros(selection.OPTIONS)
        options[selection.VARIANT] = selection.VARIANTS.index(self.variant)
        options[selection.PIXEL_NOISE] = self.pixel_noise
        options[selection.GATE] = self.gate
        options[selection.GRAVITY_NOISE] = max(
            np.hypot(self.gravity_bias, self.gravity_noise), 1e-3
        )
        options[selection.PUBLISHED_BOUND] = self.blob_bound
        options[selection.PUBLISHED_TOLERANCE] = self.geometry_tolerance
        return options

    def add_to(self, builder: DiagramBuilder, name: str, seed: int = 0) -> "SvgsCamera":
        """Add an `SvgsCamera` of this configuration to `builder`."""
        return builder.AddNamedSystem(name, SvgsCamera(self, seed))


@njit(cache=True)
def _sensed_up(exposure, bias, noise, key, frame):
    """The direction against gravity in C, turned by a bias (3,) and white noise (rad)."""
    up = rotation_matrix(exposure[:4])[2]
    turn = bias + noise * np.array([standard_normal(key, frame, 2 + i) for i in range(3)])
    sensed = np.array(
        [
            up[0] + turn[1] * up[2] - turn[2] * up[1],
            up[1] + turn[2] * up[0] - turn[0] * up[2],
            up[2] + turn[0] * up[1] - turn[1] * up[0],
        ]
    )
    return sensed / math.sqrt(sensed[0] ** 2 + sensed[1] ** 2 + sensed[2] ** 2)


class SvgsCamera(PadCamera):
    """The Smartphone Video Guidance Sensor: the pose of an LED beacon in the camera's frame.

    .. pydrake_system::

        name: SvgsCamera
        input_ports:
        - body
        - pad
        output_ports:
        - measurement
        - image

    | port | layout | meaning |
    |---|---|---|
    | `body` | `BODY_STATE` | the vehicle's true state |
    | `pad` (optional) | `PAD_STATE` | the pad's; unconnected: at rest in W's origin, yaw 0 |
    | `measurement` | `SVGS` | the pose of one beacon, or an error code |
    | `image` | uint8 array (height, width, 3) | the image behind it: blue, green, red |

    With `fidelity` "pixels" each frame is rendered and its blobs are found
    (`systems.vision.svgs_blobs`); with "geometric" the blobs are sampled from the same spots and
    an error model fitted to the images. Which blobs are a beacon, and its pose, is the same code
    for both (`svgs_selection`, `svgs_pose`), in the published or the robust variant. A frame
    without a pose is a packet with an error code and `valid` = 0.

    The next frame begins when the phone is done with this one, n blobs later:

        period = (1 + jitter · U(−1, 1)) · clip(shortest + period_per_blob (n − 4), …, longest)

    on the grid of CLOCK_PERIOD. The exposure is set for the next frame from the number of saturated
    pixels. `measurement` is valid at the middle of its exposure; processing and transport are a
    `DelayLine` behind the camera. The image is not kept: it is rendered again, in both
    fidelities, from the exposure and the frame's number.

    State: the measurement; the exposure it was made of (EXPOSURE); the phone's clock and
    exposure, the track of the robust variant, the last poses of the published one.

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | a frame, if the phone is ready for one |
    """

    channels = (3,)

    def __init__(self, config: SvgsCameraConfig, seed: int = 0):
        initial = no_measurement(SVGS)
        initial[SVGS.index("beacon")] = -1.0
        initial[SVGS.index("error_code")] = selection.NO_BLOBS
        super().__init__(config, seed, "svgs_camera", initial)
        host = np.zeros(_HOST_SIZE)
        host[_GAIN] = host[FRAME_GAIN] = 1.0
        self.DeclareDiscreteState(host)

    def configure(self, config: SvgsCameraConfig, seed: int = 0) -> None:
        """Take over another configuration and seed; every field may change."""
        self.config = config
        self.camera = pinhole_camera(
            config.width, config.height, config.focal_length, config.distortion
        )
        self.X_BC = camera_mount(config.position, config.yaw)
        self._lamps = config.beacons.lamps()
        self._leds = config.beacons.led_positions()
        self._placements = config.beacons.placements()
        self._colours = config.beacons.colours()
        self._glint_colour = self._colours[("short", "medium", "long").index(config.glint_beacon)]
        self._options = config.options()
        self._key = stream_key(seed, self._stream)
        self._glint_key = stream_key(seed, f"{self._stream}.glints")
        self._host_key = stream_key(seed, f"{self._stream}.host")
        bias = stream_key(seed, f"{self._stream}.gravity_bias")
        self._gravity_bias = config.gravity_bias * np.array(
            [standard_normal(bias, 0, axis) for axis in range(3)]
        )

    def _spots(self, exposure: np.ndarray, gain: float, frame: int) -> tuple[np.ndarray, int]:
        spots = np.empty((MAXIMUM_SPOTS, SPOT_SIZE))
        count = project_lamps(exposure, self._lamps, gain, self.camera, spots)
        if self.config.random_glints:
            count = add_glints(
                spots,
                count,
                self.config.random_glints,
                self._glint_colour,
                self.camera,
                self._glint_key,
                frame,
            )
        return spots, count

    def _render(self, exposure: np.ndarray, gain: float, frame: int) -> np.ndarray:
        spots, count = self._spots(exposure, gain, frame)
        return render_spots(spots, count, exposure[SMEAR], gain, self.camera, self._key, frame)

    def _up(self, exposure: np.ndarray, frame: int) -> np.ndarray:
        """The direction against gravity in C as the phone's sensors say, shape (3,)."""
        return _sensed_up(
            exposure, self._gravity_bias, self.config.gravity_noise, self._host_key, frame
        )

    def _period(self, blobs: float, frame: int) -> float:
        c = self.config
        period = c.shortest_period + c.period_per_blob * (blobs - 4.0)
        period = min(max(period, c.shortest_period), c.longest_period)
        return period * (1.0 + c.jitter * (2.0 * uniform(self._host_key, frame, 0) - 1.0))

    def _update(self, context: Context, values: DiscreteValues) -> None:
        now = context.get_time()
        if now < context.get_discrete_state(2).value()[_NEXT_FRAME] - _TICK:
            return
        host: Any = values.get_mutable_value(2)
        gain = host[FRAME_GAIN] = host[_GAIN]
        exposure, measurement, frame = self._expose(
            context, values, gain * self.config.longest_exposure
        )
        blobs = np.empty((MAXIMUM_BLOBS, BLOB_SIZE))
        if self.config.fidelity == "geometric":
            spots, spot_count = self._spots(exposure, gain, frame)
            smear_u, smear_v = exposure[SMEAR]
            count, saturated = sample_blobs(
                spots,
                spot_count,
                smear_u,
                smear_v,
                gain,
                self.camera,
                self._colours,
                self._key,
                frame,
                blobs,
            )
        else:
            image = self._render(exposure, gain, frame)
            count, saturated = detect_blobs(image, self._colours, blobs)
        host[_GAIN] = next_gain(gain, saturated)
        selection.select(
            blobs,
            count,
            self._leds,
            self._placements,
            self.camera,
            self._up(exposure, frame),
            now,
            frame,
            self._options,
            host[_LAST].reshape(3, 8),
            host[_TRACK],
            measurement,
        )
        # From when this frame was due, not from the tick it fell on: the rate holds on average.
        due = max(host[_NEXT_FRAME], now - CLOCK_PERIOD)
        host[_NEXT_FRAME] = due + self._period(measurement[_BLOB_COUNT], frame)

    def _image(self, context: Context, exposure: np.ndarray, frame: int) -> np.ndarray:
        gain = context.get_discrete_state(2).value()[FRAME_GAIN]
        planes = self._render(exposure, gain, frame)
        return np.ascontiguousarray(np.moveaxis(planes[::-1], 0, -1))
