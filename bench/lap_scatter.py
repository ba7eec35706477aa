"""How often intervals hold the truth where friction is another in each lap: `python bench/lap_scatter.py [--laps 6]`.

The mass of `tests/lab/single_mass_rig.py` with Coulomb friction and a ripple; dry and viscous friction differ by 8 %
from lap to lap, and no tolerance speaks of it.  All parameters are fitted from the truth; printed is how many of the
95 % intervals hold it, from the curvature alone and as wide as the laps' own scatter makes them
(`hannes_lab.intervals`).
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
from hannes_description.model import Model
from hannes_lab.fit import fit
from hannes_lab.intervals import NORMAL, sway
from hannes_lab.prepare import prepare
from hannes_lab.problem import effect_coordinates, nuisance_coordinate, vanishing_entry
from hannes_lab.rig import load_rig
from hannes_lab.secants import over_its_spread
from hannes_sim.effect import load_effect
from hannes_sim.factory import make_plant
from hannes_sim.rollout import rollout

sys.path.insert(0, str(Path(__file__).parents[1] / "tests"))
from lab.single_mass_rig import reference, write_files

ADAPTER = f"{Path(__file__).parents[1] / 'tests' / 'lab' / 'single_mass_rig.py'}:SingleMass"
SCATTER, MOST_LAPS = 0.08, 8
TRUTH = {
    "motor.armature": 2.1,
    "friction.viscous": 5.0,
    "coulomb_friction.level": 1.2,
    "cogging.sine": 0.3,
    "cogging.cosine": 0.2,
    "cogging.period": 2.5e-3,
}

LAPS = f'''
from hannes_sim.effect import Effect, EffectParameter
from hannes_sim.ports import DAMPING, FRICTION, T


class Laps(Effect):
    """Dry and viscous friction of each lap."""

    name = "laps"
    parameters = (
        *(EffectParameter(f"dry{{k}}", "N", -9.0, 9.0, 0.1, 0.0) for k in range({MOST_LAPS})),
        *(EffectParameter(f"viscous{{k}}", "N.s/m", -9.0, 9.0, 0.1, 0.0) for k in range({MOST_LAPS})),
        EffectParameter("lap", "s", 0.1, 99.0, 1.0, None),
    )

    @staticmethod
    def contribute(x, p, s, y):
        k = min(int(x[T] / p[2 * {MOST_LAPS}]), {MOST_LAPS} - 1)
        y[FRICTION] += p[k]
        y[DAMPING] += p[{MOST_LAPS} + k]
'''


def record(folder: Path, rig: Any, laps: int, seed: int) -> None:
    """One recording of the mass whose friction scatters, with noise of 5 um and 0.06 N."""
    rng, machine = np.random.default_rng(seed), rig([])
    write_files(folder)
    (folder / "laps.py").write_text(LAPS)
    model = Model.load(folder / "mass.yaml").with_values(
        {name: TRUTH[name] for name in ("motor.armature", "friction.viscous")}
    )
    for name in ("coulomb_friction", "cogging"):
        own = {k.partition(".")[2]: v for k, v in TRUTH.items() if k.startswith(name)}
        model = model.with_effect(machine.effect(load_effect(name)).entry(own))
    source = f"{folder / 'laps.py'}:Laps"
    scattered = {"lap": reference(1).size * 1e-3}
    for k in range(MOST_LAPS):
        scattered[f"dry{k}"] = SCATTER * TRUTH["coulomb_friction.level"] * rng.standard_normal()
        scattered[f"viscous{k}"] = SCATTER * TRUTH["friction.viscous"] * rng.standard_normal()
    model = model.with_effect(load_effect(source).entry(scattered, source=source))
    run = rollout(make_plant(model), machine.controller(model, 1e-3), reference(laps))
    np.savez(
        folder / "mass.npz",
        reference=run.reference_position,
        position=run.encoder_position + 5e-6 * rng.standard_normal(run.time.size),
        force=run.motor_voltage + 0.06 * rng.standard_normal(run.time.size),
    )


def held(laps: int, pooled: bool, seed: int) -> dict[str, tuple[bool, bool]]:
    """Per parameter whether its interval holds the truth: by the curvature, and by the laps' scatter."""
    rig = load_rig(ADAPTER)
    rig.pooled = pooled
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        record(folder, rig, laps, seed)
        prepared = prepare(rig.read([folder / "mass.npz"]), Model.load(folder / "mass.yaml"), rig=rig)
    model, coordinates = prepared.model, [nuisance_coordinate(n) for n in prepared.nuisances]
    for name in ("coulomb_friction", "cogging"):
        kind = prepared.rig.effect(load_effect(name))
        model = model.with_effect(vanishing_entry(kind, None, {"period": TRUTH["cogging.period"]}))
        coordinates += effect_coordinates(kind)
    start = {c.name: c.z(TRUTH[c.name]) for c in coordinates if c.name in TRUTH}
    found = over_its_spread(
        prepared.problem, fit(prepared.problem, model, coordinates, start, evaluations=40)
    )
    wider = sway(prepared.problem, found)
    out = {}
    for c, z, sd in zip(found.coordinates, found.z, found.sd(), strict=True):
        if c.name in TRUTH:
            off = abs(float(z) - c.z(TRUTH[c.name])) / float(sd)
            out[c.name] = off <= NORMAL, off <= NORMAL * wider[c.name]
    return out


def main() -> None:
    """Print one line per parameter."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--recordings", type=int, default=20)
    parser.add_argument("--laps", type=int, default=6, help=f"at most {MOST_LAPS}")
    parser.add_argument("--pooled", action="store_true", help="every sample counts alike")
    given = parser.parse_args()
    rows = [held(given.laps, given.pooled, seed) for seed in range(given.recordings)]
    for name in rows[0]:
        plain, wide = (sum(row[name][k] for row in rows) for k in range(2))
        print(f"{name:<24} {plain:3d} of {len(rows)} by the curvature, {wide:3d} by the laps' own scatter")


if __name__ == "__main__":
    main()
