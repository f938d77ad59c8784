"""Rasters of others: nothing is asked of a server, no file is read but those in the folder."""

import os
import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
import rasterio
from rasterio.transform import Affine

from catalog.bodies.body import Body
from catalog.errors import DataError
from catalog.rasters import (
    PICTURES,
    TERRAIN,
    encode_geotiff,
    handle_read_errors,
    keep_gdal_settings,
    open_raster,
    reopen_raster,
)
from catalog.terrain.dem.source import DemSettings, DemSource
from tests.catalog.conftest import smooth_grid, write_dem
from tests.catalog.mute_server import MuteServer
from tests.optnav_cli.archives.made_cubes import Cube, write_cube

SRS = (
    '<SRS>GEOGCS["Moon",DATUM["Moon",SPHEROID["Moon",1737400,0]],PRIMEM["0",0],'
    'UNIT["degree",0.0174532925199433]]</SRS><GeoTransform>-180,2.8125,0,90,0,-2.8125</GeoTransform>'
)


@pytest.fixture
def server(monkeypatch: pytest.MonkeyPatch) -> Iterator[MuteServer]:
    """A mute server; Python's own sockets raise, those of the libraries reach the server."""
    made = MuteServer()

    def refused(*_: object) -> None:
        raise AssertionError("something wants the network")

    monkeypatch.setattr(socket.socket, "connect", refused)
    yield made
    made.close()


def dem(path: Path) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return write_dem(path, smooth_grid(64).astype(np.float32))


def mosaic(path: Path, *sources: str, relative: str = "1", extra: str = "", srs: str = SRS) -> Path:
    """A VRT of 128 x 64 pixels."""
    parts = "".join(
        f'<SimpleSource><SourceFilename relativeToVRT="{relative}">{source}</SourceFilename>'
        "<SourceBand>1</SourceBand></SimpleSource>"
        for source in sources
    )
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(
        f'<VRTDataset rasterXSize="128" rasterYSize="64">{srs}{extra}'
        f'<VRTRasterBand dataType="Float32" band="1">{parts}</VRTRasterBand></VRTDataset>'
    )
    return path


def wms(path: Path, url: str) -> Path:
    path.write_text(
        f'<GDAL_WMS><Service name="TMS"><ServerUrl>{url}?${{z}}/${{x}}/${{y}}</ServerUrl></Service>'
        "<DataWindow><UpperLeftX>-180</UpperLeftX><UpperLeftY>90</UpperLeftY><LowerRightX>180"
        "</LowerRightX><LowerRightY>-90</LowerRightY><TileLevel>3</TileLevel><TileCountX>1"
        "</TileCountX><TileCountY>1</TileCountY></DataWindow><Projection>EPSG:4326</Projection>"
        "<BlockSizeX>256</BlockSizeX><BlockSizeY>256</BlockSizeY><BandsCount>1</BandsCount>"
        "</GDAL_WMS>"
    )
    return path


def quickly_refused(path: Path, drivers: tuple[str, ...], server: MuteServer) -> str:
    """The words with which a file is refused, at once and without a call."""
    began = time.monotonic()
    with pytest.raises(DataError) as caught, open_raster(path, drivers) as dataset:
        dataset.read(1)
    assert time.monotonic() - began < 5.0
    assert server.calls == 0
    assert str(path.parent) in str(caught.value)
    return str(caught.value)


@pytest.mark.parametrize("drivers", [PICTURES, TERRAIN], ids=["picture", "terrain"])
def test_the_description_of_a_server_is_no_raster_under_any_name(
    tmp_path: Path, server: MuteServer, drivers: tuple[str, ...]
) -> None:
    path = wms(tmp_path / "frame.png", server.url)
    assert "elsewhere" in quickly_refused(path, drivers, server)
    path.write_text(f"<WCS_GDAL><ServiceURL>{server.url}</ServiceURL></WCS_GDAL>")
    assert "elsewhere" in quickly_refused(path, drivers, server)
    path.write_text('{"stac_version": "1.0.0", "assets": {"a": {"href": "' + server.url + '"}}}')
    assert "elsewhere" in quickly_refused(path, drivers, server)


def test_a_mosaic_is_no_picture(tmp_path: Path, server: MuteServer) -> None:
    dem(tmp_path / "a.tif")
    path = mosaic(tmp_path / "frame.png", "a.tif")
    quickly_refused(path, PICTURES, server)
    with open_raster(path, TERRAIN) as dataset:
        assert dataset.read(1).max() > 1000.0


