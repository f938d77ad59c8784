"""Star catalogues of the user's own: what they must say, and what is refused."""

import logging
from pathlib import Path

import numpy as np
import pytest

from catalog.bodies.stars import (
    EPOCHS,
    GAIA,
    KEYWORDS,
    MAS,
    NAMES,
    load_bright_stars,
    read_star_catalog,
)
from catalog.errors import DataError

HEAD = "ra_deg,dec_deg,pm_ra_mas_yr,pm_dec_mas_yr,mag"
ROWS = ["10.0,20.0,100.0,-50.0,8.5", "190.0,-60.0,-3.0,4.0,7.0", "200.0,0.0,,,8.0"]


def written(path: Path, head: str = HEAD, rows: list[str] | None = None) -> Path:
    file = path / "own.csv"
    file.write_text("\n".join([head, *(ROWS if rows is None else rows)]) + "\n")
    return file


def test_places_motions_and_magnitudes_are_read_the_brightest_first(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        stars = read_star_catalog(written(tmp_path), 2016.0)
    assert stars.magnitudes.tolist() == [7.0, 8.0, 8.5]
    assert "1 stars without a proper motion stand still" in caplog.text
    ra, dec = np.radians([10.0, 20.0])
    wanted = [np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)]
    assert np.allclose(stars.directions[2], wanted, atol=1e-14)
    assert stars.label(2) == "row 2"
    # 9 years on, each along its own motion: 100 and -50 mas a year
    later = stars.propagate((2025.0 - 2000.0) * 365.25 * 86400.0)
    moved = (later - stars.directions) / (9.0 * MAS)
    assert np.allclose(np.linalg.norm(moved, axis=1), [5.0, 0.0, np.hypot(100.0, 50.0)], atol=1e-3)
    assert moved[2] @ [-np.sin(ra), np.cos(ra), 0.0] == pytest.approx(100.0, abs=1e-3)


def test_the_shipped_stars_come_back_through_a_table(tmp_path: Path) -> None:
    ours = load_bright_stars()
    assert len(ours.magnitudes) == 9928
    assert ours.magnitudes[8869] <= 6.5 < ours.magnitudes[8870]
    source = Path(__file__).resolve().parents[3] / "catalog/data/bright_stars.csv"
    again = read_star_catalog(source, 1991.25)
    assert np.allclose(again.propagate(8e8), ours.propagate(8e8), atol=1e-15)
    assert again.label(0) == "Sirius"
    assert again.label(9000) == ours.label(9000)


def test_each_star_may_have_its_own_epoch(tmp_path: Path) -> None:
    rows = ["10.0,20.0,100.0,0.0,8.0,2016.0", "10.0,20.0,100.0,0.0,8.5,1991.25"]
    stars = read_star_catalog(written(tmp_path, HEAD + ",epoch", rows))
    now = stars.propagate(None)
    apart = np.linalg.norm(now[1] - now[0]) / MAS
    assert apart == pytest.approx(24.75 * 100.0, rel=1e-6)
    with pytest.raises(DataError, match="2000 is stated beside it"):
        read_star_catalog(tmp_path / "own.csv", 2000.0)


def test_a_table_of_the_gaia_archive_is_taken_as_it_is(tmp_path: Path) -> None:
    head = "source_id,ref_epoch,ra,dec,parallax,pmra,pmdec,phot_g_mean_mag"
    rows = ["4472832130942575872,2016.0,269.44850,4.73942,546.9,-801.5,10362.3,8.19",
            "11,2016.0,10.0,-30.0,null,null,null,9.9"]  # fmt: skip
    stars = read_star_catalog(written(tmp_path, head, rows))
    assert stars.label(0) == "Gaia 4472832130942575872"
    moved = (stars.propagate(0.0)[0] - stars.directions[0]) / MAS
    assert np.linalg.norm(moved) == pytest.approx(16.0 * np.hypot(801.5, 10362.3), rel=1e-4)
    # without Gaia's magnitude the names say no unit
    with pytest.raises(DataError, match=r"no column 'ra_deg'; its column 'ra' names no unit"):
        read_star_catalog(written(tmp_path, head.replace("phot_g_mean_mag", "mag"), rows))


@pytest.mark.parametrize(
    ("head", "rows", "words"),
    [
        (HEAD, None, "states no epoch.*--epoch"),
        (HEAD.replace(",mag", ""), ["1,2,3,4"], "no column 'mag'"),
        (HEAD, ["1,2,3,4"], "row 2 has 4 cells, the header 5"),
        (HEAD, ["370,2,3,4,5"], "row 2, ra_deg: 370; wanted degrees"),
        (HEAD, ["1,-91,3,4,5"], "row 2, dec_deg: -91"),
        (HEAD, ["1,2,3,99999,5"], "row 2, pm_dec_mas_yr: 99999; wanted mas/yr"),
        (HEAD, ["1,2,3,4,95"], "row 2, mag: 95"),
        (HEAD, ["00:00:12.8,2,3,4,5"], "row 2, ra_deg: '00:00:12.8' is no number"),
        (HEAD, ["1,2,3,4,"], "no star has a magnitude"),
        (HEAD, [], "has no stars"),
        (HEAD + ",mag", ["1,2,3,4,5,6"], "the column 'mag' twice"),
        (HEAD + ",v_mag", ["1,2,3,4,5,6"], "both 'mag' and 'v_mag'"),
        (HEAD + ",epoch", ["1,2,3,4,5,2457389"], "row 2, epoch: 2457389; wanted a Julian year"),
    ],
)
def test_what_no_star_has_is_refused(
    head: str, rows: list[str] | None, words: str, tmp_path: Path
) -> None:
    epoch = None if words.startswith(("states", "row 2, epoch")) else 2016.0
    with pytest.raises(DataError, match=words):
        read_star_catalog(written(tmp_path, head, rows), epoch)


@pytest.mark.parametrize(("scale", "words"), [(1.0 / 15.0, "as hours"), (np.pi / 180, "radians")])
def test_a_sky_in_hours_or_radians_is_named(scale: float, words: str, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    dec = np.degrees(np.arcsin(rng.uniform(-1.0, 1.0, 300))) * (1.0 if scale > 0.05 else scale)
    rows = [
        f"{a * scale:.6f},{b:.6f},0,0,8" for a, b in zip(rng.uniform(0, 360, 300), dec, strict=True)
    ]
    with pytest.raises(DataError, match=words):
        read_star_catalog(written(tmp_path, HEAD, rows), 2016.0)


@pytest.mark.parametrize("name", [n for n, key in KEYWORDS.items() if key.fate == "refused"])
def test_columns_of_other_units_and_frames_are_refused(name: str, tmp_path: Path) -> None:
    head = f"{HEAD},{name}"
    file = written(tmp_path, head, ["1,2,3,4,5,B1950", "1,2,3,4,5,B1950"])
    with pytest.raises(DataError, match=rf"states {name} = B1950; wanted"):
        read_star_catalog(file, 2016.0)
    for allowed in KEYWORDS[name].allowed:
        file = written(tmp_path, head, [f"1,2,3,4,5,{allowed}"])
        assert len(read_star_catalog(file, 2016.0).magnitudes) == 1


def test_every_name_of_a_quantity_is_a_keyword() -> None:
    for name in (*(n for names in NAMES.values() for n in names), *GAIA.values(), *EPOCHS):
        assert KEYWORDS[name].fate == "used"
