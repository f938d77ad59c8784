"""Navigate a picture folder: every row of frames.csv becomes a row of solution.csv."""

import hashlib
import logging
from collections.abc import Iterator, Mapping
from contextlib import closing
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from catalog.bodies.body import is_body_file
from catalog.errors import NothingToDoError, OutputError
from catalog.files import hash_file, replace_folder
from catalog.jobs.cluster import check_address, start_cluster_workers
from catalog.jobs.usage import StageAccount
from catalog.jobs.workers import Workers, count_cores, make_workers
from catalog.jobs.workspace import (
    ChunkResults,
    Workspace,
    compute_stage_key,
    decode_records,
    encode_records,
    hash_package,
)
from catalog.places import check_apart
from catalog.progress import Progress, log_stage
from optnav_cli.camera.camera import Camera
from optnav_cli.fix import MatchRow, Method, Solution
from optnav_cli.frames.orbit_tables import ZENITH
from optnav_cli.frames.points import POINTS_CSV
from optnav_cli.frames.run_settings import RUN_TOML
from optnav_cli.navigate.answers import FrameRecord, FrameTask, make_empty_record, unpack_row
from optnav_cli.navigate.autonomous import Navigator
from optnav_cli.navigate.descent.navigator import DescentMemory, DescentNavigator
from optnav_cli.navigate.history import SAME_TIME_S
from optnav_cli.navigate.inputs import list_orbit_files
from optnav_cli.navigate.worker import FrameWorker, RunInputs, look_at, order_frames
from optnav_cli.navigate.zenith_file import make_zenith_rows
from optnav_cli.orbit.fit.zenith import ZENITH_CSV
from optnav_cli.output.manifest import (
    hash_files,
    is_finished,
    list_versions,
    open_workspace,
    write_manifest,
)
from optnav_cli.output.overlay import overlay_path
from optnav_cli.output.recording import Recording, describe
from optnav_cli.output.run_folder import (
    CAMERAS,
    FRAMES,
    LANDMARKS,
    MATCHES,
    OVERLAYS,
    RECORDING,
    SOLUTION,
    copy_inputs,
    read_run,
)
from optnav_cli.output.tables import LandmarkRow, write_landmarks, write_matches, write_solutions
from optnav_cli.reasons import ReasonCode

log = logging.getLogger(__name__)

KIND, STAGE = "run", "navigate"
LENS_SHARE = 1e-3  # a focal length from a data sheet is seldom nearer


