"""What `write_ulog` writes, pyulog reads without loss."""

import numpy as np
import pytest
from pyulog import ULog

from runs.ulog import write_ulog


def rows(count: int, start_us: int, step_us: int, seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    table = np.zeros(
        count,
        dtype=[
            ("timestamp", "u8"), ("lat", "f8"), ("q", "f4", (4,)), ("fix_type", "u1"),
            ("armed", "?"), ("delta", "i4"),
        ],
    )  # fmt: skip
    table["timestamp"] = start_us + step_us * np.arange(count)
    table["lat"] = generator.normal(size=count)
    table["q"] = generator.normal(size=(count, 4))
    table["fix_type"] = generator.integers(0, 7, count)
    table["armed"] = generator.integers(0, 2, count)
    table["delta"] = generator.integers(-1000, 1000, count)
    return table


def test_round_trip_is_exact(tmp_path):
    first, second = rows(500, 1_000, 4_000, 1), rows(40, 7_000, 50_000, 2)
    path = tmp_path / "log.ulg"
    write_ulog(
        path,
        {"sensor": first, ("sensor", 1): second, "other": second},
        parameters={"EKF2_EV_DELAY": 175.0, "EKF2_HGT_REF": 1},
        information={"sys_name": "Plumbline"},
    )
    log = ULog(str(path))
    assert not log.file_corruption
    assert log.msg_info_dict["sys_name"] == "Plumbline"
    assert log.initial_parameters == {"EKF2_EV_DELAY": 175.0, "EKF2_HGT_REF": 1}
    for name, instance, expected in (
        ("sensor", 0, first),
        ("sensor", 1, second),
        ("other", 0, second),
    ):
        data = log.get_dataset(name, instance).data
        for field in ("timestamp", "lat", "fix_type", "armed", "delta"):
            np.testing.assert_array_equal(data[field], expected[field])
        for i in range(4):
            np.testing.assert_array_equal(data[f"q[{i}]"], expected["q"][:, i])


def test_messages_are_in_order_of_time(tmp_path):
    path = tmp_path / "log.ulg"
    write_ulog(path, {"late": rows(3, 500, 10, 1), "early": rows(3, 100, 10, 1)})
    log = ULog(str(path))
    assert log.start_timestamp == 100
    assert log.last_timestamp == 520


def test_without_timestamp_is_refused(tmp_path):
    table = np.zeros(3, dtype=[("x", "f4")])
    with pytest.raises(ValueError, match="topic odd: the first field must be timestamp"):
        write_ulog(tmp_path / "log.ulg", {"odd": table})
