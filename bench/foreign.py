"""The lab on recordings of another simulator: `python bench/foreign.py [--jobs N]`.

Hands of `bench/other_hand.py`, perturbed and scattering from closure to closure, are recorded into plain rosbag2 bags
without metadata: nothing says how they were logged, what was grasped, or which gains the controller has.  Each set is
diagnosed with the nominal model.  Every result is kept in a file named by its content and the sources' hash, so
that an interrupted run goes on where it stopped.  `--tuning` takes other seeds and strengths, for setting thresholds.
`--full-hand` takes closures of the full hand in MuJoCo instead, without what describes them: a third simulator to the
reduced plant, on which no threshold was set.  `--lugre` takes the hand of `bench/lugre_hand.py`, with another friction,
other gains and another move: first the sets of which the failures were looked into, then others.  `--wound` takes both
hands with the wire wound up at encoder zero, so that they rest off their open stop.  `--voltage` takes recordings that
have the motor's voltage too.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import math
import sys
import tempfile
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.hide import make_set
from hannes_lab.prepare import load_trials, prepare
from hannes_lab.recorded import make_trial
from hannes_lab.trials import Trial
from hannes_sim.effect import strength_of
from joblib import Parallel, delayed
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

sys.path.insert(0, str(Path(__file__).parent))
import identification
import lugre_hand
import other_hand
from identification import kept, source_hash

SPREAD = {
    "resistance": 0.025, "kt": 0.015, "friction": 0.05, "viscous": 0.05, "preload": 0.025, "spring": 0.025,
    "load_friction": 0.05,
}  # fmt: skip
"""Relative standard deviations from hand to hand."""

SCATTER = {"friction": 0.02, "load_friction": 0.02, "viscous": 0.02, "resistance": 0.005, "preload": 0.005}
"""The same from closure to closure; besides 0.002 rad of the encoder's zero, and of an object 2 % and 0.03 rad."""

OBJECTS = {"rigid": (1.5, 8.1, 0.0), "soft": (0.0136, 5.6, 0.05)}
"""Stiffness (N.m/rad at the pulley), angle of the contact, damping."""

LOGS = {
    "30 Hz rectified": (30.0, 1.0 / 30.0, True, 250.0),
    "50 Hz": (50.0, 0.02, False, 100.0),
    "100 Hz": (100.0, 0.01, False, 100.0),
}
"""Rate (Hz), averaging window (s) and rectifier of the current, and rate of the reference's log (Hz)."""

AND_VOLTAGE = ", voltage"
"""Ends the name of a log that has the motor's voltage too, as it was commanded last."""

STORE = get_typestore(Stores.ROS2_JAZZY)
FLOAT, JOINTS = STORE.types["std_msgs/msg/Float64"], STORE.types["sensor_msgs/msg/JointState"]
HEADER, TIME = STORE.types["std_msgs/msg/Header"], STORE.types["builtin_interfaces/msg/Time"]

HIDDEN: tuple[tuple[tuple[str, ...], str, tuple[tuple[str, float], ...]], ...] = (
    (("viscous_friction",), "50 Hz", (("viscous", 3.5),)),
    (("viscous_friction",), "30 Hz rectified", (("viscous", 5.0),)),
    (("load_dependent_friction",), "100 Hz", (("capstan", 0.12),)),
    (("load_dependent_friction",), "30 Hz rectified", (("capstan", 0.25),)),
    (("glove_stiffness",), "50 Hz", (("glove", 4e-4), ("glove_power", 2.0))),
    (("glove_stiffness",), "30 Hz rectified", (("glove", 3e-5),)),
    (("wire_slack",), "100 Hz", (("slack", 0.6),)),
    (("wire_slack",), "50 Hz", (("slack", 1.2),)),
    (("stribeck_friction",), "100 Hz", (("stiction", 0.02), ("stiction_speed", 0.8))),
    (("stribeck_friction",), "50 Hz", (("stiction", 0.04), ("stiction_speed", 0.4))),
    (("direction_dependent_friction",), "100 Hz", (("asymmetry", 0.012),)),
    (("direction_dependent_friction",), "50 Hz", (("asymmetry", 0.025),)),
    (("cogging",), "100 Hz", (("ripple", 0.015), ("waves", 1.5))),
    (("cogging",), "50 Hz", (("ripple", 0.025), ("waves", 0.8))),
    (("current_sensor",), "100 Hz", (("current_gain", 1.15),)),
    (("current_sensor",), "50 Hz", (("current_gain", 0.85),)),
    (("glove_stiffness", "load_dependent_friction"), "100 Hz", (("glove", 3e-5), ("capstan", 0.2))),
    (("viscous_friction", "wire_slack"), "50 Hz", (("viscous", 4.0), ("slack", 0.8))),
    (("a worn spot",), "100 Hz", (("spot", 0.04),)),
    (("a worn spot",), "30 Hz rectified", (("spot", 0.03), ("spot_at", 5.0))),
    (("quadratic drag",), "100 Hz", (("drag", 1.5e-4),)),
    (("quadratic drag",), "50 Hz", (("drag", 4e-4),)),
    (("gearbox_inertia",), "50 Hz", (("rotor", 1.6),)),
    (("gearbox_inertia",), "100 Hz", (("rotor", 2.2),)),
)
"""What is hidden, as the catalogue calls it if it does, the log, and values of Hand (`viscous`, `rotor` as factors)."""

