"""The `optnav` command: its subcommands by name, and the one place where errors become exit codes.

Exit codes: 0 done; 1 our bug (with a traceback); 2 wrong usage; 3 bad or damaged config, data or
output place; 4 nothing could be solved or selected; 5 a comparison differs or a limit is passed;
130 interrupted.
"""

import errno
import gc
import os
import signal
import sys
from collections.abc import Sequence
from types import FrameType
from typing import NoReturn

import click

import catalog
from catalog.errors import OptnavError, OutputError, limit_length
from optnav_cli.console import find_output_failure, install_safe_streams, is_set_up
from optnav_cli.options import IN_FILES, Entry, LazyGroup

COMPLETE, SHELLS = "_OPTNAV_COMPLETE", ("bash", "zsh", "fish")
INTERRUPTED = 130
BAD_PLACE = 3

# Errors of the operating system when an output place cannot be used, and what to do about it.
PLACE_ERRORS = {
    errno.ENOSPC: "free some space or choose another place",
    errno.EDQUOT: "free some space or choose another place",
    errno.EACCES: "check the permissions or choose another place",
    errno.EPERM: "check the permissions or choose another place",
    errno.EROFS: "choose a place that can be written to",
    errno.ENOTDIR: "a part of this path is a file; choose another place",
    errno.ELOOP: "a link in this path leads to itself; choose another place",
    errno.EISDIR: "this is a folder; name a file",
    errno.ENAMETOOLONG: "choose a shorter name",
    errno.EFBIG: "the file system takes no file this large; choose another place",
    errno.EMFILE: "raise the limit of open files (ulimit -n) or use fewer --workers",
}

_HERE = "optnav_cli.commands"
_PICTURES = f"{_HERE}.pictures"
_RESULTS = f"{_HERE}.results"
COMMANDS = {
    "demo": Entry(f"{_HERE}.demo", "The main job on the bundled Tycho terrain, with a report."),
    "build": Entry(f"{_HERE}.build", "Build a control-point catalog from terrain models.", "build"),
    "ingest": Entry(f"{_HERE}.build", "Build stage 1: read the terrain models.", "ingest"),
    "render": Entry(f"{_HERE}.build", "Build stage 2: shortlist points, render them.", "render"),
    "select": Entry(f"{_HERE}.build", "Build stage 3: choose the points to check.", "select"),
    "check": Entry(f"{_HERE}.build", "Build stage 4: check the chosen points.", "check"),
    "write": Entry(f"{_HERE}.build", "Build stage 5: write the catalog file.", "write"),
    "catalog": Entry(f"{_HERE}.catalog", "Look at, verify and export a catalog."),
    "import": Entry(
        _PICTURES, "Make a picture folder of an archive's pictures.", "import_pictures"
    ),
    "simulate": Entry(_PICTURES, "Make a folder of pictures with known positions.", "simulate"),
    "navigate": Entry(_PICTURES, "Find the camera's position for each picture.", "navigate"),
    "adjust": Entry(_PICTURES, "Adjust the frames of runs, and what is common to them.", "adjust"),
    "calibrate": Entry(
        f"{_HERE}.calibrate", "Calibrate cameras by control points, a lens by a grid of dots."
    ),
    "stars": Entry(f"{_HERE}.stars", "Attitudes from the stars in pictures."),
    "stereo": Entry(f"{_HERE}.stereo", "Height and side velocity from two cameras on a base."),
    "cylinder": Entry(f"{_HERE}.cylinder", "Distance and light angle by a lit cylinder."),
    "orbit": Entry(f"{_HERE}.orbit", "Orbits through fixes, and what follows from them."),
    "slopes": Entry(f"{_HERE}.hazard", "How steep a terrain model is.", "slopes"),
    "hazard": Entry(f"{_HERE}.hazard", "Map the risk of landing, choose pads.", "hazard"),
    "evaluate": Entry(_RESULTS, "Compare a run's positions with the truth.", "evaluate"),
    "export": Entry(_RESULTS, "Write a run as layers for GIS programs.", "export"),
    "report": Entry(_RESULTS, "Make a page about a run or a catalog.", "report"),
    "config": Entry(f"{_HERE}.config", "What ships with optnav; configurations to start from."),
}


