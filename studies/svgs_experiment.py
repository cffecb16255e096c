"""The experiment of the SVGS studies: a landing beside beacons that must not be landed on."""

import math
from typing import Any

import numpy as np

from diagrams.loading import with_overrides
from diagrams.scenario import MultirotorLanding
from plants.vehicles import Vehicle
from studies.landing_experiment import LandingExperiment


class SvgsExperiment(LandingExperiment):
    """`LandingExperiment` with one column more, `clearance_m`."""

    def run(self, overrides: dict[str, Any], seed: int) -> dict[str, Any]:
        """Fly once.

        Parameters
        ----------
        overrides : dict
            Dotted field paths of the scenario and their values.
        seed : int
            Of all noise of the run.

        Returns
        -------
        dict
            The columns of `LandingExperiment`, and `clearance_m`, from the tips of the landed
            vehicle's propellers to the nearest LED; negative: it stands on it, nan: no LEDs.
        """
        row = super().run(overrides, seed)
        flown = with_overrides(self._scenario, overrides)
        row["clearance_m"] = clearance(flown, np.array([row["landing_x_m"], row["landing_y_m"]]))
        return row


def reach(vehicle: Vehicle) -> float:
    """Radius of the circle that holds a vehicle, propellers and all, m."""
    return max(math.hypot(x, y) for x, y, _ in vehicle.rotor_positions) + vehicle.rotor_radius


def clearance(scenario: MultirotorLanding, offset: np.ndarray) -> float:
    """Free room between a landed vehicle and the LEDs; see `SvgsBeaconsConfig.clearance`.

    Parameters
    ----------
    scenario : MultirotorLanding
    offset : array of shape (2,)
        Where the vehicle stands, from the pad's centre, m in W.

    Returns
    -------
    float
        m; nan where the scenario has no SVGS beacons.
    """
    channel = scenario.sensors.svgs_camera
    if channel is None:
        return math.nan
    c, s = math.cos(scenario.pad.yaw), math.sin(scenario.pad.yaw)
    in_pad = np.array([[c, s], [-s, c]]) @ offset
    return channel.sensor.beacons.clearance(in_pad, reach(scenario.vehicle.resolved_vehicle()))