@pytest.mark.parametrize(
    "source",
    [
        "/vsicurl/{url}",
        "/vsicurl_streaming/{url}",
        "{url}",
        "vrt://{url}",
        "/etc/passwd",
        "../a.tif",
        "sub/../../a.tif",
        "/vsizip/a.zip/a.tif",
        'NETCDF:"a.nc":z',
        "HDF5:a.tif://x",
        "WMS:{url}",
        "link.tif",
        "linked/a.tif",
        "server.tif",
        "list.gti.json",
        " a.tif",
        "&lt;VRTDataset/&gt;",
        "pipe",
        "loop",
    ],
)
@pytest.mark.parametrize("relative", ["0", "1", "true"])
def test_a_mosaic_is_made_of_files_in_its_folder_alone(
    tmp_path: Path, server: MuteServer, source: str, relative: str
) -> None:
    folder = tmp_path / "in"
    dem(folder / "a.tif")
    dem(tmp_path / "a.tif")
    (folder / "link.tif").symlink_to(tmp_path / "a.tif")
    (folder / "linked").symlink_to(tmp_path)
    (folder / "sub").mkdir()
    (folder / "loop").symlink_to("loop")
    os.mkfifo(folder / "pipe")
    wms(folder / "server.tif", server.url)
    (folder / "list.gti.json").write_text('{"type": "FeatureCollection"}')
    path = mosaic(folder / "m.vrt", source.format(url=server.url), relative=relative)
    quickly_refused(path, TERRAIN, server)
    # one mosaic further on, too
    quickly_refused(mosaic(folder / "outer.vrt", "m.vrt"), TERRAIN, server)


def test_mosaics_of_mosaics_below_the_folder_are_read(tmp_path: Path) -> None:
    dem(tmp_path / "parts" / "a.tif")
    mosaic(tmp_path / "parts" / "inner.vrt", "a.tif")
    mosaic(tmp_path / "back" / "b.vrt", "../parts/a.tif")
    whole = str(tmp_path / "parts" / "a.tif")
    path = mosaic(tmp_path / "outer.vrt", "parts/inner.vrt", "back/b.vrt", whole)
    with open_raster(path, TERRAIN) as dataset:
        assert dataset.read(1).max() > 1000.0


@pytest.mark.parametrize(
    "extra",
    [
        '<Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/{url}</MDI></Metadata>',
        '<Metadata domain="GEOLOCATION"><MDI key="X_DATASET">{url}</MDI></Metadata>',
        "<OpenOptions><OOI key='URL'>{url}</OOI></OpenOptions>",
        "<Group name='/'/>",
        '<!DOCTYPE a SYSTEM "{url}">',
    ],
)
def test_a_mosaic_names_files_in_no_other_way(
    tmp_path: Path, server: MuteServer, extra: str
) -> None:
    dem(tmp_path / "a.tif")
    path = mosaic(tmp_path / "m.vrt", "a.tif", extra=extra.format(url=server.url))
    quickly_refused(path, TERRAIN, server)
    path = mosaic(tmp_path / "n.vrt", "a.tif", srs=f"<SRS>{server.url}</SRS>")
    quickly_refused(path, TERRAIN, server)


def test_raw_bytes_are_no_part_of_a_mosaic(tmp_path: Path, server: MuteServer) -> None:
    (tmp_path / "raw.dat").write_bytes(bytes(128 * 64 * 4))
    path = mosaic(tmp_path / "m.vrt", "raw.dat")
    path.write_text(
        path.read_text()
        .replace('band="1"', 'band="1" subClass="VRTRawRasterBand"')
        .replace("<SimpleSource>", "")
        .replace("</SimpleSource>", "")
    )
    quickly_refused(path, TERRAIN, server)


@pytest.mark.parametrize("ending", [".ovr", ".msk", ".aux.xml"])
def test_files_beside_a_model_lead_nowhere_else(
    tmp_path: Path, server: MuteServer, ending: str
) -> None:
    path = dem(tmp_path / "a.tif")
    beside = tmp_path / f"a.tif{ending}"
    if ending == ".aux.xml":
        beside.write_text(
            '<PAMDataset><Metadata domain="OVERVIEWS"><MDI key="OVERVIEW_FILE">/vsicurl/'
            f"{server.url}</MDI></Metadata></PAMDataset>"
        )
    else:
        mosaic(beside, f"/vsicurl/{server.url}", relative="0")
    with pytest.raises(DataError, match="remove it"):
        open_raster(path, TERRAIN)
    beside.unlink()
    os.mkfifo(beside)
    with pytest.raises(DataError, match="no file in its folder"):
        open_raster(path, TERRAIN)
    beside.unlink()
    shutil.copyfile(path, tmp_path / "a.tif.ovr")
    open_raster(path, TERRAIN).close()
    assert server.calls == 0


