"""Run folders, work folders and older outputs: files gone, damaged, or not what they say."""

import json
import shutil
from pathlib import Path

from tests.fuzz.cases import DATA, NOTHING, OK, USAGE, Case, Place, kind
from tests.fuzz.damage import damaged
from tests.fuzz.kinds.meshes import changed_json
from tests.fuzz.materials import BOX, HALF_DONE

READ = frozenset({OK, DATA, NOTHING})
FILES = (
    "manifest.json", "solution.csv", "matches.csv", "frames.csv", "run.toml", "evaluation.json", "evaluation.csv", "cameras/cam.toml",
    "run.mcap", "overlays/frame_0000.png",
)  # fmt: skip


@kind("run-file", 0.8)
def files(place: Place) -> Case:
    """A run one of whose files is gone, damaged, empty, a folder, or of another run."""
    rng = place.rng
    place.take("run", "pictures/truth.csv")
    name = rng.choice(FILES)
    path = place.folder / "run" / name
    way = rng.choice(("gone", "damaged", "damaged", "damaged", "empty", "folder", "loop", "json"))
    if not path.exists():
        way = "not there"
    elif way == "damaged":
        data, way = damaged(path.read_bytes(), rng)
        path.write_bytes(data)
    elif way == "json" and name.endswith(".json"):
        data_ = json.loads(path.read_text())
        way = changed_json(data_, rng)
        path.write_text(json.dumps(data_))
    else:
        path.unlink()
        if way == "empty":
            path.write_bytes(b"")
        elif way == "folder":
            path.mkdir()
        elif way == "loop":
            path.symlink_to(path.name)
    return _read(place, f"{name}: {way}")


def _read(place: Place, note: str) -> Case:
    rng = place.rng
    job = rng.choice(("report", "report", "svg", "evaluate", "navigate", "export"))
    if job == "evaluate":
        left = ("run/evaluation.json", "run/evaluation.csv")
        args = ("-q", "evaluate", "run", "--truth", "pictures/truth.csv")
        return Case(args, READ, leaves=left, note=note)
    if job == "navigate":  # onto the run, which may not look like one of ours any more
        place.take("pictures", "moon.gpkg")
        args = ("-q", "navigate", "pictures", "--catalog", "moon.gpkg", "-o", "run")
        return Case(args, READ, "run", frozenset({OK, NOTHING}), note=note)
    if job == "export":
        return Case(("-q", "export", "run", "-o", "new.gpkg"), READ, "new.gpkg", note=note)
    ending = "html" if job == "report" else "svg"
    return Case(("-q", "report", "run", "-o", f"new.{ending}"), READ, f"new.{ending}", note=note)


@kind("run-manifest", 1.5)
def manifests(place: Place) -> Case:
    """A folder whose manifest is nested, of another kind, or nonsense is not replaced."""
    rng = place.rng
    place.take("pictures", "moon.gpkg")
    place.write("old/diary.txt", "mine")
    text = rng.choice((
        '{"made_by": "optnav", "kind": "pictures"}', '{"made_by": "optnav", "kind": ["run"]}', '{"made_by": {"optnav": 1}, "kind": "run"}',
        "[" * 100_000, '{"a":' * 30_000, "null", "1", '"run"', "[]", "{}", "", "\x00", "9" * 6000, '{"kind": "run"}', '{"made_by": "optnav"}', "NaN",
        '{"made_by": "someone", "kind": "run"}', '{"made_by": "optnav", "kind": null}', '{"kind": "run", "kind": "x", "made_by": "optnav"}',
    ))  # fmt: skip
    place.write("old/manifest.json", text)
    args = ("-q", "navigate", "pictures", "--catalog", "moon.gpkg", "-o", "old")
    return Case(args, frozenset({DATA}), note=f"manifest {text[:60]!r}")


