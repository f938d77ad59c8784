"""Run the cases of a folder: `python -m tests.cases FOLDER [NAME ...]`; 5 if one is wrong.

FOLDER has `files` and `archives`: files that other programs wrote, each of which is to be read
right or refused with the reason. They are not part of the project. The case of a gap in a kernel
needs the kernels of the folder that OPTNAV_SHARED_DATA names.
"""

import sys
import tempfile
from pathlib import Path

from tests.cases import archives, files


def main(words: list[str]) -> int:
    """Run all cases of a folder, or those whose names begin with some words."""
    if not words or not Path(words[0]).is_dir():
        sys.stderr.write(__doc__ or "")
        return 2
    folder = Path(words[0])
    listed = files.cases(folder / "files") | archives.cases(folder / "archives")
    chosen = {
        name: case
        for name, case in listed.items()
        if len(words) == 1 or name.startswith(tuple(words[1:]))
    }
    wrong = 0
    for name, case in chosen.items():
        with tempfile.TemporaryDirectory() as place:
            outcome = case(Path(place))
        wrong += outcome.verdict == "wrong"
        sys.stdout.write(f"{name:32} {outcome.verdict:8} {outcome.shown}\n")
        sys.stdout.flush()
    sys.stdout.write(f"{len(chosen) - wrong} of {len(chosen)} right or refused with the reason\n")
    return 5 if wrong else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
