"""What a broken adapter is told: one error of one line that says what is wrong and where, and no wrong numbers."""

import json
import re
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hannes_description.model import Model
from hannes_lab.adapter import _coarse, _unlike, count_of
from hannes_lab.own_law import check_own_law
from hannes_lab.rig import load_rig
from hannes_lab.trials import Closure, Trial
from hannes_sim.factory import make_plant
from hannes_sim.plant import DEFAULT_DT
from hannes_sim.rollout import rollout, step_of
from lab.foreign_bags import hannes
from lab.single_mass_rig import reference, write_files

BASE = f"{Path(__file__).parent / 'single_mass_rig.py'}:SingleMass"

ADAPTER = """
from dataclasses import replace
import numpy as np
from hannes_lab.rig import load_rig
from hannes_lab.trials import Closure, Part, Trial

Base = load_rig({base!r})


def signal(t, name, change):
    return replace(t, signals={{**t.signals, name: change(*t.signals[name])}})


def position(t, change):
    return signal(t, "encoder_position", change)


def closures(t, change):
    return replace(t, closures=tuple(change(c) for c in t.closures))


class Mine(Base):
    model = {model!r}

    def logged(self, run, trial):
        s = super().logged(run, trial)
        return {logged}

    @classmethod
    def read(cls, paths):
        return {read}

    {more}
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three laps of the nominal mass, as its own simulation gives them, with the files of its model."""
    folder = tmp_path_factory.mktemp("rig")
    write_files(folder)
    model, machine = Model.load(folder / "mass.yaml"), load_rig(BASE)([])
    run = rollout(make_plant(model), machine.controller(model, 1e-3), reference(3))
    rng = np.random.default_rng(3)
    position = run.encoder_position + 2e-7 * rng.standard_normal(run.time.size)
    force = run.motor_voltage + 0.02 * rng.standard_normal(run.time.size)
    np.savez(folder / "mass.npz", reference=run.reference_position, position=position, force=force)
    return folder


class Lab:
    """`hannes compare` with an adapter of which one thing is changed."""

    def __init__(
        self, folder: Path, here: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
    ):
        self.folder, self.here, self._capsys, self._monkeypatch = folder, here, capsys, monkeypatch
        self.model = folder / "mass.yaml"

    def __call__(
        self, change: str = "t", *words: str, read: str = "", logged: str = "s", more: str = ""
    ) -> tuple[int, str, str]:
        read = read or f"[{change} for t in Base.read(paths)]"
        file = self.here / f"mine{len(list(self.here.glob('mine*.py')))}.py"  # a file is executed once
        file.write_text(ADAPTER.format(base=BASE, model=str(self.model), read=read, logged=logged, more=more))
        given = ["compare", str(self.folder / "mass.npz"), "--rig", f"{file}:Mine", *words]
        code, out, err = hannes(*given, capsys=self._capsys, monkeypatch=self._monkeypatch)
        return code, " ".join(out.split()), err

    def refused(self, *change: str, **how: str) -> str:
        code, _, err = self(*change, **how)
        assert code == 2, err
        assert len(err.strip().splitlines()) == 1, err
        return err