OUTSIDE = (
    "a worn spot", "quadratic drag", "hysteresis", "a shaking mount", "a torque constant that falls",
)  # fmt: skip
RELATIVE = ("viscous", "rotor")

CLEAN: tuple[tuple[str, tuple[tuple[str, float], ...]], ...] = (
    ("30 Hz rectified", ()), ("50 Hz", ()), ("100 Hz", ()), ("30 Hz rectified", (("wire", 1.5),)),
    ("50 Hz", (("kp", 0.55), ("kd", 0.03), ("current_kp", 0.05), ("current_ki", 600.0))),
    ("100 Hz", (("friction", 0.020), ("load_friction", 0.012))), ("30 Hz rectified", (("blur", 0.1),)),
    ("100 Hz", (("load", 8e-6), ("wire_damping", 2e-3))), ("50 Hz", (("rotor", 1.12),)),
)  # fmt: skip
"""Nothing is hidden, but the hand, its controller or the simulator's friction law is another."""


FULL_HAND: tuple[tuple[str, ...], ...] = (
    (), ("glove_stiffness",), ("viscous_friction",), ("wire_slack",), ("load_dependent_friction",), ("cogging",),
    ("glove_stiffness", "viscous_friction"), (),
)  # fmt: skip
"""What is hidden in the full hand, at the catalogue's typical strength."""

FULL_LOG = "full hand, 30 Hz rectified"
DESCRIBES = ("sensors", "plant")
"""What says how a recording was made."""


LUGRE: tuple[tuple[tuple[str, ...], str, tuple[tuple[str, float], ...]], ...] = (
    ((), "30 Hz rectified", ()),
    ((), "50 Hz", ()),
    ((), "100 Hz", (("current_kp", 0.12), ("current_ki", 1100.0))),
    (("viscous_friction",), "50 Hz", (("viscous", 4.0),)),
    (("load_dependent_friction",), "100 Hz", (("capstan", 0.2),)),
    (("glove_stiffness",), "50 Hz", (("glove", 4e-4),)),
    (("wire_slack",), "100 Hz", (("slack", 0.9),)),
    (("gear_backlash",), "100 Hz", (("backlash", 0.4),)),
    (("hysteresis",), "100 Hz", (("hysteresis", 0.03),)),
    (("quadratic drag",), "100 Hz", (("drag", 2.5e-4),)),
    (("a shaking mount",), "100 Hz", (("shaking", 0.02),)),
)
"""What is hidden in the hand of bristles, the log, and values of its Hand; what went wrong in these was looked into."""

LUGRE_ONCE: tuple[tuple[tuple[str, ...], str, tuple[tuple[str, float], ...]], ...] = (
    ((), "50 Hz", (("friction", 0.021), ("load_friction", 0.011))),
    ((), "30 Hz rectified", (("kp", 0.5), ("kd", 0.025), ("wire", 1.3))),
    (("viscous_friction",), "30 Hz rectified", (("viscous", 3.0),)),
    (("load_dependent_friction",), "30 Hz rectified", (("capstan", 0.3),)),
    (("glove_stiffness",), "100 Hz", (("glove", 5e-5), ("glove_power", 3.0))),
    (("wire_slack",), "50 Hz", (("slack", 0.6),)),
    (("gear_backlash",), "50 Hz", (("backlash", 0.25),)),
    (("stribeck_friction",), "100 Hz", (("stiction", 0.045),)),
    (("glove_stiffness", "viscous_friction"), "50 Hz", (("glove", 3e-4), ("viscous", 3.0))),
    (("hysteresis",), "50 Hz", (("hysteresis", 0.05),)),
    (("quadratic drag",), "50 Hz", (("drag", 5e-4),)),
)
"""The same, with other values and loggers; the slack that was missed in these was looked into."""


