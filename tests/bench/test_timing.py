"""The table that the benches keep."""

import pytest

from tests.bench import timing
from tests.studies.tables import StudyReport


@pytest.mark.parametrize(
    ("whole", "wanted"), [(True, {"a": "3 ms"}), (False, {"a": "3 ms", "b": "2 ms"})]
)
def test_a_part_of_the_benches_replaces_its_own_rows_alone(tmp_path, monkeypatch, whole, wanted):
    monkeypatch.setattr(timing, "STORED", tmp_path / "bench.json")
    monkeypatch.setattr(timing, "FOUND", {})
    timing.result("a", "1 ms")
    timing.result("b", "2 ms", "limit 5 ms")
    timing.store(whole=True)
    timing.FOUND.clear()
    timing.result("a", "3 ms")
    timing.store(whole)
    (table,) = StudyReport.from_json(timing.STORED.read_text(encoding="utf-8")).tables
    assert {row[0]: row[1] for row in table.rows} == wanted
