"""The report's section on SVGS beacons."""

import numpy as np
import pytest
from bokeh.plotting import figure

from diagrams.loading import load_scenario
from runs.plots import RunPlots
from runs.run import Laboratory
from runs.svgs_plots import BEACON_COLOURS, SvgsPlots
from systems.estimators.ekf2_selector import selection_layout

YAW = 0.7


@pytest.fixture(scope="module")
def plots() -> SvgsPlots:
    scenario = load_scenario(
        "svgs-high-altitude",
        {"fidelity": "geometric", "guidance.mission.altitude": 9.0, "vehicle.yaw": YAW},
    )
    laboratory = Laboratory(scenario)
    simulator = laboratory.start()
    simulator.AdvanceTo(36.0)
    log = laboratory.log(simulator.get_context())
    return SvgsPlots(log, laboratory.landing.state_names(), scenario)


def renderers(plot: figure) -> dict[str, list]:
    return {item.label.value: item.renderers for legend in plot.legend for item in legend.items}


def test_poses_are_where_the_vehicle_was(plots: SvgsPlots):
    seen = plots.sightings
    assert len(seen["time"]) > 50
    assert set(seen["beacon"]) <= {0.0, 1.0, 2.0}
    forward, left, up = plots._track(plots.body)
    for name, true in (("f", forward), ("l", left), ("u", up)):
        error = seen[name] - np.interp(seen["time"], plots.body["time"], true)
        assert np.median(np.abs(error)) < 0.2


def test_the_frame_is_that_of_the_vehicle_before_take_off(plots: SvgsPlots):
    ahead = np.array([np.cos(YAW)]), np.array([np.sin(YAW)])
    np.testing.assert_allclose(plots._flu(*ahead), [[1.0], [0.0]], atol=1e-12)


def test_states_passed_through_have_no_row(plots: SvgsPlots):
    shown = RunPlots(plots.log, plots.states).supervisor_state()
    (bars,) = shown.renderers
    data = bars.data_source.data
    flown = {plots.states[int(i)] for i in plots.supervisor["state"]}
    left_at_once = {f"fly to waypoint {i}" for i in (1, 2, 3, 4)}  # the mission has no square
    assert left_at_once < flown
    assert not left_at_once & set(shown.y_range.factors)
    assert {"wait", "climb", "hover", "align"} <= set(shown.y_range.factors)
    assert set(data["y"]) == set(shown.y_range.factors)
    longest = dict.fromkeys(data["y"], 0.0)
    for name, left, right in zip(data["y"], data["left"], data["right"], strict=True):
        longest[name] = max(longest[name], right - left)
    assert min(longest.values()) > 0.1


def test_layout_has_the_papers_figures(plots: SvgsPlots):
    titles = [plot.title.text for plot in plots.layout().select({"type": figure})]
    for title in ("Landing zone", "Trajectory", "Forward", "Left", "Up", "Beacon hand-over"):
        assert title in titles
    assert "Distance from the point aligned with" in titles
    assert not [title for title in titles if "EKF2" in title]  # one instance: nothing to select


def test_a_pose_has_the_colour_of_its_beacon(plots: SvgsPlots):
    drawn = renderers(plots.along(2))
    for beacon, name in enumerate(("short", "medium", "long")):
        (dots,) = drawn[f"SVGS, {name}-range"]
        assert dots.glyph.fill_color == BEACON_COLOURS[beacon]
        assert len(dots.data_source.data["x"]) == np.sum(plots.sightings["beacon"] == beacon)
    assert sum(plots.sightings["beacon"] == 0) > 0


def test_distance_shrinks_in_the_alignment(plots: SvgsPlots):
    (line,) = renderers(plots.alignment())["approach point"]
    distance = line.data_source.data["y"]
    assert distance[0] > 1.0
    assert distance[-1] < 0.5 * distance[0]


@pytest.fixture
def selection(plots: SvgsPlots, monkeypatch) -> dict[str, np.ndarray]:
    """Instance 0 hands over to 2 at 30 s, on the left; instance 0 is ill from then on."""
    time = plots.body["time"]
    after = time >= 30.0
    samples = {name: np.zeros_like(time) for name in ("time", *selection_layout(3).fields)}
    samples["time"], samples["selected"], samples["changes"] = time, 2.0 * after, 1.0 * after
    samples["changed"] = 30.0 * after
    samples["position_jump_x"] = -0.4 * np.sin(YAW) * after
    samples["position_jump_y"] = 0.4 * np.cos(YAW) * after
    for i in range(3):
        samples[f"combined_test_ratio_{i}"] = np.full_like(time, 0.1 * (i + 1))
        samples[f"healthy_{i}"] = 1.0 - after if i == 0 else np.ones_like(time)
    port = RunPlots.port
    monkeypatch.setattr(
        RunPlots, "port", lambda self, name: samples if name == "selection" else port(self, name)
    )
    return samples


def test_a_change_of_instance_is_drawn(plots: SvgsPlots, selection: dict[str, np.ndarray]):
    titles = [plot.title.text for plot in plots.layout().select({"type": figure})]
    assert "Instance 0 hands over to 2 at 30.0 s" in titles
    change = plots.change()
    assert change.yaxis[0].axis_label == "left (m)"
    (truth,) = renderers(change)["truth"]
    np.testing.assert_allclose(truth.data_source.data["x"][[0, -1]], [27.0, 33.0], atol=0.1)
    drawn = renderers(plots.instances())
    assert set(drawn) == {"instance 0", "instance 0 unhealthy", "instance 1", "instance 2"}
    _, chosen = drawn["instance 2"]
    np.testing.assert_array_equal(
        np.isfinite(chosen.data_source.data["y"]), selection["selected"] == 2.0
    )


def test_no_change_in_flight(plots: SvgsPlots, selection: dict[str, np.ndarray]):
    selection["changes"][:] = 0.0
    assert plots.change().title.text == "No change of instance in flight"