@pytest.fixture
def lab(
    folder: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Lab:
    return Lab(folder, tmp_path, capsys, monkeypatch)


def test_a_good_adapter_is_not_complained_of(lab: Lab) -> None:
    code, out, err = lab()
    assert code == 0 and not err and "Overall error" in out


@pytest.mark.parametrize(
    ("read", "said"),
    [
        ("None", "Mine.read returned nothing"),
        ("[]", "Mine.read returned no trial"),
        ("Base.read(paths)[0]", "must return a list of trials"),
        ("[np.zeros(3)]", "must be a hannes_lab.trials.Trial"),
        ("{}['x']", "Mine.read failed: KeyError: 'x' .*mine0.py, line"),
    ],
)
def test_what_read_returns_must_be_trials(lab: Lab, read: str, said: str) -> None:

    assert re.search(said, lab.refused(read=read))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ("replace(t, period=0.0)", "its period is 0.0"),
        ("replace(t, period=1e-4)", "lasts 7.799 s and the reference 0.7799 s"),
        ("replace(t, period=1e-2)", "the reference lasts 77.99 s and all signals end at 7.799 s"),
        ("replace(t, reference=t.reference[:, None])", "the reference has the shape (7800, 1)"),
        ("replace(t, reference=t.reference + np.where(t.reference > 0.05, np.nan, 0))", "the reference has"),
        ("replace(t, signals={})", "it has no signals"),
        ("position(t, lambda x, y: (x, y[:-3]))", "'encoder_position' has 7800 time stamps and 7797 values"),
        ("position(t, lambda x, y: (x, np.where(x > 5, np.nan, y)))", "'encoder_position' has 2799 of 7800 values"),
        ("position(t, lambda x, y: y)", "must be a pair (time, values)"),
        ("position(t, lambda x, y: (x[::-1], y))", "time stamps of 'encoder_position' go back"),
        ("position(t, lambda x, y: (1e3 * x, y))", "are time stamps in seconds"),
        ("position(t, lambda x, y: (x + 1e3, y))", "they do not overlap"),
        ("position(t, lambda x, y: (x[:300], y[:300]))", "covers no whole closure"),
        ("closures(t, lambda c: replace(c, start=c.stop, stop=c.start))", "it must stop later than it starts"),
        ("closures(t, lambda c: replace(c, stop=c.stop + 5))", "but the reference from 0 to 7.799 s"),
        ("closures(t, lambda c: replace(c, start=c.start - 5))", "but the reference from 0 to 7.799 s"),
        ("closures(t, lambda c: (c.start, c.stop))", "closure 1 is a tuple"),
        ("replace(t, reference=t.reference[:5000])", "but the reference from 0 to 4.999 s"),
        ("position(t, lambda x, y: (x[::800], y[::800]))", "has a sample every 0.8 s, but a closure lasts"),
        ("closures(t, lambda c: replace(c, condition='lap'))", "both 'lap', but their references are 0.0289 apart"),
    ],
)  # fmt: skip
def test_a_recording_that_cannot_be_replayed_is_refused(lab: Lab, change: str, said: str) -> None:
    told = lab.refused(change)
    assert said in told and "trial 'mass'" in told.replace("Trial", "trial")


def test_numbers_may_come_as_lists(lab: Lab) -> None:
    code, out, _ = lab("position(t, lambda x, y: (list(x), list(y)))")
    assert code == 0 and out == lab()[1]


@pytest.mark.parametrize(
    ("more", "said"),
    [
        ("sizes = {'Nm': 3.0}", "Mine.sizes: 'Nm': 3.0; it takes positive numbers for N.m, rad, V, A, s"),
        ("sizes = {'N.m': -3.0}", "Mine.sizes: 'N.m': -3.0"),
        ("without = {'gravitation': 'level'}", "no effect of the catalogue; is 'gravity' meant?"),
        ("without = ['gravity']", "Mine.without is a list; it takes a mapping of effects to reasons"),
        ("points = 1", "Mine.points is 1; it is how many points of a closure are compared at most"),
        ("floor = -1.0", "Mine.floor is -1.0; it is a part of a signal's span"),
        ("drive_signals = 'drive_force'", "Mine.drive_signals is 'drive_force'; it takes a tuple of names"),
        (
            "drive_signals = ('drive_forse',)",
            "they have drive_force, encoder_position: is 'drive_force' meant?",
        ),
    ],
)
def test_what_the_class_says_wrongly_is_refused(lab: Lab, more: str, said: str) -> None:
    assert said in lab.refused(more=more)


def test_a_gain_of_the_law_among_the_tolerances_is_led_to_run(lab: Lab) -> None:
    some = "value: 3, lower: 0, upper: 50, status: assumed, source: x"
    with_model(
        lab,
        friction=f"friction: {{viscous: {{{some}, unit: N.s/m}}}}\ncontrol: {{kp: {{{some}, unit: V/m}}}}",
    )
    file = lab.here / "mine.yaml"
    file.write_text("control.kp: {sd: 0.1, closure_sd: 0, unit: '1', source: x}\n")
    said = lab.refused(more=f"population = property(lambda self: {str(file)!r})")
    assert "'control.kp' is a gain of the control law" in said and "take it out of `values`" in said


