"""What the fixed wing's sensors share: a sample clock, a delay, an output that stands.

A sensor looks at its clock every `look` seconds, samples every `period`, and
lets each measurement out `delay` seconds later; one without delay and with a period
of whole seconds is woken for its samples only. Its model is one pure compiled
function of the aircraft's state, so a sensor's file holds that function, its
configuration and little else.

Constant errors (biases, misalignments) are drawn once a run from the seed by
the spread that the configuration declares, as the Monte Carlo simulations of
the thesis do (Leonard 2016, 5.3): a campaign is one scenario and many seeds.
"""

import math
from typing import Any

import numpy as np
from pydrake.systems.framework import LeafSystem

from systems.configuration import StructureChangedError, require_same_structure
from systems.runway_frames import RunwayConfig
from systems.signals.measurement import Layout, no_measurement
from systems.signals.noise import standard_normals, stream_key
from systems.signals.runway_measurement import (
    FIXED_WING_STATE,
    NAVIGATION_PERIOD,
    enqueue,
    release,
)


def turn_on(seed: int, stream: str, spreads: list[float]) -> np.ndarray:
    """The constant errors of one run: N(0, spread²) each, shape (len(spreads),)."""
    return standard_normals(stream_key(seed, f"{stream}.turn_on"), 0, len(spreads)) * spreads


class RunwaySensor(LeafSystem):
    """A sensor of the aircraft's state with a sample clock and a delay.

    A subclass sets the class attributes and defines `_draw`, which turns
    configuration and seed into the flat parameters of the model, and `_sample`.

    Attributes
    ----------
    layout : Layout
        Of the measurement.
    stream : str
        Name of its noise.
    look : float
        s, period of the event; `period` and `delay` are counted in it.
    capacity : int
        Measurements that can be under way.
    """

    layout: Layout
    stream: str
    look: float = NAVIGATION_PERIOD
    capacity: int = 16

    def __init__(self, config: Any, seed: int = 0, runway: RunwayConfig | None = None):
        super().__init__()
        self._config = config
        self._event_period = self.look
        self.configure(config, seed, runway)
        self._state = self.DeclareVectorInputPort("state", FIXED_WING_STATE.size).Eval
        output = self.DeclareDiscreteState(no_measurement(self.layout))
        self.DeclareDiscreteState(2 + self.capacity * (self.layout.size + 1))
        self.DeclareStateOutputPort("measurement", output)
        # whole seconds lie on every grid, and without delay there is nothing to do in between
        seldom = self._delay == 0.0 and config.period == round(config.period)
        self._event_period = config.period if seldom else self.look
        self.DeclarePeriodicDiscreteUpdateEvent(self._event_period, 0.0, self._update)

    def configure(self, config: Any, seed: int, runway: RunwayConfig | None = None) -> None:
        """Take a new configuration of the same period, a seed and a runway."""
        require_same_structure(self._config, config, "period")
        if getattr(config, "delay", 0.0) > 0.0 and self._event_period > self.look:
            raise StructureChangedError(
                f"{type(config).__name__}.delay was 0 s in the diagram, where this sensor wakes "
                f"every {self._event_period:g} s only: build a new diagram"
            )
        self._config = config
        self._every = max(round(config.period / self.look), 1)
        self._delay = getattr(config, "delay", 0.0)
        # looks after a sample: at it, and when a measurement comes out
        self._awake = {0, math.ceil((self._delay - 1e-9) / self.look) % self._every}
        self._runway = runway or RunwayConfig()
        self._key = stream_key(seed, self.stream)
        self._parameters = np.asarray(self._draw(config, seed), dtype=float)

    @property
    def model(self) -> tuple[np.ndarray, np.uint64, float, int]:
        """Parameters of one run, noise key, delay (s) and looks between two samples."""
        return self._parameters, self._key, self._delay, self._every

    def _draw(self, config: Any, seed: int) -> np.ndarray:
        raise TypeError(f"{type(self).__name__} does not say how its parameters are drawn")

    def _sample(self, state: np.ndarray, time: float, index: int) -> np.ndarray:
        raise TypeError(f"{type(self).__name__} does not say how it samples")

    def _update(self, context, discrete_state):
        time = context.get_time()
        index, since = divmod(round(time / self.look), self._every)
        if since not in self._awake:
            return
        output = discrete_state.get_mutable_value(0)
        if self._delay == 0.0:
            output[:] = self._sample(self._state(context), time, index)
            return
        pipeline = discrete_state.get_mutable_value(1)
        if since == 0:
            enqueue(pipeline, self._sample(self._state(context), time, index), time + self._delay)
        release(pipeline, output, time)
