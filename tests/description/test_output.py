"""How the commands' tables and numbers look."""

import io
import json
import math
import re

import pytest
from hannes_description.output import estimate, number, print_json, print_table, with_unit

ROWS = [
    ["friction.coulomb", 0.012345, "a sentence on where this number comes from, longer than a terminal"]
] * 2


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


@pytest.mark.parametrize("columns", [20, 60, 200])
def test_a_narrow_terminal_folds_text_and_cuts_no_number(
    columns: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", str(columns))
    monkeypatch.setenv("TERM", "xterm")
    out = Terminal()
    monkeypatch.setattr("sys.stdout", out)
    print_table("Parameters", ["parameter", "value", "source"], ROWS, right=[1])
    text = re.sub(r"\x1b\[[\d;]*m", "", out.getvalue())
    lines = text.splitlines()
    assert sum("friction.coulomb  0.012345" in line for line in lines) == 2
    assert text.count("sentence") == 2 and "…" not in text
    widest = max(len(line.rstrip()) for line in lines)
    assert widest <= max(columns, 40) and (columns < 200 or len(lines) == 4)


def test_a_pipe_gets_whole_lines(capsys: pytest.CaptureFixture[str]) -> None:
    print_table("", ["parameter", "value", "source"], ROWS, right=[1])
    assert capsys.readouterr().out.count("longer than a terminal") == 2


def test_what_is_not_a_number_is_a_dash_or_null(capsys: pytest.CaptureFixture[str]) -> None:
    assert [number(v) for v in (1.23456, math.nan, None, math.inf)] == ["1.235", "-", "-", "-"]
    assert (with_unit(2.0, "A"), with_unit(2.0, "1")) == ("2 A", "2")
    print_json({"a": (math.nan, 1.0), 2: {"ü": -math.inf}})
    out = capsys.readouterr().out
    assert json.loads(out) == {"a": [None, 1.0], "2": {"ü": None}} and "ü" in out


def test_an_interval_is_printed_with_digits_that_show_its_width() -> None:
    assert estimate(5.9969, 5.9941, 5.9996, "Hz") == ("5.9969 Hz", "5.9941 .. 5.9996")
    assert estimate(0.12, 0.05, 0.3, "1") == ("0.12", "0.05 .. 0.3")
    assert estimate(1234.5678, 1234.5, 1234.6, "V") == ("1234.568 V", "1234.5 .. 1234.6")
    assert estimate(0.0, 0.0, 0.0, "m") == ("0 m", "0 .. 0")
    assert estimate(2.0, None, float("inf"), "m") == ("2 m", "- .. -")
