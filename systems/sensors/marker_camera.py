"""The marker camera: looks down at a nested marker on the pad, 30 frames a second."""

from typing import Annotated, Literal

import cv2
import numpy as np
from pydantic import Field
from pydrake.common.value import Value
from pydrake.systems.framework import (
    Context,
    DiagramBuilder,
    DiscreteValues,
    LeafSystem,
)

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
from systems.signals.measurement import (
    BODY_STATE,
    MARKER,
    MARKER_LEVELS,
    PAD_STATE,
    SEQUENCE_NUMBER,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
    no_measurement,
)
from systems.signals.noise import stream_key
from systems.signals.optional_input import optional_input
from systems.vision.exposure import EXPOSURE, expose, is_due
from systems.vision.marker_error_model import write_geometric_detection, write_marker_detection
from systems.vision.nested_marker import NestedMarker, NestedMarkerDetector
from systems.vision.pinhole import camera_mount, pinhole_camera
from systems.vision.rendering import PadRenderer

# OpenCV's threads save no time on images this small; they only burn a second core.
cv2.setNumThreads(1)

_PAD_AT_ORIGIN = PAD_STATE.zeros()


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


class MarkerCamera(LeafSystem):
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

    | event | period | offset | does |
    |---|---|---|---|
    | discrete update | 20 ms | 0 | a frame, if one is due by its rate |

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
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        pad = self.DeclareVectorInputPort("pad", PAD_STATE.size)
        self._pad = optional_input(pad, _PAD_AT_ORIGIN)
        measurement = self.DeclareDiscreteState(no_measurement(MARKER))
        self.DeclareDiscreteState(EXPOSURE.zeros())
        self.DeclareStateOutputPort("measurement", measurement)
        self.DeclareAbstractOutputPort(
            "image",
            lambda: Value(np.zeros((0, 0), dtype=np.uint8)),
            self._calc_image,
            prerequisites_of_calc={self.xd_ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(CLOCK_PERIOD, 0.0, self._update)

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

    def _detect(self, exposure: np.ndarray, measurement: np.ndarray) -> None:
        if self._detector is None:
            self._detector = NestedMarkerDetector(self.pad_pattern, self.camera)
        image = self._render(exposure, int(measurement[SEQUENCE_NUMBER]))
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
        now = context.get_time()
        if not is_due(now, config.frame_rate):
            return
        exposure = values.get_mutable_value(1)
        expose(
            self._body(context),
            self._pad(context),
            self.X_BC,
            self.camera,
            config.exposure_time,
            exposure,
        )
        measurement = values.get_mutable_value(0)
        measurement[TIME_OF_VALIDITY] = now - 0.5 * config.exposure_time
        measurement[TIME_OF_ARRIVAL] = now
        measurement[SEQUENCE_NUMBER] += 1.0
        if config.fidelity == "geometric":
            write_geometric_detection(
                exposure,
                self._sides,
                self.camera,
                config.light,
                config.read_noise,
                self._key,
                int(measurement[SEQUENCE_NUMBER]),
                measurement,
            )
        else:
            self._detect(exposure, measurement)

    def _calc_image(self, context: Context, output: Value) -> None:
        frame = int(context.get_discrete_state(0).value()[SEQUENCE_NUMBER])
        if frame < 0:  # before the first frame
            output.set_value(np.zeros((self.config.height, self.config.width), dtype=np.uint8))
        else:
            exposure = context.get_discrete_state(1).value()
            output.set_value(self._render(exposure, frame))
