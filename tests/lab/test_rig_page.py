"""The whole adapter of docs/your-own-rig.md, as pasted, on logs of a gate that an integrator of its own makes."""

import json
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from lab.foreign_bags import hannes
from numba import njit
from numpy.typing import NDArray

PAGE = Path(__file__).resolve().parents[2] / "docs" / "your-own-rig.md"
FILES = ("gate.py", "gate.yaml", "parameters.yaml", "tolerances.yaml")
STICTION = 1.2  # N.m, that the model lacks
SPEED = 0.2  # rad/s, over which it falls off
PERIOD, REPEATS = 0.002, 5
CONSIDERED = ("stribeck_friction", "command_delay")


def pasted() -> dict[str, str]:
    found = re.findall(r"<!-- file: (\S+) -->\n```\w*\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    return dict(found)


@njit
def gate(reference: NDArray[np.float64], stiction: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Angle and current at the beginning of each control period; 20 us, friction of a steep smooth law."""
    angle, current = np.zeros(reference.size), np.zeros(reference.size)
    q = v = i = integral = slow = last = 0.0
    for k in range(reference.size):
        angle[k], current[k] = q, i
        slow += PERIOD / (PERIOD + 0.004) * ((q - last) / PERIOD - slow)
        last = q
        error = reference[k] - q
        u = 60.0 * error + integral + 120.0 * error * PERIOD - 1.5 * slow
        if abs(u) <= 24.0:
            integral += 120.0 * error * PERIOD
        u = min(max(u, -24.0), 24.0)
        for _ in range(100):
            level = 1.7 + stiction * math.exp(-((v / SPEED) ** 2))
            torque = 0.65 * 150.0 * 0.0325 * i - 1.0 * v - level * v / math.sqrt(v * v + 1e-6)
            v += 2e-5 * torque / (4.6e-6 * 150.0**2)
            q += 2e-5 * v
            i += 2e-5 * (u - 2.7 * i - 0.0325 * 150.0 * v) / 9e-4
    return angle, current


def there_and_back(seconds: float) -> NDArray[np.float64]:
    up = 0.6 - 0.6 * np.cos(np.pi * np.arange(0.0, seconds, PERIOD) / seconds)
    stand = np.ones(round(0.4 / PERIOD))
    lap = (up, 1.2 * stand, up[::-1], 0.0 * stand)
    return np.concatenate([0.0 * stand, *(part for _ in range(REPEATS) for part in lap)])


def log(folder: Path, stiction: float) -> list[str]:
    rng = np.random.default_rng(5)
    paths = []
    for name, seconds in (("slow", 2.0), ("fast", 1.0)):
        reference = there_and_back(seconds)
        angle, current = gate(reference, stiction)
        noise = rng.standard_normal((2, reference.size))
        columns = (
            np.arange(reference.size) * PERIOD,
            reference,
            angle + 1e-4 * noise[0],
            current + 0.004 * noise[1],
        )
        np.savetxt(
            folder / f"{name}.csv", np.column_stack(columns), delimiter=",", header="t,ref,angle,current"
        )
        paths.append(str(folder / f"{name}.csv"))
    return paths


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    for name, text in pasted().items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    return tmp_path


def test_it_is_as_short_as_it_says() -> None:
    files = pasted()
    assert tuple(files) == FILES
    assert len([line for line in files["gate.py"].splitlines() if line.strip()]) < 100


Asking = Callable[..., dict[str, Any]]


@pytest.fixture
def ask(folder: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Asking:
    """What a command answers of logs of a gate with this much stiction."""

    def asked(command: str, stiction: float, *words: str) -> dict[str, Any]:
        call = (command, *log(folder, stiction), "--rig", f"{folder}/gate.py:Gate", *words, "--json")
        code, out, err = hannes(*call, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 0, err
        answer: dict[str, Any] = json.loads(out)
        return answer

    return asked


def test_compare(ask: Asking) -> None:
    """The adapter's model, its parameters fitted, is as good as the gate repeats."""
    clean = ask("compare", 0.0, "--fitted")
    assert {c["phase"] for c in clean["cells"]} == {"opening", "closing", "hold", "rest"}
    assert max(e["ratio"] for e in clean["errors"]) < 1.5, clean["errors"]
    assert max(e["ratio"] for e in ask("compare", STICTION, "--fitted")["errors"]) > 3.0


@pytest.mark.parametrize(("stiction", "missing"), [(0.0, []), (STICTION, ["stribeck_friction"])])
def test_diagnose(ask: Asking, stiction: float, missing: list[str]) -> None:
    few = [word for name in CONSIDERED for word in ("--only", name)]
    found = ask("diagnose", stiction, "--jobs", "1", *few)
    assert [effect["name"] for effect in found["effects"]] == missing
