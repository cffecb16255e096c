"""Computer vision: the tracker that holds the touch-down point in the picture."""

import math

import numpy as np
from numba import njit
from pydantic import Field
from pydrake.systems.framework import DiagramBuilder, LeafSystem

from systems.configuration import (
    Metres,
    NonNegative,
    Probability,
    Seconds,
    Vector2,
    Vector3,
    configuration,
)
from systems.runway_frames import RunwayConfig
from systems.signals.measurement import no_measurement
from systems.signals.noise import standard_normals, stream_key, uniform
from systems.signals.runway_measurement import (
    ACT_OFFSET,
    FIXED_WING_STATE,
    PICTURE,
    PICTURE_PERIOD,
    enqueue,
    release,
)

PICTURES_UNDER_WAY = 32  # at most; the newest is lost beyond


@configuration
class RunwayTrackerConfig:
    """A tracker that an operator points at the touch-down point two or three times (2.3)."""

    # m from the touch-down point: where the operator points at it, the farthest first
    clicks: Vector3 = Field(default_factory=lambda: [4500.0, 2000.0, 800.0])
    click_spread: NonNegative = 1.5  # px, one sigma of the operator's error, b_k of (15)
    noise: NonNegative = 1.0  # px, one sigma of the tracking, n_k of (15)
    loss_distance: Metres = 90.0  # m, nearer the tracker cannot hold the point any more (2.3)
    delay: Seconds = 0.0  # s, L_ci: compression and image analysis, about 0.2 s (6.4)
    # a fault: between two distances the tracker sits on something else
    false_lock: Vector2 = Field(default_factory=lambda: [0.0, 0.0])  # px, off the point
    false_lock_from: Metres = 0.0  # m, farther end
    false_lock_until: Metres = 0.0  # m, nearer end
    outlier_probability: Probability = 0.0  # of a picture with a match anywhere within 50 px

    def add_to(
        self, builder: DiagramBuilder, name: str, seed: int, runway: RunwayConfig | None = None
    ) -> "RunwayTracker":
        """Add the tracker to a builder."""
        return builder.AddNamedSystem(name, RunwayTracker(self, seed, runway))


@njit(cache=True)
def track(picture, distance, time, parameters, key):
    """What the tracker makes of one picture, shape (7,).

    Parameters
    ----------
    picture : array, shape (7,)
        Layout `PICTURE`: where the point really is.
    distance : float
        From the touch-down point, m.
    time : float
        s.
    parameters : array, shape (11,)
        Distances of the clicks (3), click error, noise (px), distance of loss,
        false lock (2, px), its two distances (m), probability of an outlier.
    key : np.uint64
    """
    found = picture.copy()
    clicked = 0
    while clicked < 3 and distance <= parameters[clicked]:
        clicked += 1
    if clicked == 0 or distance < parameters[5]:
        found[3] = 0.0
        return found
    found[6] = clicked
    index = int(picture[2])
    bias = standard_normals(key, 1000000 + clicked, 2)
    noise = standard_normals(key, index, 2)
    wrong = 0.0
    if parameters[9] < distance < parameters[8]:
        wrong = 1.0
    for axis in range(2):
        found[4 + axis] += parameters[3] * bias[axis] + parameters[4] * noise[axis]
        found[4 + axis] += wrong * parameters[6 + axis]
    if uniform(key, index, 8) < parameters[10]:
        found[4] += 100.0 * (uniform(key, index, 9) - 0.5)
        found[5] += 100.0 * (uniform(key, index, 10) - 0.5)
    return found


class RunwayTracker(LeafSystem):
    """The vision chain between camera and filter (Leonard 2016, Eq. 15).

    .. pydrake_system::

        name: RunwayTracker
        input_ports:
        - picture
        - state
        output_ports:
        - measurement

    | port | layout | meaning |
    |---|---|---|
    | picture | PICTURE | where the touch-down point is in the camera's picture |
    | state | FIXED_WING_STATE | the aircraft, for the distances at which the operator acts |
    | measurement | PICTURE | where the tracker says it is; valid while locked |

    P_k^Tracking = P_{k−τ}^Picture + b_k + n_k: b_k is the operator's error, a new
    one at every click, n_k white. Locked from the first click until the point is
    too near, while it is inside the picture. The time of validity stays the one
    that the camera stamped.

    | event | when | does |
    |---|---|---|
    | update | every 40 ms from 5 ms | takes the new picture, lets out after `delay` |
    """

    def __init__(
        self, config: RunwayTrackerConfig, seed: int = 0, runway: RunwayConfig | None = None
    ):
        super().__init__()
        self.configure(config, seed)
        self._picture = self.DeclareVectorInputPort("picture", PICTURE.size).Eval
        self._state = self.DeclareVectorInputPort("state", FIXED_WING_STATE.size).Eval
        output = self.DeclareDiscreteState(no_measurement(PICTURE))
        self.DeclareDiscreteState(2 + PICTURES_UNDER_WAY * (PICTURE.size + 1))
        self.DeclareStateOutputPort("measurement", output)
        self.DeclarePeriodicDiscreteUpdateEvent(PICTURE_PERIOD, ACT_OFFSET, self._update)

    def configure(
        self, config: RunwayTrackerConfig, seed: int, runway: RunwayConfig | None = None
    ) -> None:
        """Take a new configuration and seed; the runway does not matter to it."""
        self._config = config
        self._key = stream_key(seed, "runway_tracker")
        self._parameters = np.array(
            [
                *config.clicks,
                config.click_spread,
                config.noise,
                config.loss_distance,
                *config.false_lock,
                config.false_lock_from,
                config.false_lock_until,
                config.outlier_probability,
            ]
        )

    @property
    def model(self) -> tuple[np.ndarray, np.uint64, float]:
        """Parameters of one run, noise key and delay (s)."""
        return self._parameters, self._key, self._config.delay

    def _update(self, context, discrete_state):
        picture = self._picture(context)
        pipeline = discrete_state.get_mutable_value(1)
        time = context.get_time()
        if picture[2] + 1.0 > pipeline[0]:  # a sequence number not seen yet
            pipeline[0] = picture[2] + 1.0
            state = self._state(context)
            distance = math.hypot(state[0], state[1])
            found = track(picture, distance, time, self._parameters, self._key)
            # the picture leaves the camera at its time stamp, the tracker `delay` later
            enqueue(pipeline, found, max(time, picture[0]) + self._config.delay)
        if pipeline[1] > 0.0:
            release(pipeline, discrete_state.get_mutable_value(0), time)