WOUND: tuple[tuple[tuple[str, ...], str, tuple[tuple[str, float], ...], bool], ...] = (
    ((), "30 Hz rectified", (("zero", -1.3),), False),
    ((), "100 Hz", (("zero", -0.8), ("friction", 0.015), ("load_friction", 0.005)), True),
    ((), "50 Hz", (("zero", -2.0), ("friction", 0.017), ("load_friction", 0.004)), False),
    (("viscous_friction",), "50 Hz", (("zero", -1.3), ("viscous", 4.0)), True),
    (
        ("load_dependent_friction",),
        "30 Hz rectified",
        (("zero", -0.7), ("capstan", 0.25), ("friction", 0.017)),
        False,
    ),
    (("glove_stiffness",), "100 Hz", (("zero", -1.6), ("glove", 4e-4), ("glove_power", 2.0)), False),
    (
        ("cogging",),
        "100 Hz",
        (("zero", -1.0), ("ripple", 0.02), ("waves", 1.2), ("load_friction", 0.005)),
        False,
    ),
    (("stribeck_friction",), "50 Hz", (("zero", -1.5), ("stiction", 0.045), ("friction", 0.017)), True),
    (
        ("glove_stiffness", "viscous_friction"),
        "30 Hz rectified",
        (("zero", -1.2), ("glove", 4e-4), ("viscous", 4.0)),
        True,
    ),
    (("a worn spot",), "100 Hz", (("zero", -1.3), ("spot", 0.04)), False),
)
"""Hands that rest off their open stop, some with half the dry friction: what is hidden, the log, values of Hand, and
whether the hand is that of bristles."""


VOLTAGE: tuple[tuple[tuple[str, ...], str, tuple[tuple[str, float], ...], str], ...] = (
    ((), "100 Hz", (), "rigid"),
    ((), "50 Hz", (("friction", 0.022), ("wire", 1.2)), "soft"),
    ((), "30 Hz rectified", (("kp", 0.5), ("current_kp", 0.09), ("current_ki", 900.0)), "rigid"),
    (("brush_drop",), "100 Hz", (("brush", 0.25),), "rigid"),
    (("supply_sag",), "50 Hz", (("source", 0.6),), "rigid"),
    (("stribeck_friction",), "100 Hz", (("stiction", 0.03), ("stiction_speed", 0.7)), "rigid"),
    (("glove_stiffness", "brush_drop"), "100 Hz", (("glove", 4e-5), ("brush", 0.3)), "rigid"),
    (("a torque constant that falls",), "50 Hz", (("saturation", 0.05),), "rigid"),
)
"""Recordings with the motor's voltage: what is hidden, the log, values of Hand, and what is grasped."""


@dataclass(frozen=True)
class Case:
    """One set of recordings: slow and fast closures on nothing, slow ones on an object."""

    hidden: tuple[str, ...]
    log: str
    changes: tuple[tuple[str, float], ...]
    seed: int
    grasp: str = "rigid"
    repeats: int = 13
    lugre: bool = False

    @property
    def key(self) -> str:
        here = Path(__file__).parent
        files = ("foreign.py", "hand_parts.py", "lugre_hand.py", "other_hand.py")
        sources = [source_hash(), *((here / f).read_text() for f in files)]
        return hashlib.sha256(json.dumps([asdict(self), sources]).encode()).hexdigest()[:20]


def full_hand_cases() -> list[Case]:
    """The sets of the full hand."""
    return [Case(hidden, FULL_LOG, (), 900 + k) for k, hidden in enumerate(FULL_HAND)]


def lugre_cases() -> list[Case]:
    """The sets of the hand of bristles."""
    return [
        Case(*what, first + k, lugre=True)
        for first, some in ((500, LUGRE), (550, LUGRE_ONCE))
        for k, what in enumerate(some)
    ]


def wound_cases() -> list[Case]:
    """The sets of both hands with the wire wound up at encoder zero."""
    return [
        Case(hidden, log, values, 650 + k, lugre=lugre)
        for k, (hidden, log, values, lugre) in enumerate(WOUND)
    ]


def voltage_cases() -> list[Case]:
    """The sets with the motor's voltage."""
    return [
        Case(hidden, log + AND_VOLTAGE, values, 750 + k, grasp)
        for k, (hidden, log, values, grasp) in enumerate(VOLTAGE)
    ]


