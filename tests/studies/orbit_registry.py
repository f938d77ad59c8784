"""The studies of orbits: what each asks, and how it is called."""

import click

from optnav_cli.options import Number
from tests.studies.study import MANY, Study, option, output, seed, trials

ORBIT_STUDIES = (
    Study(
        "delivery",
        "Accuracy of deliveries: boxes against trials.",
        """Bound the errors and corrections of the shipped deliveries and compare with trials.

        Moon by radio and by optical fixes, Mars, Venus, Jupiter with electric thrust: velocity
        change, arrival, the navigation with considered errors against drawn ones, times. Takes half
        a minute.""",
        "--cut 10000",
        (
            option("--cut", click.IntRange(100, 10 * MANY), MANY, "Trials that must lie inside."),
            seed(),
        ),
        compiles=False,
    ),
    Study(
        "landing",
        "Landings on Phobos.",
        """Fly landings on Phobos with drawn errors and compare the navigation with the truth.

        Departure impulses, rays on the shape model, transfers over wrong ground, the end of the
        descent and the touchdown. Takes two minutes; --trials 10 --fits 4 gives a first look.""",
        "--trials 10 --fits 4",
        (
            trials(1, 200, "Landings of each row."),
            option("--fits", click.IntRange(1, MANY), 40, "Transfers of each row."),
            seed("Of errors and grounds."),
        ),
    ),
    Study(
        "orbit",
        "Orbits through fixes, predictions.",
        """Fit orbits through fixes with drawn errors along paths of another integrator.

        Needs the Moon's field to degree 90 in the folder of OPTNAV_SHARED_DATA. Takes minutes.""",
        "--trials 6 --rows clocks",
        (trials(3, 60, "Flights."), seed(), option("--rows", str, "", "Groups of these names.")),
    ),
    Study(
        "orbit_motion",
        "Accuracy and speed of the motion, by degree of the field.",
        """Fly a day at 100 km over the Moon by fields of degree 2, 20 and 50.

        Compares the end with scipy at 1e-13, whose rates are written another way, times the flight
        with its transition, and states what each field leaves out. Takes a minute.""",
        "--hours 2",
        (option("--hours", Number(0.1, 240.0), 24.0, "Of each flight."),),
    ),
    Study(
        "orbit_runs",
        "Orbits through the fixes of simulated flights.",
        """Fly past Phobos and over the Moon, navigate, fit orbits, and compare with the truth.

        Several flights a row, and one of its own that shows what errors of near fixes have in
        common. Flights over the Moon need the folder of OPTNAV_SHARED_DATA. Takes an hour on two
        cores; --rows approach leaves the Moon out, --frames 8 gives a first look.""",
        "--frames 8 --rows approach",
        (
            output("optnav-orbit-runs", "Folder for all files; pictures in it are used again."),
            option("--frames", click.IntRange(4, MANY), None, "Pictures of each; all if left."),
            option("--rows", str, "", "Only flights whose name contains this."),
        ),
    ),
    Study(
        "qso",
        "Quasi-satellite orbits of Phobos.",
        """Find quasi-satellite orbits of Phobos over 270 deg W and compare them.

        Rings and angular rates against those of the source, the averaged theory against the numeric
        motion, the table of 50 to 200 km at four anomalies, and what Mars' flattening and the field
        of Phobos' mesh change. Takes a minute.""",
        "--anomalies 1",
        (option("--anomalies", click.IntRange(1, 4), 4, "Of Phobos in its orbit."),),
    ),
    Study(
        "zenith",
        "Orbits through zenith distances of stars.",
        """Fit orbits of a lunar constellation through zenith distances of stars with drawn errors.

        Tables 2 to 4 and figures 2 to 5 of the source beside ours; then the same truth with a bias
        of the vertical, fixed errors of stars, a small field, no sunlight, and a vertical from the
        limb. Takes five minutes; --revolutions 3 --trials 3 gives a first look.""",
        "--craft 1.5 --revolutions 3 --trials 3",
        (
            option(
                "--craft",
                click.Choice([f"{plane}.{place}" for plane in (1, 2, 3) for place in range(1, 7)]),
                "1.5",
                "Of forecasts and curves.",
            ),
            option("--revolutions", click.IntRange(1, 100), 35, "Of tables 2 and 3."),
            trials(2, 20, "Fits of the other rows."),
            seed("Of errors."),
        ),
        draws=True,
    ),
)
