"""The studies: what each asks, how it is called, and the module that answers.

A study's module has `run(progress, ...)`, which takes the options below by name, and
`report(result)`, which makes the tables; where there is a plot, `picture(result)` draws it. Modules
are imported when a study is run, so that listing the studies does not load what they compute with.
"""

import click

from optnav_cli.options import PATH, Number
from tests.studies.orbit_registry import ORBIT_STUDIES
from tests.studies.study import MANY, YEAR, Study, option, output, seed, trials


def _flights(name: str, files: str, row: str) -> tuple[click.Option, ...]:
    """The options of a study that flies scenarios: its folder, and less than all of it."""
    return (
        output(f"optnav-{name}", f"Folder for {files}; what is in it is used again."),
        option("--frames", click.IntRange(1, MANY), None, "Pictures of each case; all if left."),
        option("--rows", str, "", f"Only rows whose name contains this, such as '{row}'."),
    )


_MATCHERS = click.Choice(["ncc", "surf"])
_RUNS = "catalogs, pictures, runs and figures.json"

_OTHERS = (
    Study(
        "acceptance",
        "Wrong pictures solved, right ones refused.",
        """Navigate right and wrong situations of simulated and real pictures and count the answers.

        Wrong ones are other ground, mirrored and turned pictures, a wrong Sun, noise, another body.
        The folder gets the curves of both shares against the limits (acceptance.svg). Uses pictures
        of 67P where OPTNAV_SHARED_DATA names the folder that has them. Takes half an hour;
        --frames 2 gives a first look.""",
        "--frames 2 --rows Apollo",
        (
            *_flights("acceptance", "catalogs, pictures, figures and acceptance.svg", "Apollo"),
            seed("Of windows, priors and errors."),
            option(
                "--fit", bool, False, "Other grounds and draws: to set limits with.", is_flag=True
            ),
        ),
    ),
    Study(
        "apollo",
        "A real Apollo 15 picture over bundled terrain.",
        """Build the catalog below Apollo 15 metric frame 0297 and navigate the frame.

        Prints how many control points were recognised, the residual, and the correction to the pose
        in the frame's ISIS cube with its sigma.""",
        "-o apollo",
        (
            output("optnav-apollo", "Folder for the catalog, the pictures and the run."),
            option("--matcher", _MATCHERS, "ncc", "How a control point is recognised."),
        ),
    ),
    Study(
        "arc",
        "Errors of a horizon against the arc of limb in view.",
        """Fit limbs with correlated errors and tabulate the errors of direction and angular radius.

        Shows why less than 100 degrees of limb make no good horizon, and how relief, whose errors
        are correlated over degrees of limb, costs more than noise.""",
        "-o arc.svg",
        (
            trials(5, 100, "Limbs of each interval."),
            option("--height-km", Number(1.0, 1e6), 200.0, "From which the Moon is seen."),
            seed("Of errors."),
        ),
        draws=True,
    ),
    Study(
        "autonomous",
        "Flights without any prior.",
        """Fly without priors over Tycho and all over the Moon, and compare with the truth.

        Needs the 948 m model of the whole Moon in the folder that OPTNAV_SHARED_DATA names. All
        pictures take some two hours on two cores; --frames 4 gives a first look.""",
        "--frames 4 --rows wide",
        _flights("autonomous", _RUNS, "wide"),
    ),
    Study(
        "calibration",
        "A camera calibrated in flight.",
        """Calibrate routes with a lens that is not the told one and compare with the truth.

        Routes at measurement level give the statistics; one is drawn, matched, calibrated, and
        navigated with the camera of before and after. Takes an hour; --trials 2 --pictures 0 gives
        a first look.""",
        "--trials 2 --pictures 0",
        (
            output(
                "optnav-calibration", "Folder for the drawn route; what is in it is used again."
            ),
            trials(0, 24, "Routes at measurement level."),
            option("--pictures", click.IntRange(0, MANY), 12, "Of the drawn route; 0 for none."),
            option("--frames", click.IntRange(8, MANY), 100, "Of a route at measurement level."),
            option("--catalog", PATH, None, "Of the bundled Tycho terrain; built if left out."),
            seed("Of routes."),
        ),
    ),
    Study(
        "comet",
        "67P with position and attitude stated, turned, or not at all.",
        """Navigate the pictures of 67P with less and less stated.

        Position to 300 m with the attitude to 200 arc seconds; the same with the attitude free and
        0.7 deg off; no position. FOLDER holds rosetta/pictures/*.lbl with their pictures and
        rosetta/67p*.obj, as for the study real, whose corrected labels are the truth.""",
        "shared -o comet --frames 10",
        (
            click.Argument(["folder"], type=PATH),
            *_flights("comet", "the catalog, pictures and runs with overlays", "free"),
        ),
    ),
    Study(
        "cylinder",
        "A lit cylinder: distance, light and speed.",
        """Draw pictures of a cylinder whose cloth and light the fit does not have, and fit them.

        Errors by the angle of the light against what is asked and stated, the speed of a craft that
        circles, and what the printed formula (6) makes of exact widths. --fit finds the sizes of
        configs/models/cylinder.toml, on other cloths and another cylinder. Takes some minutes.""",
        "--trials 5",
        (
            trials(2, 40, "Pictures of each range of angles."),
            seed("Of places, cloths and noise."),
            option("--fit", bool, False, "Find the sizes on other cloths.", is_flag=True),
        ),
    ),
    Study(
        "descent",
        "A descent to 2 km by windows of the model and landmarks.",
        """Fly descents of one inertial track over several grounds, with several drawn tracks each.

        Errors above and below 6.5 km, with a model that is wrong, over ground that differs
        as the Moon does from GLD100, with a noisy track, and with landmarks alone near the ground;
        then, without pictures, landmarks in one state with the
        pose against landmarks as independent points. Needs nothing but what is bundled; the
        pictures of a ground take a quarter of an hour.""",
        "--grounds 1 --tracks 1",
        (
            output("optnav-descent", "Folder for catalogs and pictures; used again."),
            option("--grounds", click.IntRange(1, 1000), 5, "Grounds, each with its pictures."),
            option(
                "--first",
                click.IntRange(0, 10_000),
                0,
                "Ground to begin with: 0 and 5 were fitted with.",
            ),
            option("--tracks", click.IntRange(1, 100), 3, "Drawn tracks over each ground."),
            option(
                "--landmarks-only",
                bool,
                False,
                "Only the row without windows below 6.5 km.",
                is_flag=True,
            ),
            option("--rows", str, "", "Only rows whose name contains this, such as 'wrong|12 m'."),
        ),
    ),
    Study(
        "discs",
        "Direction and range of discs of 2 to 40 px.",
        """Draw small discs of the Moon and of Phobos, solve them, and compare with the truth.

        Needs nothing but what is bundled; 30 discs of each size take a quarter of an hour.""",
        "--discs 5",
        (
            option("--discs", click.IntRange(1, MANY), 30, "Discs of each size and body."),
            output(None, "JSON file for every disc's errors.", ".json", ""),
        ),
        compiles=False,
    ),
    Study(
        "economy",
        "The build's settings against slower and quicker ones.",
        """Choose points on the bundled Tycho terrain by several policies and try to recognise them.

        Prints what the build's few candidates, Suns and trials cost in recognition and gain in
        time, against all candidates under 32 Suns, against trials of them all, and against fewer
        candidates.""",
        "--cell-deg 0.5 --trials 40",
        (
            trials(4, 24, "New recognition trials of each place, at least."),
            option(
                "--cell-deg cells_deg",
                Number(0.2, 2.0),
                (1.0, 0.5),
                "Side of the cells; may be given several times.",
                multiple=True,
            ),
            seed(),
        ),
    ),
    Study(
        "fit",
        "Error sizes of matches, scored on other ground.",
        """Fit the sizes of a model of errors, configs/models/NAME.toml, by maximum likelihood.

        Frames over ground that differs from the terrain model as the Moon's does from GLD100 are
        matched from their true poses. NEES of frames held back, and of other ground, is that of the
        present sizes and of the new ones. Catalogs and pictures are those of the study
        navigation; with them it takes a minute. `descent` is fitted with the windows of flights of
        `make study-descent`, over another ground than those that it scores, `horizon` with limbs
        of `make study-horizon` over the simulator's own ground, or with --rows real_flights over
        ground in long shadows. `albedo`, how the Moon's albedo follows its relief, is fitted with a
        map of it and a terrain model, no pictures.""",
        "control_points -o sizes.toml",
        (
            click.Argument(
                ["name"], type=click.Choice(["control_points", "descent", "horizon", "albedo"])
            ),
            output(None, "TOML file for the sizes.", ".toml"),
            option(
                "--folder",
                PATH,
                None,
                "For catalogs and pictures; if left, that of the study that the model is of.",
            ),
            option(
                "--frames", click.IntRange(1, MANY), None, "Pictures of each scenario; all if left."
            ),
            option("--rows", str, "", "Only scenarios whose name contains this, such as 'unk'."),
        ),
    ),
    Study(
        "hazard",
        "Danger of the pads of a hazard map.",
        """Map hazards of fields of synthetic ground and judge the chosen pads by their true slopes.

        Ground of which 38 % and 16 % are above 7 deg, a Sun of 20 and 5 deg from any azimuth; other
        albedo, an oblique view, a prior slope map, whole pictures from 500 m. Takes ten minutes;
        --fields 2 gives a first look. --fit finds the chances of configs/models/hazard.toml on
        other fields before, judges with them and prints them.""",
        "--fields 2",
        (
            option("--fields", click.IntRange(1, 90), 8, "Fields of each ground."),
            option("--fit", bool, False, "Fit the model's numbers before.", is_flag=True),
            option("--rows", str, "", "Only cases whose method contains this: 'variance'."),
        ),
    ),
    Study(
        "hazard_descent",
        "Pads carried along navigated descents.",
        """Map navigated runs from 1500 to 50 m, carry their pads and judge them by the truth.

        Rough ground of which 38 % is above 7 deg, a Sun of 20 and 5 deg; poses err by 1 % of the
        height, the terrain model of 20 m by 0.5 m. Takes four minutes a field.""",
        "--fields 4 --first 11",
        (
            option("--fields", click.IntRange(1, 90), 1, "Fields, and descents under each Sun."),
            option("--first", click.IntRange(1, 90), 3, "Seed of the first field."),
        ),
    ),
    Study(
        "hazard_rocks",
        "Rocks by their shadows; craters that are dangerous.",
        """Photograph ground with rocks of a published law from above, list its rocks, and compare.

        Rocks above 30 cm under a Sun of 5, 20 and 30 deg from 100 to 300 m, and the area of rocks
        whose shadows cover 10 %. Then the least dangerous crater by age and the variance of
        brightness by crater and resolution. Takes ten minutes; --fit finds [rocks] of
        configs/models/hazard.toml on other fields before and prints it.""",
        "--fields 1",
        (
            option("--fields", click.IntRange(1, 90), 3, "Fields of each case."),
            option("--fit", bool, False, "Fit the numbers before.", is_flag=True),
        ),
    ),
    Study(
        "horizon",
        "Positions from the limb alone.",
        """Solve single pictures from 50 to 100 000 km by their limb, and compare with the truth.

        Needs the 948 m model of the whole Moon in the folder that OPTNAV_SHARED_DATA names. All
        pictures take some three hours on two cores, solving them two minutes; --frames 6 gives a
        first look.""",
        "--frames 6 --rows nadir",
        _flights("horizon", "pictures and figures.json", "far"),
    ),
    Study(
        "matching",
        "Limits of matching: noise, scale, slant, roll.",
        """Look for control points of the bundled Tycho terrain by correlation and by SURF-64.

        Prints how many are recognised, and how well, as the picture's noise or the stated scale,
        slant or roll gets worse: first with nothing but the place searched, then with what the
        navigator does about it.""",
        "-o matching.svg",
        (
            option(
                "--scenes",
                click.IntRange(1, 24),
                2,
                "Grounds and Suns that the pictures are made of.",
            ),
            seed(),
        ),
        draws=True,
    ),
    Study(
        "navigation",
        "Control points in simulated flights.",
        """Fly, navigate and evaluate every row of the accuracy table.

        Rows called real fly over ground that differs from the terrain model as the Moon differs
        from GLD100; that of 474 m needs the map in the folder that OPTNAV_SHARED_DATA names. All
        pictures take two to four hours on two cores; --frames 10 gives a first look.""",
        '--frames 10 --rows "unk 200"',
        (
            *_flights("navigation", _RUNS, "unk 200"),
            option(
                "--kept",
                bool,
                False,
                "Evaluate the runs that the folder holds as they are.",
                is_flag=True,
            ),
        ),
    ),
    Study(
        "phobos",
        "Navigation at Phobos, by disc, limb and control points.",
        """Build the catalog of Phobos, fly to it, navigate, and compare with the truth.

        Needs nothing but what is bundled. All pictures take half an hour on two cores; --frames 4
        gives a first look.""",
        "--frames 4 --rows limb",
        _flights("phobos", _RUNS, "limb"),
    ),
    Study(
        "photometry",
        "Simple brightness laws against Hapke's.",
        """Draw real ground by Hapke's law and by the simple ones, and compare what a matcher sees.

        Shows, by emission angle, the correlation of the pictures and how far the law alone moves
        the peak of a template.""",
        "",
        compiles=False,
    ),
    Study(
        "points",
        "Positions from picked points.",
        """Draw pictures of the Earth with points of known places and solve them in all ways.

        Errors by way, by number of points and angle off the nadir; what a focal length does that is
        not what it says; how many blunders are found; the places that three points leave.""",
        "-o points.svg",
        (
            trials(5, 200, "Pictures of each row."),
            seed("Of pictures and errors."),
        ),
        draws=True,
    ),
    Study(
        "real",
        "Real pictures against their labels.",
        """Import, navigate and adjust sets of real pictures with the labels of their archives.

        The Apollo 15 frame is bundled. FOLDER holds the others: rosetta/pictures/*.lbl with their
        pictures and rosetta/67p*.obj, near/*.fit; what is not there is skipped, and said. Pictures,
        runs with overlays and adjusted runs go into the folder of -o. All of it takes a quarter of
        an hour.""",
        "shared -o real --frames 10",
        (
            click.Argument(["folder"], type=PATH),
            *_flights("real", "catalogs, pictures and runs with overlays", "67P"),
        ),
    ),
    Study(
        "resection",
        "Position errors against number and angle of control points.",
        """Solve thousands of resections with noisy points and tabulate the errors.

        Shows how the horizontal error falls with the number of points, how the height error grows
        below 20 degrees of intersection angle, and what solving the attitude too costs.""",
        "--trials 1000 -o resection.svg",
        (trials(10, 300, "Resections of each geometry."), seed("Of noise.")),
        draws=True,
        compiles=False,
    ),
    Study(
        "rotation",
        "Analytic rotation of bodies against SPICE kernels.",
        """Fit the small turn between the published rotation of a body and that of SPICE KERNELS.

        Prints the section [rotation_correction] for the body's file, and on stderr what the fit
        leaves at times that it has not seen. Takes two minutes.""",
        "moon_080317.tf moon_pa_de421_1900-2050.bpc",
        (
            click.Argument(["kernels"], nargs=-1, required=True, type=PATH),
            option("--body", str, "moon", "Whose rotation."),
            option("--years", (YEAR, YEAR), (1900.0, 2051.0), "First and last year of the fit."),
            option("--terms", click.IntRange(1, 400), 120, "How many trigonometric terms."),
        ),
        compiles=False,
        prints="format_toml",
    ),
    Study(
        "selection",
        "Chosen control points against random and one-Sun Harris points.",
        """Try to recognise chosen, random and one-Sun Harris points on the bundled Tycho terrain.

        Prints recognition rates and errors with 95 % intervals, at the DEM's posting and at twice
        it.""",
        "--trials 2000",
        (
            trials(100, 1000, "Recognition trials of each strategy at each posting, at least."),
            seed(),
        ),
    ),
    Study(
        "kmss",
        "Routes over a coast under clouds, by the points of an image.",
        """Draw coasts, build catalogs of their mosaics, fly routes of the KMSS and navigate.

        Pictures show another season, tone and haze than the mosaic, under clouds. Prints the shares
        of points found and of frames solved, the three sigmas beside those of the thesis, and the
        error of a mounting that was calibrated over each ground. Takes twenty minutes.""",
        "--routes 2 --frames 1",
        (
            output("optnav-kmss", "Folder for mosaics, catalogs, pictures and runs."),
            option("--routes", click.IntRange(2, 1000), 28, "Over both grounds together."),
            option("--frames", click.IntRange(1, 4), 3, "Of each route."),
            option("--fit", bool, False, "Other grounds: to set numbers with.", is_flag=True),
        ),
    ),
    Study(
        "stars",
        "Attitudes from stars at random pointings.",
        """Identify random pointings of three cameras among false spots, and random spots alone.

        How many are found, the errors of their attitudes against the stated sigmas, the time, and
        how many pictures without a star are taken for sky. Then draw the Moon from 10 000 km with
        stars beside it and do the same. Takes ten minutes; --pictures 0 leaves the Moon out.""",
        "--trials 20 --pictures 0",
        (
            output("optnav-stars", "Folder for the pictures; those in it are used again."),
            trials(5, 334, "Pictures of each row."),
            option("--pictures", click.IntRange(0, 1000), 60, "Of the Moon."),
            seed("Of pointings and errors."),
        ),
    ),
    Study(
        "stereo",
        "Height and side velocity from two cameras on a base.",
        """Draw pairs of the wide camera 25 to 1500 m over craters and relief and measure them.

        Prints the errors with the mounting exact and known to 20 arc seconds, how they grow with
        the height, the side velocity at 100 m, and how far the stated sigmas hold. Takes half an
        hour; --trials 1 gives a first look.""",
        "--trials 2",
        (
            trials(1, 6, "Pairs of each height, each with its own ground and Sun."),
            option("--draws", click.IntRange(1, MANY), 3, "Of noise and mounting, a pair."),
            seed("Of grounds, noise and errors."),
        ),
    ),
    Study(
        "flight_computer",
        "Time and memory of a frame by each method.",
        """Navigate by one frame in each way, in a process of its own, on one core in one thread.

        Times are of the processor, warm; memory is the greatest over what the loaded modules take.
        Needs nothing but what is bundled, and Linux. Takes ten minutes, most of them for pictures
        of a descent.""",
        "--rows cylinder",
        (
            output("optnav-flight-computer", "Folder for pictures and catalogs; used again."),
            option("--rows", str, "", "Only modes whose name contains this, such as 'stars'."),
            option("--rounds", click.IntRange(1, 1000), 7, "Frames of each mode that are timed."),
        ),
    ),
)

STUDIES = tuple(sorted((*_OTHERS, *ORBIT_STUDIES), key=lambda study: study.name))
