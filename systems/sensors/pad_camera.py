"""What the cameras under the vehicle share: ports, clock, exposure, an image drawn on demand."""

from typing import Any

import cv2
import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import Context, DiscreteValues, LeafSystem

from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import (
    BODY_STATE,
    PAD_STATE,
    SEQUENCE_NUMBER,
    TIME_OF_ARRIVAL,
    TIME_OF_VALIDITY,
)
from systems.signals.optional_input import optional_input
from systems.vision.exposure import EXPOSURE, expose

# OpenCV's threads save no time on images this small; they only burn a second core.
cv2.setNumThreads(1)

_PAD_AT_ORIGIN = PAD_STATE.zeros()


class PadCamera(LeafSystem):
    """A camera under the vehicle, with ports `body`, `pad` (optional), `measurement` and `image`.

    It looks at its clock on every tick. A subclass documents its ports and defines
    `configure`, which sets `config`, `camera` and `X_BC`; `_update`, which takes a frame with
    `_expose` if one is due; and `_image`. The image is not kept: it is rendered again when
    somebody asks, from the exposure and the frame's number.

    State: the measurement; the exposure it was made of (EXPOSURE).

    Attributes
    ----------
    camera : array of shape (10,)
        See `systems.vision.pinhole`.
    X_BC : array of shape (3, 4)
        The camera's mount.
    channels : tuple of int
        What follows height and width in the image's shape.
    """

    camera: np.ndarray
    X_BC: np.ndarray
    channels: tuple[int, ...] = ()

    def __init__(self, config: Any, seed: int, stream: str, initial: np.ndarray):
        super().__init__()
        self._stream = stream
        self.configure(config, seed)
        self._body = self.DeclareVectorInputPort("body", BODY_STATE.size).Eval
        pad = self.DeclareVectorInputPort("pad", PAD_STATE.size)
        self._pad = optional_input(pad, _PAD_AT_ORIGIN)
        measurement = self.DeclareDiscreteState(initial)
        self.DeclareDiscreteState(EXPOSURE.zeros())
        self.DeclareStateOutputPort("measurement", measurement)
        self.DeclareAbstractOutputPort(
            "image",
            lambda: Value(np.zeros((0, 0, *self.channels), dtype=np.uint8)),
            self._calc_image,
            prerequisites_of_calc={self.xd_ticket()},
        )
        self.DeclarePeriodicDiscreteUpdateEvent(CLOCK_PERIOD, 0.0, self._update)

    def configure(self, config: Any, seed: int) -> None:
        """Take over another configuration and seed."""
        raise TypeError(f"{type(self).__name__} does not say how it is configured")

    def _update(self, context: Context, values: DiscreteValues) -> None:
        raise TypeError(f"{type(self).__name__} does not say what it does on its clock")

    def _image(self, context: Context, exposure: np.ndarray, frame: int) -> np.ndarray:
        """The image of an exposure, shape (height, width, *channels)."""
        raise TypeError(f"{type(self).__name__} does not say how its image is rendered")

    def _expose(
        self, context: Context, values: DiscreteValues, exposure_time: float
    ) -> tuple[np.ndarray, np.ndarray, int]:
        """Take a frame whose exposure (s) ends now.

        Returns the exposure, the measurement with its times and sequence number, and the latter.
        """
        now = context.get_time()
        exposure: Any = values.get_mutable_value(1)
        body, pad = self._body(context), self._pad(context)
        expose(body, pad, self.X_BC, self.camera, exposure_time, exposure)
        measurement: Any = values.get_mutable_value(0)
        frame = int(measurement.item(SEQUENCE_NUMBER)) + 1
        measurement[TIME_OF_VALIDITY] = now - 0.5 * exposure_time
        measurement[TIME_OF_ARRIVAL] = now
        measurement[SEQUENCE_NUMBER] = frame
        return exposure, measurement, frame

    def _calc_image(self, context: Context, output: Value) -> None:
        frame = int(context.get_discrete_state(0).value()[SEQUENCE_NUMBER])
        if frame < 0:  # before the first frame
            shape = self.config.height, self.config.width, *self.channels
            output.set_value(np.zeros(shape, dtype=np.uint8))
        else:
            exposure = context.get_discrete_state(1).value()
            output.set_value(self._image(context, exposure, frame))
