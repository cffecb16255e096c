"""PX4's parameters of EKF2: names, units and defaults, and the flat array that the kernels read.

Every constant `EKF2_…` of this module is the index of that parameter in the array
that `parameter_array` makes. There are two sets of defaults: "module" is what a
vehicle starts with (PX4's EKF2 module), "unit-test" what PX4's unit tests run on
(the filter's own struct). Both are of PX4's main branch of August 2026.

Names that PX4 knows but that belong to parts not built here (optical flow,
airspeed, drag, ranging beacons …) are accepted and have no effect.
"""

import difflib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

Defaults = Literal["module", "unit-test"]
Value = int | float


class ParameterError(ValueError):
    """A parameter does not exist, has the wrong type, or cannot be used."""


@dataclass(frozen=True)
class Parameter:
    """One parameter of PX4's EKF2.

    Attributes
    ----------
    name : str
        PX4's name.
    module, unit_test : int or float
        The two defaults. Their type is the parameter's type.
    unit : str
        The unit; empty for switches and bit masks.
    meaning : str
        What it sets.
    """

    name: str
    module: Value
    unit_test: Value
    unit: str
    meaning: str


_table: list[Parameter] = []


def _parameter(name: str, module: Value, unit_test: Value, unit: str, meaning: str) -> int:
    _table.append(Parameter(name, module, unit_test, unit, meaning))
    return len(_table) - 1


