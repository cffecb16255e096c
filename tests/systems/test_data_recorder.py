"""The data recorder: columns, rate, and what is in the file."""

import csv

import numpy as np
import pandas as pd
import pytest
from pydrake.systems.analysis import Simulator
from pydrake.systems.framework import DiagramBuilder
from pydrake.systems.primitives import Sine

from systems.configuration import StructureChangedError
from systems.data_recorder import DataRecorder, DataRecorderConfig
from systems.schedule import CLOCK_PERIOD
from systems.signals.measurement import SETPOINT
from tests.system_contract import periodic_update

PORTS = {"wave": ["a", "b"], "setpoint": SETPOINT}


def recorded(path, duration=4.0):
    """A recorder of a sine, with its second port not connected."""
    builder = DiagramBuilder()
    recorder = DataRecorderConfig(path=str(path)).add_to(builder, "recorder", ports=PORTS)
    source = builder.AddSystem(Sine(1.0, 2.0, 0.0, 2))
    builder.Connect(source.get_output_port(0), recorder.GetInputPort("wave"))
    simulator = Simulator(builder.Build())
    simulator.Initialize()
    simulator.AdvanceTo(duration)
    return simulator


def test_topology():
    recorder = DataRecorder(DataRecorderConfig(), ports=PORTS)
    assert [recorder.get_input_port(i).size() for i in range(2)] == [2, SETPOINT.size]
    assert recorder.num_output_ports() == 0
    assert periodic_update(recorder) == (CLOCK_PERIOD, 0.0)
    assert recorder.columns[:4] == ["time", "wave.a", "wave.b", "setpoint.p_WB_x"]


def test_rows(tmp_path):
    path = tmp_path / "flight.csv"
    recorded(path)
    table = pd.read_csv(path)
    assert len(table) == pytest.approx(25 * 4, abs=1)
    time = table["time"].to_numpy()
    assert np.diff(time).mean() == pytest.approx(0.04, abs=1e-3)
    np.testing.assert_allclose(table["wave.a"], np.sin(2.0 * time), atol=1e-9)
    assert table["setpoint.yaw"].isna().all()


def test_a_new_simulation_begins_a_new_file(tmp_path):
    path = tmp_path / "flight.csv"
    recorded(path)
    recorded(path, 1.0)
    with path.open(newline="") as file:
        rows = list(csv.reader(file))
    assert rows[0][0] == "time"
    assert len(rows) - 1 == pytest.approx(25, abs=1)


def test_without_a_path_nothing_is_written(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    recorded("")
    assert list(tmp_path.iterdir()) == []


def test_configure():
    recorder = DataRecorder(DataRecorderConfig(), ports=PORTS)
    recorder.configure(DataRecorderConfig(path="x.csv"))
    assert recorder.config.path == "x.csv"
    with pytest.raises(StructureChangedError):
        recorder.configure(DataRecorderConfig(rate=10.0))
