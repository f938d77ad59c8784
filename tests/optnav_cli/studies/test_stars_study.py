"""The study of attitudes from stars, with few pictures."""

from catalog.progress import SilentProgress
from optnav_cli.studies import stars


def test_few_pointings_are_all_found_and_no_empty_picture_is(monkeypatch):
    monkeypatch.setattr(stars, "CAMERAS", {"kam_s": 4.5})
    figures = stars.run(SilentProgress(), trials=5)
    (row,), (empty,) = figures.found, figures.empty
    assert row[2:5] == (5, 5, 0)
    assert empty[2] == 0
    assert "Random pointings" in stars.report(figures).to_text()
