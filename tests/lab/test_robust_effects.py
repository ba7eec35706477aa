"""A user's effect that hangs, gives NaN or is too strong: one clear error; what diverges in a fit is counted."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
import yaml
from hannes_description.model import Model
from hannes_lab.own_effect import check_own_effects
from hannes_lab.prepare import prepare
from hannes_lab.recorded import make_trial
from lab.foreign_bags import Signals, hannes_in_one_line, signals_of_set, write_set

EFFECT = '''
import math

from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import FRICTION, LOAD, RESISTANCE, TORQUE, Q, T, V


class Mine(Effect):
    """A test."""

    name = "mine"
    title = "mine"
    parameters = (EffectParameter("level", "N.m", lower=0.0, upper=10.0, typical={typical}, vanishing=0.0),)
    looks_like = "nothing"

    @staticmethod
    def contribute(x, p, s, y):
        {body}
'''
HANG = "k = 0.0\n        while k < 1.0:\n            k -= 1.0 + p[0]\n        y[FRICTION] += k"
ROOT = "y[FRICTION] += p[0] * math.sqrt(5.0 - x[Q])"
DIVISION = "y[FRICTION] += p[0] / (x[Q] - x[Q])"
RARE = "if 0.4 < x[T] < 0.401:\n            raise ValueError('rare')\n        y[FRICTION] += p[0]"
LATE = "if x[T] > 6.0:\n            raise ValueError('late')\n        y[FRICTION] += p[0]"
UNDER_LOAD = "y[FRICTION] += p[0] * math.sqrt(1.0 - 60.0 * x[LOAD])"
LATER = "y[FRICTION] += p[0] * math.sqrt(3.0 - x[T])"
STRONG = "y[TORQUE] += 1e9 * p[0] * x[V]"


def effect_file(folder: Path, body: str, typical: float = 0.01) -> str:
    path = folder / "mine.py"
    path.write_text(EFFECT.format(body=body, typical=typical), encoding="utf-8")
    return f"{path}:Mine"


@pytest.fixture(scope="module")
def bags(tmp_path_factory: pytest.TempPathFactory) -> Path:
    conditions: dict[str, Signals] = signals_of_set(conditions=("fast",), closures=2)
    return write_set(tmp_path_factory.mktemp("set") / "bags", conditions)


@pytest.mark.parametrize(
    ("body", "said"),
    [
        (ROOT, "gives no number (math domain error) at position 5"),
        (DIVISION, "gives NaN or infinity"),
        (STRONG, "Is the typical value too strong?"),
        ("y[FRICTION] += undefined", "cannot be compiled"),
        ("print(p[0])", "contribute(x, p, s, y) calls print, or something else that needs Python"),
        (RARE, "failed at t = 0.4"),
        ("s[0] = x[Q]\n        y[FRICTION] += p[0]", "s has as many as its class says: `states = 1`"),
        ("y[FRICTION] = p[0]", "it must add to y"),
        ("y[FRICTION] += p[0]\n        p[0] *= 1.0001", "changes x or p"),
        ("y[FRICTION] += p[0]\n        x[V] = 7.0", "changes x or p"),
    ],
)
def test_a_bad_effect_is_one_clear_error(
    body: str,
    said: str,
    bags: Path,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    source = effect_file(tmp_path, body)
    out, truth = tmp_path / "out", tmp_path / "truth.yaml"
    for words in (
        ("diagnose", str(bags), "--effect", source),
        ("hide", str(out), "--truth", str(truth), "--effect", source),
    ):
        code, _, err = hannes_in_one_line(*words, capsys=capsys, monkeypatch=monkeypatch)
        assert code == 2 and said in err and len(err.strip().splitlines()) == 1
    assert not out.exists() and not truth.exists()


def test_an_effect_that_raises_late_ends_the_command(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """An exception cannot leave a C function: it was printed at every step, and the set was written all the same."""
    out, truth = tmp_path / "out", tmp_path / "truth.yaml"
    words = ("hide", str(out), "--truth", str(truth), "--effect", effect_file(tmp_path, LATE))
    code, _, err = hannes_in_one_line(*words, capsys=capfd, monkeypatch=monkeypatch)
    assert code == 2 and len(err.strip().splitlines()) == 1
    assert (
        "'mine'" in err and "failed at t = 6" in err and "ValueError: late" in err and "mine.py, line" in err
    )
    assert not out.exists() and not truth.exists()


@pytest.mark.parametrize(
    ("body", "plant"), [(LATER, "nominal"), (UNDER_LOAD, "nominal"), (LATER, "nominal_mujoco")]
)
def test_an_effect_that_gives_no_number_later_ends_the_command(
    body: str,
    plant: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A limiter behind it took the NaN for a number: a wild hand was recorded, and the effect found in it."""
    out, words = tmp_path / "out", ("--condition", "slow", "--closures", "1", "--model", plant)
    given = ("hide", str(out), "--truth", str(tmp_path / "t.yaml"), "--effect", effect_file(tmp_path, body))
    code, _, err = hannes_in_one_line(*given, *words, capsys=capsys, monkeypatch=monkeypatch)
    assert code == 2 and "'mine'" in err and "gave NaN or infinity before t = " in err
    assert not out.exists()


