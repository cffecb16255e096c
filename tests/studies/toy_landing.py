"""A landing that costs nothing and misses by a known rule, for the tests of the searches."""

import math
import signal
from typing import Any

from studies.sampling import hashed_uniform
from studies.study import Study


class ToyLanding:
    """Misses by 0.1 m, and by more with wind and latency together; luck adds up to 10 %.

    error = 0.1 + (speed / 7)^2 + (speed / 7) (latency / 0.25) m, and with more than 0.8 lost at
    random it does not land.
    """

    patience = 0.8

    def prepare(self, study: Study) -> None:
        pass

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        wind = overrides.get("wind.speed", 0.0) / 7.0
        latency = overrides.get("sensors.marker_camera.latency.transport", 0.0) / 0.25
        faults = overrides.get("sensors.marker_camera.faults.faults", [])
        drops = sum(fault.get("probability", 0.0) for fault in faults)
        luck = 1.0 + 0.1 * hashed_uniform(overrides["seed"], "luck")
        error = luck * (0.1 + wind**2 + wind * latency)
        landed = drops <= self.patience
        return {
            "landed": landed,
            "reason": "landed" if landed else "time limit: still flying",
            "took_off": True,
            "landing_error_m": error,
            "landing_x_m": error,
            "landing_y_m": 0.0,
            "landing_time_s": 20.0 if landed else math.nan,
            "landing_started_s": 30.0,
            "touchdown_speed_m_s": 0.4,
            "attempts": 1,
            "simulated_s": 60.0,
        }


class Broken(ToyLanding):
    """Fails in strong wind."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        if overrides.get("wind.speed", 0.0) > 7.0:
            raise ArithmeticError("the filter diverged")
        return super().run(overrides, seed)


class Grounded(ToyLanding):
    """Never flies."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        raise ArithmeticError("no hands")


class Impatient(ToyLanding):
    """Presses Ctrl-C at the fortieth flight."""

    flown = 0

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        Impatient.flown += 1
        if Impatient.flown == 40:
            signal.raise_signal(signal.SIGINT)
        return super().run(overrides, seed)
