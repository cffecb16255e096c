"""The SVGS benchmark's tables, at a few frames a row."""

from benchmarks.svgs_camera import GLINTS, HEIGHTS, accuracy_table, glint_table


def test_accuracy_is_near_the_bound():
    rows = [row.split() for row in accuracy_table("geometric", frames=60)[2:]]
    assert [float(row[0]) for row in rows] == list(HEIGHTS)
    for row in rows:
        lateral, lateral_bound, distance, distance_bound = (float(x) for x in row[3:7])
        assert lateral < 2.0 * lateral_bound
        assert distance < 2.0 * distance_bound


def test_glint_table_has_both_variants():
    rows = [row.split() for row in glint_table(frames=40)[1:]]
    assert len(rows) == 2 * len(GLINTS)
    assert {row[1] for row in rows} == {"published", "robust"}
    assert all(float(row[3]) == 0.0 for row in rows if row[1] == "robust")