def test_a_machine_may_show_nothing_of_what_its_drive_gives(lab: Lab) -> None:
    code, out, _ = lab(more="drive_signals = ()")
    assert code == 0 and "no current is recorded (only encoder_position, drive_force)" in out


def test_what_the_class_leaves_out_is_said(lab: Lab) -> None:
    code, out, _ = lab(more="sizes = {}")
    assert code == 0 and "Mine gives no `sizes`" in out and "0.05 N.m, 14.57 rad" in out


@pytest.mark.parametrize(
    ("tolerances", "said"),
    [
        ("", "there are no tolerances in it; give a line for each uncertain parameter"),
        ("- motor.armature", "there are no tolerances in it"),
        ("motor.armature: [0.1]", "'motor.armature' needs the numbers sd and closure_sd"),
        ("motor.armature: {sd: -0.1, closure_sd: 0, unit: kg}", "'motor.armature': sd is -0.1; it must be"),
        ("friction.viscous: {sd: 0.1, closure_sd: 0, unit: '1'}", "but is 0 N.s/m in "),
    ],
)
def test_tolerances_that_are_none_are_refused_by_their_file(lab: Lab, tolerances: str, said: str) -> None:
    with_model(
        lab,
        friction="friction: {viscous: {value: 0, unit: N.s/m, lower: 0, upper: 50, status: assumed, source: x}}",
    )
    file = lab.here / "mine.yaml"
    file.write_text(tolerances)
    told = lab.refused(more=f"population = property(lambda self: {str(file)!r})")
    assert told.startswith(f"hannes: {file}: ") and said in told


def test_units_that_a_turning_machine_does_not_take_are_refused(lab: Lab) -> None:
    with_model(
        lab, armature="  armature: {value: 2, unit: g, lower: 1, upper: 9, status: assumed, source: x}"
    )
    assert "armature" not in lab()[1], "of a linear machine a mass may come in other units"
    told = lab.refused(more="linear = False")
    assert f"{lab.here / 'parameters.yaml'}: parameter 'motor.armature' is in 'g'" in told
    assert "takes 'kg.m2': convert value, lower and upper" in told


def test_a_recording_that_is_not_there_is_refused(lab: Lab) -> None:
    code, _, err = lab("t", str(lab.here / "none.npz"))
    assert code == 2 and "No recording" in err and "none.npz': the path does not exist" in err


@pytest.mark.parametrize(
    ("logged", "said"),
    [
        ("None", "it returned nothing"),
        ("{'position': run.encoder_position}", "gives no encoder_position, drive_force"),
        ("{k: v[:-5] for k, v in s.items()}", "of shape (5255,)"),
        ("{k: list(v) for k, v in s.items()}", "as list"),
        ("{**s, 'drive_force': s['drive_force'] * np.nan}", "makes 'drive_force' of trial 'mass' NaN"),
        ("{**s, 'drive_force': trial.options['gain']}", "failed: KeyError: 'gain'"),
    ],
)
def test_logged_must_give_what_was_recorded(lab: Lab, logged: str, said: str) -> None:
    told = lab.refused(logged=logged)
    assert "Mine.logged" in told and said in told


def test_a_signal_that_logged_does_not_give_may_be_left_out_of_the_comparison(lab: Lab) -> None:
    more = "replace(t, signals={**t.signals, 'speed': t.signals['drive_force']})"
    assert "it gives no speed, which was recorded" in lab.refused(more)
    code, _, _ = lab(more, "--signal", "encoder_position")
    assert code == 0


def test_closures_with_a_gap_are_left_out(lab: Lab) -> None:
    gap = "position(t, lambda x, y: (np.delete(x, slice(500, 700)), np.delete(y, slice(500, 700))))"
    code, out, _ = lab(gap)
    assert code == 0 and "1 closure in which samples are missing is left out" in out
    gaps = "position(t, lambda x, y: (x[x % 0.3 < 0.2], y[x % 0.3 < 0.2]))"
    assert (
        "samples are missing in each of its closures; 'encoder_position' has none for 0.101 s"
        in lab.refused(gaps)
    )
    some = "position(t, lambda x, y: (x[:4000], y[:4000]))"
    assert "encoder_position covers 7 of 15 closures" in lab(some)[1]


