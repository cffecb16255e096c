"""The marker camera: looks down at a nested marker on the pad, 30 frames a second."""

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
from systems.signals.measurement import MARKER, MARKER_LEVELS, no_measurement
from systems.signals.noise import stream_key
from systems.vision.exposure import is_due
from systems.vision.marker_error_model import write_geometric_detection, write_marker_detection
from systems.vision.nested_marker import NestedMarker, NestedMarkerDetector
from systems.vision.pinhole import camera_mount, pinhole_camera
from systems.vision.rendering import PadRenderer


@configuration
class MarkerCameraConfig:
    """A global-shutter camera of 640x480 pixels that looks down at the pad."""

    # Project pixels through an error model fitted to the images, or render and detect
    fidelity: Literal["pixels", "geometric"] = "geometric"
    width: Annotated[int, Field(ge=16, le=4096)] = 640  # px
    height: Annotated[int, Field(ge=16, le=4096)] = 480  # px
    focal_length: Positive = 530.0  # px
    # k1, k2, p1, p2 of Brown's model
    distortion: Annotated[list[Finite], Field(min_length=4, max_length=4)] = Field(
        default_factory=lambda: [-0.05, 0.01, 0.0, 0.0]
    )
    frame_rate: Annotated[float, Field(gt=0.0, le=1.0 / CLOCK_PERIOD)] = 30.0  # 1/s
    exposure_time: Seconds = 0.004  # s
    position: Vector3 = Field(default_factory=lambda: [0.0, 0.0, -0.05])  # m, p_BC
    yaw: Finite = 0.0  # rad, turn of the camera about z_B; at 0 the image's top is the body's front
    # The nested marker on the pad, outermost level first: ids of DICT_4X4_1000, sides
    marker_ids: Annotated[list[int], Field(min_length=1, max_length=MARKER_LEVELS)] = Field(
        default_factory=lambda: [16, 45, 59]
    )
    marker_sides: Annotated[list[Positive], Field(min_length=1, max_length=MARKER_LEVELS)] = Field(
        default_factory=lambda: [0.8, 0.16, 0.032]  # m
    )
    plate_side: Metres = 1.2  # m, of the white plate that the marker is printed on
    light: Positive = 0.75  # 1, the plate's white in the image; 1 is full scale, more saturates
    read_noise: NonNegative = 1.2  # grey levels of 255, one sigma

    def add_to(self, builder: DiagramBuilder, name: str, seed: int) -> "MarkerCamera":
        """Add a `MarkerCamera`; `name` also names its random stream."""
        return builder.AddNamedSystem(name, MarkerCamera(self, seed, stream=name))


class MarkerCamera(PadCamera):
    """A camera under the vehicle that finds the nested marker on the pad.

    .. pydrake_system::

        name: MarkerCamera
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
    | `measurement` | `MARKER` | corners, bearing, range and both attitudes of the pad |
    | `image` | uint8 array (height, width) | the image behind the measurement |

    With `fidelity` "pixels" each frame is rendered (`systems.vision.rendering`), its markers
    are found (`nested_marker`) and their corners refined (`corner_lines`); with "geometric"
    the true corners are projected and disturbed by an error model fitted to the same images
    (`marker_error_model`). The rest is the same: the largest level found gives both planar
    poses, the bearing b_C and the range r of the pad's centre (`planar_pose`),

        p_CP = r b_C

    A frame without a detection is a measurement with `valid` = 0. `measurement` is valid at
    the middle of its exposure, for which pose and velocity are taken back from the exposure's
    end, and leaves the camera at that end. Processing and transport are a `DelayLine` behind
    it. The image is not kept: it is rendered again, in both fidelities, from the exposure's
    pose and the frame's number.

    State: the measurement; the exposure it was made of (EXPOSURE).

    | event | when | does |
    |---|---|---|
    | update | every 20 ms from 0 | a frame, if one is due by its rate |

    So frames fall on the 20 ms grid, the first at 0, `frame_rate` a second on average
    (`systems.vision.exposure.is_due`).

    Parameters
    ----------
    config : MarkerCameraConfig
    seed : int
    stream : str
        The name of the random stream; cameras that share it under one seed err alike.
    """

    def __init__(self, config: MarkerCameraConfig, seed: int = 0, *, stream: str = "marker_camera"):
        super().__init__(config, seed, stream, no_measurement(MARKER))

    def configure(self, config: MarkerCameraConfig, seed: int) -> None:
        """Take over another configuration and seed; every field may change.

        Raises
        ------
        ValueError
            If the marker's levels do not fit into each other.
        """
        self.config = config
        self.pad_pattern = NestedMarker(
            tuple(config.marker_ids), tuple(config.marker_sides), config.plate_side
        )
        self.camera = pinhole_camera(
            config.width, config.height, config.focal_length, config.distortion
        )
        self.X_BC = camera_mount(config.position, config.yaw)
        self._sides = self.pad_pattern.padded_sides()
        self._key = stream_key(seed, self._stream)
        self._renderer: PadRenderer | None = None
        self._detector: NestedMarkerDetector | None = None

    def _render(self, exposure: np.ndarray, frame: int) -> np.ndarray:
        if self._renderer is None:
            self._renderer = PadRenderer(
                self.pad_pattern,
                self.camera,
                self.config.light,
                self.config.read_noise,
                self._key,
            )
        return self._renderer.render(exposure, frame)

    def _detect(self, exposure: np.ndarray, frame: int, measurement: np.ndarray) -> None:
        if self._detector is None:
            self._detector = NestedMarkerDetector(self.pad_pattern, self.camera)
        image = self._render(exposure, frame)
        corners = np.empty((MARKER_LEVELS, 4, 2))
        self._detector.detect(image, corners)
        write_marker_detection(
            corners,
            exposure,
            self._sides,
            self.camera,
            self.config.light,
            self.config.read_noise,
            measurement,
        )

    def _update(self, context: Context, values: DiscreteValues) -> None:
        config = self.config
        if not is_due(context.get_time(), config.frame_rate):
            return
        exposure, measurement, frame = self._expose(context, values, config.exposure_time)
        if config.fidelity == "geometric":
            write_geometric_detection(
                exposure,
                self._sides,
                self.camera,
                config.light,
                config.read_noise,
                self._key,
                frame,
                measurement,
            )
        else:
            self._detect(exposure, frame, measurement)

    def _image(self, context: Context, exposure: np.ndarray, frame: int) -> np.ndarray:
        return self._render(exposure, frame)