# fmt: off
EKF2_PREDICT_US = _parameter("EKF2_PREDICT_US", 10000, 10000, "us", "filter update interval")
EKF2_DELAY_MAX = _parameter("EKF2_DELAY_MAX", 200.0, 110.0, "ms", "longest delay; sizes the rings")
EKF2_SENS_EN = _parameter("EKF2_SENS_EN", 8191, 8191, "", "sensors that may be fused, bits")
EKF2_IMU_CTRL = _parameter("EKF2_IMU_CTRL", 7, 3, "", "1 gyro bias, 2 accel bias, 4 gravity")
EKF2_HGT_REF = _parameter("EKF2_HGT_REF", 1, 0, "", "height reference: 0 baro 1 GNSS 2 range 3 EV")
EKF2_VEL_LIM = _parameter("EKF2_VEL_LIM", 100.0, 100.0, "m/s", "largest believable velocity")
EKF2_NOAID_TOUT = _parameter("EKF2_NOAID_TOUT", 5000000, 5000000, "us", "dead reckoning allowed")
EKF2_NOAID_NOISE = _parameter("EKF2_NOAID_NOISE", 10.0, 10.0, "m", "sigma of the fake position")
EKF2_TAU_VEL = _parameter("EKF2_TAU_VEL", 0.25, 0.25, "s", "output predictor, velocity")
EKF2_TAU_POS = _parameter("EKF2_TAU_POS", 0.25, 0.25, "s", "output predictor, position")
# IMU and process noise
EKF2_GYR_NOISE = _parameter("EKF2_GYR_NOISE", 0.015, 0.015, "rad/s", "gyro noise a step")
EKF2_ACC_NOISE = _parameter("EKF2_ACC_NOISE", 0.35, 0.35, "m/s2", "accelerometer noise a step")
EKF2_GYR_B_NOISE = _parameter("EKF2_GYR_B_NOISE", 1e-3, 1e-3, "rad/s2", "gyro bias drift")
EKF2_ACC_B_NOISE = _parameter("EKF2_ACC_B_NOISE", 3e-3, 1e-2, "m/s3", "accel bias drift")
EKF2_GYR_B_LIM = _parameter("EKF2_GYR_B_LIM", 0.15, 0.4, "rad/s", "largest gyro bias")
EKF2_ABL_LIM = _parameter("EKF2_ABL_LIM", 0.4, 0.4, "m/s2", "largest accel bias")
EKF2_ABL_ACCLIM = _parameter("EKF2_ABL_ACCLIM", 25.0, 25.0, "m/s2", "no accel bias learning above")
EKF2_ABL_GYRLIM = _parameter("EKF2_ABL_GYRLIM", 3.0, 3.0, "rad/s", "no accel bias learning above")
EKF2_ABL_TAU = _parameter("EKF2_ABL_TAU", 0.5, 0.5, "s", "decay of the two maxima above")
EKF2_WIND_NSD = _parameter("EKF2_WIND_NSD", 0.05, 0.01, "m/s2/sqrt(Hz)", "wind drift")
EKF2_GBIAS_INIT = _parameter("EKF2_GBIAS_INIT", 0.1, 0.1, "rad/s", "initial sigma of gyro bias")
EKF2_ABIAS_INIT = _parameter("EKF2_ABIAS_INIT", 0.2, 0.2, "m/s2", "initial sigma of accel bias")
EKF2_ANGERR_INIT = _parameter("EKF2_ANGERR_INIT", 0.1, 0.1, "rad", "initial sigma of tilt")
EKF2_GRAV_NOISE = _parameter("EKF2_GRAV_NOISE", 1.0, 1.0, "g0", "sigma of the gravity direction")
# barometer
EKF2_BARO_CTRL = _parameter("EKF2_BARO_CTRL", 1, 1, "", "fuse the barometer")
EKF2_BARO_DELAY = _parameter("EKF2_BARO_DELAY", 0.0, 0.0, "ms", "delay behind the IMU")
EKF2_BARO_NOISE = _parameter("EKF2_BARO_NOISE", 3.5, 2.0, "m", "sigma")
EKF2_BARO_GATE = _parameter("EKF2_BARO_GATE", 5.0, 5.0, "SD", "innovation gate")
EKF2_GND_EFF_DZ = _parameter("EKF2_GND_EFF_DZ", 4.0, 5.0, "m", "dead zone in ground effect")
EKF2_GND_MAX_HGT = _parameter("EKF2_GND_MAX_HGT", 0.5, 0.5, "m", "height of the ground effect")
# GNSS
EKF2_GPS_CTRL = _parameter("EKF2_GPS_CTRL", 7, 5, "", "1 horizontal position, 2 height, 4 velocity")
EKF2_GPS_MODE = _parameter("EKF2_GPS_MODE", 0, 0, "", "0 automatic, 1 dead reckoning")
EKF2_GPS_DELAY = _parameter("EKF2_GPS_DELAY", 110.0, 0.0, "ms", "arrival behind validity (v1.13)")
EKF2_GPS_V_NOISE = _parameter("EKF2_GPS_V_NOISE", 0.3, 0.5, "m/s", "smallest sigma of velocity")
EKF2_GPS_P_NOISE = _parameter("EKF2_GPS_P_NOISE", 0.5, 0.5, "m", "smallest sigma of position")
EKF2_GPS_V_GATE = _parameter("EKF2_GPS_V_GATE", 5.0, 5.0, "SD", "innovation gate of velocity")
EKF2_GPS_P_GATE = _parameter("EKF2_GPS_P_GATE", 5.0, 5.0, "SD", "innovation gate of position")
EKF2_GPS_CHECK = _parameter("EKF2_GPS_CHECK", 2047, 1045, "", "quality checks, bits")
EKF2_REQ_EPH = _parameter("EKF2_REQ_EPH", 3.0, 5.0, "m", "largest horizontal accuracy")
EKF2_REQ_EPV = _parameter("EKF2_REQ_EPV", 5.0, 8.0, "m", "largest vertical accuracy")
EKF2_REQ_SACC = _parameter("EKF2_REQ_SACC", 0.5, 1.0, "m/s", "largest speed accuracy")
EKF2_REQ_NSATS = _parameter("EKF2_REQ_NSATS", 6, 6, "", "fewest satellites")
EKF2_REQ_PDOP = _parameter("EKF2_REQ_PDOP", 2.5, 2.0, "", "largest PDOP")
EKF2_REQ_HDRIFT = _parameter("EKF2_REQ_HDRIFT", 0.1, 0.3, "m/s", "largest horizontal drift at rest")
EKF2_REQ_VDRIFT = _parameter("EKF2_REQ_VDRIFT", 0.2, 0.5, "m/s", "largest vertical drift at rest")
EKF2_REQ_FIX = _parameter("EKF2_REQ_FIX", 3, 3, "", "least fix type")
EKF2_REQ_GPS_H = _parameter("EKF2_REQ_GPS_H", 10.0, 10.0, "s", "checks must pass this long")
# magnetometer
EKF2_MAG_TYPE = _parameter("EKF2_MAG_TYPE", 0, 0, "", "0 automatic 1 heading 5 none 6 initial")
EKF2_MAG_DELAY = _parameter("EKF2_MAG_DELAY", 0.0, 0.0, "ms", "delay behind the IMU")
EKF2_MAG_GATE = _parameter("EKF2_MAG_GATE", 3.0, 3.0, "SD", "innovation gate")
EKF2_MAG_NOISE = _parameter("EKF2_MAG_NOISE", 0.05, 0.05, "gauss", "sigma")
EKF2_MAG_B_NOISE = _parameter("EKF2_MAG_B_NOISE", 1e-4, 1e-4, "gauss/s", "body field drift")
EKF2_MAG_E_NOISE = _parameter("EKF2_MAG_E_NOISE", 1e-3, 1e-3, "gauss/s", "earth field drift")
EKF2_MAG_DECL = _parameter("EKF2_MAG_DECL", 0.0, 0.0, "deg", "declination saved by the last flight")
EKF2_DECL_TYPE = _parameter("EKF2_DECL_TYPE", 3, 3, "", "1 use the world model, 2 use MAG_DECL")
EKF2_MAG_ACCLIM = _parameter("EKF2_MAG_ACCLIM", 0.5, 0.5, "m/s2", "yaw is observable above")
EKF2_MAG_CHECK = _parameter("EKF2_MAG_CHECK", 1, 0, "", "1 strength, 2 inclination, 4 force model")
EKF2_MAG_CHK_STR = _parameter("EKF2_MAG_CHK_STR", 0.2, 0.2, "gauss", "tolerance of the strength")
EKF2_MAG_CHK_INC = _parameter("EKF2_MAG_CHK_INC", 20.0, 20.0, "deg", "tolerance of the inclination")
EKF2_SYNT_MAG_Z = _parameter("EKF2_SYNT_MAG_Z", 0, 0, "", "compute z from x, y and the model")
EKF2_HDG_GATE = _parameter("EKF2_HDG_GATE", 2.6, 2.6, "SD", "innovation gate of heading")
EKF2_HEAD_NOISE = _parameter("EKF2_HEAD_NOISE", 0.3, 0.3, "rad", "sigma of heading")
# range finder and terrain
EKF2_RNG_CTRL = _parameter("EKF2_RNG_CTRL", 1, 1, "", "0 off, 1 when low and slow, 2 on")
EKF2_RNG_DELAY = _parameter("EKF2_RNG_DELAY", 5.0, 5.0, "ms", "delay behind the IMU")
EKF2_RNG_NOISE = _parameter("EKF2_RNG_NOISE", 0.1, 0.1, "m", "sigma at zero range")
EKF2_RNG_SFE = _parameter("EKF2_RNG_SFE", 0.05, 0.0, "m/m", "growth of sigma with range")
EKF2_RNG_GATE = _parameter("EKF2_RNG_GATE", 5.0, 5.0, "SD", "innovation gate")
EKF2_RNG_PITCH = _parameter("EKF2_RNG_PITCH", 0.0, 0.0, "rad", "pitch of the beam")
EKF2_RNG_A_HMAX = _parameter("EKF2_RNG_A_HMAX", 5.0, 5.0, "m", "height aiding below this height")
EKF2_RNG_A_VMAX = _parameter("EKF2_RNG_A_VMAX", 1.0, 1.0, "m/s", "height aiding below this speed")
EKF2_RNG_QLTY_T = _parameter("EKF2_RNG_QLTY_T", 1.0, 1.0, "s", "good quality needed this long")
EKF2_RNG_K_GATE = _parameter("EKF2_RNG_K_GATE", 1.0, 1.0, "SD", "gate of the kinematic check")
EKF2_RNG_FOG = _parameter("EKF2_RNG_FOG", 3.0, 0.0, "m", "longest range a blocked sensor reports")
EKF2_MIN_RNG = _parameter("EKF2_MIN_RNG", 0.01, 0.1, "m", "range expected on the ground")
EKF2_TERR_NOISE = _parameter("EKF2_TERR_NOISE", 5.0, 5.0, "m/s", "terrain drift")
EKF2_TERR_GRAD = _parameter("EKF2_TERR_GRAD", 0.5, 0.5, "m/m", "slope of the terrain")
# external vision
EKF2_EV_CTRL = _parameter("EKF2_EV_CTRL", 0, 0, "", "1 position, 2 height, 4 velocity, 8 yaw")
EKF2_EV_DELAY = _parameter("EKF2_EV_DELAY", 0.0, 175.0, "ms", "delay behind the IMU")
EKF2_EV_NOISE_MD = _parameter("EKF2_EV_NOISE_MD", 0, 0, "", "0 reported variances, 1 parameters")
EKF2_EV_QMIN = _parameter("EKF2_EV_QMIN", 0, 0, "", "least quality")
EKF2_EVA_NOISE = _parameter("EKF2_EVA_NOISE", 0.1, 0.1, "rad", "smallest sigma of angles")
EKF2_EVP_NOISE = _parameter("EKF2_EVP_NOISE", 0.1, 0.1, "m", "smallest sigma of position")
EKF2_EVV_NOISE = _parameter("EKF2_EVV_NOISE", 0.1, 0.1, "m/s", "smallest sigma of velocity")
EKF2_EVP_GATE = _parameter("EKF2_EVP_GATE", 5.0, 5.0, "SD", "innovation gate of position")
EKF2_EVV_GATE = _parameter("EKF2_EVV_GATE", 3.0, 3.0, "SD", "innovation gate of velocity")
# lever arms, forward-right-down from the body origin
EKF2_IMU_POS_X = _parameter("EKF2_IMU_POS_X", 0.0, 0.0, "m", "IMU")
EKF2_IMU_POS_Y = _parameter("EKF2_IMU_POS_Y", 0.0, 0.0, "m", "IMU")
EKF2_IMU_POS_Z = _parameter("EKF2_IMU_POS_Z", 0.0, 0.0, "m", "IMU")
EKF2_GPS_POS_X = _parameter("EKF2_GPS_POS_X", 0.0, 0.0, "m", "GNSS antenna (v1.13)")
EKF2_GPS_POS_Y = _parameter("EKF2_GPS_POS_Y", 0.0, 0.0, "m", "GNSS antenna (v1.13)")
EKF2_GPS_POS_Z = _parameter("EKF2_GPS_POS_Z", 0.0, 0.0, "m", "GNSS antenna (v1.13)")
EKF2_RNG_POS_X = _parameter("EKF2_RNG_POS_X", 0.0, 0.0, "m", "range finder")
EKF2_RNG_POS_Y = _parameter("EKF2_RNG_POS_Y", 0.0, 0.0, "m", "range finder")
EKF2_RNG_POS_Z = _parameter("EKF2_RNG_POS_Z", 0.0, 0.0, "m", "range finder")
EKF2_EV_POS_X = _parameter("EKF2_EV_POS_X", 0.0, 0.0, "m", "camera")
EKF2_EV_POS_Y = _parameter("EKF2_EV_POS_Y", 0.0, 0.0, "m", "camera")
EKF2_EV_POS_Z = _parameter("EKF2_EV_POS_Z", 0.0, 0.0, "m", "camera")
# fmt: on

