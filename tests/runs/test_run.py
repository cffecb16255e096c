"""A run is a pure function of scenario and seed, and lands."""

import subprocess
import sys

import pytest

from diagrams.loading import ScenarioError, load_scenario, scenario_names, with_overrides
from runs.logs import port_samples, write_log
from runs.run import Laboratory, laboratory

SHORT = 1.0 / 16.0  # s, of a smoke run


@pytest.fixture(scope="module")
def scenario():
    return load_scenario("infrared-and-marker", {"fidelity": "geometric"})


@pytest.fixture(scope="module")
def lab(scenario):
    return laboratory(scenario)


def log_bytes(lab, simulator, folder):
    path = folder / "log.parquet"
    write_log(lab.log(simulator.get_context()), path)
    return path.read_bytes()


@pytest.mark.parametrize("name", scenario_names())
def test_every_scenario_runs_a_fraction_of_a_second(name):
    lab = laboratory(load_scenario(name))
    simulator = lab.start()
    simulator.AdvanceTo(SHORT)
    assert simulator.get_context().get_time() == SHORT


def test_default_scenario_lands(scenario, lab):
    lab.configure(scenario)
    simulator = lab.start()
    result = lab.fly(simulator)
    assert result.landed, result.reason
    assert result.landing_error_m < 0.15
    assert result.touchdown_speed_m_s < 0.7
    assert result.attempts == 1
    body = port_samples(lab.log(simulator.get_context()), "body")
    assert body["p_WB_z"].max() == pytest.approx(10.0, abs=1.0)  # took off to 10 m
    assert body["p_WB_x"].max() > 3.5  # flew its square of 2 m away from the pad


def test_same_seed_same_bytes_another_seed_others(scenario, lab, tmp_path):
    def fly(seed):
        lab.configure(with_overrides(scenario, {"seed": seed}))
        simulator = lab.start()
        lab.fly(simulator)
        return log_bytes(lab, simulator, tmp_path)

    first = fly(1)
    assert fly(2) != first
    assert fly(1) == first


def test_a_cloned_context_goes_on_to_the_same_bytes(scenario, lab, tmp_path):
    lab.configure(scenario)
    whole = lab.start()
    lab.fly(whole)

    half = lab.start()
    half.AdvanceTo(25.6)
    clone = lab.resume(half.get_context().Clone())
    half.AdvanceTo(30.0)  # the original goes its own way
    lab.fly(clone)
    assert log_bytes(lab, clone, tmp_path) == log_bytes(lab, whole, tmp_path)


def test_a_fresh_diagram_gives_the_same_bytes(scenario, lab, tmp_path):
    lab.configure(scenario)
    used = lab.start()
    lab.fly(used)
    fresh = Laboratory(scenario)
    simulator = fresh.start()
    fresh.fly(simulator)
    assert log_bytes(fresh, simulator, tmp_path) == log_bytes(lab, used, tmp_path)


def test_blocks_that_contradict_the_scenario_are_refused(scenario):
    with pytest.raises(ScenarioError, match=r"control\.vehicle is 'iris'"):
        Laboratory(with_overrides(scenario, {"control.vehicle": "iris"}))


def test_memory_of_a_run():
    # In processes of their own: resident memory only ever grows. The first one compiles what is
    # not yet compiled on this machine, which takes LLVM more memory than any flight. VmHWM is
    # the peak of this program alone; ru_maxrss would pass on the peak of the process that
    # started it.
    script = """
import sys
from diagrams.loading import load_scenario
from runs.run import laboratory

def megabytes():
    for line in open("/proc/self/status"):
        if line.startswith("VmHWM"):
            return float(line.split()[1]) / 1024

scenario = load_scenario("infrared-and-marker", {"fidelity": "pixels"})
peaks = []
for _ in range(2):
    laboratory(scenario).fly()
    if "compile" in sys.argv:
        break
    peaks.append(megabytes())
print(*peaks)
"""
    subprocess.run([sys.executable, "-c", script, "compile"], check=True, timeout=600)
    done = subprocess.run(
        [sys.executable, "-c", script], capture_output=True, text=True, check=True, timeout=600
    )
    first, second = map(float, done.stdout.split())
    assert first < 600.0
    assert second - first < 5.0