def cases(tuning: bool) -> list[Case]:
    """All sets; the tuning ones have other seeds and strengths."""
    first = 100 if tuning else 700
    out = [
        Case((), log, values, first + k, "soft" if k % 4 == 2 else "rigid")
        for k, (log, values) in enumerate(CLEAN)
    ]
    for k, (hidden, log, values) in enumerate(HIDDEN):
        factor = 1.2 if tuning else 1.0
        values = tuple((n, _stronger(n, v, factor)) for n, v in values)
        out.append(Case(hidden, log, values, first + 50 + k))
    return out


def _stronger(name: str, value: float, factor: float) -> float:
    """A value that departs `factor` times as far from what it is when nothing is hidden; shapes stay."""
    if name in ("waves", "glove_power", "spot_at", "stiction_speed"):
        return value
    still = 1.0 if name in (*RELATIVE, "current_gain") else 0.0
    return still + (value - still) * factor


def record(case: Case, folder: Path) -> None:
    """The set as bags."""
    rng = np.random.default_rng(case.seed)
    simulator: Any = lugre_hand if case.lugre else other_hand
    base = simulator.Hand()
    base = base._replace(
        **{n: getattr(base, n) * math.exp(sd * rng.standard_normal()) for n, sd in SPREAD.items()}
    )
    base = base._replace(**{n: v * getattr(base, n) if n in RELATIVE else v for n, v in case.changes})
    for name, period, grasp in (("slow", 4.0, ""), ("fast", 2.0, ""), ("grasp", 4.0, case.grasp)):
        reference = simulator.reference(period)
        hand = base
        if grasp:
            k, at, damping = OBJECTS[grasp]
            hand = base._replace(object_stiffness=k, object_at=at, object_damping=damping)
        hands = []
        for _ in range(case.repeats):
            moved = {n: getattr(hand, n) * math.exp(sd * rng.standard_normal()) for n, sd in SCATTER.items()}
            moved["zero"] = hand.zero + 0.002 * rng.standard_normal()
            if grasp:
                moved["object_stiffness"] = hand.object_stiffness * math.exp(0.02 * rng.standard_normal())
                moved["object_at"] = hand.object_at + 0.03 * rng.standard_normal()
            hands.append(hand._replace(**moved))
        signals = simulator.closures(hands, reference)
        rest = np.zeros(signals.shape[0] - case.repeats * reference.size)
        commanded = np.concatenate([rest, *([reference] * case.repeats)])
        _write(folder / name, commanded, signals, simulator.TICK, case.log, rng)