PARAMETERS = tuple(_table)
INDEX = {parameter.name: index for index, parameter in enumerate(PARAMETERS)}

# What PX4 is told by its drivers and libraries instead of by a parameter.
RANGE_MINIMUM = len(PARAMETERS)  # m, shortest range that the range finder measures
RANGE_MAXIMUM = RANGE_MINIMUM + 1  # m, longest
WORLD_DECLINATION = RANGE_MINIMUM + 2  # rad, earth's field where the vehicle flies
WORLD_INCLINATION = RANGE_MINIMUM + 3  # rad, positive down
WORLD_STRENGTH = RANGE_MINIMUM + 4  # gauss
SIZE = RANGE_MINIMUM + 5

NOT_BUILT = frozenset(
    [
        "EKF2_ARSP_THR",
        "EKF2_ASPD_MAX",
        "EKF2_ASP_DELAY",
        "EKF2_AVEL_DELAY",
        "EKF2_AVEL_EN",
        "EKF2_BCOEF_X",
        "EKF2_BCOEF_Y",
        "EKF2_BETA_GATE",
        "EKF2_BETA_NOISE",
        "EKF2_DRAG_CTRL",
        "EKF2_DRAG_NOISE",
        "EKF2_EAS_NOISE",
        "EKF2_EN",
        "EKF2_FUSE_BETA",
        "EKF2_GPS_YAW_OFF",
        "EKF2_GSF_TAS",
        "EKF2_LOG_VERBOSE",
        "EKF2_MCOEF",
        "EKF2_MULTI_IMU",
        "EKF2_MULTI_MAG",
        "EKF2_OF_CTRL",
        "EKF2_OF_DELAY",
        "EKF2_OF_GATE",
        "EKF2_OF_GYR_SRC",
        "EKF2_OF_N_MAX",
        "EKF2_OF_N_MIN",
        "EKF2_OF_POS_X",
        "EKF2_OF_POS_Y",
        "EKF2_OF_POS_Z",
        "EKF2_OF_QMIN",
        "EKF2_OF_QMIN_GND",
        "EKF2_PCOEF_XN",
        "EKF2_PCOEF_XP",
        "EKF2_PCOEF_YN",
        "EKF2_PCOEF_YP",
        "EKF2_PCOEF_Z",
        "EKF2_POS_LOCK",
        "EKF2_RNGBC_CTRL",
        "EKF2_RNGBC_DELAY",
        "EKF2_RNGBC_GATE",
        "EKF2_RNGBC_NOISE",
        "EKF2_SEL_ERR_RED",
        "EKF2_SEL_IMU_ACC",
        "EKF2_SEL_IMU_ANG",
        "EKF2_SEL_IMU_RAT",
        "EKF2_SEL_IMU_VEL",
        "EKF2_TAS_GATE",
    ]
    + [
        f"EKF2_AGP{source}_{field}"
        for source in range(4)
        for field in ("ID", "CTRL", "MODE", "DELAY", "NOISE", "GATE")
    ]
)