@click.group(
    cls=LazyGroup,
    table=lambda: COMMANDS,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
    epilog="Begin with `optnav demo`. Each command has its own --help with an example.",
)
@click.version_option(catalog.__version__, message="optnav %(version)s")
def cli() -> None:
    """Optical navigation at airless bodies.

    Builds catalogs of control points from terrain models and finds the camera's position for each
    picture of a folder. Results go to stdout, messages to stderr.
    """


def _invoke(args: Sequence[str], group: click.Group, program: str) -> int:
    # Not cli.main(): it has its own words for an interrupt and for a reader that left.
    code, in_files = 0, False
    try:
        with group.make_context(program, list(args)) as context:
            group.invoke(context)
            in_files = context.meta.get(IN_FILES, False)
    except click.exceptions.Exit as end:  # --help, --version
        code = end.exit_code
    failure = find_output_failure()
    if failure is not None and code == 0 and not in_files:
        reason = (failure.strerror or str(failure)).lower()
        raise OutputError(f"{reason}: stdout did not take the result; send it elsewhere")
    return code


def run(args: Sequence[str], group: click.Group = cli, program: str = "optnav") -> int:
    """Run a command line and return its exit code; a bug of ours stays a traceback."""
    try:
        return _invoke(args, group, program)
    except OptnavError as error:
        return _fail(str(error), error.exit_code)
    except click.exceptions.NoArgsIsHelpError as error:
        error.show()
        return error.exit_code
    except click.UsageError as error:
        return _fail(_explain_usage(error), error.exit_code)
    except click.ClickException as error:
        return _fail(error.format_message(), error.exit_code)
    except (click.Abort, KeyboardInterrupt):
        return _fail("interrupted", INTERRUPTED)
    except OSError as error:
        if error.errno == errno.ENOENT and _is_folder_gone():
            text = "the working folder is not there any more; change to one that is"
            return _fail(text, BAD_PLACE)
        if error.errno not in PLACE_ERRORS:
            raise
        where = f"{os.fsdecode(error.filename)}: " if error.filename else ""
        reason = os.strerror(error.errno).lower()
        return _fail(f"{where}{reason}; {PLACE_ERRORS[error.errno]}", BAD_PLACE)


def _is_folder_gone() -> bool:
    """Whether the working folder was removed, so that no relative path leads anywhere."""
    try:
        os.getcwd()
    except FileNotFoundError:
        return True
    return False


def _fail(message: str, code: int) -> int:
    """Write why the command ends to stderr, and to the log file if there is one."""
    import logging

    message = limit_length(message)  # it quotes a name or a value of the input
    if is_set_up():
        logging.getLogger(__name__).error("%s", message)
    else:  # the command line was wrong: no logging yet
        click.echo(f"optnav: {message}", err=True)
    return code


def _explain_usage(error: click.UsageError) -> str:
    """The message of a wrong command line, and where to look."""
    message = error.format_message()
    if isinstance(error, click.NoSuchOption) and error.possibilities:
        near = " or ".join(repr(name) for name in error.possibilities)
        message = f"{error.message.rstrip('.')}; did you mean {near}?"
    command = error.ctx.command_path if error.ctx else "optnav"
    return f"{message[:1].lower()}{message[1:].rstrip('.')} (see `{command} --help`)"


def complete() -> int:
    """Answer a shell that asks how a command line goes on, or for the script that makes it ask."""
    from click.shell_completion import shell_complete

    asked = os.environ[COMPLETE]
    if asked.partition("_")[0] not in SHELLS:
        return _fail(f"{COMPLETE}={asked}: give SHELL_source, SHELL one of {', '.join(SHELLS)}", 2)
    return shell_complete(cli, {}, "optnav", COMPLETE, asked)


def main(group: click.Group = cli, program: str = "optnav") -> NoReturn:
    """Run the command line of this process and end it; the entry point of the `optnav` script."""
    process = os.getpid()

    def terminate(number: int, frame: FrameType | None) -> NoReturn:
        # Leave on SIGTERM as on Ctrl-C, so that half-written files are cleared away.
        if os.getpid() != process:  # a forked worker is ended by its pool: without a message
            os._exit(INTERRUPTED)
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, terminate)
    # With Python's threshold of 700 objects, garbage collection took a tenth of a command's start
    # and 8 % of the compilation of kernels. Commands make few reference cycles.
    gc.set_threshold(100_000, 20, 100)
    install_safe_streams()
    sys.exit(complete() if COMPLETE in os.environ else run(sys.argv[1:], group, program))


if __name__ == "__main__":
    main()
