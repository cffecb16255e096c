"""A run's log under PX4's topic and field names, for `log.ulg`.

Vectors change to NED and FRD on the way. Every message's `timestamp` is when the
laboratory recorded it, in microseconds from the start of the run, plus one second
so that no stamp is zero (pyulog and Flight Review take zero as "never").
"""

from collections.abc import Mapping, Sequence

import numpy as np
import pyarrow as pa

from runs.logs import port_samples
from systems.frames import attitude_ned_from_world

START_US = 1_000_000
ORIENTATION_DOWN = 25  # distance_sensor: ROTATION_DOWNWARD_FACING

Samples = Mapping[str, np.ndarray]


def px4_topics(log: pa.Table) -> dict[str, np.ndarray]:
    """PX4's topics of a run.

    Parameters
    ----------
    log : pa.Table
        A run's log.

    Returns
    -------
    dict
        Topic name to a structured array whose first field is `timestamp` (us); ports
        that the run does not have are left out.
    """
    makers = {
        "body": _ground_truth,
        "estimate": _estimate,
        "imu": _inertial,
        "gnss": _gnss,
        "barometer": _barometer,
        "magnetometer": _magnetometer,
        "range_finder": _range_finder,
        "infrared": _infrared,
        "target": _landing_target,
        "setpoint": _setpoint,
        "rotor_commands": _motors,
        "supervisor": _status,
        "wind": _wind,
    }
    topics: dict[str, np.ndarray] = {}
    for port, make in makers.items():
        try:
            samples = port_samples(log, port)
        except KeyError:
            continue
        if len(samples["time"]):
            topics |= make(samples)
    return topics


def microseconds(time: np.ndarray) -> np.ndarray:
    """Seconds of the run as PX4's time stamps (uint64, us)."""
    return (np.round(time * 1e6) + START_US).astype("u8")


def _table(time: np.ndarray, fields: Sequence[tuple[str, str, np.ndarray]]) -> np.ndarray:
    """A structured array of a topic: `timestamp`, then (name, numpy type, values)."""
    types: list[tuple] = [("timestamp", "u8")]
    types += [(name, kind, values.shape[1:]) for name, kind, values in fields]
    table = np.zeros(len(time), dtype=types)
    table["timestamp"] = microseconds(time)
    for name, _, values in fields:
        table[name] = values
    return table


def _rows(samples: Samples, vector: str, components: str = "xyz") -> np.ndarray:
    return np.column_stack([samples[f"{vector}_{c}"] for c in components])


def _ned(samples: Samples, vector: str) -> np.ndarray:
    """A vector in W as rows in NED."""
    rows = _rows(samples, vector)
    return np.column_stack([rows[:, 1], rows[:, 0], -rows[:, 2]])


def _frd(samples: Samples, vector: str) -> np.ndarray:
    """A vector in B as rows in FRD."""
    return _rows(samples, vector) * [1.0, -1.0, -1.0]


def _attitude(samples: Samples) -> np.ndarray:
    q_WB = _rows(samples, "q_WB", "wxyz")
    return np.array([attitude_ned_from_world(q) for q in q_WB])


def _position_and_velocity(samples: Samples) -> list[tuple[str, str, np.ndarray]]:
    position, velocity = _ned(samples, "p_WB"), _ned(samples, "v_WB")
    names = ("x", "y", "z"), ("vx", "vy", "vz")
    return [
        (name, "f4", values[:, i])
        for triple, values in zip(names, (position, velocity), strict=True)
        for i, name in enumerate(triple)
    ]


def _ground_truth(body: Samples) -> dict[str, np.ndarray]:
    time = body["time"]
    return {
        "vehicle_attitude_groundtruth": _table(time, [("q", "f4", _attitude(body))]),
        "vehicle_local_position_groundtruth": _table(time, _position_and_velocity(body)),
        "vehicle_angular_velocity_groundtruth": _table(time, [("xyz", "f4", _frd(body, "w_WB_B"))]),
    }