FRESH = (
    "replace(t, closures=tuple(replace(c, condition='lap') for c in t.closures if c.condition == t.conditions[0]), "
    "parts=tuple(Part(str(k), '', '', 2.6 * k) for k in range(3)), fresh=True"
)


def test_parts_that_begin_anew_must_be_equal_tick_by_tick(lab: Lab) -> None:
    assert lab(f"{FRESH})")[0] == 0
    other = f"{FRESH}, reference=t.reference * (1 + 0.1 * (np.arange(t.reference.size) > 2000)))"
    assert "its reference (nearly) equal tick by tick" in lab.refused(other)
    many = "replace(t, parts=tuple(Part(str(k), '', '', 2.6 * k) for k in range(3)), fresh=True)"
    assert "conditions in it" in lab.refused(many)


def with_model(lab: Lab, model: str = "", **parameters: str) -> None:
    """Another model file beside the adapter, with lines of its parameters replaced."""
    text = (lab.folder / "parameters.yaml").read_text()
    for before, after in parameters.items():
        assert before in text
        text = "\n".join(
            after if line.strip().startswith(f"{before}:") else line for line in text.splitlines()
        )
    (lab.here / "parameters.yaml").write_text(text)
    lab.model = lab.here / "mass.yaml"
    lab.model.write_text(model or (lab.folder / "mass.yaml").read_text())


LAW = """
import numpy as np
from hannes_sim.native import CONTROL_SIGNATURE
from numba import cfunc


def control(x, p, s):
    {body}
    return 0.0


COMPILED = cfunc(CONTROL_SIGNATURE)(control)


class Law:
    def __init__(self, parameters, period):
        self.address, self.period = {address}, {period}
        self.parameters, self.states = {parameters}, np.zeros(1)

    def reset(self):
        {reset}
"""


GIVEN = {
    "body": "pass",
    "address": "COMPILED.address",
    "period": "period",
    "parameters": "np.zeros(1)",
    "reset": "pass",
}


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"body": "s.foo = 1"}, "TypingError: Cannot resolve setattr: (float64*).foo"),
        ({"address": "0"}, "its address is 0"),
        ({"address": "None"}, "its address is None"),
        ({"parameters": "[1.0]"}, "its `parameters` must be a numpy array of floats"),
        ({"parameters": "np.zeros(2, dtype=int)"}, "its `parameters` must be a numpy array of floats"),
        ({"period": "0.002"}, "its period is 0.002 s, that of the trial 0.001 s"),
        ({"parameters": "parameters['gain']"}, "Unknown parameter 'gain'"),
        ({"parameters": "parameters.gain"}, "AttributeError"),
        (
            {"body": "return p[3]"},
            "reads p[3]: index 3 is out of bounds, the length of its `parameters` is 1",
        ),
        ({"body": "return s[-1]"}, "reads s[-1]: index -1 is out of bounds"),
        ({"body": "s[2] += 2.0"}, "writes s[2]: index 2 is out of bounds, the length of its `states` is 1"),
        ({"body": "if s[2] == 0.0: s[2] = 1.0"}, "reads s[2]: index 2 is out of bounds"),
        ({"body": "x[6] = 2.0"}, "writes x[6]: index 6 is out of bounds, the length of x is 6"),
        ({"body": "return 1.0 / p[0]"}, "The control law failed at t = 0 s: ZeroDivisionError"),
        ({"body": "if x[5] > 0.3: raise ValueError('far')"}, "failed at t = 0.301 s: ValueError: far ("),
        ({"reset": "self.start = self.gain"}, "Law.reset failed: AttributeError"),
        ({"body": "print(x[0])"}, "calls print, or something else that needs Python"),
    ],
)
def test_a_control_law_that_cannot_run_is_refused(lab: Lab, change: dict[str, str], said: str) -> None:
    """Address 0 would end the process without a word, and beside an array is whatever lies there."""
    (lab.here / "law.py").write_text(LAW.format(**{**GIVEN, **change}))
    with_model(lab, (lab.folder / "mass.yaml").read_text().replace(BASE.rpartition(":")[0], "law.py"))
    assert said in lab.refused()


