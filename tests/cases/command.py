"""Runs of the command on the files of a case, and what they leave."""

import csv
import json
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np

TIMEOUT_S = 600.0


class Outcome(NamedTuple):
    """What became of a case: right, refused with a reason, or wrong; and what shows it."""

    verdict: str
    shown: str


class Run(NamedTuple):
    """A finished command: its exit code, and all that it printed."""

    code: int
    text: str

    @property
    def error(self) -> str:
        """The last line that the command printed."""
        lines = self.text.strip().splitlines()
        return lines[-1] if lines else ""


def run_command(*words: object) -> Run:
    """Run `optnav` with some words."""
    line = [sys.executable, "-m", "optnav_cli.main", *map(str, words)]
    ended = subprocess.run(line, capture_output=True, text=True, timeout=TIMEOUT_S, check=False)
    return Run(ended.returncode, ended.stdout + ended.stderr)


def judge_refusal(run: Run, *words: str) -> Outcome:
    """Judge a failed command: refused rightly if it ends with code 3 or 4 and names some words."""
    named = all(word.lower() in run.text.lower() for word in words)
    honest = run.code in (3, 4) and "Traceback" not in run.text and named
    return Outcome("refused" if honest else "wrong", run.error[:160])


def read_rows(path: Path) -> list[dict[str, str]]:
    """Read the rows of a CSV file by their columns."""
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def read_vector(row: dict[str, str], names: str) -> np.ndarray:
    """Read a vector of a row; `names` are its columns with spaces between."""
    return np.array([float(row[name] or "nan") for name in names.split()])


def navigate(folder: Path, out: Path, *words: object) -> tuple[Run, dict[str, str]]:
    """Navigate a picture folder; return the run and the first row of its solution."""
    run = run_command("navigate", folder, "-o", out, *words)
    solution = out / "solution.csv"
    return run, read_rows(solution)[0] if solution.is_file() else {}


def judge_solution(run: Run, row: dict[str, str], truth: Path, *reasons: str) -> Outcome:
    """Judge the first frame of a run: inside 3 sigma an axis, or unsolved for a true reason.

    reasons  words, one of which the reason of an unsolved frame must have
    """
    if not row:
        return judge_refusal(run)
    if row["status"] != "solved":
        shown = f"{row['reason_code']}: {row['reason']}"
        fits = any(word.lower() in shown.lower() for word in reasons)
        return Outcome("refused" if fits else "wrong", shown[:160])
    covariance = np.array(
        [[float(row[f"cov_{''.join(sorted(i + j))}_m2"]) for j in "xyz"] for i in "xyz"]
    )
    error = read_vector(row, "x_m y_m z_m") - read_vector(read_rows(truth)[0], "x_m y_m z_m")
    sigmas = float(np.sqrt(error @ np.linalg.solve(covariance, error)))
    shown = f"{row['method']}: off by {np.linalg.norm(error) / 1e3:.4g} km, {sigmas:.2f} sigmas"
    # 99.73 % of three normal components lie within 3.76 sigmas
    return Outcome("right" if sigmas < 3.76 else "wrong", shown)


def read_evaluation(folder: Path) -> dict[str, object]:
    """Read the figures that `optnav evaluate` left in a folder."""
    figures: dict[str, object] = json.loads((folder / "evaluation.json").read_text("utf-8"))
    return figures
