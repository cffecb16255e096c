"""The report's section on SVGS beacons."""

import numpy as np
import pytest
from bokeh.plotting import figure

from diagrams.loading import load_scenario
from runs.run import Laboratory
from runs.svgs_plots import BEACON_COLOURS, SvgsPlots

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
