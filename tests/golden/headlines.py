"""The decisive figures of each study, for the table of the studies' README.

Each text names its figures' places as `tests.golden.documents.pick_cells` reads them. What was
asked for stands in brackets. A test demands that a number typed here stands in the stored run, too.
"""

HEADLINES: dict[str, dict[str, str]] = {
    "navigation": {
        "200 km, ground off as GLD100: {} of {}, {} m horizontal (≤ {}), {} m height (≤ {}), "
        "NEES {}": (
            "navigation_real 0 0 solved frames horizontal_rms_m horizontal_limit_m height_rms_m "
            "height_limit_m nees"
        ),
        "400 km, mare drawn at 474 m: {} m (≤ {}), {} m (≤ {}), NEES {}": (
            "navigation_real_474 0 2 horizontal_rms_m horizontal_limit_m height_rms_m "
            "height_limit_m nees"
        ),
        "**missed**, mare at 948 m: {} m (≤ {}), {} m (≤ {})": (
            "navigation_real_mare 0 0 horizontal_rms_m horizontal_limit_m height_rms_m "
            "height_limit_m"
        ),
    },
    "autonomous": {
        "wide camera, 400 km: {} of {}, {} m horizontal (≤ {}), {} m height (≤ {}), NEES {}": (
            "autonomous 0 2 solved frames horizontal_rms_m horizontal_limit_m height_rms_m "
            "height_limit_m nees"
        ),
        "limb of ≥ 140° lit: {} of {} (95 %), worst {} σ": (
            "autonomous 1 4 enough_solved enough_frames worst"
        ),
    },
    "horizon": {
        "100 km, ground off as GLD100: {} m below (≤ {}), {} m height (≤ {}), NEES {} (0.7-1.4)": (
            "horizon_real 0 1 terrain_ssp_m ssp_limit_m terrain_height_m height_limit_m nees"
        ),
        "100 000 km: range {}, direction {}": "horizon 1 3 range_with_relief direction",
    },
    "discs": {
        "Moon of 2.2-3 px: {}, direction {}, range {}": "discs 0 0 moon_solved direction range",
    },
    "phobos": {
        "limb, 100 km: {} m across (≤ {}), {} % of range (≤ {})": (
            "phobos 0 3 across_rms_m across_limit_m range_share range_share_limit"
        ),
        "points, 40 km: {} of {}, NEES {} (0.7-1.4); 20 km: {} of {}": (
            "phobos 0 6 solved frames nees; 0 7 solved frames"
        ),
    },
    "comet": {
        "no position: {} of {} ({} %), {} m across as seen (≤ {}), range {} % (≤ {}), NEES {}": (
            "comet 0 2 solved frames solved_limit across_seen_m across_limit range_rms range_limit "
            "nees"
        ),
    },
    "real": {
        "67P: {} of {}, {} px": "real 0 1 solved frames residual_rms_px",
        "Eros: {} of {}": "real 0 2 solved frames",
    },
    "kmss": {
        "{} of points found, {} of frames solved (≥ {}), N {}, B {}, R {} m, NEES {}": (
            "kmss 0 1 found solved solved_least n_m b_m r_m nees"
        ),
        "thesis, real pictures: N {}, B {}, R {} m": "kmss 0 0 n_m b_m r_m",
    },
    "apollo": {
        "{} of {} points, residual {} px = {} m": (
            "apollo 0 0 used predicted residual_px residual_m"
        ),
    },
    "acceptance": {
        "wrong ones solved: {} of {} (0.1 %)": "acceptance 1 8 solved situations",
        "right ones refused: {} of {} (3 %)": "acceptance 0 8 refused situations",
    },
    "descent": {
        "118 m model, 6.5-2 km: {} of {}, {} m a component / {} m height ({}), NEES {}": (
            "descent 0 1 solved frames horizontal_a_component_m height_m asked_for_m nees"
        ),
        "12 m model: {} / {} m ({}), NEES {}": (
            "descent_fine 0 0 horizontal_a_component_m height_m asked_for_m nees"
        ),
        "**missed**, as the Moon differs, 6.5-2 km: {} / {} m ({}), NEES {}": (
            "descent_moon 0 1 horizontal_a_component_m height_m asked_for_m nees"
        ),
    },
    "hazard": {
        "rough ground, {} % above 7°, Sun at 20°: {} % of pads, {} % expected": (
            "hazard 0 2 area_7 pads_7 expected"
        ),
        "Sun at 20°, albedo of 6 %: {} %, {} % expected": "hazard 0 8 pads_7 expected",
    },
    "hazard_descent": {
        "to 500 m and below, Sun at 20°: {} % of pads above 7°, {} σ at worst (3)": (
            "hazard_descent 0 4 pads_7 worst"
        ),
        "one picture: {} %": "hazard_descent 0 6 pads_7",
    },
    "hazard_rocks": {
        "even ground, Sun at 20°, 100 m: {} % found ({}), false {} of 100 ({})": (
            "hazard_rocks 0 4 found found_asked false false_asked"
        ),
        "**missed**, rough: {} % ({}), {} of 100 ({})": (
            "hazard_rocks 0 1 found found_asked false false_asked"
        ),
    },
    "stereo": {
        "100 m, mounting exact: {} m (0.1)": "stereo 0 2 exact_m",
        'known to 20": {} m, {} m stated': "stereo 0 2 mounted_m mounted_sigma_m",
    },
    "stars": {
        "`unk`: {} of {} (98 %), {} wrong, {}″ across": "stars 0 0 found frames wrong across",
        "beside the Moon: {} of {} (95 %), NEES {} (0.7-1.4)": "stars 2 0 solved pictures nees",
    },
    "points": {
        "20 points: {} / {} km ({})": "points 0 0 horizontal_km vertical_km asked",
        "orbit with the lens free: {} m across ({}), {} m radial ({})": (
            "points 5 2 found wanted; 5 3 found wanted"
        ),
        "**missed**, 12 pictures of 6 points: {} m ({})": "points 5 27 found wanted",
    },
    "cylinder": {
        "light at {}°: {} mm (≤ {}), {}° (≤ {})": (
            "cylinder 0 0 light d_rms d_asked theta_rms theta_asked"
        ),
        "speed: {} mm/s rms; **missed**: {} mm/s at most, from 2.4 m (≤ {})": (
            "cylinder 1 0 rms; 1 4 largest asked"
        ),
    },
    "calibration": {
        "NEES {} ({})": "calibration 0 0 NEES asked",
        "f {} % (0.004), clock {} ms (3)": "calibration 1 0 error; 1 7 error",
    },
    "orbit": {
        "NEES {} ({})": "orbit 0 5 found wanted",
        "prediction of 12 h {} m ({})": "orbit 0 11 found wanted",
    },
    "orbit_motion": {
        "degree {}: {} m, transition {} %, {} ms": (
            "orbit_motion 0 2 degree error_m transition milliseconds"
        ),
    },
    "orbit_runs": {
        "Moon: {} m range, {} m across, NEES {} ± {} (0.7-1.4)": (
            "orbit_runs 0 5 range across_m nees error"
        ),
    },
    "zenith": {
        "500 sessions: {} m (source: {})": "zenith 0 2 mean seed",
    },
    "qso": {
        "ring at 50 km: {} km (source: {})": "qso 0 0 ring seed_ring",
    },
    "landing": {
        "arrival {} m (≤ 30), NEES {} (0.7-1.4)": "landing 2 2 error nees",
        "{} of {} landed, {} m off at most (≤ 100)": "landing 4 0 landed trials most",
    },
    "delivery": {
        "trials inside: {} %": "delivery 0 0 inside",
        "bound over 99.73 % (1.3): radio {}; **missed**: optical {}, electric thrust {}": (
            "delivery 0 0 ratio; 0 1 ratio; 0 4 ratio"
        ),
    },
    "fit": {
        "held back, 200 km: NEES {}, worst {} σ": "fit 1 5 NEES_old worst_old",
        "`orbit_400km`: {}, {} σ": "fit 1 7 NEES_old worst_old",
    },
    "selection": {
        "118 m: chosen {}, random {}, one-Sun {}": (
            "selection 0 0 chosen random one_sun_our_window"
        ),
    },
    "economy": {
        "recognised: build {} %, all candidates under all Suns {} ± {} points": (
            "economy 0 5 recognised; 0 6 against against_half"
        ),
    },
    "matching": {
        "scale {}, aided {}": "matching 0 1 correlation aided_both",
    },
    "photometry": {
        "lunar-Lambert to {}°: correlation ≥ {}, shift ≤ {} nodes": (
            "photometry 1 4 emission_deg correlation_least shift_greatest"
        ),
    },
    "resection": {
        "4 points, 40°, attitude known: {} σ horizontal, {} σ height; free: {} σ, {} σ": (
            "resection 0 1 horizontal_40_deg height_40_deg; 1 0 horizontal_40_deg height_40_deg"
        ),
    },
    "arc": {
        "direction, errors correlated over 1°: {} σ at {}°, {} σ at {}°": (
            "arc 0 0 direction_1_deg arc_deg; 0 6 direction_1_deg arc_deg"
        ),
    },
    "flight_computer": {
        "limb {} ms, {} MB; points {} ms, {} MB; descent {} ms, {} MB": (
            "flight_computer 0 1 time_ms memory_mb; 0 2 time_ms memory_mb; 0 4 time_ms memory_mb"
        ),
    },
    "rotation": {
        "Moon with correction: {} rms, largest {}": "rotation 0 1 rms largest",
    },
}
