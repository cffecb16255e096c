"""The documentation's blocks about searches."""

from studies.falsification import falsify
from studies.search_pages import write
from studies.sensitivity import analyse

TOY = "tests.studies.toy_landing:ToyLanding"
PAGE = "# A page\n\n<!-- found -->\nold\n<!-- end -->\n\nThe rest.\n"


def test_blocks_are_written_anew(tmp_path):
    for name in ("falsification", "sensitivity"):
        (tmp_path / f"{name}.md").write_text(PAGE)
    options = {"workers": 0, "progress": False, "experiment": TOY}
    wind = falsify("marker-landing", tmp_path / "a", ("wind",), 60, **options)
    falsify("marker-landing", tmp_path / "b", ("latency",), 60, **options)
    analyse("marker-landing", tmp_path / "c", ("wind",), 30, **options)
    write([tmp_path / name for name in "abc"], tmp_path)

    text = (tmp_path / "falsification.md").read_text()
    assert f"`marker-landing` | {wind.space.describe(wind.best.point)}" in text
    assert "nothing of latency" in text
    assert "lands at the limit of: latency" in text
    assert "old" not in text
    assert text.endswith("The rest.\n")
    assert "most by wind" in (tmp_path / "sensitivity.md").read_text()
    assert (tmp_path / "data" / "sensitivity-marker-landing-morris.svg").is_file()
