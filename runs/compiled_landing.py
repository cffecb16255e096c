"""A landing without GPS in one compiled loop: the diagram's kernels in the diagram's order.

A Drake event costs some ten microseconds whatever it does, and this vehicle has seven
hundred a second; the arithmetic is a thirtieth of that. Studies of thousands of landings
take this way. `tests/runs/test_compiled_landing.py` holds it to the diagram.
"""

import dataclasses
import math
from typing import Any

import numpy as np
from numba import njit

from diagrams.landing_without_gps import LandingWithoutGpsScenario
from diagrams.loading import ScenarioError
from plants.fixed_wing_dynamics import advance
from plants.recorded_flight import interpolate_flight
from runs.landing_without_gps import RunwayLaboratory, landing_numbers
from runs.run import laboratory
from systems.controllers.fixed_wing_flight_controller import control
from systems.estimators import runway_error_filter_kernel as thesis
from systems.estimators import runway_improved_filter_kernel as improved
from systems.estimators.runway_record import END, PASSAGE, note
from systems.sensors.runway_airspeed import airspeed_sample
from systems.sensors.runway_antenna import antenna_sample
from systems.sensors.runway_baro_inertial import baro_inertial_sample
from systems.sensors.runway_camera import camera_sample
from systems.sensors.runway_gps import fix_sample
from systems.sensors.runway_heading import heading_sample
from systems.sensors.runway_inertial_drift import inertial_sample
from systems.sensors.runway_laser import laser_sample
from systems.sensors.runway_tracker import track
from systems.sensors.runway_wheel_encoder import wheel_sample
from systems.signals.measurement import no_measurement
from systems.signals.runway_measurement import (
    ACT_OFFSET,
    AIRSPEED_AT,
    ANTENNA_AT,
    BARO_AT,
    FIX_AT,
    FIXED_WING_STATE,
    GUIDANCE,
    HEADING_AT,
    LASER_AT,
    MEASUREMENTS_END,
    NAVIGATION_ESTIMATE,
    PHASE_AT,
    PICTURE,
    PICTURE_AT,
    WHEELS_AT,
    enqueue,
    no_measurements,
    release,
)

_TICK = 0.01  # s
_SENSORS = (
    "inertial",
    "baro",
    "gps",
    "antenna",
    "camera",
    "tracker",
    "laser",
    "heading",
    "wheel_encoder",
    "airspeed",
)


@njit(cache=True)
def _pipeline(layout_size, capacity):
    return np.zeros(2 + capacity * (layout_size + 1))


@njit(cache=True)
def _next_phase(phase, silent, criteria, estimate, guidance, laser, wheels, untracked):
    """The table of `systems.supervisors.runway_phases`, at most one transition."""
    on_ground = wheels[3] > 0.0
    if phase == 0.0:
        return 1.0 if silent > criteria[0] else 0.0
    if phase <= 4.0 and on_ground:
        return 5.0
    if phase == 1.0:
        return 2.0 if guidance[1] > 0.0 else 1.0
    if phase == 2.0 or phase == 3.0:
        distance = math.hypot(estimate[2], estimate[3])
        if distance < criteria[1] or (untracked > criteria[2] and distance < criteria[3]):
            return 4.0
        if phase == 2.0 and criteria[6] > 0.0 and laser[3] > 0.0:
            return 3.0
        return phase
    if phase == 5.0 and on_ground and wheels[4] < criteria[4]:
        return 6.0
    return phase