def navigate_folder(
    given: RunInputs,
    run: Path,
    progress: Progress,
    *,
    workers: int | None = 1,
    scheduler: str | None = None,
) -> list[Solution]:
    """Navigate all frames of a folder and write the run folder in one step.

    A run that was stopped goes on with the frames that are not done; one that is there already,
    whole and from the same inputs, is left as it is.

    workers    processes; 1 works in this one, None takes all cores, as far as there are frames
    scheduler  tcp://HOST:PORT of a dask cluster, whose workers do the work instead
    Returns the rows of solution.csv, without the control points and limbs that they rest on.
    Raises NothingToDoError, after the run is written, when no frame was solved; DataError or
    ConfigError when folder or catalog cannot be used at all.
    """
    started = datetime.now(UTC)
    if scheduler is not None:
        check_address(scheduler)
    worker = FrameWorker(given if scheduler is None else given.make_absolute())
    check_apart(run, worker.list_files())
    try:
        with log_stage(STAGE), open_workspace(run, KIND) as workspace:
            folder = worker.folder
            log.info("rotation of the %s and its Sun by %s", folder.body.name, folder.motion.name)
            inputs = _describe_inputs(worker, given)
            key = _compute_key(worker, given, inputs)
            if is_finished(run, key):
                log.info("%s: is there already, from the same inputs", run)
                solutions = read_run(run).solutions
                for row in solutions:
                    log.debug("%s", describe(row), extra=row.event(STAGE, 0.0))
            else:
                if workers is None:
                    # A worker process takes as long to start as eight frames to navigate.
                    most = max(1, len(folder.frames) // 8)
                    workers = min(count_cores(), most)
                crew = make_workers(workers)
                if scheduler is not None:
                    crew = start_cluster_workers(scheduler, worker.list_files())
                try:
                    job = _Run(worker, workspace, key, crew)
                    with replace_folder(run, KIND) as partial:
                        solutions = job.write(partial, progress)
                        write_manifest(
                            partial,
                            KIND,
                            command="navigate",
                            options=_list_options(given),
                            inputs=inputs,
                            results={
                                "frames": len(solutions),
                                "solved": sum(solution.solved for solution in solutions),
                            },
                            started=started,
                            key=key,
                        )
                finally:
                    crew.close()
    finally:
        worker.close()
    if not any(solution.solved for solution in solutions):
        raise NothingToDoError(
            f"{run}: none of {len(solutions)} frames was solved; the reasons stand in {SOLUTION}, "
            f"the first: {solutions[0].reason}"
        )
    return solutions


def _measure_distance_m(row: Solution) -> float:
    """Measure the camera's mean distance to its picked points, m."""
    places = np.array([match.cp_position_m for match in row.evidence.matches])
    return float(np.linalg.norm(places - row.position_m, axis=1).mean())


def _describe_exact_lenses(
    cameras: Mapping[str, Camera], distances_m: Mapping[str, list[float]]
) -> Iterator[str]:
    """Describe what errors of focal lengths would do to positions by picked points."""
    for camera, each in distances_m.items():
        if cameras[camera].focal_length_error != 0.0:
            continue
        low, high = (LENS_SHARE * value for value in (min(each), max(each)))
        shown = f"{low:.3g}" if f"{low:.3g}" == f"{high:.3g}" else f"{low:.3g} to {high:.3g}"
        yield (
            f"camera '{camera}' states no focal_length_error, so its focal length counts as exact: "
            f"an error of {LENS_SHARE:.1%} would move the positions by {shown} m along the line of "
            "sight"
        )


def _describe_photometry(worker: FrameWorker, solutions: list[Solution]) -> Iterator[str]:
    """Say of which frames the phase lies outside the range of the ground's photometric set.

    The phase of what the boresight meets does not depend on where that is.
    """
    body, points = worker.folder.body, worker.inputs.points
    missing = body.describe_missing_photometry()
    if missing:
        yield missing
    phases = []
    for frame, row in zip(worker.folder.frames, solutions, strict=True):
        if row.camera_from_body is not None and frame.sun_body is not None:
            boresight = row.camera_from_body.inv().apply([0.0, 0.0, 1.0])
            phases.append(np.degrees(np.arccos(np.clip(-boresight @ frame.sun_body, -1.0, 1.0))))
    used = [layer.photometry for layer in points.layers] if points else [body.photometry]
    for ground in dict.fromkeys(used):
        outside = ground.find_outside(np.array(phases))
        if outside:
            yield outside


@dataclass(frozen=True, eq=False)
class FlownSoFar:
    """Number of frames of a descent that are done, and the memory that the next ones need."""

    frames: int
    memory: DescentMemory | None = None


class _Run:
    """The frames of one run, in the order of time."""

    def __init__(
        self, worker: FrameWorker, workspace: Workspace, key: str, workers: Workers
    ) -> None:
        self._worker, self._workers = worker, workers
        self._frames = worker.folder.frames
        self._order = list(order_frames(worker.folder))
        self._landmarks: list[LandmarkRow] | None = None
        self._results = ChunkResults(workspace, STAGE, key, FrameRecord)
        workspace.keep_only(STAGE, {key})

    def write(self, place: Path, progress: Progress) -> list[Solution]:
        """Write a run folder but for its manifest; return the rows in the order of frames.csv."""
        worker, folder = self._worker, self._worker.folder
        copy_inputs(folder.path, folder.settings, place)
        (place / OVERLAYS).mkdir()
        rows: dict[int, Solution] = {}
        sights: dict[str, list[float]] = {}
        names, relief = sorted(folder.cameras), worker.inputs.relief
        with Recording(
            place / RECORDING, folder.body, relief, names, self._describe_recording()
        ) as recording:
            for number, row, record in self._process_in_time_order(progress):
                frame, seen = self._frames[number], row.evidence
                camera = folder.cameras.get(frame.camera)
                undrawn = record.undrawn
                if record.overlay:
                    overlay_path(place / OVERLAYS, row.file).write_bytes(record.overlay)
                try:
                    recording.add_frame(row, seen.matches, camera, record.image, seen.outline)
                except ValueError as error:  # numbers that JSON cannot hold
                    undrawn = undrawn or f"cannot be recorded ({error})"
                if undrawn:
                    log.warning("%s: %s", row.file, undrawn)
                if record.details:
                    log.debug("%s: %s", row.file, record.details)
                if row.method is Method.PICKED_POINTS and row.position_m is not None:
                    sights.setdefault(frame.camera, []).append(_measure_distance_m(row))
                level = logging.DEBUG if row.solved else logging.WARNING
                log.log(level, "%s", describe(row), extra=row.event(STAGE, record.seconds))
                bare = replace(seen, matches=(), outline=None)
                rows[number] = replace(row, outcome=replace(row.outcome, evidence=bare))
        solutions = [rows[number] for number in range(len(self._frames))]
        for text in (
            *_describe_exact_lenses(folder.cameras, sights),
            *_describe_photometry(worker, solutions),
        ):
            log.warning("%s", text)
        write_solutions(place / SOLUTION, solutions, folder.attitude)
        zenith = make_zenith_rows(folder, solutions)
        if zenith:
            ZENITH.write(place / ZENITH_CSV, zenith)
        write_matches(place / MATCHES, self._read_matches())
        if self._landmarks is not None:
            write_landmarks(place / LANDMARKS, self._landmarks, folder.attitude)
        points = worker.inputs.points
        for (_, point_id), reason in (points.damaged if points else {}).items():
            log.warning("control point %d is left out: %s", point_id, reason)
        return solutions

    def _process_in_time_order(
        self, progress: Progress
    ) -> Iterator[tuple[int, Solution, FrameRecord]]:
        """Yield index in frames.csv, row and record of each frame, once those before are done."""
        descent = self._worker.make_descent()
        if descent is not None:
            yield from self._process_descent(descent, progress)
            return
        navigator = Navigator(self._worker.inputs)
        tasks, next_one = self._make_tasks(), 0
        waiting: set[int] = set()
        with progress.stage(STAGE, len(tasks), "frame") as bar:
            made = self._results.make(
                look_at, self._worker, [[t] for t in tasks], self._workers, StageAccount(STAGE), bar
            )
            with closing(made):  # at once by an error here, so that no worker goes on
                for position in made:
                    waiting.add(position)
                    while next_one in waiting:
                        waiting.remove(next_one)
                        row, record = self._finish_frame(next_one, tasks[next_one], navigator)
                        yield self._order[next_one], row, record
                        next_one += 1

    def _process_descent(
        self, descent: DescentNavigator, progress: Progress
    ) -> Iterator[tuple[int, Solution, FrameRecord]]:
        """Process a descent, each frame of which needs those before."""
        results, count = self._results, len(self._order)
        # beside the frames' files: what the frames to come need of those that are done
        memory = ChunkResults(results.workspace, STAGE, results.key, FlownSoFar)
        stopped = (memory.read(count) or [FlownSoFar(0)])[0]
        kept = results.read_all(stopped.frames) or []
        if stopped.memory is not None and kept:
            descent.restore(stopped.memory)
        with progress.stage(STAGE, count, "frame") as bar:
            bar.keep(len(kept))
            for position, number in enumerate(self._order):
                if position < len(kept):
                    yield number, unpack_row(kept[position].row), kept[position]
                    continue
                _, record = self._worker.finish(self._frames[number], descent, make_empty_record())
                results.workspace.put(results.name(position), encode_records([record]))
                done = encode_records([FlownSoFar(position + 1, descent.save_memory())])
                results.workspace.put(memory.name(count), done)
                # goes on from the same arrays as a run that was stopped here: a sum over another
                # order of memory differs in its last digit
                (read,) = decode_records(done, FlownSoFar)
                if read.memory is not None:
                    descent.restore(read.memory)
                bar.advance()
                yield number, unpack_row(record.row), record
        self._landmarks = [
            LandmarkRow(
                landmark.number,
                landmark.first_file,
                landmark.last_file,
                landmark.n_seen,
                landmark.place_m,
                landmark.covariance_m2,
                landmark.reason,
            )
            for landmark in descent.landmarks
        ]

    def _finish_frame(
        self, position: int, task: FrameTask, navigator: Navigator
    ) -> tuple[Solution, FrameRecord]:
        records = self._results.read(position)
        seen: FrameRecord = records[0] if records else self._worker.look(task)
        row, record = self._worker.finish(task.frame, navigator, seen)
        if record is not seen or not records:
            name = self._results.name(position)
            self._results.workspace.put(name, encode_records([record]))
        return row, record

    def _make_tasks(self) -> list[FrameTask]:
        """Make a task for each frame in the order of time."""
        tasks, last = [], None
        for number in self._order:
            frame = self._frames[number]
            now = frame.tdb_s
            twin = last is not None and now is not None and abs(now - last) <= SAME_TIME_S
            tasks.append(FrameTask(frame, twin))
            last = last if now is None else now
        return tasks

    def _read_matches(self) -> Iterator[MatchRow]:
        """Read all control points tried, frame by frame in the order of frames.csv."""
        points = self._worker.inputs.points
        for position in sorted(range(len(self._order)), key=self._order.__getitem__):
            records = self._results.read(position)
            if not records:
                raise OutputError(
                    f"{self._results.workspace.folder}: results vanished or were damaged; give the "
                    "same command again"
                )
            for match in unpack_row(records[0].row).evidence.matches:
                if points and match.reason_code == ReasonCode.DAMAGED_PATCH:
                    points.reference(points.index_of(match.catalog, match.cp_id))  # notes why
                yield match

    def _describe_recording(self) -> dict[str, str]:
        """Return the metadata of the recording."""
        worker = self._worker
        relief = worker.inputs.relief
        return {
            "optnav": list_versions()["optnav"],
            "command": "navigate",
            "matcher": worker.given.matcher,
            "body": worker.folder.body.name,
            "relief": Path(relief.source).name if relief else "",
            "motion": worker.folder.motion.name,
            **{f"catalog {catalog.path.name}": catalog.digest for catalog in worker.catalogs},
        }


def _list_options(given: RunInputs) -> dict[str, Any]:
    return {"matcher": given.matcher, "config": msgspec.to_builtins(given.settings)}


def _describe_inputs(worker: FrameWorker, given: RunInputs) -> dict[str, Any]:
    """Describe the inputs of a run for its manifest."""
    folder = worker.folder
    usable = (frame.file for frame in folder.frames if frame.problem is None)
    cameras = (f"{CAMERAS}/{name}.toml" for name in folder.cameras)
    tables = [RUN_TOML, FRAMES, *([] if folder.points is None else [POINTS_CSV])]
    relief = worker.inputs.relief
    orbit: dict[str, Any] = {}
    if given.orbit is not None:
        names = [path.name for path in list_orbit_files(given.orbit)]
        orbit["orbit"] = {
            "path": str(given.orbit),
            "files_sha256": hash_files(given.orbit, names),
        }
    return {
        **orbit,
        "pictures": str(given.pictures),
        "files_sha256": hash_files(given.pictures, [*usable, *cameras, *tables]),
        "catalogs": [
            {"path": str(path), "digest": catalog.digest}
            for path, catalog in zip(given.catalogs, worker.catalogs, strict=True)
        ],
        "relief": relief.source if relief else "",
        "motion": folder.motion.name,
    }


def _compute_key(worker: FrameWorker, given: RunInputs, inputs: dict[str, Any]) -> str:
    """Hash all that the rows and drawings of a run depend on."""
    body, relief = worker.folder.settings.body, worker.inputs.relief
    named = given.kernels
    if is_body_file(body):
        named.append(Path(body))
    states = [catalog.path.stat() for catalog in worker.catalogs]
    return compute_stage_key(
        [hash_package(), hash_package("optnav_cli"), list_versions()],
        [_list_options(given), inputs],
        [hash_file(path) for path in named],
        # a catalog may be mended, its digest the same
        [(state.st_size, state.st_mtime_ns) for state in states],
        [] if relief is None else [hashlib.sha256(relief.heights.tobytes()).hexdigest()],
    )