def _estimate(estimate: Samples) -> dict[str, np.ndarray]:
    time = estimate["time"]
    sampled = microseconds(estimate["time_of_validity"])
    horizontal, vertical = estimate["horizontal_valid"], estimate["vertical_valid"]
    acceleration = _ned(estimate, "a_WB")
    position_variance = _ned(estimate, "position_variance")
    velocity_variance = _ned(estimate, "velocity_variance")
    attitude = _attitude(estimate)
    w, x, y, z = attitude.T
    return {
        "vehicle_attitude": _table(
            time, [("timestamp_sample", "u8", sampled), ("q", "f4", attitude)]
        ),
        "vehicle_local_position": _table(
            time,
            [
                ("timestamp_sample", "u8", sampled),
                ("xy_valid", "?", horizontal),
                ("z_valid", "?", vertical),
                ("v_xy_valid", "?", horizontal),
                ("v_z_valid", "?", vertical),
                *_position_and_velocity(estimate),
                ("ax", "f4", acceleration[:, 0]),
                ("ay", "f4", acceleration[:, 1]),
                ("az", "f4", acceleration[:, 2]),
                ("heading", "f4", np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))),
                ("xy_reset_counter", "u1", estimate["horizontal_reset_counter"] % 256),
                ("z_reset_counter", "u1", estimate["vertical_reset_counter"] % 256),
                ("dist_bottom", "f4", estimate["height_above_ground"]),
                ("dist_bottom_valid", "?", estimate["height_above_ground_valid"]),
                ("eph", "f4", np.sqrt(np.abs(position_variance[:, :2]).sum(axis=1))),
                ("epv", "f4", np.sqrt(np.abs(position_variance[:, 2]))),
                ("evh", "f4", np.sqrt(np.abs(velocity_variance[:, :2]).sum(axis=1))),
                ("evv", "f4", np.sqrt(np.abs(velocity_variance[:, 2]))),
            ],
        ),
    }


def _inertial(imu: Samples) -> dict[str, np.ndarray]:
    dt = imu["delta_angle_dt"]
    return {
        "sensor_combined": _table(
            imu["time"],
            [
                ("gyro_rad", "f4", _frd(imu, "delta_angle") / dt[:, None]),
                ("gyro_integral_dt", "u4", np.round(dt * 1e6)),
                ("accelerometer_timestamp_relative", "i4", np.zeros(len(dt))),
                ("accelerometer_m_s2", "f4", _frd(imu, "delta_velocity") / dt[:, None]),
                ("accelerometer_integral_dt", "u4", np.round(imu["delta_velocity_dt"] * 1e6)),
                ("accelerometer_clipping", "u1", imu["clipping"]),
            ],
        )
    }


def _gnss(gnss: Samples) -> dict[str, np.ndarray]:
    velocity = _ned(gnss, "v_W")
    return {
        "sensor_gps": _table(
            gnss["time"],
            [
                ("timestamp_sample", "u8", microseconds(gnss["time_of_validity"])),
                ("latitude_deg", "f8", gnss["latitude"]),
                ("longitude_deg", "f8", gnss["longitude"]),
                ("altitude_msl_m", "f8", gnss["altitude"]),
                ("altitude_ellipsoid_m", "f8", gnss["altitude"]),
                ("s_variance_m_s", "f4", gnss["speed_accuracy"]),
                ("eph", "f4", gnss["horizontal_accuracy"]),
                ("epv", "f4", gnss["vertical_accuracy"]),
                ("hdop", "f4", gnss["position_dilution"] / np.sqrt(2.0)),
                ("vdop", "f4", gnss["position_dilution"] / np.sqrt(2.0)),
                ("vel_m_s", "f4", np.hypot(velocity[:, 0], velocity[:, 1])),
                ("vel_n_m_s", "f4", velocity[:, 0]),
                ("vel_e_m_s", "f4", velocity[:, 1]),
                ("vel_d_m_s", "f4", velocity[:, 2]),
                ("vel_ned_valid", "?", gnss["valid"]),
                ("fix_type", "u1", gnss["fix_type"]),
                ("satellites_used", "u1", gnss["satellites"]),
            ],
        )
    }


def _barometer(barometer: Samples) -> dict[str, np.ndarray]:
    sampled = microseconds(barometer["time_of_validity"])
    return {
        "vehicle_air_data": _table(
            barometer["time"],
            [
                ("timestamp_sample", "u8", sampled),
                ("baro_alt_meter", "f4", barometer["altitude"]),
            ],
        )
    }