@pytest.mark.parametrize("name", ["../secret.img", "/etc/passwd", "..\\secret.img", "sub/x.img"])
def test_a_label_names_no_file_outside_its_folder(
    tmp_path: Path, shared_data: Callable[[str], Path], name: str
) -> None:
    folder = tmp_path / "in"
    folder.mkdir()
    label = shared_data("moon/LDEM_4.LBL").read_text()
    (folder / "a.lbl").write_text(label.replace("LDEM_4.IMG", name))
    for place in (tmp_path / "secret.img", folder / "LDEM_4.IMG"):
        shutil.copyfile(shared_data("moon/LDEM_4.IMG"), place)
    for drivers in (PICTURES, TERRAIN):
        with pytest.raises(DataError, match="elsewhere"):
            open_raster(folder / "a.lbl", drivers)
    (folder / "a.lbl").write_text(label)
    open_raster(folder / "a.lbl", TERRAIN).close()
    (folder / "LDEM_4.IMG").unlink()
    (folder / "LDEM_4.IMG").symlink_to(tmp_path / "secret.img")
    with pytest.raises(DataError, match="no file in its folder"):
        open_raster(folder / "a.lbl", TERRAIN)


@pytest.mark.parametrize(
    "crs",
    [
        "{url}",
        "/etc/passwd",
        "passwd.wkt",
        "+proj=longlat +R=1737400 +nadgrids={url}",
        "+proj=longlat +R=1737400 +geoidgrids=/etc/passwd",
        "+proj=pipeline +step +proj=longlat",
        "+init=/etc/passwd:1",
        "urn:ogc:def:crs,{url}",
        "",
        "EPSG:",
        "EPSG:" + "9" * 5000,
        'GEOGCS["a"]',
    ],
)
def test_a_coordinate_system_is_stated_not_fetched(
    tmp_path: Path, server: MuteServer, moon: Body, crs: str
) -> None:
    dem(tmp_path / "a.tif")
    settings = DemSettings(path="a.tif", crs=crs.format(url=server.url))
    began = time.monotonic()
    with pytest.raises(DataError, match=r"a\.tif: "):
        DemSource.open(settings, tmp_path, moon)
    assert time.monotonic() - began < 5.0
    assert server.calls == 0


@pytest.mark.parametrize(
    "crs",
    [
        "IAU_2015:30100",
        "+proj=longlat +R=1737400 +no_defs",
        'GEOGCRS["Moon",DATUM["Moon",ELLIPSOID["Moon",1737400,0]],CS[ellipsoidal,2],'
        'AXIS["latitude",north],AXIS["longitude",east],ANGLEUNIT["degree",0.0174532925199433]]',
    ],
)
def test_codes_wkt_and_proj_strings_are_coordinate_systems(
    tmp_path: Path, moon: Body, crs: str
) -> None:
    dem(tmp_path / "a.tif")
    DemSource.open(DemSettings(path="a.tif", crs=crs), tmp_path, moon).close()


