"""All-weather camera with real pixels, and the tracker that holds the point in them."""

import math
from typing import Literal

import numpy as np
from pydrake.common.value import Value
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import NonNegative, configuration
from systems.runway_frames import RunwayConfig
from systems.sensors.runway_camera import RunwayCameraConfig, camera_parameters, camera_sample
from systems.sensors.runway_tracker import RunwayTrackerConfig
from systems.signals.measurement import no_measurement
from systems.signals.noise import standard_normals, stream_key
from systems.signals.runway_measurement import (
    FIXED_WING_STATE,
    PICTURE,
    PICTURE_PERIOD,
    enqueue,
    release,
)
from systems.vision.runway_picture import draw_picture
from systems.vision.runway_point_tracker import follow_point

_CAPACITY = 32
_WINDOW = (120, 160)  # rows and columns about the tracked point, the square of Fig. 10
_KEEP = 0.9  # a key picture serves until the distance has shrunk to this share
_KEY = 3  # memory: point (u, v; NaN not locked), clicks, then of the key picture:
# the point (u, v), the picture's index and the aircraft's state


def initial_memory() -> np.ndarray:
    """Not locked, no click, no key picture."""
    memory = np.zeros(_KEY + 3 + FIXED_WING_STATE.size)
    memory[:2] = math.nan
    return memory


@configuration
class RunwayPixelCameraConfig(RunwayCameraConfig):
    """The camera of `RunwayCameraConfig`, drawn."""

    kind: Literal["pixels"] = "pixels"  # type: ignore[assignment]
    grain: NonNegative = 2.0  # grey levels of 255, one sigma of each pixel

    def add_to(
        self,
        builder: DiagramBuilder,
        name: str,
        seed: int,
        runway: RunwayConfig | None = None,
        tracker: RunwayTrackerConfig | None = None,
    ) -> "RunwayPixelCamera":
        """Add camera and tracker to a builder."""
        return builder.AddNamedSystem(name, RunwayPixelCamera(self, seed, runway, tracker))