def _spoiled(place: Place, folder: Path) -> str:
    """Take away, damage or replace one of the files of a folder; which and how."""
    rng = place.rng
    path = rng.choice(sorted(path for path in folder.rglob("*") if path.is_file()))
    way = rng.choice(("gone", "damaged", "damaged", "damaged", "folder"))
    if way == "damaged":
        data, way = damaged(path.read_bytes(), rng)
        path.write_bytes(data)
    else:
        path.unlink()
        if way == "folder":
            path.mkdir()
    return f"{path.relative_to(place.folder)}: {way}"


@kind("run-half", 0.4)
def halves(place: Place) -> Case:
    """A navigation that goes on in a work folder one of whose files is damaged."""
    place.take("pictures", "moon.gpkg", "half.work")
    note = _spoiled(place, place.folder / "half.work")
    workers = place.rng.choice(("1", "1", "1", "2"))
    args = ("-q", *HALF_DONE, "--workers", workers)
    return Case(args, READ, "half", frozenset({OK, NOTHING}), ("half.work",), note=note)


@kind("run-scheduler", 0.1)
def schedulers(place: Place) -> Case:
    """A scheduler where there is none, or that is no address."""
    place.take("pictures", "moon.gpkg")
    dead = ("tcp://127.0.0.1:9", "tcp://127.0.0.1:1", "tcp://[::1]:9", "tcp://localhost:65535")
    no_address = (
        "", "tcp://", "nonsense", "127.0.0.1:9", "http://127.0.0.1:9", "tcp://127.0.0.1", "tcp://127.0.0.1:99999", "tcp://127.0.0.1:-1",
        "tcp://[::1:9", "tcp://:8786", "tcp://127.0.0.1:0x9", "tcp://\u0661:9", "tcp://a b:9", "file:///etc/passwd", "tcp://127.0.0.1:9/../x",
    )  # fmt: skip
    address = place.rng.choice((*dead, *no_address))
    args = ("-q", *HALF_DONE, "--scheduler", address)
    codes = frozenset({DATA} if address in dead else {DATA, USAGE})
    return Case(args, codes, note=f"scheduler {address!r}", network=True)


@kind("run-work", 0.6)
def works(place: Place) -> Case:
    """A build that goes on in a work folder one of whose files is damaged."""
    rng = place.rng
    place.take("moon.toml", "dem.tif")
    shutil.copytree(place.materials / "moon.gpkg.work", place.folder / "w", dirs_exist_ok=True)
    note = _spoiled(place, place.folder / "w")
    args = (
        "-q",
        "build",
        "moon.toml",
        "--work",
        "w",
        "-o",
        "new.gpkg",
        "--workers",
        "1",
        "--bbox",
        "10,20,12,21",
    )
    if rng.random() < 0.3:
        stage = rng.choice(("ingest", "render", "select", "check"))
        args = ("-q", stage, "moon.toml", "--work", "w", "--workers", "1", "--bbox", "10,20,12,21")
        return Case(args, READ | {USAGE}, leaves=("w",), note=note)
    return Case(args, READ, "new.gpkg", frozenset({OK, NOTHING}), ("w",), note=note)


@kind("run-stages", 0.2)
def stages(place: Place) -> Case:
    """A stage of a build without those before it, or with another box or config."""
    rng = place.rng
    place.take("moon.toml", "dem.tif")
    stage = rng.choice(("render", "select", "check", "write"))
    if rng.random() < 0.5:
        shutil.copytree(place.materials / "moon.gpkg.work", place.folder / "w", dirs_exist_ok=True)
        box = rng.choice((BOX, "10,20,12,21", "10,20,13,21", "-180,-90,180,90", "170,-5,-170,5"))
    else:
        box = BOX
        place.write("w/mine.txt", "mine")
    more = ("-o", "new.gpkg") if stage == "write" else ()
    args = ("-q", stage, "moon.toml", "--work", "w", "--workers", "1", "--bbox", box, *more)
    codes = READ | {USAGE}
    if (place.folder / "w/mine.txt").exists():
        return Case(args, frozenset({DATA}), note=f"{stage} in a foreign folder")
    output = "new.gpkg" if more else None
    return Case(args, codes, output, frozenset({OK, NOTHING}), ("w",), note=f"{stage} of {box}")