LAW = """
import numpy as np
from hannes_sim.native import CONTROL_SIGNATURE
from numba import cfunc

def control(x, p, s):
    {}
    return 0.5

COMPILED = cfunc(CONTROL_SIGNATURE)(control)

class Law:
    def __init__(self, parameters, period):
        self.address, self.period = COMPILED.address, period
        self.parameters, self.states = np.zeros(1), np.zeros(1)
    def reset(self):
        self.states[:] = 0.0
"""


def test_code_that_a_model_file_brings_is_tried_before_anything_runs_with_it(
    bags: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """What the clocks are judged by was simulated with a law that nobody had tried: it stood still, and Ctrl-C too."""
    (tmp_path / "law.py").write_text(LAW.format("print(x[0])"), encoding="utf-8")
    law = Model.load().to_dict() | {"controller": "law.py:Law"}
    effect_file(tmp_path, "s[0] = x[Q]\n        y[FRICTION] += p[0]")
    level = {"value": 0.01, "unit": "N.m", "lower": 0.0, "upper": 10.0, "status": "assumed", "source": "test"}
    entry = {"name": "mine", "source": "mine.py:Mine", "parameters": {"level": level}}
    effect = Model.load().to_dict() | {"effects": [entry]}
    out = ("--truth", str(tmp_path / "t.yaml"), "--closures", "1")
    for content, said in ((law, "calls print"), (effect, "s has as many as its class says")):
        file = tmp_path / "model.yaml"
        file.write_text(yaml.safe_dump(content), encoding="utf-8")
        for words in (("compare", str(bags)), ("hide", str(tmp_path / "out"), *out)):
            given = (*words, "--model", str(file))
            code, _, err = hannes_in_one_line(*given, capsys=capsys, monkeypatch=monkeypatch)
            assert code == 2 and said in err and len(err.strip().splitlines()) == 1, (words, err)
    assert not (tmp_path / "out").exists()


def test_what_a_machine_has_may_be_divided_by(tmp_path: Path) -> None:
    source = effect_file(tmp_path, "y[TORQUE] -= p[0] * x[V] / x[RESISTANCE]")
    motion = (np.linspace(0.0, 1.0, 50), np.linspace(0.0, 10.0, 50))
    check_own_effects([source], lambda _: None, motion)


def test_an_effect_that_hangs_is_ended(tmp_path: Path) -> None:
    motion = (np.linspace(0.0, 1.0, 50), np.linspace(0.0, 10.0, 50))
    for source in (effect_file(tmp_path, HANG), f"{tmp_path / 'endless.py'}:Mine"):
        (tmp_path / "endless.py").write_text("while True:\n    pass\n", encoding="utf-8")
        with pytest.raises(ValueError, match="loop that does not end"):
            check_own_effects([source], lambda _: None, motion, limit=3.0)


def test_a_simulation_that_diverges_is_penalised_and_counted() -> None:
    from hannes_lab.hide import make_set

    recordings, _ = make_set(Model.load(), [], seed=1, closures=2, conditions=["fast"])
    prepared = prepare([make_trial(r) for r in recordings], Model.load())
    residual = prepared.problem.residual(
        prepared.model, {"friction.coulomb": math.nan, "hand.stiffness": -1e9}
    )
    assert np.all(residual == prepared.problem.failed) and prepared.problem.failures == 1