class RunwayPixelCamera(LeafSystem):
    """Camera, operator and tracker: the runway drawn, clicked at, and followed.

    .. pydrake_system::

        name: RunwayPixelCamera
        input_ports:
        - state
        output_ports:
        - measurement
        - image

    | port | layout | meaning |
    |---|---|---|
    | state | FIXED_WING_STATE | the aircraft |
    | measurement | PICTURE | the tracked point; valid while locked |
    | image | array of uint8, (rows, columns) | the whole picture now, for looking at |

    At the distances of the tracker's configuration the operator points at the
    touch-down point, with an error (Leonard 2016, 2.3); from picture to picture
    `systems.vision.runway_point_tracker` carries the point on, always from the same
    key picture until that has become too different: errors add up only from one key
    picture to the next. A picture is a pure function of the aircraft's state, so the
    state holds the aircraft of the key picture instead of the picture. Latencies as in
    the geometric camera and tracker. The coarse aircraft rolls at once, by more from
    one picture to the next than the tracker can follow: fly the lagged one with pixels.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 0 | draws, follows, lets out after the latencies |
    """

    def __init__(
        self,
        config: RunwayPixelCameraConfig,
        seed: int = 0,
        runway: RunwayConfig | None = None,
        tracker: RunwayTrackerConfig | None = None,
    ):
        super().__init__()
        self.configure(config, seed, runway, tracker)
        self._state = self.DeclareVectorInputPort("state", FIXED_WING_STATE.size)
        output = self.DeclareDiscreteState(no_measurement(PICTURE))
        self._pipeline = self.DeclareDiscreteState(2 + _CAPACITY * (PICTURE.size + 1))
        self._memory = self.DeclareDiscreteState(initial_memory())
        self.DeclareStateOutputPort("measurement", output)
        self.DeclareAbstractOutputPort(
            "image", lambda: Value(np.zeros((1, 1), np.uint8)), self._calc_image
        )
        self.DeclarePeriodicDiscreteUpdateEvent(PICTURE_PERIOD, 0.0, self._update)

    def configure(
        self,
        config: RunwayPixelCameraConfig,
        seed: int,
        runway: RunwayConfig | None = None,
        tracker: RunwayTrackerConfig | None = None,
    ) -> None:
        """Take a new camera, tracker, seed and runway."""
        runway = runway or RunwayConfig()
        self._tracker = tracker or RunwayTrackerConfig()
        self._config = config
        self._parameters = camera_parameters(config, seed)
        self._runway = np.array([runway.heading_radians, runway.width, runway.length])
        self._grain_key = stream_key(seed, "runway_pixel_camera.grain")
        self._click_key = stream_key(seed, "runway_tracker")

    def picture(self, state, index, corner, shape):
        """A window of the picture of an aircraft's state, see `draw_picture`."""
        p = self._parameters
        return draw_picture(
            np.array(state[:3]), np.array(state[6:9]), p[4:7], p[7:10], p[:4], self._runway,
            corner, shape, self._config.grain, self._grain_key, index,
        )  # fmt: skip

    def _calc_image(self, context, output):
        index = round(context.get_time() / PICTURE_PERIOD)
        shape = (int(self._config.rows), int(self._config.columns))
        output.set_value(self.picture(self._state.Eval(context), index, (0, 0), shape))

    def _follow(self, memory, state, index):
        """The tracked point in this picture, carried there from the key picture."""
        rows, columns = _WINDOW
        key_u, key_v = memory[_KEY : _KEY + 2]
        key_corner = (round(key_u) - columns // 2, round(key_v) - rows // 2)
        corner = (round(memory[0]) - columns // 2, round(memory[1]) - rows // 2)
        before = self.picture(memory[_KEY + 3 :], int(memory[_KEY + 2]), key_corner, _WINDOW)
        after = self.picture(state, index, corner, _WINDOW)
        # Eq. 14 counts from the pixel's edge, OpenCV from its centre
        point = (key_u - key_corner[0] - 0.5, key_v - key_corner[1] - 0.5)
        moved = follow_point(before, after, point)
        if moved is None:
            return math.nan, math.nan
        return moved[0] + corner[0] + 0.5, moved[1] + corner[1] + 0.5

    def _track(self, memory, message, state, index, distance):
        """Click, follow, or lose the point: `memory` in place."""
        clicks = sum(distance <= click for click in self._tracker.clicks)
        renew = False
        if message[3] == 0.0 or distance < self._tracker.loss_distance:
            memory[:2] = math.nan
        elif clicks > memory[2]:
            error = standard_normals(self._click_key, 1000000 + clicks, 2)
            memory[:2] = message[4:6] + self._tracker.click_spread * error
            memory[2] = clicks
            renew = True
        elif not math.isnan(memory[0]):
            memory[:2] = self._follow(memory, state, index)
            key_distance = math.hypot(memory[_KEY + 3], memory[_KEY + 4])
            renew = not math.isnan(memory[0]) and distance < _KEEP * key_distance
        if renew:
            memory[_KEY : _KEY + 2] = memory[:2]
            memory[_KEY + 2] = index
            memory[_KEY + 3 :] = state

    def _update(self, context, discrete_state):
        time = context.get_time()
        index = round(time / PICTURE_PERIOD)
        state = self._state.Eval(context)
        memory = discrete_state.get_mutable_value(self._memory)
        pipeline = discrete_state.get_mutable_value(self._pipeline)
        message = camera_sample(state, time, index, self._parameters)
        self._track(memory, message, state, index, math.hypot(state[0], state[1]))
        message[3] = 0.0 if math.isnan(memory[0]) else 1.0
        message[4:6] = np.nan_to_num(memory[:2])
        message[6] = memory[2]
        ready = max(time, message[0]) + self._tracker.delay
        enqueue(pipeline, message, ready)
        release(pipeline, discrete_state.get_mutable_value(0), time)