_RING_LIMIT = 255  # entries, PX4 counts them in a byte


def defaults(name: Defaults) -> dict[str, Value]:
    """One of PX4's sets of defaults, by parameter name."""
    if name not in ("module", "unit-test"):
        raise ParameterError(f'there is no set of defaults "{name}", only "module" and "unit-test"')
    return {p.name: p.module if name == "module" else p.unit_test for p in PARAMETERS}


def checked(values: Mapping[str, Value], source: str = "parameters") -> dict[str, Value]:
    """The parameters that the filter has, of the right type; raises on anything else.

    Parameters
    ----------
    values : mapping of str to int or float
        PX4 names and values.
    source : str
        What an error message calls the place they came from.

    Raises
    ------
    ParameterError
        In one sentence: an unknown name (with the nearest valid one), a value
        that is not a finite number, or a fraction where PX4 has an integer.
    """
    result: dict[str, Value] = {}
    for name, value in values.items():
        if name in NOT_BUILT:
            continue
        if name not in INDEX:
            nearest = difflib.get_close_matches(name, INDEX, n=1, cutoff=0.0)[0]
            raise ParameterError(f"{source}: EKF2 has no parameter {name}; did you mean {nearest}?")
        parameter = PARAMETERS[INDEX[name]]
        number = isinstance(value, int | float | np.number) and not isinstance(value, bool)
        if not number or not np.isfinite(value):
            raise ParameterError(f"{source}: {name} must be a finite number, not {value!r}")
        if isinstance(parameter.module, int):
            if value != int(value):
                raise ParameterError(f"{source}: {name} must be a whole number, not {value!r}")
            result[name] = int(value)
        else:
            result[name] = float(value)
    return result


