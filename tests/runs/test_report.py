"""The report is one self-contained page that a browser shows without complaint."""

import re
import shutil
import subprocess

import cv2
import pytest

from diagrams.loading import load_scenario
from runs.flight import fly_and_report


@pytest.fixture(scope="module")
def page(tmp_path_factory):
    folder = tmp_path_factory.mktemp("report")
    scenario = load_scenario("infrared-and-marker", {"fidelity": "geometric", "seed": 5})
    fly_and_report(scenario, folder)
    return folder / "report.html"


def test_it_is_self_contained(page):
    text = page.read_text()
    # Nothing is loaded from elsewhere: no element names a source outside the page.
    for element in ("script", "link", "img", "iframe"):
        assert not re.findall(rf'<{element}[^>]*(?:src|href)="(?:https?:)?//', text), element
    assert text.count("data:image/jpeg;base64,") >= 10


def test_it_has_its_sections(page):
    text = page.read_text()
    for anchor in ("replay", "plots", "cameras", "states", "wiring", "scenario"):
        assert f'id="{anchor}"' in text
    assert "descend on target" in text or "descend_on_target" in text


def browser():
    for name in ("chromium", "chromium-browser", "google-chrome"):
        if shutil.which(name):
            return name
    pytest.skip("no Chromium to open the report in")
    return None


def test_a_browser_shows_it(page, tmp_path):
    picture = tmp_path / "report.png"
    done = subprocess.run(
        [
            browser(), "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic",
            "--no-first-run", "--disable-background-networking", "--disable-component-update",
            "--disable-sync", "--enable-logging=stderr", f"--user-data-dir={tmp_path / 'profile'}",
            "--window-size=1280,4000", "--virtual-time-budget=2000",
            f"--screenshot={picture}", page.as_uri(),
        ],
        capture_output=True, text=True, timeout=400, check=False,
    )  # fmt: skip
    assert picture.exists(), done.stderr[-500:]
    errors = [line for line in done.stderr.splitlines() if "CONSOLE" in line and "Error" in line]
    assert not errors, errors
    # The plots are drawn by script: without it the middle of the page would be blank.
    image = cv2.imread(str(picture))
    middle = image[1200:3500, 100:1180]
    colours = len({tuple(pixel) for pixel in middle[::7, ::7].reshape(-1, 3)})
    assert colours > 50