@njit(cache=True)
def _fly(
    closed, state, plant_memory, plant, gust_key, flight, altitude_error, gear, terrain, geometry,
    inertial_model, baro_model, fix_model, antenna_model, camera_model, tracker_model,
    laser_model, heading_model, wheels_model, airspeed_model,
    is_improved, filter_model, filter_memory, estimate, guidance, controller, criteria,
    distances, passages, end, time_limit,
    measurements, camera,
):  # fmt: skip
    inertial, baro = measurements[:BARO_AT], measurements[BARO_AT:FIX_AT]
    fix, antenna = measurements[FIX_AT:ANTENNA_AT], measurements[ANTENNA_AT:PICTURE_AT]
    picture, laser = measurements[PICTURE_AT:LASER_AT], measurements[LASER_AT:PHASE_AT]
    heading, wheels = measurements[HEADING_AT:WHEELS_AT], measurements[WHEELS_AT:AIRSPEED_AT]
    airspeed = measurements[AIRSPEED_AT:MEASUREMENTS_END]
    seen = state.copy()
    if not closed:
        interpolate_flight(seen, flight, 0.0, terrain, geometry, 0.0, gear)
    inertial_memory = np.zeros(7)
    baro_line = _pipeline(baro.shape[0], 16)
    fix_line = _pipeline(fix.shape[0], 16)
    antenna_line = _pipeline(antenna.shape[0], 16)
    picture_line = _pipeline(picture.shape[0], 32)
    laser_line = _pipeline(laser.shape[0], 16)
    command = np.zeros(4)
    phase, silent, tracked, in_phase = 0.0, 0.0, 0.0, 0.0
    samples = np.zeros(7)  # of baro, fix, antenna, camera, laser and the two slow clocks
    for k in range(round(time_limit / _TICK) + 1):
        time = k * _TICK
        # sense and decide: everyone sees the others' values from before this tick
        now, now_seen = state.copy(), seen.copy()
        if k % 4 == 0:
            if phase == 0.0:
                silent = time - max(fix[0], 0.0) if fix[3] > 0.0 else silent + 4 * _TICK
            if picture[3] > 0.0:
                tracked = time
            before = phase
            phase = _next_phase(
                phase, silent, criteria, estimate, guidance, laser, wheels, time - tracked
            )
            measurements[PHASE_AT] = phase
            in_phase = in_phase + 4 * _TICK if phase == before else 0.0
            note(passages, end, now, estimate, before, distances, controller[1], time)
            if phase == 6.0 and in_phase >= criteria[5]:
                break
        if closed:
            advance(state, plant_memory, command, plant, terrain, geometry, gust_key, _TICK)
            seen[:] = state
        else:
            for target, error in ((state, altitude_error), (seen, 0.0)):
                interpolate_flight(target, flight, time + _TICK, terrain, geometry, error, gear)
        inertial_sample(inertial, inertial_memory, now, time, inertial_model, _TICK)
        if k % 2 == 0:
            tick = k // 2
            if tick % baro_model[3] == 0:
                sample = baro_inertial_sample(now_seen, time, samples[0], baro_model[0])
                enqueue(baro_line, sample, time + baro_model[2])
                samples[0] += 1.0
            release(baro_line, baro, time)
            if tick % laser_model[3] == 0:
                sample = laser_sample(now, time, int(samples[4]), laser_model[0], laser_model[1])
                enqueue(laser_line, sample, time + laser_model[2])
                samples[4] += 1.0
            release(laser_line, laser, time)
        if k % 4 == 0:
            tick = k // 4
            if tick % fix_model[3] == 0:
                sample = fix_sample(now_seen, time, int(samples[1]), fix_model[0], fix_model[1])
                enqueue(fix_line, sample, time + fix_model[2])
                samples[1] += 1.0
            release(fix_line, fix, time)
            if tick % antenna_model[3] == 0:
                sample = antenna_sample(
                    now, time, int(samples[2]), antenna_model[0], antenna_model[1]
                )
                enqueue(antenna_line, sample, time + antenna_model[2])
                samples[2] += 1.0
            release(antenna_line, antenna, time)
            if tick % camera_model[3] == 0:
                camera[:] = camera_sample(now_seen, time, int(samples[3]), camera_model[0])
                samples[3] += 1.0
        if k % 8 == 0:
            index = int(samples[5])
            heading[:] = heading_sample(now, time, index, heading_model[0], heading_model[1])
            wheels[:] = wheel_sample(now, time, index, wheels_model[0], wheels_model[1])
            airspeed[:] = airspeed_sample(now, time, index, airspeed_model[0], airspeed_model[1])
            samples[5] += 1.0
        # estimate and act, half a tick later
        if k % 2 == 0 and estimate[1] > 0.0:
            control(
                command, guidance, estimate, phase, controller[0], controller[1], controller[2],
                controller[3], controller[4], 2.0 * _TICK,
            )  # fmt: skip
        if is_improved:
            improved.step(estimate, filter_memory, measurements, filter_model)
        else:
            thesis.step(estimate, filter_memory, measurements, filter_model)
        if k % 4 == 0:  # after the filter, which sees what the tracker said before
            acting = ACT_OFFSET + time
            if camera[2] + 1.0 > picture_line[0]:
                picture_line[0] = camera[2] + 1.0
                distance = math.hypot(seen[0], seen[1])
                found = track(camera, distance, acting, tracker_model[0], tracker_model[1])
                enqueue(picture_line, found, max(acting, camera[0]) + tracker_model[2])
            if picture_line[1] > 0.0:
                release(picture_line, picture, acting)


