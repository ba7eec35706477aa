"""A real machine, the EMPS bench: `python bench/emps.py [DATA_EMPS.mat] [--jobs N] [--picture FILE]`.

Grows a model from mass and viscous friction by `--greedy` and prints what each effect is worth on moves that took no
part in its fit: by closed-loop simulation, and of the force by inverse dynamics (then fitted so).  If the second
recording of the machine, DATA_EMPS_PULSES.mat, lies beside the first, the final model's error on it is printed too.
The data are not part of the project; their default place is $HANNES_DATA/emps/DATA_EMPS.mat.  Interrupted, it goes on
where it stopped.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Callable
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
from hannes_description.model import Model
from hannes_lab.cache import Store
from hannes_lab.diagnose import diagnose, effect_sources
from hannes_lab.diagnosis import Diagnosis
from hannes_lab.errors import pooled_repeatability
from hannes_lab.executor import Executor
from hannes_lab.inverse import force_residual, rows
from hannes_lab.prepare import Prepared, prepare
from hannes_lab.problem import effect_coordinates, nuisance_coordinate, values_at, vanishing_entry
from hannes_lab.rig import PlantRig, load_rig
from hannes_sim.effect import load_effect
from numpy.typing import NDArray
from scipy.io import loadmat
from scipy.optimize import least_squares

Array = NDArray[np.float64]

DISTURBED = 0.15
"""Seconds after an edge of the pulses of the second recording for which the axis is off its course."""

ROOT = Path(__file__).resolve().parents[1]
DATA = Path(os.environ.get("HANNES_DATA", ROOT.parent / "shared" / "data")) / "emps" / "DATA_EMPS.mat"


def left_out(
    prepared: Prepared, names: tuple[str, ...], start: dict[str, float]
) -> tuple[dict[str, float], float]:
    """Parameters of a set fitted to the force of all moves by inverse dynamics, and its error on moves left out, N."""
    rig, trial = prepared.rig, prepared.features.trials[0]
    model, coordinates = prepared.model, [nuisance_coordinate(n) for n in prepared.nuisances]
    for name in names:
        kind = rig.effect(load_effect(name))
        model = model.with_effect(vanishing_entry(kind, None))
        coordinates += effect_coordinates(kind)
    low, high = np.array([c.bounds for c in coordinates]).T

    def values(z: Array) -> dict[str, float]:
        return values_at(coordinates, z)

    def fitted(z: Array, used: NDArray[np.bool_]) -> Array:
        def residual(point: Array) -> Array:
            return force_residual(rig, model, values(point), trial)[used]

        inside = np.clip(z, low + 1e-9, high - 1e-9)
        steps = np.array([1e-3 * c.step if c.log else c.step for c in coordinates])
        found = least_squares(
            residual, inside, jac=lambda p: _slopes(residual, p, steps, high), bounds=(low, high), max_nfev=10
        )
        return np.asarray(found.x, dtype=np.float64)

    own = {c: rows(trial, c) for c in trial.conditions}
    moving = np.logical_or.reduce(list(own.values()))
    whole = fitted(np.array([c.z(start[c.name]) for c in coordinates]), moving)
    power, ticks = 0.0, 0
    for used in own.values():
        z = fitted(whole, moving & ~used)
        power += float(np.sum(force_residual(rig, model, values(z), trial)[used] ** 2))
        ticks += int(used.sum())
    return values(whole), float(np.sqrt(power / ticks))


def undisturbed(path: Path, period: float) -> NDArray[np.bool_]:
    """Which ticks of the second recording are not within DISTURBED after an edge of its force pulses."""
    pulses = np.asarray(loadmat(path)["pulses_N"], float).ravel()
    out = np.ones(pulses.size, dtype=bool)
    for edge in np.flatnonzero(np.diff(pulses)):
        out[edge + 1 : edge + 1 + round(DISTURBED / period)] = False
    return out


def on_second_recording(
    kind: type[PlantRig], found: Diagnosis, first: Path, second: Path
) -> list[tuple[str, float, float]]:
    """Errors on the undisturbed ticks of moves: (of what, position in m, force in N).

    Of the model as given, of the final one, and of the first recording itself, taken for a prediction of the second.
    """
    one, two = kind.read([first])[0], kind.read([second])[0]
    rig = kind([two])
    moving = np.logical_or.reduce([rows(two, condition) for condition in two.conditions])
    used = moving & undisturbed(second, two.period)
    measured = {name: values for name, (_, values) in two.signals.items()}
    predicted = {
        "model as given": rig.simulate(Model.load(kind.model), {}, two, two.reference),
        "final model": rig.simulate(found.model, found.values, two, two.reference),
        "first recording": {name: values for name, (_, values) in one.signals.items()},
    }
    out = []
    for what, signals in predicted.items():
        errors = {n: signals[n][: used.size][used] - measured[n][used] for n in measured}
        rms = {n: float(np.sqrt(np.mean(e**2))) for n, e in errors.items()}
        out.append((what, rms["encoder_position"], rms["drive_force"]))
    return out


def draw(found: Diagnosis, repeats: dict[str, float], path: Path) -> None:
    """Error of both signals on moves left out, as effects are added; dashed the repeatability from lap to lap."""
    falls = found.falls[1:]
    labels = ["mass + viscous", *(f"+ {fall.added.replace('_', ' ')}" for fall in falls[1:])]
    figure, axes = plt.subplots(1, 2, figsize=(11, 3.8), sharey=True, layout="constrained")
    for ax, (signal, unit, factor) in zip(
        axes, (("drive_force", "N", 1.0), ("encoder_position", "µm", 1e6)), strict=True
    ):
        errors = [factor * fall.held_out_signals[signal] for fall in falls]
        bars = ax.barh(labels, errors, height=0.5, color="#1064ab")
        ax.bar_label(bars, [f"{e:.2f}" for e in errors], padding=4)
        ax.axvline(
            factor * repeats[signal], color="#117a44", linestyle="--", label="repeatability from lap to lap"
        )
        ax.set_title(f"{signal.replace('_', ' ')}, {unit}", loc="left")
        ax.set_xlim(0.0, 1.12 * max(errors))
        ax.spines[["top", "right"]].set_visible(False)
    axes[0].invert_yaxis()
    axes[1].legend(frameon=False, loc="lower right")
    figure.savefig(path, dpi=100)


def _slopes(residual: Callable[[Array], Array], z: Array, steps: Array, high: Array) -> Array:
    here = residual(z)
    columns = []
    for k, size in enumerate(steps):
        step = -size if z[k] + size > high[k] else size
        columns.append((residual(z + step * np.eye(z.size)[k]) - here) / step)
    return np.column_stack(columns)


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", nargs="?", type=Path, default=DATA)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--picture", type=Path, help="draw the fall of the error into this file, too")
    options = parser.parse_args()
    if not options.data.is_file():
        print(f"no {options.data}: nothing is measured; give the path of DATA_EMPS.mat", file=sys.stderr)
        return 0
    rig = load_rig(f"{ROOT / 'examples' / 'emps' / 'emps.py'}:Emps")
    model = Model.load(rig.model)
    prepared = prepare(rig.read([options.data]), model, rig=rig)
    with Executor(options.jobs, store=Store()) as executor:
        found = diagnose(prepared, effect_sources(model=model), executor=executor, max_effects=7, greedy=True)
    names = tuple(e.name for e in found.effects)
    print(f"{'added':<32} {'position, um':>14} {'force, N':>10} {'inverse dynamics, N':>21}")
    for k, fall in enumerate(found.falls[1:]):
        held = fall.held_out_signals
        _, inverse = left_out(prepared, names[:k], dict(found.values))
        print(
            f"{fall.added:<32} {1e6 * held['encoder_position']:>14.2f} {held['drive_force']:>10.2f} {inverse:>21.2f}"
        )
    print(f"mass {found.values['motor.armature']:.2f} kg, {len(names)} effects", end="")
    print(f", ripple {1e3 * found.values['cogging.period']:.4f} mm" if "cogging" in names else "")
    second = options.data.with_name("DATA_EMPS_PULSES.mat")
    if second.is_file():
        print(f"\n{'on the second recording':<32} {'position, um':>14} {'force, N':>10}")
        for what, position, force in on_second_recording(rig, found, options.data, second):
            print(f"{what:<32} {1e6 * position:>14.2f} {force:>10.2f}")
    if options.picture:
        draw(found, pooled_repeatability(prepared.features), options.picture)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
