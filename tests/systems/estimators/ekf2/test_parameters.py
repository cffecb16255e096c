"""PX4's parameters: defaults, files, and messages about mistakes."""

import csv

import numpy as np
import pytest

from systems.estimators.ekf2 import parameters as prm
from systems.estimators.ekf2.parameters import ParameterError
from tests.shared_data import shared


@pytest.mark.parametrize("name", ["module", "unit-test"])
def test_defaults_are_px4s(name):
    file = shared(f"data/px4-ekf2/{name.replace('-', '_')}_defaults.csv")
    with file.open() as stream:
        published = {row["parameter"]: float(row["value"]) for row in csv.DictReader(stream)}
    ours = prm.defaults(name)
    missing = {parameter for parameter in published if parameter not in ours}
    assert missing <= prm.NOT_BUILT
    common = published.keys() & ours.keys()
    assert len(common) >= 80
    assert {p: ours[p] for p in common} == {p: published[p] for p in common}


def test_constants_are_indices_into_the_table():
    assert len(prm.INDEX) == len(prm.PARAMETERS)
    for name, index in prm.INDEX.items():
        assert getattr(prm, name) == index
    array = prm.parameter_array({"EKF2_EVP_GATE": 10, "EKF2_GYR_NOISE": 7.0}, "unit-test")
    assert array.shape == (prm.SIZE,)
    assert array[prm.EKF2_EVP_GATE] == 10.0
    assert array[prm.EKF2_GYR_NOISE] == 1.0  # PX4 holds noises within 0 to 1
    assert array[prm.EKF2_DELAY_MAX] == 110.0
    assert np.isnan(array[prm.WORLD_STRENGTH])


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"EKF2_EVP_GAT": 5.0}, "has no parameter EKF2_EVP_GAT; did you mean EKF2_EVP_GATE?"),
        ({"EKF2_AID_MASK": 1}, "has no parameter EKF2_AID_MASK; did you mean EKF2_"),
        ({"EKF2_HGT_REF": 1.5}, "EKF2_HGT_REF must be a whole number, not 1.5"),
        ({"EKF2_EV_DELAY": "fast"}, "EKF2_EV_DELAY must be a finite number, not 'fast'"),
        ({"EKF2_EV_DELAY": float("nan")}, "must be a finite number"),
        ({"EKF2_BARO_CTRL": True}, "must be a finite number, not True"),
    ],
)
def test_a_mistake_is_named_in_one_sentence(values, message):
    with pytest.raises(ParameterError, match=message.replace("?", r"\?")) as error:
        prm.checked(values, "vehicle.params")
    assert str(error.value).startswith("vehicle.params: ")
    assert "\n" not in str(error.value)


def test_parameters_of_parts_not_built_are_accepted():
    assert prm.checked({"EKF2_OF_CTRL": 1, "EKF2_EVP_GATE": 3}) == {"EKF2_EVP_GATE": 3.0}


def test_rings_that_px4_could_not_count_are_refused():
    with pytest.raises(ParameterError, match="EKF2_DELAY_MAX 1000 ms are more than 255 steps"):
        prm.parameter_array({"EKF2_DELAY_MAX": 1000, "EKF2_PREDICT_US": 1000})
    with pytest.raises(ParameterError, match="EKF2_PREDICT_US must be positive"):
        prm.parameter_array({"EKF2_PREDICT_US": 0})
    with pytest.raises(ParameterError, match="no set of defaults"):
        prm.parameter_array({}, "v1.13")


@pytest.mark.parametrize(
    ("delay_max", "predict_us", "lengths"),
    [(200, 10000, (20, 20)), (110, 10000, (11, 11)), (5, 10000, (2, 1)), (105, 10000, (11, 11))],
)
def test_ring_lengths(delay_max, predict_us, lengths):
    values = {"EKF2_DELAY_MAX": delay_max, "EKF2_PREDICT_US": predict_us}
    assert prm.ring_lengths(prm.parameter_array(values)) == lengths


def test_a_qgroundcontrol_file_is_read(tmp_path):
    file = tmp_path / "vehicle.params"
    file.write_text(
        "# Onboard parameters for Vehicle 1\n"
        "#\n"
        "1\t1\tEKF2_EV_CTRL\t3\t6\n"
        "1\t1\tEKF2_EVP_GATE\t10.000000000000000000\t9\n"
        "1\t1\tEKF2_OF_CTRL\t1\t6\n"
        "1\t1\tMPC_XY_P\t0.949999988079071045\t9\n"
    )
    assert prm.read_parameter_file(file) == {"EKF2_EV_CTRL": 3, "EKF2_EVP_GATE": 10.0}


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("1\t1\tEKF2_EV_CTL\t3\t6", "line 2: EKF2 has no parameter EKF2_EV_CTL; did you mean"),
        ("1\t1\tEKF2_EV_CTRL\t3.5\t6", "line 2: EKF2_EV_CTRL has no readable value in '3.5'"),
        ("1 1 EKF2_EV_CTRL", "line 2: expected vehicle, component, name, value and type"),
    ],
)
def test_a_bad_line_of_a_file_is_named(tmp_path, line, message):
    file = tmp_path / "vehicle.params"
    file.write_text(f"# comment\n{line}\n")
    with pytest.raises(ParameterError, match=message):
        prm.read_parameter_file(file)