_INTEGER_TYPES = range(1, 9)  # MAV_PARAM_TYPE of MAVLink; 9 and 10 are real


def read_parameter_file(path: str | Path) -> dict[str, Value]:
    """The `EKF2_…` parameters of a QGroundControl `.params` file.

    A line holds vehicle id, component id, name, value and MAVLink type,
    separated by tabs; lines that start with `#` are comments. Parameters of
    other modules are passed over.

    Raises
    ------
    ParameterError
        With the file and the line, if a line cannot be read.
    """
    values: dict[str, Value] = {}
    for number, line in enumerate(Path(path).read_text().splitlines(), start=1):
        if not line.strip() or line.lstrip().startswith("#"):
            continue
        where = f"{path}, line {number}"
        words = line.split()
        if len(words) != 5:
            raise ParameterError(
                f"{where}: expected vehicle, component, name, value and type, not {line.strip()!r}"
            )
        name, text, kind = words[2:]
        if not name.startswith("EKF2_"):
            continue
        try:
            value = int(text) if int(kind) in _INTEGER_TYPES else float(text)
        except ValueError:
            raise ParameterError(f"{where}: {name} has no readable value in {text!r}") from None
        values.update(checked({name: value}, where))
    return values


def parameter_array(
    values: Mapping[str, Value],
    base: Defaults = "module",
    range_limits: tuple[float, float] = (0.1, 40.0),
    earth_field: tuple[float, float, float] | None = None,
) -> np.ndarray:
    """The flat array that the kernels read, shape (SIZE,).

    Parameters
    ----------
    values : mapping of str to int or float
        What differs from the defaults.
    base : str
        The set of defaults.
    range_limits : tuple of float
        Shortest and longest range (m) of the range finder, in PX4 from its driver.
    earth_field : tuple of float, optional
        Declination (deg), inclination (deg) and strength (gauss) of the world
        magnetic model where the vehicle flies. None: there is no model.

    Raises
    ------
    ParameterError
        As `checked`; also if the rings would grow beyond 255 entries.
    """
    merged = defaults(base) | checked(values)
    array = np.full(SIZE, np.nan)
    for name, value in merged.items():
        array[INDEX[name]] = value
    for noise in (
        EKF2_GYR_NOISE,
        EKF2_ACC_NOISE,
        EKF2_GYR_B_NOISE,
        EKF2_ACC_B_NOISE,
        EKF2_MAG_E_NOISE,
        EKF2_MAG_B_NOISE,
        EKF2_WIND_NSD,
    ):
        array[noise] = min(max(array[noise], 0.0), 1.0)
    array[RANGE_MINIMUM], array[RANGE_MAXIMUM] = range_limits
    if earth_field is not None:
        array[WORLD_DECLINATION] = np.radians(earth_field[0])
        array[WORLD_INCLINATION] = np.radians(earth_field[1])
        array[WORLD_STRENGTH] = earth_field[2]
    if array[EKF2_PREDICT_US] <= 0.0:
        raise ParameterError("parameters: EKF2_PREDICT_US must be positive")
    if ring_lengths(array)[0] > _RING_LIMIT:
        raise ParameterError(
            f"parameters: EKF2_DELAY_MAX {array[EKF2_DELAY_MAX]:g} ms are more than {_RING_LIMIT} "
            f"steps of EKF2_PREDICT_US {array[EKF2_PREDICT_US]:g} us"
        )
    return array


def ring_lengths(array: np.ndarray) -> tuple[int, int]:
    """Entries of the IMU ring and of each observation ring.

    The IMU ring covers EKF2_DELAY_MAX in steps of EKF2_PREDICT_US, at least 2;
    an observation ring half as much again, at most the IMU ring.
    """
    steps = array[EKF2_DELAY_MAX] / (array[EKF2_PREDICT_US] * 1e-3)
    # the guard keeps 200 ms / 10 ms at 20: PX4 divides in single precision
    imu = max(2, int(np.ceil(steps - 1e-5)))
    return imu, min(int(np.floor(1.5 * steps + 0.5 + 1e-5)), imu)
