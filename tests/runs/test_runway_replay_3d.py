"""The 3-D replay and the live view of a landing without GPS."""

import dataclasses

import pytest

from diagrams.loading import load_scenario
from plants.recorded_flight import RecordedFlightConfig
from runs import runway_replay_3d
from runs.replay_3d import meshcat
from runs.run import laboratory


@pytest.fixture(scope="module")
def flown():
    """Three seconds of the full procedure, and their log."""
    lab = laboratory(dataclasses.replace(load_scenario("landing-without-gps"), time_limit=3.0))
    simulator = lab.start()
    lab.fly(simulator)
    return lab, lab.log(simulator.get_context())


@pytest.mark.parametrize(("frames", "every"), [(3000, 1), (10, 4)])
def test_the_replay_takes_as_long_as_the_flight(flown, monkeypatch, frames, every):
    lab, log = flown
    shown = []

    def move(scene, samples, runway, lens, path, time=None):
        shown.append((time, samples["state"][0], samples["estimate"][1]))

    monkeypatch.setattr(runway_replay_3d, "move_world", move)
    monkeypatch.setattr(runway_replay_3d, "_FRAMES", frames)
    page = runway_replay_3d.runway_replay_html(lab.scenario, log)
    assert page.startswith("<!DOCTYPE html>")
    period = 0.08 * every
    assert [int(time / period) for time, _, _ in shown] == list(range(len(shown)))
    assert len(shown) * period == pytest.approx(3.0, abs=2.0 * period)
    assert shown[0][1] != shown[-1][1]
    assert shown[-1][2] == 1.0  # the estimate is known by then


def test_the_live_view_follows_the_simulation(monkeypatch):
    lab = laboratory(dataclasses.replace(load_scenario("landing-without-gps"), time_limit=3.0))
    times = []
    monkeypatch.setattr(
        runway_replay_3d, "move_world", lambda scene, samples, *_: times.append(samples["state"][0])
    )
    simulator = lab.start()
    simulator.set_monitor(runway_replay_3d.runway_live_view(lab.landing, lab.scenario))
    simulator.AdvanceTo(1.0)
    assert len(set(times)) == pytest.approx(25, abs=2)
    for part in ("terrain", "runway/asphalt", "aircraft/fuselage", "estimate/fuselage", "station"):
        assert meshcat().HasPath(f"/plumbline/world/{part}")


def test_a_recorded_flight_has_a_picture_too():
    scenario = dataclasses.replace(
        load_scenario("landing-without-gps-final"), aircraft=RecordedFlightConfig()
    )
    scene = runway_replay_3d._scene(scenario)
    assert scene.HasPath("/plumbline/world/plan")