def test_a_control_law_that_does_not_end_is_refused(lab: Lab) -> None:
    body = "while x[4] > 0.0:\n        s[0] += 1.0"
    (lab.here / "law.py").write_text(LAW.format(**{**GIVEN, "body": body}))
    with_model(lab, (lab.folder / "mass.yaml").read_text().replace(BASE.rpartition(":")[0], "law.py"))
    kind = load_rig(BASE)
    rig = kind(kind.read([lab.folder / "mass.npz"]))
    with pytest.raises(ValueError, match=r"law.py:Law' did not finish one closure within 1 s"):
        check_own_law(rig, Model.load(lab.model), limit=1.0)


def test_a_model_that_lacks_what_its_plant_needs_is_refused(lab: Lab) -> None:
    with_model(lab, supply="", armature="")
    assert (
        "missing parameters: supply.voltage, motor.armature (the reduced plant cannot do without)"
        in lab.refused()
    )
    with_model(lab, "schema: hannes/model/1\nplant: reduced\nparameters: parameters.yaml\n", supply="")
    told = lab.refused()
    assert (
        "supply.voltage (the reduced plant" in told
        and "control.kp" in told
        and "the control law double_pid" in told
    )


def test_a_law_that_the_adapter_makes_is_checked_too(lab: Lab) -> None:
    told = lab.refused(more="def controller(self, model, period): return model.gain")
    assert "Mine.controller failed: AttributeError" in told
    assert "its address is None" in lab.refused(more="def controller(self, model, period): return 3")


def test_any_control_period_is_simulated(lab: Lab) -> None:
    """300 Hz is no multiple of the plant's usual step, 0.1 ms is less than it: the step follows."""
    for period in (1 / 300, 1e-4):
        at = f"np.arange(round(t.reference.size * 1e-3 / {period})) * {period}"
        resampled = f"np.interp({at}, np.arange(t.reference.size) * 1e-3, t.reference)"
        resampled = f"replace(t, period={period}, reference={resampled})"
        code, out, err = lab(resampled, "--json")
        assert code == 0, err
        errors = json.loads(out)["errors"]
        assert max(e["rmse"] for e in errors if e["unit"] == "m") < 2e-4, (
            "the recording's own model, at another rate"
        )
    usual = [1e-3, 2e-3, 0.25e-3, 0.01]
    assert [step_of(period) for period in usual] == [DEFAULT_DT] * 4
    assert step_of(1 / 300) == pytest.approx(1 / 300 / 14) and step_of(1e-4) == 1e-4


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (
            "position(t, lambda x, y: (x, 57.3 * y))",
            "times its reference, which the simulated one follows",
        ),
        ("position(t, lambda x, y: (x, -y))", "encoder_position moves against its reference"),
        ("signal(t, 'drive_force', lambda x, y: (x, 1e3 * y))", "is it recorded in another unit?"),
        (
            "signal(t, 'drive_force', lambda x, y: (x, -y))",
            "drive_force goes against its simulation (correlation -1.00)",
        ),
        ("replace(t, reference=np.append(t.reference, np.zeros(2000)))", "is its period of 0.001 s right?"),
    ],
)
def test_what_looks_like_another_unit_or_sign_is_said(lab: Lab, change: str, said: str) -> None:
    code, out, _ = lab(change)
    assert code == 0 and said in out


def test_what_is_said_to_another_machine_is_not_said_of_a_hand(lab: Lab) -> None:
    one = "replace(t, closures=tuple(c for c in t.closures if c.condition == t.conditions[0]))"
    code, out, _ = lab(one)
    assert code == 0 and "record another speed, and another load" in out and "forward" in out
    assert not re.search(r"\b(hand|grasp|void|opening)\b", out)
    single = "replace(t, closures=t.closures[:1])"
    assert "how well it repeats is not known" in lab(single)[1]
    alone = "replace(t, signals={'encoder_position': t.signals['encoder_position']})"
    assert "no drive force is recorded" in lab(alone)[1]


