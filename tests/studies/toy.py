"""Experiments that cost nothing, for the tests of the campaign engine."""

import math
import os
import signal
import time
from typing import Any

from studies.sampling import hashed_uniform
from studies.study import Study


class Toy:
    """A landing made of three hashes; `overrides` may make it slow, fail or kill its process."""

    def prepare(self, study: Study) -> None:
        self.name = study.name

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, float | int | str | bool]:
        time.sleep(overrides.get("toy.seconds", 0.0))
        if hashed_uniform(seed, "death") < overrides.get("toy.deaths", 0.0):
            os.kill(os.getpid(), signal.SIGKILL)
        if hashed_uniform(seed, "failure") < overrides.get("toy.failures", 0.0):
            raise ArithmeticError("the filter\ndiverged")
        spread = overrides.get("toy.spread", 0.1)
        radius = spread * math.sqrt(-2.0 * math.log(hashed_uniform(seed, "radius")))
        angle = 2.0 * math.pi * hashed_uniform(seed, "angle")
        return {
            "landed": radius < 3.0 * spread,
            "reason": "touchdown" if radius < 3.0 * spread else "tipped",
            "landing_error_m": radius,
            "landing_x_m": radius * math.cos(angle),
            "landing_y_m": radius * math.sin(angle),
            "landing_time_s": 20.0 + 5.0 * hashed_uniform(seed, "time"),
            "attempts": 1 + int(2.0 * hashed_uniform(seed, "attempts")),
            "cpu_s": time.process_time(),
        }


class Unprepared(Toy):
    """Cannot be prepared."""

    def prepare(self, study: Study) -> None:
        raise OSError(f"no beacon in {study.scenario}")


class Wordy(Toy):
    """Gives a column of a kind that no table holds."""

    def run(self, overrides: dict[str, Any], seed: int) -> Any:
        return super().run(overrides, seed) | {"path": [1, 2]}


class Forgetful(Toy):
    """Gives no landing time."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, float | int | str | bool]:
        columns = super().run(overrides, seed)
        del columns["landing_time_s"]
        return columns


class Gentle(Toy):
    """Knows its touchdown speed too."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, float | int | str | bool]:
        speed = 0.3 + 0.2 * hashed_uniform(seed, "speed")
        return super().run(overrides, seed) | {"touchdown_speed_m_s": speed}
