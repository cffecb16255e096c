"""A flight to replay in open loop: the lagged aircraft in turbulence, guided by true positions.

The thesis replays a flight recorded with GPS, which fed the flight controller
with real positions (Leonard 2016, 6.1). This is its stand-in: the same
kernels that fly in closed loop, in one compiled loop, with the truth in the
estimate's place.
"""

import numpy as np
import pandas as pd
from numba import njit

from plants.fixed_wing import FixedWingConfig
from plants.fixed_wing_dynamics import advance, trimmed_state
from plants.recorded_flight import FLIGHT_COLUMNS
from plants.terrain import Terrain
from systems.controllers.fixed_wing_flight_controller import (
    FixedWingFlightControllerConfig,
    control,
)
from systems.runway_frames import RunwayConfig, ned_from_runway
from systems.signals.noise import stream_key
from systems.signals.runway_measurement import (
    ATTITUDE_PERIOD,
    GUIDANCE,
    NAVIGATION_ESTIMATE,
    NAVIGATION_PERIOD,
)
from systems.supervisors.runway_phases import Phase

_IN_THE_AIR = float(Phase.FINAL)
_BRAKING = float(Phase.BRAKING)

# the wind at 20 ft of MIL-F-8785C's light turbulence is 15 kn
TURBULENT_AIRCRAFT = FixedWingConfig(dynamics="lagged", turbulence_wind=7.7)


@njit(cache=True)
def _fly(
    state,
    memory,
    parameters,
    terrain,
    geometry,
    key,
    waypoints,
    heading,
    profile,
    gains,
    deceleration,
    guidance,
    estimate,
    samples,
    dt,
):
    command = np.zeros(4)
    rows = 0
    for k in range(2 * samples.shape[0]):
        if k % 2 == 0:
            samples[rows, 0] = k * dt
            samples[rows, 1:10] = state[:9]
            rows += 1
            if state[14] > 0.0 and state[3] == 0.0 and state[4] == 0.0:
                break
            estimate[2:11] = state[:9]
            phase = _BRAKING if state[14] > 0.0 else _IN_THE_AIR
            control(
                command,
                guidance,
                estimate,
                phase,
                waypoints,
                heading,
                profile,
                gains,
                deceleration,
                2.0 * dt,
            )
        advance(state, memory, command, parameters, terrain, geometry, key, dt)
    return rows


def reference_flight(
    controller: FixedWingFlightControllerConfig,
    runway: RunwayConfig,
    terrain: Terrain,
    seed: int,
    aircraft: FixedWingConfig = TURBULENT_AIRCRAFT,
    longest: float = 1800.0,
) -> pd.DataFrame:
    """Fly from the aircraft's start to a standstill, guided by the truth.

    Returns
    -------
    DataFrame
        One row each 20 ms with the columns `FLIGHT_COLUMNS` (angles in rad), as
        `plants.recorded_flight.read_flight` returns them.
    """
    grid = terrain.grid(runway)
    heading = runway.heading_radians
    parameters = aircraft.parameters(seed)
    state, memory = trimmed_state(
        ned_from_runway(np.array(aircraft.start), heading),
        heading + np.radians(aircraft.start_course),
        aircraft.start_vertical_speed,
        parameters,
        grid.values,
        grid.geometry,
    )
    samples = np.empty((round(longest / NAVIGATION_PERIOD), 10))
    rows = _fly(
        state,
        memory,
        parameters,
        grid.values,
        grid.geometry,
        stream_key(seed, "fixed_wing.gust"),
        controller.route.waypoints_n(runway),
        heading,
        controller.route.profile.vector(controller.speed, controller.gear),
        controller.gains.vector(),
        controller.gains.deceleration,
        GUIDANCE.zeros(),
        NAVIGATION_ESTIMATE.zeros(),
        samples,
        ATTITUDE_PERIOD,
    )
    flight = pd.DataFrame(samples[:rows], columns=list(FLIGHT_COLUMNS))
    flight["yaw"] = np.unwrap(flight["yaw"])
    return flight
