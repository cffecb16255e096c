"""The infrared camera, an IR-LOCK: directions of up to five bright spots, 50 times a second."""

from typing import Annotated, Literal

import numpy as np
from pydantic import Field
from pydrake.systems.framework import Context, DiagramBuilder, DiscreteValues

from systems.configuration import (
    Finite,
    Metres,
    NonNegative,
    Positive,
    Seconds,
    Vector3,
    configuration,
)
from systems.schedule import CLOCK_PERIOD
from systems.sensors.pad_camera import PadCamera
from systems.signals.measurement import (
    INFRARED,
    INFRARED_BLOBS,
    TIME_OF_VALIDITY,
    no_measurement,
)
from systems.signals.noise import stream_key
from systems.vision.exposure import is_due
from systems.vision.infrared_blobs import (
    MAXIMUM_SPOTS,
    THRESHOLD,
    black_level,
    detect_blobs,
    project_spots,
    render_spots,
    write_blobs,
    write_geometric_blobs,
)
from systems.vision.pinhole import camera_mount, pinhole_camera


@configuration
class FalseBeacon:
    """A lamp or a glint of the sun that is not the beacon."""

    position: Vector3 = Field(default_factory=lambda: [3.0, 0.0, 0.0])  # m, W
    strength: NonNegative = 1.0  # 1, brightness relative to the beacon
    start_time: Seconds = 0.0  # s, when it begins to shine
    end_time: Seconds | None = None  # s; null never


@configuration
class InfraredCameraConfig:
    """An IR-LOCK: a Pixy of 320x200 pixels behind an infrared filter, and its MarkOne beacon."""

    # Project the beacons, or render and detect
    fidelity: Literal["pixels", "geometric"] = "geometric"
    width: Annotated[int, Field(ge=16, le=4096)] = 320  # px
    height: Annotated[int, Field(ge=16, le=4096)] = 200  # px
    pixel_angle: Positive = 0.003  # rad a pixel in the middle of the image
    frame_rate: Annotated[float, Field(gt=0.0, le=1.0 / CLOCK_PERIOD)] = 50.0  # 1/s
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    yaw: Finite = 0.0  # rad, turn of the camera about z_B; at 0 the image's top is the body's front
    # Report whole pixels, as the Pixy does, or the centroid
    quantised: bool = True
    beacon_position: Vector3 = Field(
        default_factory=lambda: [0.0, 0.0, 0.0]
    )  # m, P, from its centre
    # m, at which the beacon is just seen: MarkOne 15, MarkOne V3 40 to 55 (SVGS paper, section 4)
    maximum_range: Positive = 15.0
    lamp_radius: Metres = 0.02  # m, of the beacon's array of diodes
    noise: NonNegative = 2.0  # grey levels of 255, one sigma
    false_beacons: Annotated[list[FalseBeacon], Field(max_length=MAXIMUM_SPOTS - 1)] = Field(
        default_factory=list
    )

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "InfraredCamera":
        """Add an `InfraredCamera`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, InfraredCamera(self, seed, stream=name))


class InfraredCamera(PadCamera):
    """A camera under the vehicle that reports the brightest infrared spots.

    .. pydrake_system::

        name: InfraredCamera
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
    | `measurement` | `INFRARED` | up to five blobs, the largest first, the beacon or not |
    | `image` | uint8 array (height, width) | the image behind the measurement |

    A lamp's image and what becomes of it are described in `systems.vision.infrared_blobs`.
    With `fidelity` "pixels" each frame is rendered and its blobs are found; with "geometric"
    the pixels of each spot above the threshold are counted instead. An image without a blob
    is a measurement with `valid` = 0. The exposure is taken as short. Processing and
    transport are a `DelayLine` behind the camera. The image is not kept: it is rendered
    again, in both fidelities, from the exposure's pose and the frame's number.

    State: the measurement; the exposure it was made of (EXPOSURE).

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | a frame, if one is due by its rate |

    So frames fall on the 20 ms grid, the first at 0, `frame_rate` a second on average
    (`systems.vision.exposure.is_due`).

    Parameters
    ----------
    config : InfraredCameraConfig
    seed : int
    stream : str
        The name of the random stream; cameras that share it under one seed err alike.
    """

    def __init__(
        self, config: InfraredCameraConfig, seed: int = 0, *, stream: str = "infrared_camera"
    ):
        super().__init__(config, seed, stream, no_measurement(INFRARED))

    def configure(self, config: InfraredCameraConfig, seed: int) -> None:
        """Take over another configuration and seed; every field may change."""
        self.config = config
        self.camera = pinhole_camera(config.width, config.height, 1.0 / config.pixel_angle)
        self.X_BC = camera_mount(config.position, config.yaw)
        self._key = stream_key(seed, self._stream)
        self._beacon = np.array(config.beacon_position)
        self._false_beacons = np.array(
            [[*lamp.position, lamp.strength] for lamp in config.false_beacons]
        ).reshape(-1, 4)
        self._shining = np.array(
            [
                [lamp.start_time, np.inf if lamp.end_time is None else lamp.end_time]
                for lamp in config.false_beacons
            ]
        ).reshape(-1, 2)

    def _lamps(self, time: float) -> np.ndarray:
        """The false beacons that shine at `time` (s)."""
        if not len(self._shining):
            return self._false_beacons
        shines = (self._shining[:, 0] <= time) & (time < self._shining[:, 1])
        return self._false_beacons[shines]

    def _render(self, exposure: np.ndarray, frame: int, time: float) -> np.ndarray:
        config = self.config
        spots = np.empty((MAXIMUM_SPOTS, 4))
        count = project_spots(
            exposure,
            self._beacon,
            self._lamps(time),
            config.lamp_radius,
            config.maximum_range,
            self.camera,
            spots,
        )
        return render_spots(spots, count, self.camera, config.noise, self._key, frame)

    def _update(self, context: Context, values: DiscreteValues) -> None:
        config = self.config
        now = context.get_time()
        if not is_due(now, config.frame_rate):
            return
        exposure, measurement, frame = self._expose(context, values, 0.0)
        if config.fidelity == "geometric":
            write_geometric_blobs(
                exposure,
                self._beacon,
                self._lamps(now),
                config.lamp_radius,
                config.maximum_range,
                self.camera,
                config.quantised,
                self._key,
                frame,
                measurement,
            )
        else:
            blobs = np.empty((INFRARED_BLOBS, 3))
            image = self._render(exposure, frame, now)
            count = detect_blobs(
                image, THRESHOLD + black_level(config.noise), config.quantised, blobs
            )
            write_blobs(blobs, count, self.camera, measurement)

    def _image(self, context: Context, exposure: np.ndarray, frame: int) -> np.ndarray:
        time = context.get_discrete_state(0).value()[TIME_OF_VALIDITY]
        return self._render(exposure, frame, time)