def test_what_is_no_file_is_refused_at_once(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe.tif")
    (tmp_path / "loop.tif").symlink_to("loop.tif")
    (tmp_path / "folder.tif").mkdir()
    bad_name = Path(os.fsdecode(bytes(tmp_path) + b"/caf\xe9.tif"))
    dem(tmp_path / "a.tif").rename(bad_name)
    wanted = {"pipe.tif": "pipe", "loop.tif": "cannot be read", "folder.tif": "folder"}
    for name, words in wanted.items():
        with pytest.raises(DataError, match=words):
            open_raster(tmp_path / name, TERRAIN)
    with pytest.raises(DataError, match=r"caf\\udce9.tif: the name is not UTF-8 text"):
        open_raster(bad_name, TERRAIN)
    with pytest.raises(DataError, match="pipe or a device"):
        open_raster(Path("/dev/zero"), PICTURES)


def test_declared_sizes_are_bounded_before_memory_is_taken(tmp_path: Path) -> None:
    path = mosaic(tmp_path / "huge.vrt")
    huge = path.read_text().replace('"128"', '"2000000000"').replace('"64"', '"2000000000"')
    path.write_text(huge)
    with pytest.raises(DataError, match="2000000000 x 2000000000 pixels"):
        open_raster(path, TERRAIN)
    with rasterio.open(
        tmp_path / "strip.tif",
        "w",
        driver="GTiff",
        width=60000,
        height=60000,
        count=1,
        dtype="float64",
        blockysize=60000,
        compress="deflate",
        sparse_ok=True,
        transform=Affine.translation(1.0, 1.0),
    ):
        pass
    with pytest.raises(DataError, match=r"blocks of 60000 x 60000, 26\.8 GiB each"):
        open_raster(tmp_path / "strip.tif", TERRAIN)


def test_a_name_in_a_header_that_is_no_utf_8_is_refused(tmp_path: Path) -> None:
    path = dem(tmp_path / "dem.tif")
    data = path.read_bytes()
    assert b"unknown" in data  # the name of its coordinate system
    path.write_bytes(data.replace(b"unknown", b"unkn\xfewn"))
    with pytest.raises(DataError, match=r"dem\.tif: a text of its header is not UTF-8"):
        open_raster(path, TERRAIN)


def test_a_label_that_names_a_file_in_no_utf_8_is_refused_quietly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    """GDAL's words about it hold the name, which makes rasterio print a traceback."""
    label = tmp_path / "a.lbl"
    label.write_bytes(b'PDS_VERSION_ID = PDS3\r\n^IMAGE = "\xff\xffimg"\r\nEND\r\n')
    with pytest.raises(DataError, match=r"a\.lbl: the name of a file in it is not UTF-8 text"):
        open_raster(label, PICTURES)
    assert capfd.readouterr().err == ""


def test_a_cube_with_a_layout_in_no_utf_8_is_refused_quietly(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    cube = write_cube(tmp_path / "a.cub", Cube())
    cube.write_bytes(cube.read_bytes().replace(b"BandSequential", b"BandSequ\x82ntial"))
    with pytest.raises(DataError, match=r"a\.cub: a text of its header is not UTF-8"):
        reopen_raster(cube, ("ISIS3",))
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("kind", ["complex_int16", "complex64"])
def test_complex_numbers_are_no_heights(kind: str, tmp_path: Path) -> None:
    """numpy has no name for the first of them."""
    with rasterio.open(
        tmp_path / "c.tif", "w", driver="GTiff", width=4, height=4, count=1, dtype=kind,
        transform=Affine(2, 0, 0, 0, -2, 0),
    ):  # fmt: skip
        pass
    with pytest.raises(DataError, match=r"c\.tif: holds complex numbers"):
        open_raster(tmp_path / "c.tif", TERRAIN)


@pytest.mark.parametrize("name", ["dem.IMD", "dem.RPB", "dem_rpc.txt"])
def test_a_pipe_in_the_place_of_metadata_is_not_waited_for(tmp_path: Path, name: str) -> None:
    path = dem(tmp_path / "dem.tif")
    os.mkfifo(tmp_path / name)
    with pytest.raises(DataError, match="is a pipe or a device beside a raster"):
        open_raster(path, TERRAIN)


@pytest.mark.parametrize(
    "name", ["GDAL_DATA", "PROJ_DATA", "PROJ_LIB", "PROJ_NETWORK", "GDAL_CACHEMAX"]
)
def test_a_setting_of_the_environment_that_is_no_utf_8_is_passed_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    path = dem(tmp_path / "dem.tif")
    monkeypatch.setenv(name, "\udcff")
    with open_raster(path, TERRAIN) as dataset:
        assert dataset.count == 1
    monkeypatch.setenv(name, "\udcff")
    place = {"transform": Affine.translation(1.0, 1.0)}
    assert encode_geotiff({"height": np.zeros((4, 4), np.float32)}, place).startswith(b"II*")


def test_settings_are_held_for_a_threads_readings_and_then_let_go() -> None:
    """Offline all the while; a reading that wants other settings has them and gives them back."""

    def found() -> tuple[object, object]:
        options = rasterio.env.getenv()
        return options["GDAL_DISABLE_READDIR_ON_OPEN"], options["CPL_VSIL_CURL_ALLOWED_FILENAME"]

    with keep_gdal_settings():
        for siblings, beside in ((True, "FALSE"), (False, "EMPTY_DIR"), (True, "FALSE")):
            with handle_read_errors(Path("any.tif"), siblings=siblings):
                assert found() == (beside, "none")
        outside: list[bool] = []
        thread = threading.Thread(target=lambda: outside.append(rasterio.env.hasenv()))
        thread.start()
        thread.join()
        assert outside == [False]
    assert not rasterio.env.hasenv()
    with handle_read_errors(Path("any.tif")):
        assert found() == ("FALSE", "none")