def test_parameters_of_the_hand_are_not_taken_in_silence(lab: Lab) -> None:
    with_model(
        lab,
        f"schema: hannes/model/1\nname: bare\nplant: reduced\ncontroller: '{BASE.rpartition(':')[0]}:Law'\n",
    )
    code, out, _ = lab()
    assert code == 0 and "the parameters of model 'bare' are the Hannes hand's" in out
    with_model(lab)
    assert "Hannes hand's" not in lab()[1]


def test_repeats_that_a_coarse_sensor_shows_alike_are_known_to_the_rigs_floor(lab: Lab) -> None:
    """Rounded to 0.1 mm the machine repeats itself here and there, but for the last bit."""
    _, out, _ = lab("position(t, lambda x, y: (x, np.round(y, 4)))", "--json")
    cells = [c for c in json.loads(out)["cells"] if c["signal"] == "encoder_position"]
    least = [1e-5 * abs(float(b) - float(a)) * 1e-3 for c in cells for a, _, b, _ in [c["condition"].split()]]
    assert all(c["repeatability"] > 0.9 * floor for c, floor in zip(cells, least, strict=True))


def test_a_payload_of_a_condition_is_added_to_what_is_fitted(lab: Lab) -> None:
    """As docs/your-own-rig.md has it: the recording is of a mass without it."""
    run = """def run(self, model, values, trial, reference):
        j = values.get("motor.armature", model.parameters.value("motor.armature"))
        return super().run(model, {**values, "motor.armature": j + trial.options["payload"]}, trial, reference)"""
    less = ["value: 2.0", "value: 1.5"]
    text = (lab.folder / "parameters.yaml").read_text()
    assert less[0] in text

    def error(payload: float) -> float:
        code, out, err = lab(f"replace(t, options={{'payload': {payload}}})", "--json", more=run)
        assert code == 0, err
        return max(e["rmse"] for e in json.loads(out)["errors"] if e["unit"] == "N")

    as_it_was = error(0.0)
    assert error(0.5) > 3.0 * as_it_was
    with_model(lab, armature=next(line for line in text.splitlines() if "armature" in line).replace(*less))
    assert error(0.5) == pytest.approx(as_it_was, rel=1e-3)


def test_an_encoder_of_the_other_sign_is_said_of_a_step_and_of_volts() -> None:
    """There the simulated position does not look like its reference: it is held against the simulation itself."""
    t = np.arange(0.0, 1.0, 1e-3)
    reference = (t, np.where(t > 0.05, 2.4, 0.0))
    motion = 2.4 * np.clip((t - 0.05) / 0.8, 0.0, 1.0)
    said = _unlike("encoder_position", "rad", reference, (t, motion), (t, -1.1 * motion))
    assert said is not None and "goes against its simulation" in said
    assert _unlike("encoder_position", "rad", reference, (t, motion), (t, 1.1 * motion)) is None
    volts = (t, np.full(t.size, -6.0))
    assert _unlike("encoder_position", "rad", volts, (t, -motion), (t, motion)) is not None


def test_an_encoder_that_is_coarser_than_the_floor_is_told() -> None:
    """Whole degrees of an arm that swings by 2 rad, logged at 200 Hz; noise over many counts hides no step."""
    t = np.arange(2000) * 5e-3
    angle = np.where(t < 4.0, 0.0, 1.0 - np.cos(t - 4.0))
    counts = np.radians(np.round(np.degrees(angle)))
    noise = 0.1 * np.random.default_rng(0).standard_normal(t.size)

    def told(values: np.ndarray, floor: float = 2e-4) -> list[str]:
        trial = Trial("arm", 5e-3, angle, {"encoder_position": (t, values)}, (Closure(0.0, 9.0, "swing"),))
        rig: Any = SimpleNamespace(trials=(trial,), floor=floor)
        return _coarse(rig)

    (said,) = told(counts)
    assert "in steps of 0.0175 rad in 'arm'" in said and "make it 0.003" in said
    assert count_of(np.round(counts, 4)) == pytest.approx(np.radians(1.0), rel=0.01), "a log of few digits"
    switched = np.where(t < 5.0, 0.0, 12.0)
    for values in (angle, np.radians(np.round(np.degrees(angle + noise))), switched):
        assert count_of(values) == 0.0 and not told(values)
    assert not told(counts, floor=3e-3)