def fly_compiled(scenario: LandingWithoutGpsScenario, seed: int) -> dict[str, Any]:
    """Fly one landing without Drake's simulator.

    Parameters
    ----------
    scenario : LandingWithoutGpsScenario
        Its own seed is replaced. With a geometric camera and without recorded sensors.
    seed : int
        Of every noise and every error drawn once a run.

    Returns
    -------
    dict
        As from `runs.landing_without_gps.simulate_landing`.

    Raises
    ------
    ScenarioError
        For a scenario with pictures or recorded sensors: those fly in the diagram.
    """
    scenario = dataclasses.replace(scenario, seed=seed)
    lab = laboratory(scenario)
    assert isinstance(lab, RunwayLaboratory)
    systems = lab.landing.systems
    closed = scenario.aircraft.kind == "fixed_wing"
    if not set(_SENSORS) <= set(systems) or scenario.camera.kind != "geometric":
        raise ScenarioError(
            f"scenario {scenario.name}: expected a geometric camera and no recorded sensors in a "
            "compiled landing"
        )
    for name in _SENSORS[-3:]:
        _, _, delay, every = systems[name].model
        if delay > 0.0 or every != 1:
            raise ScenarioError(
                f"{name}: expected a period of 0.08 s and no delay in a compiled landing"
            )
    state, memory = FIXED_WING_STATE.zeros(), np.zeros(8)
    plant, key, flight, error, gear = np.zeros(18), np.uint64(0), np.zeros((2, 13)), 0.0, 0.0
    if closed:
        state, memory, plant, key, grid = systems["aircraft"].model
    else:
        flight, error, gear, grid = systems["aircraft"].model
        interpolate_flight(state, flight, 0.0, grid.values, grid.geometry, error, gear)
    is_improved = scenario.filter.kind == "improved_filter"
    phases = scenario.phases
    criteria = np.array(
        [
            phases.confirm_loss,
            phases.short_final_distance,
            phases.tracker_patience,
            phases.tracker_distance,
            phases.standstill_speed,
            phases.settle,
            float(phases.use_laser),
        ]
    )
    distances = np.array(scenario.record.distances)
    passages = np.full((len(distances), PASSAGE.size), math.nan)
    end = END.zeros()
    end[END.index("touchdown_time")] = end[END.index("stop_time")] = -1.0
    kernel = improved if is_improved else thesis
    arguments: list[Any] = [
        closed,
        state.copy(),
        memory.copy(),
        plant,
        key,
        flight,
        error,
        gear,
        grid.values,
        grid.geometry,
        *(systems[name].model for name in _SENSORS),
        is_improved,
        systems["filter"].model,
        kernel.initial_memory(),
        NAVIGATION_ESTIMATE.zeros(),
        GUIDANCE.zeros(),
        systems["flight_controller"].model,
        criteria,
        distances,
        passages,
        end,
        scenario.time_limit,
        no_measurements(),
        no_measurement(PICTURE),
    ]
    _fly(*arguments)
    return landing_numbers(end, passages, scenario)
