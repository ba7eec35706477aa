"""Speed of the reduced plant in the closed loop, and of one evaluation of the lab: `python bench/reduced.py`.

Prints real-time factors (target: at least 500), what an effect adds, and where the time goes.
"""

from __future__ import annotations

import time
from collections.abc import Callable

from hannes_control.double_pid import DoublePID
from hannes_control.reference import half_sine
from hannes_description.model import Model
from hannes_sim.effect import catalogue
from hannes_sim.factory import make_plant
from hannes_sim.objects import OBJECTS
from hannes_sim.rollout import rollout

TARGET = 500.0
REPEATS = 7


def best_of(run: Callable[[], object]) -> float:
    """Shortest of a few runs, s of wall time; the first one, which compiles, does not count."""
    run()
    times = []
    for _ in range(REPEATS):
        start = time.perf_counter()
        run()
        times.append(time.perf_counter() - start)
    return min(times)


def main() -> int:
    model = Model.load("nominal")
    law = DoublePID.of_model(model.parameters)
    reference = half_sine(10)
    seconds = reference.size * law.period
    print(
        f"closed loop, {seconds:g} s simulated, plant step {make_plant(model).dt * 1e3:g} ms, control 1 kHz"
    )
    worst = float("inf")
    base = 0.0
    for name, grasp in OBJECTS.items():
        plant = make_plant(model, grasp)
        taken = best_of(lambda plant=plant: rollout(plant, law, reference, joints=False))  # type: ignore[misc]
        base = base or taken
        worst = min(worst, seconds / taken)
        steps = seconds / plant.dt
        print(f"  object {name:<6} {seconds / taken:8.0f} x real time   {1e9 * taken / steps:6.1f} ns a step")
    many = model
    for effect in catalogue().values():
        many = many.with_effect(effect.entry())
    plant = make_plant(many)
    taken = best_of(lambda: rollout(plant, law, reference, joints=False))
    added = 1e9 * (taken - base) / (seconds / plant.dt) / len(catalogue())
    print(
        f"  with all {len(catalogue())} effects {seconds / taken:6.0f} x real time   {added:6.1f} ns a step and effect"
    )
    whole = best_of(lambda: rollout(make_plant(model), law, reference))
    print(f"  logging the finger joints too and building the plant: {whole / base:.2f} times as long")
    print(f"target {TARGET:g} x: {'reached' if worst >= TARGET else 'missed'} (slowest {worst:.0f} x)")
    return 0 if worst >= TARGET else 1


if __name__ == "__main__":
    raise SystemExit(main())
