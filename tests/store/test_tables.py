"""Tables as spreadsheets of any country write them: read rightly, or refused with the line."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tract_dask.errors import InputError, SettingsError
from tract_dask.export.atoms import read_atoms
from tract_dask.stages.drift.stage import read_drift_csv
from tract_dask.store.columns import parse_columns_csv, positions, read_columns_csv
from tract_dask.store.tables import parse_number, parse_table

RIGHT = {
    "commas": "x,y\n1.5,2\n3,4.25\n",
    "semicolons": "x;y\n1.5;2\n3;4.25\n",
    "decimal commas": "x;y\n1,5;2\n3;4,25\n",
    "decimal commas and tabs": "x\ty\n1,5\t2\n3\t4,25\n",
    "a separator that is said": "sep=;\nx;y\n1,5;2\n3;4,25\n",
    "windows": "\ufeffx;y\r\n1,5;2\r\n3;4,25\r\n",
    "comments": '# written by "a, "b\n#,"\nx,y\n# 9,9\n1.5,2\n\n3,4.25\n  # end\n',
    "more that is empty": "x,y\n1.5,2,,\n3,4.25,\n",
    "quotes": 'x,y,kind\n"1.5","2","a, b"\n3,4.25,c\n',
    "spaces": " x , y \n 1.5,  2\n 3, 4.25 \n",
}


@pytest.mark.parametrize("text", RIGHT.values(), ids=RIGHT)
def test_the_same_table_in_other_spellings(text: str, tmp_path: Path) -> None:
    np.testing.assert_array_equal(positions(parse_columns_csv(text, "c.csv")), [[1.5, 2], [3, 4.25]])
    for encoding in ("utf-8", "utf-16"):
        (tmp_path / "c.csv").write_text(text, encoding=encoding, newline="")
        np.testing.assert_array_equal(positions(read_columns_csv(tmp_path / "c.csv")), [[1.5, 2], [3, 4.25]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("x,y\n1,5,2,5\n", "line 2: there are more values than the first line names"),
        ("x,y,kind\n1,2,a\n3,4\n", "line 3: there are fewer values than the first line names"),
        ("x;y\n1,5;2\n\n3.25;4\n", "line 4: numbers have commas in one place and points in another.*line 2.*line 4"),
        ("x;y\n1.234,5;2\n", "line 2: x cannot be read"),
        ("x,y,x\n1,2,3\n", "line 1: a name of the first line comes twice.*x"),
        ("# a\nx,y\n1_0,2\n", "line 3: x cannot be read"),
        ("x,y\n0x1F,2\n", "line 2: x cannot be read"),
        ('x,y\n"1,5","2,5"\n', "line 2: x cannot be read"),
        ("x,y\n1 # one,2\n", "line 2: x cannot be read"),
    ],
)
def test_what_cannot_be_known_is_refused_with_its_line(text: str, message: str) -> None:
    with pytest.raises(SettingsError, match=rf"c\.csv, {message}"):
        parse_columns_csv(text, "c.csv")


def test_lines_are_those_of_the_file() -> None:
    table = parse_table("# a\n\nframe;y;x\n0;0,5;1\n#\n1;2;3\n", "d.csv")
    assert table.header == ["frame", "y", "x"]
    assert (table.line, table.rows) == (3, [(4, ["0", "0.5", "1"]), (6, ["1", "2", "3"])])


def test_drift_and_numbers_of_atoms_with_decimal_commas(tmp_path: Path) -> None:
    path = tmp_path / "drift.csv"
    path.write_text("frame;y;x\n1;-0,25;1,5\n0;0;0\n")
    np.testing.assert_array_equal(read_drift_csv(path, 2), [[0, 0], [-0.25, 1.5]])
    path.write_text("column_id;atoms;note\n4;3;a\n2;;b\n")
    np.testing.assert_array_equal(read_atoms(path).sel(column_id=[4, 2]), [3, np.nan])
    path.write_text("column_id,atoms\n4,3\n2,3,5\n")
    with pytest.raises(InputError, match="line 3: there are more values"):
        read_atoms(path)
    path.write_text("column_id,atoms\n4.5,3\n")
    with pytest.raises(InputError, match="line 2: column_id cannot be read"):
        read_atoms(path)


@given(st.text(st.sampled_from('xy,;\t\n\r"#1.5 ='), max_size=40))
def test_any_text_is_a_table_or_is_refused(text: str) -> None:
    try:
        table = parse_table(text, "a.csv")
    except SettingsError:
        return
    assert all(len(values) == len(table.header) for _, values in table.rows)


@pytest.mark.parametrize(("text", "value"), [("1e-3", 1e-3), (" -.5 ", -0.5), ("+2.", 2.0), ("Inf", np.inf)])
def test_numbers(text: str, value: float) -> None:
    assert parse_number(text) == value


@pytest.mark.parametrize("text", ["", "1_0", "1,5", "0x1", "one", "1 2", "١"])
def test_what_is_no_number(text: str) -> None:
    with pytest.raises(ValueError, match="not a number"):
        parse_number(text)
