"""The 3-D replay takes as long as the flight, and shows the pad as the cameras know it."""

import numpy as np
import pyarrow as pa
import pytest

from diagrams.loading import load_scenario
from runs import replay_3d
from systems.signals.measurement import BODY_STATE, PAD_STATE


def log_of(times: np.ndarray) -> pa.Table:
    """A log of a vehicle at rest over a pad at rest, recorded at `times` (s)."""
    columns = {"time": times}
    for port, layout in (("body", BODY_STATE), ("pad", PAD_STATE)):
        columns |= {f"{port}.{field}": np.zeros(len(times)) for field in layout.fields}
    columns["body.q_WB_w"] = np.ones(len(times))
    return pa.table(columns)


@pytest.mark.parametrize("period", [0.04, 0.08])
def test_each_sample_is_shown_at_its_time(monkeypatch, period):
    shown = []

    def move(scene, body, pad, time=None):
        if time is not None:
            shown.append(time)

    monkeypatch.setattr(replay_3d, "move", move)
    times = period * np.arange(200)
    scenario = load_scenario("marker-landing", {"recording.period": period})
    page = replay_3d.replay_html(scenario, log_of(times))
    assert page.startswith("<!DOCTYPE html>")
    # Meshcat shows the frame that a time lies in
    np.testing.assert_array_equal(np.floor(np.array(shown) / period), np.arange(200))


@pytest.mark.parametrize(
    ("name", "marker", "leds"),
    [
        ("svgs-high-altitude", False, True),
        ("infrared-high-altitude", False, False),
        ("marker-landing", True, False),
    ],
)
def test_the_pad_has_what_the_cameras_look_for(name, marker, leds):
    scene = replay_3d._scene(load_scenario(name))
    assert scene.HasPath("/plumbline/pad/board")
    assert scene.HasPath("/plumbline/pad/level0") == marker
    assert scene.HasPath("/plumbline/pad/long_led3") == leds
