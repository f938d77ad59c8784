"""The columns of files that other programs read, in their order."""

import pytest

from optnav_cli.fix import MatchKind, Method
from optnav_cli.frames.tables import HEIGHTS, LANDMARKS, PADS, CsvTable


@pytest.mark.parametrize(
    ("table", "columns"),
    [
        (
            LANDMARKS,
            "id,first_file,last_file,n_seen,lat_deg,lon_deg,radius_m,cov_ee_m2,cov_en_m2,cov_eu_m2,"
            "cov_nn_m2,cov_nu_m2,cov_uu_m2,status,reason",
        ),
        (
            PADS,
            "file,square_row,square_col,x_px,y_px,lat_deg,lon_deg,expected_dangerous_share,"
            "expected_critical_share,shadow_share,mean_slope_deg,prior_slope_deg,n_rocks,rock_share,"
            "dir_camera_x,dir_camera_y,dir_camera_z,dir_body_x,dir_body_y,dir_body_z,reason",
        ),
        (
            HEIGHTS,
            "file_left,file_right,utc,height_m,sigma_m,sigma_mounting_m,n_windows,velocity_x_m_s,"
            "velocity_y_m_s,velocity_sigma_m_s,status,reason",
        ),
    ],
)
def test_tables_of_a_descent_have_their_columns_in_this_order(
    table: CsvTable, columns: str
) -> None:
    assert ",".join(column.name for column in table.columns) == columns


def test_words_of_a_descents_rows_are_those_of_the_files() -> None:
    kinds = {kind.value for kind in MatchKind}
    assert {"control_point", "window", "landmark"} <= kinds
    assert {"control_points", "descent", "relative_landmarks"} <= {m.value for m in Method}