def _magnetometer(magnetometer: Samples) -> dict[str, np.ndarray]:
    sampled = microseconds(magnetometer["time_of_validity"])
    return {
        "vehicle_magnetometer": _table(
            magnetometer["time"],
            [
                ("timestamp_sample", "u8", sampled),
                ("magnetometer_ga", "f4", _frd(magnetometer, "field_B")),
            ],
        )
    }


def _range_finder(range_finder: Samples) -> dict[str, np.ndarray]:
    count = len(range_finder["time"])
    quality = np.where(range_finder["valid"] > 0.5, range_finder["signal_quality"], 0.0)
    return {
        "distance_sensor": _table(
            range_finder["time"],
            [
                ("current_distance", "f4", range_finder["range"]),
                ("signal_quality", "i1", quality),
                ("orientation", "u1", np.full(count, ORIENTATION_DOWN)),
            ],
        )
    }


def _infrared(infrared: Samples) -> dict[str, np.ndarray]:
    seen = infrared["valid"] > 0.5
    if not seen.any():
        return {}
    size = np.sqrt(infrared["blob_0_area"][seen])
    return {
        "irlock_report": _table(
            infrared["time"][seen],
            [
                ("signature", "u2", np.ones(seen.sum())),
                ("pos_x", "f4", infrared["blob_0_x"][seen]),
                ("pos_y", "f4", infrared["blob_0_y"][seen]),
                ("size_x", "f4", size),
                ("size_y", "f4", size),
            ],
        )
    }


def _landing_target(target: Samples) -> dict[str, np.ndarray]:
    position, velocity = _ned(target, "p_BP_W"), _ned(target, "v_BP_W")
    covariance = np.abs(_ned(target, "position_variance"))
    speed_covariance = np.abs(_ned(target, "velocity_variance"))
    acquired = target["acquired"]
    return {
        "landing_target_pose": _table(
            target["time"],
            [
                ("rel_pos_valid", "?", acquired),
                ("rel_vel_valid", "?", acquired),
                ("x_rel", "f4", position[:, 0]),
                ("y_rel", "f4", position[:, 1]),
                ("z_rel", "f4", position[:, 2]),
                ("vx_rel", "f4", velocity[:, 0]),
                ("vy_rel", "f4", velocity[:, 1]),
                ("cov_x_rel", "f4", covariance[:, 0]),
                ("cov_y_rel", "f4", covariance[:, 1]),
                ("cov_vx_rel", "f4", speed_covariance[:, 0]),
                ("cov_vy_rel", "f4", speed_covariance[:, 1]),
            ],
        )
    }


def _setpoint(setpoint: Samples) -> dict[str, np.ndarray]:
    return {
        "vehicle_local_position_setpoint": _table(
            setpoint["time"],
            [
                *_position_and_velocity(setpoint),
                ("yaw", "f4", np.pi / 2 - setpoint["yaw"]),
            ],
        )
    }


def _motors(commands: Samples) -> dict[str, np.ndarray]:
    names = [name for name in commands if name != "time"]
    control = np.full((len(commands["time"]), 12), np.nan)
    for i, name in enumerate(names):
        control[:, i] = commands[name]
    return {"actuator_motors": _table(commands["time"], [("control", "f4", control)])}


def _status(status: Samples) -> dict[str, np.ndarray]:
    armed = 1.0 - status["disarmed"]
    landing = status["landing_started"] >= 0.0
    return {
        "vehicle_status": _table(
            status["time"],
            [
                ("arming_state", "u1", 1.0 + armed),  # 1 disarmed, 2 armed
                ("nav_state", "u1", np.where(landing, 20, 3)),  # precision landing, mission
            ],
        ),
        "vehicle_land_detected": _table(
            status["time"], [("landed", "?", status["landed_detected"])]
        ),
    }


def _wind(wind: Samples) -> dict[str, np.ndarray]:
    return {
        "wind": _table(
            wind["time"],
            [
                ("windspeed_north", "f4", wind["v_W_y"]),
                ("windspeed_east", "f4", wind["v_W_x"]),
            ],
        )
    }