def _write(
    folder: Path,
    reference: np.ndarray,
    signals: np.ndarray,
    period: float,
    log: str,
    rng: np.random.Generator,
) -> None:
    rate, window, rectified, reference_rate = LOGS[log.removesuffix(AND_VOLTAGE)]
    width = round(window / period)
    current = np.abs(signals[:, 1]) if rectified else signals[:, 1]
    total = np.concatenate([np.zeros(width), np.cumsum(current)])
    current = (total[width:] - total[:-width]) / width
    at = np.arange(int(reference.size * period * rate)) / rate + 3e-4
    tick = np.minimum((at / period).astype(int), reference.size - 1)
    amperes = current[tick] + 0.005 * rng.standard_normal(tick.size)
    amperes = np.abs(amperes) if rectified else amperes
    stamps = at + np.abs(rng.normal(0.0, 1e-3, at.size))
    told = np.arange(int(reference.size * period * reference_rate)) / reference_rate
    values = reference[(told / period + 1e-6).astype(int)]
    events = [(float(a), 0, float(v)) for a, v in zip(told, values, strict=True)]
    events += [(float(a), 1, float(v)) for a, v in zip(stamps, signals[tick, 0], strict=True)]
    events += [(float(a), 2, float(v)) for a, v in zip(stamps, amperes, strict=True)]
    topics = [("reference_position", FLOAT), ("motor/state", JOINTS), ("motor/current", FLOAT)]
    if log.endswith(AND_VOLTAGE):
        volts = signals[tick, 2] + 0.005 * rng.standard_normal(tick.size)
        events += [(float(a), 3, float(v)) for a, v in zip(stamps, volts, strict=True)]
        topics.append(("motor/voltage", FLOAT))
    with Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer:
        to = [writer.add_connection(f"/hannes/{t}", kind.__msgtype__, typestore=STORE) for t, kind in topics]
        none = np.zeros(0)
        for a, which, value in sorted(events):
            stamp = int((1.7e9 + a) * 1e9)
            message: Any = FLOAT(value)
            if which == 1:
                header = HEADER(TIME(stamp // 10**9, stamp % 10**9), "")
                message = JOINTS(header, ["motor_pulley"], np.array([value]), none, none)
            writer.write(to[which], stamp + 1_000_000, STORE.serialize_cdr(message, message.__msgtype__))


def trials_of(case: Case) -> list[Trial]:
    """The set, as it is read."""
    if case.log == FULL_LOG:
        hidden = [strength_of(name, 1.0) for name in case.hidden]
        recordings, _ = make_set(Model.load("nominal_mujoco"), hidden, seed=case.seed, closures=case.repeats)
        trials = [make_trial(r) for r in recordings]
        return [
            replace(t, options={k: v for k, v in t.options.items() if k not in DESCRIBES}) for t in trials
        ]
    with tempfile.TemporaryDirectory() as folder:
        record(case, Path(folder))
        return load_trials([Path(folder)])


def run_case(case: Case) -> dict[str, Any]:
    """Record, diagnose with the nominal model, compare with the truth."""
    trials = trials_of(case)
    start = time.monotonic()
    model = Model.load()
    found = diagnose(prepare(trials, model), effect_sources(model=model))
    return {
        "hidden": sorted(case.hidden),
        "log": case.log,
        "changes": dict(case.changes),
        "seed": case.seed,
        "verdict": found.verdict,
        "named": sorted(e.name for e in found.effects) if found.verdict == "effects" else [],
        "tied": [sorted(t) for t in found.tied],
        "falls": [[f.added, f.held_out, dict(f.by_condition)] for f in found.falls],
        "costs": dict(found.costs),
        "prior_sds": {name: row["prior_sds"] for name, row in found.nuisances.items()},
        "seconds": time.monotonic() - start,
    }


def as_hidden(result: dict[str, Any]) -> bool:
    """As in identification.py; what is in no catalogue must be called unknown."""
    if result["hidden"] and result["hidden"][0] in OUTSIDE:
        return bool(result["verdict"] == "unknown")
    return identification.as_hidden(result)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--jobs", type=int, default=2)
    which = parser.add_mutually_exclusive_group()
    which.add_argument("--tuning", action="store_true", help="other seeds and strengths")
    which.add_argument("--full-hand", action="store_true", help="closures of the full hand, undescribed")
    which.add_argument("--lugre", action="store_true", help="the hand of bristles instead of the other one")
    which.add_argument("--wound", action="store_true", help="both, resting off their open stop")
    which.add_argument("--voltage", action="store_true", help="recordings that have the motor's voltage too")
    parser.add_argument("--out", type=Path, default=Path("out/foreign"), help="folder of the kept results")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    if options.full_hand:
        todo = full_hand_cases()
    elif options.lugre:
        todo = lugre_cases()
    elif options.wound:
        todo = wound_cases()
    elif options.voltage:
        todo = voltage_cases()
    else:
        todo = cases(options.tuning)
    runs = Parallel(n_jobs=options.jobs, return_as="generator")(
        delayed(kept)(run_case, c, options.out / f"{c.key}.json") for c in todo
    )
    results = []
    for k, r in enumerate(runs):
        results.append(r)
        what = " + ".join(r["hidden"]) or "nothing"
        said = " + ".join(r["named"]) or r["verdict"]
        ties = "".join(f", tied with {' + '.join(t)}" for t in r["tied"] if t != r["named"])
        errors = " -> ".join(f"{f[1]:.1f}" for f in r["falls"][1:])
        mark = "ok " if as_hidden(r) else "NOT"
        print(
            f"[{k + 1}/{len(todo)}] {mark} {what}, {r['log']}: {said}{ties}; held out {errors} ({r['seconds']:.0f} s)",
            flush=True,
        )
    for label, part in (
        ("nothing hidden: answered nothing", [r for r in results if not r["hidden"]]),
        (
            "one hidden: named, or in a tie",
            [r for r in results if len(r["hidden"]) == 1 and r["hidden"][0] not in OUTSIDE],
        ),
        ("two hidden: both", [r for r in results if len(r["hidden"]) == 2]),
        ("in no catalogue: unknown", [r for r in results if r["hidden"] and r["hidden"][0] in OUTSIDE]),
    ):
        if part:
            print(f"{label:<40} {sum(map(as_hidden, part))} of {len(part)}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
